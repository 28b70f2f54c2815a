# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The sea floor along the swath of a side-scan array, and which terrain model holds where.

A ping of a multi-stave side-scan sonar is a row of snapshots, one per range bin. Each says, with
noise, from which direction the floor answered, and the floor goes on from bin to bin like one of a
few terrain models (`models`). So the filter runs *along the ping*: range is its time.

    snapshot -> likelihood of each bin (`likelihood`)
             -> the cycle of the particle filter, bin after bin (`ping.run`, `filter_kernels`)
             -> optional smoothing -> one row per bin (`ping.summarise`)

The cycle of the particle filter, for each bin with an echo (`filter_kernels`):

    resample    particles of each model, from those of all models that could become it: the
                interaction of the multiple models, and the only resampling that is needed
    propagate   each particle by its terrain model to the next range
    weigh       each particle by the likelihood of its direction; the models by their particles
    summarise   height or angle, its covariance, and the probability of each model

There is no rejuvenation step, `move`: the noise of every terrain model keeps copies of a particle
apart. Through bins without an echo particles are only propagated. The default set, `terrain`, has
none: two Gaussian filters run along the ping, outward and inward (`terrain_kernels`).

Nothing is carried from one ping to the next, which loses more than it gains (docs/bathymetry.md).
Late, shuffled or repeated pings therefore need no care; the random numbers of a ping come from its
own stamp. Only the labels may lean on those of the neighbours (`Coupling`).

On a ship that moves each bin has a pose of its own, and a ping waits until the navigation has
covered its last bin (`PoseQueue`). The state is then the height of the floor in the world, so
that the models know of no attitude.

Source: docs/bathymetry.md, after Saucan, Chonavel, Sintes, Le Caillec, *Interacting multiple model
particle filters for side scan bathymetry*, OCEANS 2013.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection
from functools import cached_property
import math
from typing import Any, ClassVar, NamedTuple

from attrs import define, evolve, field, frozen
import numpy as np

from ...acoustics.calibration import Calibration, FEWEST_STAVES
from ...acoustics.layover import Layover
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...intake import KnownFrames
from ...intake.stream import Stream, StreamRules
from ...measurements import Altitude, nanoseconds, Navigation, Snapshot
from ..navigation import MOST_WAITING, NavigationBuffer
from .bins import Track
from .config import BathymetryConfig
from .findings import (
    FEWEST_PINGS,
    LoudBins,
    noise_warnings,
    Sign,
    sign_evidence,
    sign_warnings,
    stave_warnings,
    staves_of,
    TILTS,
    with_open_start,
)
from .ping import (
    Answer,
    bin_stamps,
    floor_of,
    Look,
    look,
    Ping,
    PosedPing,
    run,
    summarise,
    track_ping,
)
from .two_surfaces import resolve

__all__ = ['BathymetryConfig', 'BathymetryTracker']

SPACING_TOLERANCE = 0.05
PINGS_JUDGED, FEWEST_LOUD = 100, 200
"""Warnings are drawn from the last pings, when they have so many loud bins."""
MUCH_ARRAY_ERROR = 0.01
"""From here on the test for a second surface misses many."""
SOME_DECORRELATION = 0.04
"""Noise, slopes and rough floor make neighbouring staves differ by so much in any case."""
SOME_ALIKE = 1.2
"""So many bins that say the same as one are worth a sentence."""
NEIGHBOURS_NS = 5_000_000_000
"""Pings of one side further apart in time are no neighbours."""
KEPT_NS = 60_000_000_000
_LONGEST_PAUSE_NS = 3_600_000_000_000
_RESTART_AFTER = 5
ALTITUDE_AGE_NS = 5_000_000_000
"""An altitude older than this, seen from the ping, says nothing."""


