# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pings of a tilted side-scan array over a sea floor.

`paper` is the scene of Saucan et al. 2013: a sonar 15 m above a flat floor with one rough patch.
The signal-to-noise ratio falls from 30 to 10 dB along the swath, linearly in decibels over the
logarithm of range, as spreading loss does. The other scenarios add one difficulty each: slope,
undulation, roughness that is correlated as real roughness is, shadows, spikes, echoes by way of
the surface, Gaussian echoes, a second side, objects on the floor (`objects`); and a ship that
moves (`ship`).

One bin is y = sqrt(z) (s a(u) + n), the observation model of `acoustics.laplace`, or with noise
that does not fade y = sqrt(z) s a(u) + n. Surface echoes fade with a z of their own. A spike is a
strong burst of noise, incoherent across the array.
In one file, since all of it draws from one generator in turn.
"""

from __future__ import annotations

import math
from typing import Any

from attrs import evolve, frozen
import numpy as np
from numpy.random import Generator

from sonar_imm.acoustics import array, geometry, rays, sounding
from sonar_imm.estimation.arrays import BoolArray, ComplexArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.parameters import parameter
from sonar_imm.truth import Received, Scene, TrueProfile

from ..scenario import FIRST_STAMP_NS, lasting, Scenarios, smoothed
from .objects import above, Facets, facets_of, OBJECTS, second_of, surfaces_of
from .ship import in_outline, navigation_of, see, Ship, ship_of, ShipScenario, sine_from, Terrain

SIDES = ('starboard', 'port', 'both')
LAWS = ('laplace', 'gaussian', 'k')
ROUGHNESS_LAWS = ('gaussian', 'laplace', 'fractal', 'exponential')
SPIKE_POWER = 100.0
"""Of bursts of noise over echo and noise."""


@frozen(kw_only=True)
class BathymetryScenario(ShipScenario):
    """Parameters of a bathymetry scene; the defaults are the scene of the paper."""

    INSTRUMENT = ('tilt_deg', 'conjugate', 'sonar_height', 'sonar_depth')

    # fmt: off
    pings: int = parameter(20, '', 'number of pings of each side', range=(1, 1_000_000))
    ping_rate: float = parameter(10.0, 'Hz', 'pings per second', range=(0.01, 1000.0))
    side: str = parameter('starboard', '', 'which sides the sonar looks to', choices=SIDES)

    staves: int = parameter(8, '', 'number of staves of the array', range=(2, 64))
    spacing_wavelengths: float = parameter(0.5, '',
        'distance between staves, in wavelengths', range=(0.01, 100.0))
    frequency: float = parameter(455e3, 'Hz', 'frequency of the sonar', range=(1e3, 1e7))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound at the sonar', range=(1300.0, 1700.0))
    tilt_deg: float = parameter(30.0, 'deg',
        'direction the array looks to, below the horizon', range=(-90.0, 90.0))
    conjugate: bool = parameter(False, '', 'the array is wired the other way round')
    sonar_height: float = parameter(15.0, 'm',
        'height of the sonar above the reference floor', range=(0.1, 12000.0))
    sonar_depth: float = parameter(3.0, 'm',
        'depth of the sonar below the surface', range=(0.0, 12000.0))

    first_range: float = parameter(17.0, 'm', 'slant range of the first bin', range=(0.0, None))
    last_range: float = parameter(77.0, 'm', 'slant range where the swath ends', range=(0.1, None))
    bin_width: float = parameter(0.05, 'm', 'distance between bins', range=(1e-3, 10.0))
    snr_near_db: float = parameter(30.0, 'dB',
        'signal-to-noise ratio at a stave, at the first echo')
    snr_far_db: float = parameter(10.0, 'dB',
        'signal-to-noise ratio at a stave, at the end of the swath')
    noise_variance: float = parameter(1.0, '', 'noise power at a stave', range=(1e-12, 1e12))
    state_noise: bool = parameter(True, '', 'whether the snapshot states its noise variance')
    state_signal: bool = parameter(False, '', 'whether the snapshot states its signal variance')
    law: str = parameter('laplace', '',
        'distribution of the samples of an echo, by how its power varies', choices=LAWS)
    texture_shape: float = parameter(0.5, '',
        'law k: shape of the gamma distribution of the power of echoes; 1 is laplace',
        range=(0.05, 100.0))
    noise_fades: bool = parameter(True, '',
        'whether the noise varies with the echo, as the observation model has it; thermal noise '
        'does not')
    decorrelation: float = parameter(0.0, '',
        'share of the power of an echo that differs from stave to stave', range=(0.0, 1.0))

    slope: float = parameter(0.0, '',
        'rise of the floor per metre of slant range', range=(-1.0, 1.0))
    undulation_height: float = parameter(0.0, 'm',
        'amplitude of an undulation of the floor', range=(0.0, None))
    undulation_length: float = parameter(20.0, 'm',
        'length of the undulation of the floor in slant range', range=(0.1, None))
    patch_start: float = parameter(40.0, 'm', 'slant range at which the rough patch begins')
    patch_end: float = parameter(50.0, 'm', 'slant range at which the rough patch ends')
    patch_std: float = parameter(0.5, 'm',
        'standard deviation of the heights of the rough patch', range=(0.0, 100.0))
    patch_drift: float = parameter(0.0, 'm',
        'distance by which the rough patch moves outwards from ping to ping')
    roughness_law: str = parameter('gaussian', '',
        'distribution of the heights of the rough patch; fractal: Gaussian with a spectrum that '
        'falls with the square of the wave number; exponential: Gaussian, correlated as '
        'exp(-distance / correlation_length)', choices=ROUGHNESS_LAWS)
    correlation_length: float = parameter(0.0, 'm',
        'standard deviation of the kernel that smooths the heights of the rough patch, or as '
        'roughness_law says; 0: white', range=(0.0, 100.0))

    object: str = parameter('none', '',
        'object on the floor, which is level then: a step up (ledge), a box 2 m wide, a wall or a '
        'boulder, all along the track of a ship; where it answers at the range of the floor a bin '
        'has two surfaces',
        choices=OBJECTS)
    object_distance: float = parameter(30.0, 'm',
        'horizontal distance of the object from the sonar, or from the track',
        range=(0.1, 10_000.0))
    object_size: float = parameter(2.0, 'm',
        'height of the object, or radius of the boulder', range=(0.01, 1000.0))
    shadows: tuple[float, ...] = parameter((), 'm',
        'slant ranges where shadows begin and end, in pairs', range=(0.0, None), kind='float[]')
    spike_probability: float = parameter(0.0, '',
        'probability that a bin has a burst of noise', range=(0.0, 1.0))

    multipath: bool = parameter(False, '', 'whether a calm surface returns echoes too')
    multipath_level_db: float = parameter(0.0, 'dB',
        'multipath: power of each surface echo relative to the floor', range=(-60.0, 60.0))
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check()
        if self.multipath and self.moving:
            problems.append('multipath is for a sonar that rests, not for moving: true')
        if self.object != 'none':
            if self.multipath or self.sound_speed_profile:
                problems.append('objects are for straight rays and without multipath')
            if self.object_size >= self.sonar_height:
                problems.append('object_size must be less than sonar_height')
        if self.last_range < self.first_range + 2.0 * self.bin_width:
            problems.append('last_range must lie at least two bins beyond first_range')
        elif (self.last_range - self.first_range) / self.bin_width > 100_000:
            problems.append('a ping has at most 100,000 bins; bin_width is too small')
        if self.patch_end < self.patch_start:
            problems.append('patch_end cannot lie before patch_start')
        if len(self.shadows) % 2 or any(np.diff(self.shadows) < 0.0):
            problems.append('shadows needs increasing ranges in pairs, begin and end of each')
        return problems

    def instruments(self) -> dict[str, Any]:
        ship = ('sonar_lever', 'sonar_mount_rpy_deg', 'sound_speed_profile', 'water_level')
        mounted = {name: getattr(self, name) for name in ship} if self.moving else {}
        second = {} if self.object == 'none' else {'layover': 'resolved'}
        # The array and the water of a scene are what the tracker is told.
        exact = {'tilt_std_deg': 0.0, 'spacing_std': 0.0, 'sound_speed_std': 0.0}
        return {**super().instruments(), **exact, **mounted, **second}


SUMMER = (0.0, 1520.0, 5.0, 1518.0, 10.0, 1505.0, 15.0, 1495.0, 30.0, 1490.0)
"""Depth and sound speed of a shallow sea in summer."""
_UNDER_WAY: dict[str, Any] = {
    'moving': True, 'pings': 24, 'ping_rate': 2.0, 'sonar_depth': 5.0, 'patch_along': (8.0, 20.0),
    'patch_outline': 1.0, 'nav_attitude_error_deg': 0.05, 'nav_heading_error_deg': 0.1,
    'nav_heave_error': 0.05, 'nav_position_error': 0.1,
}  # fmt: skip

# fmt: off
SCENARIOS: Scenarios = {
    'paper': ('flat floor with a rough patch, 30 to 10 dB: the scene of the paper', {}),
    'slope': ('paper on a floor that rises 0.1 m per metre', {'slope': 0.1}),
    'correlated': ('paper with roughness correlated over a metre, as real roughness is',
        {'correlation_length': 1.0}),
    'undulating': ('paper on an undulating floor',
        {'undulation_height': 0.5, 'undulation_length': 15.0}),
    'shadow': ('paper with two shadows', {'shadows': (30.0, 33.0, 58.0, 63.0)}),
    'spikes': ('paper with a burst of noise in every tenth bin', {'spike_probability': 0.1}),
    'multipath': ('paper under a calm surface', {'multipath': True}),
    'water_column': ('paper from 5 m on, so that the noise is heard and need not be stated',
        {'first_range': 5.0, 'state_noise': False}),
    'gaussian': ('paper with Gaussian echoes', {'law': 'gaussian'}),
    'thermal': ('paper with noise that does not fade with the echo', {'noise_fades': False}),
    'foreign': ('paper under other laws than the tracker supposes: fractal roughness, echoes with '
        'heavier tails, noise that does not fade',
        {'noise_fades': False, 'law': 'k', 'roughness_law': 'fractal'}),
    'ledge': ('a step of 2 m, which answers at the same ranges as the floor; noise that does not '
        'fade',
        {'object': 'ledge', 'noise_fades': False}),
    'moving_ledge': ('ledge below a ship under way in a swell',
        {**_UNDER_WAY, 'object': 'ledge', 'noise_fades': False}),
    'two_sides': ('paper on both sides of the ship', {'side': 'both'}),
    'moving': ('a ship under way in a swell, with navigation and its errors; a rough patch with a '
        'wavy outline',
        {**_UNDER_WAY}),
    'moving_profile': ('moving in summer, when sound bends by metres at the end of the swath',
        {**_UNDER_WAY, 'sonar_depth': 5.0, 'sound_speed_profile': SUMMER}),
    'moving_two_sides': ('moving, on both sides of the ship', {**_UNDER_WAY, 'side': 'both'}),
    'drifting_patch': ('paper with a patch that lies further out each ping',
        {'pings': 60, 'patch_drift': 0.2, 'patch_start': 32.0, 'patch_end': 42.0}),
}
# fmt: on

scenario = BathymetryScenario.among(SCENARIOS)


def simulate(config: BathymetryScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene.

    A measurement is received together with its last echo. With both sides, each has a namespace of
    its own. The frame is that of the sonar: x forward, y to port, z up. With a moving ship it is
    the world, and the navigation is part of the scene.
    """
    rng = np.random.default_rng(seed)
    sides = ('port', 'starboard') if config.side == 'both' else (config.side,)
    ranges = config.first_range + config.bin_width * np.arange(
        round((config.last_range - config.first_range) / config.bin_width), dtype=np.float64
    )
    listening_ns = round(2e9 * ranges[-1] / config.sound_speed)
    ship = ship_of(config, config.sonar_depth, rng) if config.moving else None
    received, truth = [], []
    for ping in range(config.pings):
        since_start = ping / config.ping_rate
        stamp = FIRST_STAMP_NS + round(since_start * 1e9)
        for side in sides:
            namespace = side if len(sides) > 1 else ''
            look = facets = floor = None
            if ship is None:
                profile = _floor(config, ping, ranges, rng, side)
            else:
                look = look_of(config, ship, since_start, ranges, side)
                roughness = _roughness(config, len(ranges), rng)
                profile = floor_below(config, look, _terrain(config, ship), roughness, ranges)
                floor = above(look, ship.course, side, _level(config))
            if config.object != 'none':
                facets = facets_of(config, ranges, snr(config, ranges), floor)
                profile = _with_object(config, profile, facets, look)
            profile = evolve(profile, stamp_ns=stamp, namespace=namespace)
            truth.append(profile)
            snapshot = hear(config, profile, rng, facets)
            received.append(Received(stamp + listening_ns, snapshot, namespace))
    if ship is not None:
        seconds = (config.pings - 1) / config.ping_rate
        stated = navigation_of(config, ship, FIRST_STAMP_NS, seconds, rng, 'map')
        received = [*(Received(item.stamp_ns, item) for item in stated), *received]
        received.sort(key=lambda item: item.received_ns)
    return Scene(tuple(received), tuple(truth), frame_id=truth[0].frame_id)


