# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Interferometers: two staves, wide apart, over a floor that they do not see alike."""

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.findings import LoudBins
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

WIDE = {'staves': 2, 'spacing_wavelengths': 3.66, 'pings': 4, 'last_range': 57.0}


def run(scene, **values):
    """RMSE, share inside two standard deviations, share of bins heard of echoes and of shadows,
    and the tracker."""
    config = scenario('paper', {**WIDE, **scene})
    simulated = simulate(config, 1)
    stated = BathymetryConfig.from_mapping({**config.instruments(), **values})
    tracker = BathymetryTracker(stated)
    error, inside, found, echo = [], [], [], []
    for each, truth in zip(simulated.measurements, simulated.truth):
        made = tracker.process(each.measurement)[0]
        difference = made.state[:, 0] - truth.height
        error.append(difference[truth.valid])
        sd = np.sqrt(made.covariance[:, 0, 0])
        inside.append((np.abs(difference) < 2.0 * sd)[truth.valid])
        found.append(made.extras['valid'] > 0)
        echo.append(truth.valid)
    found, echo = np.concatenate(found), np.concatenate(echo)
    return (
        float(np.sqrt(np.mean(np.square(np.concatenate(error))))),
        float(np.concatenate(inside).mean()),
        float(found[echo].mean()),
        float(found[~echo].mean()) if (~echo).any() else 0.0,
        tracker,
    )


@pytest.mark.parametrize('model_set', ['terrain', 'height_two_rw'])
def test_two_staves_far_apart_are_an_array_like_any(model_set):
    rmse, inside, found, _, tracker = run({}, model_set=model_set)
    assert rmse < 0.27 and 0.93 < inside <= 1.0 and found > 0.95
    assert tracker.warnings() == []


def test_a_floor_that_they_see_differently_is_followed_when_told():
    lost, inside, found, _, tracker = run({'decorrelation': 0.2})
    assert lost > 1.5 and found > 0.95
    assert any('decorrelation says 0%' in sentence for sentence in tracker.warnings())
    rmse, inside, found, _, tracker = run({'decorrelation': 0.2}, decorrelation=0.2)
    # In the patch the scatter models are surer than they should be: two walks have .93 inside.
    assert rmse < 0.3 and inside > 0.75 and found > 0.95
    assert tracker.warnings() == []
    assert 0.05 < tracker.health()['decorrelation'] < 0.25


def test_a_lobe_beside_the_floor_is_not_taken_for_one():
    """A level floor is a slope in the next lobe, too: one ping began there from one Gaussian."""
    config = scenario('paper', {**WIDE, 'pings': 5, 'decorrelation': 0.2, 'patch_std': 0.0})
    tracker = BathymetryTracker(
        BathymetryConfig.from_mapping({**config.instruments(), 'decorrelation': 0.2})
    )
    for each in simulate(config, 5).measurements:
        assert np.abs(tracker.process(each.measurement)[0].state).max() < 0.5


def test_their_gate_knows_shadows_by_power():
    shadow = {'shadows': (30.0, 33.0)}
    rmse, _, found, in_shadow, _ = run({**shadow, 'decorrelation': 0.2}, decorrelation=0.2)
    assert found > 0.94 and in_shadow < 0.08  # two bins at either end
    assert rmse < 0.6


@pytest.mark.parametrize('staves', [2, 8])
def test_a_diffuse_floor_far_above_the_noise_is_heard(staves):
    scene = {'staves': staves, 'snr_near_db': 60.0, 'snr_far_db': 50.0, 'decorrelation': 0.6}
    scene['spacing_wavelengths'] = 0.5
    *_, found, _, tracker = run(scene, decorrelation=0.6)
    assert found > 0.95 and not tracker.warnings()


def test_where_the_noise_is_unknown_most_loud_bins_are_lost_and_it_is_said():
    unknown = {'state_noise': False, 'decorrelation': 0.6, 'snr_near_db': 60.0}
    unknown |= {'snr_far_db': 10.0, 'spacing_wavelengths': 0.5}
    *_, found, _, tracker = run(unknown, decorrelation=0.6)
    assert found < 0.5
    assert any('state noise_variance' in each for each in tracker.warnings())
    *_, found, _, tracker = run(unknown, decorrelation=0.6, noise_variance=1.0)
    assert found > 0.9 and not tracker.warnings()


def test_the_first_return_of_a_diffuse_floor_is_found_where_the_noise_is_known():
    scene = {'first_range': 8.0, 'last_range': 40.0, 'decorrelation': 0.2}
    scene['spacing_wavelengths'] = 0.5  # wider ones are ambiguous near nadir
    rmse, *_ = run(scene, decorrelation=0.2, sonar_height=17.0, sonar_height_std=4.0)
    plain, *_ = run(scene, decorrelation=0.2)
    # Heights are counted from a sonar that is 2 m lower than told.
    assert abs(rmse - 2.0) < 0.4 and plain < 0.7