class BathymetryTracker:
    """The tracker of `trackers.Tracker` for the sea floor: `process` takes `Snapshot`,
    `Navigation` and `Altitude`."""

    STATE = ('_queue', '_coupling', '_health', '_loud', '_residuals', '_staves', '_signs')

    _queue: PoseQueue
    _coupling: Coupling
    _health: dict[str, float]
    _loud: deque[LoudBins]
    _residuals: deque[float]
    _staves: deque[Calibration]
    _signs: dict[str, Sign]

    def __init__(self, config: BathymetryConfig):
        self.config = config
        self.reset()

    def reset(self) -> None:
        self._queue = PoseQueue()
        self.counts: Counter[str] = self._queue.counts
        self._coupling = Coupling()
        self._health = {}
        self._loud = deque(maxlen=PINGS_JUDGED)
        self._residuals = deque(maxlen=PINGS_JUDGED)
        self._staves = deque(maxlen=PINGS_JUDGED)
        self._signs = {}

    @property
    def frames(self) -> KnownFrames:
        return self._queue.frames

    def reconfigure(self, config: BathymetryConfig) -> None:
        if config.conjugate != self.config.conjugate:
            self._signs = {}
        self.config = config

    def remount(self, config: BathymetryConfig) -> None:
        """Take another place of the sonar on the ship, for all pings from now on."""
        self.config = config

    def warm(self, inputs: Collection[type] | None = None) -> None:
        if inputs is not None and Snapshot not in inputs:
            return
        self._warm_pings()
        if self.config.layover_used != 'ignored':
            self._warm_surfaces()

    def _short_ping(self) -> Snapshot:
        return Snapshot(
            stamp_ns=1,
            range=self.config.sonar_height * (1.1 + 0.01 * np.arange(8)),
            iq=np.ones((8, 8), np.complex64),
            noise_variance=np.full(8, 0.1),
        )

    def _warm_surfaces(self) -> None:
        snapshot, everywhere = self._short_ping(), Layover(np.ones(8), 0.0, np.ones(8, bool))
        seen = look(Ping(self._used, snapshot, None))
        geometry = seen.swath.of_heights.geometry
        resolve(snapshot.iq, seen.likelihood, geometry, everywhere, np.zeros(8))

    def _warm_pings(self) -> None:
        snapshot, tracker = self._short_ping(), BathymetryTracker(self.config)
        if self.config.navigation != 'ignored':
            # With and without poses: the kernels are the same, those of the rays come in besides.
            for stamp in (1, 60_000_000_000):
                still = Navigation(
                    stamp_ns=stamp, position=np.zeros(3), orientation=[0.0, 0.0, 0.0, 1.0]
                )
                tracker._queue.add_pose(still)
            gap = evolve(self.config, max_gap=60.0)
            tracker._queue.add_ping(snapshot)
            for ping in tracker._queue.ready(gap):
                track_ping(evolve(ping, config=tracker._used))
        track_ping(Ping(tracker._used, snapshot, None))

    def health(self) -> dict[str, float]:
        """Numbers of the last ping: bins, share of bins with an echo, mean effective sample size
        of the particles of a model (NaN without particles), mean log likelihood of a bin, noise
        variance, what is left beside the echo in stated noises (`ping.residual_ratio`), what of
        loud echoes is no plane wave (`layover.array_error`), how much is the same at all staves
        (`coherence.common_mode`); and how many pings wait for navigation."""
        waiting = {'pings_waiting': len(self._queue)} if self._moving else {}
        held = {'pings_held': len(self._coupling)} if len(self._coupling) else {}
        return {**self._health, **waiting, **held}

    def warnings(self) -> list[str]:
        """What of the last pings makes most echoes useless, or more sure than they are."""
        loud = sum(ping.bins for ping in self._loud)
        stated = [*sign_warnings(list(self._signs.values())), *stave_warnings(self._staves)]
        stated += [*self._silence(), *self._common_mode(), *noise_warnings(self._residuals)]
        if self._used is not self.config and self._loud:
            stated.append(
                f'the array looks down (tilt {self.config.tilt_deg:g} deg): angle models are used'
            )
        stated += self._oversampling()
        if any(ping.unresolved for ping in self._loud):
            stated.append(
                'layover: resolved needs four staves: bins with two surfaces are only gated'
            )
        if loud < FEWEST_LOUD:
            return stated
        silent = sum(ping.silent for ping in self._loud) / loud
        differ = sum(ping.bins * ping.decorrelation for ping in self._loud if ping.bins) / loud
        configured, sentences = self.config.decorrelation, stated
        if silent > 0.5:
            sentences.append(
                f'{silent:.0%} of the bins that stand 20 dB above the quiet ones were passed '
                'over, since their staves do not agree: state noise_variance, so that power can '
                'tell echo from noise, check element_spacing_wavelengths, or set '
                'gate_false_alarm: 1'
            )
        if differ > SOME_DECORRELATION + 2.0 * configured:
            sentences.append(
                f'{differ:.0%} of the power of loud echoes differs from stave to stave, where '
                f'decorrelation says {configured:.0%}: estimates are surer than they should be, '
                'or lost'
            )
        errors = [ping.array_error for ping in self._loud if math.isfinite(ping.array_error)]
        if errors and (typical := float(np.median(errors))) > MUCH_ARRAY_ERROR:
            sentences.append(
                f'{typical:.1%} of the power of loud echoes is no plane wave, counted twice '
                'for safety: second surfaces in a bin (layover) are mostly missed; check the '
                'calibration of the staves, noise_variance, decorrelation and '
                'element_spacing_wavelengths'
            )
        return sentences

    def array(self) -> dict[str, Any]:
        """What the last pings show of each stave, stave 0 first: `stave_gain`, by which samples
        are divided, `stave_phase_deg`, which is taken off them, `stave_coherence`, `stave_live`;
        and `independent_bins` of a bin, and `phase_tilt_deg`, which the phases leave. Nothing of
        fewer than five pings."""
        found = staves_of(self._staves)
        if found is None:
            return {}
        gain = 10.0 ** (found.gain_db / 20.0)
        return {
            'stave_gain': np.round(gain, 4).tolist(),
            'stave_phase_deg': np.round(found.phase_deg, 2).tolist(),
            'stave_coherence': np.round(found.coherence, 3).tolist(),
            'stave_live': found.live.tolist(),
            'independent_bins': round(1.0 / float(np.median([p.alike for p in self._loud])), 3),
            'phase_tilt_deg': round(found.tilt_deg, 3),
        }

    def _silence(self) -> list[str]:
        """What to say when most bins where a floor can be are passed over, loud or not."""
        beyond = sum(ping.beyond for ping in self._loud)
        silent = sum(ping.beyond_silent for ping in self._loud)
        if beyond < FEWEST_LOUD or silent <= 0.5 * beyond:
            return []
        return [
            f'{silent / beyond:.0%} of the bins beyond the depth of the floor were passed over as '
            'silent: check noise_variance (of the snapshot, the parameter, or the water column, '
            'which has to be quiet), sonar_height and element_spacing_wavelengths'
        ]

    def _oversampling(self) -> list[str]:
        """What to say when neighbouring bins say the same."""
        if len(self._loud) < FEWEST_PINGS:
            return []
        alike = float(np.median([ping.alike for ping in self._loud]))
        if alike < SOME_ALIKE:
            return []
        told = f'bins are finer than the pulse: {alike:.1f} neighbours say the same, '
        if self._used.is_terrain:
            return [told + 'likelihood tempered; relief finer than the pulse is not seen']
        return [told + 'estimates are surer than they should be']

    def _common_mode(self) -> list[str]:
        """What to say when the echoes of most pings are a signal common to all staves."""
        shares = [ping.common_mode for ping in self._loud]
        if not shares or (typical := float(np.median(shares))) <= 0.5:
            return []
        return [
            f'at nearly all ranges all staves have the same phase in {typical:.0%} of the bins: '
            'that is no floor, but a signal that the staves share, such as of their electronics; '
            'estimates follow it'
        ]

    def process(self, measurement: Any) -> list[Estimate]:
        return [made for ping in self.tasks(measurement) for made in self.take(self.work(ping))]

    def finish(self) -> list[Estimate]:
        """The estimates of pings that waited for the next one, when there will be none."""
        return [self._counted(_again(held)) for held in self._coupling.finish()]

    def tasks(self, measurement: Any) -> list[Ping]:
        """The pings that a measurement makes ready to be estimated, in the order in which they
        came."""
        if isinstance(measurement, Navigation):
            self._queue.add_pose(measurement)
        elif isinstance(measurement, Altitude):
            self._queue.add_altitude(measurement)
        elif not isinstance(measurement, Snapshot):
            self.counts['unknown_type'] += 1
            return []
        elif self._other_spacing(measurement):
            self.counts['other_spacing'] += 1
            return []
        elif not self._moving:
            return [self._with_sign(Ping(self._used, measurement, None))]
        else:
            self._queue.add_ping(measurement)
        if not self._moving:
            return []
        return [self._with_sign(ping) for ping in self._queue.ready(self._used)]

    @staticmethod
    def work(task: Ping) -> Answer | Alone:
        """What a ping says by itself: its answer, or what its neighbours need of it."""
        if not task.config.ping_coupling > 0.0:
            return track_ping(task)
        seen = look(task)
        return Alone.of(seen, run(seen))

    def take(self, found: Answer | Alone) -> list[Estimate]:
        """The estimates that follow from what `work` found, pings in the order of `tasks`."""
        if isinstance(found, Alone):
            return [self._counted(_again(held)) for held in self._coupling.add(found)]
        left = self.finish() if len(self._coupling) else []
        return [*left, self._counted(found)]

    def _counted(self, answer: Answer) -> Estimate:
        """The estimate of an answer, after what it says is counted."""
        self.counts.update(answer.counts)
        self._health = answer.health
        self._loud.append(answer.loud)
        self._residuals.append(answer.residual)
        self._staves.append(answer.staves)
        return answer.estimate

    def _with_sign(self, ping: Ping) -> Ping:
        """The ping with the sign of the phase that the first pings of its side have shown."""
        config = ping.config
        if not config.conjugate_auto or not TILTS[0] <= config.tilt_deg < TILTS[1]:
            return ping
        side = ping.snapshot.side or config.side
        sign = self._signs.get(side, Sign())
        if sign.is_open:
            sign = Sign(sign.evidence + _evidence_of_sign(ping), sign.pings + 1)
            self._signs[side] = sign
        if not sign.is_turned:
            return ping
        return evolve(ping, config=evolve(config, conjugate=not config.conjugate))

    @property
    def _used(self) -> BathymetryConfig:
        """The parameters that pings are estimated with."""
        return self.config.as_used()

    @property
    def _moving(self) -> bool:
        """Whether pings wait for poses."""
        use = self.config.navigation
        return use == 'required' or (use == 'auto' and self._queue.has_poses)

    def _other_spacing(self, snapshot: Snapshot) -> bool:
        """True when the snapshot contradicts the spacing that was configured."""
        configured, stated = self.config.element_spacing_wavelengths, snapshot.spacing_wavelengths
        if not configured > 0.0 or stated is None:
            return False
        return abs(stated / configured - 1.0) > SPACING_TOLERANCE


