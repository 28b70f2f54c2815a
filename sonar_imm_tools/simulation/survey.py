# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Surveys of many lines over one floor, with truth: soundings as a tracker would make them
(`simulate`), or the pings and navigation that a tracker makes them of (`pings_of`).

Nothing here uses the first-order formulas of `sonar_imm_tools.survey`, which it tests: poses are
rotations, and sound goes in two straight pieces through two layers of water. The tracker is taken
to know the speed of sound in the upper third of the column, where the array is, and to suppose the
same below, where it is wrong. A correction is the true value less the reported one. In one file,
with the parameters, whose texts are a part of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import math
from pathlib import Path
from typing import Any

from attrs import evolve, frozen
import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter, map_coordinates

from sonar_imm.acoustics.geometry import rotation
from sonar_imm.acoustics.sounding import ErrorBudget, uncertainties
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.parameters import parameter
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.truth import Received, Scene

from ..recordings.export.points import Points
from .bathymetry.ship import navigation_of, Ship, ship_of, Terrain, Waves
from .bathymetry.simulator import BathymetryScenario, floor_below, hear, look_of
from .scenario import FIRST_STAMP_NS, lasting, Scenario, Scenarios

TERRAINS = ('survey', 'flat', 'slope')
SECONDS = {'attitude': 3.0, 'heave': 5.0, 'heading': 30.0, 'position': 60.0}
"""How long errors of the navigation last."""
_STEP = 0.25
"""Cells of the height map of the floor, m."""
_MARCH, _BISECTIONS = 64, 24
SOUND_SPEED = 1500.0
"""What the tracker supposes, m/s."""
KEEL, PAUSE_NS = 2.0, 120_000_000_000
"""How deep the array is, m, and the time between lines."""


@frozen(kw_only=True)
class SurveyScenario(Scenario):
    """Parameters of a survey; corrections are true less reported."""

    # fmt: off
    lines: int = parameter(12, '', 'number of parallel lines', range=(1, 5000))
    cross_lines: int = parameter(3, '', 'number of lines across', range=(0, 1000))
    spacing: float = parameter(40.0, 'm', 'distance between lines', range=(1.0, 1000.0))
    length: float = parameter(440.0, 'm', 'length of the parallel lines', range=(10.0, 100_000.0))
    speed: float = parameter(2.0, 'm/s', 'speed of the ship', range=(0.1, 20.0))
    ping_interval: float = parameter(1.0, 's', 'time between pings', range=(0.01, 60.0))
    beams: int = parameter(40, '', 'soundings of a ping on each side', range=(2, 2000))
    reach: float = parameter(3.0, '',
        'horizontal distance of the outermost sounding, in depths', range=(0.5, 8.0))
    terrain: str = parameter('survey', '', 'the floor', choices=TERRAINS)
    depth: float = parameter(20.0, 'm', 'mean depth', range=(3.0, 5000.0))
    slope: float = parameter(0.02, '', 'rise of the floor per metre', range=(-1.0, 1.0))
    noise: float = parameter(0.04, 'm',
        'standard deviation of the noise of a sounding', range=(0.0, 10.0))
    roll_bias_deg: float = parameter(1.0, 'deg', 'correction of roll', range=(-10.0, 10.0))
    pitch: float = parameter(0.0, 'deg', 'correction of pitch', range=(-10.0, 10.0))
    heading: float = parameter(0.0, 'deg', 'correction of the heading', range=(-10.0, 10.0))
    latency: float = parameter(0.0, 's',
        'correction of the latency of positions', range=(-5.0, 5.0))
    tide_std: float = parameter(0.3, 'm',
        'standard deviation of the offsets of lines', range=(0.0, 100.0))
    sound_speed_error: float = parameter(4.0, 'm/s',
        'correction of the mean speed of sound', range=(-50.0, 50.0))
    nav_errors: float = parameter(1.0, '',
        'errors of the navigation, in those that the tracker supposes', range=(0.0, 100.0))
    outliers: float = parameter(0.01, '', 'share of soundings far off', range=(0.0, 1.0))
    fish: bool = parameter(True, '', 'whether one line sees a school of fish above the floor')
    ghost: bool = parameter(True, '', 'whether one line has false echoes below the floor')
    # fmt: on


