"""The measurements measure what they say."""

import pytest

from sonar_imm.evaluation.fathometer import bench


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
