# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The measurements measure what they say."""

import pytest

from benchmarks.speed import bathymetry as bench


@pytest.fixture
def short(monkeypatch):
    ping = bench.a_ping(last_range=27.0)
    monkeypatch.setattr(bench, 'a_ping', lambda **values: ping)
    monkeypatch.setattr(bench, 'PEER_BINS', 60)
    return ping


def test_both_filters_are_one_filter(short):
    result = bench.bench_numpy(rounds=1)
    assert result['rms_difference_m'] < 0.05
    assert set(result['bins_per_second']) == {'particles', 'gated', 'grid', 'numpy'}


def test_the_best_round_of_each_method_counts(monkeypatch):
    """By a clock that only the methods move: rounds of 3, 2 and 4 seconds for 10 bins are 5 bins
    per second; the first call compiles and is not timed."""
    clock, costs = [0.0], {'a': iter([100.0, 3.0, 2.0, 4.0]), 'b': iter([1.0, 8.0, 9.0, 10.0])}

    def take(name):
        clock[0] += next(costs[name])

    monkeypatch.setattr(bench.time, 'perf_counter', lambda: clock[0])
    methods = {'a': (lambda: take('a'), 10), 'b': (lambda: take('b'), 4)}
    assert bench.rates(methods, rounds=3) == {'a': 5.0, 'b': 0.5}


@pytest.mark.parametrize(
    'particles, numpy, ratio, good',
    [(90e3, 1e3, 90.0, True), (60e3, 1e3, 60.0, False), (90e3, 9e3, 10.0, False)],
)
def test_the_goal_is_met_by_speed_and_by_ratio(short, monkeypatch, particles, numpy, ratio, good):
    rates = {'particles': particles, 'gated': 7.0, 'grid': 8.0, 'numpy': numpy}
    monkeypatch.setattr(bench, 'rates', lambda methods, rounds: rates)
    result = bench.bench_numpy(rounds=1)
    assert (result['ratio'], result['good']) == (ratio, good)


def test_the_goal_at_sea_is_met_by_both_engines(monkeypatch):
    def rates(methods, rounds, clock):
        ran.update(methods)
        return speeds

    monkeypatch.setattr(bench, 'rates', rates)
    for grid, good in ((26e3, True), (24e3, False)):
        ran, speeds = {}, {'particles': 121e3, 'grid': grid}
        assert bench.bench_sea(rounds=1)['good'] is good
    lengths = {name: (len(run()[0]), bins) for name, (run, bins) in ran.items()}
    assert lengths == {'particles': (2000, 2000), 'grid': (2000, 2000)}


def test_stone_soup_follows_the_same_floor(short):
    pytest.importorskip('stonesoup')
    height = bench.stone_soup_filter(bench.cut(short, 60))
    assert abs(height[20:]).max() < 0.5
    assert set(bench.bench_stone_soup(rounds=1)['bins_per_second']) == {'particles', 'stone_soup'}


def test_every_variant_is_measured(short):
    assert all(speed > 0.0 for speed in bench.bench_threads(1, 1)['bins_per_second'].values())
    speed = bench.bench_scaling(rounds=1)['bins_per_second']
    assert len(speed) == 9 and min(speed.values()) > 0.0


def test_the_goal_with_both_surfaces_is_met_beside_a_ledge(monkeypatch):
    def rates(methods, rounds, clock):
        ran.update(methods)
        return {name: resolved if name.startswith('ledge') else 50e3 for name in methods}

    monkeypatch.setattr(bench, 'rates', rates)
    for resolved, good in ((41e3, True), (39e3, False)):
        ran = {}
        result = bench.bench_layover(rounds=1)
        assert result['good'] is good and 0.01 < result['stretch_share'] < 0.1
        extra = 1e6 * (1.0 / resolved - 1.0 / 50e3)
        assert result['us_per_stretch_bin'] * result['stretch_share'] == pytest.approx(extra)
    assert len(ran) == 18
    assert {(len(run()[0]), bins) for run, bins in ran.values()} == {(1200, 1200)}
    assert 'ledge' in next(b for b in bench.BENCHES if b.name == 'layover').sentence(result)
