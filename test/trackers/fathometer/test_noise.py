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

from helpers.fathometer_runs import run
from helpers.sea_scenes import score_scene, sea_scene
import numpy as np
import pytest

from sonar_imm.acoustics.fathometer import depth_response
from sonar_imm.measurements import Rejection, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.response import Lattice, mirror_sigma

MIRROR = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}


def test_the_mirror_lies_at_negative_lags():
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
