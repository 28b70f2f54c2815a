# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A particle filter for sets of unknown size: the multiple-model particle filter, verb by verb.

A particle is one set of the model (`set_model`), ``[m, z_1 .. z_m]``, and the filter is one
importance sampler for sets of every size at once. A cycle takes in one record::

    record = filter.record(b, key)                 # tables of this record
    before = before or filter.start(record)        # sets before the first record
    sets = filter.propagate(before, record)        # deaths, shift or jump, walks, births
    step = filter.weigh(sets, record)              # each set meets the record
    step = filter.resample(step, record)           # where few of the sets count
    step = filter.move(step, record)               # copies of a set differ again
    before = step.after
    summary = filter.summarise(step)               # order, and what lies on each cell

Each verb is pure: it takes a value and gives another. A record can therefore be tried without
being taken in (a preview), and the sets at one record can be weighted again when later records are
in (`LagSmoother`).

Data-driven proposals
    A walk is drawn from ``share * K(z' - z) exp(g(z')) / Z(z) + (1 - share) * K(z' - z)``, with
    ``g = max(s b, 0)^2 / 2`` (what a member of sign s alone would be worth); of the births a share
    is drawn in proportion to the sign's probability times ``exp(min(g, cap))`` and the rest
    uniformly, at the places that those already there leave free. The cap lets a weak peak have
    births beside a strong one; the uniform rest bounds the weight of a birth where the record
    shows nothing. Each draw is weighted by the exact ratio of model to proposal, so proposals
    change how many particles are needed and nothing else. Shares of zero make the bootstrap
    filter: with eight sharp peaks in a record, all but a handful of its particles are lost at
    every step.

Gaps, and members that may walk far
    Where the time of several records passed since the last one, members may have walked far and
    been replaced; where they move on by a slope that is not known yet, they may be far from where
    they were after one record, too (`Walks`). The gains of all peaks are then lowered to what
    births get at most, each peak keeping its own shape (`levelled`): by its full gain the
    strongest peak within reach would draw all members to itself.

Random numbers are counter based: those of a record come from a Philox generator whose key is the
seed and the record's own name (its stamp), and each particle has its row of them, ``(1 + c + J)``
for the order, the c members that can come and go at once, and the J that can walk. The result is
therefore the same whatever was processed before, and on one thread or several.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
import math
from typing import Annotated, ClassVar, NamedTuple

from attrs import define, evolve, field, frozen
import numpy as np

from . import set_kernels as kernels
from .arrays import FloatArray, IntArray
from .particles import effective_sample_size, normalise, systematic
from .set_model import (
    aged,
    inherited,
    leave,
    Left,
    remembered,
    repeated_walk,
    SetModel,
    Sets,
    turnover,
    Walks,
)
from .set_proposals import (
    begin,
    Births,
    fill_walks,
    first_members,
    gains,
    levelled,
    Peaks,
    propose_births,
    walked_from,
    WalkTables,
)
from .set_shifts import Shift, ShiftPath, ShiftTables

_STEP, _START, _RESAMPLE, _MOVE = range(4)
_PASSAGES = 16
_SUMS, _SHIFTED_SUMS = 5, 8
"""Rows of what `moments` adds up, without a shift and with one."""


class Passage(NamedTuple):
    """How sets change while the time of so many `records` passes: walks; most_changes, how many
    members can come and go at once; cumulative (orders, columns), the running sums of the rows of
    the transition matrix, or of `set_model.turnover`; shift, None without one; shared: tables of
    the shift, or of the jump, None without either."""

    records: int
    walks: Walks
    most_changes: int
    cumulative: FloatArray
    shift: Shift | None
    shared: ShiftTables | None


class AmplitudeModel(NamedTuple):
    """How members answer: gram (n,) by lag; ridge, added to its diagonal; penalty in log
    likelihood for each member; marginal: amplitudes are integrated out; remembers: those of one
    record say something of those of the next."""

    gram: FloatArray
    ridge: float
    penalty: float
    marginal: bool
    remembers: bool


class Record(NamedTuple):
    """A record as the verbs take it: b (n,), or (n + 2 pad,) with a shift, in units of its noise;
    key: of its random numbers, seed and name, each in 0 .. 2^64 - 1; gains (S, n) by sign that
    walks look at, see `gains`; amplitudes: how members answer in it; births; walks: as far as
    nothing of the record is known; passage: since the record before; found: gains (S, n) by sign
    before they were levelled, and what stands out."""

    b: FloatArray
    key: tuple[int, int]
    gains: FloatArray
    amplitudes: AmplitudeModel
    births: Births
    walks: Walks
    passage: Passage
    found: tuple[FloatArray, Peaks]


class Weighted(NamedTuple):
    """Sets with log weights (N,) that need not be normalised: the state between records. path: of
    their shifts, None without. log_before: log of the sum of the weights before the record, and
    jump (N,) by how many cells members jumped, None without, both of sets that were propagated."""

    sets: Sets
    log_weight: Annotated[FloatArray, 'N']
    path: ShiftPath | None = None
    log_before: float = 0.0
    jump: Annotated[IntArray, 'N'] | None = None


@frozen(eq=False)
class SetStep:
    """One record taken in.

    sets: weighted by w (N,), summing to one; amplitude (N, J) given each set, in units of the
    noise; path: of their shifts, jump (N,): see `Weighted`; None without. log_evidence: log of
    the record's probability given those before, against that of an empty record; effective:
    sample size; ok False when no set could explain the record. after: the same sets as the next
    record finds them, resampled when needed, with source (N,) the index into `sets` of each of
    them.
    """

    sets: Sets
    w: Annotated[FloatArray, 'N']
    amplitude: Annotated[FloatArray, 'NJ']
    path: ShiftPath | None
    log_evidence: float
    effective: float
    ok: bool
    after: Weighted
    source: Annotated[IntArray, 'N']
    resampled: bool = False
    jump: Annotated[IntArray, 'N'] | None = None


class Summary(NamedTuple):
    """pmf (orders,) of the order; sums (5, n), or (8, n + 2 pad) with a shift, see
    `set_kernels.moments`; shift: its mean and standard deviation in cells, None without; jump: the
    probability that members jumped, and the mean of that in cells."""

    pmf: FloatArray
    sums: FloatArray
    shift: tuple[float, float] | None
    jump: tuple[float, float] = (0.0, 0.0)


class SetFilter:
    """Runs a `SetModel` on `particles` sets with `threads` threads."""

    def __init__(self, model: SetModel, particles: int, threads: int = 1):
        self.model = model
        self.particles = particles
        self.threads = threads
        self._tables = WalkTables.empty(0, 0)
        self._passages: dict[int, Passage] = {}
        self._passage(1)
        self._amplitudes = AmplitudeModel(
            gram=model.gram,
            ridge=float(model.ridge),
            penalty=float(model.penalty),
            marginal=model.amplitude_prior == 'marginal',
            remembers=model.amplitude_memory > 0.0,
        )
        self._charge = np.array(
            [
                math.log(max(model.room(m), 1)) - m * math.log(model.cells)
                for m in range(model.order_min, model.order_max + 1)
            ]
        ) - np.log(len(model.start) * model.start)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def _passage(self, records: int) -> Passage:
        if records in self._passages:
            return self._passages[records]
        model, shift, walk = self.model, self.model.shift, self.model.walk
        chances, changes = model.transition, model.most_changes
        if not records:
            chances = np.eye(len(chances))
        elif records > 1:
            walk = repeated_walk(walk, records)
            chances, changes = turnover(chances, model.order_min, records), 2 * model.order_max
            shift = shift and evolve(shift, memory=shift.memory**records)
        walks = Walks.alike(walk, model.record_cells, wide=records > 1)
        shared = ShiftTables.of(shift) if shift else None
        if model.jump and records:
            shared = model.jump.tables()
        found = Passage(records, walks, changes, np.cumsum(chances, axis=1), shift, shared)
        if len(self._passages) > _PASSAGES:
            self._passages = {1: self._passages[1]}
        self._passages[records] = found
        return found

    def record(
        self,
        b: FloatArray,
        key: tuple[int, int],
        gram: FloatArray | None = None,
        records: int = 1,
        walks: Walks | None = None,
    ) -> Record:
        """The record b, see `Record`. gram (n,): of this record, where it is not the model's;
        records: how many records' time passed since the one before, 0 for a first one before which
        no member comes or goes; walks: by then, where they are not the model's."""
        model, passage = self.model, self._passage(records)
        walks = walks or passage.walks
        amplitudes = self._amplitudes if gram is None else self._amplitudes._replace(gram=gram)
        g, peaks = gains(model, b, amplitudes.gram)
        walked = levelled(model, g) if walks.wide else g
        births = propose_births(
            model, walked if records > 1 else g, model.birth_share, model.birth_cap
        )
        found = g, peaks
        return Record(b, key, walked, amplitudes, births, walks, passage, found)

    def start(self, record: Record) -> Weighted:
        """Sets before the first record, drawn where it will want them."""
        model, shift = self.model, np.full(self.particles, self.model.pad, np.int64)
        beginning, births = begin(model, *record.found)
        needed = 1 + model.order_max + (model.shift is not None) + len(beginning.sure)
        uniform = _generator(record.key, _START).random((self.particles, needed))
        if model.shift:
            start = ShiftTables.of(model.shift).start
            shift = np.searchsorted(start, uniform[:, 1 + model.order_max], 'right')
            shift = model.shift.step * np.minimum(shift, len(start) - 1)
        found, order, log_ratio = first_members(model, beginning, births, uniform, shift)
        sets = Sets.empty(model, self.particles)._replace(order=order, shift=shift)
        elsewhere = births._replace(running=beginning.elsewhere)
        # Those that were found stay where they are.
        one, centre = np.ones((births.ratio.size, 1)), np.zeros(model.record_cells, np.int64)
        walks = centre, WalkTables(one, one, one[:, 0])
        self._draw(Left.all_of(found), walks, elsewhere, (1, uniform), sets, log_ratio)
        log_ratio -= self._charge[order - model.order_min]
        # An impossible set has members that mean nothing; it must not walk.
        sets.cell[~np.isfinite(log_ratio)] = 0
        # The sets are draws from the prior in disguise: as many particles as if they were.
        return Weighted(sets, log_ratio)

    def require(self, before: Weighted, steps: Iterable[SetStep] = ()) -> None:
        """Raise ValueError for sets, or steps kept for smoothing, that are none of this model: of
        sets that come from a file. Kernels take places for indices."""
        self._require_sets(before)
        for step in steps:
            self._require_sets(step.after)
            with np.errstate(divide='ignore', invalid='ignore'):
                self._require_sets(Weighted(step.sets, np.log(step.w), step.path, 0.0, step.jump))
            if not ((step.source >= 0) & (step.source < self.particles)).all():
                raise ValueError('sets come from none')

    def _require_sets(self, weighted: Weighted) -> None:
        model, (sets, log_weight, path, _, jump) = self.model, weighted
        memory = model.order_max if model.amplitude_memory > 0.0 else 0
        there = np.arange(model.order_max) < sets.order[:, None]
        if sets.cell.shape != (self.particles, model.order_max):
            raise ValueError('sets are as many as no tracker has')
        cell = np.where(there, sets.cell, model.cells - 1)
        # The members of impossible sets are in no order.
        rising = (np.diff(cell, axis=1) >= 0) | ~(log_weight > -np.inf)[:, None]
        good = (
            sets.prior_mean.shape == (self.particles, memory)
            and ((sets.order >= model.order_min) & (sets.order <= model.order_max)).all()
            and ((cell >= 0) & (cell < model.cells)).all()
            and rising.all()
            and ((sets.shift >= 0) & (sets.shift <= 2 * model.pad)).all()
            and np.isfinite(sets.prior_mean).all()
            and np.isfinite(sets.prior_variance).all()
            and (log_weight < np.inf).all()
            and (model.shift is None or path is None or path.precision > 0.0)
            and (path is None or np.isfinite(path.pull).all())
            and (jump is None or jump.shape == (self.particles,))
        )
        if not good:
            raise ValueError('sets are none of this model')

    def propagate(self, before: Weighted, record: Record) -> Weighted:
        """Sets as they may have become by the time of the record: deaths, shift, walks, births."""
        passage, shift, path = record.passage, record.passage.shift, None
        needed = self.model.uniforms + passage.most_changes - self.model.most_changes
        uniform = _generator(record.key, _STEP).random((self.particles, needed))
        old = aged(self.model, before.sets, passage.records - 1)
        sets, log_ratio, jump = self._drawn(old, record, uniform)
        if shift is not None:
            path = ShiftPath.begin(shift, sets.shift)
            if before.path is not None:
                path = before.path.then(shift, before.sets.shift, sets.shift)
        _, log_before = normalise(before.log_weight)
        return Weighted(sets, before.log_weight + log_ratio, path, float(log_before), jump)

    def weigh(self, propagated: Weighted, record: Record) -> SetStep:
        """Each set meets the record."""
        sets, log_weight = propagated.sets, propagated.log_weight.copy()
        amplitude = np.zeros(sets.cell.shape)

        def work(first: int, last: int) -> None:
            J, slots = self.model.order_max, kernels.SLOTS
            owner, kept = np.full(slots, -1, np.int64), np.empty(slots)
            scratch = np.empty((J, J)), np.empty((2, J)), owner, kept
            seen = record.b, *record.amplitudes
            kernels.weigh(first, last, *seen, *sets, *scratch, log_weight, amplitude)

        self._split(work)
        w, log_sum = normalise(log_weight)
        ok = bool(np.isfinite(log_sum))
        return SetStep(
            sets,
            w,
            amplitude,
            propagated.path,
            log_evidence=float(log_sum) - propagated.log_before,  # of no weights at all: NaN
            effective=float(effective_sample_size(w)) if ok else 0.0,
            ok=ok,
            after=Weighted(sets, log_weight, propagated.path),
            source=np.arange(self.particles),
            jump=propagated.jump,
        )

    def resample(self, step: SetStep, record: Record) -> SetStep:
        """Equally weighted sets for the next record where less than half of these count, else the
        same; they remember their amplitudes."""
        after, source = step.after, step.source
        resampled = step.ok and step.effective < 0.5 * self.particles
        if resampled:
            source = systematic(step.w, self.particles, _generator(record.key, _RESAMPLE))
            path = step.path.take(source) if step.path else None
            after = Weighted(step.sets.take(source), np.zeros(self.particles), path)
        if self.model.amplitude_memory > 0.0:
            gram, amplitude = record.amplitudes.gram, step.amplitude[source]
            after = after._replace(sets=remembered(self.model, gram, after.sets, amplitude))
        return evolve(step, after=after, source=source, resampled=resampled)

    def move(self, step: SetStep, record: Record) -> SetStep:
        """With the offset of members and shift drawn anew after resampling, so that copies of a
        set differ: a Gibbs move, see `set_shifts`. Without a shift there is none."""
        shift, (sets, _, path, *_) = self.model.shift, step.after
        if shift is None or path is None or not step.resampled:
            return step
        u = _generator(record.key, _MOVE).random((self.particles, 2))
        # By how much all members of a set can be lowered and stay on the lattice.
        last = self.model.cells - 1
        lowest = sets.cell[np.arange(len(sets.order)), np.maximum(sets.order - 1, 0)]
        low = np.where(sets.order > 0, lowest - last, -last - 1)
        high = np.where(sets.order > 0, sets.cell[:, 0], last + 1)
        d, path = path.draw(shift, sets.shift, (low, high), u)
        # No member is moved below 0; what is no member must stay an index.
        cell = np.maximum(sets.cell - d[:, None], 0)
        moved = sets._replace(cell=cell, shift=sets.shift + d)
        return evolve(step, after=step.after._replace(sets=moved, path=path))

    def summarise(self, step: SetStep) -> Summary:
        """What the sets say together."""
        pmf = np.zeros(len(self.model.transition))
        rows = _SHIFTED_SUMS if self.model.shift else _SUMS
        sums = np.zeros((rows, self.model.record_cells))
        # Of the shift, what is still to be drawn: its mean (N,) and variance, cells.
        offset, variance, shift = np.empty(0), 0.0, None
        if step.path:
            offset, variance = step.path.mean, 1.0 / step.path.precision
            place = step.sets.shift + offset
            mean = float(step.w @ place)
            spread = math.sqrt(float(step.w @ np.square(place - mean)) + variance)
            shift = mean - self.model.pad, spread
        order, cell, _, prior_variance, _, shifted = step.sets
        kernels.moments(
            step.w,
            self.model.order_min,
            order,
            cell,
            prior_variance,
            shifted,
            step.amplitude,
            float(self.model.amplitude_std**2),
            offset,
            float(variance),
            pmf,
            sums,
        )
        share, mean = 0.0, 0.0
        if step.jump is not None:
            share = min(1.0, float(step.w[step.jump != 0].sum()))
            mean = float((step.w * step.jump).sum()) / share if share else 0.0
        # Weights add up to one but for rounding: no probability may pass it for that.
        return Summary(np.minimum(pmf, 1.0), sums, shift, (share, mean))

    def _drawn(
        self, old: Sets, record: Record, uniform: FloatArray
    ) -> tuple[Sets, FloatArray, IntArray | None]:
        """Sets drawn from the proposals by uniform (N, uniforms), log of model to proposal (N,),
        and by how many cells they jumped (N,), None where none can."""
        model, passage, walks = self.model, record.passage, record.walks
        new, log_ratio = Sets.empty(model, self.particles), np.zeros(self.particles)
        left, new.order[:] = leave(model.order_min, passage.cumulative, old, uniform)
        shape = len(model.signs) * model.record_cells, walks.probability.shape[1]
        if self._tables.running.shape != shape:
            self._tables = WalkTables.empty(*shape)
        fill, jump, moved = (walks, record.gains, model.walk_share), None, old
        if model.jump and passage.shared:
            fill_walks(*fill, np.zeros(shape[0], np.bool_), self._tables, all_sums=True)
            jump = self._draw_shared(left, old.shift, record, uniform, log_ratio) - model.jump.pad
            moved = old._replace(cell=(old.cell + jump[:, None]).clip(0, model.cells - 1))
        shifted = model.shift is not None
        fill_walks(*fill, walked_from(model, moved), self._tables, all_sums=shifted)
        if shifted:
            new.shift[:] = self._draw_shared(left, old.shift, record, uniform, log_ratio)
        drawn = 1 + passage.most_changes, uniform
        tables = walks.centre[walks.kind], self._tables
        self._draw(left, tables, record.births, drawn, new, log_ratio, jump)
        if model.amplitude_memory:
            new = inherited(model, old, left.parent, new)
        return new, log_ratio, jump

    def _draw_shared(
        self, left: Left, old: IntArray, record: Record, drawn: FloatArray, log_ratio: FloatArray
    ) -> IntArray:
        """The shifts or jumps (N,) plus pad of those that are left, in a record whose walks are
        known; old (N,): shifts of the record before. log_ratio (N,) is written."""
        from . import set_shift_kernels as shift_kernels  # compiled where it is needed only

        shared, tables = record.passage.shift or self.model.jump, record.passage.shared
        assert shared and tables
        log_sum = self._tables.log_sum.reshape(len(self.model.signs), -1)
        # A jump leads beyond the lattice, and what is neighbours on the grid becomes so in memory.
        pad, step = shared.pad if self.model.jump else 0, shared.step
        more = pad + -(log_sum.shape[1] + 2 * pad) % step
        log_sum = np.pad(log_sum, ((0, 0), (pad, more)), constant_values=-np.inf)
        log_sum = np.ascontiguousarray(log_sum.reshape(len(log_sum), -1, step).swapaxes(1, 2))
        known = step, *tables[1:], log_sum, self.model.walk_share, drawn
        found, slots, G = np.empty_like(old), shift_kernels.SLOTS, tables.log_prior.shape[1]

        def work(first: int, last: int) -> None:
            key = np.full((slots, left.cell.shape[1] + 2), -1, np.int64)
            span = np.empty((slots, 2), np.int64)
            scratch = key, np.empty((slots, G)), np.empty((slots, G)), span
            shift_kernels.draw_shifts(first, last, *known, *left, old, *scratch, found, log_ratio)

        self._split(work)
        return found

    def _draw(
        self,
        left: Left,
        walks: tuple[IntArray, WalkTables],
        births: Births,
        drawn: tuple[int, FloatArray],
        sets: Sets,
        log_ratio: FloatArray,
        jump: IntArray | None = None,
    ) -> None:
        """Let those that are left jump and walk, and others be born, into `sets`, whose order and
        shift are known. walks: see `set_kernels.propagate`, as what else there is."""
        model, (centre, tables) = self.model, walks
        jump = np.zeros(len(sets.order), np.int64) if jump is None else jump
        known = model.cells, model.separation, *drawn, *left, jump, centre, *tables[:2], *births
        sets_of = sets.shift, sets.order, sets.cell, sets.sign
        self._split(
            lambda first, last: kernels.propagate(first, last, *known, *sets_of, log_ratio)
        )

    def _split(self, work: Callable[[int, int], None]) -> None:
        """Run work(first, last) over all particles, a share for each thread."""
        if self._pool is None:
            work(0, self.particles)
            return
        edges = np.linspace(0, self.particles, self.threads + 1).astype(int).tolist()
        list(self._pool.map(work, edges[:-1], edges[1:]))


@define(eq=False)
class LagSmoother:
    """Fixed-lag smoothing by surviving lines: each of the newest particles is traced to its
    ancestor `lag` records ago. STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('_steps',)

    lag: int
    _steps: deque[SetStep] = field(init=False)

    def __attrs_post_init__(self) -> None:
        self._steps = deque(maxlen=self.lag + 1)

    @property
    def steps(self) -> list[SetStep]:
        """The steps that are kept, oldest first."""
        return list(self._steps)

    def push(self, step: SetStep) -> SetStep | None:
        """The step `lag` records before this one as the ancestors of its sets, each with the
        weight of its descendant; None while there is none, and after a record that nothing
        explained.

        What all members and shifts are off by together is the same in every record. The ancestor
        knows of it what its descendant does, against its own places: those of the descendant have
        since been moved by what was drawn of it.
        """
        if not step.ok or not self.lag:
            self._steps.clear()
            return None
        self._steps.append(step)
        if len(self._steps) <= self.lag:
            return None
        steps = list(self._steps)
        line, drawn = np.arange(len(step.w)), np.zeros(len(step.w))
        for earlier in reversed(steps[:-1]):
            if earlier.path:
                before = earlier.sets.shift[earlier.source]
                drawn += (earlier.after.sets.shift - before)[line]
            line = earlier.source[line]
        path = step.path.moved(drawn) if step.path else None
        first = steps[0]
        return evolve(
            first,
            sets=first.sets.take(line),
            w=step.w,
            amplitude=first.amplitude[line],
            path=path,
            jump=None if first.jump is None else first.jump[line],
        )


def _generator(key: tuple[int, int], purpose: int) -> np.random.Generator:
    """The random numbers of one record for one purpose."""
    counter = np.array([0, 0, 0, purpose], np.uint64)
    return np.random.Generator(np.random.Philox(key=np.array(key, np.uint64), counter=counter))