# fmt: off
SCENARIOS: Scenarios = {
    'survey': ('twelve lines and three across, 12 to 28 m deep, with biases and false echoes', {}),
    'flat': ('one line over a level floor, with the errors that the tracker supposes',
        {'lines': 1, 'cross_lines': 0, 'terrain': 'flat', 'roll_bias_deg': 0.0, 'tide_std': 0.0,
         'sound_speed_error': 0.0, 'outliers': 0.0, 'fish': False, 'ghost': False}),
}
# fmt: on


@frozen(eq=False)
class SurveyScene:
    """Lines by name, and what is true of them.

    corrections (L, 6): roll, pitch, heading (rad), offset (m), sound speed (m/s), latency (s).
    bad: by line, soundings (n,) that are not of the floor; fish the same. floor: height map.
    """

    names: tuple[str, ...]
    points: tuple[Points, ...]
    corrections: FloatArray
    bad: tuple[BoolArray, ...]
    fish: tuple[BoolArray, ...]
    floor: Floor


@frozen(eq=False)
class Floor:
    """A height map: z (X, Y) at x0 + i step, y0 + j step."""

    x0: float
    y0: float
    z: FloatArray

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Heights at places, linear between the points of the map."""
        where = np.array([(x - self.x0) / _STEP, (y - self.y0) / _STEP])
        return np.asarray(map_coordinates(self.z, where, order=1, mode='nearest'))


scenario = SurveyScenario.among(SCENARIOS)


def simulate(config: SurveyScenario, seed: int) -> SurveyScene:
    """Run a survey; the same config and seed give the same scene."""
    rng = np.random.default_rng(seed)
    floor, starts, corrections = _plan(config, rng)
    points, bad, fish = [], [], []
    first = FIRST_STAMP_NS
    for k, (start, course, length) in enumerate(starts):
        line = _line(config, floor, np.array(start), course, length, corrections[k], first, rng)
        false = _falsify(config, k, line, rng)
        points.append(line)
        bad.append(false[0])
        fish.append(false[1])
        first = int(line.stamp_ns.max()) + PAUSE_NS
    names = tuple(f'line_{k:03d}' for k in range(len(starts)))
    return SurveyScene(names, tuple(points), corrections, tuple(bad), tuple(fish), floor)


def _plan(
    config: SurveyScenario, rng: Generator
) -> tuple[Floor, list[tuple[tuple[float, float], float, float]], FloatArray]:
    """The floor, start, course and length of each line, and the corrections (L, 6)."""
    width = (config.lines - 1) * config.spacing
    floor = _floor(config, width, rng)
    lines: list[tuple[tuple[float, float], float, float]] = []
    for k in range(config.lines):  # there and back
        start, course = (config.length, math.pi) if k % 2 else (0.0, 0.0)
        lines.append(((start, k * config.spacing), course, config.length))
    for k in range(config.cross_lines):
        x = config.length * (k + 1) / (config.cross_lines + 1)
        lines.append(((x, -0.5 * config.spacing), 0.5 * math.pi, width + config.spacing))
    corrections = np.zeros((len(lines), 6))
    corrections[:, :3] = np.radians([config.roll_bias_deg, config.pitch, config.heading])
    corrections[:, 3] = config.tide_std * rng.standard_normal(len(lines))
    spread = config.nav_errors * budget().sound_speed
    corrections[:, 4] = config.sound_speed_error + spread * rng.standard_normal(len(lines))
    corrections[:, 5] = config.latency
    return floor, lines, corrections


def pings_of(
    config: SurveyScenario, seed: int
) -> tuple[SurveyScene, Iterator[tuple[str, Scene, Mapping[str, Any]]]]:
    """The same survey as pings of both sides with navigation: what is true of it, without points,
    and each line by its name with what its tracker is told. False echoes are those of the
    tracker's own; biases are in the navigation, and sound bends as the tracker is not told."""
    rng = np.random.default_rng(seed)
    floor, lines, corrections = _plan(config, rng)
    names = tuple(f'line_{k:03d}' for k in range(len(lines)))
    nothing = (np.zeros(0, bool),)

    def scenes() -> Iterator[tuple[str, Scene, Mapping[str, Any]]]:
        first = FIRST_STAMP_NS
        for name, line, correction in zip(names, lines, corrections):
            sonar = _sonar(config, line, float(correction[4]))
            scene = _swaths(sonar, floor, line[0], correction, first, rng)
            first = scene.measurements[-1].received_ns + PAUSE_NS
            told = evolve(sonar, sound_speed_profile=())
            yield name, scene, told.instruments()

    return SurveyScene(names, (), corrections, nothing, nothing, floor), scenes()


