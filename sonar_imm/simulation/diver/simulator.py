"""Swimming divers, observed by a polar or a multistatic sonar.

A scenario (`SCENARIOS`) is a named choice of `motion`, how the divers move, and `sensor`, how they
are observed. The paper's Table 1 gives start, speed, sampling and accuracy, but not the path. In
`table1` the diver swims legs of 7 to 15 s whose headings lie within 85 degrees of a general
heading ("zigzag with general consistent direction" in the paper).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import frozen
import numpy as np

from ...acoustics import multistatic
from ...acoustics.localisation import Localisation, localise
from ...acoustics.polar import unbiased_polar_to_cartesian
from ...estimation.arrays import FloatArray
from ...measurements import Arrivals, Fix
from ...parameters import parameter
from ..scene import Received, Scenario, Scene, TrueTrack
from .crossing import CROSSING, crossing_paths, sense_scan, told_of_scans

MOTIONS = ('legs', 'straight', 'circle', 'zigzag', 'stop_and_go', 'still', 'crossing')
SENSORS = ('polar', 'multistatic_fixes', 'arrivals', 'scans')

TRANSMITTER = np.array([0.0, 0.0, 0.0])
RECEIVERS = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
"""One transmitter that also listens, and three receivers, metres."""

FIRST_STAMP_NS = 1_700_000_000_000_000_000


@frozen(kw_only=True)
class DiverScenario(Scenario):
    """Parameters of a diver scene; the defaults are Table 1 of the paper."""

    motion: str = parameter('legs', 'how the diver moves', choices=MOTIONS)
    speed: float = parameter(1.0, 'swimming speed', unit='m/s', low=0.0, high=10.0)
    start: tuple[float, ...] = parameter(
        (-40.0, 40.0), 'first position of the first diver', unit='m'
    )
    heading_deg: float = parameter(0.0, 'general heading, counter-clockwise from +x', unit='deg')
    random_rotation: bool = parameter(
        False, 'turn the scene, start and heading, about the sonar by an angle drawn at random'
    )
    turn_deg: float = parameter(
        85.0, 'legs head within this of the general heading', unit='deg', low=0.0, high=180.0
    )
    leg_min: float = parameter(7.0, 'shortest leg', unit='s', low=0.1)
    leg_max: float = parameter(15.0, 'longest leg', unit='s', low=0.1)
    duration: float = parameter(100.0, 'length of the scene', unit='s', low=1.0, high=1e6)
    step: float = parameter(1.0, 'time between scans', unit='s', low=1e-3, high=1e4)
    step_jitter: float = parameter(
        0.0, 'scan times vary uniformly by this much of a step', low=0.0, high=0.9
    )
    divers: int = parameter(1, 'number of divers', low=1, high=2000)
    spacing: float = parameter(
        15.0, 'distance between the starts of several divers', unit='m', low=0.0
    )
    sensor: str = parameter('polar', 'what sees the divers', choices=SENSORS)
    range_std: float = parameter(0.1, 'range error of the polar sonar', unit='m', low=1e-6)
    bearing_std_deg: float = parameter(
        2.0, 'bearing error of the polar sonar', unit='deg', low=1e-6
    )
    fix_std: float = parameter(0.7, 'error on each axis of the fixes of scans', unit='m', low=1e-6)
    toa_std: float = parameter(
        2e-4, 'arrival-time error of the multistatic sonar', unit='s', low=1e-9
    )
    sound_speed: float = parameter(1500.0, 'speed of sound', unit='m/s', low=1300.0, high=1700.0)
    detection_probability: float = parameter(
        1.0, 'that a sensor sees a diver in a scan', low=0.0, high=1.0
    )
    outlier_probability: float = parameter(
        0.0, 'that a detection is an outlier', low=0.0, high=1.0
    )
    clutter: float = parameter(0.0, 'false detections in a scan, on average', low=0.0, high=1e4)
    clutter_range: float = parameter(
        100.0, 'half width of the square they fall in', unit='m', low=1.0
    )
    late_fraction: float = parameter(0.0, 'share of scans received late', low=0.0, high=1.0)
    late_delay: float = parameter(3.0, 'most they are late by', unit='s', low=0.0)

    def check(self) -> list[str]:
        problems = []
        if len(self.start) != 2:
            problems.append('start needs two values, x and y')
        if self.leg_min > self.leg_max:
            problems.append('leg_min cannot exceed leg_max')
        return problems

    def told(self) -> dict[str, Any]:
        return told_of_scans(self) if self.sensor == 'scans' else {}


SCENARIOS: dict[str, tuple[str, dict[str, Any]]] = {
    'table1': ('zigzag legs at 1 m/s, polar sonar: Table 1 of the paper', {}),
    'random_heading': (
        'table1 turned about the sonar by a random angle: no heading is a model',
        {'random_rotation': True},
    ),
    'legs_slow': ('table1 at 0.5 m/s', {'speed': 0.5}),
    'straight': (
        'a straight cruise, turned at random',
        {'motion': 'straight', 'random_rotation': True},
    ),
    'circle': ('a circle once every 80 s at 0.75 m/s', {'motion': 'circle', 'speed': 0.75}),
    'zigzag': (
        '60 degrees to either side in turn, every 10 s',
        {
            'motion': 'zigzag',
            'turn_deg': 60.0,
            'leg_min': 10.0,
            'leg_max': 10.0,
            'speed': 0.75,
            'random_rotation': True,
        },
    ),
    'stop_and_go': (
        'legs with rests between',
        {'motion': 'stop_and_go', 'speed': 0.75, 'random_rotation': True},
    ),
    'still': ('a diver that does not move', {'motion': 'still'}),
    'irregular': (
        'table1, irregular scans, a quarter of them late',
        {'step_jitter': 0.4, 'late_fraction': 0.25, 'detection_probability': 0.9},
    ),
    'multistatic': (
        'raw arrival times at four receivers, some missing, some outliers',
        {
            'sensor': 'arrivals',
            'speed': 0.75,
            'detection_probability': 0.7,
            'outlier_probability': 0.02,
            'random_rotation': True,
        },
    ),
    'multistatic_fixes': (
        'fixes computed ping by ping from four receivers',
        {'sensor': 'multistatic_fixes', 'speed': 0.75, 'random_rotation': True},
    ),
    'several': (
        'four divers, missed detections and clutter',
        {
            'divers': 4,
            'detection_probability': 0.9,
            'clutter': 2.0,
            'random_rotation': True,
            'speed': 0.75,
        },
    ),
    'crossing': CROSSING,
}
"""Name: (what it is, what differs from the defaults of `DiverScenario`)."""


def scenario(name: str, overrides: Mapping[str, Any] | None = None) -> DiverScenario:
    """The scenario `name` with some values replaced. Raises `ConfigError` naming mistakes."""
    return DiverScenario.named(name, SCENARIOS, overrides)


def simulate(config: DiverScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene."""
    rng = np.random.default_rng(seed)
    times = _scan_times(config, rng)
    stamps = FIRST_STAMP_NS + np.round(times * 1e9).astype(np.int64)
    turn = rng.uniform(0.0, 2.0 * np.pi) if config.random_rotation else 0.0
    if config.motion == 'crossing':
        paths = crossing_paths(config.divers, times, rng)
    else:
        paths = [_path(config, times, diver, turn, rng) for diver in range(config.divers)]
    truth = tuple(
        TrueTrack(
            number, stamps, np.column_stack([state[:, :2], np.zeros(len(times))]), state[:, 2:]
        )
        for number, state in enumerate(paths, start=1)
    )
    received = []
    for k, stamp in enumerate(stamps):
        present = np.array([state[k, :2] for state in paths])
        delay = config.late_delay * rng.uniform() if rng.uniform() < config.late_fraction else 0.0
        for measurement in _SENSE[config.sensor](config, int(stamp), present, rng):
            received.append(Received(int(stamp) + round(delay * 1e9), measurement))
    received.sort(key=lambda one: one.received_ns)
    return Scene(tuple(received), truth)


