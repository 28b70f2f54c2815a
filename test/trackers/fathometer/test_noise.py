# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Noise measured where no echo is: in the mirror window, and in what reflectors leave."""

from collections import Counter
from pathlib import Path

from helpers.fathometer_runs import run
from helpers.sea_scenes import score_scene, sea_scene
import numpy as np
import pytest

from sonar_imm.acoustics.fathometer import depth_response
from sonar_imm.measurements import Pressure, Rejection, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.pressure import PressureStream
from sonar_imm.trackers.fathometer.response import array_response, Lattice, mirror_sigma

SEA = Path(__file__).parents[2] / 'vectors' / 'fathometer_sea'
MIRROR = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}


@pytest.fixture(scope='module')
def vectors():
    with np.load(SEA / 'pressure.npz') as file:
        return {name: file[name] for name in file}


def config_of(vectors, **changes):
    return FathometerConfig(
        phones=16,
        element_spacing=float(vectors['element_spacing']),
        snapshot_seconds=float(vectors['snapshot_seconds']),
        record_seconds=float(vectors['record_seconds']),
        frequency_min=float(vectors['frequency_min']),
        frequency_max=float(vectors['frequency_max']),
        **changes,
    )


@pytest.mark.parametrize('record', [0, 1])
def test_response_and_noise_from_pressure_are_those_of_the_vectors(vectors, record):
    config = config_of(vectors, **MIRROR)
    depth = vectors['depth']
    lattice = Lattice(float(depth[0]), float(depth[1] - depth[0]), len(depth))
    block = Pressure(
        stamp_ns=1,
        pressure=vectors['p'][record] * vectors['scale'][record],
        sample_rate=float(vectors['sample_rate']),
    )
    (collected,), _ = PressureStream(config, Counter()).push(block, 40.0)
    spectra = collected.spectra
    assert spectra.snapshots == vectors['snapshots']
    found = array_response(spectra, lattice, config, float(vectors['array_depth'][record]))
    expected = vectors['response'][record]
    assert np.abs(found.amplitude - expected).max() < 1e-4 * np.abs(expected).max()
    assert np.ptp(found.sigma) == 0.0
    assert found.sigma[0] == pytest.approx(vectors['sigma_mirror'][record], rel=1e-4)


def test_the_mirror_lies_at_negative_lags(vectors):
    """What lies above the array would be seen in the mirror window; what lies below is not."""
    lattice = Lattice(50.0, 0.05, 400)
    rng = np.random.default_rng(0)
    frequency = 100.0 + 2.0 * np.arange(1000)
    noise = 0.1 * (rng.standard_normal(1000) + 1j * rng.standard_normal(1000))

    def sigma(depth, strength):
        echo = strength * np.exp(-2j * np.pi * frequency * 2.0 * (depth - 20.0) / 1500.0)
        return mirror_sigma(
            lambda low, step, count: depth_response(
                noise + echo, 100.0, 2.0, (low, step, count), 20.0, 1500.0
            ),
            lattice,
            20.0,
            4.0,
        )

    quiet = sigma(60.0, 0.0)
    assert quiet == pytest.approx(0.1 / np.sqrt(1000.0), rel=0.2)
    assert sigma(60.0, 0.3) == pytest.approx(quiet, rel=0.2)
    with pytest.raises(Rejection, match='mirrored'):
        mirror_sigma(lambda *a: np.ones(a[2]), Lattice(20.0, 1e-3, 100), 20.0, 4.0)


def test_the_noise_of_a_trace_is_what_its_reflectors_leave():
    scene = sea_scene('negative')
    traces = list(scene.traces(range(25), sigma=False))
    options = {'particles': 2000, 'polarity': 'both', **MIRROR}
    _, found = run(traces, **options)
    assert score_scene(found, scene, after=5).right >= 0.9
    measured = np.mean([each.extras['sigma'][0] for each in found.values()])
    whole = np.mean([_mad(each.amplitude) for each in traces])
    assert measured == pytest.approx(1.0, abs=0.15)
    assert abs(measured - 1.0) < 0.7 * abs(whole - 1.0)


def _mad(x):
    return np.median(np.abs(x - np.median(x))) / 0.6744897501960817


def test_a_trace_without_noise_beside_its_reflectors_is_still_taken():
    depth = np.arange(40.0, 50.0, 0.05)
    trace = Trace(stamp_ns=1, depth=depth, amplitude=np.sin(depth))
    tracker, found = run([trace], particles=100, **MIRROR)
    assert len(found) == 1 and tracker.counts['used'] == 1


def test_only_both_depths_at_zero_ask_for_the_mirror():
    assert FathometerConfig(**MIRROR).noise_from_mirror
    assert not FathometerConfig().noise_from_mirror
    with pytest.raises(ConfigError, match='noise_depth_max'):
        FathometerConfig(noise_depth_min=10.0, noise_depth_max=0.0)