def _sonar(
    config: SurveyScenario, line: tuple[tuple[float, float], float, float], error: float
) -> BathymetryScenario:
    """Sonar and ship of a line; the mean speed of sound is wrong by `error`."""
    height = config.depth - KEEL
    layer, below = KEEL + height / 3.0, SOUND_SPEED + 1.5 * error
    stated, errors = budget(), config.nav_errors
    return BathymetryScenario(
        moving=True,
        side='both',
        pings=max(round(line[2] / config.speed / config.ping_interval), 1),
        ping_rate=1.0 / config.ping_interval,
        speed=config.speed,
        course_deg=math.degrees(line[1]),
        sonar_depth=KEEL,
        sonar_height=height,
        sonar_lever=(0.0, 0.0, 0.0),
        sonar_mount_rpy_deg=(0.0, 0.0, 0.0),
        first_range=0.5 * height,
        last_range=1.1 * height * math.hypot(1.0, config.reach),
        bin_width=0.1,
        sound_speed=SOUND_SPEED,
        sound_speed_profile=(0.0, SOUND_SPEED, layer, SOUND_SPEED, layer + 0.1, below),
        noise_fades=False,
        nav_attitude_error_deg=errors * math.degrees(stated.attitude),
        nav_heading_error_deg=errors * math.degrees(stated.heading),
        nav_heave_error=errors * stated.heave,
        nav_position_error=errors * stated.position,
    )


class _Ground(Terrain):
    """A floor whose `rise` gives z by east and north."""

    def at(self, place: FloatArray, roughness: FloatArray) -> tuple[FloatArray, BoolArray]:
        return self.rise(place[..., 0], place[..., 1]), np.zeros(place.shape[:-1], bool)


def _swaths(
    sonar: BathymetryScenario,
    floor: Floor,
    start: tuple[float, float],
    correction: FloatArray,
    first_ns: int,
    rng: Generator,
) -> Scene:
    ship = ship_of(sonar, sonar.sonar_depth, rng)
    ship = ship._replace(start=ship.start + [*start, 0.0])
    level = -KEEL - sonar.sonar_height
    ground = _Ground(level, ship.course, floor.at, lambda along, off: off > np.inf)
    count = round((sonar.last_range - sonar.first_range) / sonar.bin_width)
    ranges = sonar.first_range + sonar.bin_width * np.arange(count, dtype=np.float64)
    heard = round(2e9 * ranges[-1] / SOUND_SPEED)
    received, truth = [], []
    for ping in range(sonar.pings):
        sent = ping / sonar.ping_rate
        for side in ('port', 'starboard'):
            look = look_of(sonar, ship, sent, ranges, side)
            profile = floor_below(sonar, look, ground, np.zeros(count), ranges)
            profile = evolve(profile, stamp_ns=first_ns + round(sent * 1e9), namespace=side)
            truth.append(profile)
            received.append(Received(profile.stamp_ns + heard, hear(sonar, profile, rng), side))
    reported, seconds = _as_reported(ship, correction), sonar.pings / sonar.ping_rate
    stated = navigation_of(sonar, reported, first_ns, seconds, rng, 'map')
    received += [Received(each.stamp_ns, each) for each in stated]
    received.sort(key=lambda item: item.received_ns)
    return Scene(tuple(received), tuple(truth), frame_id='map')