def _scan_times(config: DiverScenario, rng: np.random.Generator) -> FloatArray:
    times = np.arange(0.0, config.duration + 0.5 * config.step, config.step)
    jitter = 0.5 * config.step_jitter * config.step
    times[1:] += rng.uniform(-jitter, jitter, len(times) - 1)
    return times


def _path(
    config: DiverScenario, times: FloatArray, diver: int, turn: float, rng: np.random.Generator
) -> FloatArray:
    """State (n, 4), px py vx vy, of one diver at `times` in a scene turned by `turn` rad; the
    velocity is that of the step before."""
    general = np.deg2rad(config.heading_deg) + turn
    velocity = _VELOCITY[config.motion](config, times, general, rng)
    state = np.empty((len(times), 4))
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    start = turned @ (np.array(config.start) + config.spacing * _spiral(diver))
    moved = np.cumsum(velocity[1:] * np.diff(times)[:, None], axis=0)
    state[:, :2] = start + np.vstack([np.zeros(2), moved])
    state[:, 2:] = velocity
    return state


def _spiral(diver: int) -> FloatArray:
    """Where diver number `diver` starts, in units of the spacing: the first at the centre."""
    return np.sqrt(diver) * np.array([np.cos(2.4 * diver), np.sin(2.4 * diver)])


def _along(heading: FloatArray, speed: FloatArray | float) -> FloatArray:
    return np.column_stack([np.cos(heading), np.sin(heading)]) * np.reshape(speed, (-1, 1))


