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
from sonar_imm.trackers.bathymetry import findings
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

RANGES = 17.0 + 0.05 * np.arange(700)
PATCH = (RANGES > 30.0) & (RANGES < 40.0)
HEIGHT = 0.5 * PATCH * np.random.default_rng(9).normal(size=len(RANGES))


def pings(spoil=lambda iq: iq, count=5, **more):
    for k in range(count):
        clean = floor(HEIGHT, ranges=RANGES, seed=k, stamp_ns=1_000 + k, snr_db=22.0, **more)
        yield evolve(clean, iq=spoil(clean.iq.copy()))


def tracked(snapshots, **values):
    """Error on the patch, share inside two deviations, share of bins used; tracker; tables."""
    tracker = BathymetryTracker(BathymetryConfig(**EXACT | values))
    made = [each.columns() for snapshot in snapshots for each in tracker.process(snapshot)]
    error = np.array([np.where(t['valid'] > 0, t['height'] - HEIGHT, np.nan) for t in made])
    std = np.sqrt([t.get('cov_height_height', np.ones(len(RANGES))) for t in made])
    heard = np.isfinite(error)
    inside = (np.abs(error) < 2.0 * std)[:, PATCH][heard[:, PATCH]].mean()
    scores = np.sqrt(np.nanmean(error[:, PATCH] ** 2)), inside, heard.mean()
    return scores, tracker, made


def changed(stave, value=None, factor=1.0, noise=0.0, seed=4):
    """What spoils the samples of staves, which are `value`, or times a factor, with noise."""

    def spoil(iq):
        white = np.random.default_rng(seed).normal(size=(len(iq), 2)).view(complex)
        iq[:, stave] = (factor * iq[:, stave] if value is None else value) + noise * white
        return iq

    return spoil


FAULTS = {
    'dead': (changed([3], 0.0), 'stave 3 is dead: masked'),
    'deaf': (changed([4], 0.0, noise=4.0, seed=3), 'stave 4 hears noise only (coherence'),
    'weak': (changed([1], factor=0.5), 'stave 1 is 6.'),
    'noisy': (changed([6], noise=2.5), 'stave 6 has 1'),
    'inverted': (changed([5], factor=-1.0), 'stave 5 is inverted: phase corrected by 180 deg'),
    'exchanged': (lambda iq: iq[:, [0, 1, 3, 2, 4, 5, 6, 7]], 'staves 2, 3 are exchanged: put'),
}


@pytest.fixture(scope='module')
def clean():
    return tracked(pings())


def test_an_array_without_faults_is_left_alone(clean):
    (_, inside, used), tracker, made = clean
    _, other, as_is = tracked(pings(), calibrate_array=False, conjugate_auto=False)
    for ours, theirs in zip(made, as_is):
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs)
    assert tracker.warnings() == [] and tracker.health()['staves_live'] == 8
    assert tracker.array()['stave_gain'] == [1.0] * 8 and tracker.array()['phase_tilt_deg'] == 0.0
    assert other.array() == {} and inside > 0.9 and used > 0.8


@pytest.mark.parametrize('name', FAULTS)
def test_a_fault_is_put_right_and_named(clean, name):
    spoil, sentence = FAULTS[name]
    (patch, inside, used), tracker, _ = tracked(pings(spoil))
    (said,) = tracker.warnings()
    assert said.startswith(sentence)
    good = clean[0]
    assert patch < 1.12 * good[0] and inside > good[1] - 0.04 and used > good[2] - 0.06


PHASES = np.exp(1j * np.radians([14.0, -20.0, 9.0, 25.0, -16.0, 0.0, -12.0, 20.0]))


def out_of_phase(iq):
    return (iq * PHASES).astype(np.complex64)


def test_phases_leave_a_tilt_that_all_bins_share():
    """In angles the tilt is none, and the phases still count."""
    (_, inside, _), tracker, (*_, last) = tracked(pings(out_of_phase))
    (sentence,) = tracker.warnings()
    assert 'are off in phase by' in sentence and 'leaves the tilt uncertain by 1.1' in sentence
    left = tracker.health()['phase_tilt_deg']
    assert 1.0 < left < 1.2 and inside > 0.9
    aside = np.abs(last['y']) / np.cos(last['angle'])
    assert last['geometry_std'] == pytest.approx(np.radians(left) * aside, rel=1e-3)
    _, tracker, (found,) = tracked(pings(out_of_phase, count=1), model_set='angle_two_rw')
    left = np.radians(tracker.health()['phase_tilt_deg'])
    assert found['cov_angle_angle'].min() > left**2


