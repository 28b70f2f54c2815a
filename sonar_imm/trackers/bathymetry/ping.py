# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One ping, from the snapshot to the estimate: no ping needs another one, so these are functions.

`look` says which bins hold an echo and which models there are, `run` runs the models along the
ping, by Gaussian filters or by particles, and `summarise` makes the answer, a table and what to
count. The same numbers come out wherever and whenever a ping is computed; a recording's pings can
be shared out over processes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import chain
import math
from typing import Any, NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...acoustics import variances
from ...acoustics.calibration import Calibration
from ...acoustics.coherence import common_mode, FEWEST_STAVES_ALONE
from ...acoustics.geometry import Pose
from ...acoustics.layover import GATE, Layover, layover
from ...acoustics.rays import profile_of
from ...acoustics.sounding import GeometryDoubt
from ...estimates import Estimate, places
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.smoothing import smooth_modes
from ...measurements import Snapshot
from ...soundings import SIDES
from .bins import Particles, PingLikelihood, Track
from .config import BathymetryConfig
from .filter_kernels import filter_block, normals
from .findings import LoudBins, residual_ratio
from .likelihood import (
    Floor,
    level_swath,
    measure_staves,
    ping_likelihood,
    ship_swath,
    spacing_of,
    stated_noise,
    Swath,
)
from .models import build_models, TerrainModels
from .terrain_filter import bridged, run_terrain
from .two_surfaces import EXISTS, FEWEST_STAVES, resolve, Surfaces

SMOOTH, ROUGH, CANNOT_TELL = 0, 1, 2
"""Values of the column `told`."""
SURE = 0.9
"""Probability from which on floor is called rough, or smooth."""
DETECTABLE = 1.5
"""Roughness is seen where its standard deviation is that of so many single snapshots."""

LOUD = 4.0
"""So many times the noise is much power, in a bin of which two waves leave only noise."""
LEAST_STD = 0.02
"""Of a state by particles, in the standard deviation of one snapshot."""
JUST_GATED = 0.4
"""Probability of a second surface where one cannot be measured: no sounding, and not two."""
# Random numbers are drawn for so many at a time, which still fit into the cache.
_BLOCK = 32768


class PosedPing(NamedTuple):
    """The poses of the ship (T + 1,), ENU from FLU, when a ping was sent and when each bin was
    received, the frame of the navigation, and the newest altitude, m, None when there is none."""

    poses: Pose
    frame_id: str
    altitude: float | None


@frozen(eq=False)
class Ping:
    """A ping to be estimated: its snapshot, and where the ship was; None for a sonar at rest."""

    config: BathymetryConfig
    snapshot: Snapshot
    posed: PosedPing | None


@frozen(eq=False)
class Look:
    """What a ping says before any terrain model is run along it; staves: what they are, which
    `snapshot` is without; loud (T,): bins 20 dB above the noise; loudest (T,): direction sine from
    which each bin is; layover: None where it is ignored; floor_below: how far below the array the
    floor is said to be, m; alike: `variances.bins_alike`."""

    ping: Ping
    staves: Calibration
    snapshot: Snapshot
    swath: Swath
    models: TerrainModels
    likelihood: PingLikelihood
    loud: BoolArray
    loudest: FloatArray
    layover: Layover | None
    floor_below: float
    alike: float

    @property
    def config(self) -> BathymetryConfig:
        return self.ping.config

    @property
    def doubt(self) -> GeometryDoubt:
        """What all pings have in common, with the line that phases of staves leave."""
        doubt = self.config.doubt(self.snapshot.sound_speed)
        return evolve(doubt, sine=self.staves.sine_std)


class Answer(NamedTuple):
    """The estimate of one ping, what to count of it, numbers for diagnostics, what its loud bins
    show, its `residual_ratio`, NaN where no noise is stated, and what its staves are."""

    estimate: Estimate
    counts: Counter[str]
    health: dict[str, float]
    loud: LoudBins
    residual: float
    staves: Calibration


