# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A judge of obstacle runs: against sums done by hand, and on real runs."""

import json

from attrs import evolve
from helpers.obstacle_runs import tracked_by_command as tracked
import numpy as np
import pytest
from scipy.special import ndtr

from sonar_imm.estimates import Estimate, places
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.judging import judge, JudgeOptions
from sonar_imm_tools.evaluation.obstacle import figures, scoring
from sonar_imm_tools.evaluation.obstacle.series import match, series_of, TruePath, truth_of
from sonar_imm_tools.offline.run_folder import RunFolder

SECOND = 10**9


def estimate(second, rows):
    """Rows (track_id, track_state, range, bearing, offset, sigma, low, high, above)."""
    rows = np.reshape(rows, (-1, 9)).astype(float)
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, [0, 1], [0, 1]] = 1e-2, 1e-4
    covariance[:, 2, 2] = rows[:, 5] ** 2
    extras = {
        'track_id': rows[:, 0].astype(np.uint32), 'track_state': rows[:, 1].astype(np.uint8),
        'vertical_offset_lo': rows[:, 6], 'vertical_offset_hi': rows[:, 7],
        'nis': np.full(len(rows), 2.0),
    }  # fmt: skip
    return Estimate(
        stamp_ns=second * SECOND, frame_id='odom', xyz=rows[:, 2:5].astype(np.float32),
        state_names=('range', 'bearing', 'vertical_offset'), state=rows[:, 2:5],
        covariance=covariance, model_names=('above', 'below'),
        probabilities=np.column_stack([rows[:, 8], 1.0 - rows[:, 8]]), extras=extras,
    )  # fmt: skip


def straight(track_id, offset, bearing=0.0, count=20):
    """An obstacle that comes 2 m nearer each second from 60 m, always in the beam."""
    ones, t = np.ones(count), np.arange(count)
    seen = np.column_stack([60.0 - 2.0 * t, bearing * ones, offset * ones])
    return TruePath(track_id, (t + 1) * SECOND, seen, ones > 0.0)


def row(track_id, distance, bearing, state=1, offset=3.0):
    return [track_id, state, distance, bearing, offset, 1.0, 2.0, 5.0, 0.1]


def test_of_true_deviations_nine_in_ten_lie_in_the_shaded_band():
    """4 m stated where 3 m are true, at a range of 42 m."""
    series = series_of([estimate(10, [row(4, 42.0, 0.0, offset=4.0)])])
    _, found = scoring.score(series, (straight(1, 3.0),), cutoff=5.0, gap=60.0)
    figure = figures.error_figure(found)
    (band,), (points,) = figure.layout.shapes, figure.data
    assert np.ravel(points.x) == pytest.approx([42.0])
    assert np.ravel(points.y) == pytest.approx(found.series.covariance[:1, 2, 2] ** -0.5)
    assert ndtr(band.y1) - ndtr(band.y0) == pytest.approx(0.9, abs=1e-3)


def test_the_image_is_seen_from_above_with_starboard_to_the_right():
    ping = Detections(stamp_ns=SECOND, range=[20.0, 40.0], bearing=[0.5, -1.0])
    series = series_of([estimate(10, [row(4, 10.0, 0.2)])])
    figure = figures.image_figure(series, [ping], (straight(1, 3.0, bearing=0.1),))
    assert (figure.layout.yaxis.scaleanchor, figure.layout.yaxis.scaleratio) == ('x', 1)
    path = 60.0 - 2.0 * np.arange(20), 0.1
    places = [(ping.range, ping.bearing), path, (10.0, 0.2)]
    for drawn, (distance, bearing) in zip(figure.data, places, strict=True):
        np.testing.assert_allclose(np.ravel(drawn.x), -distance * np.sin(bearing), atol=0.01)
        np.testing.assert_allclose(np.ravel(drawn.y), distance * np.cos(bearing), atol=0.01)