def _floor(
    config: BathymetryScenario, ping: int, ranges: FloatArray, rng: Generator, side: str
) -> TrueProfile:
    """The floor below a sonar that rests, of which `simulate` knows the stamp."""
    drift = ping * config.patch_drift
    patch = (ranges >= config.patch_start + drift) & (ranges < config.patch_end + drift)
    height = config.slope * (ranges - ranges[0]) + patch * _roughness(config, len(ranges), rng)
    waves = 2.0 * np.pi * (ranges - ranges[0]) / config.undulation_length
    height += config.undulation_height * np.sin(waves)
    depth = config.sonar_height - height
    valid = np.abs(depth) <= ranges  # before that, the sound is still in the water column
    valid &= _lit(config, ranges)
    return TrueProfile(
        stamp_ns=0,
        frame_id='sonar',
        range=ranges,
        height=height,
        angle=array.angle_of_depth(depth, ranges, math.radians(config.tilt_deg)),
        patch=patch,
        valid=valid,
        xyz=_at_rest(depth, ranges, side == 'port'),
    )


def _at_rest(depth: FloatArray, ranges: FloatArray, to_port: bool) -> FloatArray:
    """Places (n, 3) of echoes in the frame of a sonar that rests."""
    outward = array.across_track(depth, ranges)
    return np.column_stack([np.zeros(len(depth)), outward if to_port else -outward, -depth])


