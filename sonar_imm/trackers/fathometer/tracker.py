# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Reflectors below the sea floor, their number unknown and changing, from the noise of the sea.

    pressure -> cross-spectra (`pressure`)
             -> depth response (`response`): traces come in here
             -> multiple-model particle filter (`estimation.set_filter`), whose particles are
                sets of reflectors
             -> reflectors with ids (`reflectors`) -> one estimate per record

The cycle of the particle filter, for each record (`FathometerTracker._cycle`):

    propagate   each set: heave of the array, deaths, common jump, walks in depth, births
    weigh       each set by how well it explains the depth response
    resample    sets by their weights, where few of them count
    move        heave and depths of each set together, where the array's heave is a state: records
                tell their sum only
    summarise   the number of reflectors (order), and where they are

Records are minutes of averaging apart, so that each is taken in once and for good: one that is
late or repeated is counted and dropped. The random numbers of a record come from its own stamp.
After a gap, or a longer way, what is per record happens as often as records would have come
(`Pace`).

With a `smoothing_lag`, `process` gives the revised estimate of an earlier record before that of
the newest. A preview leaves the filter as it was: windows that overlap are not independent.

Source: docs/fathometer.md, after C. Yardim, P. Gerstoft, Z.-H. Michalopoulou, *Passive fathometer
reflector identification with multiple model particle filtering*.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
import math
from typing import Any

from attrs import evolve
import numpy as np

from ...acoustics.pulse import independent_samples, Pulse
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.set_filter import LagSmoother, SetFilter, SetStep, Weighted
from ...estimation.set_members import find_members
from ...estimation.set_model import (
    banded_transition,
    gaussian_walk,
    independent_orders,
    SetModel,
    walk_reach,
)
from ...intake import KnownFrames
from ...intake.stream import OnceStream, StreamRules
from ...measurements import ArrayDepth, CrossSpectra, GeodeticFix, Pressure, Rejection, Trace
from .config import FathometerConfig
from .datum import DatumError, LEAST_FOLLOWED
from .fit import Fit, has_negative_residual
from .multiples import Multiples, seen_as
from .phones import PhoneFaults
from .pressure import (
    Collected,
    CompanionDepths,
    CompanionPlaces,
    MOST_HEAVE,
    Pace,
    PressureStream,
)
from .reflectors import (
    earlier_ids,
    IdArray,
    Identities,
    Reflectors,
    reflectors_of,
    Taken,
    write_estimate,
)
from .response import (
    array_response,
    common_jump,
    depths_wanted,
    heave_shift,
    Lattice,
    lattice_of_array,
    lattice_of_trace,
    MAX_MOVES,
    MAX_SIGMAS,
    pulse_of,
    rank_deficient,
    residual_sigma,
    Response,
    trace_response,
    widened,
)
from .slopes import slopes_followed
from .water import Water
from .width import EchoWidth

__all__ = ['FathometerConfig', 'FathometerTracker']

LONGEST_GAP = 5000