def _evidence_of_sign(ping: Ping) -> float:
    """What a ping says of the sign of its phase, see `Sign`; nothing without echoes."""
    config = with_open_start(ping.config)
    seen = look(evolve(ping, config=config))
    measured = config.calibrate_array and not config.multipath
    measured &= seen.snapshot.staves >= FEWEST_STAVES
    known = seen.staves.bins > 0 and bool(seen.staves.fits.all())
    if measured and not known or np.count_nonzero(seen.likelihood.echo) < FEWEST_LOUD:
        return 0.0
    turned = look(evolve(ping, config=evolve(config, conjugate=not config.conjugate)))
    return sign_evidence(run(seen).log_likelihood, run(turned).log_likelihood)


def _again(ping: Favoured) -> Answer:
    """The answer of a ping, given what its neighbours favour."""
    seen, favour = ping.alone.seen, ping.favour
    return summarise(seen, ping.alone.track if favour is None else run(seen, favour))


@define(eq=False)
class PoseQueue:
    """Poses and the pings that wait for them: until the navigation says how the ship lay from the
    transmission of the ping to the reception of its last bin. A ping is skipped, and counted, when
    the navigation has a gap there, and may be late by `KEPT_NS`: poses are kept that long.
    STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('has_poses', '_stream', '_buffer', '_altitudes', '_waiting')

    has_poses: bool = field(init=False, default=False)
    _stream: Stream = field(init=False)
    _buffer: NavigationBuffer = field(init=False, factory=NavigationBuffer)
    _altitudes: list[Altitude] = field(init=False, factory=list)
    _waiting: list[Snapshot] = field(init=False, factory=list)

    def __attrs_post_init__(self) -> None:
        rules = StreamRules(KEPT_NS, _LONGEST_PAUSE_NS, _RESTART_AFTER)
        self._stream = Stream((Navigation,), rules)

    def __len__(self) -> int:
        """How many pings wait."""
        return len(self._waiting)

    @property
    def counts(self) -> Counter[str]:
        """What was not used, by reason."""
        return self._stream.counts

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def add_pose(self, sample: Navigation) -> None:
        """Take one pose in. A clock that was set back forgets all poses."""
        admitted = self._stream.admit(sample)
        if admitted.restarted:
            self.counts['navigation_gap'] += len(self._waiting)
            self._buffer, self._altitudes, self._waiting = NavigationBuffer(), [], []
        for pose in admitted.items:
            self.has_poses = True
            self.counts['poses'] += 1
            self._buffer = self._buffer.inserted(pose)
        if self._buffer.stamps:
            self._buffer = self._buffer.since(self._buffer.stamps[-1] - KEPT_NS)

    def add_altitude(self, altitude: Altitude) -> None:
        self._altitudes = [*self._altitudes[-999:], altitude]

    def add_ping(self, snapshot: Snapshot) -> None:
        if len(self._waiting) == MOST_WAITING:
            self._waiting.pop(0)
            self.counts['navigation_missing'] += 1
        self._waiting.append(snapshot)

    def ready(self, config: BathymetryConfig) -> list[Ping]:
        """The pings whose poses are known now, in the order in which they came."""
        done, waiting = [], []
        for snapshot in self._waiting:
            stamps = bin_stamps(snapshot, config)
            known = self._buffer.readiness(
                int(stamps[0]), int(stamps[-1]), nanoseconds(config.max_gap)
            )
            if known == 'wait':
                waiting.append(snapshot)
            elif known == 'gap':
                self.counts['navigation_gap'] += 1
            else:
                poses = self._buffer.poses(stamps)
                altitude = self._altitude(int(stamps[-1]))
                posed = PosedPing(poses, self._stream.frame_id, altitude)
                done.append(Ping(config, snapshot, posed))
        self._waiting = waiting
        return done

    def _altitude(self, stamp_ns: int) -> float | None:
        usable = [a for a in self._altitudes if 0 <= stamp_ns - a.stamp_ns <= ALTITUDE_AGE_NS]
        return max(usable, key=lambda altitude: altitude.stamp_ns).altitude if usable else None


@frozen(eq=False, slots=False)
class Alone:
    """A ping estimated by itself. All else follows from the ping, and is computed when it is asked
    for: a saved state has the ping alone."""

    ping: Ping

    @classmethod
    def of(cls, seen: Look, track: Track) -> Alone:
        """The same of what was computed before."""
        alone = cls(seen.ping)
        vars(alone).update(seen=seen, track=track)
        return alone

    @cached_property
    def seen(self) -> Look:
        return look(self.ping)

    @cached_property
    def track(self) -> Track:
        return run(self.seen)

    @cached_property
    def rough(self) -> tuple[FloatArray, FloatArray]:
        """Distances (n,) m from the array, increasing, and the probability (n,) of rough floor
        there; bins whose place is not known are left out."""
        seen, track = self.seen, self.track
        distance = seen.swath.distance(floor_of(seen, track))
        known = np.flatnonzero(np.isfinite(distance))
        order = known[np.argsort(distance[known], kind='stable')]
        rough = track.probability[:, seen.models.rough].sum(axis=1)
        return distance[order], np.clip(rough[order], 0.0, 1.0)

    @property
    def stamp_ns(self) -> int:
        return self.ping.snapshot.stamp_ns


class Favoured(NamedTuple):
    """A ping to be estimated again, and what its neighbours favour, see `run`; None when it
    has no neighbours, so that its estimate by itself is final."""

    alone: Alone
    favour: FloatArray | None


@define(eq=False)
class Coupling:
    """Labels of neighbouring pings lean on each other: rough patches are wider than a ping.

    Each ping is first estimated by itself, smoothed forward-backward. Then it is estimated
    again with a prior for each bin from the probability p of rough floor that its neighbours,
    the ping before and the ping after, have at the same distance across the track, as
    neighbours do in an Ising field of strength J (`ping_coupling`)::

        L = sum over neighbours of log((p + (1 - p) e^-J) / ((1 - p) + p e^-J))

    The predicted probability of rough models is multiplied by ``2 / (1 + e^-L)``, that of the
    others by ``2 / (1 + e^L)``. p is that of a neighbour by itself, so that nothing goes round
    in circles: an estimate depends on three pings and on no others.

    Heights are not coupled: soundings of neighbouring pings have to stay independent, since
    what makes a chart of them takes them to be.

    A ping's estimate is therefore ready when the next one has come: `Coupling` holds the
    newest ping of each side until then. STATE: see `trackers.Tracker`.
    """

    STATE: ClassVar = ('_before', '_held')

    _before: dict[str, Alone] = field(init=False, factory=dict)
    _held: dict[str, Alone] = field(init=False, factory=dict)

    def __len__(self) -> int:
        """How many pings are held."""
        return len(self._held)

    def add(self, alone: Alone) -> list[Favoured]:
        """Take the next ping in; gives the one before it, if one was held."""
        side = alone.seen.swath.side
        held = self._held.get(side)
        near = held is not None and 0 < alone.stamp_ns - held.stamp_ns <= NEIGHBOURS_NS
        done = []
        if held is not None:
            done.append(self._favoured(side, held, alone if near else None))
        self._before.pop(side, None)
        if held is not None and near:
            self._before[side] = held
        self._held[side] = alone
        return done

    def finish(self) -> list[Favoured]:
        """The pings still held, oldest first; nothing is held any more."""
        left = sorted(self._held.items(), key=lambda item: item[1].stamp_ns)
        done = [self._favoured(side, alone, None) for side, alone in left]
        self._before, self._held = {}, {}
        return done

    def _favoured(self, side: str, held: Alone, after: Alone | None) -> Favoured:
        around = [near for near in (self._before.get(side), after) if near is not None]
        strength = held.seen.config.ping_coupling
        return Favoured(held, favour_of(held, around, strength) if around else None)


def favour_of(alone: Alone, neighbours: list[Alone], strength: float) -> FloatArray:
    """What favours each model (T, M) in each bin of a ping, see `run`."""
    seen, track = alone.seen, alone.track
    distance = np.nan_to_num(seen.swath.distance(floor_of(seen, track)), nan=-1.0)
    field = np.zeros(len(distance))
    for near in neighbours:
        place, share = near.rough
        if len(share):
            p = np.interp(distance, place, share, left=0.5, right=0.5)
            field += _log_ratio(p, strength)
    rough = seen.models.rough
    favour = np.empty(track.probability.shape)
    favour[:, rough] = (2.0 / (1.0 + np.exp(-field)))[:, None]
    favour[:, ~rough] = (2.0 / (1.0 + np.exp(field)))[:, None]
    return favour


def _log_ratio(p: FloatArray, strength: float) -> FloatArray:
    weak = math.exp(-strength)
    return np.asarray(np.log((p + (1.0 - p) * weak) / ((1.0 - p) + p * weak)))
