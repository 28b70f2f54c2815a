# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A swath of an array whose staves are not what they should be: found from its own echoes, put
right as far as they tell it, and named."""

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
import numpy as np
import pytest

from sonar_imm.acoustics.calibration import Calibration
from sonar_imm.trackers.bathymetry.findings import stave_warnings
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

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
    bad, tracker, _ = tracked(pings(np.conj, count=2), conjugate_auto=False, **values)
    assert bad['patch'] > 3.0 and not tracker.warnings()[:0]


def test_a_sign_that_is_told_right_stays():
    for values in ({}, {'conjugate': True}):
        _, tracker, _ = tracked(pings(conjugate=bool(values), count=1), **values)
        assert not tracker.warnings() and not tracker._signs['starboard'].is_turned
        assert not tracker._signs['starboard'].is_open


def test_without_a_tilt_no_floor_tells_the_sign():
    snapshots = pings(np.conj, count=1, tilt_deg=10.0)
    _, tracker, _ = tracked(snapshots, tilt_deg=10.0)
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
