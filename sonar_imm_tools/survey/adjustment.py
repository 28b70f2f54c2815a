# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Crossing adjustment: what lines that see the same floor say of each other's errors.

Unknowns are corrections, true less reported: roll, pitch and heading (latency when asked for) of
the survey; offset, speed of sound and a little roll of each line. Every look (what a line sees of
a cell with one side) is a height; the height of the cell itself is eliminated, so that only cells
with two lines or more say anything. The prior holds the totals, not the steps of a round, and it
alone knows the common level.

Errors of attitude and heave last for seconds. As *error states*, roll and heave in blocks of ten
seconds, they are unknowns of the estimate, in one sparse factorization. So is one number for the
water: layers lie at a depth, so that the mean speed of sound over the column changes with the
depth; along a line that goes with its gradients, and was taken for heading. Beside it stands the
*consider* covariance of the estimate without states,

    C = N^-1 (J' M V M J + J' M U S U' M J + P) N^-1,

J the partials, M the weights after elimination, V the variances of looks, U the blocks with their
budget S, P the prior information. The larger standard deviation of both is published. In one file,
since it is one estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import math
from typing import Any

from attrs import evolve, frozen
import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.sparse import csc_array, csr_array, diags_array, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray, IntArray

from .line import PARAMETERS, partials, Rows
from .looks import gradients, Looks, MAD, runs_of, strips

NU, REWEIGHTINGS = 4.0, 8
CLOSE = 3e-3
"""Rms change of the unknowns, in deviations of their priors, after which weights are left as they
are: by then each correction is within .03 of its stated deviation of where more would take it."""
ROUNDS = 3
BLOCK_SECONDS, LONGEST_BLOCK = 10.0, 160.0
SOUND_SPEED = 1500.0
DRIFT_SECONDS = 60.0
"""How long errors of heading and position last, which are considered only."""
LAYERS_STD = 5.0
"""By how much the mean speed of sound over the column changes where the depth doubles, m/s: layers
lie at a depth, not at a share of it."""
SECOND_ORDER = 0.04
"""Share of a correction of sound speed that its partial misses, where the water has layers."""
MOST_UNKNOWNS = 20_000
MOST_LOOKS = 1_000_000
"""Above it the equations are those of a part of the cells."""
ROWS_AT_ONCE = 200_000
MOST_PARAMETERS = 1000
"""Above it the covariance with states is not worked out: the consider covariance stands alone."""
FIXED = 1e-3
"""Standard deviation of the offset of a line whose tide is known, m."""
UNITS = ('roll_deg', 'pitch_deg', 'heading_deg', 'offset_m', 'sound_speed_m_s', 'latency_s')
SCALE = np.array([math.degrees(1.0)] * 3 + [1.0] * 3)
"""From `PARAMETERS` to `UNITS`."""


@frozen(kw_only=True)
class Priors:
    """Standard deviations of corrections: of the survey, of a line. latency 0: not free."""

    roll: float = math.radians(2.0)
    pitch: float = math.radians(2.0)
    heading: float = math.radians(3.0)
    latency: float = 0.0
    line_offset: float = 0.5
    line_sound_speed: float = 5.0
    line_roll: float = math.radians(0.02)


@frozen(eq=False)
class Adjustment:
    """What came of it. P unknowns: of the survey first, then those of each line.

    owner (P,): number of the line, -1 the survey; kind (P,): index into `PARAMETERS`; value, std,
    prior_std (P,); covariance (P, P); information (P, P) of the data alone; corrections (L, 6):
    total of each line; rms: of looks about their cells, robust, before the first round and after
    each; group (L,): number of the group of lines that overlap, of each line.
    """

    owner: IntArray
    kind: IntArray
    value: FloatArray
    std: FloatArray
    prior_std: FloatArray
    covariance: FloatArray
    information: FloatArray
    corrections: FloatArray
    rms: tuple[float, ...]
    group: IntArray

    def known_share(self) -> FloatArray:
        """`told` of each unknown (P,): the share of the prior variance that is gone, 0 where
        misties leave more than the prior."""
        return np.maximum(1.0 - np.square(self.std / self.prior_std), 0.0)

    def of_lines(self, lines: Sequence[int]) -> FloatArray:
        """Covariance (L, 6, L, 6) of the total corrections of some lines."""
        T = _totals(self.owner, self.kind, lines)
        K = len(PARAMETERS)
        full = T @ (T @ self.covariance).T
        return np.asarray(full).reshape(len(lines), K, len(lines), K)

    def levels(self) -> list[tuple[IntArray, float]]:
        """The lines of each group, and the standard deviation of their common level, m: the least
        that any weighted mean of their offsets has. All heights of a group share that error; what
        is stated of a height less this, in squares, is how sure it is beside the others."""
        found = []
        offset = np.flatnonzero(self.kind == 3)
        for number in range(int(self.group.max()) + 1):
            lines = np.flatnonzero(self.group == number)
            own = offset[np.isin(self.owner[offset], lines)]
            weights = np.linalg.solve(self.covariance[np.ix_(own, own)], np.ones(len(own)))
            found.append((lines, float(1.0 / np.sqrt(weights.sum()))))
        return found

    def not_known(self) -> list[tuple[FloatArray, float]]:
        """Combinations (P,) of unknowns, in their priors, of which the data say less than the
        prior does, and the share of the prior variance that stays; the least known first."""
        scaled = self.information * np.outer(self.prior_std, self.prior_std)
        values, vectors = eigh(scaled, subset_by_value=(-np.inf, 1.0))
        return [
            (vectors[:, k] * np.sign(vectors[np.argmax(np.abs(vectors[:, k])), k]), float(share))
            for k, share in enumerate(1.0 / (1.0 + np.maximum(values, 0.0)))
        ]


@frozen(eq=False)
class Rounds:
    """What R rounds have solved: rms of looks before each (R,), unknowns (P,) after the last."""

    rms: FloatArray
    value: FloatArray


def adjust(
    statistics: Callable[[FloatArray], Sequence[Looks]],
    count: int,
    budget: ErrorBudget,
    priors: Priors | None = None,
    fixed: Sequence[int] = (),
    states: bool = True,
    note: Callable[[int, float], None] = lambda number, rms: None,
    solved: Rounds | None = None,
    keep: Callable[[Rounds], None] = lambda solved: None,
) -> Adjustment:
    """Adjust `count` lines in three rounds.

    statistics: the looks of each line, at places corrected by (L, 6). fixed: lines whose offset is
    known to be 0. note: called after each round with its number and the rms of looks. keep: called
    with what has been solved so far, from which another call goes on as `solved`.
    Raises ValueError where no two lines see the same cell.
    """
    unknowns = _Unknowns.of(count, priors or Priors(), fixed)
    solved = solved or Rounds(np.zeros(0), np.zeros(len(unknowns.owner)))
    history, value = solved.rms.tolist(), solved.value
    corrections = unknowns.totals(value)
    for number in range(len(history), ROUNDS + 1):
        found = Crossing.of(statistics(corrections))
        equations = _Equations(found, unknowns, corrections, budget)
        history.append(found.rms())
        if number:
            note(number, history[-1])
        if number < ROUNDS:
            value = equations.solve(states, value)
            corrections = unknowns.totals(value)
            del found, equations  # before the next ones are made
            keep(Rounds(np.array(history), value))
    # The last step moved no place by much: the equations of the last statistics are those of it.
    equations.reweight(equations.J, value)
    covariance, information = equations.covariance(states)
    # To first order only the mean over the column counts; what a second layer adds is common.
    bent = np.where(unknowns.kind == 4, SECOND_ORDER * value, 0.0)
    covariance = covariance + np.outer(bent, bent)
    return Adjustment(
        owner=unknowns.owner,
        kind=unknowns.kind,
        value=value,
        std=np.sqrt(np.diag(covariance)),
        prior_std=unknowns.prior_std,
        covariance=covariance,
        information=information,
        corrections=corrections,
        rms=tuple(history),
        group=groups_of(found, count),
    )


@frozen(eq=False)
class Crossing(Rows):
    """Looks (m,) in cells that two lines or more see, sorted by cell and line.

    cell: number of the cell, from 0; line: number; time s; z: height at the centre, m; variance of
    it, m^2; g (m, 2): gradient of the floor; partials (m, 6) of the height; depth below the array,
    m. cells: how many there are.
    """

    cell: IntArray
    line: IntArray
    time: FloatArray
    z: FloatArray
    variance: FloatArray
    g: FloatArray
    partials: FloatArray
    depth: FloatArray
    cells: int

    @classmethod
    def of(cls, lines: Sequence[Looks]) -> Crossing:
        """Of the looks of lines; where they are more than `MOST_LOOKS`, of every second cell, of
        every fourth, and so on: what lasts for seconds limits the corrections, not noise.

        Raises ValueError where no two lines see the same cell.
        """
        parts: list[Crossing] = []
        every = 1
        for part in crossings(lines):
            parts.append(part.thinned(every))
            while sum(len(each.z) for each in parts) > MOST_LOOKS:
                every *= 2
                parts = [each.thinned(2) for each in parts]
        firsts = np.cumsum([0, *(part.cells for part in parts)])
        if not firsts[-1]:
            raise ValueError('no two lines overlap')
        cell = np.concatenate([part.cell + first for part, first in zip(parts, firsts.tolist())])
        return evolve(cls.joined(parts), cell=cell, cells=int(firsts[-1]))

    def thinned(self, every: int) -> Crossing:
        """Each cell whose number `every` divides."""
        if every == 1:
            return self
        chosen = self.chosen(self.cell % every == 0)
        return evolve(chosen, cell=chosen.cell // every, cells=-(-self.cells // every))

    def rms(self) -> float:
        """Of looks about the weighted means of their cells, robust."""
        weight = 1.0 / self.variance
        total = np.bincount(self.cell, weight * self.z, self.cells)
        mean = total / np.bincount(self.cell, weight, self.cells)
        return robust_rms(self.z - mean[self.cell])


def crossings(lines: Sequence[Looks]) -> Iterator[Crossing]:
    """What lines have in common, by parts of the floor."""
    for looks, inside in strips(lines):
        starts, _, group = runs_of(looks.ix, looks.iy)
        least = np.minimum.reduceat(looks.line, starts)
        most = np.maximum.reduceat(looks.line, starts)
        shared = (least < most) & inside[starts]
        rows = shared[group]
        g = gradients(looks, looks.ix[starts][shared], looks.iy[starts][shared])
        cell = (np.cumsum(shared) - 1)[group[rows]]
        chosen, g = looks.chosen(rows), g[cell]
        yield Crossing(
            cell=cell,
            line=chosen.line,
            time=chosen.time,
            z=chosen.heights(g),
            variance=chosen.variances(g),
            g=g,
            partials=partials(chosen.basis, g, SOUND_SPEED),
            depth=2.0 * chosen.basis[:, 8] - SOUND_SPEED * chosen.basis[:, 1],
            cells=int(shared.sum()),
        )


def groups_of(found: Crossing, count: int) -> IntArray:
    """The number of the group (L,) of each line; groups do not overlap each other."""
    shape = found.cells, count
    see = csr_array((np.ones(len(found.cell)), (found.cell, found.line)), shape=shape)
    return np.asarray(connected_components(see.T @ see, directed=False)[1], np.int64)


@frozen
class Mistie:
    """Difference of two lines: cells that both see; median and robust rms, m."""

    cells: int
    median: float
    rms: float


def misties(lines: Sequence[Looks]) -> tuple[dict[tuple[int, int], Mistie], int]:
    """By pairs of lines that share cells, first less second; how many cells several lines see."""
    keys, apart = [], []
    cells = 0
    for found in crossings(lines):
        cells += found.cells
        if not found.cells:
            continue
        starts, _, _ = runs_of(found.cell, found.line)
        weight = 1.0 / found.variance
        z = np.add.reduceat(weight * found.z, starts) / np.add.reduceat(weight, starts)
        cell, line = found.cell[starts], found.line[starts]
        for step in range(1, int(np.bincount(cell).max())):
            here = np.flatnonzero(cell[step:] == cell[:-step])
            keys.append((line[here] << 32) + line[here + step])
            apart.append(z[here] - z[here + step])
    if not cells:
        return {}, 0
    key, d = np.concatenate(keys), np.concatenate(apart)
    order = np.argsort(key, kind='stable')
    starts, _, _ = runs_of(key[order])
    pairs = [divmod(pair, 1 << 32) for pair in key[order[starts]].tolist()]
    each = np.split(d[order], starts[1:])
    made = (Mistie(len(own), float(np.median(own)), robust_rms(own)) for own in each)
    return dict(zip(pairs, made)), cells


def robust_rms(values: FloatArray) -> float:
    """1.4826 times the median magnitude; NaN for none."""
    return float(MAD * np.median(np.abs(values))) if len(values) else math.nan


def _totals(owner: IntArray, kind: IntArray, lines: Sequence[int]) -> csr_array:
    """The matrix (6 L, P) from unknowns to the total corrections of lines."""
    place = {number: row for row, number in enumerate(lines)}
    rows, columns = [], []
    for column, (line, what) in enumerate(zip(owner.tolist(), kind.tolist())):
        for row in range(len(lines)) if line < 0 else [place[line]] if line in place else []:
            rows.append(row * len(PARAMETERS) + what)
            columns.append(column)
    shape = len(lines) * len(PARAMETERS), len(owner)
    return csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


@frozen(eq=False)
class _Unknowns:
    """Which unknowns there are: see `Adjustment`."""

    owner: IntArray
    kind: IntArray
    prior_std: FloatArray
    count: int

    @classmethod
    def of(cls, count: int, priors: Priors, fixed: Sequence[int]) -> _Unknowns:
        survey = [(0, priors.roll), (1, priors.pitch), (2, priors.heading), (5, priors.latency)]
        line = [(3, priors.line_offset), (4, priors.line_sound_speed), (0, priors.line_roll)]
        rows = [(-1, kind, std) for kind, std in survey if std > 0.0]
        rows += [(k, kind, std) for k in range(count) for kind, std in line]
        owner, kind, std = (np.array(column) for column in zip(*rows))
        std[(kind == 3) & np.isin(owner, list(fixed))] = FIXED
        return cls(owner.astype(np.int64), kind.astype(np.int64), std, count)

    def totals(self, value: FloatArray) -> FloatArray:
        """Total corrections (L, 6) of the lines."""
        T = _totals(self.owner, self.kind, range(self.count))
        return np.asarray(T @ value).reshape(self.count, len(PARAMETERS))


class _Equations:
    """Heights of looks as equations of the unknowns, at one round's places."""

    def __init__(
        self, found: Crossing, unknowns: _Unknowns, corrections: FloatArray, budget: ErrorBudget
    ):
        self.found, self.unknowns, self.budget = found, unknowns, budget
        self.a, self.v, self.cell = found.partials, found.variance, found.cell
        self.J = self._jacobian()
        m = len(found.z)
        shape = found.cells, m
        self.in_cell = csr_array((np.ones(m), (self.cell, np.arange(m))), shape=shape)
        # As the sounding was reported: the prior holds the total, not what this round adds.
        self.y = found.z - (self.a * corrections[found.line]).sum(axis=1)
        self.w = 1.0 / self.v

    def _jacobian(self) -> csr_array:
        known, line = self.unknowns, self.found.line
        survey = np.flatnonzero(known.owner < 0)
        m, k = len(line), len(survey)
        values = np.column_stack([self.a[:, known.kind[survey]], self.a[:, [3, 4, 0]]])
        columns = np.empty((m, k + 3), np.int64)
        columns[:, :k] = survey
        columns[:, k:] = k + 3 * line[:, None] + np.arange(3)
        pointers = np.arange(0, m * (k + 3) + 1, k + 3)
        return csr_array((values.ravel(), columns.ravel(), pointers), shape=(m, len(known.owner)))

    def reweight(self, J: csr_array, value: FloatArray) -> None:
        """Student weights of the residuals at a solution for the unknowns of J."""
        z = self.y + J @ value
        mean = (self.in_cell @ (self.w * z)) / (self.in_cell @ self.w)
        u = (z - mean[self.cell]) / np.sqrt(self.v)
        self.w = (NU + 1.0) / (NU + np.square(u)) / self.v

    def normal(self, J: csr_array) -> tuple[csc_array, FloatArray]:
        """Information (k, k) and right-hand side (k,) for J, heights of cells eliminated."""
        WJ = diags_array(self.w) @ J
        K = (self.in_cell @ WJ).tocsr()
        weight = self.in_cell @ self.w
        N = J.T @ WJ - K.T @ (diags_array(1.0 / weight) @ K)
        rhs = K.T @ ((self.in_cell @ (self.w * self.y)) / weight) - WJ.T @ self.y
        return N.tocsc(), np.asarray(rhs)

    def states(self, seconds: float) -> tuple[csr_array, FloatArray]:
        """Columns (m, S) of the speed of sound by depth, and of roll and heave in blocks of each
        line (0: without), and the prior information."""
        deeper = self.found.depth / np.median(self.found.depth) - 1.0
        columns = [csr_array((self.a[:, 4] * deeper)[:, None])]
        count = 0
        if seconds:
            block, count = self._blocks(seconds)
            rows = np.arange(len(block))
            for partial in (self.a[:, 0], self.a[:, 3]):
                columns.append(csr_array((partial, (rows, block)), shape=(len(block), count)))
        deviations = [LAYERS_STD, *[self.budget.attitude] * count, *[self.budget.heave] * count]
        return hstack(columns).tocsr(), 1.0 / np.square(np.maximum(deviations, 1e-9))

    def _blocks(self, seconds: float) -> tuple[IntArray, int]:
        key = self.found.line * (1 << 40) + np.floor(self.found.time / seconds).astype(np.int64)
        found, block = np.unique(key, return_inverse=True)
        return block, len(found)

    def _system(self, states: bool) -> tuple[csr_array, FloatArray]:
        """Columns of all unknowns, states last, and their prior information."""
        prior = 1.0 / np.square(self.unknowns.prior_std)
        if not states:
            return self.J, prior
        # With such blocks the unknowns are few enough; none where that would take too long ones.
        seconds = BLOCK_SECONDS
        while 2 * self._blocks(seconds)[1] + len(self.unknowns.owner) > MOST_UNKNOWNS:
            seconds *= 2.0
            if seconds > LONGEST_BLOCK:
                seconds = 0.0
                break
        columns, information = self.states(seconds)
        return hstack([self.J, columns]).tocsr(), np.concatenate([prior, information])

    def solve(self, states: bool, start: FloatArray) -> FloatArray:
        """The unknowns (P,), by iterated Student weights, from those of the round before or 0."""
        J, prior = self._system(states)
        size = len(start)
        value = np.concatenate([start, np.zeros(len(prior) - size)])
        scale = 1.0 / np.sqrt(prior)
        if start.any():
            self.reweight(J, value)
        for _ in range(REWEIGHTINGS):
            N, rhs = self.normal(J)
            before, value = value, _factored(N, prior, scale)(rhs)
            self.reweight(J, value)
            if np.sqrt(np.mean(np.square((value - before) / scale)[:size])) < CLOSE:
                break
        return np.asarray(value[:size])

    def covariance(self, states: bool) -> tuple[FloatArray, FloatArray]:
        """Covariance of the unknowns, consider or with states, whichever is wider, and the
        information of the data alone."""
        J, prior = self._system(states)
        size = len(self.unknowns.owner)
        N, _ = self.normal(self.J)
        information = N.toarray()
        own = prior[:size]
        factor = cho_factor(information + np.diag(own))
        middle = self._considered() + np.diag(own)
        half = cho_solve(factor, middle)
        C = cho_solve(factor, half.T)
        C = 0.5 * (C + C.T)
        if J.shape[1] > size and size <= MOST_PARAMETERS:
            full, _ = self.normal(J)
            solve = _factored(full, prior, 1.0 / np.sqrt(prior))
            unit = np.zeros((len(prior), size))
            unit[np.arange(size), np.arange(size)] = 1.0
            with_states = solve(unit)[:size]
            wider = np.sqrt(np.maximum(np.diag(with_states) / np.diag(C), 1.0))
            C *= np.outer(wider, wider)
        return np.asarray(C), information

    def _considered(self) -> FloatArray:
        """J' M (V + U S U') M J (P, P): what errors of looks, and those that last for seconds, do
        to the right-hand side. In parts of the looks, for memory."""
        size = len(self.unknowns.owner)
        b = self.budget
        short, long = self._blocks(BLOCK_SECONDS), self._blocks(DRIFT_SECONDS)
        lasting = [
            (self.a[:, 0], b.attitude, short),
            (self.a[:, 1], b.attitude, short),
            (self.a[:, 3], b.heave, short),
            (self.a[:, 2], b.heading, long),
            (self.found.g[:, 0], b.position, long),
            (self.found.g[:, 1], b.position, long),
        ]
        total = np.zeros((size, size))
        sums = [csr_array((size, count)) for _, _, (_, count) in lasting]
        weight = self.in_cell @ self.w
        for start in range(0, len(self.w), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            R = self._eliminated(rows, weight)
            total += (R.T @ (diags_array(self.v[rows]) @ R)).toarray()
            n = np.arange(R.shape[0])
            for k, (partial, deviation, (block, count)) in enumerate(lasting):
                U = csr_array((deviation * partial[rows], (n, block[rows])), shape=(len(n), count))
                sums[k] = sums[k] + (R.T @ U).tocsr()
        for B in sums:
            total += (B @ B.T).toarray()
        return total

    def _eliminated(self, rows: slice, weight: FloatArray) -> csr_array:
        """Rows of M J (n, P): weighted partials less the mean of their cell."""
        first, last = self.cell[rows][0], self.cell[rows][-1] + 1
        near = slice(*np.searchsorted(self.cell, [first, last]).tolist())
        WJ = (diags_array(self.w[near]) @ self.J[near]).tocsr()
        cell = self.cell[near] - first
        sums = csr_array(
            (np.ones(len(cell)), (cell, np.arange(len(cell)))), shape=(last - first, len(cell))
        )
        mean = (diags_array(1.0 / weight[first:last]) @ (sums @ WJ)).tocsr()
        own = slice(rows.start - near.start, rows.start - near.start + len(self.w[rows]))
        return (WJ[own] - diags_array(self.w[rows]) @ mean[cell[own]]).tocsr()


def _factored(
    N: csc_array, prior: FloatArray, scale: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    """Solves (N + diag(prior)) x = b, in units of the priors."""
    S = diags_array(scale)
    A = (S @ (N + diags_array(prior)) @ S).tocsc()
    lu = splu(
        A, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0, options={'SymmetricMode': True}
    )

    def solve(b: FloatArray) -> FloatArray:
        scaled = (b.T * scale).T
        return np.asarray((lu.solve(scaled).T * scale).T)

    return solve


def described(adjustment: Adjustment, names: Sequence[str]) -> dict[str, Any]:
    """The parameters, what could not be told, and levels, as adjustment.json has them."""

    scale = SCALE[adjustment.kind]
    lines = [names[owner] if owner >= 0 else '' for owner in adjustment.owner.tolist()]
    columns = {
        'line': lines,
        'name': [UNITS[kind] for kind in adjustment.kind],
        'value': (adjustment.value * scale).tolist(),
        'std': (adjustment.std * scale).tolist(),
        'prior_std': (adjustment.prior_std * scale).tolist(),
        'told': adjustment.known_share().tolist(),
    }
    parameters = [dict(zip(columns, row)) for row in zip(*columns.values())]
    labels = [' '.join(filter(None, (row['name'], row['line']))) for row in parameters]
    combinations = []
    for vector, share in adjustment.not_known():
        largest = np.argsort(-np.abs(vector), kind='stable')[:6].tolist()
        words = [f'{vector[k]:+.2f} {labels[k]}' for k in largest if abs(vector[k]) > 0.05]
        combinations.append({'combination': ' '.join(words), 'share': share})
    groups = adjustment.levels()
    levels = [{'lines': [names[k] for k in lines], 'std_m': std} for lines, std in groups]
    return {'parameters': parameters, 'not_told': combinations, 'levels': levels}
