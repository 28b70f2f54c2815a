# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle tracker on approaches computed elsewhere, with the exact posterior beside them."""

from helpers.obstacle_runs import (
    approach,
    EXACT,
    FAITHFUL,
    FIXED,
    follow,
    lever,
    meta,
    rows,
    run,
    SECOND,
    track_approach,
)
from helpers.obstacle_sea import column, encounter, ENCOUNTERS, KINDS, oldest, track, tracked
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

NOISY = ('approach_dst+3_noisy', 'approach_level_mirror_noisy')
NOISE_FREE = ('approach_dst+0.5_noisefree', 'approach_dst+3_noisefree')
SHARP = {'range_std': 0.01, 'bearing_std_deg': 0.01}


@pytest.mark.parametrize('name', NOISY)
def test_posterior_is_the_exact_one(name):
    estimates = track_approach(name, **FAITHFUL)
    coarse = track_approach(name, **{**FAITHFUL, 'components': 9})
    for exact in meta(name)['oracle_posterior_flat_prior_pm12']:
        estimate = estimates[exact['ping']]
        assert len(estimate) == 1
        assert estimate.state[0, 2] == pytest.approx(exact['mean_dst'], abs=0.05)
        assert np.sqrt(estimate.covariance[0, 2, 2]) == pytest.approx(exact['sd'], abs=0.05)
        assert estimate.probabilities[0, 0] == pytest.approx(exact['p_above'], abs=0.02)
        nine = coarse[exact['ping']].state[0, 2]  # slices do as well
        assert nine == pytest.approx(exact['mean_dst'], abs=0.1)


@pytest.mark.parametrize('name', NOISE_FREE)
def test_without_noise_the_offset_is_found(name):
    exact = {**FAITHFUL, **SHARP, 'components': 61}
    final, true = track_approach(name, **exact), rows(name)['true_dst']
    assert final[60].state[0, 2] == pytest.approx(true[60], abs=0.1)
    assert final[-1].state[0, 2] == pytest.approx(true[-1], abs=0.03)


@pytest.mark.parametrize(
    'kind, values',
    [
        ('noisy', {}),
        ('noisefree', {}),
        ('noisy', {'components': 5}),
        ('noisy', {'components': 6}),
        ('noisy', {'scale_std': 0.0}),
    ],
)
def test_a_level_path_cannot_tell_above_from_below(kind, values):
    """From the first ping on, although the prior reaches further up than down."""
    estimates = track_approach(f'approach_level_mirror_{kind}', max_tracks=1, **FIXED, **values)
    for ping, estimate in enumerate(estimates[1:]):
        assert estimate.probabilities[0, 0] == pytest.approx(0.5, abs=0.005)
        if ping > 40:
            assert estimate.extras['vertical_offset_lo'][0] < -3.0
            assert estimate.extras['vertical_offset_hi'][0] > 3.0


def test_nor_can_it_with_all_behaviours():
    """The sea floor lies on one side only; it is ruled out soon, and does not last."""
    name = 'approach_level_mirror_noisy'
    moving = track_approach(name, max_tracks=1, behaviours=('fixed', 'swaying', 'moving'))
    assert_allclose([item.probabilities[0, 0] for item in moving[1:]], 0.5, atol=0.005)
    everything = track_approach(name, max_tracks=1, **EXACT)
    assert_allclose([item.probabilities[0, 0] for item in everything[28:]], 0.5, atol=0.01)
    assert everything[-1].extras['vertical_offset_lo'][0] < -3.0
    assert everything[-1].extras['vertical_offset_hi'][0] > 3.0


def test_estimates_are_where_the_obstacle_is():
    """Range, bearing to port and place in ENU against the file, without noise."""
    name = 'approach_dst+3_noisefree'
    estimates = track_approach(name, **{**FAITHFUL, **SHARP})
    north, east, down = meta(name)['obstacle_ned']
    truth = rows(name)
    for ping in (60, 100):
        estimate = estimates[ping]
        assert estimate.state[0, 0] == pytest.approx(truth['true_range'][ping], abs=0.01)
        assert estimate.state[0, 1] == pytest.approx(-truth['true_delta'][ping], abs=2e-4)
        assert_allclose(estimate.xyz[0], [east, north, -down], atol=0.15)
        spread = [np.sqrt(estimate.extras[f'place_cov_{a}_{a}'][0]) for a in 'xyz']
        assert np.all(
            np.abs(estimate.xyz[0] - [east, north, -down]) < 4.0 * np.array(spread) + 0.01
        )


def test_outliers_are_taken_for_what_they_are():
    """One echo in eight is off by up to 8 m and 6 degrees."""
    name = 'approach_dst+3_noisy'
    true = rows(name)['true_dst'][-1]
    config = ObstacleConfig(sonar_lever=lever(name), **FIXED)

    def squared(mean, variance):
        return (mean - true) ** 2 / variance

    whole, believed = [], []
    for seed in range(4):
        given = with_outliers(approach(name), seed)
        view = follow(given, config)[1]
        believed.append(squared(view.state[0, 2], view.covariance[0, 2, 2]))
        last = list(run(ObstacleTracker(config), given).values())[-1]
        row = int(np.argmin(last.extras['track_id']))
        whole.append(squared(last.state[row, 2], last.covariance[row, 2, 2]))
    assert np.mean(whole) < 2.0
    assert np.mean(believed) > 10.0


