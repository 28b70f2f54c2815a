# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of floors whose errors are known by hand, runs from a recording to the page, tuning."""

import json
import math

from attrs import evolve
from helpers.bathymetry_cases import floor
from helpers.commands import run
import numpy as np
from oracles.bin_likelihood import log_likelihood
import pytest

from sonar_imm.acoustics import array
from sonar_imm.acoustics.laplace import log_constant
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.markov import persistent
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig, MODEL_SETS
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry import (
    figures,
    METRICS,
    scoring,
    summary_sentence,
    truth_topics,
)
from sonar_imm_tools.evaluation.bathymetry.predictive import for_tuning, Scored, tunables
from sonar_imm_tools.evaluation.bathymetry.scoring import profile_of, profiles_of, score
from sonar_imm_tools.evaluation.judging import judge, JudgeOptions
from sonar_imm_tools.evaluation.numbers import cards, lines
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate
from sonar_imm_tools.survey.chart import Chart

N = 20
PATCH = slice(8, 14)


def profile(*, height=0.1, rough=slice(9, 15), known=True, shadow=slice(0, 0), valid=None, at=0):
    """Twenty bins of a floor at 0 with a patch in 8..13; estimates are off by `height`."""
    probabilities = np.tile([0.9, 0.1], (N, 1))
    probabilities[rough] = [0.2, 0.8]
    patch, echo = np.zeros(N, bool), np.ones(N, bool)
    patch[PATCH], echo[shadow] = True, False
    truth = scoring.TrueFloor(np.zeros(N), np.full(N, 0.1), patch, echo)
    return scoring.Profile(
        stamp_ns=at, range=20.0 + np.arange(N), height=np.full(N, height),
        height_std=np.full(N, 0.06), angle=np.full(N, 0.1 + np.radians(2.0)),
        angle_std=np.full(N, 0.01), valid=np.ones(N, bool) if valid is None else valid,
        probabilities=probabilities, truth=truth if known else None,
    )  # fmt: skip


def swath(*profiles):
    return scoring.Swath(profiles, ('rw_smooth', 'rw_rough'), np.array([False, True]))


def test_a_ping_shades_patch_and_band_and_the_chart_has_small_cells_north_up(
    monkeypatch,
):
    figure = figures.profile_figure(drawn := profile())
    ((begin, end),) = [(shape.x0, shape.x1) for shape in figure.layout.shapes]
    assert (begin, end) == (drawn.range[PATCH][0], drawn.range[PATCH][-1])
    edges = np.concatenate([np.asarray(trace.y, float) for trace in figure.data[:2]])
    assert (edges.min(), edges.max()) == pytest.approx((0.1 - 0.12, 0.1 + 0.12))
    depth = np.array([[5.0, 6.0, 7.0], [8.0, 9.0, np.nan]])
    bands = dict.fromkeys(('depth', 'uncertainty', 'label', 'count'), depth)
    track = np.array([[101.0, 46.0], [106.0, 50.0]])
    cells, ship = figures.chart_figure(Chart(100.0, 50.0, 2.0, bands), track).data
    assert list(cells.x) == [101.0, 103.0, 105.0] and list(cells.y) == [49.0, 47.0]
    np.testing.assert_array_equal(cells.z, -depth)
    assert list(ship.x) == [101.0, 106.0] and list(ship.y) == [46.0, 50.0]
    assert cells.customdata.shape == (2, 3, 3)
    made, record = [], {'parameters': BathymetryConfig().as_dict()}
    monkeypatch.setattr(figures, 'chart_of', lambda points, size, *_: made.append(size))
    for extent in (10.0, 17.0, 900.0):
        figures.finest_chart({'x': np.array([0.0, extent]), 'y': np.zeros(2)}, record)
    assert made == [0.1, 0.25, 6.0]


