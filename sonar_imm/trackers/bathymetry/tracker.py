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

"""The sea floor along the swath of a side-scan array, and which terrain model holds where.

A ping of a multi-stave side-scan sonar is a row of snapshots, one a range bin. Each says, with
noise, from which direction the floor answered, and the floor goes on from bin to bin like one of a
few terrain models (`models`). So the filter runs *along the ping*: range is its time.

    snapshot -> likelihood of each bin (`likelihood`)
             -> mix, predict, update, combine, bin after bin (`engines`)
             -> optional smoothing -> one row per bin

Nothing is carried from one ping to the next: a floor that was taken over wrongly would do more
harm than a floor that is taken over rightly does good. Late, shuffled or repeated pings therefore
need no care; the random numbers of a ping come from its own stamp. Only the labels may lean on
those of the neighbours (`coupling`).

On a ship that moves each bin has a pose of its own, and a ping waits until the navigation has
covered its last bin (`pose_queue`). The state is then the height of the floor in the world, so
that the models know of no attitude (`swath`).

Source: docs/bathymetry.md, after Saucan, Chonavel, Sintes, Le Caillec, *Interacting multiple model
particle filters for side scan bathymetry*, OCEANS 2013.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

from attrs import evolve
import numpy as np

from ...estimates import Estimate
from ...intake import KnownFrames
from ...measurements import Altitude, Navigation, Snapshot
from .config import BathymetryConfig
from .consistency import noise_warnings
from .coupling import Alone, Coupling, Favoured
from .ping import Answer, answer_of, look, LoudBins, Ping, run, track_ping
from .pose_queue import PoseQueue

__all__ = ['BathymetryConfig', 'BathymetryTracker']

SPACING_TOLERANCE = 0.05
PINGS_JUDGED, FEWEST_LOUD = 100, 200
"""Warnings are drawn from the last pings, when they have so many loud bins."""
SOME_DECORRELATION = 0.04
"""Noise, slopes and rough floor make neighbouring staves differ by so much in any case."""


class BathymetryTracker:
    """The tracker of `trackers.Tracker` for the sea floor: `process` takes `Snapshot`,
    `Navigation` and `Altitude`."""

    STATE = ('counts', '_queue', '_coupling', '_health', '_loud', '_residuals')

    def __init__(self, config: BathymetryConfig):
        self.config = config
        self.reset()

    def reset(self) -> None:
        self.counts: Counter[str] = Counter()
        self._queue = PoseQueue(self.counts)
        self._coupling = Coupling()
        self._health: dict[str, float] = {}
        self._loud: deque[LoudBins] = deque(maxlen=PINGS_JUDGED)
        self._residuals: deque[float] = deque(maxlen=PINGS_JUDGED)

    @property
    def frames(self) -> KnownFrames:
        return self._queue.frames

    def reconfigure(self, config: BathymetryConfig) -> None:
        self.config = config

    def remount(self, config: BathymetryConfig) -> None:
        """Take another place of the sonar on the ship, for all pings from now on."""
        self.config = config

    def warm(self) -> None:
        T, P = 8, 8
        snapshot = Snapshot(
            stamp_ns=1,
            range=self.config.sonar_height * (1.1 + 0.01 * np.arange(T)),
            iq=np.ones((T, P), np.complex64),
            noise_variance=np.full(T, 0.1),
        )
        tracker = BathymetryTracker(self.config)
        if self.config.navigation != 'ignored':
            # With and without poses: the kernels are the same, those of the rays come in besides.
            for stamp in (1, 60_000_000_000):
                still = Navigation(
                    stamp_ns=stamp, position=np.zeros(3), orientation=[0.0, 0.0, 0.0, 1.0]
                )
                tracker._queue.add_pose(still)
            gap = evolve(self.config, max_gap=60.0)
            tracker._queue.add_ping(snapshot)
            for posed in tracker._queue.ready(gap):
                track_ping(Ping(tracker.config, posed.snapshot, posed))
        track_ping(Ping(tracker.config, snapshot, None))

    def health(self) -> dict[str, float]:
        """Numbers of the last ping: bins, share of bins heard, mean effective sample size of the
        particles of a model (NaN for the grid), mean log likelihood of a bin, noise variance, what
        is left beside the echo in stated noises (`consistency`); and how many pings wait for
        navigation."""
        waiting = {'pings_waiting': len(self._queue)} if self._moving else {}
        held = {'pings_held': len(self._coupling)} if len(self._coupling) else {}
        return {**self._health, **waiting, **held}

    def warnings(self) -> list[str]:
        """What of the last pings makes most echoes useless, or more sure than they are."""
        loud = sum(one.count for one in self._loud)
        stated = noise_warnings(self._residuals)
        if loud < FEWEST_LOUD:
            return stated
        silent = sum(one.silent for one in self._loud) / loud
        differ = sum(one.count * one.decorrelation for one in self._loud if one.count) / loud
        told, sentences = self.config.decorrelation, stated
        if silent > 0.5:
            sentences.append(
                f'{silent:.0%} of the bins that stand 20 dB above the quiet ones were passed '
                'over, since their staves do not agree: state noise_variance, so that power can '
                'tell echo from noise, check element_spacing_wavelengths, or say shadow_gate: '
                'false'
            )
        if differ > SOME_DECORRELATION + 2.0 * told:
            sentences.append(
                f'{differ:.0%} of the power of loud echoes differs from stave to stave, where '
                f'decorrelation says {told:.0%}: estimates are surer than they should be, or lost'
            )
        return sentences

    def process(self, measurement: Any) -> list[Estimate]:
        return [made for ping in self.tasks(measurement) for made in self.take(self.work(ping))]

    def finish(self) -> list[Estimate]:
        """The estimates of pings that waited for the next one, when there will be none."""
        return [self._counted(_again(one)) for one in self._coupling.finish()]

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
            return [Ping(self.config, measurement, None)]
        else:
            self._queue.add_ping(measurement)
        if not self._moving:
            return []
        ready = self._queue.ready(self.config)
        return [Ping(self.config, posed.snapshot, posed) for posed in ready]

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
            return [self._counted(_again(one)) for one in self._coupling.add(found)]
        left = self.finish() if len(self._coupling) else []
        return [*left, self._counted(found)]

    def _counted(self, answer: Answer) -> Estimate:
        """The estimate of an answer, after what it says is counted."""
        self.counts.update(answer.counts)
        self._health = answer.health
        self._loud.append(answer.loud)
        self._residuals.append(answer.residual)
        return answer.estimate

    @property
    def _moving(self) -> bool:
        """Whether pings wait for poses."""
        use = self.config.navigation
        return use == 'required' or (use == 'auto' and self._queue.heard)

    def _other_spacing(self, snapshot: Snapshot) -> bool:
        """True when the snapshot contradicts the spacing that was configured."""
        told, said = self.config.element_spacing_wavelengths, snapshot.spacing_wavelengths
        return told > 0.0 and said is not None and abs(said / told - 1.0) > SPACING_TOLERANCE


def _again(one: Favoured) -> Answer:
    """The answer of a ping, given what its neighbours favour."""
    seen, favour = one.alone.seen, one.favour
    return answer_of(seen, one.alone.track if favour is None else run(seen, favour))
