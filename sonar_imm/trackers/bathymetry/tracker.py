"""The sea floor along the swath of a side-scan array, and which terrain model holds where.

A ping of a multi-stave side-scan sonar is a row of snapshots, one a range bin. Each says, with
noise, from which direction the floor answered, and the floor goes on from bin to bin like one of a
few terrain models (`models`). So the filter runs *along the ping*: range is its time.

    snapshot -> likelihood of each bin (`likelihood`)
             -> mix, predict, update, combine, bin after bin (`engines`)
             -> optional smoothing -> one row per bin

Nothing is carried from one ping to the next: a floor that was taken over wrongly would do more
harm than a floor that is taken over rightly does good. Late, shuffled or repeated pings therefore
need no care; the random numbers of a ping come from its own stamp.

On a ship that moves each bin has a pose of its own, and a ping waits until the navigation has
covered its last bin (`pose_queue`). The state is then the height of the floor in the world, so
that the models know of no attitude (`swath`).

Source: docs/bathymetry.md, after Saucan, Chonavel, Sintes, Le Caillec, *Interacting multiple model
particle filters for side scan bathymetry*, OCEANS 2013.
"""

from __future__ import annotations

from collections import Counter
import math
from typing import Any

from attrs import evolve
import numpy as np

from ...acoustics.geometry import Pose
from ...acoustics.rays import profile_of
from ...acoustics.variances import mean_power
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.mode_smoothing import smooth_modes
from ...measurements import Altitude, Navigation, Snapshot
from ...soundings import SIDES
from .config import BathymetryConfig
from .engines import run_grid, run_particles
from .kernels import PingLikelihood, Track
from .likelihood import ping_likelihood, spacing_of
from .models import build_models, grid_cells, TerrainModels
from .pose_queue import PosedPing, PoseQueue, sound_speed_of
from .swath import level_swath, ship_swath, Swath

__all__ = ['BathymetryConfig', 'BathymetryTracker']

SPACING_TOLERANCE = 0.05


