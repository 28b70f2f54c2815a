# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The table of rows: a target is a weighted set of filters, each under one assumption.

A row is one filter of a `bank` under one assumption: a scale of the covariances, a depth at which
the target began, a side of the array, a history of associations. The rows of all targets lie in
one table, so that every verb runs over all of them at once; rows that belong to the same target
lie side by side, and their weights sum to one.

Rows begin and end at run time. `Rows.key` says what a row assumes, by name; a row that is copied
has its origin in `parent`, the row of the table before, so that a smoother can follow it back.

No array in a table is ever written again: tables of earlier scans share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import evolve, field, frozen
import numpy as np

from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .bank import Gaussians

__all__ = ['Rows']

MOST_ROWS = 32
"""Rows of a target; the least probable ones leave."""


@frozen(eq=False)
class Rows:
    """N rows of M models each.

    blocks: states of the models, see `bank`; mu (N, M): probabilities of the models in each row,
    which sum to one; logw (N,): logarithms of the weights of the rows, which sum to one for each
    target; target (N,): the place of the target, in rising order; parent (N,): the row of the
    table before, -1 for none; key: what each row assumes, by name, (N,) each.
    """

    blocks: tuple[Gaussians, ...]
    mu: FloatArray
    logw: FloatArray
    target: IntArray
    parent: IntArray
    key: Mapping[str, np.ndarray] = field(factory=dict)

    def __len__(self) -> int:
        return len(self.mu)

    @property
    def first(self) -> IndexArray:
        """(T,) the first row of each target that has one."""
        return np.unique(self.target, return_index=True)[1]

    @property
    def weight(self) -> FloatArray:
        """(N,) the weights of the rows of each target."""
        return np.exp(self.logw)

    def take(self, rows: IndexArray) -> Rows:
        """Return those rows, in that order, each as often as it is named; `parent` says which they
        were."""
        return Rows(
            tuple(block.rows(rows) for block in self.blocks),
            self.mu[rows],
            self.logw[rows],
            self.target[rows],
            np.asarray(rows, np.int64),
            {name: column[rows] for name, column in self.key.items()},
        )

    def of_targets(self, kept: BoolArray) -> Rows:
        """Return the rows of the targets where `kept` (T,) is True, which are numbered anew."""
        chosen = self.take(np.flatnonzero(kept[self.target]))
        return evolve(chosen, target=(np.cumsum(kept) - 1)[chosen.target])

    def append(self, new: Rows) -> Rows:
        """Return the table with more rows, of targets already there or of new ones.

        Raises ValueError when the new rows assume something else by name.
        """
        if set(new.key) != set(self.key):
            raise ValueError(f'rows with {sorted(new.key)} do not fit {sorted(self.key)}')
        blocks = tuple(
            Gaussians(*(np.concatenate(parts) for parts in zip(ours, theirs)))
            for ours, theirs in zip(self.blocks, new.blocks)
        )
        both = Rows(
            blocks,
            np.concatenate([self.mu, new.mu]),
            np.concatenate([self.logw, new.logw]),
            np.concatenate([self.target, new.target]),
            np.concatenate([self.parent, np.full(len(new), -1)]),
            {name: np.concatenate([self.key[name], new.key[name]]) for name in self.key},
        )
        order = np.argsort(both.target, kind='stable')
        return evolve(both.take(order), parent=both.parent[order])

    def reweighed(self, log_likelihood: FloatArray) -> tuple[Rows, FloatArray]:
        """Return the rows after evidence of `log_likelihood` (N,), and the logarithm (T,) of the
        evidence of each target. A target none of whose rows explains it keeps its weights."""
        log = self.logw + log_likelihood
        total = self.log_sum(log)
        known = np.isfinite(total)[self._place]
        after = np.where(known, log - np.where(known, total[self._place], 0.0), self.logw)
        return evolve(self, logw=after), total

    def log_sum(self, log: FloatArray) -> FloatArray:
        """Return ln sum exp (T, ...) over the rows of each target of `log` (N, ...)."""
        if not len(log):
            return np.empty((0, *log.shape[1:]))
        top = np.maximum.reduceat(log, self.first)
        top = np.where(np.isfinite(top), top, 0.0)
        with np.errstate(divide='ignore'):
            return np.asarray(
                top + np.log(np.add.reduceat(np.exp(log - top[self._place]), self.first))
            )

    def spread(self, share: float) -> Rows:
        """Return the rows after `share` of the weight of each target was spread evenly over its
        rows, so that an assumption that becomes true is noticed."""
        count = np.bincount(self._place)[self._place]
        return evolve(self, logw=np.log((1.0 - share) * self.weight + share / count))

    def pruned(self, least: float, most: int = MOST_ROWS) -> Rows:
        """Return the rows without those below `least` in weight, and at most `most` of each
        target; the heaviest row of a target stays. Weights sum to one again."""
        order = np.lexsort((-self.logw, self._place))
        rank = np.empty(len(self), np.int64)
        rank[order] = np.arange(len(self)) - self.first[self._place[order]]
        kept = (rank == 0) | ((self.weight >= least) & (rank < most))
        chosen = self if kept.all() else self.take(np.flatnonzero(kept))
        return evolve(chosen, logw=chosen.logw - chosen.log_sum(chosen.logw)[chosen._place])

    @property
    def _place(self) -> IndexArray:
        """(N,) the place of each row's target among those that have rows."""
        return np.asarray(np.unique(self.target, return_inverse=True)[1])

    def combine(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean (T, q) and covariance (T, q, q) of each target, of those of its rows (N, q),
        (N, q, q)."""
        w = self.weight[:, None]
        centre = np.add.reduceat(w * mean, self.first)
        d = mean - centre[self._place]
        spread = covariance + d[:, :, None] * d[:, None]
        return centre, np.add.reduceat(w[..., None] * spread, self.first)

    def models(self) -> FloatArray:
        """Return the probabilities (T, M) of the models of each target, over all its rows."""
        return np.asarray(np.add.reduceat(self.weight[:, None] * self.mu, self.first))

    def replace(self, **changes: Any) -> Rows:
        """Return the rows with other blocks, mu, logw or key."""
        return evolve(self, **changes)