def _with_object(
    config: BathymetryScenario, floor: TrueProfile, facets: Facets, look: sounding.Looks | None
) -> TrueProfile:
    """The truth of a level floor with an object on it; look: of the array of a ship, else None."""
    number, height, second = second_of(*surfaces_of(facets, len(floor.range)))
    height = np.where(number > 0, height, 0.0)
    if look is None:
        depth = config.sonar_height - height
        angle = array.angle_of_depth(depth, floor.range, math.radians(config.tilt_deg))
        xyz = _at_rest(depth, floor.range, floor.xyz[-1, 1] > 0.0)
    else:
        height, second = _level(config) + height, _level(config) + second
        rise = np.clip((look.position[:, 2] - height) / (floor.range * look.C), -1.0, 1.0)
        sine = sine_from(look, rise)
        place = look.position + floor.range[:, None] * sounding.direction(look, sine)
        angle = np.arcsin(np.clip(sine, -1.0, 1.0))
        xyz = np.column_stack([place[:, :2], height])
    return evolve(
        floor,
        height=height,
        angle=angle,
        patch=np.zeros(len(height), bool),
        valid=number > 0,
        xyz=xyz,
        surfaces=number.astype(np.uint8),
        height_2=second,
    )


def _level(config: BathymetryScenario) -> float:
    """z of the floor below a ship."""
    return config.water_level - config.sonar_depth - config.sonar_height