def test_errors_by_place_and_the_share_inside_the_band():
    ground = profile()
    ground.height[PATCH] = 0.3
    metrics = score(swath(ground))
    every = np.sqrt((14 * 0.01 + 6 * 0.09) / N)
    rmse = {place: metrics['height'][place]['rmse_m'] for place in ('smooth', 'patch', 'all')}
    assert rmse == pytest.approx({'smooth': 0.1, 'patch': 0.3, 'all': every})
    assert metrics['height']['all']['n'] == N
    assert metrics['angle']['all']['rmse_deg'] == pytest.approx(2.0)
    inside = {'smooth': 1.0, 'patch': 0.0, 'all': 0.7, 'shadow': np.nan}
    assert metrics['inside_band'] == pytest.approx(inside, nan_ok=True)


@pytest.mark.parametrize('patch, both', [(PATCH, True), (slice(0, N), False), (slice(0), False)])
def test_smooth_floor_and_patches_are_told_apart_where_there_are_both(patch, both):
    drawn = profile()
    drawn.truth.patch[:] = False
    drawn.truth.patch[patch] = True
    metrics = score(swath(drawn))
    shown = {card.title for card in cards(METRICS, metrics)}
    assert ({'On smooth floor, RMS', 'In rough patches, RMS'} <= shown) == both
    assert ('where it is smooth' in summary_sentence(metrics)) == both


def test_overlap_and_delay_of_the_segmentation():
    # Labels 9..14 against the patch 8..13: five of seven bins, one late in, one late out.
    found = score(swath(profile()))['segmentation']
    assert found['iou'] == pytest.approx(5 / 7)
    assert found['recall'] == found['precision'] == pytest.approx(5 / 6)
    assert (found['bins_late_in'], found['bins_late_out']) == (1.0, 1.0)
    missed = score(swath(profile(rough=slice(0, 2))))['segmentation']
    assert (missed['patches'], missed['patches_missed'], missed['iou']) == (1, 1, 0.0)
    to_the_end = score(swath(profile(rough=slice(8, N))))['segmentation']
    assert (to_the_end['bins_late_in'], to_the_end['bins_late_out']) == (0.0, 6.0)


def test_what_is_called_smooth_and_rough_and_how_much_of_it_is():
    verdict = np.full(N, 2.0)
    verdict[:4], verdict[8:10], verdict[12:16] = 0, 0, 1
    called = evolve(profile(), verdict=verdict)
    metrics = score(swath(called))
    shares = {'smooth': 0.3, 'rough': 0.2, 'cannot_tell': 0.5}
    right = {'smooth_right': 4 / 6, 'rough_right': 0.5}
    assert metrics['verdicts'] == pytest.approx(shares | right)
    assert dict(lines(METRICS, metrics))['of these right, smooth / rough'] == '66.7 % / 50.0 %'
    unknown = score(swath(evolve(called, truth=None)))
    assert set(unknown['verdicts']) == {'smooth', 'rough', 'cannot_tell'}
    assert 'verdicts' not in score(swath(profile()))
    marks = figures.verdict_figure(called, np.zeros(N)).data[-1]
    assert list(marks.x) == list(called.range[verdict == 2])


def test_shadow_is_scored_apart():
    valid = np.ones(N, bool)
    valid[:3] = False
    metrics = score(swath(profile(shadow=slice(0, 4), valid=valid)))
    assert metrics['height']['all']['n'] == N - 4
    assert metrics['height']['shadow']['n'] == 4
    assert metrics['gate'] == {'shadow_bins': 4, 'shadow_passed_over': 0.75, 'echo_heard': 1.0}
    told = ' '.join(name for name, _ in lines(METRICS, metrics))
    for words in ('height error, all', 'angle error, all', 'shadow passed over'):
        assert words in told


