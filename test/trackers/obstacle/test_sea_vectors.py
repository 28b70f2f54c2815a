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

"""The whole tracker on recorded encounters, beside what an independent filter made of them."""

from helpers.obstacle_runs import SECOND
from helpers.obstacle_sea import column, encounter, ENCOUNTERS, KINDS, oldest, track
import numpy as np
from numpy.testing import assert_allclose
import pytest

SETTLED = 30
"""Pings after which the answers are compared."""


def tracks_of(estimates):
    return {int(number) for estimate in estimates for number in estimate.extras['track_id']}


@pytest.mark.parametrize('name, number', ENCOUNTERS)
def test_answers_are_those_of_an_independent_filter(name, number):
    """Mixing e as one quantity, merging across slices, a wrong ``step`` or axes of the velocity:
    each leaves the errors of a steady obstacle alone and shows here. That filter knows how far
    obstacles sway and ours does not: while one begins to move they differ more."""
    data = encounter(name, number)
    estimates = track(data)
    assert tracks_of(estimates) == {1}
    pings = np.arange(SETTLED, len(estimates))
    offset = column(estimates, 'vertical_offset', pings)
    assert_allclose(offset, data['ref_offset'][pings], atol=0.1)
    probability = np.stack([column(estimates, f'prob_{kind}', pings) for kind in KINDS], -1)
    begins = name == 'starts_moving'
    assert_allclose(probability, data['ref_prob'][pings], atol=0.1 if begins else 0.05)
    assert_allclose(probability.sum(axis=-1), 1.0, atol=1e-9)
    velocity = np.stack([column(estimates, item, pings) for item in ('vx', 'vy')], -1)
    assert_allclose(velocity, data['ref_v'][pings], atol=0.05 if begins else 0.01)
    assert_allclose(column(estimates, 'prob_above', pings), data['ref_above'][pings], atol=0.05)
    for end in ('lo', 'hi'):
        stated = column(estimates, f'vertical_offset_{end}', pings)
        assert_allclose(stated, data[f'ref_{end}'][pings], atol=0.2)


@pytest.mark.parametrize('number', [0, 1])
def test_a_new_obstacle_is_believed_to_be_where_the_study_believes_it(number):
    """The slices end at the sea floor, and the sea floor is a slice: while little is known, the
    offset is 0.7 to 1 m another and the sea floor 0.2 less probable without."""
    data = encounter('seabed_and_fixed', number)
    estimates = track(data)
    pings = np.arange(4, SETTLED)
    offset = column(estimates, 'vertical_offset', pings)
    assert_allclose(offset, data['ref_offset'][pings], atol=0.35)
    seabed = column(estimates, 'prob_seabed', pings)
    assert_allclose(seabed, data['ref_prob'][pings, KINDS.index('seabed')], atol=0.06)


@pytest.mark.parametrize('name, number', ENCOUNTERS)
def test_the_true_behaviour_is_found(name, number):
    kind = {'sway': 'swaying', 'move': 'moving', 'go': 'moving'}
    data = encounter(name, number)
    true = kind.get(str(data['kind']), str(data['kind']))
    last = track(data)[-1]
    assert last.extras[f'prob_{true}'][0] > (0.5 if true == 'seabed' else 0.9)


def test_a_mover_is_lost_without_the_behaviour():
    """Why it is there: under `fixed` alone the same echoes make many tracks."""
    data = encounter('moving_target')
    assert len(tracks_of(track(data, behaviours=('fixed',)))) >= 4


def test_only_the_behaviours_asked_for_are_published():
    data = encounter('starts_moving')
    for asked in (('moving', 'fixed'), ('swaying',), ('fixed',)):
        extras = track(data, behaviours=asked)[10].extras
        assert {name for name in extras if name.startswith('prob_')} == {
            f'prob_{name}' for name in asked
        }
        assert sum(extras[f'prob_{name}'] for name in asked) == pytest.approx(1.0)


def test_without_altitude_there_is_no_sea_floor():
    estimates = track(encounter('seabed_and_fixed', 0), altitude=False)
    assert_allclose(column(estimates, 'prob_seabed', range(40)), 0.0)


def test_velocity_is_east_and_north():
    """A mistake of the axes shows in no error of the offset."""
    data = encounter('moving_target')
    last = track(data)[-1]
    assert_allclose([last.extras['vx'][0], last.extras['vy'][0]], data['true_v'][-1], atol=0.12)
    for i, a in enumerate('xy'):
        spread = np.sqrt(last.extras[f'vel_cov_{a}_{a}'][0])
        assert 0.005 < spread < 0.3
        error = last.extras[f'v{a}'][0] - data['true_v'][-1, i]
        assert abs(error) < 4.0 * spread


def test_the_place_is_as_deep_as_the_offset_says():
    """Also where a hypothesis lies deeper than the echo is far, as those of a near echo do."""
    data = encounter('seabed_and_fixed', 1)
    for estimate in track(data)[::5]:
        row = oldest(estimate)
        assert_allclose(
            row['place_cov_z_z'], row['cov_vertical_offset_vertical_offset'], rtol=1e-9
        )
        k = int(np.argmin(np.abs(SECOND + data['t'] * SECOND - estimate.stamp_ns)))
        sonar = data['odom_p'][k] + turned(data['odom_q'][k], data['sonar_lever_flu'])
        assert_allclose(row['z'], sonar[2] - row['vertical_offset'], atol=1e-4)


def turned(q, vector):
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q).apply(vector)
