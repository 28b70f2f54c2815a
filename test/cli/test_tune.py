# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `sonar-imm tune` makes of recordings, and of what a user can get wrong."""

from itertools import product
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm
import yaml

from sonar_imm.measurements import Detections, Fix, Navigation, NOBODY
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation import tuning
from sonar_imm_tools.evaluation.bathymetry import predictive as swaths
from sonar_imm_tools.evaluation.diver.predictive import Scored
from sonar_imm_tools.evaluation.obstacle import predictive as obstacles
from sonar_imm_tools.evaluation.tuning import errors, maximise, Tunable, values_of

VECTORS = Path(__file__).parents[1] / 'vectors' / 'regret_free'


def dive(folder, duration):
    bag, settings = folder / f'dive_{duration}.bag', ['--set', f'duration={duration}']
    assert main(['simulate', 'diver', str(bag), '--scenario', 'straight', *settings]) == 0
    return bag


def tune(bag, *words, model_set='linear', name='covariance_scale'):
    """The code of `tune` of a diver."""
    options = '--system', 'diver', '--set', f'model_set={model_set}', '--parameters', name
    return main(['tune', str(bag), *options, *words])


def test_a_file_is_written_where_nothing_is_determined(tmp_path, capsys):
    bag, out = dive(tmp_path, 60), tmp_path / 'tuned.yaml'
    assert tune(bag, '--set', 'fix_std=2.0', '--out', str(out)) == 0
    printed = capsys.readouterr().out
    assert 'covariance_scale: not determined' in printed
    assert f'does not determine any of the parameters; {out} holds them unchanged' in printed
    written = yaml.safe_load(out.read_text())['/**']['ros__parameters']
    assert written == {'model_set': 'linear', 'fix_std': 2.0, 'covariance_scale': 1.0}
    assert main(['track', str(bag), str(tmp_path / 'run'), '--params', str(out)]) == 0


def wandering(folder, variance):
    """A fix a second for a minute, good to a metre, of a target that moves as the set `linear`
    says; variance: what messages state."""
    rng, lines = np.random.default_rng(1), ['stamp_s,x,y,std']
    F, Q = np.array([[1.0, 1.0], [0.0, 1.0]]), 0.25**2 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    state = np.array([[0.0, 0.0], [0.7, 0.2]])
    for k in range(60):
        state = F @ state + rng.multivariate_normal(np.zeros(2), Q, 2).T
        east, north = state[0] + rng.normal(0.0, 1.0, 2)
        lines.append(f'{1_700_000_000 + k},{east:.4f},{north:.4f},{variance**0.5:.6f}')
    (folder / 'fixes.csv').write_text('\n'.join(lines) + '\n', encoding='utf-8')
    assert main(['convert', 'fixes', str(folder / 'fixes.csv'), str(folder / 'fixes.bag')]) == 0
    return folder / 'fixes.bag'


@pytest.mark.parametrize('model_set, factor', [('linear', 60), ('families', 1000)])
def test_covariances_that_are_far_too_small_are_found_and_written(
    tmp_path, capsys, model_set, factor
):
    """The tracker rejects nearly all fixes, or begins tracks that share them; at ten times what is
    stated the likelihood is no better than at one."""
    bag, out = wandering(tmp_path, 1.0 / factor), tmp_path / 'tuned.yaml'
    capsys.readouterr()
    assert tune(bag, '--json', '--out', str(out), model_set=model_set) == 0
    (row,) = json.loads(capsys.readouterr().out)['parameters']
    assert row['verdict'] == 'determined' and row['before'] == 1.0
    assert row['low'] < factor < row['high'] < 3.0 * row['low']
    written = yaml.safe_load(out.read_text())['/**']['ros__parameters']
    scale = pytest.approx(row['after'], rel=1e-3)
    assert written == {'model_set': model_set, 'covariance_scale': scale}


def test_covariances_that_are_too_large_are_said_to_be_out_of_range(tmp_path, capsys):
    """Unless the fit may begin below: then they are found."""
    bag = wandering(tmp_path, 25.0)
    capsys.readouterr()
    assert tune(bag) == 0
    printed = capsys.readouterr().out
    assert 'covariance_scale: not determined, the likelihood goes on rising below 1\n' in printed
    assert tune(bag, '--set', 'covariance_scale=0.01', '--json') == 0
    (row,) = json.loads(capsys.readouterr().out)['parameters']
    assert row['verdict'] == 'determined' and row['low'] < 0.04 < row['high']