def _as_reported(ship: Ship, correction: FloatArray) -> Ship:
    """The ship as its navigation has it, before errors that change: true less the corrections."""

    def less(waves: Waves, bias: float) -> Waves:
        constant = -bias, 0.0, 0.5 * math.pi
        return Waves(*(np.append(part, value) for part, value in zip(waves, constant)))

    return ship._replace(
        start=ship.start - [0.0, 0.0, correction[3]] - correction[5] * ship.velocity,
        roll=less(ship.roll, correction[0]),
        pitch=less(ship.pitch, correction[1]),
        yaw=less(ship.yaw, correction[2]),
    )


def write_truth(path: Path, scene: SurveyScene) -> None:
    """Truth as npz: `names` and `corrections` (L, 6) of the lines; `truth_z` (nx, ny) at the nodes
    (x0 + i + .5, y0 + j + .5) of 1 m cells, `ext` = x0, y0, nx, ny; `bad` and `fish`: flags of all
    soundings, line after line in the order of their tables."""
    x0, y0 = math.ceil(scene.floor.x0), math.ceil(scene.floor.y0)
    nx, ny = (np.array(scene.floor.z.shape) * _STEP - 2.0).astype(int).tolist()
    x, y = np.meshgrid(x0 + np.arange(nx) + 0.5, y0 + np.arange(ny) + 0.5, indexing='ij')
    np.savez_compressed(
        path,
        names=np.array(scene.names),
        corrections=scene.corrections,
        ext=np.array([x0, y0, nx, ny]),
        truth_z=scene.floor.at(x, y).astype(np.float32),
        bad=np.concatenate(scene.bad),
        fish=np.concatenate(scene.fish),
    )


def budget() -> ErrorBudget:
    """The errors that a tracker supposes by default, and that the scene has."""
    return BathymetryConfig().budget()


def _floor(config: SurveyScenario, width: float, rng: Generator) -> Floor:
    margin = (config.reach + 0.5) * 1.4 * config.depth
    x = np.arange(-margin, config.length + margin, _STEP)
    y = np.arange(-margin - 0.5 * config.spacing, width + 0.5 * config.spacing + margin, _STEP)
    z = np.full((len(x), len(y)), -config.depth)
    if config.terrain != 'flat':
        z += config.slope * (x[:, None] - 0.5 * config.length)
    if config.terrain == 'survey':
        X, Y = np.meshgrid(x, y, indexing='ij', sparse=True)
        z += 0.1 * config.depth * np.sin(2.0 * math.pi * (X + 0.3 * Y) / 160.0)
        z += 0.05 * config.depth * np.sin(2.0 * math.pi * (Y - 0.4 * X) / 90.0)
        waves = np.exp(-np.square((X - 0.7 * config.length) / 60.0))
        z += 0.125 * waves * np.sin(2.0 * math.pi * X / 8.0)
        rough = gaussian_filter(rng.standard_normal(z.shape), 2.0, mode='wrap')
        patch = (np.abs(X - 0.3 * config.length) < 30.0) & (np.abs(Y - 0.5 * width) < 30.0)
        z += 0.15 * patch * rough / rough.std()
        for _ in range(max(4, int(config.length * max(width, 40.0) / 6000.0))):
            place = rng.uniform([0.0, 0.0], [config.length, max(width, 1.0)])
            _add_ellipsoid(z, x, y, place, np.full(3, rng.uniform(0.7, 2.0)))
        wreck = np.array([0.55 * config.length, 0.35 * width])
        _add_ellipsoid(z, x, y, wreck, np.array([20.0, 4.0, 4.0]))
    return Floor(float(x[0]), float(y[0]), z)


