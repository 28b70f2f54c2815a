# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Staves that are not what they should be: found from echoes, put right as far as they tell it,
and named. Two staves, wide apart, over a floor that they do not see alike. Wrong noise."""

import math

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
from helpers.tracked import BAGS
import numpy as np
import pytest

from sonar_imm.acoustics.calibration import Calibration
from sonar_imm.acoustics.coherence import common_mode
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.findings import (
    LoudBins,
    noise_warnings,
    residual_ratio,
    stave_warnings,
)
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.simulation.bathymetry import simulator
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

RANGES = 17.0 + 0.05 * np.arange(700)
PATCH = (RANGES > 30.0) & (RANGES < 40.0)
HEIGHT = 0.5 * PATCH * np.random.default_rng(9).normal(size=len(RANGES))


def pings(spoil=lambda iq: iq, count=5, **more):
    for k in range(count):
        clean = floor(HEIGHT, ranges=RANGES, seed=k, stamp_ns=1_000 + k, snr_db=22.0, **more)
        yield evolve(clean, iq=spoil(clean.iq.copy()))


def tracked(snapshots, **values):
    tracker = BathymetryTracker(BathymetryConfig(**EXACT | values))
    made = [each.columns() for snapshot in snapshots for each in tracker.process(snapshot)]
    error = np.array([np.where(t['valid'] > 0, t['height'] - HEIGHT, np.nan) for t in made])
    std = np.sqrt([t.get('cov_height_height', np.ones(len(RANGES))) for t in made])
    inside = np.nanmean(np.where(np.isnan(error), np.nan, np.abs(error) < 2.0 * std)[:, PATCH])
    scores = {
        'patch': float(np.sqrt(np.nanmean(error[:, PATCH] ** 2))),
        'inside': float(inside),
        'used': float(np.isfinite(error).mean()),
    }
    return scores, tracker, made


def without(iq, stave):
    iq[:, stave] = 0.0
    return iq


def of_noise(iq, stave):
    rng = np.random.default_rng(3)
    iq[:, stave] = 4.0 * rng.normal(size=(len(iq), 2)).view(complex)[:, 0]
    return iq


def times(iq, stave, factor):
    iq[:, stave] *= factor
    return iq


def with_noise(iq, stave, std):
    iq[:, stave] += std * np.random.default_rng(4).normal(size=(len(iq), 2)).view(complex)[:, 0]
    return iq


FAULTS = {
    'dead': (lambda iq: without(iq, 3), 'stave 3 is dead: masked'),
    'deaf': (lambda iq: of_noise(iq, 4), 'stave 4 hears noise only (coherence'),
    'weak': (lambda iq: times(iq, 1, 0.5), 'stave 1 is 6.'),
    'noisy': (lambda iq: with_noise(iq, 6, 2.5), 'stave 6 has 1'),
    'inverted': (lambda iq: times(iq, 5, -1.0), 'stave 5 is inverted: phase corrected by 180 deg'),
    'exchanged': (lambda iq: iq[:, [0, 1, 3, 2, 4, 5, 6, 7]], 'staves 2, 3 are exchanged: put'),
}


@pytest.fixture(scope='module')
def clean():
    return tracked(pings())


def test_an_array_without_faults_is_left_alone(clean):
    scores, tracker, made = clean
    _, other, as_is = tracked(pings(), calibrate_array=False, conjugate_auto=False)
    for ours, theirs in zip(made, as_is):
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs)
    assert tracker.warnings() == [] and tracker.health()['staves_live'] == 8
    assert tracker.array()['stave_gain'] == [1.0] * 8 and tracker.array()['phase_tilt_deg'] == 0.0
    assert other.array() == {} and scores['inside'] > 0.9 and scores['used'] > 0.8


@pytest.mark.parametrize('name', FAULTS)
def test_a_fault_is_put_right_and_named(clean, name):
    spoil, sentence = FAULTS[name]
    scores, tracker, _ = tracked(pings(spoil))
    said = tracker.warnings()
    assert len(said) == 1 and said[0].startswith(sentence), said
    good = clean[0]
    assert scores['patch'] < 1.12 * good['patch'], (scores, good)
    assert scores['inside'] > good['inside'] - 0.04
    assert scores['used'] > good['used'] - 0.06


def test_phases_leave_a_tilt_that_all_bins_share():
    phase = np.radians([14.0, -20.0, 9.0, 25.0, -16.0, 0.0, -12.0, 20.0])
    scores, tracker, made = tracked(pings(lambda iq: iq * np.exp(1j * phase).astype(np.complex64)))
    (sentence,) = tracker.warnings()
    assert 'are off in phase by' in sentence and 'leaves the tilt uncertain by 1.1' in sentence
    left = tracker.health()['phase_tilt_deg']
    assert 1.0 < left < 1.2 and scores['inside'] > 0.9
    aside = np.abs(made[-1]['y']) / np.cos(made[-1]['angle'])
    assert made[-1]['geometry_std'] == pytest.approx(np.radians(left) * aside, rel=1e-3)


def test_in_angles_the_tilt_is_none_and_the_phases_still_count():
    phase = np.radians([14.0, -20.0, 9.0, 25.0, -16.0, 0.0, -12.0, 20.0])
    values = {**EXACT, 'model_set': 'angle_two_rw'}
    tracker = BathymetryTracker(BathymetryConfig(**values))
    (snapshot,) = pings(lambda iq: iq * np.exp(1j * phase).astype(np.complex64), count=1)
    (found,) = tracker.process(snapshot)
    left = np.radians(tracker.health()['phase_tilt_deg'])
    assert found.covariance[:, 0, 0].min() > left**2


def test_columns_stay_when_staves_go():
    snapshots = [*pings(count=1), *pings(lambda iq: without(without(iq, 3), 4), count=1)]
    _, tracker, (before, after) = tracked(snapshots, layover='resolved')
    assert list(before) == list(after)
    assert (after['surfaces'] < 2).all() and np.isnan(after['height_2']).all()
    assert after['valid'].mean() > 0.6 and tracker.health()['staves_live'] == 6


@pytest.mark.parametrize('model_set', ['terrain', 'height_two_rw', 'angle_two_rw'])
def test_conjugated_samples_are_turned_back_and_said(model_set):
    values = {'model_set': model_set}
    good, _, _ = tracked(pings(count=2), **values)
    scores, tracker, _ = tracked(pings(np.conj, count=2), **values)
    assert scores['patch'] == pytest.approx(good['patch'], rel=0.15)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('echoes fit the other sign of the phase (log likelihood +')
    bad, *_ = tracked(pings(np.conj, count=2), conjugate_auto=False, **values)
    assert bad['patch'] > 3.0


def test_a_sign_that_is_told_right_stays():
    for values in ({}, {'conjugate': True}):
        _, tracker, _ = tracked(pings(conjugate=bool(values), count=1), **values)
        assert not tracker.warnings() and not tracker._signs['starboard'].is_turned
        assert not tracker._signs['starboard'].is_open
    # Without a tilt no floor tells the sign.
    _, tracker, _ = tracked(pings(np.conj, count=1, tilt_deg=10.0), tilt_deg=10.0)
    assert tracker._signs == {}


def test_each_side_has_a_sign_of_its_own():
    both = [evolve(each, side='port') for each in pings(np.conj, count=1)]
    both += [evolve(each, side='starboard') for each in pings(count=1)]
    scores, tracker, _ = tracked(both)
    assert tracker._signs['port'].is_turned and not tracker._signs['starboard'].is_turned
    assert scores['patch'] < 0.4
    tracker.reconfigure(evolve(tracker.config, conjugate=True))
    assert tracker._signs == {}


def test_pings_of_other_arrays_and_without_echoes_do_not_count():
    dead = evolve(Calibration.exact(8), live=np.arange(8) != 2, gain=np.eye(8)[5] + 1e-9, bins=99)
    of_four = evolve(Calibration.exact(4), bins=99)
    assert stave_warnings([dead] * 4) == [] and stave_warnings([]) == []
    assert 'stave 2 is dead: masked' in stave_warnings([of_four] * 9 + [dead] * 5)
    assert stave_warnings([dead] * 9 + [of_four] * 5) == []
    assert stave_warnings([Calibration.exact(8)] * 9) == []


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


@pytest.mark.parametrize('fading', [False, True])
@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, -0.5)])
def test_what_is_left_beside_an_echo_is_the_noise(fading, staves, spacing):
    """Whatever the echo, and whether or not its power fades: to five standard deviations."""
    rng = np.random.default_rng(5)
    T, noise = 4000, 0.3
    sines = rng.uniform(-0.9, 0.9, T)
    white = rng.normal(size=(T, staves + 1)) + 1j * rng.normal(size=(T, staves + 1))
    white *= math.sqrt(0.5)
    steer = np.exp(2j * np.pi * spacing * sines[:, None] * np.arange(staves))
    y = 7.0 * white[:, :1] * steer + math.sqrt(noise) * white[:, 1:]
    if fading:
        y *= np.sqrt(rng.exponential(size=(T, 1)))
    stated, every = np.full(T, noise), np.ones(T, bool)
    of_fading = 2.0 * (1.0 + 1.0 / (staves - 1)) - 1.0
    std = math.sqrt((of_fading if fading else 1.0 / (staves - 1)) / T)
    ratio = residual_ratio(y, sines, spacing, stated, every)
    assert abs(ratio - 1.0) < 5.0 * std
    assert residual_ratio(y, sines, spacing, 4.0 * stated, every) == pytest.approx(ratio / 4.0)
    assert math.isnan(residual_ratio(y, sines, spacing, stated, np.arange(T) < 99))


def test_the_median_ping_decides_and_a_few_are_not_enough():
    assert not noise_warnings([4.0] * 4 + [math.nan] * 50)
    assert not noise_warnings([4.0, 9.0, 1.9, 1.0, 1.0])
    (high,) = noise_warnings([4.0] * 5)
    (low,) = noise_warnings([0.25] * 5)
    assert 'cannot be true' in high and 'element_spacing' in high
    assert '0.25 times' in low and 'element_spacing' not in low


@pytest.mark.parametrize(
    'factor, warned', [(1.0, False), (4.0, True), (0.25, True), (None, False)]
)
def test_a_noise_variance_that_is_wrong_by_four_is_said(factor, warned):
    """Where none is stated there is nothing to test."""
    scene = simulator.scenario('paper', {'pings': 6})
    tracker = BathymetryTracker(BathymetryConfig(**scene.instruments()))
    for each in simulator.simulate(scene, 4).measurements:
        ping = each.measurement
        stated = factor and factor * ping.noise_variance
        tracker.process(evolve(ping, noise_variance=stated))
    assert any('cannot be true' in sentence for sentence in tracker.warnings()) == warned
    ratio = pytest.approx(1.0 / (factor or math.nan), rel=0.2, nan_ok=True)
    assert tracker.health()['residual_ratio'] == ratio


def shared(snapshot, level_db, seed=5):
    """The snapshot with a signal that is the same at all staves, in decibels over the noise."""
    rng = np.random.default_rng(seed)
    T = len(snapshot)
    both = rng.normal(size=(T, 2)).view(complex) * np.sqrt(0.5) * 10.0 ** (level_db / 20.0)
    return evolve(snapshot, iq=(snapshot.iq + both).astype(np.complex64))


def lines_and_health(snapshot, **values):
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    tracker.process(snapshot)
    return [line for line in tracker.warnings() if 'same phase' in line], tracker.health()


@pytest.mark.parametrize(
    'P, values',
    [(2, {}), (4, {}), (8, {}), (8, {'gate_false_alarm': 1.0}), (8, {'tilt_deg': 0.0})],
)
def test_a_signal_common_to_the_staves_is_said(P, values):
    clean = floor(0.0, snr_db=10.0, P=P, ranges=15.5 + 0.05 * np.arange(600))
    loud, health = lines_and_health(shared(clean, 30.0), **values)
    assert len(loud) == 1 and health['common_mode'] > 0.5
    quiet, health = lines_and_health(clean, **values)
    assert not quiet and health['common_mode'] < 0.1


def test_so_is_what_the_staves_of_one_card_share():
    clean = floor(0.0, snr_db=10.0, ranges=15.5 + 0.05 * np.arange(600))
    cards = [
        shared(clean, 30.0, seed).iq[:, part] for seed, part in ((5, np.s_[:4]), (6, np.s_[4:]))
    ]
    lines, _ = lines_and_health(evolve(clean, iq=np.hstack(cards)), gate_false_alarm=1.0)
    assert len(lines) == 1
    # A weak one under a floor is not said.
    lines, health = lines_and_health(shared(floor(0.0, snr_db=25.0), 0.0))
    assert not lines and health['common_mode'] < 0.1


@pytest.mark.parametrize('tilt_deg', [0.0, 3.0, 30.0, 60.0, 90.0])
def test_a_flat_floor_is_a_floor_wherever_the_array_looks(tilt_deg):
    ranges = 15.1 + 0.05 * np.arange(1200)
    lines, _ = lines_and_health(floor(0.0, tilt_deg=tilt_deg, ranges=ranges), tilt_deg=tilt_deg)
    assert not lines


def test_noise_has_no_common_mode():
    rng = np.random.default_rng(1)
    iq = rng.normal(size=(800, 8, 2)).view(complex)[..., 0]
    assert common_mode(iq, np.ones(800, bool)) < 0.1
    assert common_mode(np.ones((800, 8)), np.ones(800, bool)) == 1.0
    # In a quarter of the swath alone it may be a floor.
    assert common_mode(np.ones((800, 8)), np.arange(800) < 200) == 0.0


@pytest.mark.parametrize('name', ['bathymetry_paper', 'bathymetry_shadow', 'bathymetry_ship'])
def test_shipped_recordings_have_none(name):
    with BagReader(BAGS / name) as bag:
        found = [item.measurement for item in measurements_of(bag, 'bathymetry')]
    shares = [common_mode(each.iq, each.usable) for each in found if isinstance(each, Snapshot)]
    assert len(shares) > 5 and max(shares) < 0.2