def test_bad_input_is_named(tmp_path, capsys):
    short, bag = dive(tmp_path, 5), dive(tmp_path, 30)
    for recording, name, sentence in (
        (short, 'covariance_scale', 'too little to fit'), (bag, 'max_tracks', 'cannot be fitted'),
        (bag, 'covariance_scal', "did you mean 'covariance_scale'"),
    ):  # fmt: skip
        assert tune(recording, name=name) == 2
        assert sentence in capsys.readouterr().err


def test_scales_are_tried_over_their_whole_range_within_the_bounds_of_the_parameter():
    scale = Tunable(name='covariance_scale', start=1.0, std=3.0, least=1.0, scanned=True)
    grid = np.array(scale.grid(DiverConfig()))
    assert grid[0] == 0.0 and grid[-1] == pytest.approx(math.log(1e4))
    assert np.diff(grid).max() <= tuning.SPACING
    assert Tunable(name='covariance_scale', start=1.0).grid(DiverConfig()) == []
    assert Tunable(name='covariance_scale', start=1.0, least=1.0).bounds(DiverConfig())[0] == 0.0
    stay = Tunable(name='stay_probability', start=0.9, kind='logit')
    assert stay.value(stay.coordinate(0.9)) == pytest.approx(0.9)


def test_an_element_that_is_fitted_leaves_the_others_of_its_list():
    """Also where the list was empty, which stands for values of the model set."""
    config = BathymetryConfig(model_set='height_two_rw')
    first, second, _ = swaths.tunables(config, [])
    assert swaths.tunables(BathymetryConfig(), []) == []  # terrain has nothing to fit
    assert not config.sigmas and not first.usual and second.label == 'sigmas[1]'
    changed = values_of([second], np.log([0.3]))
    assert changed == {'sigmas': (config.sigmas_used[0], pytest.approx(0.3))}


def fitting_of(peak, H):
    """A posterior that is a parabola: its peak in coordinates, and its curvature -H."""
    names = ('speed_std', 'speed_noise')
    tunables = tuple(Tunable(name=name, start=1.0) for name in names[: len(peak)])

    def posterior(u, part=''):
        return float(7.0 - 0.5 * (u - peak) @ H @ (u - peak))

    return SimpleNamespace(jobs=(None,), tunables=tunables, posterior=posterior)


def test_standard_errors_are_those_of_the_inverse_of_the_curvature():
    H = np.array([[4.0, 3.0], [3.0, 9.0]])
    saddle = np.array([[1.0, 3.0], [3.0, 1.0]])
    known = np.array([0.3, -0.2]), H, np.sqrt(np.diag(np.linalg.inv(H)))
    for peak, curvature, exact in (known, (np.zeros(2), saddle, np.full(2, np.inf))):
        fitting = fitting_of(peak, curvature)
        found = errors(fitting, peak, lambda points, at=fitting.posterior: [at(u) for u in points])
        assert found == pytest.approx(exact)


@pytest.mark.parametrize('peak', [[0.3, -0.2], [-40.0, 40.0]])
def test_a_fit_ends_at_the_peak_or_at_the_bounds_before_it(peak, monkeypatch):
    monkeypatch.setattr(tuning, '_recording', lambda job: SimpleNamespace(config=DiverConfig()))
    fitting = fitting_of(peak, np.diag([4.0, 9.0]))
    low, high = np.transpose([t.bounds(DiverConfig()) for t in fitting.tunables])
    asked = []
    best, value, used = maximise(fitting, np.zeros(2), 'whole', asked.append)
    assert best == pytest.approx(np.clip(peak, low, high), abs=0.05)
    assert value == pytest.approx(fitting.posterior(best)) and used == sum(asked) <= 80


class Halves:
    """Forty numbers with a standard deviation of 3 in the first half and 2 in the second; that
    of the model is the parameter speed_std."""

    config = DiverConfig()

    def __init__(self, first=3.0, second=2.0):
        self.z = np.tile([1.0, -1.0], 20) * np.repeat([first, second], 20)

    def terms(self, values):
        return norm.logpdf(self.z, scale=values.get('speed_std', 1.0))

    def scores(self, values, until=math.inf):
        return {k: (float(term), 1) for k, term in enumerate(self.terms(values)) if k <= until}


