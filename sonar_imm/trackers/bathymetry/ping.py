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

"""One ping, from the snapshot to the estimate: no ping needs another one, so these are functions.

`look` says what is heard in each bin and which models there are, `run` runs the models along the
ping, `estimate_of` makes a table of the answer. The same numbers come out wherever and whenever a
ping is computed; a recording's pings can be shared out over processes.
"""

from __future__ import annotations

from collections import Counter
import math
from typing import NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...acoustics import variances
from ...acoustics.coherence import FEWEST_STAVES_ALONE
from ...acoustics.geometry import Pose
from ...acoustics.rays import profile_of
from ...estimates import Estimate, places
from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.smoothing import smooth_modes
from ...measurements import Snapshot
from ...soundings import SIDES
from .config import BathymetryConfig
from .consistency import residual_ratio
from .engines import run_grid, run_particles
from .kernels import PingLikelihood, Track
from .likelihood import ping_likelihood, spacing_of, stated_noise
from .models import build_models, grid_cells, TerrainModels
from .pose_queue import PosedPing, sound_speed_of
from .swath import Floor, level_swath, ship_swath, Swath


@frozen(eq=False)
class Ping:
    """A ping to be estimated: its snapshot, and where the ship was; None for a sonar at rest."""

    config: BathymetryConfig
    snapshot: Snapshot
    posed: PosedPing | None


@frozen(eq=False)
class Look:
    """What a ping says before any terrain model is run along it; loud (T,): bins 20 dB above the
    noise."""

    ping: Ping
    swath: Swath
    models: TerrainModels
    likelihood: PingLikelihood
    loud: BoolArray

    @property
    def config(self) -> BathymetryConfig:
        return self.ping.config


class LoudBins(NamedTuple):
    """How many bins stand 20 dB above the noise, how many of them are passed over, and the share
    of their power that differs from stave to stave, NaN without any."""

    count: int
    silent: int
    decorrelation: float


class Answer(NamedTuple):
    """The estimate of one ping, what to count of it, numbers for diagnostics, what its loud bins
    show, and its `consistency.residual_ratio`, NaN where no noise is stated."""

    estimate: Estimate
    counts: Counter[str]
    health: dict[str, float]
    loud: LoudBins
    residual: float


def track_ping(ping: Ping) -> Answer:
    """The whole way, for a ping by itself."""
    seen = look(ping)
    return answer_of(seen, run(seen))


def look(ping: Ping) -> Look:
    """What is heard in each bin, and the models for it."""
    config = ping.config
    swath, floor_below = _swath(ping)
    likelihood, loud = ping_likelihood(ping.snapshot, config, swath, floor_below)
    first = int(np.argmax(likelihood.heard)) if likelihood.heard.any() else 0
    models = build_models(config, likelihood.ranges, likelihood.geometry, first, floor_below)
    return Look(ping, swath, models, likelihood, loud)


def run(seen: Look, favour: FloatArray | None = None) -> Track:
    """The models along a ping. favour (T, M): how much more probable than the chain predicts each
    model is in each bin, from elsewhere; None for no opinion."""
    config, models, likelihood = seen.config, seen.models, seen.likelihood
    if favour is not None:
        models = evolve(models, favour=favour)
    if config.runs_on_grid:
        cells = grid_cells(config, models)
        track = run_grid(models, likelihood, cells, smooth=config.smoothing_used == 'states')
    else:
        entropy = config.seed, seen.ping.snapshot.stamp_ns, int(seen.swath.side == 'port')
        track = run_particles(
            models,
            likelihood,
            config.particles_per_model,
            entropy,
            resample=config.as_printed,
        )
    if config.smoothing_used == 'modes':
        smoothed = smooth_modes(track.probability, models.transition, likelihood.heard)
        track = track._replace(probability=smoothed)
    # They add up to one but for rounding: none may pass it for that.
    return track._replace(probability=np.minimum(track.probability, 1.0))


def answer_of(seen: Look, track: Track) -> Answer:
    """The answer of a ping whose models were run."""
    snapshot, likelihood = seen.ping.snapshot, seen.likelihood
    heard, usable = likelihood.heard, snapshot.usable
    counts = Counter(
        used=1,
        bins=len(snapshot),
        bins_unusable=int((~usable).sum()),
        bins_silent=int((usable & ~heard).sum()),
        bins_unexplained=int(np.isneginf(track.log_likelihood).sum()),
    )
    health = {
        'bins': len(snapshot),
        'heard_share': float(heard.mean()),
        'effective_sample_size': float(track.sample_size.mean()),
        'log_likelihood_mean': float(track.log_likelihood[heard].mean())
        if heard.any()
        else math.nan,
        'noise_variance': float(np.median(likelihood.noise)),
    }
    loud = LoudBins(
        int(seen.loud.sum()),
        int((seen.loud & ~heard).sum()),
        variances.decorrelation(snapshot.iq, seen.loud & heard),
    )
    health['decorrelation'] = loud.decorrelation
    health['residual_ratio'] = _residual(seen, track)
    return Answer(estimate_of(seen, track), counts, health, loud, health['residual_ratio'])


def _residual(seen: Look, track: Track) -> float:
    """`residual_ratio` of a ping whose noise is stated. Few staves leave too little beside the
    echo, and echoes by way of the surface are no white noise."""
    config, snapshot, likelihood = seen.config, seen.ping.snapshot, seen.likelihood
    few = snapshot.staves < FEWEST_STAVES_ALONE
    if few or config.multipath or not np.isfinite(stated_noise(snapshot, config)).all():
        return math.nan
    sines = np.sin(floor_of(seen, track).angle)
    spacing = seen.swath.geometry.spacing
    return residual_ratio(snapshot.iq, sines, spacing, likelihood.noise, likelihood.heard)


def floor_of(seen: Look, track: Track) -> Floor:
    """Where the floor is, by the first state of each bin."""
    return seen.swath.floor(track.mean[:, 0], track.covariance[:, 0, 0])


def estimate_of(seen: Look, track: Track) -> Estimate:
    """A row for each bin."""
    config, covariance = seen.config, track.covariance
    snapshot, posed = seen.ping.snapshot, seen.ping.posed
    swath, models, ping = seen.swath, seen.models, seen.likelihood
    floor = floor_of(seen, track)
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
        extras['rough'] = np.minimum(track.probability[:, models.rough].sum(axis=1), 1.0)
    if posed is not None:
        vertical, horizontal = swath.uncertainties(floor, config.budget())
        extras |= {
            'vertical_uncertainty': vertical,
            'horizontal_uncertainty': horizontal,
            'intensity': intensity(snapshot),
            'beam_angle': swath.beam_angle(floor.angle),
            **places(floor.xyz),
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
        xyz=floor.xyz,
        state_names=models.state_names,
        state=track.mean,
        covariance=covariance,
        model_names=models.names,
        probabilities=track.probability,
        extras=extras,
    )


def _swath(ping: Ping) -> tuple[Swath, float]:
    """The swath of a ping, and how far below the array the floor is said to be."""
    config, snapshot, posed = ping.config, ping.snapshot, ping.posed
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


def intensity(snapshot: Snapshot) -> FloatArray:
    """Mean power of a stave in each bin (T,), dB; -inf for silent bins."""
    with np.errstate(divide='ignore', invalid='ignore'):
        return 10.0 * np.log10(variances.mean_power(snapshot.iq))


def array_height(config: BathymetryConfig, poses: Pose) -> float:
    """z of the array in the world, m, mean over the ping."""
    lever = poses.R @ np.array(config.sonar_lever)
    return float((poses.position + lever)[:, 2].mean())
