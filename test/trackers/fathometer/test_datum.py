# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The depth of the array that is wrong: found from its reflectors, counted in, and followed."""

from helpers.fathometer_runs import run
from helpers.moving_layers import scene
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.datum import (
    BENDS,
    DatumError,
    error_weights,
    ERRORS,
    STEPS,
    STEPS_PRIOR,
)
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities

FEW = {'particles': 2000, 'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}


def found_of(changes):
    datum = DatumError()
    for change in changes:
        datum.add(float(change))
    return datum


def test_errors_of_the_vectors():
    scalars = load_vectors('fathometer_in_the_field/scalars')
    # Theirs are moments, which waves of the floor leave a quarter too small or too great.
    for kind, within in (('', 0.1), ('_fault', 0.1), ('_waves', 0.25)):
        found = found_of(scalars[f'change{kind}'][-40:]).found
        assert found == pytest.approx(float(scalars[f'found{kind}']), rel=within)


def test_weights_are_those_of_the_joint_normal_density():
    rng = np.random.default_rng(2)
    n, changes, noise = 6, 0.1 * rng.standard_normal(6), np.full(7, 0.03**2)
    one = np.ones((n, n))
    difference = np.eye(n, n + 1, 1) - np.eye(n, n + 1)
    sums = np.tril(one)
    total, seen = 0.0, []
    for error, prior in zip(ERRORS, [0.2, *[0.8 / 15] * 15]):
        sum_of_one = 0.0
        for step, likely in zip(STEPS, STEPS_PRIOR):
            for bend in BENDS:
                covariance = 0.4**2 * one + bend**2 * sums @ sums.T + step**2 * np.eye(n)
                covariance += difference @ np.diag(error**2 + noise) @ difference.T
                sum_of_one += likely * multivariate_normal(cov=covariance).pdf(changes)
        seen.append(prior * sum_of_one)
        total += seen[-1]
    # A fault is possible at each change, which costs the density .005.
    found = error_weights(np.column_stack([changes, noise[1:]]))
    assert found == pytest.approx(np.array(seen) / total, abs=0.01)


def test_what_is_found_of_an_error_a_slope_and_a_fault():
    rng, config, record = np.random.default_rng(0), FathometerConfig(), np.arange(41)
    found, sure = [], []
    for _ in range(60):
        datum = found_of(np.diff(0.2 * rng.standard_normal(41)))
        found.append(datum.found)
        sure.append(datum.exceeds(config))
    assert np.median(found) == pytest.approx(0.2, rel=0.15) and np.mean(sure) > 0.9
    early = [found_of(np.diff(0.5 * rng.standard_normal(6))).found for _ in range(60)]
    assert np.mean(early) == pytest.approx(0.5, rel=0.25)
    fault = np.where(record >= 20, 3.0, 0.0) + 0.01 * rng.standard_normal(41)
    for floor in (2.5 * np.sin(2.0 * np.pi * record / 25.0), 0.18 * record, fault, 0.0 * record):
        datum = found_of(np.diff(floor))
        assert datum.found < 0.03 and not datum.exceeds(config)
    # All layers of a rough floor step together, and look not back.
    steps = [found_of(0.3 * rng.standard_normal(40)).exceeds(config) for _ in range(60)]
    assert np.mean(steps) < 0.1


def test_an_error_counts_after_four_changes_and_is_followed_after_eight():
    config = FathometerConfig()
    changes = np.diff(0.8 * np.random.default_rng(4).standard_normal(9))
    assert found_of(changes[:3]).found == 0.0 and found_of(changes[:4]).found > 0.2
    datum = found_of(changes[:7])
    assert not datum.follow(config) and not datum.followed
    datum.add(changes[7])
    assert not datum.exceeds(FathometerConfig(array_depth_std=1.0))
    assert not datum.exceeds(FathometerConfig(array_depth_std=0.0))
    assert datum.follow(config) and datum.followed == datum.found
    assert not datum.follow(config)
    for _ in range(40):
        datum.add(0.0)
    assert datum.follow(config) and datum.followed < 0.1


def inside(found, true, after):
    """Share of the depths within two stated standard deviations."""
    good = []
    for stamp, each in found.items():
        if stamp <= after * 10**9:
            continue
        off = np.abs(each.state[:, :1] - true[stamp // 10**9 - 1])
        good += (off.min(axis=1) <= 2.0 * np.sqrt(each.covariance[:, 0, 0])).tolist()
    return np.mean(good)


def test_a_depth_that_is_wrong_anew_in_each_record_is_followed():
    error = 0.2 * np.random.default_rng(1).standard_normal(36)
    traces, true = scene(error, 2)
    tracker, found = run(traces, **FEW)
    newest = found[36 * 10**9]
    assert newest.extras['array_depth_found'][0] == pytest.approx(0.2, abs=0.08)
    assert newest.extras['heave_std'][0] > 0.0
    assert inside(found, true, 18) > 0.85
    assert any('it is followed as heave' in each for each in tracker.warnings())
    # A state, and not only a wider covariance: depths are better than what is told of the array.
    settled = range(25, 37)
    rms = np.sqrt(
        np.mean([np.square(found[k * 10**9].state[:, 0] - true[k - 1]).mean() for k in settled])
    )
    assert rms < 0.12

    tracker, plain = run(traces, **FEW, heave='none')
    assert inside(plain, true, 18) > 0.6
    assert len(set(np.concatenate([e.extras['track_id'] for e in plain.values()]))) == 6
    assert plain[36 * 10**9].extras['heave_std'][0] == 0.0
    assert any('heave auto follows it' in each for each in tracker.warnings())


@pytest.mark.parametrize('kind', ['still', 'fault'])
def test_a_right_depth_is_left_alone(kind):
    floor = np.zeros(36)
    if kind == 'fault':
        floor[20:] = 1.0
    traces, true = scene(np.zeros(36), 3, floor=floor)
    tracker, found = run(traces, **FEW)
    newest = found[36 * 10**9]
    assert newest.extras['array_depth_found'][0] < 0.05
    assert newest.extras['heave_std'][0] == 0.0 and tracker.warnings() == []


def test_all_keep_their_ids_when_a_great_error_is_followed():
    error = 0.5 * np.random.default_rng(7).standard_normal(26)
    traces, _ = scene(error, 2, 26)
    tracker, found = run(traces, **FEW)
    assert tracker.warnings() and found[26 * 10**9].extras['heave_std'][0] > 0.0
    late = [each.extras['track_id'].tolist() for stamp, each in found.items() if stamp > 10**10]
    assert all(ids == late[0] for ids in late)


def test_the_last_records_say_where_the_layers_lie_once_an_error_is_followed():
    error = 0.5 * np.random.default_rng(16).standard_normal(12)
    traces, true = scene(error, 2, 12)
    _, found = run(traces, **FEW)
    first = next(k for k in range(1, 13) if found[k * 10**9].extras['heave_std'][0] > 0.0)
    off = found[first * 10**9].state[:, 0] - true[first - 1]
    # Layers that stay are where the mean of the records has them, not where the newest shows them.
    eight = error[first - 8 : first].mean()
    assert abs(error[first - 1] - eight) > 0.5
    np.testing.assert_allclose(off, eight, atol=0.1)
    assert found[first * 10**9].extras['heave'][0] == pytest.approx(
        error[first - 1] - eight, abs=0.1
    )


def test_what_all_are_off_by_together():
    known = Identities(tuple(Identified(k, z, 0) for k, z in enumerate((50.0, 54.0, 61.0, 66.0))))
    seen = np.array([50.9, 54.92, 57.0, 66.9])
    assert known.offset(seen, 1.5, 0.4) == pytest.approx(0.9, abs=0.03)
    assert known.offset(seen, 0.5, 0.4) == 0.0
    # One alone says nothing of the others, and those that are near stay.
    assert known.offset(np.array([50.9]), 1.5, 0.4) == 0.0
    assert known.offset(np.array([50.05, 54.0, 61.1, 67.0]), 1.5, 0.4) == pytest.approx(
        0.0, abs=0.1
    )
    assert known.offset(seen, 0.0, 0.4) == 0.0
    assert known.offset(np.empty(0), 1.5, 0.4) == 0.0
    assert Identities().offset(seen, 1.5, 0.4) == 0.0
