# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Hydrophones that differ: against vectors, and each fault in a record of its own."""

from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.ambient import sample_csdm, surface_noise_csdm
from sonar_imm.acoustics.hydrophones import apply_response, correct_phones, fit_phones

M, SPACING, SPEED = 16, 0.25, 1500.0
WAVE, PLACES = SPEED / SPACING, np.arange(M)
FREQUENCY = np.arange(100.0, 2801.0, 10.0)


def fitted(csdm, phones=PLACES, **options):
    return correct_phones(csdm, FREQUENCY, phones, WAVE, 0.1, **options)


@pytest.fixture(scope='module')
def vectors():
    return load_vectors('fathometer_in_the_field/phones')


@pytest.fixture(scope='module')
def clean():
    R = surface_noise_csdm(FREQUENCY, M, SPACING, [22.0, 36.0], [0.35, 0.2], SPEED)
    return sample_csdm(R + 0.01 * np.eye(M), 100, np.random.default_rng(0))


def heard(csdm, response):
    """With the responses (M,) or (F, M)."""
    c = np.broadcast_to(response, (len(FREQUENCY), M)).astype(np.complex64)
    return csdm * c[:, :, None] * c.conj()[:, None, :]


def late(seconds, phone=9):
    response = np.ones((len(FREQUENCY), M), np.complex128)
    response[:, phone] = np.exp(-2j * np.pi * FREQUENCY * seconds)
    return response


def test_response_of_the_vectors(vectors):
    wave = float(vectors['sound_speed'] / vectors['element_spacing'])
    fit = fit_phones(vectors['csdm'], vectors['frequency'], PLACES, wave)
    assert np.abs(fit.gain / vectors['gain'] - 1.0).max() < 1e-6
    assert (fit.sign == vectors['sign']).all() and (fit.sign == vectors['true_sign']).all()
    assert np.abs(fit.delay - vectors['delay']).max() < 1e-6
    assert np.abs(fit.share - vectors['share']).max() < 0.02
    corrected = apply_response(vectors['csdm'], vectors['frequency'], fit)
    power = np.einsum('fmm->fm', vectors['csdm']).real.mean()
    assert np.abs(corrected - vectors['corrected']).max() < 1e-3 * power


def test_equal_hydrophones_are_left_as_they_are(clean):
    corrected, keep, fit = fitted(clean)
    assert keep.all() and (fit.sign == 1).all()
    assert np.abs(fit.delay).max() < 2e-6
    assert np.abs(10.0 * np.log10(np.median(fit.gain, axis=0))).max() < 0.2
    assert np.abs(corrected - clean).max() < 0.2 * np.abs(clean).max()


@pytest.mark.parametrize('factor', [0.1, 0.5, 2.0])
def test_gain(clean, factor):
    response = np.where(PLACES == 5, factor, 1.0)
    corrected, keep, fit = fitted(heard(clean, response))
    assert keep.all()
    assert np.median(fit.gain[:, 5]) == pytest.approx(factor**2, rel=0.05)
    other, _, _ = fitted(clean)
    assert np.abs(corrected - other).max() < 0.05 * np.abs(other).max()


@pytest.mark.parametrize('turned', [[4], [0, 15], [3, 4, 5], [1, 3, 5, 7, 9]])
def test_signs(clean, turned):
    response = np.where(np.isin(PLACES, turned), -1.0, 1.0)
    _, keep, fit = fitted(heard(clean, response))
    assert keep.all() and (fit.sign == response).all()
    assert np.abs(fit.delay).max() < 2e-6


@pytest.mark.parametrize('seconds', [50e-6, -120e-6])
def test_a_delay(clean, seconds):
    _, _, fit = fitted(heard(clean, late(seconds)))
    assert fit.delay[9] == pytest.approx(seconds, rel=0.12)
    assert np.abs(np.delete(fit.delay, 9)).max() < 0.12 * abs(seconds)


def test_delays_of_all_are_found_but_for_a_tilt_which_stays(clean):
    delay = 30e-6 * np.random.default_rng(3).standard_normal(M)
    _, _, fit = fitted(heard(clean, np.exp(-2j * np.pi * np.outer(FREQUENCY, delay))))
    off = fit.delay - delay
    line = np.polyfit(PLACES, off, 1)
    assert np.abs(off - np.polyval(line, PLACES)).max() < 8e-6
    assert abs(line[0]) < 4e-6
    _, _, fit = fitted(heard(clean, np.exp(-2j * np.pi * np.outer(FREQUENCY, 8e-6 * PLACES))))
    assert np.abs(fit.delay).max() < 2e-6


def alone(phones, snapshots, seed):
    """Cross-spectra (F, phones, phones) of hydrophones that have nothing in common."""
    unit = np.repeat(np.eye(phones)[None], len(FREQUENCY), axis=0)
    return sample_csdm(unit, snapshots, np.random.default_rng(seed))


@pytest.mark.parametrize('place', [0, 7, 15])
def test_a_hydrophone_that_hears_something_else_is_left_out(clean, place):
    own, foreign = alone(M, 100, 4), clean.copy()
    foreign[:, place], foreign[:, :, place] = own[:, place], own[:, :, place]
    corrected, keep, fit = fitted(foreign)
    assert keep.sum() == M - 1 and not keep[place] and corrected.shape[1:] == (M - 1, M - 1)
    assert abs(fit.share[place]) < 0.05 and np.delete(fit.share, place).min() > 0.95
    assert np.abs(np.delete(fit.delay, place)).max() < 2e-6


@pytest.mark.parametrize('kind', ['8 alone', '16 alone', '3 together', '4 together', 'gains'])
def test_where_nothing_else_can_be_told_hydrophones_are_levelled_only(clean, kind):
    """Of those that hear nothing in common, of few, and where no more is asked for."""
    few = heard(clean, late(100e-6, 1))
    csdm = {
        '8 alone': alone(8, 5, 5),
        '16 alone': alone(16, 100, 5),
        '3 together': few[:, :3, :3],
        '4 together': few[:, :4, :4],
        'gains': heard(clean, late(100e-6)),
    }[kind]
    _, keep, fit = fitted(csdm, np.arange(csdm.shape[1]), full=kind != 'gains')
    assert keep.all() and (fit.sign == 1).all() and not fit.delay.any()
    assert np.isnan(fit.share).all()


def test_dead_hydrophones_leave_gaps(clean):
    alive = np.delete(PLACES, [2, 3, 10])
    response = np.ones((len(FREQUENCY), M)) * late(50e-6)
    response[:, 4] *= -1.0
    csdm = heard(clean, response)[:, alive][:, :, alive]
    _, keep, fit = fitted(csdm, alive)
    assert keep.all() and fit.sign[alive == 4] == -1 and fit.sign.sum() == len(alive) - 2
    assert fit.delay[alive == 9] == pytest.approx(50e-6, abs=6e-6)
