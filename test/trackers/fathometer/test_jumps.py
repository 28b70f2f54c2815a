# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Jumps that all reflectors make together: found, said, and no end of their ids."""

from attrs import evolve
from helpers.fathometer_runs import run
from helpers.moving_layers import scene
import numpy as np
import pytest

from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities
from sonar_imm.trackers.fathometer.response import common_jump
from sonar_imm.trackers.fathometer.slopes import begun, Common, learned, Slope

FEW = {'particles': 1500, 'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}
RECORDS, AT = 24, 14


def tracked(floor, **options):
    """The tracker; share of the records after the fifth with six reflectors; ids that each of the
    six true layers had then; and the estimates."""
    traces, true = scene(np.zeros(len(floor)), 5, len(floor), floor)
    tracker, found = run(traces, **{**FEW, **options})
    ids, right = [set() for _ in range(6)], []
    for k in range(5, len(floor)):
        each = found[(k + 1) * 10**9]
        right.append(len(each.state) == 6)
        for layer, z in zip(ids, true[k]):
            layer.add(int(each.extras['track_id'][np.argmin(np.abs(each.state[:, 0] - z))]))
    return tracker, float(np.mean(right)), [len(layer) for layer in ids], found


@pytest.mark.parametrize('jump', [3.0, -2.2])
def test_after_a_fault_all_have_their_ids(jump):
    floor = jump * (np.arange(RECORDS) >= AT)
    tracker, right, ids, found = tracked(floor)
    assert right == 1.0 and ids == [1] * 6
    drawn = np.array([each.extras['common_jump'][0] for each in found.values()])
    assert drawn[AT] == pytest.approx(jump, abs=0.1)
    assert np.abs(np.delete(drawn, AT)).max() < 0.1
    (said,) = tracker.warnings()
    assert said.startswith(f'all reflectors jumped together in 1 record, by {jump:+.1f} m')
    # Nothing is taken for a slope.
    assert found[RECORDS * 10**9].extras['dipping'].max() < 0.2


def test_over_steep_waves_all_keep_their_ids():
    floor = 4.0 * np.sin(2.0 * np.pi * np.arange(30) / 25.0)
    tracker, right, ids, _ = tracked(floor)
    assert right == 1.0 and ids == [1] * 6
    assert tracker.warnings() == []


def test_what_dips_is_still_a_slope():
    tracker, right, ids, found = tracked(0.3 * np.arange(RECORDS) - 4.0)
    newest = found[RECORDS * 10**9]
    assert right == 1.0 and ids == [1] * 6 and tracker.warnings() == []
    assert newest.extras['dipping'].min() > 0.9
    assert newest.extras['slope'] == pytest.approx(0.3, abs=0.03)


def test_a_jump_within_a_gap():
    floor = 2.5 * (np.arange(RECORDS) >= AT)
    traces, true = scene(np.zeros(RECORDS), 5, RECORDS, floor)
    tracker, found = run(traces[: AT - 2] + traces[AT + 1 :], **FEW, record_interval=1.0)
    before, after = found[(AT - 2) * 10**9], found[(AT + 2) * 10**9]
    assert after.state[:, 0] == pytest.approx(true[AT], abs=0.1)
    assert after.extras['track_id'].tolist() == before.extras['track_id'].tolist()


def test_what_is_smoothed_has_the_ids_of_before_the_jump():
    floor = 3.0 * (np.arange(RECORDS) >= AT)
    tracker, right, ids, found = tracked(floor, smoothing_lag=2)
    assert ids == [1] * 6
    drawn = [found[(k + 1) * 10**9].extras['common_jump'][0] for k in range(RECORDS - 2)]
    assert int(np.argmax(drawn)) == AT


def test_with_heave_there_are_none_and_the_grid_has_a_bound():
    config = FathometerConfig(heave='none')
    jump = common_jump(config, 0.05)
    assert (jump.step, jump.pad * 0.05) == (1, 4.0) and jump.std == pytest.approx(30.0)
    assert common_jump(config, 1.0 / 64.0).step == 4
    assert common_jump(config, 0.5).pad == 8
    for changed in (
        evolve(config, common_jump_probability=0.0),
        evolve(config, heave='independent'),
    ):
        assert common_jump(changed, 0.05) is None
    wide = common_jump(evolve(config, common_jump_std=100.0), 0.01)
    assert wide.reach <= 200 and wide.pad * 0.01 == pytest.approx(267.0, rel=0.01)


def test_what_slopes_explain_is_no_jump():
    config = FathometerConfig()
    slope, common = Slope(0.0, 0.0, 0.16, 1e-4), Common()
    plain = learned(slope, common, 0.02, 1e-4, 1, config)
    far = learned(slope, common, 0.02, 1e-4, 1, config, 3.0)
    assert tuple(far) == pytest.approx(tuple(plain), abs=1e-7)
    # The first time either may be, the second time it is a slope.
    once = learned(slope, common, 0.0, 1e-4, 1, config, 0.5)
    assert 0.3 < once.dipping < 0.7 and once.mean == pytest.approx(0.48, abs=0.05)
    twice = learned(once, common, 0.0, 1e-4, 1, config, 0.5)
    assert twice.dipping > 0.9 and twice.mean == pytest.approx(0.5, abs=0.05)
    # By both, weighted by how probable they are.
    std = np.sqrt(0.16 + 0.01 + 2e-4)
    turned = 0.02 * np.exp(-0.5 * (0.5 / std) ** 2) / std
    still = 0.98 * np.exp(-0.5 * 0.25 / 0.0102) / np.sqrt(0.0102)
    leap = 0.05 * np.exp(-0.5 * (0.5 / 1.5) ** 2) / 1.5
    slopes = (turned + still) / (turned + still + leap)
    share = turned / (turned + still)
    expected = (
        slopes * share + (1.0 - slopes) * learned(slope, common, 0.0, 1e-4, 1, config).dipping
    )
    assert once.dipping == pytest.approx(expected, rel=1e-6)


def test_those_that_are_waited_for_jump_as_well():
    slope = begun(Common(), 1e-4, FathometerConfig())
    known = Identities((Identified(3, 50.0, 0, 0, slope), Identified(5, 60.0, 2, 0, slope)), 6)
    moved = known.moved(-2.0)
    assert [each.depth for each in moved.reflectors] == [48.0, 58.0]
    assert [each.missed for each in moved.reflectors] == [0, 2] and known.moved(0.0) is known