def test_columns_stay_when_staves_go():
    snapshots = [*pings(count=1), *pings(changed([3, 4], 0.0), count=1)]
    _, tracker, (before, after) = tracked(snapshots, layover='resolved')
    assert list(before) == list(after)
    assert (after['surfaces'] < 2).all() and np.isnan(after['height_2']).all()
    assert after['valid'].mean() > 0.6 and tracker.health()['staves_live'] == 6


@pytest.mark.parametrize('model_set', ['terrain', 'height_two_rw', 'angle_two_rw'])
def test_conjugated_samples_are_turned_back_and_said(model_set):
    values = {'model_set': model_set}
    (good, *_), *_ = tracked(pings(count=2), **values)
    (turned, *_), tracker, _ = tracked(pings(np.conj, count=2), **values)
    assert turned == pytest.approx(good, rel=0.15)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('echoes fit the other sign of the phase (log likelihood +')
    (bad, *_), *_ = tracked(pings(np.conj, count=2), conjugate_auto=False, **values)
    assert bad > 3.0


def test_a_sign_that_is_told_right_stays():
    for values in ({}, {'conjugate': True}):
        _, tracker, _ = tracked(pings(count=1, **values), **values)
        sign = tracker._signs['starboard']
        assert not (tracker.warnings() or sign.is_turned or sign.is_open)
    # Without a tilt no floor tells the sign.
    _, tracker, _ = tracked(pings(np.conj, count=1, tilt_deg=10.0), tilt_deg=10.0)
    assert tracker._signs == {}


def test_each_side_has_a_sign_of_its_own():
    (port,), (starboard,) = pings(np.conj, count=1), pings(count=1)
    both = [evolve(port, side='port'), evolve(starboard, side='starboard')]
    (patch, *_), tracker, _ = tracked(both)
    assert tracker._signs['port'].is_turned and not tracker._signs['starboard'].is_turned
    assert patch < 0.4
    tracker.reconfigure(evolve(tracker.config, conjugate=True))
    assert tracker._signs == {}


def test_pings_of_other_arrays_and_without_echoes_do_not_count():
    dead = evolve(Calibration.exact(8), live=np.arange(8) != 2, gain=np.eye(8)[5] + 1e-9, bins=99)
    of_four = evolve(Calibration.exact(4), bins=99)
    assert findings.stave_warnings([dead] * 4) == [] and findings.stave_warnings([]) == []
    assert 'stave 2 is dead: masked' in findings.stave_warnings([of_four] * 9 + [dead] * 5)
    assert findings.stave_warnings([dead] * 9 + [of_four] * 5) == []
    assert findings.stave_warnings([Calibration.exact(8)] * 9) == []


WIDE = {'staves': 2, 'spacing_wavelengths': 3.66, 'pings': 4, 'last_range': 57.0}
HALF = {'spacing_wavelengths': 0.5}


def heard(name, scene, seed=1, spoil=lambda ping: ping, **values):
    """Of a scene the estimates, measurements and truths, and the tracker."""
    config = scenario(name, scene)
    simulated = simulate(config, seed)
    stated = {**config.instruments(), **values}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(stated))
    pings = [spoil(each.measurement) for each in simulated.measurements]
    return [tracker.process(each)[0] for each in pings], pings, simulated.truth, tracker


def run(scene, **values):
    """RMSE, share inside two standard deviations, share of bins heard of echoes and of shadows,
    and the tracker."""
    made, _, truths, tracker = heard('paper', {**WIDE, **scene}, **values)
    error = np.concatenate([each.state[:, 0] - true.height for each, true in zip(made, truths)])
    sd = np.sqrt(np.concatenate([each.covariance[:, 0, 0] for each in made]))
    found = np.concatenate([each.extras['valid'] > 0 for each in made])
    echo = np.concatenate([true.valid for true in truths])
    rmse, inside = np.sqrt(np.mean(error[echo] ** 2)), np.mean((np.abs(error) < 2.0 * sd)[echo])
    return rmse, inside, found[echo].mean(), np.sum(found & ~echo) / max(1, (~echo).sum()), tracker


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
    scene = {**WIDE, 'pings': 5, 'decorrelation': 0.2, 'patch_std': 0.0}
    made, *_ = heard('paper', scene, 5, decorrelation=0.2)
    assert np.abs([each.state for each in made]).max() < 0.5


def test_their_gate_knows_shadows_by_power():
    scene = {'shadows': (30.0, 33.0), 'decorrelation': 0.2}
    rmse, _, found, in_shadow, _ = run(scene, decorrelation=0.2)
    assert found > 0.94 and in_shadow < 0.08 and rmse < 0.6  # two bins at either end


@pytest.mark.parametrize('staves', [2, 8])
def test_a_diffuse_floor_far_above_the_noise_is_heard(staves):
    scene = {'staves': staves, 'snr_near_db': 60.0, 'snr_far_db': 50.0, 'decorrelation': 0.6}
    *_, found, _, tracker = run(scene | HALF, decorrelation=0.6)
    assert found > 0.95 and not tracker.warnings()