class FathometerTracker:
    """The tracker of `trackers.Tracker` for reflectors: `process` takes `Pressure`,
    `CrossSpectra`, `Trace`, `ArrayDepth` and `GeodeticFix`.

    response: the depth response of the newest record or preview, for display; None before.
    refusals: the sentence of the first record that could not be used, by reason.
    """

    STATE = (
        *('response', 'refusals', '_stream', '_pace', '_ids', '_depths', '_places'),
        *('_hydrophones', '_pressure', '_multiples', '_lattice', '_before', '_smoother'),
        *('_taken', '_recent', '_health', '_fit', '_phones', '_water', '_datum', '_width'),
    )

    response: Response | None
    refusals: dict[str, str]
    _stream: OnceStream
    _pace: Pace
    _ids: Identities
    _depths: CompanionDepths
    _places: CompanionPlaces
    _hydrophones: int
    _pressure: PressureStream
    _multiples: Multiples
    _lattice: Lattice | None
    _before: Weighted | None
    _smoother: LagSmoother
    _taken: deque[Taken]
    _recent: deque[Response]
    _health: dict[str, float]
    _fit: Fit
    _phones: PhoneFaults
    _water: Water
    _datum: DatumError
    _width: EchoWidth
    _own: FathometerConfig

    def __init__(self, config: FathometerConfig):
        self.config = config
        self._pulse = pulse_of(config)
        self.reset()

    @property
    def pulse(self) -> Pulse:
        """Of one reflector, unless a response has its own."""
        return pulse_of(self._own) if self._width.followed else self._pulse

    def _effective(self) -> FathometerConfig:
        """Return the parameters with the pulse and the heave that are used."""
        return self._datum.effective(self._width.effective(self.config))

    def reset(self) -> None:
        self._stream = OnceStream((Pressure, CrossSpectra, Trace), StreamRules.of(self.config))
        self.counts = self._stream.counts
        self.response, self.refusals = None, {}
        self._ids = Identities()
        self._depths = CompanionDepths()
        self._places = CompanionPlaces()
        self._forget()

    def _forget(self) -> None:
        """Begin anew, but for counts and ids."""
        self._datum, self._width = DatumError(), EchoWidth()
        self._own = self._effective()
        self._hydrophones = self.config.phones
        self._pace = Pace()
        self._pressure = PressureStream(self.config, self.counts)
        self._ids = self._ids.forget()
        self._multiples = Multiples()
        self._lattice = None
        self._settled = self._own
        self._padded: Lattice | None = None
        self._filter: SetFilter | None = None
        self._before = None
        self._smoother = LagSmoother(self._own.smoothing_lag)
        self._taken = deque(maxlen=self._own.smoothing_lag + 1)
        self._recent = deque(maxlen=LEAST_FOLLOWED)
        self._health = {}
        self._fit = Fit()
        self._phones = PhoneFaults()
        self._water = Water(self._own)

    def restored(self) -> None:
        """Build anew what follows from the lattice, after a state was put in."""
        self._datum.require()
        self._width.require()
        self._ids.require()
        self._own = self._effective()
        self._water.require()
        if self._lattice is None:
            if self._before is not None:
                raise ValueError('sets without a lattice')
            return
        self._lattice.require(self._own)
        self._begin(self._lattice)
        if self._before is not None and self._filter is not None:
            self._filter.require(self._before, self._smoother.steps)

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: FathometerConfig) -> None:
        self.config.require_changeable(config)
        heave_differs = config.array_depth_std != self.config.array_depth_std
        self.config = self._water.config = config
        self._own = config = self._effective()
        if self._lattice is not None:
            self._settled = config.settled(self._lattice.hydrophones)
        if self.config.heave in ('independent', 'memory') and heave_differs:
            # It is built into the filter as the spread of a state.
            self._forget()

    def warm(self, inputs: Collection[type] | None = None) -> None:
        if inputs is not None and {ArrayDepth, GeodeticFix}.issuperset(inputs):
            return
        depth = 0.05 * np.arange(200)
        config = evolve(
            self._own,
            depth_min=0.0,
            depth_max=0.0,
            depth_step=0.05,
            min_separation=0.4,
            array_depth_std=0.1,
            order_min=1,
            order_max=2,
            order_transition_matrix=(),
            particles=64,
            threads=1,
        )
        # What is not explained has no next record, and leaves kernels that are for that one.
        tracker = FathometerTracker(config)
        amplitude = 0.1 * np.exp(-np.square((depth - 5.0) / 0.1)) + 0.01 * np.sin(31.0 * depth)
        for second in (1, 2):
            trace = Trace(stamp_ns=second * 10**9, depth=depth, amplitude=amplitude)
            tracker.process(trace)

    def health(self) -> dict[str, float]:
        """Numbers of the last record: effective sample size, log evidence against an empty one,
        noise, most probable number of reflectors; pulse that was measured, m; and of hydrophones
        what was left out and corrected, and snapshots waiting."""
        waiting = {'snapshots_waiting': float(self._pressure.waiting)}
        if self._width.followed:
            waiting['pulse_width'] = self._width.followed
        return {**self._health, **waiting, **self._phones.health()}

    def warnings(self) -> list[str]:
        """What of the input leads to estimates that are worse than they say, in sentences."""
        found = []
        if few := self.counts.get('few_snapshots'):
            found.append(
                f'{few} records average fewer independent snapshots than the array has '
                'hydrophones: make them longer (record_seconds), or track less deep (depth_max)'
            )
        if heaving := self.counts.get('heave_within_record'):
            found.append(
                f'in {heaving} records the array heaves by more than {MOST_HEAVE:g} m: their '
                'echoes are weaker than they should be'
            )
        found += self._phones.warnings() + self._water.warnings()
        return [*found, *self._datum.warnings(self.config), *self._fit.warnings(self._own)]

    def process(self, measurement: Any) -> list[Estimate]:
        if isinstance(measurement, ArrayDepth):
            self._depths.add(measurement)
            self.counts['array_depths'] += 1
            return []
        if isinstance(measurement, GeodeticFix):
            self._places.add(measurement)
            self.counts['positions'] += 1
            return []
        admitted = self._stream.admit(measurement)
        if admitted.restarted:
            self._forget()
        return [estimate for item in admitted.items for estimate in self._take(item)]

    def _take(self, item: Pressure | CrossSpectra | Trace) -> list[Estimate]:
        """The estimates of one item; one that cannot be used is counted."""
        try:
            return self._estimates(item)
        except Rejection as rejection:
            self.counts[rejection.reason] += 1
            self.refusals.setdefault(rejection.reason, rejection.sentence)
            return []

    def _estimates(self, item: Pressure | CrossSpectra | Trace) -> list[Estimate]:
        if isinstance(item, Trace):
            depth = self._array_depth(item, 0)
            if self._lattice is None:
                self._water.begin(item)
            fits = self._water.active or not self._width.take(item, self.config, self._pulse)
            self._own = self._effective()
            if self._lattice is None:
                self._begin(lattice_of_trace(item, self._own))
            elif wider := widened(self._lattice, item, self._own):
                self._begin_anew(wider)
                if self._water.active:
                    own = wider.depth
                    self._water = self._water.widened(float(own[0]), float(own[-1]))
            elif not fits:
                self._begin_anew(self._lattice)
            assert self._padded is not None
            reference = math.nan if depth is None else depth
            response = trace_response(item, self._padded, self._own, reference, self._water)
            return self._record(response)
        self._count_hydrophones(item)
        if isinstance(item, CrossSpectra):
            return self._record(self._array_response(Collected(item, item.snapshots), 0))
        records, previews = self._pressure.push(item, self._reach(item))
        self.counts['blocks'] += 1
        span_ns = round(self._own.record_seconds * 1e9)
        made = []
        for record in records:
            made += self._record(self._array_response(record, span_ns))
        for record in previews:
            made.append(self._preview(self._array_response(record, span_ns)))
        return made

    def _reach(self, block: Pressure) -> float:
        """From hydrophone 0 to the deepest depth that is tracked, m."""
        depth = block.reference_depth
        if depth is None:
            depth = self._depths.nearest(block.stamp_ns, self._own) or self._own.array_depth
        if self._lattice is not None:
            return float(self._lattice.depth[-1]) - depth
        return depths_wanted(self._own, depth)[1] - depth

    def _count_hydrophones(self, item: Pressure | CrossSpectra) -> None:
        if self._hydrophones and item.hydrophones != self._hydrophones:
            raise Rejection(
                'wrong_hydrophones',
                f'the array has {item.hydrophones} hydrophones, not {self._hydrophones}',
            )
        self._hydrophones = item.hydrophones
        if not item.alive.all():
            self.counts['dead_hydrophones_masked'] += 1
        self._health['dead_hydrophones'] = float((~item.alive).sum())

    def _array_depth(self, item: CrossSpectra | Trace, span_ns: int) -> float | None:
        """As the record says; else as the companion does; else as configured."""
        if item.reference_depth is not None:
            return item.reference_depth
        depth = self._depths.over(item.stamp_ns, span_ns, self._own)
        if depth is None:
            self.counts['array_depth_unknown'] += not self._own.array_depth
            depth = self._own.array_depth or None
        return depth

    # -- a record ---------------------------------------------------------------------------------

    def _array_response(self, collected: Collected, span_ns: int) -> Response:
        record = collected.spectra
        if rank_deficient(record):
            self.counts['rank_deficient'] += 1
        self.counts['few_snapshots'] += bool(0.0 < collected.snapshots < record.alive.sum())
        spread = max(collected.depth_std, self._depths.spread(record.stamp_ns, span_ns))
        self.counts['heave_within_record'] += spread > MOST_HEAVE
        depth = self._array_depth(record, span_ns) or 0.0
        if self._lattice is None:
            lattice = lattice_of_array(depth, self._own)
            self._begin(evolve(lattice, hydrophones=self._hydrophones))
        assert self._padded is not None
        return array_response(record, self._padded, self._settled, depth)

    def _begin(self, lattice: Lattice) -> None:
        try:
            model = self._set_model(lattice)
            self._filter = SetFilter(model, self._own.particles, self._own.threads)
        except ValueError as error:
            raise Rejection('too_crowded', str(error)) from None
        self._lattice, self._settled = lattice, self._own.settled(lattice.hydrophones)
        self._padded = lattice.padded(self._filter.model.pad)

    def _set_model(self, lattice: Lattice) -> SetModel:
        """Return what the particle filter assumes. A subclass can change it, as the printed form
        in benchmarks/fathometer_paper.py does. Raises ValueError when the most reflectors do not
        fit."""
        config = self._own.settled(lattice.hydrophones)
        pulse, step = pulse_of(config), lattice.step
        transition = banded_transition(config.orders, config.order_switch_probability)
        if config.order_transition_matrix:
            square = config.orders, config.orders
            transition = np.reshape(config.order_transition_matrix, square)
        return SetModel(
            cells=lattice.cells,
            separation=max(1, math.ceil(config.min_separation / step - 1e-6)),
            order_min=config.order_min,
            transition=transition,
            walk=gaussian_walk(config.depth_std / step),
            gram=np.ascontiguousarray(pulse(step * np.arange(lattice.cells, dtype=np.float64))),
            amplitude_std=config.amplitude_std,
            independent_samples=independent_samples(pulse, step * lattice.cells, 0.25 * step),
            amplitude_memory=config.amplitude_memory,
            negative_probability=config.negative_share,
            shift=heave_shift(config, step),
            # Schools of fish come and go together as layers that jump would.
            jump=None if self._water.active else common_jump(config, step),
            start=independent_orders(config.order_min, config.orders),
        )

    def _filtered(self, response: Response) -> tuple[Response, SetStep, int, Pace]:
        """What this record would change, how many records' time passed, and the pace with it.
        Where its noise is not known, it is measured in what a first round's reflectors leave."""
        place = self._places.at(response.stamp_ns, self._own)
        records = self._pace.records(response.stamp_ns, self._own, place)
        step = self._cycle(response, records)
        if response.noise_unknown:
            found, _ = self._summarise(step, response)
            away = response.depth[:, None] - (found.depth + found.heave)
            pulse = response.pulse or self.pulse
            response = residual_sigma(response, pulse(away) @ found.amplitude)
            step = self._cycle(response, records)
        self.response = response
        return response, step, records, self._pace.after(response.stamp_ns, place)

    def _cycle(self, response: Response, records: int) -> SetStep:
        """The particle filter over one record; what is kept of it is decided by the caller."""
        assert self._filter is not None and self._lattice is not None
        # Beyond a million sigmas the numbers say nothing more, and their squares would overflow.
        with np.errstate(over='ignore', divide='ignore', invalid='ignore'):
            b = np.clip(response.amplitude / response.sigma, -MAX_SIGMAS, MAX_SIGMAS)
        b = np.ascontiguousarray(np.nan_to_num(b))
        key, gram = (self._own.seed, response.stamp_ns), None
        if response.pulse is not None:
            lags = self._lattice.step * np.arange(self._lattice.cells, dtype=np.float64)
            gram = np.ascontiguousarray(response.pulse(lags))
        particles, before = self._filter, self._before
        if not self._bridged(records):
            before = None
        records = 0 if before is None else records
        walks = None
        if before is not None and slopes_followed(self._own):
            walks = self._ids.walks(self._lattice, records, self._own)
        record = particles.record(b, key, gram, records, walks)
        before = before or particles.start(record)
        sets = particles.propagate(before, record)
        step = particles.weigh(sets, record)
        step = particles.resample(step, record)
        return particles.move(step, record)

    def _bridged(self, records: int) -> bool:
        """Whether sets can be followed over so many records: a short enough time, in which fewer
        than half of the most reflectors come and go, and not more walks than there is room for.
        Otherwise they begin anew."""
        assert self._filter is not None and self._lattice is not None
        if records > 1 and 2.0 * records * self._filter.model.mean_changes > self._own.order_max:
            return False
        reach = walk_reach(math.sqrt(records) * self._own.depth_std / self._lattice.step)
        tables = self._lattice.cells * (2.0 * reach + 1.0)
        return records == 1 or (records <= LONGEST_GAP and tables <= MAX_MOVES)

    def _named(
        self, known: Identities, found: Reflectors, records: int
    ) -> tuple[Identities, IdArray]:
        known = known.wait(records - 1) if records <= LONGEST_GAP else known.forget()
        # Where heave begins to be a state, all depths may come to lie elsewhere together.
        most = 2.0 * self._own.common_jump_std if found.heave_std else 0.0
        jump = found.probable_jump or known.offset(found.depth, most, self._own.min_separation)
        return known.moved(jump).name(
            found.depth,
            found.is_bottom,
            self._own,
            found.covariance[:, 0, 0],
            strength=found.strength,
            floor_known=bool(self._water.active),
            jump=jump,
        )

    def _record(self, response: Response) -> list[Estimate]:
        response, step, records, self._pace = self._filtered(response)
        self._before = step.after if step.ok else None
        self.counts['used'] += 1
        if records > 1:
            self.counts['gaps'] += 1
        if not self._bridged(records):
            self._smoother = LagSmoother(self._own.smoothing_lag)
        self.counts['unexplained'] += not step.ok
        reflectors, pmf = self._summarise(step, response)
        before = self._ids
        self._ids, ids = self._named(before, reflectors, records)
        if records == 1:
            self._datum.note(before, ids, reflectors, self._own, array=not self._water.active)
        if again := self._datum_followed(response):
            response, step = again
            reflectors, pmf = self._summarise(step, response)
            self._ids, ids = self._named(before, reflectors, records)
            self._datum.heave = reflectors.heave
        self._taken.append(Taken(response, self._ids.reflectors, reflectors.probable_jump))
        self._health.update(
            effective_sample_size=step.effective,
            log_evidence=step.log_evidence,
            sigma=response.noise,
            order=float(self._own.order_min + int(np.argmax(pmf))),
        )
        negative = self._settled.polarity == 'positive' and has_negative_residual(
            reflectors, response, response.pulse or self.pulse, self._own
        )
        self.counts['foreign_hydrophones_left_out'] += self._phones.add(response, self._own)
        self._fit.add(step.ok, reflectors, response, float(pmf[-1]), negative)
        newest = self._write(reflectors, ids, pmf, response, self._ids, records)
        self._multiples = self._multiples.after(seen_as(reflectors, ids, records))
        return [*self._smoothed(step), newest]

    def _datum_followed(self, response: Response) -> tuple[Response, SetStep] | None:
        """Make the error of the array's depth a state, where it is far greater than what is told,
        or than what is followed, and take the last records again; the newest as it is seen then,
        None where nothing changes. The reflectors keep their ids."""
        datum, lattice = self._datum, self._lattice
        # What moves the floor of a profiler is its ship, which slopes follow.
        if self.config.heave != 'auto' or self._water.active or lattice is None:
            return None
        self._recent.append(response)
        before = datum.followed
        if not datum.follow(self.config):
            return None
        self._own = self._effective()
        try:
            lattice.require(self._own)
            self._begin_anew(lattice, self._recent)
        except (ValueError, Rejection):
            datum.followed = before
            self._own = self._effective()
            self._begin(lattice)
            return None
        assert self._padded is not None
        # One record says where the layers lie as badly as the depth of the array is known.
        for recent in self._recent:
            response = recent.onto(self._padded)
            step = self._cycle(response, 1)
            self._before = step.after if step.ok else None
        return response, step

    def _begin_anew(self, lattice: Lattice, recent: Iterable[Response] = ()) -> None:
        """Go on with other depths or parameters. The reflectors keep their ids."""
        self._begin(lattice)
        self._before = None
        self._smoother = LagSmoother(self.config.smoothing_lag)
        self._taken.clear()
        self._recent = deque(recent, maxlen=LEAST_FOLLOWED)

    def _preview(self, response: Response) -> Estimate:
        response, step, records, _ = self._filtered(response)
        reflectors, pmf = self._summarise(step, response)
        known, ids = self._named(self._ids, reflectors, records)
        self.counts['previews'] += 1
        return self._write(reflectors, ids, pmf, response, known, records, preview=True)

    def _smoothed(self, newest: SetStep) -> list[Estimate]:
        """The record `smoothing_lag` ago, seen with all since."""
        step = self._smoother.push(newest)
        if step is None:
            return []
        response = self._taken[0].response
        reflectors, pmf = self._summarise(step, response)
        ids = earlier_ids(reflectors.depth, self._taken, self._own)
        return [self._write(reflectors, ids, pmf, response, self._ids)]

    def _write(
        self,
        reflectors: Reflectors,
        ids: IdArray,
        pmf: FloatArray,
        response: Response,
        known: Identities,
        records: int = 1,
        *,
        preview: bool = False,
    ) -> Estimate:
        multiple = np.full(len(ids), np.nan)
        if self._own.multiples == 'mark':
            assert self._lattice is not None
            span = self._lattice.step * self._lattice.cells
            seen = seen_as(reflectors, ids, records)
            multiple = self._multiples.probabilities(seen, self._settled, span)
        return write_estimate(
            reflectors,
            ids,
            pmf,
            multiple,
            known,
            response,
            self._own,
            array_depth_found=self._datum.counted(self.config),
            preview=preview,
        )

    def _summarise(self, step: SetStep, response: Response) -> tuple[Reflectors, FloatArray]:
        """The reflectors of the most probable order, and the PMF (orders,) of the order."""
        assert self._filter is not None and self._lattice is not None
        pmf, sums, shift, jump = self._filter.summarise(step)
        most = self._own.order_min + int(np.argmax(pmf))
        separation = self._filter.model.separation
        modes = bool(self._water.active)
        members = find_members(sums, separation, most, self._own.existence_min, modes=modes)
        pulse, cell = response.pulse or self.pulse, self._lattice.step
        heave = (cell * shift[0], cell * shift[1]) if shift else None
        common = heave, self._datum.counted(self.config), jump
        return reflectors_of(members, response, self._lattice, pulse, self._own, *common), pmf
