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

from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.datum import DatumError, found_std
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities

FEW = {'particles': 2000, 'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}


def test_errors_of_the_vectors():
    scalars = load_vectors('fathometer_in_the_field/scalars')
    for change, found in (
        ('change', 'found'),
        ('change_waves', 'found_waves'),
        ('change_fault', 'found_fault'),
    ):
        assert found_std(scalars[change][-40:]) == pytest.approx(float(scalars[found]), abs=1e-9)


def test_what_is_found_of_an_error_a_slope_and_a_fault():
    rng, found = np.random.default_rng(0), []
    for _ in range(200):
        error = 0.2 * rng.standard_normal(41)
        found.append(found_std(np.diff(error)))
    assert np.median(found) == pytest.approx(0.2, rel=0.15)
    wave = 2.5 * np.sin(2.0 * np.pi * np.arange(41) / 25.0)
    assert found_std(np.diff(wave)) < 0.05
    fault = np.zeros(40)
    fault[20] = 3.0
    assert found_std(fault + 0.01 * rng.standard_normal(40)) < 0.02
    assert found_std(np.zeros(40)) == 0.0


def test_nothing_is_found_before_fifteen_records():
    datum, config = DatumError(), FathometerConfig()
    changes = np.diff(0.2 * np.random.default_rng(4).standard_normal(16))
    for change in changes[:14]:
        datum.add(change)
        assert datum.found == 0.0 and not datum.exceeds(config)
    datum.add(changes[14])
    assert datum.exceeds(config)
    assert not datum.exceeds(FathometerConfig(array_depth_std=0.3))
    assert not datum.exceeds(FathometerConfig(array_depth_std=0.0))


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
