# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Velocities, behaviours and forecasts of collisions against sums done by hand, and on a run."""

import json

from attrs import evolve
from helpers.obstacle_bags import tracked
import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.obstacle.scoring import forecast_scores, forecasts, motion_metrics
from sonar_imm_tools.evaluation.obstacle.series import match, series_of, TruePath

SECOND = 10**9


def estimate(second, distance, risk, velocity=(0.0, 0.0), does=(1.0, 0.0, 0.0, 0.0)):
    """One confirmed track at bearing and offset 0, with a variance of 0.01 of its velocity."""
    unit = np.ones(1)
    return Estimate(
        stamp_ns=second * SECOND,
        frame_id='odom',
        xyz=np.zeros((1, 3), np.float32),
        state_names=('range', 'bearing', 'vertical_offset'),
        state=np.array([[distance, 0.0, 0.0]]),
        covariance=np.eye(3)[None],
        model_names=('above', 'below'),
        probabilities=np.full((1, 2), 0.5),
        extras={
            **{f'prob_{name}': share * unit for name, share in zip(BEHAVIOURS, does)},
            'vx': velocity[0] * unit,
            'vy': velocity[1] * unit,
            'vel_cov_x_x': 0.01 * unit,
            'vel_cov_x_y': 0.0 * unit,
            'vel_cov_y_y': 0.01 * unit,
            'collision_probability': risk * unit,
            'track_id': np.ones(1, np.uint32),
            'track_state': np.ones(1, np.uint8),
            'vertical_offset_lo': -unit,
            'vertical_offset_hi': unit,
            'nis': 2.0 * unit,
        },
    )


def path(distances, offset=0.0, velocity=(0.0, 0.0), does=0):
    """An obstacle that was at these distances in seconds 1, 2, ..."""
    n = len(distances)
    seen = np.column_stack([distances, np.zeros(n), np.full(n, offset)])
    stamps = np.arange(1, n + 1) * SECOND
    given = np.tile(velocity, (n, 1)), np.full(n, does)
    return TruePath(1, stamps, seen, np.ones(n, bool), *given)


def matched(estimates, truth):
    return match(series_of(estimates), (truth,), cutoff=5.0, gap=60.0)


def test_scores_are_those_done_by_hand():
    moving = path(np.arange(60.0, 0.0, -2.0), velocity=(0.5, -0.2), does=2)
    estimates = [
        estimate(10, 42.0, 0.4, (0.6, -0.2), (0.1, 0.1, 0.8, 0.0)),
        estimate(11, 40.0, 0.8, (0.5, 0.0), (0.0, 0.0, 1.0, 0.0)),
    ]
    metrics = motion_metrics(matched(estimates, moving), (moving,), ObstacleConfig())
    scores = metrics['velocity']['moving']
    assert scores['rmse_m_s'] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 4.0))
    assert scores['nees']['mean'] == pytest.approx((1.0 + 4.0) / 2.0)
    still = path(np.arange(60.0, 0.0, -2.0))
    alone = motion_metrics(matched(estimates[:1], still), (still,), ObstacleConfig())['velocity']
    assert alone == {'still': {'n': 1, 'rmse_m_s': pytest.approx(np.sqrt((0.36 + 0.04) / 2.0))}}
    assert metrics['behaviours']['confusion']['moving'] == pytest.approx(
        {'n': 2, 'fixed': 0.05, 'swaying': 0.05, 'moving': 0.9, 'seabed': 0.0}
    )
    assert metrics['behaviours']['brier'] == pytest.approx((0.01 + 0.01 + 0.04) / 2.0)
    # It comes as near as 2 m: both forecasts of a collision within 3 m come true.
    assert metrics['collisions']['brier'] == pytest.approx((0.36 + 0.04) / 2.0)
    assert metrics['collisions']['bins']['0.3 to 0.6'] == {'n': 1, 'stated': 0.4, 'came_true': 1.0}


@pytest.mark.parametrize(
    'distances, offset, came',
    [
        ([40.0, 20.0, 2.0, 20.0], 0.0, [1, 1, 1, 0]),  # hit, and then passed
        ([40.0, 20.0, 4.0, 20.0], 0.0, [0, 0, 0, 0]),  # passed too far aside
        ([40.0, 20.0, 2.9, 20.0], 2.5, [0, 0, 0, 0]),  # below
        ([40.0, 30.0, 20.0, 10.0], 0.0, []),  # the truth ends before anyone can know
    ],
)
def test_a_forecast_counts_where_its_outcome_is_known(distances, offset, came):
    truth = path(distances, offset)
    found = matched([estimate(k + 1, d, 0.5) for k, d in enumerate(distances)], truth)
    found = evolve(found, row=np.arange(4), target=np.zeros(4, int))
    stated, happened = forecasts(found, (truth,), ObstacleConfig())
    assert happened.astype(int).tolist() == came
    assert len(stated) == len(came)


def test_what_comes_after_the_horizon_is_no_collision():
    truth = path([40.0, 30.0, 20.0, 10.0, 1.0, 10.0])
    found = matched([estimate(k + 1, 10.0, 0.5) for k in range(6)], truth)
    found = evolve(found, row=np.arange(6), target=np.zeros(6, int))
    _, happened = forecasts(found, (truth,), ObstacleConfig(cpa_horizon=2.0))
    assert happened.astype(int).tolist() == [0, 0, 1, 1, 1, 0]


def test_within_the_horizon_of_the_end_of_the_truth_nothing_is_known():
    truth = path([40.0, 30.0, 20.0, 10.0])
    found = matched([estimate(k + 1, 10.0, 0.5) for k in range(4)], truth)
    found = evolve(found, row=np.arange(4), target=np.zeros(4, int))
    _, happened = forecasts(found, (truth,), ObstacleConfig(cpa_horizon=2.0))
    assert happened.astype(int).tolist() == [0, 0]


def test_forecasts_as_often_right_as_stated_lie_on_the_diagonal():
    rng = np.random.default_rng(1)
    stated = rng.uniform(0.0, 1.0, 20_000)
    scores = forecast_scores(stated, rng.uniform(size=20_000) < stated)
    assert scores['brier'] == pytest.approx(1.0 / 6.0, abs=0.01)
    for score in scores['bins'].values():
        assert score['came_true'] == pytest.approx(score['stated'], abs=0.04)


def test_what_was_not_told_is_not_scored():
    plain = TruePath(1, path([9.0] * 9).stamp_ns, path([9.0] * 9).seen, np.ones(9, bool))
    found = matched([estimate(8, 9.0, np.nan)], plain)
    assert motion_metrics(found, (plain,), ObstacleConfig()) == {}


def test_a_run_is_scored_and_the_page_shows_the_calibration(tmp_path):
    changes = {'first_range': 45.0, 'last_range': -25.0, 'vertical_offset': 0.5}
    folder = tracked(tmp_path, 'mover', 2, **changes)
    page = tmp_path / 'page.html'
    assert main(['evaluate', str(folder), '--report', str(page)]) == 0
    metrics = json.loads((folder / 'metrics.json').read_text())
    assert metrics['velocity']['moving']['rmse_m_s'] < 0.3
    assert metrics['behaviours']['confusion']['moving']['moving'] > 0.9
    assert metrics['collisions']['n'] > 20
    assert 'Calibration of the probability of a collision' in page.read_text()
