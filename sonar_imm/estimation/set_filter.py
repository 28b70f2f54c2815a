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

"""The filter of `set_particles`, run: one record after the other, on any number of threads.

`SetFilter.step` is pure: it takes the weighted sets before a record and gives those after it. A
record can therefore be tried without being taken in (a preview), and the sets at one record can be
weighted again when later records are in (`LagSmoother`).

Random numbers are counter based: those of a record come from a Philox generator whose key is the
seed and the record's own name (its stamp), and each particle has its row of them. The result is
therefore the same whatever was processed before, and on one thread or several.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import math
from typing import NamedTuple

from attrs import evolve, frozen
import numpy as np

from . import set_amplitudes as amplitudes
from . import set_particles_kernels as kernels
from .arrays import FloatArray, IntArray
from .particles import effective_sample_size, normalise
from .resampling import systematic
from .set_model import SetModel, Sets
from .set_particles import gains, Proposals, propose_births
from .set_scatter import fit_scatter, ScatterFit
from .set_shifts import shift_tables, ShiftPath

_STEP, _START, _RESAMPLE, _OFFSET = range(4)


class Weighted(NamedTuple):
    """Sets with log weights (N,) that need not be normalised: the state between records. path: of
    their shifts, None without."""

    sets: Sets
    log_weight: FloatArray
    path: ShiftPath | None = None


@frozen(eq=False)
class SetStep:
    """One record taken in.

    sets: weighted by w (N,), summing to one; amplitude (N, J) given each set, in units of the
    noise. after: the same, resampled when needed; source (N,) the index into `sets` of each of
    them. log_evidence: log of the record's probability given those before, against that of an
    empty record; effective: sample size; ok False when no set could explain the record; path: of
    the shifts of `sets`, None without.
    """

    sets: Sets
    w: FloatArray
    amplitude: FloatArray
    after: Weighted
    source: IntArray
    log_evidence: float
    effective: float
    ok: bool
    path: ShiftPath | None = None


class SetFilter:
    """Runs a `SetModel` on `particles` sets with `threads` threads."""

    def __init__(self, model: SetModel, particles: int, threads: int = 1):
        self.model = model
        self.particles = particles
        self.threads = threads
        shape = model.record_cells * len(model.signs), len(model.move)
        self._move, self._move_ratio = np.empty(shape), np.empty(shape)
        log_sum = np.zeros((len(model.signs), model.record_cells if model.shift else 0))
        self._shifts = shift_tables(model.shift, log_sum, model.move_share)
        self._motion = kernels.SetMotion(
            order_min=model.order_min,
            separation=model.separation,
            most_changes=model.most_changes,
            cumulative=np.cumsum(model.transition, axis=1),
        )
        self._amplitudes = amplitudes.AmplitudeModel(
            gram=model.gram,
            ridge=float(model.ridge),
            penalty=float(model.penalty),
            marginal=model.amplitude_prior == 'marginal',
            memory=float(model.amplitude_memory),
            variance=float(model.amplitude_std**2),
        )
        self._charge = np.array(
            [
                math.lgamma(m + 1) + math.log(max(model.room(m), 1)) - m * math.log(model.cells)
                for m in range(model.order_min, model.order_max + 1)
            ]
        )
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def step(
        self,
        before: Weighted | None,
        b: FloatArray,
        key: tuple[int, int],
        gram: FloatArray | None = None,
    ) -> SetStep:
        """Take in the record b (n,), or (n + 2 pad,) with a shift, in units of its noise. before:
        None before the first record. key: seed and name of the record, each in 0 .. 2^64 - 1.
        gram (n,): of this record, where it is not the model's."""
        answer = self._amplitudes if gram is None else self._amplitudes._replace(gram=gram)
        fit = fit_scatter(self.model.scatter, b)
        if before is None:
            before = self._start(b, key, fit)
        sets, log_ratio = self._propagate(before.sets, b, _uniform(key, _STEP), fit)
        log_weight = before.log_weight + log_ratio
        amplitude = self._weigh(sets, b, log_weight, answer, fit)
        w, log_sum = normalise(log_weight)
        _, log_before = normalise(before.log_weight)
        ok = bool(np.isfinite(log_sum))
        effective = float(effective_sample_size(w)) if ok else 0.0
        path = seen = self._path(before, sets)
        source = np.arange(self.particles)
        resampled = ok and effective < 0.5 * self.particles
        if resampled:
            source = systematic(w, self.particles, _uniform(key, _RESAMPLE))
            log_weight = np.zeros(self.particles)
            path = path.take(source) if path else None
        after = self._remembered(sets.take(source), amplitude[source], answer)
        known = Weighted(after, log_weight, path)
        if resampled:
            known = self._offset(known, _uniform(key, _OFFSET))
        evidence = float(log_sum - log_before)
        return SetStep(sets, w, amplitude, known, source, evidence, effective, ok, seen)

    def warm(self) -> None:
        """Compile or load the kernels."""
        lag = np.minimum(np.arange(self.model.record_cells), self.model.cells - 1)
        b = np.maximum(0.0, 10.0 * self.model.gram[np.abs(lag - 1)])
        step = SetFilter(self.model, 8).step(None, b, (0, 0))
        self.summary(step)

    def summary(self, step: SetStep) -> tuple[FloatArray, FloatArray]:
        """PMF (orders,) of the order and sums (5, n), see `set_particles_kernels.moments`."""
        pmf = np.zeros(len(self.model.transition))
        rows = kernels.SHIFTED_SUMS if self.model.shift else kernels.SUMS
        sums = np.zeros((rows, self.model.record_cells))
        offset, variance = _offset_of(step.path)
        prior, least = self._amplitudes.variance, self.model.order_min
        kernels.moments(
            step.w, step.sets, step.amplitude, offset, variance, prior, least, pmf, sums
        )
        # Weights add up to one but for rounding: no probability may pass it for that.
        return np.minimum(pmf, 1.0), sums

    def shift(self, step: SetStep) -> tuple[float, float]:
        """Mean and standard deviation of the shift, cells."""
        offset, variance = _offset_of(step.path)
        there = step.sets.shift + offset
        mean = float(step.w @ there)
        spread = math.sqrt(float(step.w @ np.square(there - mean)) + variance)
        return mean - self.model.pad, spread

    def _start(
        self, b: FloatArray, key: tuple[int, int], fit: ScatterFit | None = None
    ) -> Weighted:
        model, sets = self.model, Sets.empty(self.model, self.particles)
        uniform = _uniform(key, _START).random(
            (self.particles, 1 + model.order_max + (model.shift is not None))
        )
        log_ratio = np.zeros(self.particles)
        proposals = self._proposals(self._gains(b, fit))
        self._split(
            lambda first, last: kernels.start(
                first, last, self._motion, self._charge, proposals, uniform, sets, log_ratio
            )
        )
        # An impossible set has members that mean nothing; it must not be moved.
        sets.cell[~np.isfinite(log_ratio)] = 0
        # The sets are draws from the prior in disguise: as many particles as if they were.
        return Weighted(sets, log_ratio)

    def _path(self, before: Weighted, sets: Sets) -> ShiftPath | None:
        shift = self.model.shift
        if shift is None:
            return None
        if before.path is None:
            return ShiftPath.begin(shift, sets.shift)
        return before.path.then(shift, before.sets.shift, sets.shift)

    def _offset(self, known: Weighted, rng: np.random.Generator) -> Weighted:
        """With the offset of members and shift drawn anew, so that copies of a set differ."""
        sets, shift = known.sets, self.model.shift
        if shift is None or known.path is None:
            return known
        u = rng.random((self.particles, 2))
        low, high = kernels.free(sets, self.model.cells)
        d, path = known.path.draw(shift, sets.shift, (low, high), u)
        moved = sets._replace(cell=kernels.lowered(sets, d), shift=sets.shift + d)
        return known._replace(sets=moved, path=path)

    def _gains(self, b: FloatArray, fit: ScatterFit | None) -> FloatArray:
        background = fit_scatter(self.model.scatter, b) if fit is None else fit
        return gains(self.model, b, background)

    def _proposals(self, g: FloatArray) -> Proposals:
        """The tables of one record of gains g (S, n), moves not filled in."""
        births = propose_births(self.model, g)
        return Proposals(self._move, self._move_ratio, *births, self._shifts)

    def _propagate(
        self,
        old: Sets,
        b: FloatArray,
        rng: np.random.Generator,
        fit: ScatterFit | None = None,
    ) -> tuple[Sets, FloatArray]:
        model, new = self.model, Sets.empty(self.model, self.particles)
        log_ratio = np.empty(self.particles)
        uniform = rng.random((self.particles, model.uniforms))
        g = self._gains(b, fit)
        proposals = self._proposals(g)
        if model.shift:
            kernels.fill_all_moves(old, g, model.move, model.move_share, proposals)
        else:
            filled = np.zeros(len(self._move), np.bool_)
            kernels.fill_moves(old, g, model.move, model.move_share, filled, proposals)
        self._split(
            lambda first, last: kernels.propagate(
                first,
                last,
                self._motion,
                self._amplitudes,
                proposals,
                uniform,
                old,
                new,
                log_ratio,
            )
        )
        return new, log_ratio

    def _weigh(
        self,
        sets: Sets,
        b: FloatArray,
        log_weight: FloatArray,
        answer: amplitudes.AmplitudeModel,
        fit: ScatterFit | None = None,
    ) -> FloatArray:
        background = fit_scatter(self.model.scatter, b) if fit is None else fit
        amplitude = np.zeros(sets.cell.shape)
        self._split(
            lambda first, last: amplitudes.weigh(
                first, last, b, answer, background, sets, log_weight, amplitude
            )
        )
        return amplitude

    def _remembered(
        self, sets: Sets, amplitude: FloatArray, answer: amplitudes.AmplitudeModel
    ) -> Sets:
        if self.model.amplitude_memory > 0.0:
            self._split(
                lambda first, last: amplitudes.remember(first, last, answer, amplitude, sets)
            )
        return sets

    def _split(self, work: Callable[[int, int], None]) -> None:
        """Run work(first, last) over all particles, a share for each thread."""
        if self._pool is None:
            work(0, self.particles)
            return
        edges = np.linspace(0, self.particles, self.threads + 1).astype(int).tolist()
        list(self._pool.map(work, edges[:-1], edges[1:]))


