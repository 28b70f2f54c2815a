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

Source: docs/bathymetry.md, after Saucan, Chonavel, Sintes, Le Caillec, *Interacting multiple model
particle filters for side scan bathymetry*, OCEANS 2013.
"""

from __future__ import annotations

from collections import Counter
import math
from typing import Any

import numpy as np

from ...acoustics.array import across_track, angle_of_depth, depth_of_angle
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.mode_smoothing import smooth_modes
from ...measurements import Snapshot
from .config import BathymetryConfig
from .engines import run_grid, run_particles
from .kernels import PingLikelihood, Track
from .likelihood import ping_likelihood
from .models import build_models, grid_cells, TerrainModels

__all__ = ['BathymetryConfig', 'BathymetryTracker']

SPACING_TOLERANCE = 0.05


class BathymetryTracker:
    """The tracker of `trackers.Tracker` for the sea floor: `process` takes `Snapshot`."""

    def __init__(self, config: BathymetryConfig):
        self.config = config
        self.reset()

    def reset(self) -> None:
        self.counts: Counter[str] = Counter()
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
        BathymetryTracker(self.config).process(snapshot)

    def health(self) -> dict[str, float]:
        """Numbers of the last ping: bins, share of bins heard, mean effective sample size of the
        particles of a model (NaN for the grid), mean log likelihood of a bin, noise variance."""
        return dict(self._health)

    def process(self, measurement: Any) -> list[Estimate]:
        if not isinstance(measurement, Snapshot):
            self.counts['unknown_type'] += 1
            return []
        if self._other_spacing(measurement):
            self.counts['other_spacing'] += 1
            return []
        ping = ping_likelihood(measurement, self.config)
        first = int(np.argmax(ping.heard)) if ping.heard.any() else 0
        models = build_models(self.config, ping.ranges, first)
        track = self._track(models, ping, measurement.stamp_ns)
        self._count(measurement, ping, track)
        return [self._estimate(measurement, models, ping, track)]

    def _other_spacing(self, snapshot: Snapshot) -> bool:
        """True when the snapshot contradicts the spacing that was configured."""
        told, said = self.config.element_spacing_wavelengths, snapshot.spacing_wavelengths
        return told > 0.0 and said is not None and abs(said / told - 1.0) > SPACING_TOLERANCE

    def _track(self, models: TerrainModels, ping: PingLikelihood, stamp_ns: int) -> Track:
        config = self.config
        if config.engine == 'grid':
            cells = grid_cells(config, models)
            track = run_grid(models, ping, cells, smooth=config.smoothing == 'states')
        else:
            entropy = config.seed, stamp_ns, int(config.side == 'port')
            track = run_particles(
                models,
                ping,
                config.particles_per_model,
                entropy,
                resample=config.variant == 'paper',
            )
        if config.smoothing == 'modes':
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
        self, snapshot: Snapshot, models: TerrainModels, ping: PingLikelihood, track: Track
    ) -> Estimate:
        height, angle = self._floor(models, ping.ranges, track.mean[:, 0])
        other = ('angle', angle) if models.state_names[0] == 'height' else ('height', height)
        depth = self.config.sonar_height - height
        outward = np.nan_to_num(across_track(depth, ping.ranges))
        left = outward if self.config.side == 'port' else -outward
        label = track.probability.argmax(axis=1)
        return Estimate(
            stamp_ns=snapshot.stamp_ns,
            frame_id=snapshot.frame_id,
            xyz=np.column_stack([np.zeros_like(left), left, -depth]).astype(np.float32),
            state_names=models.state_names,
            state=track.mean,
            covariance=track.covariance,
            model_names=models.names,
            probabilities=track.probability,
            extras={
                'range': ping.ranges,
                other[0]: other[1],
                'valid': ping.heard.astype(np.uint8),
                'log_likelihood': track.log_likelihood,
                'label': label.astype(np.uint8),
                'label_probability': track.probability[np.arange(len(label)), label],
            },
        )

    def _floor(
        self, models: TerrainModels, ranges: FloatArray, state: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Height (T,) and angle (T,) of the floor at the mean state; the angle is NaN where the
        floor is further than the range."""
        tilt = math.radians(self.config.tilt_deg)
        if models.state_names[0] == 'angle':
            return self.config.sonar_height - depth_of_angle(state, ranges, tilt), state
        return state, angle_of_depth(self.config.sonar_height - state, ranges, tilt)
