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

"""Scenes of the fathometer: what they promise, and that they are the same each time."""

import numpy as np
import pytest

from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Trace
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.fathometer.simulator import drift_of, scenario, SCENARIOS, simulate

TINY = {'records': 2, 'phones': 6, 'snapshot_seconds': 0.1, 'frequency_max': 1000.0}


@pytest.mark.parametrize('name', SCENARIOS)
def test_every_scenario_can_be_made_small(name):
    overrides = dict(TINY)
    if SCENARIOS[name][1].get('level') == 'pressure':
        overrides |= {'records': 1, 'record_seconds': 1.0, 'sample_rate': 4000.0}
    scene = simulate(scenario(name, overrides), 1)
    assert len(scene.truth) == overrides['records']
    stamps = [one.received_ns for one in scene.measurements]
    assert stamps == sorted(stamps)
    assert scene.truth[-1].stamp_ns == scene.measurements[-1].measurement.stamp_ns
    kinds = {type(one.measurement) for one in scene.measurements}
    assert kinds <= {CrossSpectra, Trace, Pressure, ArrayDepth}


def test_the_same_seed_gives_the_same_scene():
    config = scenario('small', {'records': 2})
    one, same, other = (
        simulate(config, seed).measurements[1].measurement.csdm.tobytes() for seed in (1, 1, 2)
    )
    assert one == same != other


def test_layers_fade_and_appear_as_told():
    config = scenario('drift', {'appearing': (10, 50), 'fading': (30,), 'records': 100})
    drift = drift_of(config, np.random.default_rng(0))
    assert drift.present.sum(axis=1)[[0, 20, 45, 99]].tolist() == [8, 9, 8, 9]
    assert drift.present[:, 0].all()
    assert (drift.amplitude[:, 0] > 0.2).all()


def test_traces_hold_the_pulse_of_each_layer_and_noise_as_stated():
    config = scenario(
        'drift_traces', {'records': 50, 'layers': 1, 'appearing': (), 'fading': (),
                         'array_depth_std': 0.0},
    )  # fmt: skip
    scene = simulate(config, 0)
    noise = []
    for received, truth in zip(scene.measurements, scene.truth):
        trace = received.measurement
        pulse = band_pulse(50.0, 4000.0, 1500.0)(trace.depth - truth.depth[0])
        amplitude = trace.amplitude @ pulse / (pulse @ pulse)
        noise.append(trace.amplitude - amplitude * pulse)
        assert amplitude > 0.01
    assert np.std(noise) == pytest.approx(1.3e-3, rel=0.05)
    # The noise is as correlated as the pulse.
    lag = 3
    seen = np.mean(np.multiply(np.array(noise)[:, lag:], np.array(noise)[:, :-lag])) / np.var(
        noise
    )
    assert seen == pytest.approx(band_pulse(50.0, 4000.0, 1500.0)(lag / 32.0), abs=0.05)


@pytest.mark.parametrize(
    'name, overrides, word',
    [
        ('drfit', {}, "did you mean 'drift'"),
        ('drift', {'frequency_min': 5000.0}, 'frequency_max'),
        ('drift', {'ship_pass': (3,)}, 'ship_pass'),
        ('drift', {'level': 'pressure'}, '600 s'),
        ('drift', {'layers': 1}, 'no layer'),
        ('drift', {'level': 'csdm'}, '13.6 GB'),
        ('drift', {'records': 0}, 'records'),
    ],
)
def test_scenes_that_cannot_be(name, overrides, word):
    with pytest.raises(ConfigError, match=word):
        scenario(name, overrides)


def test_pressure_in_whole_numbers_has_the_steps_it_was_told():
    changes = {'records': 1, 'record_seconds': 1.0, 'block_seconds': 0.3}
    coarse = simulate(scenario('pressure', {**changes, 'steps_per_sigma': 2.5}), 1)
    fine = simulate(scenario('pressure', {**changes, 'steps_per_sigma': 0.0}), 1)
    a = np.concatenate([one.measurement.pressure for one in coarse.measurements])
    b = np.concatenate([one.measurement.pressure for one in fine.measurements])
    (scale,) = {one.measurement.scale for one in coarse.measurements}
    assert [len(one.measurement) for one in coarse.measurements] == [1800, 1800, 1800, 600]
    assert scale == pytest.approx(b.std() / 2.5, rel=1e-3)
    assert np.abs(a - b).max() <= 0.5001 * scale
    assert np.abs(a / scale - np.round(a / scale)).max() < 1e-4
    assert {one.measurement.scale for one in fine.measurements} == {0.0}


def test_what_a_tracker_is_told_of_pressure_leaves_its_snapshots_to_it():
    told = scenario('pressure').instruments()
    assert 'snapshot_seconds' not in told
    assert (told['depth_min'], told['depth_max']) == (42.0, 74.0)
    assert scenario('small').instruments()['window'] == 'rectangular'


def test_whitened_spectra_are_even():
    changes = {'records': 1, 'snapshots': 400, 'ship_noise': 0.0}
    red, even = (
        simulate(scenario('small', {**changes, 'whitened': white}), 1).measurements[-1].measurement
        for white in (False, True)
    )
    ratio = [
        np.einsum('fmm->f', one.csdm).real[10] / (np.einsum('fmm->f', one.csdm).real[-10])
        for one in (red, even)
    ]
    assert ratio[0] > 20.0 and 0.5 < ratio[1] < 2.0
