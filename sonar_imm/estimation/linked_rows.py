# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Association probabilities where some rows of a track exclude other tracks.

The fixes of a burst are those of a target with an offset, or those of another target. So a burst
row of a track and the track that its first fix began exclude each other: the row is *linked* to
the track. The rows of a target form *groups*: the first holds all rows without a link, every
linked row is a group of its own. A *class* selects one group of each target. In a class, tracks
that are linked to a selected group are absent, and the joint events are those of `marginals`. A
class weighs as the sum of its events.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .marginals import clusters, log_total, marginals

MOST_CLASSES = 32
"""Maximum number of classes of a cluster; the lightest links are left out."""


class LinkedMarginals(NamedTuple):
    """Probabilities of pairs of G groups and D detections."""

    pair: FloatArray
    """(G, D)."""
    none: FloatArray
    """(G,) probability that the group holds and has no detection."""
    held: FloatArray
    """(T,) probability of the classes that hold a target."""


def linked_marginals(
    assigned: FloatArray,
    missed: FloatArray,
    possible: BoolArray,
    target: IntArray,
    link: IntArray,
    targets: int,
) -> LinkedMarginals:
    """Return the marginals over all classes.

    :param assigned: (G, D) weight of each group with each detection.
    :param missed: (G,) weight of each group without a detection; the first group of a target
        includes that the target does not exist.
    :param possible: (G, D) False for pairs outside the gate.
    :param target: (G,) target of each group.
    :param link: (G,) target that the group excludes; -1 for none.
    :param targets: number T of targets, each with a group without a link.
    """
    G, D = assigned.shape
    T = targets
    pair, none, held = np.zeros((G, D)), np.zeros(G), np.ones(T)
    label = _clusters_of_links(possible, target, link, T)
    tied = np.isin(label, label[target[link >= 0]])
    plain = np.flatnonzero(~tied[target])
    pair[plain], none[plain] = marginals(assigned[plain], missed[plain], possible[plain])
    for first in np.unique(label[tied]).tolist():
        own = np.flatnonzero(label[target] == first)
        log, found = [], []
        for chosen, absent in _classes(own, target, link, missed + assigned.sum(axis=1)):
            parts = assigned[chosen], missed[chosen], possible[chosen]
            log.append(log_total(*parts))
            found.append((chosen, absent, *marginals(*parts)))
        weight = np.exp(np.array(log) - max(log))
        weight = weight / weight.sum()
        held[np.flatnonzero(label == first)] = 0.0
        for share, (chosen, _, its_pair, its_none) in zip(weight.tolist(), found):
            pair[chosen] += share * its_pair
            none[chosen] += share * its_none
            held[target[chosen]] += share
    return LinkedMarginals(pair, none, held)


def _clusters_of_links(
    possible: BoolArray, target: IntArray, link: IntArray, targets: int
) -> IntArray:
    """Return the first target of the cluster of each target (T,), with the links as common
    detections."""
    linked = np.flatnonzero(link >= 0)
    together = np.zeros((targets, possible.shape[1] + len(linked)), np.bool_)
    group, detection = np.nonzero(possible)
    together[target[group], detection] = True
    column = possible.shape[1] + np.arange(len(linked))
    together[target[linked], column] = True
    together[link[linked], column] = True
    return clusters(together)


def _classes(
    own: IndexArray, target: IntArray, link: IntArray, size: FloatArray
) -> Iterator[tuple[IndexArray, set[int]]]:
    """Yield the groups of each class of the groups `own`, and the absent targets."""
    linked = own[link[own] >= 0]
    choices: dict[int, list[int]] = {int(target[g]): [int(g)] for g in own if link[g] < 0}
    count = 1
    for group in linked[np.argsort(-size[linked], kind='stable')].tolist():
        of_target = choices[int(target[group])]
        if count // len(of_target) * (len(of_target) + 1) > MOST_CLASSES:
            continue
        count = count // len(of_target) * (len(of_target) + 1)
        of_target.append(group)
    for chosen in product(*choices.values()):
        absent = {int(link[group]) for group in chosen if link[group] >= 0}
        left = [group for group in chosen if int(target[group]) not in absent]
        # A linked row of an absent target cannot hold.
        if any(link[group] >= 0 for group in chosen if int(target[group]) in absent):
            continue
        yield np.array(left, np.intp), absent
