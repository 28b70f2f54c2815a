# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Swimming divers, observed by a polar or a multistatic sonar.

A scenario (`SCENARIOS`) is a named choice of `motion`, how the divers move, and `sensor`, how they
are observed. The paper's Table 1 gives start, speed, sampling and accuracy, but not the path. In
`table1` the diver swims legs of 7 to 15 s whose headings lie within 85 degrees of a general
heading ("zigzag with general consistent direction" in the paper). In one
file, since all of it draws from one generator in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from attrs import evolve, frozen
import numpy as np
from numpy.random import Generator

from sonar_imm.acoustics.localisation import Localisation, localise
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.gauss_markov import gauss_markov
from sonar_imm.measurements import Arrivals, Fix
from sonar_imm.parameters import parameter
from sonar_imm.truth import Received, Scene, TrueTrack

from ..scenario import delay_ns, Scenario, Scenarios, stamps_of
from . import fixes as located

MOTIONS = ('legs', 'straight', 'circle', 'zigzag', 'stop_and_go', 'still', 'crossing')
SENSORS = ('polar', 'positions', 'multistatic_fixes', 'arrivals', 'scans', 'geodetic', 'usbl')

TRANSMITTER = np.array([0.0, 0.0, 0.0])
RECEIVERS = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
"""One transmitter that also listens, and three receivers, metres."""
LATE_DELAY = 3.0
"""Seconds, the largest delay of a scan that is received late."""


@frozen(kw_only=True)
class DiverScenario(Scenario):
    """Parameters of a diver scene; the defaults are Table 1 of the paper."""

    # fmt: off
    motion: str = parameter('legs', '', 'how the divers move', choices=MOTIONS)
    speed: float = parameter(1.0, 'm/s', 'swimming speed of the divers', range=(0.0, 10.0))
    start: tuple[float, ...] = parameter((-40.0, 40.0), 'm', 'first position of the first diver')
    heading_deg: float = parameter(0.0, 'deg', 'general heading, counter-clockwise from +x')
    random_rotation: bool = parameter(False, '',
        'turn the scene, start and heading, about the sonar by an angle drawn at random')
    turn_deg: float = parameter(85.0, 'deg',
        'largest angle between a leg and the general heading', range=(0.0, 180.0))
    leg_min: float = parameter(7.0, 's', 'duration of the shortest leg', range=(0.1, None))
    leg_max: float = parameter(15.0, 's', 'duration of the longest leg', range=(0.1, None))
    duration: float = parameter(100.0, 's', 'length of the scene', range=(1.0, 1e6))
    step: float = parameter(1.0, 's', 'time between scans', range=(1e-3, 1e4))
    step_jitter: float = parameter(0.0, '',
        'share of a step by which scan times vary, uniformly', range=(0.0, 0.9))
    divers: int = parameter(1, '', 'number of divers', range=(1, 2000))
    spacing: float = parameter(15.0, 'm',
        'distance between the starts of several divers', range=(0.0, None))
    sensor: str = parameter('polar', '', 'what sees the divers', choices=SENSORS)
    range_std: float = parameter(0.1, 'm',
        'standard deviation of ranges of the sensors polar and usbl', range=(1e-6, None))
    bearing_std_deg: float = parameter(2.0, 'deg',
        'standard deviation of bearings of the sensors polar and usbl', range=(1e-6, None))
    toa_std: float = parameter(2e-4, 's',
        'standard deviation of arrival times of the multistatic sonar', range=(1e-9, None))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound in the water', range=(1300.0, 1700.0))
    detection_probability: float = parameter(1.0, '',
        'probability that a sensor sees a diver in a scan', range=(0.0, 1.0))
    outlier_probability: float = parameter(0.0, '',
        'probability that a detection is an outlier', range=(0.0, 1.0))
    depth: tuple[float, ...] = parameter((0.0, 0.0), 'm',
        'least and greatest depth of divers, drawn between')
    swell_height: float = parameter(0.0, 'm',
        'amplitude with which a diver moves up and down in the swell', range=(0.0, 20.0))
    swell_period: float = parameter(60.0, 's', 'period of the swell', range=(0.1, None))
    receiver_depths: tuple[float, ...] = parameter((0.0, 0.0, 0.0, 0.0), 'm',
        'depths of the four receivers; the transmitter is at the first')
    depth_std: float = parameter(0.0, 'm',
        "standard deviation of the diver's own depth report, beside arrivals; 0: no report",
        range=(0.0, None))
    receiver_position_std: float = parameter(0.0, 'm',
        'standard deviation on each axis of the error of the stated positions of receivers, '
        'except the first', range=(0.0, None))
    receiver_clock_std: float = parameter(0.0, 's',
        'standard deviation of the errors of the clocks of the receivers', range=(0.0, None))
    sound_speed_std: float = parameter(0.0, 'm/s',
        'standard deviation of the error of the stated sound speed', range=(0.0, None))
    bearing_bias_std_deg: float = parameter(0.0, 'deg',
        'standard deviation of the error of all bearings of the sensors polar and usbl, drawn '
        'once', range=(0.0, 45.0))
    fix_std: float = parameter(1.0, 'm',
        'standard deviation on each axis of the white error of the sensors positions, scans and '
        'geodetic', range=(1e-6, None))
    fix_height_std: float = parameter(0.0, 'm',
        'standard deviation of the height of a fix of the sensor positions, stated then; 0: '
        'no height is', range=(0.0, None))
    fix_bias_std: float = parameter(0.0, 'm',
        'standard deviation on each axis of the lasting error of the sensor positions',
        range=(0.0, None))
    fix_bias_time: float = parameter(60.0, 's',
        'time over which the lasting error of the sensor positions (fix_bias_std) is correlated',
        range=(1e-3, None))
    clutter: float = parameter(0.0, '',
        'mean number of false detections in a scan', range=(0.0, 1e4))
    clutter_range: float = parameter(100.0, 'm',
        'half width of the square in which false detections fall', range=(1.0, None))
    late_fraction: float = parameter(0.0, '', 'share of scans received late', range=(0.0, 1.0))
    # fmt: on

    def check(self) -> list[str]:
        problems = []
        if len(self.start) != 2:
            problems.append('start needs two values, x and y')
        if len(self.depth) != 2 or self.depth[0] > self.depth[1]:
            problems.append('depth needs two values, the least and the greatest')
        if len(self.receiver_depths) != len(RECEIVERS):
            problems.append(f'receiver_depths needs {len(RECEIVERS)} values')
        if self.leg_min > self.leg_max:
            problems.append('leg_min cannot exceed leg_max')
        return problems

    def instruments(self) -> dict[str, Any]:
        if self.sensor in ('geodetic', 'usbl'):
            return located.instruments_of_places(self)
        if self.sensor == 'scans':
            return located.instruments_of_scans(self)
        return super().instruments()


