# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An AUV that approaches obstacles and detects them with a forward-looking sonar.

The vehicle is like Daurade, the sonar like a Blueview P450: 1.5 m/s along a straight course, a
little roll, pitch, yaw and heave as in swell, two pings per second into a sector of 45 by 15
degrees. Navigation is dead reckoning at 10 Hz from a Doppler log with a scale
error and a bias, and from an attitude sensor with a bias. Obstacles are given by their vertical
offset from the sonar, or as spheres on tethers, objects on the sea floor or floats at the surface.

Measurements are in ROS axes, ENU and FLU; inside, all is NED and FRD as in the papers.
In one file, since all of it draws from one generator in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from attrs import frozen
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Altitude, Detections, nanoseconds, Navigation
from sonar_imm.truth import Received, Scene, TruthTable

from ..scenario import delay_ns, FIRST_STAMP_NS, lasting, stamps_of
from .images import image_pings
from .scenario import LATE_DELAY, ObstacleScenario, scenario, SCENARIOS

ROLL_PERIOD, PITCH_PERIOD, YAW_PERIOD, HEAVE_PERIOD = 6.0, 8.0, 11.0, 20.0
"""Seconds, of the vehicle."""
OUTLIER = np.array([8.0, np.radians(6.0)])
"""Largest error of an outlier in range, m, and bearing, rad."""
_SWAY_STEP, SWING_PERIOD = 0.1, 15.0
WAVES = 3
"""Sinusoids that make up a swing, with periods of 0.75 to 1.3 times the stated one: narrow-band,
as swell is. The study that docs/obstacle.md compares with has such swings."""
_AHEAD = np.radians(12.0)
"""A mover comes from within this of the course on either side, so that a sonar can see it."""


class Swing:
    """A random narrow-band oscillation: `value` at any time (n,)."""

    def __init__(self, rms: float, period: float, rng: Generator):
        self.rate = 2.0 * np.pi / (period * rng.uniform(0.75, 1.3, WAVES))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)
        share = rng.uniform(0.6, 1.0, WAVES)
        self.amplitude = rms * np.sqrt(2.0 / np.sum(share**2)) * share

    def __call__(self, t: FloatArray) -> FloatArray:
        return np.sin(np.multiply.outer(t, self.rate) + self.phase) @ self.amplitude


@frozen(eq=False)
class Path:
    """place: (3,) NED at time `meets`; speed: (2,) m/s north and east, from the time `starts` to
    `stops`; sway: displacements north and east (n, 2) at times (n,)."""

    place: FloatArray
    meets: float = 0.0
    speed: FloatArray | None = None
    sway: Callable[[FloatArray], FloatArray] | None = None
    starts: float = -np.inf
    stops: float = np.inf

    def moves(self, t: FloatArray) -> np.ndarray:
        """Whether it moves at the times t (n,)."""
        return (self.speed is not None) & (t >= self.starts) & (t < self.stops)

    def at(self, t: FloatArray) -> FloatArray:
        """(n, 3) NED at the times t (n,), s."""
        where = np.tile(self.place, (len(t), 1))
        if self.speed is not None:
            active = np.clip(t, self.starts, self.stops)
            active = active - np.clip(self.meets, self.starts, self.stops)
            where[:, :2] += active[:, None] * self.speed
        if self.sway is not None:
            where[:, :2] += self.sway(t)
        return where

    def velocity(self, t: FloatArray) -> FloatArray:
        """(n, 3) m/s, NED, of what moves; 0 of what stays where it is on average."""
        steady = np.zeros((len(t), 3))
        if self.speed is not None:
            steady[self.moves(t), :2] = self.speed
        return steady


def paths(
    config: ObstacleScenario, places: list[FloatArray], course: float, seed: int
) -> list[Path]:
    """The way of each obstacle; `places` (3,) is where one would be that stays. A mover is there
    when the vehicle would come abeam of one that stays, so that it is passed as closely."""
    rng = np.random.default_rng([seed, 1])  # scenes whose obstacles stay keep their numbers
    return [_path(config, place, course, rng) for place in places]


