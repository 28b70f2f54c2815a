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
the target began, a side of the array, an offset of a sensor. The rows of all targets lie in one
table, so that every verb runs over all of them at once; rows that belong to the same target lie
side by side.

Rows begin and end at run time. `Rows.key` says what a row assumes, by name. `parent` is the row of
the table before that it came from, so that a smoother can follow it back.

*Borrowing.* A scale of the covariances changes how a filter goes on, not what it is. So a scale
that has become improbable need not be computed: it loses its row and keeps its weight in a list
(`Borrowed`), reckoned from a row of the same target. When it becomes probable again, it gets a
copy of that row. Nothing else may borrow: a start depth *is* its state.

No array in a table is ever written again: tables of earlier scans share them.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any

from attrs import evolve, field, frozen
import numpy as np

from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .bank import Gaussians

__all__ = ['Borrowed', 'log_sum', 'reduce_targets', 'restore_rows', 'Rows', 'drop_weightless_rows']

LEAST_LOG = -345.0
"""Logarithm of the weight, 1e-150, that a row keeps: it may become true later."""

ROW_LOST, ROW_AGAIN = 1e-4, 1e-3
"""Weights below which an assumption that may borrow loses its row, and above which it gets one
again."""


@frozen(eq=False, slots=False)
class Rows:
    """N rows of M models each, of T targets, each of which has at least one.

    blocks: states of the models, see `bank`; mu (N, M): probabilities of the models in each row,
    which sum to one; logw (N,): logarithms of the weights of the rows, which sum to one for each
    target, but for what is `Borrowed`; target (N,): the place of the target, in rising order;
    parent (N,): the row of the table before, -1 for none; key: what each row assumes, by name,
    (N,) each.
    """

    blocks: tuple[Gaussians, ...]
    mu: Annotated[FloatArray, 'NM']
    logw: Annotated[FloatArray, 'N']
    target: Annotated[IntArray, 'N']
    parent: Annotated[IntArray, 'N']
    key: dict[str, np.ndarray] = field(factory=dict)

    def __len__(self) -> int:
        return len(self.mu)

    @cached_property
    def first(self) -> IndexArray:
        """(T,) the first row of each target."""
        return _first_rows(self.target)

    @cached_property
    def weight(self) -> FloatArray:
        """(N,) the weights of the rows of each target; they sum to one."""
        return self.weights_among(np.ones(len(self), np.bool_))

    def weights_among(self, counted: BoolArray) -> FloatArray:
        """Return the weights (N,) of the rows among those that are `counted` (N,), of targets that
        have none of these among all."""
        if not len(self):
            return np.empty(0)
        first = self.first
        none = ~np.logical_or.reduceat(counted, first)
        weight = np.where(counted | none[self.target], np.exp(self.logw), 0.0)
        return weight / np.add.reduceat(weight, first)[self.target]

    def normalized_weight(self) -> FloatArray:
        """Return the weights (N,) of the rows of one target, whatever its place."""
        weight = np.exp(self.logw - self.logw.max())
        return np.asarray(weight / weight.sum())

    def select(self, rows: IndexArray) -> Rows:
        """Return those rows, in that order, each as often as it is named; `parent` says which they
        were."""
        return Rows(
            tuple(block.select(rows) for block in self.blocks),
            self.mu[rows],
            self.logw[rows],
            self.target[rows],
            np.asarray(rows, np.int64),
            {name: column[rows] for name, column in self.key.items()},
        )

    def select_targets(self, kept: BoolArray) -> Rows:
        """Return the rows of the targets where `kept` (T,) is True, which are numbered anew; their
        parents stay."""
        rows = np.flatnonzero(kept[self.target])
        renumbered = (np.cumsum(kept) - 1)[self.target[rows]]
        return evolve(self.select(rows), target=renumbered, parent=self.parent[rows])

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
            np.concatenate([self.parent, new.parent]),
            {name: np.concatenate([self.key[name], new.key[name]]) for name in self.key},
        )
        if (np.diff(both.target) >= 0).all():
            return both
        order = np.argsort(both.target, kind='stable')
        return evolve(both.select(order), parent=both.parent[order])

    def replace_target(self, target: int, new: Rows) -> Rows:
        """Return the table in which `new` are the rows of one target, without parents."""
        left = self.select(np.flatnonzero(self.target != target))
        left = evolve(left, parent=self.parent[left.parent])
        count = len(new)
        return left.append(evolve(new, target=np.full(count, target), parent=np.full(count, -1)))

    def multiply_models(self, factor: FloatArray) -> tuple[Rows, FloatArray]:
        """Return the rows after the probabilities of their models were multiplied by `factor` (N,
        M), and by what (N,) that multiplied the weight of each row."""
        mu = self.mu * factor
        total = mu.sum(axis=1)
        known = total > 0.0
        mu = np.where(known[:, None], mu / np.where(known, total, 1.0)[:, None], self.mu)
        return evolve(self, mu=mu), total

    def log_sum(self, log: FloatArray) -> FloatArray:
        """Return ln sum exp (T, ...) over the rows of each target of `log` (N, ...)."""
        return log_sum(log, self.target)

    def combine(
        self, mean: FloatArray, covariance: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (T, q) and covariance (T, q, q) of each target, of those of its rows (N, q),
        (N, q, q) with `weight` (N,)."""
        if not len(self):
            return mean, covariance
        w, first = weight[:, None], self.first
        centre = np.add.reduceat(w * mean, first)
        d = mean - centre[self.target]
        spread = covariance + d[:, :, None] * d[:, None]
        return centre, np.add.reduceat(w[..., None] * spread, first)

    def model_probabilities(self) -> FloatArray:
        """Return the probabilities (T, M) of the models of each target, over all its rows."""
        if not len(self):
            return self.mu
        return np.asarray(np.add.reduceat(self.weight[:, None] * self.mu, self.first))

    def replace(self, **changes: Any) -> Rows:
        """Return the rows with other blocks, mu, logw or key."""
        return evolve(self, **changes)


def _first_rows(target: IntArray) -> IndexArray:
    """Return where each target begins, of targets (A,) in rising order."""
    changes = np.ones(len(target), np.bool_)
    np.not_equal(target[1:], target[:-1], out=changes[1:])
    return changes.nonzero()[0]


def reduce_targets(verb: np.ufunc, values: np.ndarray, target: IntArray) -> np.ndarray:
    """Return what a verb such as ``np.maximum`` makes of all that belongs to each target, (T,
    ...): values (A, ...), target (A,) in rising order, each of T there."""
    if not len(values):
        return values
    return np.asarray(verb.reduceat(values, _first_rows(target)))


def log_sum(log: FloatArray, target: IntArray) -> FloatArray:
    """Return ln sum exp (T, ...) of what belongs to each target: log (A, ...), target (A,) in
    rising order, each of T there."""
    if not len(log):
        return np.empty((0, *log.shape[1:]))
    first = _first_rows(target)
    top = np.maximum.reduceat(log, first)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide='ignore'):
        return np.asarray(top + np.log(np.add.reduceat(np.exp(log - top[target]), first)))


@frozen(eq=False)
class Borrowed:
    """Assumptions without a row of their own: target (B,), the `key` (B,) they are known by, and
    the logarithms of their weights (B,)."""

    target: Annotated[IntArray, 'b']
    key: Annotated[FloatArray, 'b']
    logw: Annotated[FloatArray, 'b']

    @classmethod
    def empty(cls) -> Borrowed:
        """Return an empty list."""
        return cls(np.empty(0, np.int64), np.empty(0), np.empty(0))

    def __len__(self) -> int:
        return len(self.target)

    def select_targets(self, kept: BoolArray) -> Borrowed:
        """Return those of the targets where `kept` (T,) is True, which are numbered anew."""
        own = kept[self.target]
        return Borrowed((np.cumsum(kept) - 1)[self.target[own]], self.key[own], self.logw[own])

    def without_target(self, target: int) -> Borrowed:
        """Return those of all other targets."""
        other = self.target != target
        return Borrowed(self.target[other], self.key[other], self.logw[other])

    def find_lenders(self, rows: Rows, name: str) -> IndexArray:
        """Return the row (B,) of the same target that each is reckoned from: the nearest by the
        logarithm of the key `name`, of two as near the heavier."""
        if not len(self):
            return np.empty(0, np.intp)
        apart = np.abs(np.log(rows.key[name]) - np.log(self.key)[:, None])
        apart = np.where(rows.target == self.target[:, None], apart - 1e-9 * rows.logw, np.inf)
        return np.asarray(apart.argmin(axis=1))


def drop_weightless_rows(
    rows: Rows, borrowed: Borrowed, name: str, stays: BoolArray
) -> tuple[Rows, Borrowed, IndexArray]:
    """Return rows and list after rows that lost their weight were left out, but for those that
    `stays` (N,), and which rows are left. name: of the key that may borrow."""
    lost = (rows.logw < np.log(ROW_LOST)) & ~stays
    left = np.flatnonzero(~lost)
    if len(left) == len(rows):
        return rows, borrowed, left
    target = np.concatenate([borrowed.target, rows.target[lost]])
    key = np.concatenate([borrowed.key, rows.key[name][lost]])
    new = Borrowed(target, key, np.concatenate([borrowed.logw, rows.logw[lost]]))
    return evolve(rows.select(left), parent=rows.parent[left]), new, left


def restore_rows(
    rows: Rows, borrowed: Borrowed, name: str, again: BoolArray
) -> tuple[Rows, Borrowed]:
    """Return rows and list after assumptions `again` (B,) got a row, a copy of their lender."""
    if not again.any():
        return rows, borrowed
    back, waiting = (
        Borrowed(borrowed.target[own], borrowed.key[own], borrowed.logw[own])
        for own in (again, ~again)
    )
    lender = back.find_lenders(rows, name)
    copies = evolve(rows.select(lender), logw=back.logw, parent=rows.parent[lender])
    return rows.append(evolve(copies, key={**copies.key, name: back.key})), waiting