class BathymetryTracker:
    """The tracker of `trackers.Tracker` for the sea floor: `process` takes `Snapshot`,
    `Navigation` and `Altitude`."""

    def __init__(self, config: BathymetryConfig):
        self.config = config
        self.reset()

    def reset(self) -> None:
        self.counts: Counter[str] = Counter()
        self._queue = PoseQueue(self.counts)
        self._health: dict[str, float] = {}

    def reconfigure(self, config: BathymetryConfig) -> None:
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
                tracker._ping(posed.snapshot, posed)
        tracker._ping(snapshot, None)

    def health(self) -> dict[str, float]:
        """Numbers of the last ping: bins, share of bins heard, mean effective sample size of the
        particles of a model (NaN for the grid), mean log likelihood of a bin, noise variance; and
        how many pings wait for navigation."""
        waiting = {'pings_waiting': len(self._queue)} if self._moving else {}
        return {**self._health, **waiting}

    def process(self, measurement: Any) -> list[Estimate]:
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
            return [self._ping(measurement, None)]
        else:
            self._queue.add_ping(measurement)
        if not self._moving:
            return []
        return [self._ping(posed.snapshot, posed) for posed in self._queue.ready(self.config)]

    @property
    def _moving(self) -> bool:
        """Whether pings wait for poses."""
        use = self.config.navigation
        return use == 'required' or (use == 'auto' and self._queue.heard)

    def _other_spacing(self, snapshot: Snapshot) -> bool:
        """True when the snapshot contradicts the spacing that was configured."""
        told, said = self.config.element_spacing_wavelengths, snapshot.spacing_wavelengths
        return told > 0.0 and said is not None and abs(said / told - 1.0) > SPACING_TOLERANCE

    def _ping(self, snapshot: Snapshot, posed: PosedPing | None) -> Estimate:
        swath, floor_below = self._swath(snapshot, posed)
        ping = ping_likelihood(snapshot, self.config, swath, floor_below)
        first = int(np.argmax(ping.heard)) if ping.heard.any() else 0
        models = build_models(self.config, ping.ranges, ping.geometry, first, floor_below)
        track = self._track(models, ping, snapshot.stamp_ns, swath.side)
        self._count(snapshot, ping, track)
        return self._estimate(snapshot, models, ping, swath, track, posed)

    def _swath(self, snapshot: Snapshot, posed: PosedPing | None) -> tuple[Swath, float]:
        """The swath of a ping, and how far below the array the floor is said to be."""
        config = self.config
        ranges = np.array(snapshot.ranges(config.sound_speed))
        side = snapshot.side or config.side
        speed = sound_speed_of(snapshot, config)
        if posed is None:
            spacing = spacing_of(snapshot, config)
            return level_swath(config, ranges, speed, side, spacing), config.sonar_height
        at_array = None
        if config.sound_speed_profile:
            depth = config.water_level - array_height(config, posed.poses)
            at_array = float(profile_of(config.sound_speed_profile).at(depth))
        spacing = spacing_of(snapshot, config, at_array)
        swath = ship_swath(config, ranges, speed, side, spacing, posed.poses)
        if posed.altitude is None:
            return swath, config.sonar_height
        above = array_height(config, posed.poses) - float(posed.poses.position[:, 2].mean())
        return swath, max(posed.altitude + above, 0.01)

    def _track(
        self, models: TerrainModels, ping: PingLikelihood, stamp_ns: int, side: str
    ) -> Track:
        config = self.config
        if config.runs_on_grid:
            cells = grid_cells(config, models)
            track = run_grid(models, ping, cells, smooth=config.smoothing_used == 'states')
        else:
            entropy = config.seed, stamp_ns, int(side == 'port')
            track = run_particles(
                models,
                ping,
                config.particles_per_model,
                entropy,
                resample=config.variant == 'paper',
            )
        if config.smoothing_used == 'modes':
            smoothed = smooth_modes(track.probability, models.transition, ping.heard)
            track = track._replace(probability=smoothed)
        return track

    def _count(self, snapshot: Snapshot, ping: PingLikelihood, track: Track) -> None:
        self.counts['used'] += 1
        self.counts['bins'] += len(snapshot)
        self.counts['bins_unusable'] += int((~snapshot.usable).sum())
        self.counts['bins_silent'] += int((snapshot.usable & ~ping.heard).sum())
        self.counts['bins_unexplained'] += int(np.isneginf(track.log_likelihood).sum())
        self._health = {
            'bins': len(snapshot),
            'heard_share': float(ping.heard.mean()),
            'effective_sample_size': float(track.sample_size.mean()),
            'log_likelihood_mean': float(track.log_likelihood[ping.heard].mean())
            if ping.heard.any()
            else math.nan,
            'noise_variance': float(np.median(ping.noise)),
        }

    def _estimate(
        self,
        snapshot: Snapshot,
        models: TerrainModels,
        ping: PingLikelihood,
        swath: Swath,
        track: Track,
        posed: PosedPing | None,
    ) -> Estimate:
        config, covariance = self.config, track.covariance
        floor = swath.floor(track.mean[:, 0], track.covariance[:, 0, 0])
        of_heights = models.state_names[0] == 'height'
        other = ('angle', floor.angle) if of_heights else ('height', floor.height)
        label = track.probability.argmax(axis=1)
        extras = {
            'range': ping.ranges,
            other[0]: other[1],
            'valid': ping.heard.astype(np.uint8),
            'log_likelihood': track.log_likelihood,
            'label': label.astype(np.uint8),
            'label_probability': track.probability[np.arange(len(label)), label],
        }
        if config.in_bank:
            extras['rough'] = track.probability[:, models.rough].sum(axis=1)
        if posed is not None:
            vertical, horizontal = swath.uncertainties(floor, config.budget())
            extras |= {
                'vertical_uncertainty': vertical,
                'horizontal_uncertainty': horizontal,
                'intensity': intensity(snapshot),
                'beam_angle': swath.beam_angle(floor.angle),
            }
        elif of_heights and config.sonar_height_std > 0.0:
            # Heights are counted from where the sonar is believed to be: its error is theirs.
            covariance = covariance.copy()
            covariance[:, 0, 0] += config.sonar_height_std**2
        if posed is not None or snapshot.side:
            extras['side'] = np.full(len(label), SIDES.index(swath.side), np.uint8)
        return Estimate(
            stamp_ns=snapshot.stamp_ns,
            frame_id=snapshot.frame_id if posed is None else posed.frame_id,
            xyz=floor.xyz.astype(np.float32),
            state_names=models.state_names,
            state=track.mean,
            covariance=covariance,
            model_names=models.names,
            probabilities=track.probability,
            extras=extras,
        )


def intensity(snapshot: Snapshot) -> FloatArray:
    """Mean power of a stave in each bin (T,), dB; -inf for silent bins."""
    with np.errstate(divide='ignore', invalid='ignore'):
        return 10.0 * np.log10(mean_power(snapshot.iq))


def array_height(config: BathymetryConfig, poses: Pose) -> float:
    """z of the array in the world, m, mean over the ping."""
    lever = poses.R @ np.array(config.sonar_lever)
    return float((poses.position + lever)[:, 2].mean())
