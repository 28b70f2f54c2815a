# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Table of rows: a target is a weighted set of filters, each under one assumption.

A row is one filter of a `bank` under one assumption, for example a covariance scale, a start
depth, a side of the array, or a sensor offset. The rows of all targets lie in one table, so each
operation covers all of them at once. The rows of a target are adjacent.

Rows are added and removed at run time. `Rows.key` names the assumptions of each row. `parent` is
the row of the previous table that a row came from, for smoothing.

*Borrowing.* A covariance scale changes the future of a filter, not its current state. So a row of
an improbable scale is removed, and its weight is kept in a list (`Borrowed`) and updated from the
heaviest row of the target. When the scale becomes probable again, it gets a copy of that row.
Other assumptions cannot borrow: a start depth is the state itself.

Arrays are never changed in place, because tables of earlier scans share them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any

from attrs import evolve, field, frozen
import numpy as np

from .arrays import BoolArray, FloatArray, IndexArray, IntArray
from .bank import Gaussians

__all__ = [
    'Borrowed',
    'drop_weightless_rows',
    'log_sum',
    'normalise_weights',
    'reduce_targets',
    'restore_rows',
    'Rows',
    'combine_fixes',
]

NOTHING: Mapping[str, Any] = {}
LEAST_LOG = -345.0
"""Minimum logarithm of a row weight, 1e-150, so that a row can recover."""

ROW_LOST, ROW_AGAIN = 1e-4, 1e-3
"""Weight below which a borrowing assumption loses its row, and weight above which it gets a row
again."""