class LagSmoother:
    """Fixed-lag smoothing by surviving lines: each of the newest particles is traced to its
    ancestor `lag` records ago."""

    def __init__(self, lag: int):
        self.lag = lag
        self._steps: deque[SetStep] = deque(maxlen=lag + 1)

    def push(self, step: SetStep) -> SetStep | None:
        """The step `lag` records before this one as the ancestors of its sets, each with the
        weight of its descendant; None while there is none, and after a record that nothing
        explained.

        What all members and shifts are off by together is the same in every record. The ancestor
        knows of it what its descendant does, against its own places: those of the descendant have
        since been moved by what was drawn of it.
        """
        if not step.ok:
            self._steps.clear()
            return None
        self._steps.append(step)
        if len(self._steps) <= self.lag or not self.lag:
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
            first, sets=first.sets.take(line), w=step.w, amplitude=first.amplitude[line], path=path
        )

    def clear(self) -> None:
        self._steps.clear()


def _offset_of(path: ShiftPath | None) -> tuple[FloatArray, float]:
    """Mean (N,) and variance of what is still to be drawn, cells."""
    return (path.mean, 1.0 / path.precision) if path else (np.empty(0), 0.0)


def _uniform(key: tuple[int, int], purpose: int) -> np.random.Generator:
    """The random numbers of one record for one purpose."""
    counter = np.array([0, 0, 0, purpose], np.uint64)
    return np.random.Generator(np.random.Philox(key=np.array(key, np.uint64), counter=counter))