def look_of(
    config: BathymetryScenario, ship: Ship, sent: float, ranges: FloatArray, side: str
) -> sounding.Looks:
    """How the array of a ship looks at a ping sent at a time in s."""
    mount = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), mount)
    received = ship.pose(sent + 2.0 * ranges / config.sound_speed)
    return sounding.looks(axes, np.array(config.sonar_lever), ship.pose(np.array(sent)), received)


def _terrain(config: BathymetryScenario, ship: Ship) -> Terrain:
    """The floor below a moving ship."""

    def rise(along: FloatArray, off: FloatArray) -> FloatArray:
        wave = np.sin(2.0 * np.pi * off / config.undulation_length)
        return config.slope * off + config.undulation_height * wave

    def rough(along: FloatArray, off: FloatArray) -> BoolArray:
        return in_outline(config, along, off, config.patch_start, config.patch_end)

    return Terrain(_level(config), ship.course, rise, rough)


def floor_below(
    config: BathymetryScenario,
    look: sounding.Looks,
    terrain: Terrain,
    roughness: FloatArray,
    ranges: FloatArray,
) -> TrueProfile:
    """The terrain that a ping of a ship sees, see `see`; without its stamp."""
    seen = see(config, look, terrain, roughness, ranges, config.sound_speed)
    return TrueProfile(
        stamp_ns=0,
        frame_id='map',
        range=ranges,
        height=seen.place[:, 2],
        angle=np.where(seen.reached, np.arcsin(np.clip(seen.sine, -1.0, 1.0)), np.nan),
        patch=seen.patch,
        valid=seen.reached & _lit(config, ranges),
        xyz=np.where(seen.reached[:, None], seen.place, np.nan),
    )


