# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The measurements measure what they say."""

import pytest

from benchmarks.speed import obstacle as bench


def test_all_obstacles_are_tracked_and_every_ping_is_timed():
    result = bench.bench_ping(rounds=1, pings=16, obstacles=10)
    assert result['tracked'] == 10 and result['pings'] == 6
    assert 0.0 < result['median_ms'] <= result['p99_ms']


def test_false_echoes_are_counted_and_have_a_goal_of_their_own(monkeypatch):
    monkeypatch.setattr(bench, '_approach', lambda *given: ([29.0, 29.5], given[1]))
    quiet, among_false = bench.bench_ping(1), bench.bench_clutter(1)
    assert (quiet['false'], among_false['false']) == (0, 30)
    assert not quiet['good'] and among_false['good']
    assert '16 obstacles and 30 false echoes per ping' in bench.BENCHES[1].sentence(among_false)


@pytest.mark.parametrize('name', bench.VARIANTS)
def test_each_variant_tracks_the_obstacles_too(name):
    clutter, parameters = bench.VARIANTS[name]
    result = bench.bench_ping(rounds=1, pings=16, obstacles=10, clutter=clutter, **parameters)
    assert result['tracked'] >= 10 and result['median_ms'] > 0.0


def test_the_sentence_names_every_variant():
    result = bench.bench_variants(rounds=1, pings=12)
    sentence = bench.BENCHES[2].sentence(result)
    assert all(name in sentence for name in bench.VARIANTS)


def test_variants_are_timed_in_three_rounds_at_most(monkeypatch):
    asked = []

    def ping(rounds, *_, **__):
        asked.append(rounds)
        return {'median_ms': 1.0}

    monkeypatch.setattr(bench, 'bench_ping', ping)
    for rounds in (2, 7):
        bench.bench_variants(rounds)
    assert asked == [2] * len(bench.VARIANTS) + [3] * len(bench.VARIANTS)