MULTISTATIC = {
    'sensor': 'arrivals', 'speed': 0.75, 'detection_probability': 0.7, 'outlier_probability': 0.02,
    'random_rotation': True,
}  # fmt: skip

# fmt: off
SCENARIOS: Scenarios = {
    'table1': ('zigzag legs at 1 m/s, polar sonar: Table 1 of the paper', {}),
    'random_heading': ('table1 turned about the sonar by a random angle: no heading is a model',
        {'random_rotation': True}),
    'legs_slow': ('table1 at 0.5 m/s', {'speed': 0.5}),
    'straight': ('a straight cruise, turned at random',
        {'motion': 'straight', 'random_rotation': True}),
    'circle': ('a circle once every 80 s at 0.75 m/s', {'motion': 'circle', 'speed': 0.75}),
    'zigzag': ('60 degrees to either side in turn, every 10 s',
        {'motion': 'zigzag', 'turn_deg': 60.0, 'leg_min': 10.0, 'leg_max': 10.0, 'speed': 0.75,
         'random_rotation': True}),
    'stop_and_go': ('legs with rests between',
        {'motion': 'stop_and_go', 'speed': 0.75, 'random_rotation': True}),
    'still': ('a diver that does not move', {'motion': 'still'}),
    'irregular': ('table1, irregular scans, a quarter of them late',
        {'step_jitter': 0.4, 'late_fraction': 0.25, 'detection_probability': 0.9}),
    'multistatic': ('raw arrival times at four receivers, some missing, some outliers',
        MULTISTATIC),
    'multistatic_fixes': ('fixes computed ping by ping from four receivers',
        {'sensor': 'multistatic_fixes', 'speed': 0.75, 'random_rotation': True}),
    'at_depth': ('raw arrivals of a diver somewhere in 20 m of water, up and down with the swell',
        {**MULTISTATIC, 'depth': (1.0, 19.0), 'swell_height': 1.0,
         'receiver_depths': (2.0, 5.0, 8.0, 12.0)}),
    'misplaced_receivers': ('raw arrivals at receivers a metre off, with clocks and sound speed '
        'wrong too',
        {**MULTISTATIC, 'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4,
         'sound_speed_std': 5.0}),
    'lasting_errors': ('fixes whose errors last for a minute, as those of a filtered position '
        'source',
        {'sensor': 'positions', 'speed': 0.75, 'random_rotation': True, 'duration': 299.0,
         'fix_std': 0.5, 'fix_bias_std': 1.0}),
    'several': ('four divers, missed detections and clutter',
        {'divers': 4, 'detection_probability': 0.9, 'clutter': 2.0, 'random_rotation': True,
         'speed': 0.75}),
    'crossing': ('two pairs of divers that cross within a metre, scans of fixes in clutter',
        {'motion': 'crossing', 'sensor': 'scans', 'divers': 4, 'duration': 119.0,
         'detection_probability': 0.9, 'fix_std': 0.7, 'clutter': 10.0, 'clutter_range': 80.0}),
    'usbl': ('divers with transponders, located from a vessel that circles them',
        {'sensor': 'usbl', 'divers': 2, 'speed': 0.75, 'start': (0.0, 0.0),
         'depth': (5.0, 15.0)}),
    'geodetic': ('fixes in latitude and longitude',
        {'sensor': 'geodetic', 'speed': 0.75, 'random_rotation': True}),
}
# fmt: on