def _add_ellipsoid(
    z: FloatArray, x: FloatArray, y: FloatArray, place: FloatArray, axes: FloatArray
) -> None:
    i = slice(*np.searchsorted(x, [place[0] - axes[0], place[0] + axes[0]]))
    j = slice(*np.searchsorted(y, [place[1] - axes[1], place[1] + axes[1]]))
    u = (x[i, None] - place[0]) / axes[0]
    v = (y[None, j] - place[1]) / axes[1]
    z[i, j] += axes[2] * np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))


def _line(
    config: SurveyScenario,
    floor: Floor,
    start: FloatArray,
    course: float,
    length: float,
    corrections: FloatArray,
    first_ns: int,
    rng: Generator,
) -> Points:
    t = np.arange(0.0, length / config.speed, config.ping_interval)
    errors = budget()
    heave, heading, *others = (
        config.nav_errors * _slow(rng, t, SECONDS[name])
        for name in ('heave', 'heading', 'attitude', 'attitude', 'position', 'position')
    )
    attitude, position = others[:2], others[2:]
    roll = math.radians(2.0) * np.sin(2.0 * math.pi * t / 7.0 + rng.uniform(0.0, 6.0))
    pitch = math.radians(1.0) * np.sin(2.0 * math.pi * t / 5.5 + rng.uniform(0.0, 6.0))
    yaw = course + math.radians(0.8) * np.sin(2.0 * math.pi * t / 12.0 + rng.uniform(0.0, 6.0))
    ahead = np.array([math.cos(course), math.sin(course)])
    place = np.column_stack([start + t[:, None] * config.speed * ahead, np.full(len(t), -2.0)])
    place[:, 2] += 0.15 * np.sin(2.0 * math.pi * t / 6.0)
    reported_place = place.copy()
    reported_place[:, :2] -= corrections[5] * config.speed * ahead
    reported_place[:, :2] -= errors.position * np.column_stack(position)
    reported_place[:, 2] -= corrections[3] + errors.heave * heave
    reported = rotation(
        roll - corrections[0] - errors.attitude * attitude[0],
        pitch - corrections[1] - errors.attitude * attitude[1],
        yaw - corrections[2] - errors.heading * heading,
    )
    true = rotation(roll, pitch, yaw)
    # Beams evenly along the floor, on both sides.
    over = np.linspace(0.3, config.reach, config.beams)
    angle = np.concatenate([np.arctan(over), -np.arctan(over)])
    fan = np.column_stack([np.zeros(len(angle)), np.sin(angle), -np.cos(angle)])
    n = np.einsum('pij,bj->pbi', true, fan)
    below = _depth_below(config, floor, place, n, corrections[4])
    _, seconds = _ray(config, place[:, None, 2], n, below, corrections[4])
    slant = SOUND_SPEED * seconds
    stated = np.einsum('pij,bj->pbi', reported, fan)
    xyz = reported_place[:, None, :] + slant[..., None] * stated
    # Noise of unit variance that neighbours of a swath share in part, as a filter's is.
    white = rng.standard_normal((len(t), 2, config.beams))
    own = np.moveaxis(lasting(np.moveaxis(white, -1, 0), 1.0 / 3.0), 0, -1)
    own = own.reshape(len(t), 2 * config.beams) * config.noise
    xyz[..., 2] += own
    D, Y = -slant * stated[..., 2], slant * np.hypot(stated[..., 0], stated[..., 1])
    noise = np.full(D.shape, config.noise**2)
    vertical, horizontal = uncertainties(noise, D, Y, errors, SOUND_SPEED)
    whole = np.broadcast_to(angle, D.shape)
    level = np.arccos(np.clip(-stated[..., 2], -1.0, 1.0)) * np.sign(whole)
    found = np.isfinite(xyz).all(axis=-1)
    columns = {
        'x': xyz[..., 0],
        'y': xyz[..., 1],
        'z': xyz[..., 2],
        'vertical_uncertainty': vertical,
        'horizontal_uncertainty': horizontal,
        'intensity': np.zeros(D.shape),
        'beam_angle': level,
        'label': np.zeros(D.shape),
        'label_probability': np.full(D.shape, 0.95),
        'range': slant,
        'side': (whole < 0.0).astype(np.float64),
        'surface': np.ones(D.shape),
        'existence': np.zeros(D.shape),
        'geometry_std': np.zeros(D.shape),
    }
    stamps = first_ns + np.round(1e9 * t).astype(np.int64)
    stamp_ns = np.broadcast_to(stamps[:, None], D.shape)[found]
    return Points(stamp_ns, {name: values[found] for name, values in columns.items()})