def test_the_map_shows_the_way_and_names_each_track():
    rows, level = [row(k, 10.0 * k, 0.2) for k in (4, 7)], [0.0, 0.0, 0.0, 1.0]
    way = [
        Navigation(stamp_ns=s * SECOND, position=[3.0 * s, s, 0.0], orientation=level)
        for s in (1, 2)
    ]
    (section,) = figures.map_section(series_of([estimate(10, rows)]), way, None)
    vehicle, *tracks = section.figure.data
    assert list(vehicle.x) == [3.0, 6.0] and list(vehicle.y) == [1.0, 2.0]
    assert vehicle.hovertemplate is None
    for track, number, x in zip(tracks, (4, 7), (40.0, 70.0), strict=True):
        assert list(track.x) == [x] and list(track.y) == pytest.approx([0.2])
        assert track.hovertemplate.startswith(f'track {number}: ')


def test_scores_are_those_done_by_hand():
    # At seconds 10 and 11 the range is 42 and 40 m. One track is 1 m too deep, then 2 m; the band
    # holds the truth once; a false track and a tentative one are about.
    ten = [4, 1, 42.3, 0.0, 4.0, 1.0, 2.0, 5.0, 0.1], [5, 1, 20.0, 0.3, 0, 1.0, -1.0, 1.0, 0.5]
    eleven = [4, 2, 40.0, 0.01, 5.0, 1.0, 4.0, 6.0, 0.2], [6, 0, 40.0, 0, 3.0, 1.0, 2.0, 4.0, 0.5]
    series = series_of([estimate(10, ten), estimate(11, eleven)])
    assert series.place[1] == pytest.approx([20.0, 0.3])
    metrics, found = scoring.score(series, (straight(1, 3.0),), cutoff=5.0, gap=60.0)
    assert (metrics['pings'], metrics['span_s']) == (2, 1.0)
    assert metrics['vertical_offset']['rmse_m'] == pytest.approx(np.sqrt((1.0 + 4.0) / 2.0))
    assert metrics['range']['rmse_m'] == pytest.approx(0.3 / np.sqrt(2.0))
    assert metrics['bearing']['rmse_deg'] == pytest.approx(np.degrees(0.01) / np.sqrt(2.0))
    assert metrics['vertical_offset_near']['n'] == 2
    consistency = metrics['consistency']
    assert consistency['nees_offset']['mean'] == pytest.approx(2.5)
    assert [consistency[name]['dof'] for name in ('nees_offset', 'nees_state')] == [1, 3]
    assert consistency['band_coverage'] == 0.5
    assert metrics['above']['brier'] == pytest.approx((0.01 + 0.04) / 2.0)
    stated = {'n': 2, 'stated': pytest.approx(0.15), 'came_true': 0.0}
    assert metrics['above']['bins']['0.1 to 0.3'] == stated
    # GOSPA: sqrt(0.3^2 + 5^2/2), sqrt((40 * 0.01)^2).
    chord = np.hypot(40.0 * (1.0 - np.cos(0.01)), 40.0 * np.sin(0.01))
    assert metrics['gospa']['mean_m'] == pytest.approx((np.sqrt(0.09 + 12.5) + chord) / 2.0)
    assert metrics['gospa']['false_per_ping'] == pytest.approx(0.5)
    counts = {'true_obstacles': 1, 'found_obstacles': 1, 'tracks': 2, 'false_tracks': 1}
    assert metrics['tracks'] == {**counts, 'identity_switches': 0}
    assert found.target.tolist() == [0, 0]