def track_ping(ping: Ping) -> Answer:
    """The whole way, for a ping by itself."""
    seen = look(ping)
    return summarise(seen, run(seen))


def look(ping: Ping) -> Look:
    """The likelihood of each bin, and the models for it."""
    config = ping.config
    swath, floor_below = _swath(ping)
    staves, snapshot = measure_staves(ping.snapshot, config, swath), ping.snapshot
    if not staves.is_exact:
        snapshot = evolve(snapshot, iq=staves.apply(snapshot.iq))
    likelihood, loud, loudest = ping_likelihood(snapshot, config, swath, floor_below, staves)
    first = int(np.argmax(likelihood.echo)) if likelihood.echo.any() else 0
    models = build_models(config, likelihood.ranges, likelihood.geometry, first, floor_below)
    alike = variances.bins_alike(snapshot.iq, snapshot.usable)
    seen = Look(
        ping, staves, snapshot, swath, models, likelihood, loud, loudest, None, floor_below, alike
    )
    return seen if config.layover_used == 'ignored' else evolve(seen, layover=_layover(seen))


def _even_part(seen: Look) -> tuple[np.ndarray, PingLikelihood]:
    """The samples (T, m) of the longest run of live staves, which fits of several waves need, and
    a likelihood whose noise is that of these staves on average."""
    staves, likelihood = seen.staves, seen.likelihood
    noise = likelihood.noise * (float(staves.noise[staves.run].mean()) / staves.level)
    return seen.snapshot.iq[:, staves.run], likelihood._replace(noise=noise)


def _layover(seen: Look) -> Layover:
    """Second surfaces, of bins with an echo alone: a burst of noise is no plane wave, nor two.
    With enough staves also of bins with much power, which the gate for one wave passes over."""
    iq, likelihood = _even_part(seen)
    echo, usable, loud = likelihood.echo, seen.snapshot.usable, None
    if iq.shape[1] < 2:
        return Layover(np.zeros(len(echo)), math.nan, np.zeros(len(echo), bool))
    if iq.shape[1] >= FEWEST_STAVES:
        loud = usable & ~echo & np.logical_or.accumulate(echo)
        loud &= variances.mean_power(iq) > LOUD * likelihood.noise
    has_echo = echo if loud is None else echo | loud
    iq = np.where(has_echo[:, None], iq, 0.0)
    spacing = seen.swath.geometry.spacing
    return layover(iq, likelihood.signal, likelihood.noise, echo, spacing, loud)


def run(seen: Look, favour: FloatArray | None = None) -> Track:
    """The models along a ping. favour (T, M): how much more probable than the chain predicts each
    model is in each bin, from elsewhere; None for no opinion."""
    config, models, likelihood = seen.config, seen.models, seen.likelihood
    if favour is not None:
        models = evolve(models, favour=favour)
    smooth = config.smoothing_used == 'states'
    if config.is_gaussian:
        peak = seen.swath.height_from(seen.loudest)
        told, temper = likelihood, 1.0
        if config.is_terrain:
            told, temper = bridged(likelihood), 1.0 / seen.alike
        track = run_terrain(models, told, peak, smooth=smooth, temper=temper)
        track = _with_constants(track, likelihood)
    else:
        entropy = config.seed, seen.ping.snapshot.stamp_ns, int(seen.swath.side == 'port')
        track = run_particles(models, likelihood, config.particles_per_model, entropy)
        # Where one particle has all the weight, they say nothing of how sure it is.
        least = models.least_variance
        if seen.swath.geometry.of_heights:
            angle, snr = floor_of(seen, track).angle, likelihood.signal / likelihood.noise
            one = seen.swath.snapshot_std(angle, snr, seen.staves.count)
            least = np.fmax(least, np.square(LEAST_STD * one))
        np.maximum(track.covariance[:, 0, 0], least, out=track.covariance[:, 0, 0])
    if config.smoothing_used == 'modes':
        smoothed = smooth_modes(track.probability, models.transition, likelihood.echo)
        track = track._replace(probability=smoothed)
    # They add up to one but for rounding: none may pass it for that.
    return track._replace(probability=np.minimum(track.probability, 1.0))