@pytest.fixture
def tuned(monkeypatch):
    """What comes out of such numbers."""

    def tuned(numbers, names=('speed_std',)):
        monkeypatch.setattr(tuning, '_recording', lambda job: numbers)
        tunables = tuple(Tunable(name=name, start=1.0, std=3.0) for name in names)
        job, split = SimpleNamespace(system='diver'), (len(numbers.z) // 2 - 1,)
        return tuning.tune(tuning.Fitting(jobs=(job,), tunables=tunables, split=split), 40)

    return tuned


def test_what_is_gained_is_of_each_half_by_what_the_other_one_told(tuned):
    numbers = Halves()
    made, told = tuned(numbers), np.repeat([2.0, 3.0], 20)
    gained = norm.logpdf(numbers.z, scale=told) - norm.logpdf(numbers.z)
    assert made.held_out_gain == pytest.approx(gained.mean(), abs=0.02)
    assert made.values['speed_std'] == pytest.approx(math.sqrt(6.5), abs=0.1)
    assert made.log_likelihood_before == pytest.approx(norm.logpdf(numbers.z).sum())
    (row,) = made.parameters
    assert row.determined and row.held_out_gain == pytest.approx(made.held_out_gain)
    # Of forty numbers a logarithm of their spread is known to the root of one eightieth.
    assert math.log(row.high / row.low) == pytest.approx(4.0 / math.sqrt(80.0), rel=0.05)


def test_without_gain_on_the_other_half_a_parameter_is_not_determined(tuned):
    """The whole determines a spread of 2.1, with a small standard error; each half contradicts
    the other: its standard deviation is 1 / 3 in the first one and 3 in the second."""
    made = tuned(Halves(1.0 / 3.0, 3.0))
    (row,) = made.parameters
    assert not row.determined and row.low is not None and 1.0 < row.low
    assert row.after == row.before == 1.0 and 'not fitted' in row.reason
    assert made.values == {} and made.held_out_gain < 0.0
    assert made.log_likelihood_after == made.log_likelihood_before


def test_only_parameters_with_gain_of_their_own_are_kept(tuned):
    """Numbers as the model has it, but for a mean spread of 3 that only speed_noise explains."""

    class Right(Halves):
        def terms(self, values):
            right = norm.logpdf(np.sign(self.z), scale=values.get('speed_std', 1.0))
            return right + norm.logpdf(self.z, scale=values.get('speed_noise', 1.0))

    made = tuned(Right(), ('speed_std', 'speed_noise'))
    assert list(made.values) == ['speed_noise']
    first, second = made.parameters
    assert not first.determined and first.held_out_gain is not None and second.determined
    assert first.held_out_gain < 2.0 / 40.0 < made.held_out_gain


@pytest.mark.parametrize('count, determined', [(3, False), (6, True)])
def test_too_few_numbers_determine_nothing(count, determined, tuned):
    """The logarithm of a spread is known to .41, or to .29."""
    numbers = Halves()
    numbers.z = 3.0 * np.resize([1.0, -1.0], count)
    (row,) = tuned(numbers).parameters
    assert row.determined == determined


SEA = ObstacleConfig(max_range=50.0, horizontal_fov_deg=90.0, clutter_density=0.02)
CLUTTER = 0.02 * 50.0 * 0.5 * math.pi
"""False echoes of a ping."""


def ping(tracker, stamp_ns, distance, bearing):
    place, level = np.array([0.0, 0.0, -5.0]), np.array([0.0, 0.0, 0.0, 1.0])
    tracker.process(Navigation(stamp_ns=stamp_ns, position=place, orientation=level))
    seen = {'range': np.array(distance), 'bearing': np.array(bearing)}
    tracker.process(Detections(stamp_ns=stamp_ns, **seen))


def test_the_score_of_a_sea_without_obstacles_is_that_of_its_clutter():
    """Clutter is a Poisson process: m detections in an area A have m log(density) - density A."""
    tracker = obstacles.Scored(SEA)
    ping(tracker, 1, [10.0, 20.0, 30.0], [0.0, 0.2, -0.3])
    assert tracker.scores == {1: (pytest.approx(3.0 * math.log(0.02) - CLUTTER), 0)}


def test_an_obstacle_that_is_seen_is_better_predicted_than_one_that_is_missed():
    """A ping in which one of two is missed has the echo of the other, and 1 - p."""
    tracker = obstacles.Scored(SEA)
    for second in range(1, 13):
        n = 2 if second < 12 else 1
        ping(tracker, second * 10**9, [20.0, 30.0][:n], [0.2, -0.3][:n])
    scores = [score for score, _ in tracker.scores.values()]
    both, one = scores[-2:]
    assert both > scores[0] + 10.0  # where both could only be false
    missed = math.log(1.0 - SEA.detection_probability)
    # Densities of false echoes change a little with each ping.
    assert one == pytest.approx(0.5 * (both + CLUTTER) + missed - CLUTTER, abs=0.5)


def score_of(z, R, seconds, scale, noise):
    """The log likelihood that the tracker gives fixes z (n, 2) with R (n, 2, 2)."""
    config = DiverConfig(
        model_set='linear', acceleration_noise=(noise,), covariance_scale=scale, max_tracks=1,
        clutter_density=1e-12, birth_density=1e-12, gate_probability=0.9999999, longest_step=100.0,
    )  # fmt: skip
    tracker = Scored(config)
    for second, place, covariance in zip(seconds, z, R):
        known = {'position': np.array([*place, 0.0]), 'covariance': covariance}
        tracker.process(Fix(stamp_ns=round(second * 1e9), **known))
    return math.fsum(value for value, _ in tracker.scores.values())


def score_of_two(f, is_complete):
    """The score of fixes with densities f (2, D) under two tracks of one diver that exist with .9
    and .4; the tracker; and the density of other fixes."""

    class Known(dict[str, np.ndarray]):
        life = SimpleNamespace(track_id=np.array([1, 2]))

    config = DiverConfig(clutter_density=2e-4)
    tracker, D = Scored(config), f.shape[1]
    tracker.area, tracker.existence = 500.0, {1: 0.9, 2: 0.4}
    pairs = SimpleNamespace(track_log=np.log(f), direct=np.ones((2, D)), nis=np.zeros((2, D)))
    known = Known(existence=np.array([0.9, 0.4]), target_id=np.full(2, NOBODY))
    group = SimpleNamespace(
        config=config, association=SimpleNamespace(hit=np.ones(2, bool), fix=np.zeros(2, int)),
        pairs=pairs, new_targets=1e-5, detection=None, target_id=None, is_complete=is_complete,
    )  # fmt: skip
    score, count = tracker._score(known, group)
    assert count == D
    return score, tracker, 2e-4 + 1e-5


def test_a_fix_that_comes_singly_is_of_one_track():
    """Two tracks that predict it well do not count it twice."""
    score, _, other = score_of_two(np.array([[0.2], [0.1]]), is_complete=False)
    p = DiverConfig().detection_probability
    mixture = (0.9 * 0.2 + 0.4 * 0.1) / (0.9 + 0.4)
    assert score == pytest.approx(math.log((1.0 - p) * other + p * mixture))


def test_the_score_of_a_scan_is_that_of_all_joint_events():
    f, r = np.array([[0.2, 0.003], [0.1, 0.05]]), (0.9, 0.4)
    p = DiverConfig().detection_probability
    score, tracker, other = score_of_two(f, is_complete=True)
    total, exists = 0.0, [0.0, 0.0]
    for event in product((None, 0, 1), repeat=2):
        if event[0] is None or event[0] != event[1]:
            share = math.prod(
                1.0 - r[t] * p if d is None else r[t] * p * f[t, d] / other
                for t, d in enumerate(event)
            )
            total += share
            for t, d in enumerate(event):
                exists[t] += share * (r[t] * (1.0 - p) / (1.0 - r[t] * p) if d is None else 1.0)
    assert score == pytest.approx(2 * math.log(other) - 500.0 * other + math.log(total))
    assert tracker.existence == pytest.approx({1: exists[0] / total, 2: exists[1] / total})


def test_the_score_is_that_of_the_reference_vectors():
    """Where the gate refuses no fix: at six and ten times the stated covariances."""
    with np.load(VECTORS / 'tuned.npz') as given:
        scales, noises = given['grid_covariance_scale'][2:], given['grid_acceleration_noise']
        fixes = given['z'], given['R'], 1.0 + given['t']
        expected = given['grid_log_likelihood'][2:]
    found = np.array([[score_of(*fixes, s, q) for q in noises] for s in scales])
    # The first fix has a score that nothing changes.
    np.testing.assert_allclose(found - found[0, 0], expected - expected[0, 0], atol=1e-6)
