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

"""Swimming divers, observed by a polar or a multistatic sonar.

A scenario (`SCENARIOS`) is a named choice of `motion`, how the divers move, and `sensor`, how they
are observed. The paper's Table 1 gives start, speed, sampling and accuracy, but not the path. In
`table1` the diver swims legs of 7 to 15 s whose headings lie within 85 degrees of a general
heading ("zigzag with general consistent direction" in the paper).
"""

from __future__ import annotations

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.truth import Received, Scene, TrueTrack

from .afloat import namespace_of
from .crossing import crossing_paths
from .scenarios import DiverScenario, FIRST_STAMP_NS, RECEIVERS, scenario, SCENARIOS, TRANSMITTER
from .sensors import draw_errors, SENSE

__all__ = [
    'DiverScenario',
    'FIRST_STAMP_NS',
    'RECEIVERS',
    'SCENARIOS',
    'TRANSMITTER',
    'scenario',
    'simulate',
]


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
    errors = draw_errors(config, times, np.random.default_rng([seed, 1]))
    truth = tuple(
        TrueTrack(
            number,
            stamps,
            np.column_stack([state[:, :2], errors.height[:, number - 1]]),
            state[:, 2:],
        )
        for number, state in enumerate(paths, start=1)
    )
    received = []
    for k, stamp in enumerate(stamps):
        present = np.array([track.position[k] for track in truth])
        delay = config.late_delay * rng.uniform() if rng.uniform() < config.late_fraction else 0.0
        for measurement in SENSE[config.sensor](config, errors.at(k), int(stamp), present, rng):
            when = int(stamp) + round(delay * 1e9)
            received.append(Received(when, measurement, namespace_of(measurement)))
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


_VELOCITY = {
    'legs': _legs,
    'straight': _straight,
    'circle': _circle,
    'zigzag': _zigzag,
    'stop_and_go': _stop_and_go,
    'still': _still,
}