def _slow(rng: Generator, t: FloatArray, seconds: float) -> FloatArray:
    """Errors of unit variance at times t (P,)."""
    keep = math.exp(-(t[1] - t[0]) / seconds) if len(t) > 1 else 0.0
    return lasting(rng.standard_normal(len(t)), keep)


def _ray(
    config: SurveyScenario, z: FloatArray, n: FloatArray, below: FloatArray, error: float
) -> tuple[FloatArray, FloatArray]:
    """How far aside a ray of direction n is at a depth `below` the array, and after what time."""
    upper = np.minimum(below, (config.depth + z) / 3.0)
    lower = below - upper
    c1 = SOUND_SPEED
    c2 = c1 + 1.5 * error  # two thirds of the column make the mean
    level1 = np.hypot(n[..., 0], n[..., 1])
    level2 = np.minimum(level1 * c2 / c1, 1.0 - 1e-9)
    down1, down2 = np.sqrt(1.0 - level1**2), np.sqrt(1.0 - level2**2)
    aside = upper * level1 / down1 + lower * level2 / down2
    return aside, upper / (c1 * down1) + lower / (c2 * down2)


def _depth_below(
    config: SurveyScenario, floor: Floor, place: FloatArray, n: FloatArray, error: float
) -> FloatArray:
    """Depth below the array at which each ray first meets the floor; NaN where it does not."""
    level = np.maximum(np.hypot(n[..., 0], n[..., 1]), 1e-12)
    azimuth = n[..., :2] / level[..., None]
    z = place[:, None, 2]

    def above(below: FloatArray) -> FloatArray:
        aside, _ = _ray(config, z, n, below, error)
        where = place[:, None, :2] + aside[..., None] * azimuth
        return np.asarray(z - below - floor.at(where[..., 0], where[..., 1]))

    steps = np.linspace(0.3, 1.9, _MARCH) * config.depth
    low = np.full(level.shape, steps[0])
    high = np.full(level.shape, np.nan)
    for step in steps[1:]:
        under = above(np.full(level.shape, step)) <= 0.0
        open_ = np.isnan(high)
        high = np.where(open_ & under, step, high)
        low = np.where(open_ & ~under, step, low)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        under = above(np.nan_to_num(middle, nan=steps[0])) <= 0.0
        low, high = np.where(under, low, middle), np.where(under, middle, high)
    return np.asarray(0.5 * (low + high))


def _falsify(
    config: SurveyScenario, number: int, line: Points, rng: Generator
) -> tuple[BoolArray, BoolArray]:
    """Put false echoes into a line, in place; which are bad, and which of these are fish."""
    n = len(line)
    bad = rng.random(n) < config.outliers
    line['z'][bad] += rng.uniform(-5.0, 5.0, int(bad.sum()))
    along = (line.stamp_ns - line.stamp_ns[0]) / max(int(np.ptp(line.stamp_ns)), 1)
    fish = np.zeros(n, bool)
    if config.fish and number == config.lines // 2:
        near = (along > 0.4) & (along < 0.55) & (line['beam_angle'] > 0.3)
        fish = near & (rng.random(n) < 0.6)
        line['z'][fish] += rng.normal(2.5, 0.3, int(fish.sum()))
    if config.ghost and number == config.lines // 3:
        angle = line['beam_angle']
        near = (along > 0.6) & (along < 0.8) & (angle < -0.8) & (angle > -1.1)
        ghost = near & (rng.random(n) < 0.5)
        line['z'][ghost] -= 1.2
        bad |= ghost
    return bad | fish, fish
