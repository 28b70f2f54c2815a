# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The measurements measure what they say."""

import numpy as np
import pytest

from benchmarks.speed import diver as bench


def test_turns_compose_and_keep_the_speed():
    rate = np.radians(20.0)
    half = bench.turn(rate)
    assert np.hypot(*(half @ [0.0, 0.0, 3.0, 4.0])[2:]) == pytest.approx(5.0)
    np.testing.assert_allclose((half @ half)[2:, 2:], bench.turn(2 * rate)[2:, 2:])
    np.testing.assert_allclose(bench.turn(0.0) @ [1, 2, 3, 4], [4, 6, 3, 4])


def test_both_programs_do_the_same_sums():
    pytest.importorskip('filterpy')
    result = bench.bench_step(rounds=1, steps=8)
    assert result['largest_difference_m'] < 1e-9


def test_a_scan_hits_its_targets():
    result = bench.bench_scan(targets=40, scans=3)
    assert result['assigned'] > 0.9


def test_both_kinds_of_stamps_are_tracked():
    result = bench.bench_stamps(rounds=1, fixes=30)
    assert result['regular_cpu_ms'] > 0.0 and result['irregular_cpu_ms'] > 0.0
    fixes = bench._fixes(np.array([1.0, 0.6, 1.4]))
    np.testing.assert_array_equal(np.diff([fix.stamp_ns for fix in fixes]), [6e8, 14e8])


def test_scans_in_clutter_are_tracked_with_both_associations():
    result = bench.bench_clutter(rounds=1, scans=15)
    assert result['scans'] == 15 and result['fixes'] > 15
    assert result['gnn_cpu_ms'] > 0.0 and result['jipda_cpu_ms'] > 0.0
    assert len(bench.BENCHES[-1].sentence(result)) > 40