def _path(config: ObstacleScenario, place: FloatArray, course: float, rng: Generator) -> Path:
    if config.obstacle_motion == 'swaying':
        off = _sway(config, rng)
        clock = _SWAY_STEP * np.arange(len(off))
        return Path(place, sway=lambda t: np.stack([np.interp(t, clock, x) for x in off.T], -1))
    if config.obstacle_motion == 'swinging':
        swings = [Swing(config.obstacle_sway, SWING_PERIOD, rng) for _ in range(2)]
        return Path(place, sway=lambda t: np.column_stack([swing(t) for swing in swings]))
    if config.obstacle_motion == 'moving':
        ahead = np.array([np.cos(course), np.sin(course)])
        return Path(
            place,
            meets=float(place[:2] @ ahead) / config.speed,
            speed=_speed(config, course, rng),
            starts=config.obstacle_starts,
            stops=config.obstacle_stops,
        )
    return Path(place)


def _sway(config: ObstacleScenario, rng: Generator) -> FloatArray:
    """An Ornstein-Uhlenbeck process (n, 2) of the given deviation and memory."""
    duration = (config.first_range - config.last_range) / config.speed + 2.0
    white = rng.normal(size=(int(duration / _SWAY_STEP) + 2, 2))
    return config.obstacle_sway * lasting(white, np.exp(-_SWAY_STEP / config.obstacle_sway_time))


def _speed(config: ObstacleScenario, course: float, rng: Generator) -> FloatArray:
    """North and east velocity: any heading that keeps the obstacle before the sonar."""
    low, high = config.obstacle_speed
    size = rng.uniform(low, high)
    own = config.speed * np.array([np.cos(course), np.sin(course)])
    across = np.array([-np.sin(course), np.cos(course)])
    for _ in range(1000):
        heading = rng.uniform(-np.pi, np.pi)
        v = size * np.array([np.cos(heading), np.sin(heading)])
        closing = own - v
        forward, sideways = closing @ own / config.speed, closing @ across
        if forward > 0.3 * config.speed and abs(np.arctan2(sideways, forward)) < _AHEAD:
            return v
    return -size * own / config.speed


__all__ = ['ObstacleScenario', 'SCENARIOS', 'TrueObstacle', 'scenario', 'simulate']

DOES = ('fixed', 'swaying', 'moving', 'seabed')
LEAD_IN = 1.0
"""Seconds of navigation before the first ping and after the last."""
_FINE = 0.02
"""Seconds to either side for numerical derivatives."""


@frozen(eq=False)
class TrueObstacle:
    """True position of one obstacle relative to the sonar at each ping.

    stamp_ns (n,); position (n, 3) and velocity (n, 2) m/s, ENU, the latter of what moves and 0 of
    what sways; does (n,): which of `DOES`; range m, bearing rad (to port), vertical_offset m
    (below), in the sonar's frame, each (n,); in_beam (n,) True where a ping can show it.
    """

    track_id: int
    stamp_ns: np.ndarray
    position: FloatArray
    range: FloatArray
    bearing: FloatArray
    vertical_offset: FloatArray
    in_beam: np.ndarray
    velocity: FloatArray
    does: np.ndarray

    def tables(self, frame_id: str) -> Iterator[TruthTable]:
        """Give one row per ping: ``x y z range bearing vertical_offset in_beam track_id vx vy``
        and ``prob_<behaviour>``, 1 for what it does and 0 else."""
        columns = {
            **dict(zip('xyz', self.position.astype(np.float32).T)),
            'range': self.range,
            'bearing': self.bearing,
            'vertical_offset': self.vertical_offset,
            'in_beam': self.in_beam,
            'track_id': np.full(len(self.range), self.track_id, np.uint32),
            'vx': self.velocity[:, 0],
            'vy': self.velocity[:, 1],
        }
        columns |= {f'prob_{name}': 1.0 * (self.does == k) for k, name in enumerate(DOES)}
        for k, stamp in enumerate(self.stamp_ns):
            row = {name: column[k : k + 1] for name, column in columns.items()}
            yield TruthTable(int(stamp), frame_id, row)