def with_outliers(measurements, seed):
    rng = np.random.default_rng(seed)
    return [
        Detections(
            stamp_ns=item.stamp_ns,
            range=item.range + rng.uniform(-8.0, 8.0),
            bearing=item.bearing + np.radians(rng.uniform(-6.0, 6.0)),
        )
        if isinstance(item, Detections) and i > 9 and rng.uniform() < 0.125
        else item
        for i, item in enumerate(measurements)
    ]


# The whole tracker on recorded encounters, beside what an independent filter made of them.


SETTLED = 30
"""Pings after which the answers are compared."""


def tracks_of(estimates):
    """The numbers of the confirmed tracks."""
    sure = [item.extras['track_id'][item.extras['track_state'] > 0] for item in estimates]
    return {int(number) for ids in sure for number in ids}


@pytest.mark.parametrize('name, number', ENCOUNTERS)
def test_answers_are_those_of_an_independent_filter(name, number):
    """It knows how far obstacles sway: while one begins to move they differ more."""
    data, estimates = tracked(name, number, **EXACT)
    assert tracks_of(estimates) == {1}
    pings = np.arange(SETTLED, len(estimates))
    offset = column(estimates, 'vertical_offset', pings)
    assert_allclose(offset, data['ref_offset'][pings], atol=0.1)
    probability = np.stack([column(estimates, f'prob_{kind}', pings) for kind in KINDS], -1)
    begins = name == 'starts_moving'
    off = np.abs(probability - data['ref_prob'][pings]).max(axis=1) > (0.1 if begins else 0.05)
    # That filter takes the first echo of a mover for an outlier.
    assert off.sum() <= (2 if begins else 0)
    assert_allclose(probability.sum(axis=-1), 1.0, atol=1e-9)
    velocity = np.stack([column(estimates, item, pings) for item in ('vx', 'vy')], -1)
    off = np.abs(velocity - data['ref_v'][pings]).max(axis=1) > (0.05 if begins else 0.01)
    assert off.sum() <= (2 if begins else 0)
    assert_allclose(column(estimates, 'prob_above', pings), data['ref_above'][pings], atol=0.05)
    for end in ('lo', 'hi'):
        stated = column(estimates, f'vertical_offset_{end}', pings)
        assert_allclose(stated, data[f'ref_{end}'][pings], atol=0.2)


@pytest.mark.parametrize('number', [0, 1])
def test_a_new_obstacle_is_believed_to_be_where_the_study_believes_it(number):
    """The slices end at the sea floor, which is one: without, the offset is 0.7 m another."""
    data, estimates = tracked('seabed_and_fixed', number, **EXACT)
    pings = np.arange(4, SETTLED)
    offset = column(estimates, 'vertical_offset', pings)
    assert_allclose(offset, data['ref_offset'][pings], atol=0.35)
    seabed = column(estimates, 'prob_seabed', pings)
    assert_allclose(seabed, data['ref_prob'][pings, KINDS.index('seabed')], atol=0.06)


@pytest.mark.parametrize('name, number', ENCOUNTERS)
def test_the_true_behaviour_is_found(name, number):
    kind = {'sway': 'swaying', 'move': 'moving', 'go': 'moving'}
    data, estimates = tracked(name, number)
    true, last = kind.get(str(data['kind']), str(data['kind'])), estimates[-1]
    assert last.extras[f'prob_{true}'][0] > (0.5 if true == 'seabed' else 0.9)


def test_only_the_behaviours_asked_for_are_published():
    data = encounter('starts_moving')
    begin = {name: data[name] if name == 'sonar_lever_flu' else data[name][:11]
             for name in data if data[name].ndim}  # fmt: skip
    for asked in (('moving', 'fixed'), ('swaying',), ('fixed',)):
        extras = track(begin, behaviours=asked)[10].extras
        assert {name for name in extras if name.startswith('prob_')} == {
            f'prob_{name}' for name in asked
        }
        assert sum(extras[f'prob_{name}'] for name in asked) == pytest.approx(1.0)


def test_without_altitude_there_is_no_sea_floor():
    _, estimates = tracked('seabed_and_fixed', altitude=False)
    assert_allclose(column(estimates, 'prob_seabed', range(1, 40)), 0.0)


def test_the_place_is_as_deep_as_the_offset_says():
    """Also where a hypothesis lies deeper than the echo is far, as those of a near echo do."""
    data, estimates = tracked('seabed_and_fixed', 1)
    for estimate in estimates[1::5]:
        row = oldest(estimate)
        assert_allclose(
            row['place_cov_z_z'], row['cov_vertical_offset_vertical_offset'], rtol=1e-9
        )
        k = int(np.argmin(np.abs(SECOND + data['t'] * SECOND - estimate.stamp_ns)))
        sonar = Rotation.from_quat(data['odom_q'][k]).apply(data['sonar_lever_flu'])
        sonar += data['odom_p'][k]
        assert_allclose(row['z'], sonar[2] - row['vertical_offset'], atol=1e-4)
