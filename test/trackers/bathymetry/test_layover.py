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

"""Layover in the tracker: what `gated` marks, and that nothing else changes."""

from attrs import evolve
from helpers.bathymetry_cases import floor
import numpy as np
import pytest

from sonar_imm.acoustics import layover
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

NEW = ['existence_2', 'surfaces']


def step(at=slice(150, 200), up=2.0, **more):
    """A flat floor on which bins `at` have a second surface `up` metres above it."""
    snapshot, above = floor(0.0, seed=1, **more), floor(up, seed=2, **more)
    iq = snapshot.iq.copy()
    iq[at] += above.iq[at]
    return evolve(snapshot, iq=iq)


def run(snapshot, **values):
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    return tracker, tracker.process(snapshot)[0]


@pytest.mark.parametrize('values', [{}, {'model_set': 'height_bank'}, {'engine': 'grid'}])
def test_a_gated_bin_is_marked_and_nothing_else_changes(values):
    snapshot = step()
    tracker, gated = run(snapshot, layover='gated', **values)
    ignored_by, ignored = run(snapshot, layover='ignored', **values)
    a, b = gated.columns(), ignored.columns()
    assert [name for name in a if name not in b] == NEW
    for name in b:
        if name not in ('valid', 'told'):
            np.testing.assert_array_equal(a[name], b[name])
    two = a['surfaces'] == 2
    assert two[150:200].mean() > 0.7 and not two[:145].any() and not two[205:].any()
    np.testing.assert_array_equal(a['valid'], b['valid'] & ~two)
    np.testing.assert_array_equal(a['told'], np.where(two, 2, b['told']))
    np.testing.assert_array_equal(a['surfaces'] == 0, b['valid'] == 0)
    np.testing.assert_array_equal(two, a['existence_2'] > np.float32(layover.GATE))
    assert a['existence_2'].dtype == np.float32 and a['surfaces'].dtype == np.uint8
    assert tracker.counts['bins_two'] == two.sum() > 0
    assert 'bins_two' not in ignored_by.counts and 'array_error' not in ignored_by.health()
    assert tracker.health()['array_error'] >= layover.LEAST_ERROR


def test_silent_bins_have_no_second_surface():
    _, made = run(step(shadow=slice(150, 200), at=slice(0, 0)), layover='gated')
    silent = made.extras['surfaces'] == 0
    assert silent[150:200].mean() > 0.9
    assert (made.extras['existence_2'][silent] == 0.0).all()


@pytest.mark.parametrize('values', [{'multipath': True}, {'variant': 'paper'}])
def test_surface_echoes_and_the_paper_leave_layover_alone(values):
    _, made = run(floor(0.0), layover='gated', **values)
    assert not set(NEW) & set(made.extras)


@pytest.mark.parametrize('staves', [2, 3, 4])
def test_few_staves_are_gated_too(staves):
    tracker, made = run(floor(0.0, P=staves), layover='gated')
    assert tracker.counts['bins_two'] <= 2 and 'surfaces' in made.extras


def test_a_wrong_array_is_warned_of():
    rng = np.random.default_rng(1)
    snapshot = floor(0.0, snr_db=35.0)
    off = np.exp(1j * np.radians(rng.normal(0.0, 12.0, 8)))
    tracker, _ = run(snapshot, layover='gated')
    assert not tracker.warnings()
    tracker, made = run(evolve(snapshot, iq=snapshot.iq * off), layover='gated')
    assert any('plane wave' in sentence for sentence in tracker.warnings())
    assert tracker.health()['array_error'] > 0.01
    assert (made.extras['surfaces'] == 2).mean() < 0.05
