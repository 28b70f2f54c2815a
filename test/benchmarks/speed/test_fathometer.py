# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The measurements measure what they say."""

import pytest

from benchmarks.speed import fathometer as bench


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(bench, 'PARTICLES', 500)


def test_the_short_likelihood_is_the_long_one():
    result = bench.bench_likelihood(rounds=1, sets=5)
    assert result['good'] and result['largest_relative_difference'] < 1e-6


def test_threads_do_not_change_the_bytes():
    result = bench.bench_threads(threads=2, records=4)
    assert result['same_bytes'] and set(result['median_ms']) == {'1', '2'}


def test_every_step_from_pressure_to_response_is_timed():
    result = bench.bench_array(rounds=1, snapshots=3, length=960, hydrophones=6)
    assert set(result['ms']) == {
        'transforms',
        'cross-spectra',
        'their checks',
        'conventional',
        'mvdr',
        'white_noise',
    }
    assert min(result['ms'].values()) > 0.0 and 'mvdr' in bench.BENCHES[-1].sentence(result)


def test_a_record_is_timed_with_all_its_reflectors(monkeypatch):
    monkeypatch.setattr(bench, 'PARTICLES', 20_000)
    record = bench.bench_record(2)
    assert set(record['reflectors'].values()) == {8}
    assert set(record['median_ms']) == set(record['reflectors'])
