# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fixes from a real recording: an acoustic tag towed past 19 hydrophones, hand-held GPS as truth.

Time of arrival has a standard deviation of 0.9 ms here (1.4 m): with it the chi-square of the
residuals is what it should be. The error against GPS is larger, since the tag is towed behind
the receiver and GPS itself is metres-grade.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from sonar_imm.acoustics.localisation import Localisation, localise

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get('SONAR_IMM_DATA', ROOT / '../shared/data')) / 'yaps_ssu1'
SIGMA_TOA, SOUND_SPEED, TAG_Z = 0.9e-3, 1545.0, -1.0

pytestmark = pytest.mark.skipif(
    not (DATA / 'arrivals.csv').exists(),
    reason=('the recording yaps_ssu1 is not here: set SONAR_IMM_DATA to the folder that holds it'),
)


def table(name):
    return np.genfromtxt(DATA / name, delimiter=',', skip_header=1)


@pytest.fixture(scope='module')
def results():
    arrivals, receivers = table('arrivals.csv'), table('receivers.csv')
    places = np.column_stack([receivers[:, 1:3], -receivers[:, 3]])
    return [
        localise(
            places[rows[:, 1].astype(int)], rows[:, 2], np.full(len(rows), SIGMA_TOA**2),
            target_z=TAG_Z, sound_speed=SOUND_SPEED,
        )
        for rows in (arrivals[arrivals[:, 0] == ping] for ping in np.unique(arrivals[:, 0]))
    ]  # fmt: skip


@pytest.fixture(scope='module')
def fixes(results):
    return [result for result in results if isinstance(result, Localisation)]


def gps_errors(stamps, positions, lag=0.0):
    gps = table('gps_truth.csv')
    stamps = stamps + lag
    inside = (stamps >= gps[0, 0]) & (stamps <= gps[-1, 0])
    truth = np.column_stack([np.interp(stamps, gps[:, 0], gps[:, axis]) for axis in (1, 2)])
    return np.linalg.norm(positions - truth, axis=1)[inside]


def test_every_ping_of_four_receivers_gives_a_fix(results, fixes):
    assert len(fixes) == 119
    assert {each.reason for each in results if each not in fixes} == {'too_few'}


def test_residuals_are_what_the_noise_says(fixes):
    ratio = sum(fix.cost for fix in fixes) / sum(fix.dof for fix in fixes)
    assert 0.85 < ratio < 1.15
    assert sum((~fix.used).sum() for fix in fixes) <= 10


def test_error_against_gps_is_as_small_as_that_of_the_reference_fixes(fixes):
    stamps = np.array([fix.emission_time for fix in fixes])
    positions = np.array([fix.position for fix in fixes])
    reference = table('fixes.csv')
    ours = gps_errors(stamps, positions)
    theirs = gps_errors(reference[:, 0], reference[:, 1:3])
    assert len(ours) == len(theirs) == 116
    assert np.median(ours) < 1.02 * np.median(theirs)
    assert np.sqrt(np.mean(ours**2)) < 1.02 * np.sqrt(np.mean(theirs**2))
    # The tag follows the GPS receiver some seconds later.
    assert np.sqrt(np.mean(gps_errors(stamps, positions, lag=3.4) ** 2)) < 3.0


def test_fixes_agree_with_the_reference_fixes(fixes):
    reference = table('fixes.csv')
    stamps = np.array([fix.emission_time for fix in fixes])
    nearest = np.abs(stamps[:, None] - reference[:, 0]).argmin(axis=1)
    assert np.abs(stamps - reference[nearest, 0]).max() < 0.01
    apart = np.linalg.norm([fix.position for fix in fixes] - reference[nearest, 1:3], axis=1)
    assert np.median(apart) < 1.0