def test_without_truth_the_tracker_speaks_for_itself_and_has_words_without_a_ping_too():
    metrics = score(swath(profile(known=False), profile(known=False, at=10**9)))
    assert metrics['pings'] == 2 and metrics['bins'] == 2 * N and metrics['span_s'] == 1.0
    assert metrics['rough_share'] == pytest.approx(0.3)
    assert metrics['height_std_median_m'] == pytest.approx(0.06)
    assert 'height' not in metrics and 'no truth' in summary_sentence(metrics)
    assert dict(lines(METRICS, metrics))['bins with an echo'] == '100 %'
    none = score(scoring.Swath((), (), np.zeros(0, bool)))
    assert summary_sentence(none).startswith('0 pings with 0 range bins') and lines(METRICS, none)


def test_runs_of_bins_and_which_models_are_rough():
    assert scoring.runs(np.array([1, 1, 0, 1, 0, 0, 1], bool)) == [(0, 2), (3, 4), (6, 7)]
    assert scoring.runs(np.zeros(4, bool)) == scoring.runs(np.zeros(0, bool)) == []
    assert scoring.rough_models(('rw', 'ncs')).tolist() == [True, False]
    assert scoring.rough_models(('rw_smooth', 'rw_rough')).tolist() == [False, True]
    assert scoring.rough_models(('steady', 'winding', 'walk')).tolist() == [False, False, True]
    assert scoring.rough_models(('rw_smooth',)).tolist() == [False]
    assert not len(scoring.rough_models(()))


def test_both_heights_are_compared_with_the_nearest_surface():
    two = np.zeros(N, bool)
    two[4:8] = True
    height = np.full(N, 0.1)
    height[4:8] = 2.2  # the lower estimate lies near what is strongest
    truth = evolve(
        profile().truth, height=np.where(two, 2.0, 0.0), surfaces=np.where(two, 2, 1),
        height_2=np.where(two, 3.0, np.nan),
    )  # fmt: skip
    unsure = np.zeros(N, bool)
    unsure[15] = True
    upper = np.where(two, 2.6, np.nan), np.where(two, 0.15, np.nan)
    given = {'truth': truth, 'height': height, 'two': two, 'upper': upper, 'unsure': unsure}
    item = evolve(profile(valid=~unsure), **given)
    scores = (metrics := score(swath(item)))['layover']
    assert (scores['bins'], scores['found'], scores['lost']) == (4, 1.0, 0.0)
    assert scores['heights']['n'] == 8
    assert scores['heights']['rmse_m'] == pytest.approx(np.sqrt((0.2**2 + 0.4**2) / 2.0))
    assert scores['heights']['inside_band'] == 0.0
    every = np.sqrt((4 * 0.2**2 + 16 * 0.1**2) / N)
    assert metrics['height']['all']['rmse_m'] == pytest.approx(every)
    assert metrics['heard_share'] == 1.0
    words = dict(lines(METRICS, metrics))
    assert words['two surfaces: found / single bins taken for two'] == '100 % / 0.0 %'
    names = [trace.name for trace in figures.profile_figure(item).data]
    assert 'upper surface' in names and 'truth, second surface' in names
    assert 'one surface or two: no sounding' in names


# -- estimate and truth side by side --------------------------------------------------------------

RANGES = np.array([20.0, 20.5, 21.0, 21.5])


def estimate(state='height', *, stamp_ns=7, ranges=RANGES):
    n = len(ranges)
    other = 'angle' if state == 'height' else 'height'
    return Estimate(
        stamp_ns=stamp_ns, frame_id='sonar', xyz=np.tile([0.0, -8.0, -15.0], (n, 1)),
        state_names=(state,), state=np.full((n, 1), 0.25), covariance=np.full((n, 1, 1), 0.04),
        model_names=('rw_smooth', 'rw_rough'), probabilities=np.tile([0.9, 0.1], (n, 1)),
        extras={'range': ranges, other: np.full(n, 0.5), 'valid': np.array([1, 1, 0, 1][:n])},
    )  # fmt: skip