def test_where_the_noise_is_unknown_most_loud_bins_are_lost_and_it_is_said():
    unknown = {'state_noise': False, 'decorrelation': 0.6, 'snr_near_db': 60.0, 'snr_far_db': 10.0}
    *_, found, _, tracker = run(unknown | HALF, decorrelation=0.6)
    assert found < 0.5
    assert any('state noise_variance' in each for each in tracker.warnings())
    *_, found, _, tracker = run(unknown | HALF, decorrelation=0.6, noise_variance=1.0)
    assert found > 0.9 and not tracker.warnings()


def test_the_first_return_of_a_diffuse_floor_is_found_where_the_noise_is_known():
    scene = {'first_range': 8.0, 'last_range': 40.0, 'decorrelation': 0.2, **HALF}
    rmse, *_ = run(scene, decorrelation=0.2, sonar_height=17.0, sonar_height_std=4.0)
    plain, *_ = run(scene, decorrelation=0.2)
    # Heights are counted from a sonar that is 2 m lower than told.
    assert abs(rmse - 2.0) < 0.4 and plain < 0.7


def test_spikes_on_a_coherent_floor_stay_silent():
    loud = {'snr_near_db': 45.0, 'snr_far_db': 45.0, 'spike_probability': 0.1}
    made, pings, *_ = heard('paper', {**WIDE, **HALF, **loud, 'staves': 8})
    for each, ping in zip(made, pings):
        spikes = np.square(np.abs(ping.iq)).mean(axis=1) > 50.0 * 10**4.5
        assert spikes.sum() > 40 and each.extras['valid'][spikes].mean() < 0.1


def test_decorrelation_is_noise_that_grows_with_the_echo():
    config = scenario('paper', {'pings': 1, 'last_range': 20.0})
    ping = simulate(config, 1).measurements[0].measurement
    power, ones = np.square(np.abs(ping.iq)).mean(axis=1), np.ones(21)
    mean = np.convolve(power, ones, 'same') / np.convolve(np.ones(len(ping)), ones, 'same')
    signal = np.maximum(mean - 1.0, 0.01)
    stated = evolve(ping, noise_variance=1.0 + 0.25 * signal, signal_variance=0.75 * signal)
    values = {'model_set': 'height_two_rw', 'engine': 'gaussian', 'gate_false_alarm': 1.0}
    (each,), (same,) = (
        BathymetryTracker(BathymetryConfig(decorrelation=share, **values)).process(snapshot)
        for snapshot, share in ((ping, 0.25), (stated, 0.0))
    )
    assert each.state == pytest.approx(same.state, abs=1e-9)
    assert each.covariance == pytest.approx(same.covariance, abs=1e-9)


@pytest.mark.parametrize('staves', [3, 8])
def test_a_ping_without_any_noise_is_answered(staves):
    """All samples the same: blind noise is zero but for rounding."""
    ranges, iq = 16.0 + 0.05 * np.arange(200), np.ones((200, staves), complex)
    for values in ({}, {'multipath': True}, {'multipath': True, 'noise_variance': 1e-30}):
        tracker = BathymetryTracker(BathymetryConfig(particles_per_model=10, **values))
        (made,) = tracker.process(Snapshot(stamp_ns=1, range=ranges, iq=iq))
        assert np.isfinite(made.state).all()


def with_pulse(ping):
    iq = ping.iq.copy()
    iq[:40] += 1e3
    return evolve(ping, iq=iq)


@pytest.mark.parametrize('staves', [2, 8])
def test_a_transmit_pulse_in_the_water_column_is_no_noise(staves):
    scene, noise = {'staves': staves, **HALF, 'last_range': 45.0, 'pings': 2}, []
    for spoil in (lambda ping: ping, with_pulse):
        made, pings, _, tracker = heard('water_column', scene, spoil=spoil)
        for each, ping in zip(made, pings):
            assert each.extras['valid'][ping.range > 16.0].mean() > 0.85
        noise.append(tracker.health()['noise_variance'])
        assert not tracker.warnings()
    assert noise[1] == pytest.approx(noise[0], rel=0.1)


def test_most_bins_silent_is_said_whatever_their_power():
    """Noise that is stated far too high: no bin is loud, and two staves have power alone. A silent
    water column is no reason."""
    scene = {**WIDE, **HALF, 'last_range': 45.0, 'pings': 2, 'state_noise': False}
    for noise, sentences in ((1.0, 0), (1e6, 1)):
        tracker = heard('paper', scene, noise_variance=noise)[-1]
        found = [each for each in tracker.warnings() if 'passed over as silent' in each]
        assert len(found) == sentences
    scene = {'first_range': 1.0, 'last_range': 22.0, 'pings': 2, 'state_noise': False}
    tracker = heard('paper', scene)[-1]
    assert tracker.health()['heard_share'] < 0.5 and not tracker.warnings()


