# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The water above the floor in the envelopes of a profiler: what particles see, and the bottom.

    first 60 traces -> transmit pulse, noise by depth, pulse (`acoustics.envelopes`)
    each trace      -> chain of transmit pulse, water, onset, below (`estimation.onset`)
                    -> normal numbers against noise and scatter, which the particle filter takes
                    -> `SeenFloor`: the posterior of the onset, for the columns of the estimate

Scatter below the floor is a noise power that begins at the onset (`envelopes.scatter_power`).
Until ten traces are there the noise is that which is stated, or of the quietest tenth of the
trace, and nothing is said of the bottom where none is stated. The tables follow the traces that
came until sixty, and stay. What does not fit a normal number in the tails is left to `CAUTION`.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, NamedTuple

from attrs import define, field, frozen
import numpy as np

from ...acoustics import envelopes
from ...estimation.arrays import FloatArray, IntArray
from ...estimation.onset import OnsetChain, OnsetState
from ...measurements import Trace
from .config import FathometerConfig
from .noise import stated_sigma

TABLE_COUNTS = 10, 12, 15, 20, 25, 30, 40, 50, 60
"""Numbers of traces at which the tables are made, the last of them for good."""
CAUTION = 1.15
"""By how much the noise is taken to be greater: that of stacked traces is no Rayleigh."""
SCATTER_MEMORY = 0.9
UNKNOWN_PULSE, LEAD = 2.0, 2.4
"""Samples of a pulse that is not known; pulses from the onset to the reflector, likewise."""
LEAST_SAMPLES, MASKED, NEAR, LOUD = 20, 0.25, 10.0, 3.0
STILL_RECORDS, MOVED, MOVED_SAMPLES = 60, 0.5, 3.0
"""Traces in which a first return that never moves is doubted, and by how much, in m and samples,
what is below moves then."""
_DEEP = 0.5


