# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Marginals where rows of a target exclude other targets, against full enumeration."""

from pathlib import Path

import numpy as np
import pytest

from sonar_imm.estimation.linked_rows import linked_marginals, MOST_CLASSES
from sonar_imm.estimation.marginals import log_total, marginals

VECTORS = Path(__file__).parents[1] / 'vectors/diver_in_the_field/linked_rows.npz'


def cluster(vectors, number):
    return {
        name.partition('/')[2]: vectors[name]
        for name in vectors
        if name.startswith(f'{number:02d}/')
    }


@pytest.mark.parametrize('number', range(24))
def test_rows_and_fixes_are_those_of_the_enumeration(number):
    with np.load(VECTORS) as vectors:
        own, p = cluster(vectors, number), float(vectors['detection_probability'])
        clutter = float(vectors['clutter'])
    track, weight, link = own['track'], own['weight'], own['link']
    T = int(track.max()) + 1
    linked = np.flatnonzero(link >= 0)
    of = track.copy()
    of[linked] = T + np.arange(len(linked))
    target = np.concatenate([np.arange(T), track[linked]])
    links = np.concatenate([np.full(T, -1), link[linked]])
    ways = ('dir', 'stay', 'leave', 'open')
    density = weight[:, None] * sum(own[way] for way in ways) / clutter
    assigned = np.zeros((len(target), density.shape[1]))
    np.add.at(assigned, of, density)
    alive = (1.0 - p) * np.bincount(of, weight, minlength=len(target))
    missed = alive.copy()
    missed[:T] += 1.0 - np.bincount(track, weight, minlength=T)
    found = linked_marginals(assigned, missed, assigned > 0.0, target, links, T)
    none = found.none[of] * weight * (1.0 - p) / missed[of]
    np.testing.assert_allclose(none, own['after_miss'], atol=1e-12)
    share = found.pair[of] / np.where(assigned[of] > 0.0, assigned[of], 1.0)
    for way in ways:
        after = share * weight[:, None] * own[way] / clutter
        np.testing.assert_allclose(after, own[f'after_{way}'], atol=1e-12)


def test_without_links_they_are_the_marginals():
    rng = np.random.default_rng(0)
    assigned, missed = rng.uniform(size=(5, 4)), rng.uniform(size=5) + 0.1
    possible = rng.uniform(size=(5, 4)) < 0.7
    pair, none = marginals(assigned, missed, possible)
    found = linked_marginals(assigned, missed, possible, np.arange(5), np.full(5, -1), 5)
    np.testing.assert_allclose(found.pair, pair, atol=1e-14)
    np.testing.assert_allclose(found.none, none, atol=1e-14)
    np.testing.assert_array_equal(found.held, 1.0)


def test_more_links_than_classes_leave_out_the_lightest():
    rng = np.random.default_rng(1)
    T, rows = 4, 3
    target = np.concatenate([np.arange(2 * T), np.repeat(np.arange(T), rows)])
    link = np.concatenate([np.full(2 * T, -1), T + np.tile(np.arange(T), rows)])
    G = len(target)
    assigned, missed = rng.uniform(size=(G, 3)), rng.uniform(size=G) + 0.1
    found = linked_marginals(assigned, missed, np.ones((G, 3), bool), target, link, 2 * T)
    assert (1 + rows) ** T > MOST_CLASSES
    used = found.pair.sum(axis=1) + found.none
    assert np.isfinite(used).all() and (used[2 * T :] == 0.0).any() and (used[2 * T :] > 0.0).any()
    assert (found.pair.sum(axis=0) <= 1.0 + 1e-12).all()


def test_the_weight_of_all_events_is_that_of_an_enumeration():
    rng = np.random.default_rng(2)
    for shape in ((3, 2), (2, 3), (3, 3)):
        a, m = rng.uniform(size=shape), rng.uniform(size=shape[0]) + 0.1
        possible = rng.uniform(size=shape) < 0.8

        def total(track, used, a=a, m=m, possible=possible):
            if track == len(m):
                return 1.0
            weight = m[track] * total(track + 1, used)
            for d in range(a.shape[1]):
                if possible[track, d] and d not in used:
                    weight += a[track, d] * total(track + 1, used | {d})
            return weight

        assert log_total(a, m, possible) == pytest.approx(np.log(total(0, frozenset())))
