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

"""Kinds of targets by name: one parameter that sets how they move."""

from attrs import evolve
from helpers.diver_runs import fix
import numpy as np
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig, TARGETS
from sonar_imm.trackers.diver.tracker import DiverTracker


def legs(speed, seconds, turn_deg, leg, rng):
    """(seconds, 2) places of a target that turns by up to turn_deg after each `leg` of seconds,
    within 4 s."""
    heading = np.cumsum(
        np.repeat(rng.uniform(-turn_deg, turn_deg, seconds // leg + 1), leg)[:seconds]
        * (np.arange(seconds) % leg < 4) / 4.0
    )  # fmt: skip
    velocity = speed * np.column_stack([np.cos(np.radians(heading)), np.sin(np.radians(heading))])
    return np.cumsum(velocity, axis=0)


def judged(config, speed, std=1.0, seeds=range(3)):
    """RMSE of position, share of scans with a track, and the number of identities of a run."""
    squared, scans, ids = [], 0, 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        truth, tracker, seen = legs(speed, 90, 60.0, 15, rng), DiverTracker(config), set()
        for second, place in enumerate(truth, start=1):
            x, y = place + std * rng.normal(size=2)
            (estimate,) = tracker.process(fix(float(second), x, y, std**2 * np.eye(2)))
            rows = np.flatnonzero(estimate.extras['track_state'] > 0)
            scans += second > 10
            if len(rows) and second > 10:
                error = np.linalg.norm(estimate.state[rows, :2] - place, axis=1)
                squared.append(error.min() ** 2)
                seen.add(int(estimate.extras['track_id'][rows[error.argmin()]]))
        ids += len(seen)
    return np.sqrt(np.mean(squared)), len(squared) / scans, ids / len(seeds)


def test_a_fast_boat_is_one_track_as_a_boat():
    as_diver = judged(DiverConfig(), 12.0)
    as_boat = judged(DiverConfig(target='boat'), 12.0)
    assert as_boat[2] == 1.0 and as_boat[1] == 1.0
    assert as_boat[0] < 1.2  # the fixes have 1.41
    assert as_diver[1] < 0.9 or as_diver[2] > 1.0 or as_diver[0] > as_boat[0]


@pytest.mark.parametrize('target', TARGETS)
def test_each_kind_is_what_its_parameters_say(target):
    named, spelt = DiverConfig(target=target), DiverConfig(**TARGETS[target])
    assert named.for_target() == evolve(spelt, target=target)
    assert DiverTracker(named).config == named.for_target()


def test_what_is_stated_is_kept():
    config = DiverConfig(target='ship', speed_mean=9.0)
    assert config.for_target().speed_mean == 9.0
    assert config.for_target().speed_std == TARGETS['ship']['speed_std']
    tracker = DiverTracker(config)
    tracker.reconfigure(evolve(config, fix_std=2.0))
    assert tracker.config.speed_mean == 9.0
    with pytest.raises(ValueError, match='target'):
        tracker.reconfigure(evolve(config, target='fish'))


def test_a_kind_that_is_unknown_is_refused():
    with pytest.raises(ConfigError, match='did you mean|must be one of'):
        DiverConfig(target='bot')
    with pytest.raises(ConfigError, match='acceleration_noise needs one value for each of the 3'):
        DiverConfig(acceleration_noise=(1.0,))


def test_another_set_is_not_changed_by_the_kind():
    config = DiverConfig(model_set='heading_speed', target='boat')
    assert config.for_target() == config