def test_an_obstacle_taken_over_by_another_track_is_a_switch():
    """At second t the range is 62 - 2 t. Track 4 is lost at 8 and comes back as 9 (a switch); the
    other obstacle, 0.4 rad to port, loses track 5 for a ping only (none). Had the tracks changed
    places, both obstacles would have been taken over."""
    first, ninth = [row(4, 48.0, 0.0), row(5, 48.0, 0.4)], [row(5, 44.0, 0.4), row(9, 44.0, 0.0)]
    swapped = [row(4, 44.0, 0.4), row(5, 44.0, 0.0)]
    truth = (straight(1, 3.0), straight(2, 3.0, bearing=0.4))
    for scans, switches in (
        ({7: first, 8: [], 9: ninth, 10: [row(9, 42.0, 0.0)]}, 1),
        ({7: first, 9: swapped}, 2),
    ):
        series = series_of([estimate(*scan) for scan in scans.items()])
        metrics, _ = scoring.score(series, truth, cutoff=5.0, gap=60.0)
        assert metrics['tracks']['identity_switches'] == switches


def test_an_obstacle_is_asked_for_from_its_sixth_ping_until_it_is_passed():
    path = straight(1, -3.0)
    wanted = path.there(path.stamp_ns, 60.0)
    assert wanted.tolist() == [False] * 5 + [True] * 15
    aside = path.seen * [1.0, 0.0, 1.0] + [0.0, 1.5, 0.0]
    passed = TruePath(1, path.stamp_ns, aside, path.in_beam)
    assert not passed.there(path.stamp_ns, 60.0).any()
    blind = TruePath(1, path.stamp_ns, path.seen, np.zeros(20, bool))
    assert not blind.there(path.stamp_ns, 60.0).any()


