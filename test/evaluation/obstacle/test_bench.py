"""The measurements measure what they say."""

import pytest

from sonar_imm.evaluation.obstacle import bench


def test_all_obstacles_are_tracked_and_every_ping_is_timed():
    result = bench.bench_ping(rounds=1, pings=16, obstacles=10)
    assert result['tracked'] == 10 and result['pings'] == 6
    assert 0.0 < result['median_ms'] <= result['p99_ms']


@pytest.mark.parametrize('name', bench.VARIANTS)
def test_each_variant_tracks_the_obstacles_too(name):
    clutter, parameters = bench.VARIANTS[name]
    result = bench.bench_ping(rounds=1, pings=16, obstacles=10, clutter=clutter, **parameters)
    assert result['tracked'] >= 10 and result['median_ms'] > 0.0


def test_the_sentence_names_every_variant():
    result = bench.bench_variants(rounds=1, pings=12)
    told = bench.BENCHES[1].sentence(result)
    assert all(name in told for name in bench.VARIANTS)