scenario = DiverScenario.among(SCENARIOS)


def simulate(config: DiverScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, config.duration + 0.5 * config.step, config.step)
    jitter = 0.5 * config.step_jitter * config.step
    times[1:] += rng.uniform(-jitter, jitter, len(times) - 1)
    stamps = stamps_of(times)
    turn = rng.uniform(0.0, 2.0 * np.pi) if config.random_rotation else 0.0
    if config.motion == 'crossing':
        paths = located.crossing_paths(config.divers, times, rng)
    else:
        paths = [_path(config, times, diver, turn, rng) for diver in range(config.divers)]
    errors = draw_errors(config, times, np.random.default_rng([seed, 1]))
    truth = tuple(
        TrueTrack(number, stamps, np.column_stack([state[:, :2], height]), state[:, 2:])
        for number, (state, height) in enumerate(zip(paths, errors.height.T), start=1)
    )
    received = []
    for k, stamp in enumerate(stamps):
        present = np.array([track.position[k] for track in truth])
        when = int(stamp) + delay_ns(config, LATE_DELAY, rng)
        scan = Scan(config, errors.at(k), int(stamp), present, rng)
        for measurement in SENSE[config.sensor](scan):
            received.append(Received(when, measurement, located.namespace_of(measurement)))
    received.sort(key=lambda item: item.received_ns)
    return Scene(tuple(received), truth)


def _path(
    config: DiverScenario, times: FloatArray, diver: int, turn: float, rng: Generator
) -> FloatArray:
    """State (n, 4), px py vx vy, of one diver at `times` in a scene turned by `turn` rad; the
    velocity is that of the step before."""
    general = np.deg2rad(config.heading_deg) + turn
    velocity = _velocity(config, times, general, rng)
    state = np.empty((len(times), 4))
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    # The first one at the centre of a spiral.
    spiral = np.sqrt(diver) * np.array([np.cos(2.4 * diver), np.sin(2.4 * diver)])
    start = turned @ (np.array(config.start) + config.spacing * spiral)
    moved = np.cumsum(velocity[1:] * np.diff(times)[:, None], axis=0)
    state[:, :2] = start + np.vstack([np.zeros(2), moved])
    state[:, 2:] = velocity
    return state


def _along(heading: FloatArray, speed: FloatArray | float) -> FloatArray:
    return np.column_stack([np.cos(heading), np.sin(heading)]) * np.reshape(speed, (-1, 1))


