"""The measurements measure what they say."""

import pytest

from sonar_imm.evaluation.bathymetry import bench
from sonar_imm.evaluation.bathymetry.peers import cut, stone_soup_filter


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
    speed = result['bins_per_second']
    assert result['ratio'] == pytest.approx(speed['particles'] / speed['numpy'])
    assert result['ratio'] > 0.0


def test_stone_soup_follows_the_same_floor(short):
    pytest.importorskip('stonesoup')
    height = stone_soup_filter(cut(short, 60))
    assert abs(height[20:]).max() < 0.5
    assert bench.bench_stone_soup(rounds=1)['ratio'] > 0.0


def test_every_variant_is_measured(short):
    assert all(speed > 0.0 for speed in bench.bench_threads(1, 1)['bins_per_second'].values())
    speed = bench.bench_scaling(rounds=1)['bins_per_second']
    assert len(speed) == 13 and min(speed.values()) > 0.0
