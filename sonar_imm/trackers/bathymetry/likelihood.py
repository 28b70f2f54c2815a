# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a ping holds before any terrain model: how the array looked, and each bin's likelihood.

A level sonar is `level_swath`: the array at `sonar_height` above its reference floor, its tilt the
same in every bin. A ship that moves is `ship_swath`: heights are those of the world, and tilt and
depth scale change from bin to bin with the attitude (`acoustics.sounding`); with a sound-speed
profile directions come from a table of rays (`acoustics.rays`), one per ping.

The filters know nothing of arrays. `ping_likelihood` gives them, for each bin, whether it holds an
echo (`acoustics.coherence`) and the coefficients of its likelihood over directions
(`acoustics.laplace`, or `acoustics.interference` when multipath is expected).
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...acoustics import (
    coherence,
    interference,
    laplace,
    loudness,
    rays,
    sounding,
    variances,
)
from ...acoustics import geometry as frames
from ...acoustics.array import across_track, angle_of_depth, depth_of_angle, multipath_sines
from ...acoustics.calibration import calibrate, Calibration
from ...acoustics.geometry import Pose
from ...acoustics.sounding import ErrorBudget, GeometryDoubt, Looks
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...measurements import Snapshot
from .bins import Geometry, PingLikelihood
from .config import BathymetryConfig

_TABLE_DEPTH = 0.02
"""Metres to which the depth of the array is rounded for a table of rays, so that pings share
tables. The ray of an array 1 cm higher ends less than a centimetre elsewhere."""
_NO_TABLE = np.zeros((0, 0))
WATER_COLUMN = 0.8
"""Bins nearer than this share of the sonar's height, or of the first return, hold no echo of the
floor."""
FEWEST_QUIET_BINS = 16
LEAST_NOISE = 1e-12
"""Noise is taken to be at least this share of surface echoes, whose covariance has no inverse
without."""


class Floor(NamedTuple):
    """What is known of the floor at each of T bins, from the state and its variance.

    height and its variance (T,); angle (T,), NaN where no echo can come from; xyz (T, 3) in the
    axes of the estimate.
    """

    height: FloatArray
    variance: FloatArray
    angle: FloatArray
    xyz: FloatArray