def _velocity(
    config: DiverScenario, times: FloatArray, general: float, rng: Generator
) -> FloatArray:
    """Velocity (n, 2) at each time of a diver whose general heading is `general` rad."""
    turn, motion = np.deg2rad(config.turn_deg), config.motion
    if motion == 'still':
        return np.zeros((len(times), 2))
    if motion == 'straight':
        return _along(np.full(len(times), general), config.speed)
    if motion == 'circle':
        return _along(general + 2.0 * np.pi * times / 80.0, config.speed)
    count = int(config.duration / config.leg_min) + 2
    leg = np.searchsorted(np.cumsum(rng.uniform(config.leg_min, config.leg_max, count)), times)
    if motion == 'zigzag':
        return _along(general + np.where(leg % 2, -1.0, 1.0) * turn, config.speed)
    heading = (general + rng.uniform(-turn, turn, leg[-1] + 1))[leg]
    rests = (leg % 3 == 2) & (motion == 'stop_and_go')
    return _along(heading, np.where(rests, 0.0, config.speed))


@frozen(eq=False)
class Errors:
    """height (n, divers) z of the divers at n times; misplaced (receivers, 2) m, clock
    (receivers,) s, sound_speed m/s and bearing rad of the whole scene; fix_bias (n, 2) m."""

    height: FloatArray
    misplaced: FloatArray
    clock: FloatArray
    sound_speed: float
    bearing: float
    fix_bias: FloatArray

    def at(self, k: int) -> Errors:
        """Those of time k: fix_bias (2,)."""
        return evolve(self, fix_bias=self.fix_bias[k])


class Scan(NamedTuple):
    """What a sensor is to see: the divers `present` (n, 3) at a stamp."""

    config: DiverScenario
    errors: Errors
    stamp_ns: int
    present: FloatArray
    rng: Generator

    def seen(self) -> FloatArray:
        """Places (m, 3) of those divers that are detected."""
        chance = self.rng.uniform(size=len(self.present))
        return self.present[chance < self.config.detection_probability]


def draw_errors(config: DiverScenario, times: FloatArray, rng: Generator) -> Errors:
    """What is drawn once for a scene, and the errors that last, at `times` (n,) s."""
    shallow, deep = config.depth
    depth = rng.uniform(shallow, deep, size=config.divers)
    phase = rng.uniform(0.0, 2.0 * np.pi, size=config.divers)
    swell = np.sin(2.0 * np.pi * times[:, None] / config.swell_period + phase)
    misplaced = config.receiver_position_std * rng.normal(size=(len(RECEIVERS), 2))
    misplaced[0] = 0.0
    clock = config.receiver_clock_std * rng.normal(size=len(RECEIVERS))
    sound_speed = config.sound_speed_std * rng.normal()
    bias = config.fix_bias_std * rng.normal(size=(len(times), 2))
    for k, dt in enumerate(np.diff(times), start=1):
        # bias[k] was drawn with the standard deviation for ever
        fade, _ = gauss_markov(config.fix_bias_std, config.fix_bias_time, dt)
        bias[k] = fade * bias[k - 1] + np.sqrt(1.0 - fade**2) * bias[k]
    height = -depth - config.swell_height * swell
    bearing = np.radians(config.bearing_bias_std_deg) * rng.normal()
    return Errors(height, misplaced, clock, float(sound_speed), float(bearing), bias)


def _sense_polar(scan: Scan) -> list[Fix]:
    """Range and bearing from the origin, converted without bias; clutter uniform in the square."""
    config, rng = scan.config, scan.rng
    seen = scan.seen()[:, :2]
    outlier = rng.uniform(size=len(seen)) < config.outlier_probability
    false = rng.poisson(config.clutter)
    half = config.clutter_range
    points = np.vstack(
        [
            np.where(outlier[:, None], rng.uniform(-half, half, seen.shape), seen),
            rng.uniform(-half, half, (false, 2)),
        ]
    )
    bearing_std = np.deg2rad(config.bearing_std_deg)
    ranges = np.hypot(*points.T) + config.range_std * rng.normal(size=len(points))
    bearings = np.arctan2(points[:, 1], points[:, 0]) + bearing_std * rng.normal(size=len(points))
    bearings += scan.errors.bearing
    z, R = unbiased_polar_to_cartesian(ranges, bearings, config.range_std**2, bearing_std**2)
    return [_fix(scan, place, covariance) for place, covariance in zip(z, R)]