def _lit(config: BathymetryScenario, ranges: FloatArray) -> BoolArray:
    """Bins (n,) outside the shadows."""
    lit = np.ones(len(ranges), bool)
    for begin, end in zip(config.shadows[::2], config.shadows[1::2]):
        lit &= (ranges < begin) | (ranges >= end)
    return lit


def _roughness(config: BathymetryScenario, bins: int, rng: Generator) -> FloatArray:
    if config.roughness_law == 'laplace':
        white = rng.laplace(scale=math.sqrt(0.5), size=bins)
    else:
        white = rng.normal(size=bins)
    if config.roughness_law == 'fractal':
        wave = np.fft.rfft(white)
        longest = (config.patch_end - config.patch_start) / config.bin_width
        wave /= np.maximum(np.arange(len(wave)) * longest / bins, 1.0)
        wave[0] = 0.0
        white = np.fft.irfft(wave, bins)
        white /= white.std()
    width = config.correlation_length / config.bin_width
    if width > 0.0 and config.roughness_law == 'exponential':
        white = lasting(white, math.exp(-1.0 / width))
    elif width > 0.0:
        white = smoothed(white, width)
    return config.patch_std * white


def snr(config: BathymetryScenario, ranges: FloatArray) -> FloatArray:
    """Signal-to-noise ratio (n,) at one stave, linear."""
    nearest = max(config.first_range, min(config.sonar_height, 0.5 * config.last_range))
    share = np.log(np.maximum(ranges, nearest) / nearest) / math.log(config.last_range / nearest)
    decibels = config.snr_near_db + share * (config.snr_far_db - config.snr_near_db)
    return 10.0 ** (0.1 * decibels)