@pytest.mark.parametrize('fading', [False, True])
@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, -0.5)])
def test_what_is_left_beside_an_echo_is_the_noise(fading, staves, spacing):
    """Whatever the echo, and whether or not its power fades: to five standard deviations."""
    rng, T, noise, share = np.random.default_rng(5), 4000, 0.3, 1.0 / (staves - 1)
    sines = rng.uniform(-0.9, 0.9, T)
    white = rng.normal(size=(T, staves + 1)) + 1j * rng.normal(size=(T, staves + 1))
    white *= math.sqrt(0.5)
    steer = np.exp(2j * np.pi * spacing * sines[:, None] * np.arange(staves))
    y = 7.0 * white[:, :1] * steer + math.sqrt(noise) * white[:, 1:]
    if fading:
        y *= np.sqrt(rng.exponential(size=(T, 1)))

    def ratio(factor=1.0, bins=T):
        stated = np.full(T, factor * noise)
        return findings.residual_ratio(y, sines, spacing, stated, np.arange(T) < bins)

    std = math.sqrt((1.0 + 2.0 * share if fading else share) / T)
    assert abs(ratio() - 1.0) < 5.0 * std
    assert ratio(4.0) == pytest.approx(ratio() / 4.0)
    assert math.isnan(ratio(bins=99))


def test_the_median_ping_decides_and_a_few_are_not_enough():
    assert not findings.noise_warnings([4.0] * 4 + [math.nan] * 50)
    assert not findings.noise_warnings([4.0, 9.0, 1.9, 1.0, 1.0])
    (high,), (low,) = (findings.noise_warnings([ratio] * 5) for ratio in (4.0, 0.25))
    assert 'cannot be true' in high and 'element_spacing' in high
    assert '0.25 times' in low and 'element_spacing' not in low
    tracker = BathymetryTracker(BathymetryConfig())
    for count, sentences in ((150, 0), (49, 0), (1, 2)):  # 200 loud bins in all are enough
        tracker._loud.append(findings.LoudBins(bins=count, silent=count, decorrelation=0.5))
        assert len(tracker.warnings()) == sentences


@pytest.mark.parametrize(
    'factor, warned', [(1.0, False), (4.0, True), (0.25, True), (None, False)]
)
def test_a_noise_variance_that_is_wrong_by_four_is_said(factor, warned):
    """Where none is stated there is nothing to test."""

    def wrong(ping):
        return evolve(ping, noise_variance=factor and factor * ping.noise_variance)

    tracker = heard('paper', {'pings': 6}, 4, wrong)[-1]
    assert any('cannot be true' in sentence for sentence in tracker.warnings()) == warned
    ratio = pytest.approx(1.0 / (factor or math.nan), rel=0.2, nan_ok=True)
    assert tracker.health()['residual_ratio'] == ratio


def shared(snapshot, level_db, seed=5):
    """The snapshot with a signal that is the same at all staves, in decibels over the noise."""
    both = np.random.default_rng(seed).normal(size=(len(snapshot), 2)).view(complex)
    both *= np.sqrt(0.5) * 10.0 ** (level_db / 20.0)
    return evolve(snapshot, iq=(snapshot.iq + both).astype(np.complex64))


def lines_and_health(snapshot, **values):
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    tracker.process(snapshot)
    return [line for line in tracker.warnings() if 'same phase' in line], tracker.health()


BINS = 15.5 + 0.05 * np.arange(600)


@pytest.mark.parametrize(
    'P, values',
    [(2, {}), (4, {}), (8, {'gate_false_alarm': 1.0}), (8, {'tilt_deg': 0.0}), (8, {})],
)
def test_a_signal_common_to_the_staves_is_said(P, values):
    """Or to those of one card."""
    clean = floor(0.0, snr_db=10.0, P=P, ranges=BINS)
    loud, other = (shared(clean, 30.0, seed) for seed in (5, 6))
    lines, health = lines_and_health(loud, **values)
    assert len(lines) == 1 and health['common_mode'] > 0.5
    lines, health = lines_and_health(clean, **values)
    assert not lines and health['common_mode'] < 0.1
    if values == {'gate_false_alarm': 1.0}:
        cards = evolve(clean, iq=np.hstack([loud.iq[:, :4], other.iq[:, 4:]]))
        assert len(lines_and_health(cards, **values)[0]) == 1


def test_a_weak_one_under_a_floor_is_not():
    lines, health = lines_and_health(shared(floor(0.0), 0.0))
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
