# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from sonar_imm.acoustics import array, coherence, variances
from sonar_imm.measurements import Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, SCENARIOS, simulate, snr


def run(name='paper', seed=1, **overrides):
    scene = simulate(scenario(name, {'pings': 4, **overrides}), seed)
    received = [item.measurement for item in scene.measurements]
    snapshots = [item for item in received if isinstance(item, Snapshot)]
    return list(zip(snapshots, scene.truth))


@pytest.mark.parametrize('name', SCENARIOS)
def test_the_truth_of_every_scenario_is_that_of_its_snapshots(name):
    for snapshot, true in run(name, seed=5):
        assert snapshot.stamp_ns == true.stamp_ns
        assert snapshot.frame_id == ('sonar' if name.startswith('moving') else true.frame_id)
        assert snapshot.usable.all() and (snapshot.range == true.range).all()
        assert np.isfinite(true.height).all() and true.valid.any()


def test_the_scene_of_the_paper():
    config = scenario('paper')
    snapshot, true = run(pings=1)[0]
    assert snapshot.iq.shape == (1200, 8) and snapshot.bin_width == pytest.approx(0.05)
    assert snapshot.range[0] == 17.0 and snapshot.range[-1] < 77.0
    assert snapshot.spacing_wavelengths == pytest.approx(0.5)
    assert (true.height[~true.patch] == 0.0).all() and true.patch.sum() == 200
    decibels = 10.0 * np.log10(snr(config, snapshot.range))
    assert decibels[0] == 30.0 and decibels[-1] == pytest.approx(10.0, abs=0.02)
    assert (np.diff(decibels) < 0.0).all()


def test_power_and_direction_are_those_of_the_floor():
    config = scenario('paper')
    pings = run(pings=40)
    power = np.mean([variances.mean_power(snapshot.iq) for snapshot, _ in pings], axis=0)
    ratio = power / (1.0 + snr(config, pings[0][0].range))
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    errors = [
        coherence.coherence(snapshot.iq[:600], 0.5)[1] - np.sin(true.angle[:600])
        for snapshot, true in pings
    ]
    assert np.median(np.abs(errors)) < 0.01 and abs(np.median(errors)) < 1e-3


def test_patch_heights_have_their_deviation_and_correlation():
    white = np.concatenate([true.height[true.patch] for _, true in run(pings=30)])
    assert white.std() == pytest.approx(0.5, rel=0.05)
    smooth = [true.height[true.patch] for _, true in run('correlated', pings=200)]
    assert np.std(smooth) == pytest.approx(0.5, rel=0.1)
    # A Gaussian kernel of 1 m correlates neighbours 1 m apart by exp(-1/4).
    lag = np.mean([h[20:] * h[:-20] for h in smooth]) / np.mean(np.square(smooth))
    assert lag == pytest.approx(np.exp(-0.25), abs=0.05)
    assert abs(np.mean([h[1:] * h[:-1] for h in np.split(white, 30)]) / 0.25) < 0.05


def test_slope_undulation_and_drift():
    _, slope = run('slope')[0]
    smooth = ~slope.patch
    assert np.allclose(slope.height[smooth], 0.1 * (slope.range - 17.0)[smooth])
    _, waves = run('undulating')[0]
    assert waves.height[~waves.patch].max() == pytest.approx(0.5, abs=0.01)
    starts = [true.range[true.patch][0] for _, true in run('drifting_patch')]
    assert np.allclose(np.diff(starts), 0.2, atol=0.06)


def test_shadows_hold_noise_only():
    snapshot, true = run('shadow', pings=1)[0]
    assert true.valid.mean() == pytest.approx(1.0 - 8.0 / 60.0, abs=0.01)
    power = variances.mean_power(snapshot.iq)
    assert power[~true.valid].mean() == pytest.approx(1.0, rel=0.2)
    silent = coherence.silent_bins(coherence.coherence(snapshot.iq, 0.5)[0], 8)
    assert silent[~true.valid].mean() > 0.97 and silent[true.valid].mean() < 0.2


def test_the_water_column_has_no_floor():
    snapshot, true = run('water_column', pings=1)[0]
    assert (true.valid == (true.range >= 15.0)).all() and snapshot.noise_variance is None
    assert np.isnan(true.angle[~true.valid]).all() and np.isnan(true.xyz[0, 1])
    power = variances.mean_power(snapshot.iq)
    assert power[~true.valid].mean() == pytest.approx(1.0, rel=0.2)
    assert power[true.valid][:40].mean() > 100.0


def test_spikes_are_strong_and_incoherent():
    plain, spiky = (run(name, pings=1)[0][0] for name in ('paper', 'spikes'))
    ratio = variances.mean_power(spiky.iq) / variances.mean_power(plain.iq)
    spikes = ratio > 8.0
    assert 0.06 < spikes.mean() < 0.14
    gamma = coherence.coherence(spiky.iq, 0.5)[0]
    assert np.median(gamma[spikes]) < 0.5 < 0.9 < np.median(gamma[~spikes])