def _leg_numbers(config: DiverScenario, times: FloatArray, rng: np.random.Generator) -> np.ndarray:
    """Which leg (n,) each time falls in."""
    ends = np.cumsum(
        rng.uniform(config.leg_min, config.leg_max, int(config.duration / config.leg_min) + 2)
    )
    return np.searchsorted(ends, times)


def _legs(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    leg = _leg_numbers(config, times, rng)
    turn = np.deg2rad(config.turn_deg)
    return _along((general + rng.uniform(-turn, turn, leg[-1] + 1))[leg], config.speed)


def _straight(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    return _along(np.full(len(times), general), config.speed)


def _circle(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    return _along(general + 2.0 * np.pi * times / 80.0, config.speed)


def _zigzag(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    side = np.where(_leg_numbers(config, times, rng) % 2, -1.0, 1.0)
    return _along(general + side * np.deg2rad(config.turn_deg), config.speed)


def _stop_and_go(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    leg = _leg_numbers(config, times, rng)
    turn = np.deg2rad(config.turn_deg)
    heading = (general + rng.uniform(-turn, turn, leg[-1] + 1))[leg]
    return _along(heading, np.where(leg % 3 == 2, 0.0, config.speed))


def _still(
    config: DiverScenario, times: FloatArray, general: float, rng: np.random.Generator
) -> FloatArray:
    return np.zeros((len(times), 2))


def _sense_polar(
    config: DiverScenario, stamp_ns: int, present: FloatArray, rng: np.random.Generator
) -> list[Fix]:
    """Range and bearing from the origin, converted without bias; clutter uniform in the square."""
    seen = present[rng.uniform(size=len(present)) < config.detection_probability]
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
    z, R = unbiased_polar_to_cartesian(ranges, bearings, config.range_std**2, bearing_std**2)
    return [
        Fix(
            stamp_ns=stamp_ns,
            position=np.append(position, 0.0),
            covariance=covariance,
            frame_id='map',
        )
        for position, covariance in zip(z, R)
    ]


def _sense_arrivals(
    config: DiverScenario, stamp_ns: int, present: FloatArray, rng: np.random.Generator
) -> list[Arrivals]:
    """Echoes of one ping at every receiver."""
    pairs = [
        (receiver, path)
        for receiver, rx in enumerate(RECEIVERS)
        for path in _paths(config, rx, present, rng)
    ]
    if not pairs:
        return []
    receiver = np.array([one for one, _ in pairs])
    toa = np.array([path for _, path in pairs]) / config.sound_speed
    n = len(pairs)
    nothing = np.full(n, np.nan)
    return [
        Arrivals(
            stamp_ns=stamp_ns,
            tx_id=np.zeros(n),
            rx_id=receiver,
            tx=np.tile(TRANSMITTER, (n, 1)),
            rx=RECEIVERS[receiver],
            toa=toa,
            var_toa=np.full(n, config.toa_std**2),
            bearing=nothing,
            var_bearing=nothing,
            frame_id='map',
        )
    ]


def _paths(
    config: DiverScenario, rx: FloatArray, present: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Path lengths, m, received at one receiver: divers, some late by a reflection, and
    clutter."""
    path = multistatic.range_sum(present, TRANSMITTER[None], rx[None], 0.0)[:, 0]
    path = path[rng.uniform(size=len(path)) < config.detection_probability]
    path = path + config.sound_speed * config.toa_std * rng.normal(size=len(path))
    outlier = rng.uniform(size=len(path)) < config.outlier_probability
    path = path + outlier * rng.uniform(5.0, 50.0, len(path))
    direct = float(np.linalg.norm(rx - TRANSMITTER))
    false = rng.uniform(direct, direct + 2.0 * config.clutter_range, rng.poisson(config.clutter))
    return np.concatenate([path, false])


def _sense_multistatic_fixes(
    config: DiverScenario, stamp_ns: int, present: FloatArray, rng: np.random.Generator
) -> list[Fix]:
    """One fix per ping and diver, from its own echoes; none where the geometry gives none."""
    fixes = []
    for position in present:
        for ping in _sense_arrivals(config, stamp_ns, position[None], rng):
            fix = localise(
                ping.rx, ping.toa, ping.var_toa, tx=ping.tx, sound_speed=config.sound_speed
            )
            if isinstance(fix, Localisation):
                fixes.append(
                    Fix(
                        stamp_ns=stamp_ns,
                        position=np.append(fix.position, 0.0),
                        covariance=fix.covariance,
                        frame_id='map',
                    )
                )
    return fixes


_VELOCITY = {
    'legs': _legs,
    'straight': _straight,
    'circle': _circle,
    'zigzag': _zigzag,
    'stop_and_go': _stop_and_go,
    'still': _still,
}
_SENSE = {
    'polar': _sense_polar,
    'arrivals': _sense_arrivals,
    'multistatic_fixes': _sense_multistatic_fixes,
    'scans': sense_scan,
}