def simulate(config: ObstacleScenario, seed: int) -> Scene:
    """Run a scene. The same config and seed give the same scene; `truth` holds `TrueObstacle`."""
    rng = np.random.default_rng(seed)
    vehicle = _Vehicle(config, rng)
    # Until the vehicle is `last_range` from the first obstacle.
    step = 1.0 / config.ping_rate
    even = np.arange(0.0, (config.first_range - config.last_range) / config.speed, step)
    stamps = stamps_of(even + rng.uniform(-0.5, 0.5, len(even)) * config.ping_jitter * step)
    times: FloatArray = (stamps - FIRST_STAMP_NS).astype(np.float64) * 1e-9
    obstacles = paths(config, _places(config, vehicle, rng), vehicle.course, seed)
    stretch = 1.0 + config.sound_speed_error * rng.normal()
    received = _navigate(config, vehicle, rng)
    if config.images:
        places = [path.at(times) for path in obstacles]
        received += image_pings(config, vehicle.sonar(times), stamps, places, stretch, seed)
    else:
        echoes = [_echoes(config, vehicle, times, path, stretch) for path in obstacles]
        received += _pings(config, stamps, echoes, rng)
    received.sort(key=lambda item: item.received_ns)
    truth = tuple(
        _truth(config, number, path, vehicle, stamps, times)
        for number, path in enumerate(obstacles, start=1)
    )
    return Scene(tuple(received), truth)


class _Vehicle:
    """Pose of the vehicle at any time, NED and FRD."""

    def __init__(self, config: ObstacleScenario, rng: Generator):
        self.config = config
        self.course = (
            rng.uniform(-np.pi, np.pi) if config.random_course else np.radians(config.course_deg)
        )
        self.roll = Swing(np.radians(config.roll_rms_deg), ROLL_PERIOD, rng)
        self.pitch = Swing(np.radians(config.pitch_rms_deg), PITCH_PERIOD, rng)
        self.yaw = Swing(np.radians(config.yaw_rms_deg), YAW_PERIOD, rng)
        self.heave = Swing(config.heave_rms, HEAVE_PERIOD, rng)
        self.sway = Swing(config.sway_rms, config.sway_period, rng)
        self.lever = geometry.flip_body(config.sonar_lever)
        roll, pitch, yaw = np.radians(config.sonar_mount_rpy_deg)
        self.mount = geometry.rotation(roll, -pitch, -yaw)  # stated in FLU

    def angles(self, t: FloatArray) -> FloatArray:
        """Roll, pitch, yaw (..., 3)."""
        return np.stack([self.roll(t), self.pitch(t), self.course + self.yaw(t)], axis=-1)

    def position(self, t: FloatArray) -> FloatArray:
        """(..., 3) m, NED."""
        along, across = self.config.speed * t, self.sway(t)
        c, s = np.cos(self.course), np.sin(self.course)
        dive = self.config.dive * np.sin(2.0 * np.pi * t / 60.0)
        return np.stack(
            [
                along * c - across * s,
                along * s + across * c,
                self.config.depth + self.heave(t) + dive,
            ],
            axis=-1,
        )

    def pose(self, t: FloatArray) -> Pose:
        return Pose(self.position(t), geometry.rotation(*np.moveaxis(self.angles(t), -1, 0)))

    def sonar(self, t: FloatArray) -> Pose:
        return geometry.mounted(self.pose(t), self.lever, self.mount)


def _places(config: ObstacleScenario, vehicle: _Vehicle, rng: Generator) -> list[FloatArray]:
    """Positions of the obstacles, NED. The first one is `first_range` from the first ping, each
    further one `spacing` behind. The passing distance of each is drawn at random."""
    sonar = vehicle.sonar(np.zeros(()))
    c, s = np.cos(vehicle.course), np.sin(vehicle.course)
    places = []
    for number in range(config.obstacles):
        far = config.first_range + number * config.spacing
        offset = _offset(config, number, float(sonar.position[2]), rng)
        across = rng.uniform(-config.passing_distance, config.passing_distance)
        along = np.sqrt(far**2 - across**2 - offset**2)
        north, east = along * c - across * s, along * s + across * c
        places.append(sonar.position + np.array([north, east, offset]))
    return places


