# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Runs of the bathymetry tracker from a recording to the page, as the command makes them, and what
tuning runs it with."""

import json
import math

from helpers.bathymetry_cases import floor
from helpers.commands import run
import numpy as np
from oracles.array_likelihood import log_likelihood
import pytest

from sonar_imm.acoustics import array
from sonar_imm.acoustics.laplace import log_constant
from sonar_imm.estimation.markov import persistent
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig, MODEL_SETS
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry import truth_topics
from sonar_imm_tools.evaluation.bathymetry.figures import spectrum_figure
from sonar_imm_tools.evaluation.bathymetry.predictive import for_tuning, Scored, tunables
from sonar_imm_tools.evaluation.bathymetry.scoring import profile_of
from sonar_imm_tools.evaluation.judging import judge, JudgeOptions
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags') / 'floor'
    small = '--set pings=2 --set last_range=55'.split()
    assert run('simulate', 'bathymetry', path, '--seed', 4, *small) == 0
    return path


@pytest.fixture(scope='module')
def tracked(bag):
    out = bag.parent / 'out'
    assert run('track', bag, out) == 0
    return out


def test_a_run_is_scored_and_has_a_page(tracked, capsys):
    assert run('evaluate', tracked) == 0
    assert 'On average the floor lies 0.' in capsys.readouterr().out
    metrics = json.loads((tracked / 'metrics.json').read_text())
    check = judge(RunFolder(tracked)).accuracy(None)  # the limit of the shipped recordings
    assert check.good and check.name == 'height RMSE against truth'
    assert not judge(RunFolder(tracked)).accuracy(0.001).good
    assert metrics['scored_pings'] == 2
    assert metrics['height']['smooth']['rmse_m'] < 0.1 < metrics['height']['patch']['rmse_m'] < 0.6
    assert metrics['segmentation']['iou'] > 0.6
    assert metrics['inside_band']['all'] > 0.85
    assert metrics['verdicts']['smooth_right'] > 0.95 and metrics['verdicts']['cannot_tell'] > 0.05
    page = (tracked / 'report.html').read_text()
    assert 'Profile of the floor' in page and 'Pseudo-spectrum and estimated angle' in page
    assert 'Which terrain model held' in page and 'Rough floor over the whole run' in page
    assert 'Smooth, rough, or cannot tell' in page


def test_without_truth_the_page_still_says_something(tracked, bag, tmp_path):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    folder.write_estimates(RunFolder(tracked).read_estimates(), 'bathymetry')
    folder.write_json('run.json', {**RunFolder(tracked).read_run(), 'bag': str(tmp_path / 'gone')})
    judgement = judge(folder)
    assert judgement.accuracy(None) is None
    titles = [section.title for section in judgement.part([]).sections]
    assert titles and 'Pseudo-spectrum and estimated angle' not in titles


@pytest.mark.parametrize(
    'settings', ['angle_two_rw', 'terrain', 'height_rw_ncs', 'height_two_rw --set smoothing=modes']
)
def test_every_model_set_is_judged(bag, tmp_path, settings):
    words = f'--set model_set={settings}'.split()
    assert run('track', bag, tmp_path / 'out', *words) == 0
    judgement = judge(RunFolder(tmp_path / 'out'))
    assert 0.0 < judgement.metrics['height']['all']['rmse_m'] < 0.5
    assert judgement.metrics['inside_band']['all'] > 0.5
    assert len(judgement.part().sections) >= 3


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


def test_truth_lies_beside_the_topic_that_was_tracked():
    def of(**topics):
        return truth_topics({'topics': {f'/{k.replace("__", "/")}': v for k, v in topics.items()}})

    assert of(snapshot='snapshot', nav='nav') == {'/truth/estimate': None}
    assert of(port__snapshot='snapshot') == {'/truth/port/estimate': None}
    both = of(port__snapshot='port/snapshot', starboard__snapshot='starboard/snapshot')
    assert both == {'/truth/port/estimate': 0, '/truth/starboard/estimate': 1}


@pytest.mark.parametrize('conjugate', [False, True])
def test_the_bright_line_of_the_spectrum_is_the_floor(conjugate):
    values = {'pings': 1, 'last_range': 35.0, 'conjugate': conjugate}
    scene = simulate(scenario('paper', values), 2)
    snapshot, truth = scene.measurements[0].measurement, scene.truth[0]
    tracker = BathymetryTracker(BathymetryConfig(conjugate=conjugate))
    profile = profile_of(tracker.process(snapshot)[0], None)
    figure = spectrum_figure(profile, snapshot, -0.5 if conjugate else 0.5)
    image = figure.data[0]
    brightest = np.asarray(image.y)[np.asarray(image.z).argmax(axis=0)]
    assert np.median(np.abs(brightest - np.degrees(truth.angle))) < 2.0
    low, high = figure.layout.yaxis.range
    estimated = np.degrees(profile.angle[np.isfinite(profile.angle)])
    assert -90.0 < low < estimated.min() and estimated.max() < high < 90.0
    assert high - low < np.ptp(estimated) + 25.0  # the estimates fill the view


def test_of_a_long_recording_sixteen_pings_from_begin_to_end_are_scored():
    pings = [
        Snapshot(stamp_ns=k, range=[20.0, 21.0], iq=np.ones((2, 2), complex))
        for k in range(1, 101)
    ]
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
    snapshot = Snapshot(
        stamp_ns=1, range=ranges, iq=made.iq, noise_variance=ones, signal_variance=signal
    )
    sines = [array.direction_sine(15.0 - cells, r, math.radians(30.0)) for r in ranges]
    seen = zip(sines, snapshot.iq, signal)
    logs = np.array([log_likelihood(sine, y, s, 1.0, math.pi) for sine, y, s in seen])
    found, exact = [], []
    cases = [((0.01, rough), 0.995) for rough in (0.1, 0.3, 0.6, 1.2)]
    for sigmas, stay in [*cases, ((0.03, 0.6), 0.995), ((0.01, 0.6), 0.97)]:
        config = for_tuning(
            BathymetryConfig(
                model_set='height_two_rw', sigmas=sigmas, stay_probability=stay,
                gate_false_alarm=1.0, calibrate_array=False,
            )
        )  # fmt: skip
        scored = Scored(config, [snapshot])
        scored.process(snapshot)
        found.append(scored.scores[1][0])
        exact.append(log_evidence(cells, np.array(sigmas), persistent(2, stay), logs))
    constant = T * log_constant(8, math.log1p(8.0 * signal[0]))
    off = np.array(found) - constant - exact
    assert np.abs(off[1:]).max() < 1.0 and np.argsort(found).tolist() == np.argsort(exact).tolist()
    assert exact[0] < exact[2] - 400.0 and abs(off[0]) < 60.0  # walks that cannot follow