def truth(ranges, *, stamp_ns=7):
    n, none = len(ranges), np.empty((len(ranges), 0))
    values = {
        'range': ranges, 'height': np.arange(n) * 1.0, 'angle': np.arange(n) * 0.1,
        'patch': np.arange(n) % 2, 'valid': np.ones(n, np.uint8),
    }  # fmt: skip
    return Estimate(
        stamp_ns=stamp_ns, frame_id='sonar', xyz=np.zeros((n, 3)), state_names=(), state=none,
        covariance=none[..., None], extras=values,
    )  # fmt: skip


def test_the_standard_deviation_of_what_is_no_state_follows_from_the_arm():
    profile = profile_of(estimate('height'), None)
    np.testing.assert_allclose(profile.height_std, 0.2)
    np.testing.assert_allclose(profile.angle_std, 0.2 / 8.0)
    profile = profile_of(estimate('angle'), None)
    np.testing.assert_allclose(profile.angle_std, 0.2)
    np.testing.assert_allclose(profile.height_std, 0.2 * 8.0)
    np.testing.assert_allclose(profile.height, 0.5)
    assert profile.valid.tolist() == [True, True, False, True] and profile.truth is None


def test_truth_is_that_of_the_nearest_bin_the_same_stamp_and_the_topic_beside():
    floor = profile_of(estimate(), truth(np.array([19.0, 20.25, 20.9, 30.0]))).truth
    np.testing.assert_array_equal(floor.height, [1.0, 1.0, 2.0, np.nan])
    assert floor.patch.tolist() == [True, True, False, False]
    assert floor.echo.tolist() == [True, True, True, False]
    for ranges in (np.empty(0), np.array([20.5])):  # with hardly a bin
        floor = profile_of(estimate(), truth(ranges)).truth
        assert np.isfinite(floor.height).sum() == len(ranges)
    floor = profile_of(estimate(ranges=RANGES[:1]), truth(np.array([19.0, 30.0]))).truth
    assert floor.height.tolist() == [0.0]
    swath = profiles_of([estimate(stamp_ns=7), estimate(stamp_ns=8)], [truth(RANGES, stamp_ns=8)])
    assert [profile.truth is None for profile in swath.profiles] == [True, False]
    assert swath.model_names == ('rw_smooth', 'rw_rough')
    np.testing.assert_allclose(swath.roughness(swath.profiles[0]), 0.1)

    def of(**topics):
        return truth_topics({'topics': {f'/{k.replace("__", "/")}': v for k, v in topics.items()}})

    assert of(snapshot='snapshot', nav='nav') == {'/truth/estimate': None}
    assert of(port__snapshot='snapshot') == {'/truth/port/estimate': None}
    both = of(port__snapshot='port/snapshot', starboard__snapshot='starboard/snapshot')
    assert both == {'/truth/port/estimate': 0, '/truth/starboard/estimate': 1}


@pytest.fixture(scope='module')
def tracked(tmp_path_factory):
    """A run, beside its recording."""
    bag = tmp_path_factory.mktemp('bags') / 'floor'
    small = '--set pings=2 --set last_range=55'.split()
    assert run('simulate', 'bathymetry', bag, '--seed', 4, *small) == 0
    assert run('track', bag, bag.parent / 'out') == 0
    return bag.parent / 'out'


def test_a_run_is_scored_and_has_a_page(tracked, capsys):
    assert run('evaluate', tracked) == 0
    assert 'On average the floor lies 0.' in capsys.readouterr().out
    metrics = json.loads((tracked / 'metrics.json').read_text())
    check = judge(RunFolder(tracked)).accuracy(None)  # the limit of the shipped recordings
    assert check.good and check.name == 'height RMSE against truth'
    assert not judge(RunFolder(tracked)).accuracy(0.001).good
    assert metrics['scored_pings'] == 2
    assert metrics['height']['smooth']['rmse_m'] < 0.1 < metrics['height']['patch']['rmse_m'] < 0.6
    assert metrics['segmentation']['iou'] > 0.6 and metrics['inside_band']['all'] > 0.85
    assert metrics['verdicts']['smooth_right'] > 0.95 and metrics['verdicts']['cannot_tell'] > 0.05
    page = (tracked / 'report.html').read_text()
    for title in ('Profile of the floor', 'Pseudo-spectrum and estimated angle',
                  'Which terrain model held', 'Rough floor over the whole run',
                  'Smooth, rough, or cannot tell'):  # fmt: skip
        assert title in page