def run_particles(
    models: TerrainModels,
    ping: PingLikelihood,
    count: int,
    entropy: tuple[int, ...],
    *,
    resample: bool = False,
    watch: Callable[[int, Particles], None] | None = None,
) -> Track:
    """The IMM particle filter along a ping, with `count` particles per model.

    entropy: integers that name this ping; the same ones give the same bits, whatever other pings
    there were. resample: resample each model after the update, as the paper's effective sample
    size of always one demands; benchmarks/bathymetry_paper.py uses it. watch: called with each
    bin and its particles, for pictures.
    """
    seeds = np.random.SeedSequence(entropy).spawn(3)
    start, draws, noises = (np.random.Generator(np.random.SFC64(seed)) for seed in seeds)
    T, M = models.scale.shape
    n, k = models.F.shape[1], models.G.shape[2]
    w = np.full((M, count), 1.0 / count)
    particles = Particles(models.draw(count, start), w, models.initial.copy())
    chains = np.stack([models.transition, np.eye(M)][: 1 + resample])
    track, size = _empty(T, M, n), M * k * count
    block = max(1, min(_BLOCK // size, T))
    uniform = np.empty(block * size + block * size % 2)
    noise = np.empty_like(uniform)
    for first in range(0, T, block):
        bins = min(block, T - first)
        noises.random(out=uniform)
        normals(uniform, uniform.view(np.int64), noise, noise.view(np.int64))
        moves = noise[: bins * size].reshape(bins, M, k, count)
        random = draws.random((bins, 2, M))
        at_once = bins if watch is None else 1
        for b in range(0, bins, at_once):
            here = slice(b, b + at_once)
            filter_bins(
                first + b, particles, models, chains, random[here], moves[here], ping, track
            )
            if watch is not None:
                watch(first + b, particles)
    return _with_constants(track, ping)


def filter_bins(
    first: int,
    particles: Particles,
    models: TerrainModels,
    chains: FloatArray,
    uniform: FloatArray,
    noise: FloatArray,
    ping: PingLikelihood,
    track: Track,
) -> None:
    """Run `filter_block` with arrays of its own for scratch."""
    g, (M, N) = ping.geometry, particles.w.shape
    work = np.empty((5, N))
    spread = ping.spread if ping.spread.shape[1] else None
    launch = g.launch if len(g.launch) else None
    drifting = None if g.of_heights else g.tilt, g.drift_from
    groups: tuple[tuple[Any, ...], ...] = (
        particles,
        (models.F, models.G, models.scale, chains, models.coast, models.favour, uniform, noise),
        (ping.echo, ping.form, ping.base, spread, ping.signal, ping.table),
        (g.height, g.reach, g.cos_tilt, g.sin_tilt, g.spacing),
        (launch, g.row, g.first_depth, g.depth_step, *drifting),
        (np.empty(M), np.empty((M, N)), np.empty((M, N)), np.empty_like(particles.x)),
        (np.empty(N + 1, np.int64), work, work.view(np.int64)),
        track,
    )
    filter_block(first, *chain.from_iterable(groups))


def _empty(T: int, M: int, n: int) -> Track:
    return Track(np.empty((T, n)), np.empty((T, n, n)), np.empty((T, M)), np.empty(T), np.empty(T))


def _with_constants(track: Track, ping: PingLikelihood) -> Track:
    """The same with log likelihoods of the samples, not only of what depends on the state; zero
    in bins without an echo."""
    whole = np.where(ping.echo, track.log_likelihood + ping.constant, 0.0)
    return track._replace(log_likelihood=whole)


def summarise(seen: Look, track: Track) -> Answer:
    """The answer of a ping whose models were run."""
    config, snapshot, likelihood = seen.config, seen.snapshot, seen.likelihood
    echo, usable, staves = likelihood.echo, snapshot.usable, seen.staves
    even, _ = _even_part(seen)
    counts = Counter(
        used=1,
        bins=len(snapshot),
        bins_unusable=int((~usable).sum()),
        bins_silent=int((usable & ~echo).sum()),
        bins_unexplained=int(np.isneginf(track.log_likelihood).sum()),
    )
    health = {
        'bins': len(snapshot),
        'heard_share': float(echo.mean()),
        'effective_sample_size': float(track.sample_size.mean()),
        'log_likelihood_mean': float(track.log_likelihood[echo].mean())
        if echo.any()
        else math.nan,
        'noise_variance': float(np.median(likelihood.noise)) / staves.level,
    }
    beyond = usable & (likelihood.ranges >= seen.floor_below)
    loud = LoudBins(
        int(seen.loud.sum()),
        int((seen.loud & ~echo).sum()),
        variances.decorrelation(even, seen.loud & echo),
        math.nan if seen.layover is None else seen.layover.array_error,
        int(beyond.sum()),
        int((beyond & ~echo).sum()),
        common_mode(even, echo),
        config.layover_used == 'resolved' and even.shape[1] < FEWEST_STAVES,
        seen.alike,
    )
    made = estimate_of(seen, track)
    if seen.layover is not None:
        counts['bins_two'] = int((made.extras['surfaces'] == 2).sum())
        health['array_error'] = loud.array_error
    health['decorrelation'] = loud.decorrelation
    health['common_mode'] = loud.common_mode
    health['independent_bins'] = 1.0 / seen.alike
    health['staves_live'] = staves.count
    health['phase_tilt_deg'] = math.degrees(staves.sine_std)
    health['residual_ratio'] = _residual(seen, track)
    return Answer(made, counts, health, loud, health['residual_ratio'], staves)


def _residual(seen: Look, track: Track) -> float:
    """`residual_ratio` of a ping whose noise is stated. Few staves leave too little beside the
    echo, and echoes by way of the surface are no white noise."""
    config, snapshot, staves = seen.config, seen.snapshot, seen.staves
    few = staves.count < FEWEST_STAVES_ALONE
    if few or config.multipath or not np.isfinite(stated_noise(snapshot, config)).all():
        return math.nan
    sines = np.sin(floor_of(seen, track).angle)
    spacing = seen.swath.geometry.spacing
    noise = seen.likelihood.noise * (staves.mean_noise / staves.level)
    iq, count = snapshot.iq, staves.count
    return residual_ratio(iq, sines, spacing, noise, seen.likelihood.echo, count)


def floor_of(seen: Look, track: Track) -> Floor:
    """Where the floor is, by the first state of each bin."""
    return seen.swath.floor(track.mean[:, 0], track.covariance[:, 0, 0])


def _surfaces(seen: Look, track: Track) -> Surfaces | None:
    """Both surfaces where a bin may hold two; None where there are too few staves."""
    if seen.layover is None or seen.snapshot.staves < FEWEST_STAVES:
        return None
    iq, likelihood = _even_part(seen)
    if iq.shape[1] < FEWEST_STAVES:  # of an array that has lost some: columns stay
        nothing = np.full((len(iq), 2), np.nan)
        return Surfaces(np.minimum(seen.layover.existence, JUST_GATED), nothing, nothing)
    geometry = seen.swath.of_heights.geometry
    return resolve(iq, likelihood, geometry, seen.layover, floor_of(seen, track).height)


def _with_lower(seen: Look, track: Track, surfaces: Surfaces, two: BoolArray) -> Track:
    """The track with the lower surface in bins `two` (T,)."""
    mean, covariance = track.mean.copy(), track.covariance.copy()
    height, variance = surfaces.height[two, 0], surfaces.variance[two, 0]
    if not seen.swath.geometry.of_heights:
        reach, tilt = seen.swath.geometry.reach[two], seen.swath.geometry.tilt[two]
        filled = np.where(two, surfaces.height[:, 0], 0.0)
        height = seen.swath.of_heights.floor(filled, filled).angle[two]
        variance = variance / np.square(np.maximum(np.cos(height + tilt), 1e-3) * reach)
    mean[two, 0] = height
    covariance[two, 0, :] = covariance[two, :, 0] = 0.0
    covariance[two, 0, 0] = variance
    return track._replace(mean=mean, covariance=covariance)


def estimate_of(seen: Look, track: Track) -> Estimate:
    """A row for each bin."""
    config, snapshot, posed = seen.config, seen.snapshot, seen.ping.posed
    swath, models, ping = seen.swath, seen.models, seen.likelihood
    label = track.probability.argmax(axis=1)
    doubt = ~ping.echo
    second: dict[str, np.ndarray] = {}
    if seen.layover is not None:
        surfaces = _surfaces(seen, track)
        found = seen.layover.existence if surfaces is None else surfaces.existence
        has_echo = ping.echo
        if surfaces is not None:
            has_echo = has_echo | seen.layover.usable & (found >= EXISTS)
        existence = np.where(has_echo, found, 0.0)
        both = surfaces if config.layover_used == 'resolved' else None
        two = existence > GATE if both is None else existence >= EXISTS
        doubt = ~has_echo | (existence > GATE) & ((both is None) | ~two)
        second = {
            'existence_2': existence.astype(np.float32),
            'surfaces': np.where(has_echo, 1 + two, 0).astype(np.uint8),
        }
        if both is not None:
            second |= _upper(seen, both, two)
            track = _with_lower(seen, track, both, two)
    floor, covariance = floor_of(seen, track), track.covariance
    of_heights = models.state_names[0] == 'height'
    other = ('angle', floor.angle) if of_heights else ('height', floor.height)
    extras = {
        'range': ping.ranges,
        other[0]: other[1],
        'valid': (~doubt).astype(np.uint8),
        'log_likelihood': track.log_likelihood,
        'label': label.astype(np.uint8),
        'label_probability': track.probability[np.arange(len(label)), label],
        **_label_columns(seen, track, floor),
    }
    if config.is_terrain:
        extras['rough'] = np.minimum(track.probability[:, models.rough].sum(axis=1), 1.0)
    extras |= second
    doubtful = seen.doubt
    common, aside = swath.doubt(floor, doubtful)
    extras['geometry_std'] = np.sqrt(common).astype(np.float32)
    covariance = covariance.copy()
    if of_heights:
        covariance[:, 0, 0] += common
    else:  # the tilt is no part of an angle from broadside
        tangent = np.square(np.tan(np.nan_to_num(floor.angle)))
        covariance[:, 0, 0] += (doubtful.spacing**2 + doubtful.sound_speed**2) * tangent
        covariance[:, 0, 0] += doubtful.sine**2 * (1.0 + tangent)
    if posed is not None:
        vertical, horizontal = swath.uncertainties(floor, config.budget())
        vertical, horizontal = vertical + common, horizontal + aside
        extras |= {
            'vertical_uncertainty': vertical,
            'horizontal_uncertainty': horizontal,
            'intensity': intensity(seen.staves.heard(snapshot.iq)),
            'beam_angle': swath.beam_angle(floor.angle),
            **places(floor.xyz),
        }
    elif of_heights and config.sonar_height_std > 0.0:
        # Heights are counted from where the sonar is believed to be: its error is theirs.
        covariance[:, 0, 0] += config.sonar_height_std**2
    if posed is not None or snapshot.side:
        extras['side'] = np.full(len(label), SIDES.index(swath.side), np.uint8)
    if 'surfaces' in extras:
        extras['told'][extras['surfaces'] == 2] = CANNOT_TELL
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


def _label_columns(seen: Look, track: Track, floor: Floor) -> dict[str, np.ndarray]:
    """Columns (T,): how sure smooth or rough is, which of them or neither, and the standard
    deviation that roughness needs to be seen."""
    swath, ping = seen.swath, seen.likelihood
    rough, either = (
        np.minimum(track.probability[:, which].sum(axis=1), 1.0)
        for which in (seen.models.rough, seen.models.rough | seen.models.either)
    )
    snr = ping.signal / ping.noise
    detectable = DETECTABLE * swath.snapshot_std(floor.angle, snr, seen.staves.count)
    kind = verdict(rough, either, detectable, seen.config.rough_std)
    kind[~ping.echo] = CANNOT_TELL
    return {
        'label_confidence': np.maximum(rough, 1.0 - rough).astype(np.float32),
        'told': kind,
        'detectable_std': detectable.astype(np.float32),
    }


def verdict(
    rough: FloatArray, either: FloatArray, detectable: FloatArray, rough_std: float
) -> np.ndarray:
    """Smooth, rough or cannot tell (n,), from the probabilities (n,) of rough floor and of floor
    that is rough or may be, and the standard deviation (n,) that roughness needs to be seen, m,
    NaN where unknown. Floor is smooth only where roughness of `rough_std` would be seen: smooth
    means less than that."""
    smooth = (either < 1.0 - SURE) & (detectable <= rough_std)
    kind = np.where(rough > SURE, ROUGH, np.where(smooth, SMOOTH, CANNOT_TELL))
    return kind.astype(np.uint8)


def _upper(seen: Look, surfaces: Surfaces, two: BoolArray) -> dict[str, np.ndarray]:
    """Columns (T,) of the upper surface, NaN in bins that are not `two` (T,)."""
    config, swath = seen.config, seen.swath
    height, variance = (np.where(two, part[:, 1], 0.0) for part in surfaces[1:])
    unposed = seen.ping.posed is None
    floor = swath.of_heights.floor(height, variance)
    common, aside = swath.doubt(floor, seen.doubt)
    std = np.sqrt(variance + common + (config.sonar_height_std**2 if unposed else 0.0))
    columns: dict[str, np.ndarray] = {
        'height_2': height.astype(np.float32),
        'height_2_std': std.astype(np.float32),
    }
    if not unposed:
        vertical, horizontal = swath.uncertainties(floor, config.budget())
        columns |= {
            'geometry_std_2': np.sqrt(common).astype(np.float32),
            'vertical_uncertainty_2': vertical + common,
            'horizontal_uncertainty_2': horizontal + aside,
            'beam_angle_2': swath.beam_angle(floor.angle),
            **{f'{name}_2': part for name, part in places(floor.xyz).items()},
        }
    return {name: np.where(two, part, part.dtype.type(np.nan)) for name, part in columns.items()}


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


def intensity(iq: np.ndarray) -> FloatArray:
    """Mean power of the staves of iq (T, P) in each bin (T,), dB; -inf for silent bins."""
    with np.errstate(divide='ignore', invalid='ignore'):
        return 10.0 * np.log10(variances.mean_power(iq))


def array_height(config: BathymetryConfig, poses: Pose) -> float:
    """z of the array in the world, m, mean over the ping."""
    lever = poses.R @ np.array(config.sonar_lever)
    return float((poses.position + lever)[:, 2].mean())


def sound_speed_of(snapshot: Snapshot, config: BathymetryConfig) -> float:
    """The sound speed, m/s, that made the ranges of a snapshot."""
    return snapshot.sound_speed or config.sound_speed


def bin_stamps(snapshot: Snapshot, config: BathymetryConfig) -> IntArray:
    """Stamps (T + 1,) ns: of the transmission, and of the reception of each bin."""
    ranges: FloatArray = snapshot.ranges(config.sound_speed)
    late = np.rint(2e9 * ranges / sound_speed_of(snapshot, config)).astype(np.int64)
    return snapshot.stamp_ns + np.concatenate([[0], late])