def _offset(config: ObstacleScenario, number: int, depth: float, rng: Generator) -> float:
    """Vertical offset of one obstacle from the sonar at the first ping, m, below positive."""
    seabed = config.depth + config.altitude
    if config.placement == 'offset':
        return config.vertical_offset + rng.uniform(-1.0, 1.0) * config.offset_spread
    if config.placement == 'tether':
        return seabed - config.tethers[number % len(config.tethers)] - depth
    return {'seabed': seabed - 0.5, 'surface': 0.5}[config.placement] - depth


def _navigate(config: ObstacleScenario, vehicle: _Vehicle, rng: Generator) -> list[Received]:
    last = (config.first_range - config.last_range) / config.speed + LEAD_IN
    t = np.arange(-LEAD_IN, last, 1.0 / config.navigation_rate)
    exact = 0.0 if config.ideal_navigation else 1.0
    bias = exact * np.radians(
        [config.attitude_bias_deg, config.attitude_bias_deg, config.yaw_bias_deg]
    )
    angles = vehicle.angles(t) + bias * rng.normal(size=3)
    angles += exact * np.radians(config.attitude_std_deg) * rng.normal(size=angles.shape)
    R = geometry.rotation(*angles.T)
    position = vehicle.position(t)
    velocity = (vehicle.position(t + _FINE) - vehicle.position(t - _FINE)) / (2.0 * _FINE)
    true_R = vehicle.pose(t).R
    log = geometry.apply(np.swapaxes(true_R, -1, -2), velocity)
    log = log * (1.0 + exact * config.log_scale_error * rng.normal())
    log = log + exact * config.log_bias * rng.normal(size=3)
    noise = config.log_noise * np.sqrt(config.navigation_rate)
    log = log + exact * noise * rng.normal(size=log.shape)
    if not config.ideal_navigation:
        over_ground = geometry.apply(R, log)
        steps = 0.5 * (over_ground[1:] + over_ground[:-1]) * np.diff(t)[:, None]
        position = position[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        position[:, 2] = vehicle.position(t)[:, 2] + config.depth_std * rng.normal(size=len(t))
    before, after = vehicle.pose(t - _FINE).R, vehicle.pose(t + _FINE).R
    turned = Rotation.from_matrix(np.swapaxes(before, -1, -2) @ after)
    turn = turned.as_rotvec() / (2.0 * _FINE)
    q = Rotation.from_matrix(geometry.flip_rotation(R)).as_quat()
    stamps = stamps_of(t + config.navigation_delay)
    gaps = np.zeros(len(t), bool)
    if config.navigation_gaps > 0.0:
        for start in rng.uniform(t[0], t[-1], rng.poisson(config.navigation_gaps)):
            gaps |= (t >= start) & (t < start + config.navigation_gap)
    received = [
        Received(
            int(stamps[k]) + nanoseconds(config.navigation_latency),
            Navigation(
                stamp_ns=int(stamps[k]),
                position=geometry.flip_world(position[k]),
                orientation=q[k],
                velocity=geometry.flip_body(log[k]),
                turn_rate=geometry.flip_body(turn[k]),
                frame_id='odom',
                child_frame_id='base_link',
            ),
        )
        for k in np.flatnonzero(~gaps)
    ]
    every = max(1, round(config.navigation_rate / 2.0))
    turns = 2.0 * np.pi * (config.speed * t)
    ripple = np.sin(turns / 37.0) + 0.6 * np.sin(turns / 13.0 + 1.0)
    seabed = config.depth + config.altitude + config.seabed_relief * ripple
    heights = seabed - vehicle.position(t)[:, 2]
    heights = heights + config.altitude_std * rng.normal(size=len(t))
    received += [
        Received(
            int(stamps[k]), Altitude(stamp_ns=int(stamps[k]), altitude=max(float(heights[k]), 0.0))
        )
        for k in range(0, len(t), every)
        if config.altimeter
    ]
    return received


def _echoes(
    config: ObstacleScenario, vehicle: _Vehicle, times: FloatArray, path: Path, stretch: float
) -> tuple[FloatArray, np.ndarray]:
    """Range, azimuth and elevation, positive down, (n, 3) of an obstacle at each ping without
    noise, and whether it is inside the beam (n,)."""
    out = geometry.to_body(vehicle.sonar(times), path.at(times))
    d, azimuth = geometry.project(out, config.azimuth_model)
    if config.ping_timing == 'two_way':
        for _ in range(3):
            arrival = times + 2.0 * d / 1500.0
            back = geometry.to_body(vehicle.sonar(arrival), path.at(times + d / 1500.0))
            d_back, azimuth = geometry.project(back, config.azimuth_model)
            d = 0.5 * (np.linalg.norm(out, axis=-1) + d_back)
    elevation = np.arcsin(np.clip(out[:, 2] / np.linalg.norm(out, axis=-1), -1.0, 1.0))
    plane = np.arctan2(out[:, 1], out[:, 0])
    inside = (
        (np.abs(elevation) <= np.radians(0.5 * config.vertical_fov_deg))
        & (np.abs(plane) <= np.radians(0.5 * config.horizontal_fov_deg))
        & (d <= config.max_range)
    )
    return np.column_stack([d * stretch, azimuth, elevation]), inside


def _pings(
    config: ObstacleScenario,
    stamps: np.ndarray,
    echoes: list[tuple[FloatArray, np.ndarray]],
    rng: Generator,
) -> list[Received]:
    """The detections of each ping: echoes that are seen, some of them outliers, and clutter."""
    half = np.radians(0.5 * config.horizontal_fov_deg)
    noise = np.array([config.range_std, np.radians(config.bearing_std_deg)])
    step = np.array([config.range_step, np.radians(config.bearing_step_deg)])

    received = []
    for k, stamp in enumerate(stamps):
        rows: list[FloatArray] = []
        up: list[float] = []
        for echo, inside in echoes:
            chance = config.detection_probability
            if profile := config.detection_profile:
                chance *= float(np.interp(echo[k, 0], profile[::2], profile[1::2]))
            seen = rng.uniform() < chance
            outlier = rng.uniform() < config.outlier_probability
            error = noise * rng.normal(size=2) + outlier * OUTLIER * rng.uniform(-1.0, 1.0, 2)
            if seen and inside[k]:
                rows.append(echo[k, :2] + error)
                up.append(-echo[k, 2])
        for _ in range(rng.poisson(config.clutter)):
            rows.append(np.array([rng.uniform(1.0, config.max_range), rng.uniform(-half, half)]))
        z = np.reshape(rows, (-1, 2))
        z = np.where(step > 0.0, np.round(z / np.where(step > 0.0, step, 1.0)) * step, z)
        order = rng.permutation(len(z))
        z, elevation = z[order], np.full(len(z), np.nan)
        if config.elevation_std_deg:
            half_v, std = np.radians([0.5 * config.vertical_fov_deg, config.elevation_std_deg])
            measured = np.array(up) + std * rng.normal(size=len(up))
            false = rng.uniform(-half_v, half_v, len(z) - len(up))
            elevation = np.concatenate([measured, false])[order]
        if rng.uniform() < config.ping_loss:
            continue
        detections = Detections(
            stamp_ns=int(stamp),
            range=z[:, 0],
            bearing=-z[:, 1],
            elevation=elevation,
            frame_id='sonar',
        )
        received.append(Received(int(stamp) + delay_ns(config, LATE_DELAY, rng), detections))
    return received


def _truth(
    config: ObstacleScenario,
    number: int,
    path: Path,
    vehicle: _Vehicle,
    stamps: np.ndarray,
    times: FloatArray,
) -> TrueObstacle:
    sonar, place = vehicle.sonar(times), path.at(times)
    d, azimuth = geometry.project(geometry.to_body(sonar, place), config.azimuth_model)
    still = 'seabed' if config.placement == 'seabed' else 'fixed'
    if path.sway is not None:
        still = 'swaying'
    return TrueObstacle(
        track_id=number,
        stamp_ns=stamps,
        position=geometry.flip_world(place),
        range=d,
        bearing=-azimuth,
        vertical_offset=place[:, 2] - sonar.position[:, 2],
        in_beam=_echoes(config, vehicle, times, path, 1.0)[1],
        velocity=geometry.flip_world(path.velocity(times))[:, :2],
        does=np.where(path.moves(times), DOES.index('moving'), DOES.index(still)),
    )