def test_without_truth_the_page_still_says_something(tracked, tmp_path):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    folder.write_estimates(RunFolder(tracked).read_estimates(), 'bathymetry')
    folder.write_json('run.json', {**RunFolder(tracked).read_run(), 'bag': str(tmp_path / 'gone')})
    judgement = judge(folder)
    titles = [section.title for section in judgement.part([]).sections]
    assert judgement.accuracy(None) is None
    assert titles and 'Pseudo-spectrum and estimated angle' not in titles


@pytest.mark.parametrize('settings', ['angle_two_rw', 'height_two_rw --set smoothing=modes'])
def test_other_model_sets_are_judged(tracked, tmp_path, settings):
    words = f'--set model_set={settings}'.split()
    assert run('track', tracked.parent / 'floor', tmp_path / 'out', *words) == 0
    judgement = judge(RunFolder(tmp_path / 'out'))
    assert 0.0 < judgement.metrics['height']['all']['rmse_m'] < 0.5
    assert judgement.metrics['inside_band']['all'] > 0.5 and len(judgement.part().sections) >= 3


def test_two_sides_are_tracked_in_one_run_or_one_by_choice(tmp_path, capsys):
    small = '--scenario two_sides --set pings=1 --set last_range=30'.split()
    assert run('simulate', 'bathymetry', tmp_path / 'both', *small) == 0
    assert run('track', tmp_path / 'both', tmp_path / 'two') == 0
    estimates = RunFolder(tmp_path / 'two').read_estimates()
    assert [estimate.source for estimate in estimates] == [0, 1]
    assert (estimates[0].xyz[:, 1] >= 0.0).all() and (estimates[1].xyz[:, 1] <= 0.0).all()
    scored = judge(RunFolder(tmp_path / 'two'), JudgeOptions()).metrics
    assert scored['scored_pings'] == 2 and scored['height']['all']['rmse_m'] < 0.25
    port = '--topic snapshot=/port/snapshot --set side=port'.split()
    assert run('track', tmp_path / 'both', tmp_path / 'out', *port) == 0
    judgement = judge(RunFolder(tmp_path / 'out'))
    assert judgement.metrics['scored_pings'] == 1
    assert judgement.metrics['height']['all']['rmse_m'] < 0.2


@pytest.mark.parametrize('conjugate', [False, True])
def test_the_bright_line_of_the_spectrum_is_the_floor(conjugate):
    values = {'pings': 1, 'last_range': 35.0, 'conjugate': conjugate}
    scene = simulate(scenario('paper', values), 2)
    snapshot, truth = scene.measurements[0].measurement, scene.truth[0]
    tracker = BathymetryTracker(BathymetryConfig(conjugate=conjugate))
    profile = profile_of(tracker.process(snapshot)[0], None)
    figure = figures.spectrum_figure(profile, snapshot, -0.5 if conjugate else 0.5)
    image = figure.data[0]
    brightest = np.asarray(image.y)[np.asarray(image.z).argmax(axis=0)]
    assert np.median(np.abs(brightest - np.degrees(truth.angle))) < 2.0
    low, high = figure.layout.yaxis.range
    estimated = np.degrees(profile.angle[np.isfinite(profile.angle)])
    assert -90.0 < low < estimated.min() and estimated.max() < high < 90.0
    assert high - low < np.ptp(estimated) + 25.0  # the estimates fill the view