def hear(
    config: BathymetryScenario, floor: TrueProfile, rng: Generator, facets: Facets | None = None
) -> Snapshot:
    """The samples of the staves for one ping over a floor, or from its facets."""
    bins = len(floor.range)
    sine = np.nan_to_num(np.sin(floor.angle))
    signal = config.noise_variance * snr(config, floor.range) * floor.valid
    if facets is None:
        y = np.sqrt(signal)[:, None] * _echo(config, sine, rng)
    else:
        y = _of_facets(config, bins, facets, rng)
    noise = math.sqrt(config.noise_variance) * _circular(rng, bins, config.staves)
    fading = np.sqrt(_fading(config, bins, rng))[:, None]
    if facets is not None:
        y = y + noise * fading if config.noise_fades else y + noise
    else:
        y = (y + noise) * fading if config.noise_fades else y * fading + noise
    if config.multipath:
        level = np.sqrt(signal * 10.0 ** (0.1 * config.multipath_level_db))
        depth = config.sonar_height - floor.height
        tilt = math.radians(config.tilt_deg)
        others = array.multipath_sines(depth, floor.range, tilt, config.sonar_depth)
        for other in others.T:
            strength = level * np.sqrt(_fading(config, bins, rng)) * np.isfinite(other)
            y += strength[:, None] * _echo(config, np.nan_to_num(other), rng)
    spikes = rng.uniform(size=bins) < config.spike_probability
    if spikes.any():
        power = (signal + config.noise_variance) * SPIKE_POWER * spikes
        y += np.sqrt(power)[:, None] * _circular(rng, bins, config.staves)
    speed = config.sound_speed  # which makes the wavelength at the array
    if config.sound_speed_profile:
        speed = float(rays.profile_of(config.sound_speed_profile).at(config.sonar_depth))
    return Snapshot(
        stamp_ns=floor.stamp_ns,
        frame_id='sonar',
        range=floor.range,
        iq=y.astype(np.complex64),
        noise_variance=np.full(bins, config.noise_variance) if config.state_noise else None,
        signal_variance=signal if config.state_signal else None,
        sound_speed=config.sound_speed,
        frequency=config.frequency,
        element_spacing=config.spacing_wavelengths * speed / config.frequency,
        sample_rate=0.5 * config.sound_speed / config.bin_width,
    )


def _of_facets(
    config: BathymetryScenario, bins: int, facets: Facets, rng: Generator
) -> ComplexArray:
    """The echoes (T, P) of facets, each surface of a bin with a texture of its own."""
    texture = np.stack([_fading(config, bins, rng) for _ in range(4)])
    power = config.noise_variance * facets.power * texture[facets.surface, facets.bin]
    echo = np.sqrt(power)[:, None] * _echo(config, np.nan_to_num(facets.sine), rng)
    parts = [np.bincount(facets.bin, stave, bins) for stave in echo.view(np.float64).T]
    return np.column_stack(parts).view(np.complex128)


def _echo(config: BathymetryScenario, sine: FloatArray, rng: Generator) -> ComplexArray:
    """Plane waves (n, P) of unit power from direction sines (n,), less what staves differ in."""
    shape = config.staves, config.spacing_wavelengths
    vectors = array.steering(sine, *shape, conjugate=config.conjugate)
    share = config.decorrelation
    wave = vectors * _circular(rng, len(sine), 1)
    if not share > 0.0:
        return wave
    own = _circular(rng, len(sine), config.staves)
    return math.sqrt(1.0 - share) * wave + math.sqrt(share) * own


def _fading(config: BathymetryScenario, bins: int, rng: Generator) -> FloatArray:
    """The power z (n,) of echoes, one on average."""
    if config.law == 'k':
        return rng.gamma(config.texture_shape, 1.0 / config.texture_shape, size=bins)
    return rng.exponential(size=bins) if config.law == 'laplace' else np.ones(bins)


def _circular(rng: Generator, *shape: int) -> ComplexArray:
    """Circular complex Gaussian numbers of unit variance."""
    return rng.normal(size=(*shape, 2)).view(np.complex128)[..., 0] * math.sqrt(0.5)