def test_truth_is_one_path_per_obstacle_interpolated_but_not_across_gaps():
    tables = []
    for second in range(1, 9):
        table = estimate(second, [row(k, 60.0 - 2.0 * second, 0.0) for k in (1, 2)])
        in_beam = np.array([second > 1, second > 3], np.uint8)
        tables.append(evolve(table, extras={**table.extras, 'in_beam': in_beam}))
    first, second = truth_of(tables, lag=0.5)
    assert (first.track_id, second.track_id) == (1, 2)
    assert first.stamp_ns[0] == SECOND // 2 and first.seen[0].tolist() == [58.0, 0.0, 3.0]
    assert (first.in_beam.sum(), second.in_beam.sum()) == (7, 5)
    # Only the first one was in the beam for six pings.
    assert [path.there(path.stamp_ns, 60.0).sum() for path in (first, second)] == [2, 0]
    path = straight(1, 3.0)
    half = path.at(np.array([SECOND // 2, 3 * SECOND // 2, 30 * SECOND]), 60.0)
    assert half[1].tolist() == [59.0, 0.0, 3.0] and np.isnan(half[[0, 2]]).all()
    assert np.isnan(path.at(np.array([3 * SECOND // 2]), 0.5)).all()


def test_estimates_and_truth_of_something_else_are_refused():
    place = {name: np.zeros(1, np.float32) for name in 'xyz'}
    bare = [Estimate.from_columns(place, stamp_ns=1, frame_id='')]
    for read, words in ((series_of, 'not those of obstacles'), (truth_of, "no column 'range'")):
        with pytest.raises(ValueError, match=words):
            read(bare)


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    return tracked(tmp_path_factory.mktemp('tethers'))


def test_a_run_of_two_moored_spheres_is_judged(run, tmp_path):
    verdict = judge(RunFolder(run), JudgeOptions())
    metrics = verdict.metrics
    assert metrics['tracks']['found_obstacles'] == 2 and metrics['tracks']['false_tracks'] == 0
    assert metrics['range']['rmse_m'] < 0.2 and metrics['bearing']['rmse_deg'] < 0.3
    off = min(abs(metrics['tether_m'] - length) for length in (15.0, 12.0))
    assert off < 2.0 * metrics['tether_std_m'] < 3.0
    assert verdict.accuracy(None).good and not verdict.accuracy(0.01).good
    assert 'obstacles were found' in verdict.summary
    titles = [section.title for section in verdict.part([]).sections]
    assert {'Height over range', 'Image of the sonar', 'Above or below'} <= set(titles)
    assert main(['evaluate', str(run), '--report', str(tmp_path / 'report.html')]) == 0
    assert 'Dotted: truth, while the beam' in (tmp_path / 'report.html').read_text()


def test_the_length_of_a_tether_is_that_at_the_first_echo_of_a_vehicle_that_dives():
    """An obstacle 8 m below the sonar at first, which sinks towards it by 0.2 m each second."""
    estimates = []
    for k in range(20):
        below, ahead = 8.0 - 0.2 * k, 60.0 - 2.0 * k
        rows = [[4, 1, np.hypot(ahead, below), 0.0, below, 1.0 + k, below - 1.0, below + 2.0, 0.1]]
        rows += [[5, 1, 30.0, 0.4, 1.0, 1.0, 0.0, 2.0, 0.1]] if k < 5 else []
        at = np.array([[0.0, 0.0, -18.0], [0.0, 0.0, -11.0]])[: len(rows)]
        table = estimate(k + 1, rows)
        estimates.append(evolve(table, extras={**table.extras, **places(at)}))
    series = series_of(estimates)
    config = ObstacleConfig(sonar_lever=(0.0, 0.0, -0.5), altitude_std=0.3)
    heights = [Altitude(stamp_ns=k * SECOND, altitude=20.0 + k - 1) for k in (9, 1, 3)]
    found = scoring.tether_length(series, heights, config)
    assert found['tether_m'] == pytest.approx(19.5 - 8.0)
    # As sure as the last echo made it.
    assert found['tether_std_m'] == pytest.approx(np.hypot(20.0, 0.3))
    late = [Altitude(stamp_ns=k * SECOND, altitude=20.0) for k in (7, 8)]
    nothing = series.pick(np.zeros(len(series), bool))
    for rows, known in ((series, late), (series, []), (nothing, heights)):
        assert scoring.tether_length(rows, known, config) == {}


def test_without_truth_and_bag_or_without_a_track_there_is_still_a_page(run, tmp_path):
    folder = RunFolder(tmp_path / 'lonely')
    folder.path.mkdir()
    folder.write_estimates(RunFolder(run).read_estimates(), 'obstacle')
    folder.write_json('run.json', {**RunFolder(run).read_run(), 'bag': str(tmp_path / 'gone')})
    verdict = judge(folder)
    assert verdict.accuracy(None) is None and 'no truth' in verdict.summary
    assert verdict.part([]).sections
    verdict = judge(RunFolder(tracked(tmp_path, 'approach', detection_probability=0.0)))
    assert not verdict.accuracy(None).good and verdict.part([]).sections


# -- velocities, behaviours and forecasts of collisions -------------------------------------------


def moving_estimate(second, distance, risk, velocity=(0.0, 0.0), does=(1.0, 0.0, 0.0, 0.0)):
    """One confirmed track at bearing and offset 0, with a variance of 0.01 of its velocity."""
    made = estimate(second, [[1, 1, distance, 0.0, 0.0, 1.0, -1.0, 1.0, 0.5]])
    more = {
        **{f'prob_{name}': share for name, share in zip(BEHAVIOURS, does)}, 'vx': velocity[0],
        'vy': velocity[1], 'vel_cov_x_x': 0.01, 'vel_cov_x_y': 0.0, 'vel_cov_y_y': 0.01,
        'collision_probability': risk,
    }  # fmt: skip
    return evolve(made, extras={**made.extras, **{k: np.array([v]) for k, v in more.items()}})


def path(distances, offset=0.0, velocity=(0.0, 0.0), does=0):
    """An obstacle that was at these distances in seconds 1, 2, ..."""
    n = len(distances)
    seen = np.column_stack([distances, np.zeros(n), np.full(n, offset)])
    given = np.ones(n, bool), np.tile(velocity, (n, 1)), np.full(n, does)
    return TruePath(1, np.arange(1, n + 1) * SECOND, seen, *given)


def matched(estimates, truth):
    return match(series_of(estimates), (truth,), cutoff=5.0, gap=60.0)


def test_scores_of_motion_are_those_done_by_hand():
    ways = np.arange(60.0, 0.0, -2.0)
    moving, still = path(ways, velocity=(0.5, -0.2), does=2), path(ways)
    estimates = [
        moving_estimate(10, 42.0, 0.4, (0.6, -0.2), (0.1, 0.1, 0.8, 0.0)),
        moving_estimate(11, 40.0, 0.8, (0.5, 0.0), (0.0, 0.0, 1.0, 0.0)),
    ]
    config = ObstacleConfig()
    metrics = scoring.motion_metrics(matched(estimates, moving), (moving,), config)
    scores = metrics['velocity']['moving']
    assert scores['rmse_m_s'] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 4.0))
    assert scores['nees']['mean'] == pytest.approx((1.0 + 4.0) / 2.0)
    alone = scoring.motion_metrics(matched(estimates[:1], still), (still,), config)['velocity']
    assert alone == {'still': {'n': 1, 'rmse_m_s': pytest.approx(np.sqrt((0.36 + 0.04) / 2.0))}}
    shares = {'n': 2, 'fixed': 0.05, 'swaying': 0.05, 'moving': 0.9, 'seabed': 0.0}
    assert metrics['behaviours']['confusion']['moving'] == pytest.approx(shares)
    assert metrics['behaviours']['brier'] == pytest.approx((0.01 + 0.01 + 0.04) / 2.0)
    # It comes as near as 2 m: both forecasts of a collision within 3 m come true.
    assert metrics['collisions']['brier'] == pytest.approx((0.36 + 0.04) / 2.0)
    assert metrics['collisions']['bins']['0.3 to 0.6'] == {'n': 1, 'stated': 0.4, 'came_true': 1.0}
    # What was not told is not scored.
    plain = TruePath(1, moving.stamp_ns, moving.seen, moving.in_beam)
    found = matched([moving_estimate(8, 46.0, np.nan)], plain)
    assert scoring.motion_metrics(found, (plain,), config) == {}


def test_a_forecast_counts_where_its_outcome_is_known():
    """Each estimate is matched with the obstacle; after the horizon is no collision."""
    for distances, offset, came, more in (
        ([40.0, 20.0, 2.0, 20.0], 0.0, [1, 1, 1, 0], {}),  # hit, and then passed
        ([40.0, 20.0, 4.0, 20.0], 0.0, [0, 0, 0, 0], {}),  # passed too far aside
        ([40.0, 20.0, 2.9, 20.0], 2.5, [0, 0, 0, 0], {}),  # below
        ([40.0, 30.0, 20.0, 10.0], 0.0, [], {}),  # the truth ends before anyone can know
        ([40.0, 30.0, 20.0, 10.0, 1.0, 10.0], 0.0, [0, 0, 1, 1, 1, 0], {'cpa_horizon': 2.0}),
        ([40.0, 30.0, 20.0, 10.0], 0.0, [0, 0], {'cpa_horizon': 2.0}),  # known up to its horizon
    ):
        truth, n = path(distances, offset), len(distances)
        found = matched([moving_estimate(k + 1, d, 0.5) for k, d in enumerate(distances)], truth)
        found = evolve(found, row=np.arange(n), target=np.zeros(n, int))
        stated, happened = scoring.forecasts(found, (truth,), ObstacleConfig(**more))
        assert happened.astype(int).tolist() == came and len(stated) == len(came)


def test_forecasts_as_often_right_as_stated_lie_on_the_diagonal():
    rng = np.random.default_rng(1)
    stated = rng.uniform(0.0, 1.0, 20_000)
    scores = scoring.forecast_scores(stated, rng.uniform(size=20_000) < stated)
    assert scores['brier'] == pytest.approx(1.0 / 6.0, abs=0.01)
    for each in scores['bins'].values():
        assert each['came_true'] == pytest.approx(each['stated'], abs=0.04)


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