@frozen(eq=False)
class SeenFloor:
    """What a trace, and those before it, say of the floor: posterior (n,) of the onset at the
    depths ``first + step * k``, the last cell for none, empty while it is not known; in m the
    pulse, the lead from the onset to the reflector and its spread, and how deep the transmit pulse
    reaches."""

    posterior: Annotated[FloatArray, 'n'] = field(repr=False)
    first: float
    step: float
    pulse: float
    lead: float
    lead_std: float
    blanked: float

    @property
    def depth(self) -> tuple[float, float]:
        """Mean and standard deviation of the depth of the floor, m; NaN where there is none, and
        where it begins with the window or above it, which nobody can tell."""
        posterior = self.posterior
        if not len(posterior) or max(posterior[-1], posterior[:2].sum()) > _DEEP:
            return math.nan, math.nan
        p = self.posterior[:-1] / self.posterior[:-1].sum()
        cell = np.arange(len(p), dtype=np.float64)
        mean = float(p @ cell)
        spread = self.step * math.sqrt(float(p @ np.square(cell - mean)))
        return self.first + self.step * mean + self.lead, math.hypot(spread, self.lead_std)

    def labels(self, depth: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Probability (K,) of reflectors at `depth` (K,), ascending, to be the floor, and to lie
        above it; NaN while that is not known."""
        if not len(self.posterior):
            nothing = np.full(len(depth), np.nan)
            return nothing, nothing.copy()
        p = self.posterior[:-1]
        onset = self.first + self.step * np.arange(len(p), dtype=np.float64)
        near = np.searchsorted(depth, onset - self.pulse)
        padded = np.append(depth, np.inf)
        within = padded[near] - onset < 5.0 * self.pulse + 2.0 * self.step
        bottom = np.bincount(near[within], p[within], len(depth))[: len(depth)]
        # The onsets below which a reflector lies are the first so many.
        below = np.searchsorted(onset - self.pulse, depth, 'right')
        total = np.append(0.0, np.cumsum(p))
        above = np.minimum(total[-1] - total[below], 1.0)
        return np.minimum(bottom, 1.0), above


class LineTables(NamedTuple):
    """Tables made from T traces together. In samples: ring, pulse, lead, lead_std and onset."""

    noise: FloatArray
    """(n,) rms by depth."""
    loudest: float
    """Amplitude that loud traces reach."""
    ring: int
    """Transmit pulse by `envelopes.transmit_samples`, -1 where there can be none."""
    pulse: float
    """Standard deviation of the pulse, NaN when it is not known."""
    lead: float
    """From the onset to the reflector."""
    lead_std: float
    onset: IntArray
    """(T,) by trace, -1 for none."""
    state: OnsetState
    """State of the chain after the last trace."""


def measure_line(
    traces: FloatArray,
    step: float,
    jump: float = 0.005,
    fish_rate: float = 0.001,
    stated: tuple[FloatArray, float] | None = None,
    least: FloatArray | float = 0.0,
    top: float = 0.0,
) -> LineTables:
    """Make the tables of the traces (T, n), samples `step` m apart. jump, fish_rate: see
    `OnsetChain`; stated: noise (n,) and pulse, in samples, where the traces are too few to tell;
    least: noise that there is at least; top: of the first sample below the transmitter, m: far
    from it what is loud there is no transmit pulse but a floor that is cut."""
    ring = envelopes.transmit_samples(traces) if top < NEAR else -1
    first = stated[0] if stated else np.maximum(envelopes.first_noise(traces), least)
    loudest = float(np.quantile(np.nanmax(traces, axis=1), 0.9))
    whole, cells = first, quiet_cells(first, loudest)
    traces, first = traces[:, :cells], first[:cells]

    def run_chain(noise: FloatArray, pulse: float) -> tuple[IntArray, IntArray, OnsetState]:
        chain = OnsetChain(step, traces.shape[1], step * pulse, ring, jump, fish_rate)
        state, found = chain.start(), []
        for trace in traces:
            state = chain.update(state, *envelopes.log_likelihoods(trace, noise, loudest))
            found.append((state.found, state.ring_length))
        onset, ended = np.array(found).T
        return onset, ended, state

    if stated:
        pulse = stated[1]
        onset, _, state = run_chain(first, pulse)
        return LineTables(whole, loudest, ring, pulse, LEAD * pulse, pulse, onset, state)
    onset, ended, _ = run_chain(first, UNKNOWN_PULSE)
    pulse, *_ = envelopes.pulse_and_lead(traces, onset)
    known = pulse if pulse > 0.0 else UNKNOWN_PULSE
    noise = envelopes.water_noise(traces, first, int(np.median(ended)), onset, known)
    onset, _, state = run_chain(noise, known)
    _, lead, spread = envelopes.pulse_and_lead(traces, onset)
    if not lead >= 0.0:
        lead, spread = LEAD * known, known
    noise = np.append(noise, whole[cells:])
    return LineTables(noise, loudest, ring, pulse, lead, spread, onset, state)


def quiet_cells(noise: FloatArray, loudest: float) -> int:
    """Count the samples, from the first on, in which a floor stands out of the noise (n,): before
    it reaches a quarter of the loudest. What lies there is the gain of the recorder."""
    masked = np.flatnonzero(noise > MASKED * loudest)
    cells = int(masked[0]) if len(masked) else len(noise)
    return cells if cells >= LEAST_SAMPLES else len(noise)


@define(eq=False)
class Water:
    """The water of one line of envelopes, trace by trace. STATE: see `trackers.Tracker`.

    active: whether the traces are envelopes, None before the first; first, step, cells: of the
    depths they are put on, m; top: of the first below the transmitter, m; _traces (T, n): the
    first ones, until the tables are made for good; _count: of all; _noise (n,), rms; _loudest:
    what loud traces reach; _pulse, _lead, _lead_std, _ring: in samples; _state: what is known of
    onset and transmit pulse; _scatter (n,): power of the scatter from four pulses below the onset
    on, of which _seen is how much of its memory is filled; _dry: of _noted traces those without
    water above the first return; _beside (K, 2): where the first return and the loudest below it
    lay in the last traces, in samples."""

    STATE: ClassVar = (
        *('active', 'first', 'step', 'cells', 'top', '_traces', '_count', '_noise', '_loudest'),
        *('_pulse', '_lead', '_lead_std', '_ring', '_state', '_scatter', '_seen', '_noted'),
        *('_dry', '_beside'),
    )

    config: FathometerConfig
    active: bool | None = field(init=False, default=None)
    first: float = field(init=False, default=0.0)
    step: float = field(init=False, default=0.0)
    cells: int = field(init=False, default=0)
    top: float = field(init=False, default=0.0)
    _traces: Annotated[FloatArray, 'tn'] = field(init=False, factory=lambda: np.empty((0, 0)))
    _count: int = field(init=False, default=0)
    _noise: Annotated[FloatArray, 'n'] = field(init=False, factory=lambda: np.empty(0))
    _loudest: float = field(init=False, default=1.0)
    _pulse: float = field(init=False, default=UNKNOWN_PULSE)
    _lead: float = field(init=False, default=0.0)
    _lead_std: float = field(init=False, default=0.0)
    _ring: int = field(init=False, default=0)
    _state: OnsetState | None = field(init=False, default=None)
    _scatter: Annotated[FloatArray, 'n'] = field(init=False, factory=lambda: np.empty(0))
    _seen: float = field(init=False, default=0.0)
    _noted: int = field(init=False, default=0)
    _dry: int = field(init=False, default=0)
    _beside: Annotated[FloatArray, 'k2'] = field(init=False, factory=lambda: np.empty((0, 2)))

    def begin(self, trace: Trace) -> None:
        """Lay out the depths by the first trace of a line, and see whether it is an envelope."""
        wanted = self.config.water == 'auto'
        self.active = wanted and envelopes.is_envelope(trace.amplitude)
        below = np.flatnonzero(trace.depth >= self.config.blanking)
        if len(below) < LEAST_SAMPLES:
            self.active = False
            return
        self.first, self.step = float(trace.depth[below[0]]), trace.step
        self.cells = len(below)
        self.top = self.first - (trace.reference_depth or 0.0)

    def require(self) -> None:
        """Raise ValueError where the state, which may come from a file, does not fit itself."""
        n = self.cells
        good = not self.active or (n >= LEAST_SAMPLES and 0.0 < self.step < math.inf)
        good = good and math.isfinite(self.first + self.top) and self._traces.shape[1] in (0, n)
        numbers = self._pulse, self._lead, self._lead_std, self._loudest, self._seen
        good = good and all(math.isfinite(number) and number >= 0.0 for number in numbers)
        good = good and self._pulse > 0.0 and min(self._count, self._ring + 1, self._noted) >= 0
        if self._state is not None:
            seen = len(self._state.onset)
            good = good and len(self._noise) == n == len(self._scatter) and 2 <= seen <= n
            good = good and bool((self._noise > 0.0).all() and np.isfinite(self._noise).all())
            good = good and bool((self._scatter >= 0.0).all() and np.isfinite(self._scatter).all())
            longest = len(self._chain().start().ring)
            good = good and len(self._state.ring) == longest
            for p in (self._state.onset, self._state.ring):
                good = good and bool((p >= 0.0).all()) and math.isclose(float(p.sum()), 1.0)
        if not good:
            raise ValueError('the water is of no line')

    def widened(self, first: float, last: float) -> Water:
        """Return the start of the same line at the depths from `first` to `last`, m, too."""
        step, low = self.step, max(first, self.config.blanking)
        above = max(0, math.ceil((self.first - low) / step - 1e-6))
        cells = max(self.cells, math.floor((last - self.first) / step + 1e-6) + 1)
        fresh = Water(self.config)
        fresh.active, fresh.step = True, step
        fresh.first, fresh.cells = self.first - above * step, cells + above
        fresh.top = self.top - above * step
        return fresh

    @property
    def depth(self) -> FloatArray:
        """Depths (n,) that traces are put on, m."""
        return self.first + self.step * np.arange(self.cells, dtype=np.float64)

    @property
    def pulse_width(self) -> float:
        """Standard deviation of the pulse, m; of two samples while it is not known."""
        return self.step * self._pulse

    def take(self, trace: Trace) -> tuple[FloatArray, FloatArray, SeenFloor]:
        """A trace as normal numbers (n,), zero where nothing is known; the rms (n,) of the noise
        and scatter that it is seen against; and its floor."""
        amplitude = self._aligned(trace)
        self._count += 1
        if self._count <= TABLE_COUNTS[-1]:
            self._traces = np.vstack([self._traces.reshape(-1, self.cells), amplitude])
        early = self._count < TABLE_COUNTS[0]
        stated = stated_sigma(trace, self.depth, self.config.noise_sigma)
        if early and stated is None:
            scale = np.full(self.cells, CAUTION * envelopes.quietest(amplitude))
        elif early or self._count in TABLE_COUNTS:
            scale = self._make_tables(stated, early=early)
        else:
            scale = self._follow(amplitude)
        if self._count == TABLE_COUNTS[-1]:
            self._traces = np.empty((0, self.cells))
        ring, posterior = 0, np.empty(0)
        if self._state is not None:
            ring, posterior = self._state.ring_length, self._state.onset
            self._note(amplitude, ring)
        with np.errstate(invalid='ignore'):
            # A missing sample is zero as well.
            b = np.nan_to_num(envelopes.to_normal(np.maximum(amplitude, 0.0) / scale))
        b[:ring] = 0.0
        if len(posterior):
            b[len(posterior) :] = 0.0
        floor = SeenFloor(
            posterior,
            self.first,
            self.step,
            self.pulse_width,
            self.step * self._lead,
            self.step * self._lead_std,
            self.first + self.step * ring if ring else 0.0,
        )
        return b, scale, floor

    def _aligned(self, trace: Trace) -> FloatArray:
        """Amplitudes (n,) of a trace at the depths of the first, NaN where it does not reach."""
        depth, off = self.depth, trace.depth[-self.cells :]
        if len(off) == self.cells and np.abs(off - depth).max() < 0.01 * self.step:
            return np.array(trace.amplitude[-self.cells :], np.float64)
        nothing = {'left': np.nan, 'right': np.nan}
        return np.asarray(np.interp(depth, trace.depth, trace.amplitude, **nothing))

    def _make_tables(self, stated: FloatArray | None, *, early: bool) -> FloatArray:
        """Make the tables from the traces so far, and follow these again; the noise and scatter
        (n,) of the newest. stated (n,): noise, all that is known `early`, and the least later on:
        recorders cut off what is quiet."""
        config, known = self.config, None
        if early and stated is not None:
            gaussian = config.pulse == 'gaussian'
            known = stated, max(config.pulse_width / self.step if gaussian else UNKNOWN_PULSE, 1.0)
        least = 0.0 if stated is None else stated
        chances = config.bottom_jump, config.fish_rate
        # Who says where to look has cut off the transmit pulse.
        top = math.inf if config.blanking else self.top
        found = measure_line(self._traces, self.step, *chances, known, least, top)
        self._noise, self._loudest, self._ring = found.noise, found.loudest, found.ring
        self._pulse = found.pulse if found.pulse > 0.0 else UNKNOWN_PULSE
        self._lead, self._lead_std, self._state = found.lead, found.lead_std, found.state
        self._scatter, self._seen = np.zeros(self.cells), 0.0
        scale = self._noise
        for each, onset in zip(self._traces, found.onset.tolist()):
            scale = self._update_scatter(each, onset)
        return CAUTION * scale

    def _chain(self) -> OnsetChain:
        config = self.config
        jump, fish = config.bottom_jump, config.fish_rate
        assert self._state is not None
        cells = len(self._state.onset)
        return OnsetChain(self.step, cells, self.pulse_width, self._ring, jump, fish)

    def _follow(self, trace: FloatArray) -> FloatArray:
        """The chain over one more trace (n,); the noise and scatter (n,) of it."""
        assert self._state is not None
        cells = len(self._state.onset)
        seen = trace[:cells], self._noise[:cells]
        logs = envelopes.log_likelihoods(*seen, self._loudest)
        self._state = self._chain().update(self._state, *logs)
        return CAUTION * self._update_scatter(trace, self._state.found)

    def _update_scatter(self, trace: FloatArray, onset: int) -> FloatArray:
        """Noise and scatter (n,) of a trace (n,) whose floor begins at `onset`, by its scatter and
        that of those before it."""
        power = np.square(self._noise)
        if onset < 0:
            return self._noise.copy()
        own = envelopes.scatter_power(trace, self._noise, onset, self._pulse)
        self._scatter = SCATTER_MEMORY * self._scatter + (1.0 - SCATTER_MEMORY) * own
        self._seen = SCATTER_MEMORY * self._seen + 1.0 - SCATTER_MEMORY
        begin = onset + math.ceil(4.0 * self._pulse)
        if begin < self.cells:
            power[begin:] += self._scatter[: self.cells - begin] / self._seen
            # Nearer to the floor its own echo hides how loud the scatter is: no less than there.
            near = onset + math.ceil(self._lead + self._pulse)
            power[near:begin] += self._scatter[0] / self._seen
        return np.sqrt(power)

    # -- what is wrong with the line --------------------------------------------------------------

    def _note(self, trace: FloatArray, ring: int) -> None:
        assert self._state is not None
        onset = self._state.found
        self._noted += 1
        # Fish do not swim at the first depth of all traces.
        cut = self._ring < 0 and trace[0] > LOUD * self._noise[0]
        self._dry += bool(cut or 0 <= onset <= ring + 2)
        begin = onset + math.ceil(5.0 * self._pulse) + 2
        if onset < 0 or not np.isfinite(trace[begin:]).any():
            return
        if not np.nanmax(trace[begin:]) > np.nanmax(trace[onset:begin], initial=0.0):
            return  # nothing of it is louder: noise lies anywhere
        mean = float(self._state.onset[:-1] @ np.arange(len(self._state.onset) - 1))
        below = begin + int(np.nanargmax(trace[begin:]))
        self._beside = np.vstack([self._beside[1 - STILL_RECORDS :], [mean, below]])

    def warnings(self) -> list[str]:
        """What of the line leads to a wrong floor, in sentences."""
        if self._state is None:
            return []
        found, known = [], self._noted
        if ring := self._state.ring_length:
            found.append(
                f'the first {self.first + self.step * ring:.1f} m hold the transmit pulse and '
                'were not looked at'
            )
        if known >= TABLE_COUNTS[0] and self._dry > 0.5 * known:
            found.append(
                'no water is seen above the first return in '
                f'{100.0 * self._dry / known:.0f} % of the records: the file begins in the '
                'transmit pulse or below the floor'
            )
        if len(self._beside) == STILL_RECORDS:
            first, below = self._beside.T
            moved = float(np.quantile(below, 0.9) - np.quantile(below, 0.1))
            if np.std(first) < 0.5 and moved > max(MOVED_SAMPLES, MOVED / self.step):
                found.append(
                    f'the first return stays within half a sample for {STILL_RECORDS} records '
                    f'while what is below moves by {self.step * moved:.1f} m: it may belong to '
                    f'the instrument; {"increase" if self.config.blanking else "give"} blanking'
                )
        return found