def test_surface_echoes_come_from_the_surface_and_the_mirrored_floor():
    options = {'sonar_depth': 10.0, 'multipath_level_db': 40.0, 'patch_std': 0.0, 'pings': 30}
    pings = run('multipath', **options)
    R = np.mean([s.iq[200:201].T @ s.iq[200:201].conj() for s, _ in pings], axis=0)
    values, vectors = np.linalg.eigh(R)
    assert values[-2] > 20.0 * values[-3]
    true = pings[0][1]
    sines = array.multipath_sines(15.0, true.range[200], np.deg2rad(30.0), 10.0)
    for sine in np.atleast_1d(sines)[np.isfinite(sines)]:
        a = array.steering(sine, 8, 0.5) / np.sqrt(8.0)
        assert np.linalg.norm(vectors[:, -2:].conj().T @ a) > 0.99


def test_both_sides_have_names_and_one_frame():
    scene = simulate(scenario('two_sides', {'pings': 2}), 1)
    assert [item.namespace for item in scene.measurements] == ['port', 'starboard'] * 2
    assert [true.namespace for true in scene.truth] == ['port', 'starboard'] * 2
    alone = simulate(scenario('paper', {'pings': 1}), 1)
    assert {item.namespace for item in (*alone.measurements, *alone.truth)} == {''}
    port, starboard = scene.truth[:2]
    assert (port.xyz[:, 1] > 0.0).all() and (starboard.xyz[:, 1] < 0.0).all()
    assert port.frame_id == starboard.frame_id == scene.frame_id
    assert port.stamp_ns == starboard.stamp_ns
    # Received when the last echo is.
    assert scene.measurements[0].received_ns - port.stamp_ns == pytest.approx(102.6e6, abs=1e5)


def test_a_conjugated_array_looks_mirrored():
    straight, turned = (run(conjugate=value, pings=1)[0][0] for value in (False, True))
    for snapshot, sign in ((straight, 1.0), (turned, -1.0)):
        sine = coherence.coherence(snapshot.iq[:200], 0.5)[1]
        assert sign * np.median(sine) > 0.1


@pytest.mark.parametrize(
    'overrides, word',
    [
        ({'last_range': 17.0}, 'last_range'),
        ({'bin_width': 0.001, 'last_range': 500.0}, 'bin_width'),
        ({'patch_start': 60.0}, 'patch_end'),
        ({'shadows': [30.0]}, 'pairs'),
        ({'shadows': [30.0, 20.0]}, 'pairs'),
        ({'staves': 1}, 'between 2 and 64'),
    ],
)
def test_mistakes_are_named(overrides, word):
    with pytest.raises(ConfigError, match=word):
        scenario('paper', overrides)


def test_noise_that_does_not_fade_is_the_same_everywhere():
    shadow = {'shadows': (17.0, 37.0), 'pings': 40}
    spread = {}
    for fades in (True, False):
        pings = [ping.iq[:400] for ping, _ in run(noise_fades=fades, **shadow)]
        power = variances.mean_power(np.concatenate(pings))
        assert power.mean() == pytest.approx(1.0, abs=0.03)
        spread[fades] = power.var()
    # z Gamma(8)/8 against Gamma(8)/8
    assert spread[True] == pytest.approx(1.25, rel=0.15)
    assert spread[False] == pytest.approx(1.0 / 8.0, rel=0.1)


def test_other_laws_of_echoes_and_of_rough_floor():
    shape = 0.5
    power = [
        ping.iq[:100, 0] for ping, _ in run(law='k', texture_shape=shape, pings=200, snr_far_db=30)
    ]
    power = np.square(np.abs(np.concatenate(power)))
    # |s|^2 z, exponential times a gamma law: E x^2 / (E x)^2 = 2 (1 + 1 / shape).
    assert (power**2).mean() / power.mean() ** 2 == pytest.approx(6.0, rel=0.2)
    laplace = [true.height[true.patch] for _, true in run(roughness_law='laplace', pings=60)]
    laplace = np.concatenate(laplace)
    assert laplace.std() == pytest.approx(0.5, rel=0.05)
    assert (laplace**4).mean() / laplace.var() ** 2 == pytest.approx(6.0, rel=0.25)
    fractal = [
        true.height
        for _, true in run(roughness_law='fractal', pings=60, patch_end=77, patch_start=17)
    ]
    spectrum = np.mean([np.square(np.abs(np.fft.rfft(item))) for item in fractal], axis=0)
    low, high = spectrum[4:8].mean(), spectrum[40:80].mean()
    assert low / high == pytest.approx(100.0, rel=0.4)
    assert np.std(fractal) == pytest.approx(0.5, rel=0.05)
    changes = {'roughness_law': 'exponential', 'correlation_length': 1.0, 'pings': 60}
    rough = np.stack([true.height[true.patch] for _, true in run(**changes)])
    assert rough.std() == pytest.approx(0.5, rel=0.1)
    after = (rough[:, :-20] * rough[:, 20:]).mean() / rough.var()
    assert after == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.parametrize('law', ['gaussian', 'laplace', 'exponential'])
def test_roughness_without_a_correlation_length_is_white(law):
    changes = {'roughness_law': law, 'correlation_length': 0.0, 'pings': 30}
    rough = np.stack([true.height[true.patch] for _, true in run(**changes)])
    assert rough.std() == pytest.approx(0.5, rel=0.05)
    assert abs((rough[:, :-1] * rough[:, 1:]).mean() / rough.var()) < 0.05