def test_spikes_on_a_coherent_floor_stay_silent():
    scene = {'staves': 8, 'spacing_wavelengths': 0.5, 'spike_probability': 0.1}
    config = scenario('paper', {**WIDE, **scene, 'snr_near_db': 45.0, 'snr_far_db': 45.0})
    simulated = simulate(config, 1)
    tracker = BathymetryTracker(BathymetryConfig())
    for each in simulated.measurements:
        made = tracker.process(each.measurement)[0]
        power = np.square(np.abs(each.measurement.iq)).mean(axis=1)
        spikes = power > 50.0 * 10**4.5
        assert spikes.sum() > 40 and made.extras['valid'][spikes].mean() < 0.1


def test_decorrelation_is_noise_that_grows_with_the_echo():
    config = scenario('paper', {'pings': 1, 'last_range': 20.0})
    ping = simulate(config, 1).measurements[0].measurement
    given = BathymetryConfig(
        model_set='height_two_rw', decorrelation=0.25, engine='gaussian',
        gate_false_alarm=1.0, sound_speed_std=2.0,
    )  # fmt: skip
    each = BathymetryTracker(given).process(ping)[0]
    signal = np.maximum(
        np.convolve(np.square(np.abs(ping.iq)).mean(axis=1), np.ones(21), 'same')
        / np.convolve(np.ones(len(ping)), np.ones(21), 'same')
        - 1.0,
        0.01,
    )
    stated = type(ping)(
        stamp_ns=ping.stamp_ns, range=ping.range, iq=ping.iq, noise_variance=1.0 + 0.25 * signal,
        signal_variance=0.75 * signal,
    )  # fmt: skip
    same = BathymetryTracker(evolve(given, decorrelation=0.0)).process(stated)[0]
    assert each.state == pytest.approx(same.state, abs=1e-9)
    assert each.covariance == pytest.approx(same.covariance, abs=1e-9)


@pytest.mark.parametrize('staves', [3, 8])
def test_a_ping_without_any_noise_is_answered(staves):
    """All samples the same: blind noise is zero but for rounding."""
    iq = np.ones((200, staves), complex)
    ping = Snapshot(stamp_ns=1, range=16.0 + 0.05 * np.arange(200), iq=iq)
    for values in ({}, {'multipath': True}, {'multipath': True, 'noise_variance': 1e-30}):
        tracker = BathymetryTracker(BathymetryConfig(particles_per_model=10, **values))
        assert np.isfinite(tracker.process(ping)[0].state).all()


def test_a_few_loud_bins_are_no_evidence():
    tracker = BathymetryTracker(BathymetryConfig())
    for count, sentences in ((150, 0), (49, 0), (1, 2)):  # 200 in all are enough
        tracker._loud.append(LoudBins(bins=count, silent=count, decorrelation=0.5))
        assert len(tracker.warnings()) == sentences


@pytest.mark.parametrize('staves', [2, 8])
def test_a_transmit_pulse_in_the_water_column_is_no_noise(staves):
    scene = {'staves': staves, 'spacing_wavelengths': 0.5, 'last_range': 45.0, 'pings': 2}
    config = scenario('water_column', scene)
    received, health = [], []
    for pulse in (0.0, 1e3):
        tracker = BathymetryTracker(BathymetryConfig())
        for each in simulate(config, 1).measurements:
            ping = each.measurement
            iq = ping.iq.copy()
            iq[:40] += pulse
            made = tracker.process(evolve(ping, iq=iq))[0]
            received.append(made.extras['valid'][ping.range > 16.0].mean())
            health.append(tracker.health()['noise_variance'])
        assert not tracker.warnings()
    assert min(received) > 0.85
    assert health[2:] == pytest.approx(health[:2], rel=0.1)


def test_most_bins_silent_is_said_whatever_their_power():
    """Noise that is stated far too high: no bin is loud, and two staves have power alone."""
    scene = {'staves': 2, 'spacing_wavelengths': 0.5, 'last_range': 45.0, 'pings': 2}
    config = scenario('paper', {**scene, 'state_noise': False})
    for noise, sentences in ((1.0, 0), (1e6, 1)):
        tracker = BathymetryTracker(BathymetryConfig(noise_variance=noise))
        for each in simulate(config, 1).measurements:
            tracker.process(each.measurement)
        found = [each for each in tracker.warnings() if 'passed over as silent' in each]
        assert len(found) == sentences


def test_a_silent_water_column_is_no_reason_to_warn():
    scene = {'first_range': 1.0, 'last_range': 22.0, 'pings': 2, 'state_noise': False}
    config = scenario('paper', scene)
    tracker = BathymetryTracker(BathymetryConfig())
    for each in simulate(config, 1).measurements:
        tracker.process(each.measurement)
    assert tracker.health()['heard_share'] < 0.5 and not tracker.warnings()