def test_of_a_long_recording_sixteen_pings_from_begin_to_end_are_scored():
    given = {'range': [20.0, 21.0], 'iq': np.ones((2, 2), complex)}
    pings = [Snapshot(stamp_ns=k, **given) for k in range(1, 101)]
    used = Scored(BathymetryConfig(), pings).used
    assert len(used) == 16 and {1, 100} <= used
    assert Scored(BathymetryConfig(), pings[:16]).used == set(range(1, 17))


@pytest.mark.parametrize('model_set', MODEL_SETS)
def test_tuning_is_without_monte_carlo_noise_where_the_models_allow_it(model_set):
    """And the noise of its own models is tuned."""
    config = for_tuning(BathymetryConfig(model_set=model_set))
    assert config.is_gaussian == (model_set in ('terrain', 'height_two_rw'))
    assert config.smoothing == 'none'
    BathymetryTracker(config)  # it can be run
    config = BathymetryConfig(model_set=model_set)
    names = {found.name for found in tunables(config, [])}
    noise = 'sigmas_deg' if model_set == 'angle_two_rw' else 'sigmas'
    assert names == (set() if config.is_terrain else {noise, 'stay_probability'})


def log_evidence(cells, sigma, transition, logs):
    """Of the filter of one state on a grid, exact but for the width of a cell: walks of noise
    sigma (M,), at least that width, from a state of 0 with a deviation of 1; logs (T, G)."""
    law = np.exp(-0.5 * np.square(cells))
    lag = np.arange(-len(cells) + 1, len(cells)) * (cells[1] - cells[0])
    walks = np.exp(-0.5 * np.square(lag / sigma[:, None]))
    walks /= walks.sum(axis=1, keepdims=True)
    p, total = np.tile(law / law.sum() / len(sigma), (len(sigma), 1)), 0.0
    for each in logs:
        p = np.array([np.convolve(q, walk, 'valid') for q, walk in zip(transition.T @ p, walks)])
        p = p * np.exp(each - each.max())
        total, p = total + each.max() + np.log(p.sum()), p / p.sum()
    return total


def test_two_walks_are_scored_as_on_a_grid():
    """Noise of the walks and probability to stay, about what a patch of .5 m was made with."""
    T, cells = 160, np.arange(-3.0, 3.0, 0.01)
    ranges, patch = 20.0 + 0.05 * np.arange(T), np.zeros(T)
    patch[60:120] = 0.5 * np.random.default_rng(2).normal(size=60)
    made = floor(patch, ranges=ranges)
    ones, signal = np.ones(T), np.full(T, 10.0**2.5)
    stated = {'noise_variance': ones, 'signal_variance': signal}
    snapshot = Snapshot(stamp_ns=1, range=ranges, iq=made.iq, **stated)
    sines = [array.direction_sine(15.0 - cells, r, math.radians(30.0)) for r in ranges]
    seen = zip(sines, snapshot.iq, signal)
    logs = np.array([log_likelihood(sine, y, s, 1.0, math.pi) for sine, y, s in seen])
    found, exact = [], []
    cases = [((0.01, rough), 0.995) for rough in (0.1, 0.3, 0.6, 1.2)]
    for sigmas, stay in [*cases, ((0.03, 0.6), 0.995), ((0.01, 0.6), 0.97)]:
        given = {'model_set': 'height_two_rw', 'sigmas': sigmas, 'stay_probability': stay}
        config = BathymetryConfig(gate_false_alarm=1.0, calibrate_array=False, **given)
        scored = Scored(for_tuning(config), [snapshot])
        scored.process(snapshot)
        found.append(scored.scores[1][0])
        exact.append(log_evidence(cells, np.array(sigmas), persistent(2, stay), logs))
    constant = T * log_constant(8, math.log1p(8.0 * signal[0]))
    off = np.array(found) - constant - exact
    assert np.abs(off[1:]).max() < 1.0 and np.argsort(found).tolist() == np.argsort(exact).tolist()
    assert exact[0] < exact[2] - 400.0 and abs(off[0]) < 60.0  # walks that cannot follow