@frozen(eq=False)
class Swath:
    """The bins of one ping: ranges (T,) m, sound_speed that made them, side, and `geometry`.

    looks: None for a level sonar; profile: None where rays are straight.
    """

    ranges: FloatArray
    sound_speed: float
    side: str
    geometry: Geometry
    looks: Looks | None = None
    profile: rays.Profile | None = None
    water_level: float = 0.0

    @property
    def of_heights(self) -> Swath:
        """The same for states that are heights."""
        return evolve(self, geometry=self.geometry._replace(of_heights=True))

    def floor(self, state: FloatArray, variance: FloatArray) -> Floor:
        """The floor at states (T,): heights or angles, as the geometry says."""
        if self.looks is None:
            return self._level_floor(state, variance)
        g, looks = self.geometry, self.looks
        if g.of_heights:
            rise = self._launch(looks.position[:, 2] - state)
            s = rise / g.reach
            possible = np.abs(s) <= 1.0
            s = np.where(possible, s, 0.0)
            sine = s * g.cos_tilt - np.sqrt(1.0 - s * s) * g.sin_tilt
            angle = np.where(possible, np.arcsin(np.clip(sine, -1.0, 1.0)), np.nan)
        else:
            angle, sine = state, np.sin(state)
            possible = np.abs(state) <= 0.5 * math.pi
        n = sounding.direction(looks, np.clip(sine, -1.0, 1.0))
        depth, distance = self._reached(n)
        aside = np.linalg.norm(n[:, :2], axis=1)
        outward = n[:, :2] / np.maximum(aside, 1e-12)[:, None]
        height = state if g.of_heights else looks.position[:, 2] - depth
        if not g.of_heights:
            lever = g.reach * np.cos(state + g.tilt)
            variance = variance * np.square(lever)
        place = looks.position[:, :2] + np.where(possible, distance, 0.0)[:, None] * outward
        return Floor(height, variance, angle, np.column_stack([place, height]))

    def surface_sines(self, floor_below: float, sonar_depth: float) -> FloatArray:
        """Direction sines (T, 2) of the echoes by way of a calm surface, see
        `array.multipath_sines`; sonar_depth counts for a level sonar, whose z nobody knows."""
        g = self.geometry
        if self.looks is None:
            depth = np.full(len(self.ranges), floor_below)
            return multipath_sines(depth, self.ranges, float(g.tilt[0]), sonar_depth)
        surface = self.water_level - self.looks.position[:, 2]
        s = np.column_stack([-surface, -2.0 * surface - floor_below]) / g.reach[:, None]
        possible = np.abs(s) <= 1.0
        s = np.where(possible, s, 0.0)
        sine = s * g.cos_tilt[:, None] - np.sqrt(1.0 - s * s) * g.sin_tilt[:, None]
        return np.where(possible, sine, np.nan)

    def height_from(self, sine: FloatArray) -> FloatArray:
        """The height (T,) of a floor that is seen in the directions `sine` (T,)."""
        angles = evolve(self, geometry=self.geometry._replace(of_heights=False))
        return angles.floor(np.arcsin(np.clip(sine, -1.0, 1.0)), np.zeros(len(sine))).height

    def snapshot_std(self, angle: FloatArray, snr: FloatArray, staves: int) -> FloatArray:
        """Standard deviation (T,) of the height from one snapshot by itself, m: the bound of a
        plane wave from angle (T,), at signal-to-noise ratio snr (T,) of a stave."""
        g = self.geometry
        turns = 2.0 * math.pi * abs(g.spacing)
        sine = 1.0 / (turns * np.sqrt(snr * staves * (staves**2 - 1) / 6.0))
        cosine = np.maximum(np.cos(angle), 1e-3)
        return np.abs(g.reach * np.cos(angle + g.tilt)) * sine / cosine

    def beam_angle(self, angle: FloatArray) -> FloatArray:
        """From straight down, port positive (T,), of angles (T,) of echoes; NaN stays."""
        assert self.looks is not None
        return sounding.beam_angle(sounding.direction(self.looks, np.sin(angle)), self.side)

    def distance(self, floor: Floor) -> FloatArray:
        """Horizontal distance (T,) of the floor from the array, m; NaN where it is not known."""
        return np.where(np.isfinite(floor.angle), self._from_array(floor)[1], np.nan)

    def uncertainties(self, floor: Floor, budget: ErrorBudget) -> tuple[FloatArray, FloatArray]:
        """Vertical and horizontal variance (T,) of the soundings, m^2."""
        depth, distance = self._from_array(floor)
        return sounding.uncertainties(floor.variance, depth, distance, budget, self.sound_speed)

    def doubt(self, floor: Floor, doubt: GeometryDoubt) -> tuple[FloatArray, FloatArray]:
        """Vertical and horizontal variance (T,) m^2 of the floor that all pings have in common."""
        return sounding.geometry_variance(
            *self._from_array(floor), np.nan_to_num(floor.angle), doubt
        )

    def _from_array(self, floor: Floor) -> tuple[FloatArray, FloatArray]:
        """Depth of the floor below the array and its horizontal distance from it (T,), m."""
        offset = floor.xyz if self.looks is None else floor.xyz - self.looks.position
        return -offset[:, 2], np.linalg.norm(offset[:, :2], axis=1)

    def _launch(self, depth: FloatArray) -> FloatArray:
        """r sin(phi) (T,) of floors `depth` (T,) below the array."""
        g = self.geometry
        if not len(g.launch):
            return depth
        return rays.look_up(g.launch, g.row, g.first_depth, g.depth_step, depth)

    def _reached(self, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far below the array and outward echoes from directions n (T, 3) were made."""
        assert self.looks is not None
        if self.profile is None:
            return -n[:, 2] * self.ranges, np.linalg.norm(n[:, :2], axis=1) * self.ranges
        start = self.water_level - self.looks.position[:, 2]
        elevation = np.arcsin(np.clip(-n[:, 2], -1.0, 1.0))
        there = rays.trace(self.profile, start, elevation, self.ranges / self.sound_speed)
        return there.depth - start, there.distance

    def _level_floor(self, state: FloatArray, variance: FloatArray) -> Floor:
        height, tilt = float(self.geometry.height[0]), float(self.geometry.tilt[0])
        if self.geometry.of_heights:
            floor, angle = state, angle_of_depth(height - state, self.ranges, tilt)
        else:
            floor, angle = height - depth_of_angle(state, self.ranges, tilt), state
        depth = height - floor
        outward = np.nan_to_num(across_track(depth, self.ranges))
        left = outward if self.side == 'port' else -outward
        return Floor(floor, variance, angle, np.column_stack([np.zeros_like(left), left, -depth]))


def level_swath(
    config: BathymetryConfig, ranges: FloatArray, sound_speed: float, side: str, spacing: float
) -> Swath:
    """The swath of a sonar at rest, `sonar_height` above its reference floor."""
    geometry = level_geometry(
        ranges,
        config.sonar_height,
        math.radians(config.tilt_deg),
        spacing,
        of_heights=config.model_set != 'angle_two_rw',
    )
    return Swath(ranges, sound_speed, side, geometry)


def level_geometry(
    ranges: FloatArray, height: float, tilt: float, spacing: float, *, of_heights: bool = True
) -> Geometry:
    """The geometry of an array that does not move, `height` metres above its reference floor."""
    T = len(ranges)
    return Geometry(
        of_heights=of_heights,
        height=np.full(T, height),
        reach=ranges.copy(),
        tilt=np.full(T, tilt),
        cos_tilt=np.full(T, math.cos(tilt)),
        sin_tilt=np.full(T, math.sin(tilt)),
        spacing=spacing,
        launch=_NO_TABLE,
        row=np.zeros(T),
        first_depth=0.0,
        depth_step=1.0,
        drift_from=T,
    )


def ship_swath(
    config: BathymetryConfig,
    ranges: FloatArray,
    sound_speed: float,
    side: str,
    spacing: float,
    poses: Pose,
) -> Swath:
    """The swath of a moving ship. poses (T + 1,): of the ship, ENU from FLU, when the ping was
    sent and when each of the T bins was received."""
    T = len(ranges)
    mount = frames.rotation(*np.radians(config.sonar_mount_rpy_deg))
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), mount)
    sent, received = (Pose(poses.position[k], poses.R[k]) for k in (0, slice(1, None)))
    looks = sounding.looks(axes, np.array(config.sonar_lever), sent, received)
    profile, table = None, None
    if config.sound_speed_profile:
        profile = rays.profile_of(config.sound_speed_profile)
        depth = config.water_level - float(np.mean(looks.position[:, 2]))
        steps = round(depth / _TABLE_DEPTH)
        table = _table(config.sound_speed_profile, steps, float(ranges[-1]), sound_speed)
    geometry = Geometry(
        of_heights=config.model_set != 'angle_two_rw',
        height=np.ascontiguousarray(looks.position[:, 2]),
        reach=ranges * looks.C,
        tilt=looks.psi,
        cos_tilt=np.cos(looks.psi),
        sin_tilt=np.sin(looks.psi),
        spacing=spacing,
        launch=_NO_TABLE if table is None else table.value,
        row=np.zeros(T) if table is None else ranges / table.range_step,
        first_depth=0.0 if table is None else table.first_depth,
        depth_step=1.0 if table is None else table.depth_step,
        drift_from=T,
    )
    return Swath(ranges, sound_speed, side, geometry, looks, profile, config.water_level)


@lru_cache(maxsize=256)
def _table(
    pairs: tuple[float, ...], steps: int, last_range: float, sound_speed: float
) -> rays.LaunchTable:
    profile = rays.profile_of(pairs)
    return rays.launch_table(profile, steps * _TABLE_DEPTH, last_range, sound_speed)


def spacing_of(
    snapshot: Snapshot, config: BathymetryConfig, at_array: float | None = None
) -> float:
    """Distance between staves in wavelengths, negative for a conjugated array: what the config
    says, else the snapshot, else 0.5. `at_array`: the sound speed there in m/s, where a profile
    says it, which makes the wavelength whatever speed the ranges were made with."""
    stated = snapshot.spacing_wavelengths
    if stated is not None and at_array is not None:
        stated *= (snapshot.sound_speed or at_array) / at_array
    spacing = config.element_spacing_wavelengths or stated or 0.5
    return -spacing if config.conjugate else spacing


class BinLikelihood(NamedTuple):
    """The likelihood of a ping; which bins (T,) stand 20 dB above the noise, or, where that is not
    known, above the quietest tenth of the bins; and, for the Gaussian engine, the direction sine
    (T,) from which each is loudest, NaN for silent ones."""

    likelihood: PingLikelihood
    loud: BoolArray
    loudest: FloatArray


def ping_likelihood(
    snapshot: Snapshot,
    config: BathymetryConfig,
    swath: Swath,
    floor_below: float,
    staves: Calibration,
) -> BinLikelihood:
    """The likelihood of every bin of a snapshot under `config`. floor_below: how far below the
    array the floor is said to be, m; staves: what was done to those of the snapshot."""
    ranges, spacing = swath.ranges, swath.geometry.spacing
    iq = np.where(snapshot.usable[:, None], snapshot.iq, 0.0)
    first = 0
    if config.sonar_height_std > 0.0:
        first = _first_return(snapshot, iq, abs(spacing), config, staves)
        floor_below = float(ranges[first])
    noise, known = _noise(snapshot, ranges, config, floor_below, staves)
    make = _beside_surface if config.multipath else _in_white_noise
    parts = make(snapshot, iq, swath, floor_below, noise, config, staves)
    P = staves.count
    laplacian = config.likelihood == 'laplace'
    constant = laplace.log_constant if laplacian else laplace.gaussian_log_constant
    echo = _echoes(snapshot.usable, parts, known, P, abs(spacing), config)
    echo[:first] = False
    likelihood = PingLikelihood(
        ranges=ranges,
        echo=echo,
        form=np.ascontiguousarray(parts.form),
        base=np.ascontiguousarray(parts.base),
        spread=np.ascontiguousarray(parts.spread),
        signal=np.ascontiguousarray(parts.signal),
        noise=np.ascontiguousarray(parts.noise),
        constant=np.ascontiguousarray(constant(P, parts.log_determinant)),
        table=laplace.likelihood_table(P, config.likelihood),
        geometry=_drifting(swath.geometry, echo, config),
    )
    quiet = 1.0 if known.all() else float(np.quantile(parts.loudness, 0.1))
    loudest = math.copysign(1.0, spacing) * parts.sine
    return BinLikelihood(likelihood, parts.loudness > loudness.VERY_LOUD * quiet, loudest)


def _first_return(
    snapshot: Snapshot,
    iq: ComplexArray,
    spacing: float,
    config: BathymetryConfig,
    staves: Calibration,
) -> int:
    """The first bin with an echo of the floor. Few staves need a stated noise to tell it from one
    bin."""
    P, false_alarm = staves.count, config.false_alarm
    noise = stated_noise(snapshot, config) * staves.level
    if P < coherence.FEWEST_STAVES_ALONE and np.isfinite(noise).all():
        ratio = staves.power(iq) / noise
        return coherence.first_of(_loud(ratio, P, false_alarm, snapshot.usable))
    gamma = coherence.coherence(iq, spacing, weights=staves.weights)[0]
    return coherence.first_return(gamma, P, spacing=spacing, false_alarm=false_alarm)


def _drifting(geometry: Geometry, echo: BoolArray, config: BathymetryConfig) -> Geometry:
    """With `angle_drift` angles go on at constant height after the first bin with an echo, for
    which the start is stated."""
    if geometry.of_heights or not config.angle_drift or not echo.any():
        return geometry
    return geometry._replace(drift_from=int(np.argmax(echo)) + 1)


class _Parts(NamedTuple):
    """What the likelihood is made of, see `PingLikelihood`; noise (T,) with what of the echo is
    not the same at all staves; sine (T,) from which a bin is loudest, by a phase that rises from
    stave to stave, NaN for models that do not use it; loudness (T,): power of a bin in powers of
    all that is no floor."""

    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    log_determinant: FloatArray
    coherence: FloatArray
    sine: FloatArray
    loudness: FloatArray


def _in_white_noise(
    snapshot: Snapshot,
    iq: ComplexArray,
    swath: Swath,
    floor_below: float,
    noise: FloatArray,
    config: BathymetryConfig,
    staves: Calibration,
) -> _Parts:
    T, P = len(iq), staves.count
    spacing, weights = swath.geometry.spacing, staves.weights
    power = staves.power(iq)
    above_noise = power / noise
    signal, noise = _split(_signal(snapshot, power, noise, np.ones(T)), noise, config)
    gamma, sine = np.ones(T), np.full(T, np.nan)
    if config.is_gated or config.is_gaussian:
        gamma, sine = coherence.coherence(iq, abs(spacing), weights=weights)
    return _Parts(
        form=laplace.form_coefficients(iq, signal, noise, weights),
        base=np.zeros(T),
        spread=np.empty((T, 0), np.complex128),
        signal=signal,
        noise=noise,
        log_determinant=P * np.log(noise) + np.log1p(P * signal / noise) + staves.log_volume,
        coherence=gamma,
        sine=sine,
        loudness=above_noise,
    )


def _beside_surface(
    snapshot: Snapshot,
    iq: ComplexArray,
    swath: Swath,
    floor_below: float,
    noise: FloatArray,
    config: BathymetryConfig,
    staves: Calibration,
) -> _Parts:
    """With echoes by way of the surface as noise from where a flat floor would send them."""
    T, P = iq.shape
    spacing = swath.geometry.spacing
    sines = swath.surface_sines(floor_below, config.sonar_depth)
    # They are as strong as the echoes of the floor, of which they are mirror images.
    echoes = 1.0 + np.isfinite(sines).sum(axis=1)
    signal = _signal(snapshot, staves.power(iq), noise, echoes)
    signal, noise = _split(signal, noise, config)
    noise = np.maximum(noise, LEAST_NOISE * signal)
    step = 2.0 * math.pi * spacing
    R = interference.noise_covariance(sines, signal[:, None], noise, P, step)
    form = interference.interference_form(iq, R)
    sine = coherence.coherence(iq, abs(spacing))[1] if config.is_gaussian else np.full(T, np.nan)
    return _Parts(
        form=-signal[:, None] * form.beam,
        base=form.base,
        spread=form.spread,
        signal=signal,
        noise=noise,
        log_determinant=form.log_determinant,
        coherence=interference.coherence_beside(form, abs(spacing)),
        sine=sine,
        loudness=form.base / P,
    )


def _echoes(
    usable: BoolArray,
    parts: _Parts,
    known: BoolArray,
    staves: int,
    spacing: float,
    config: BathymetryConfig,
) -> BoolArray:
    """Bins (T,) with an echo. Many staves tell it by coherence, and by power where a whole stretch
    cannot be noise; few staves by power alone, where the noise is `known` (T,), since noise is
    coherent at two of them too often."""
    if not config.is_gated:
        return np.array(usable)
    false_alarm = config.false_alarm
    silent = coherence.silent_bins(
        parts.coherence, staves, spacing=spacing, false_alarm=false_alarm
    )
    if staves < coherence.FEWEST_STAVES_ALONE:
        return np.where(
            known, _loud(parts.loudness, staves, false_alarm, usable), usable & ~silent
        )
    return usable & ~(silent & ~loudness.diffuse_bins(parts.loudness, silent, usable & known))


def _loud(ratio: FloatArray, staves: int, false_alarm: float, usable: BoolArray) -> BoolArray:
    bins = coherence.GATE_BINS
    level = loudness.loud_level(staves, bins, false_alarm)
    return loudness.loud_bins(ratio, level, bins=bins, usable=usable)


def _split(
    signal: FloatArray, noise: FloatArray, config: BathymetryConfig
) -> tuple[FloatArray, FloatArray]:
    """Signal and noise (T,) when a share of the echo is not the same at all staves, and so acts as
    noise."""
    share = config.decorrelation
    return (signal * (1.0 - share), noise + share * signal) if share > 0.0 else (signal, noise)


def measure_staves(snapshot: Snapshot, config: BathymetryConfig, swath: Swath) -> Calibration:
    """What the staves of a snapshot are, by its echoes; exact where they are not to be measured.
    Echoes by way of the surface leave no bin with one wave."""
    if not config.calibrate_array or config.multipath:
        return Calibration.exact(snapshot.staves)
    noise = stated_noise(snapshot, config)
    known = noise if np.isfinite(noise).all() else None
    return calibrate(snapshot.iq, snapshot.usable, abs(swath.geometry.spacing), known)


def _noise(
    snapshot: Snapshot,
    ranges: FloatArray,
    config: BathymetryConfig,
    floor_below: float,
    staves: Calibration,
) -> tuple[FloatArray, BoolArray]:
    """Noise variance (T,) at a stave, and where it is known (T,): from the snapshot, the config or
    the water column; else it is taken blindly from what is not coherent."""
    stated = stated_noise(snapshot, config) * staves.level
    missing = np.isnan(stated)
    if not missing.any():
        return stated, ~missing
    quiet = (ranges < WATER_COLUMN * floor_below) & snapshot.usable
    measured, iq = bool(quiet.sum() >= FEWEST_QUIET_BINS), staves.heard(snapshot.iq)
    if measured:
        quiet = variances.quiet_stretches(iq, quiet)
        level = variances.noise_variance(iq, quiet)
    else:
        level = variances.blind_noise_variance(iq)
    if not level > 0.0:
        # Too few bins to tell noise from echo: suppose the 20 dB of a usual swath.
        level = 0.01 * float(np.mean(variances.mean_power(iq[snapshot.usable])))
        measured = False
    level *= staves.level / staves.mean_noise
    return np.where(missing, level, stated), ~missing | measured


def stated_noise(snapshot: Snapshot, config: BathymetryConfig) -> FloatArray:
    """Noise variance (T,) that the snapshot or the config states; NaN where neither does."""
    level = config.noise_variance if config.noise_variance > 0.0 else math.nan
    given = snapshot.noise_variance
    if given is None:
        return np.full(len(snapshot), level)
    return np.where(np.isfinite(given), given, level)


def _signal(
    snapshot: Snapshot, power: FloatArray, noise: FloatArray, echoes: FloatArray
) -> FloatArray:
    """Signal variance (T,) at a stave: from the snapshot, else a moving mean of the power (T,), of
    which the floor has one part in `echoes` (T,)."""
    given = snapshot.signal_variance
    if given is not None and np.isfinite(given).all():
        return np.array(given)
    power = np.where(snapshot.usable, power, 0.0)
    signal = variances.signal_variance(power, noise, usable=snapshot.usable) / echoes
    signal = np.fmax(signal, variances.LEAST_SNR * noise)
    return signal if given is None else np.where(np.isfinite(given), given, signal)