def _fix(scan: Scan, place: FloatArray, covariance: FloatArray, height: float = 0.0) -> Fix:
    position = np.append(place, height)
    return Fix(stamp_ns=scan.stamp_ns, position=position, covariance=covariance, frame_id='map')


def _sense_arrivals(scan: Scan) -> list[Arrivals]:
    config, errors, present = scan.config, scan.errors, scan.present
    receivers = RECEIVERS - np.outer(config.receiver_depths, [0.0, 0.0, 1.0])
    tx = receivers[0]
    pairs = [
        (receiver, path)
        for receiver, rx in enumerate(receivers)
        for path in _paths(scan, tx, rx, errors.misplaced[receiver])
    ]
    if not pairs:
        return []
    receiver = np.array([number for number, _ in pairs])
    toa = np.array([path for _, path in pairs]) / (config.sound_speed + errors.sound_speed)
    toa = toa + errors.clock[receiver]
    n = len(pairs)
    nothing = np.full(n, np.nan)
    depth = nothing
    if config.depth_std and len(present) == 1:
        depth = np.full(n, -present[0, 2] + config.depth_std * scan.rng.normal())
    return [
        Arrivals(
            stamp_ns=scan.stamp_ns,
            tx_id=np.zeros(n),
            rx_id=receiver,
            tx=np.tile(tx, (n, 1)),
            rx=receivers[receiver],
            toa=toa,
            var_toa=np.full(n, config.toa_std**2),
            bearing=nothing,
            var_bearing=nothing,
            depth=depth,
            var_depth=np.full(n, config.depth_std**2),
            frame_id='map',
        )
    ]


def _paths(scan: Scan, tx: FloatArray, rx: FloatArray, misplaced: FloatArray) -> FloatArray:
    """Path lengths heard at one receiver, said to be at `rx` (3,) but `misplaced` (2,), metres:
    divers, some of them late by a reflection, and clutter."""
    config, present, rng = scan.config, scan.present, scan.rng
    there = rx + np.append(misplaced, 0.0)
    path = np.linalg.norm(present - tx, axis=1) + np.linalg.norm(present - there, axis=1)
    path = path[rng.uniform(size=len(path)) < config.detection_probability]
    path = path + config.sound_speed * config.toa_std * rng.normal(size=len(path))
    outlier = rng.uniform(size=len(path)) < config.outlier_probability
    path = path + outlier * rng.uniform(5.0, 50.0, len(path))
    direct = float(np.linalg.norm(rx - tx))
    false = rng.uniform(direct, direct + 2.0 * config.clutter_range, rng.poisson(config.clutter))
    return np.concatenate([path, false])


def _sense_positions(scan: Scan) -> list[Fix]:
    """Positions with a white and a lasting error; the covariance states the white one."""
    config, rng, seen = scan.config, scan.rng, scan.seen()
    places = seen[:, :2] + scan.errors.fix_bias + config.fix_std * rng.normal(size=(len(seen), 2))
    heights, variances = np.zeros(len(seen)), [config.fix_std**2] * 2
    if config.fix_height_std:
        heights = seen[:, 2] + config.fix_height_std * rng.normal(size=len(seen))
        variances.append(config.fix_height_std**2)
    white = np.diag(variances)
    return [_fix(scan, place, white, height) for place, height in zip(places, heights)]


def _sense_multistatic_fixes(scan: Scan) -> list[Fix]:
    """One fix per ping and diver, from its own echoes; none where the geometry gives none."""
    fixes, speed = [], scan.config.sound_speed
    for position in scan.present:
        for ping in _sense_arrivals(scan._replace(present=position[None])):
            fix = localise(ping.rx, ping.toa, ping.var_toa, tx=ping.tx, sound_speed=speed)
            if isinstance(fix, Localisation):
                fixes.append(_fix(scan, fix.position, fix.covariance))
    return fixes


SENSE: dict[str, Callable[..., Iterable[Any]]] = {
    'polar': _sense_polar,
    'positions': _sense_positions,
    'arrivals': _sense_arrivals,
    'multistatic_fixes': _sense_multistatic_fixes,
    'geodetic': located.sense_geodetic,
    'usbl': located.sense_from_vessel,
    'scans': located.sense_scan,
}