@frozen(eq=False, slots=False)
class Rows:
    """N rows of M models each, of T targets with at least one row each."""

    blocks: tuple[Gaussians, ...]
    """States of the models, see `bank`."""
    mu: Annotated[FloatArray, 'NM']
    """(N, M) model probabilities of each row; the sum of a row is one."""
    logw: Annotated[FloatArray, 'N']
    """(N,) logarithms of the row weights. The sum over a target is one, with its `Borrowed`
    weights."""
    target: Annotated[IntArray, 'N']
    """(N,) target index, in rising order."""
    parent: Annotated[IntArray, 'N']
    """(N,) row of the previous table; -1 for none."""
    key: dict[str, np.ndarray] = field(factory=dict)
    """Assumptions of each row by name, (N,) each."""
    tail: int = 0
    """Number of last components that belong to an assumption: they are nil in rows without it, and
    they are absent where no row has it."""

    def __len__(self) -> int:
        return len(self.mu)

    @cached_property
    def first(self) -> IndexArray:
        """(T,) first row of each target."""
        return _first_rows(self.target)

    @cached_property
    def heaviest(self) -> IndexArray:
        """(T,) heaviest row of each target, the first of equals."""
        best = np.maximum.reduceat(self.logw, self.first)[self.target]
        own = np.flatnonzero(self.logw == best)
        return own[_first_rows(self.target[own])]

    @cached_property
    def weight(self) -> FloatArray:
        """(N,) row weights, normalised for each target."""
        return self.weights_among(np.ones(len(self), np.bool_))

    def weights_among(self, counted: BoolArray) -> FloatArray:
        """Return weights (N,) normalised over the `counted` (N,) rows of a target, or over all its
        rows if none is counted."""
        if not len(self):
            return np.empty(0)
        first = self.first
        none = ~np.logical_or.reduceat(counted, first)
        weight = np.where(counted | none[self.target], np.exp(self.logw), 0.0)
        return weight / np.add.reduceat(weight, first)[self.target]

    def select(self, rows: IndexArray) -> Rows:
        """Return the rows of the given indices, which may repeat. `parent` holds the indices."""
        return Rows(
            tuple(block.select(rows) for block in self.blocks),
            self.mu[rows],
            self.logw[rows],
            self.target[rows],
            np.asarray(rows, np.int64),
            {name: column[rows] for name, column in self.key.items()},
            self.tail,
        )

    def select_targets(self, kept: BoolArray) -> Rows:
        """Return the rows of the targets selected by `kept` (T,), renumbered.

        Parents do not change.
        """
        rows = np.flatnonzero(kept[self.target])
        renumbered = (np.cumsum(kept) - 1)[self.target[rows]]
        return evolve(self.select(rows), target=renumbered, parent=self.parent[rows])

    def append(self, new: Rows) -> Rows:
        """Append rows of existing or new targets.

        :raises ValueError: the new rows have other keys.
        """
        if set(new.key) != set(self.key):
            raise ValueError(f'rows with {sorted(new.key)} do not fit {sorted(self.key)}')
        tail = max(self.tail, new.tail)
        blocks = tuple(
            Gaussians(*(np.concatenate(parts) for parts in zip(ours, theirs)))
            for ours, theirs in zip(self.with_tail(tail).blocks, new.with_tail(tail).blocks)
        )
        both = Rows(
            blocks,
            np.concatenate([self.mu, new.mu]),
            np.concatenate([self.logw, new.logw]),
            np.concatenate([self.target, new.target]),
            np.concatenate([self.parent, new.parent]),
            {name: np.concatenate([self.key[name], new.key[name]]) for name in self.key},
            tail,
        )
        if (np.diff(both.target) >= 0).all():
            return both
        order = np.argsort(both.target, kind='stable')
        return evolve(both.select(order), parent=both.parent[order])

    def with_tail(self, tail: int) -> Rows:
        """Return the rows with `tail` last components, none of them or new ones, which are nil."""
        if tail == self.tail:
            return self
        blocks = []
        for x, P in self.blocks:
            kept = x.shape[1] - self.tail
            x, P = x[:, :kept], P[:, :kept, :kept]
            if tail:
                x = np.pad(x, ((0, 0), (0, tail), (0, 0)))
                P = np.pad(P, ((0, 0), (0, tail), (0, tail), (0, 0)))
            blocks.append(Gaussians(x, P))
        return evolve(self, blocks=tuple(blocks), tail=tail)

    def replace_target(self, target: int, new: Rows) -> Rows:
        """Replace all rows of one target by `new`, without parents."""
        left = self.select(np.flatnonzero(self.target != target))
        left = evolve(left, parent=self.parent[left.parent])
        count = len(new)
        return left.append(evolve(new, target=np.full(count, target), parent=np.full(count, -1)))

    def multiply_models(self, factor: FloatArray) -> tuple[Rows, FloatArray]:
        """Multiply the model probabilities by `factor` (N, M).

        Return the rows and the sum (N,) of each row before normalisation.
        """
        mu = self.mu * factor
        total = mu.sum(axis=1)
        known = total > 0.0
        mu = np.where(known[:, None], mu / np.where(known, total, 1.0)[:, None], self.mu)
        return evolve(self, mu=mu), total

    def log_sum(self, log: FloatArray) -> FloatArray:
        """Return ln sum exp (T, ...) of `log` (N, ...) over the rows of each target."""
        return log_sum(log, self.target)

    def combine(
        self, mean: FloatArray, covariance: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (T, q) and covariance (T, q, q) of each target, from its rows (N, q), (N, q,
        q) with `weight` (N,)."""
        if not len(self):
            return mean, covariance
        w, first = weight[:, None], self.first
        centre = np.add.reduceat(w * mean, first)
        d = mean - centre[self.target]
        spread = covariance + d[:, :, None] * d[:, None]
        return centre, np.add.reduceat(w[..., None] * spread, first)

    def total(self, values: FloatArray, targets: int) -> FloatArray:
        """Return the sum (T,) of `values` (N,) over the rows of each of `targets` targets."""
        return np.bincount(self.target, values, minlength=targets).astype(np.float64)

    def model_probabilities(self) -> FloatArray:
        """Return the model probabilities (T, M) of each target over all its rows."""
        if not len(self):
            return self.mu
        return np.asarray(np.add.reduceat(self.weight[:, None] * self.mu, self.first))

    def replace(self, **changes: Any) -> Rows:
        """Return the rows with other blocks, mu, logw or key."""
        return evolve(self, **changes)


def _first_rows(target: IntArray) -> IndexArray:
    """Return the first index of each target. target: (A,) in rising order."""
    changes = np.ones(len(target), np.bool_)
    np.not_equal(target[1:], target[:-1], out=changes[1:])
    return changes.nonzero()[0]


def reduce_targets(verb: np.ufunc, values: np.ndarray, target: IntArray) -> np.ndarray:
    """Reduce the values of each target by a ufunc such as ``np.maximum``.

    :param values: (A, ...).
    :param target: (A,) in rising order.
    :returns: (T, ...).
    """
    if not len(values):
        return values
    return np.asarray(verb.reduceat(values, _first_rows(target)))


def log_sum(log: FloatArray, target: IntArray) -> FloatArray:
    """Return ln sum exp (T, ...) over each target.

    :param log: (A, ...).
    :param target: (A,) in rising order.
    """
    if not len(log):
        return np.empty((0, *log.shape[1:]))
    first = _first_rows(target)
    top = np.maximum.reduceat(log, first)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide='ignore'):
        relative = log - top[target]
        return np.asarray(top + np.log(np.add.reduceat(np.exp(relative, out=relative), first)))


def combine_fixes(
    expected: Sequence[tuple[FloatArray, FloatArray]], mu: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, 2) and covariance (N, 2, 2) of the predictions of `predict_fix` over all
    models, with probabilities mu (N, M)."""
    h = np.concatenate([each for each, _ in expected], axis=-1)
    S = np.concatenate([each for _, each in expected], axis=-1)
    mean = (h @ mu[..., None])[..., 0]
    d = h - mean[..., None]
    S = S + np.stack([d[:, 0] * d[:, 0], d[:, 0] * d[:, 1], d[:, 1] * d[:, 1]], axis=1)
    whole = (S @ mu[..., None])[..., 0]
    return mean, whole[:, [[0, 1], [1, 2]]]


@frozen(eq=False)
class Borrowed:
    """B assumptions without a row of their own."""

    target: Annotated[IntArray, 'b']
    """(B,) target index."""
    key: dict[str, np.ndarray]
    """Assumptions by name, (B,) each: those of `Rows.key` that can borrow."""
    logw: Annotated[FloatArray, 'b']
    """(B,) logarithms of the weights."""

    @classmethod
    def from_rows(cls, rows: Rows, names: Iterable[str]) -> Borrowed:
        """Return the assumptions `names` of rows."""
        return cls(rows.target, {name: rows.key[name] for name in names}, rows.logw)

    def __len__(self) -> int:
        return len(self.target)

    def select(self, chosen: IndexArray | BoolArray) -> Borrowed:
        """Return the `chosen` assumptions."""
        key = {name: column[chosen] for name, column in self.key.items()}
        return Borrowed(self.target[chosen], key, self.logw[chosen])

    def append(self, new: Borrowed) -> Borrowed:
        """Append assumptions."""
        return Borrowed(
            np.concatenate([self.target, new.target]),
            {name: np.concatenate([own, new.key[name]]) for name, own in self.key.items()},
            np.concatenate([self.logw, new.logw]),
        )

    def select_targets(self, kept: BoolArray) -> Borrowed:
        """Return the assumptions of the targets selected by `kept` (T,), renumbered."""
        left = self.select(kept[self.target])
        return evolve(left, target=(np.cumsum(kept) - 1)[left.target])

    def without_target(self, target: int) -> Borrowed:
        """Return the assumptions of all other targets."""
        return self.select(self.target != target)

    def find_lenders(self, rows: Rows) -> IndexArray:
        """Return the row (B,) that each assumption borrows: the heaviest of its target.

        A scale changes the future of a filter. So the lender need not be near in scale: its state
        must fit the target.
        """
        if not len(self):
            return np.empty(0, np.intp)
        return rows.heaviest[self.target]


def drop_weightless_rows(
    rows: Rows, borrowed: Borrowed, stays: BoolArray
) -> tuple[Rows, Borrowed, IndexArray]:
    """Move rows of negligible weight to the borrowed list, except rows that `stays` (N,).

    :returns: the rows, the list, and the indices of the remaining rows.
    """
    lost = (rows.logw < np.log(ROW_LOST)) & ~stays
    left = np.flatnonzero(~lost)
    if len(left) == len(rows):
        return rows, borrowed, left
    gone = Borrowed.from_rows(rows.select(np.flatnonzero(lost)), borrowed.key)
    return (
        evolve(rows.select(left), parent=rows.parent[left]),
        borrowed.append(gone),
        left,
    )


def restore_rows(
    rows: Rows,
    borrowed: Borrowed,
    again: BoolArray,
    without: Mapping[str, Any] = NOTHING,
    lend: Callable[[Rows, Borrowed], Rows] | None = None,
) -> tuple[Rows, Borrowed]:
    """Give the assumptions `again` (B,) a row, a copy of their lender.

    The copy has no tail.

    :param without: values of other assumptions.
    :param lend: changes the copies where an assumption also changes the state.
    :returns: the rows and the list.
    """
    if not again.any():
        return rows, borrowed
    back = borrowed.select(again)
    lender = back.find_lenders(rows)
    copies = evolve(rows.select(lender), logw=back.logw, parent=rows.parent[lender])
    copies = copies.with_tail(0)
    copies = copies if lend is None else lend(copies, back)
    ended = {name: np.full(len(back), value) for name, value in without.items()}
    copies = evolve(copies, key={**copies.key, **ended, **back.key})
    return rows.append(copies), borrowed.select(~again)


def normalise_weights(rows: Rows, borrowed: Borrowed) -> tuple[Rows, Borrowed]:
    """Return rows and borrowed list whose weights sum to one for each target."""
    every = np.concatenate([rows.logw, borrowed.logw])
    target = np.concatenate([rows.target, borrowed.target])
    total = np.log(np.bincount(target, np.exp(every)))
    return (
        evolve(rows, logw=rows.logw - total[rows.target]),
        evolve(borrowed, logw=borrowed.logw - total[borrowed.target]),
    )
