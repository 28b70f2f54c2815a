# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Trackers as printed: of a swath the values of the paper, and its errata at work; of a fathometer
the model of sets, and what a bootstrap filter costs; of obstacles the estimates, on approaches
computed elsewhere and on whole recordings; of divers equation (1), the model sets, and that the
study runs."""

import json
from types import SimpleNamespace

from helpers.bathymetry_cases import floor
from helpers.obstacle_runs import approach, lever, meta
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from benchmarks import diver_paper, obstacle_paper
from benchmarks.bathymetry_paper import ANGLES, PrintedTracker, SETS
from benchmarks.diver_paper import PaperChain, Program, TRACKERS
from benchmarks.fathometer_paper import BOOTSTRAP, ChangedTracker, ENVELOPE, PENALTY, score
from benchmarks.obstacle_paper import deferred, moored, sonar_poses
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation import imm
from sonar_imm.estimation.motion import Motion
from sonar_imm.measurements import Detections, Navigation, Trace
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm.trackers.fathometer.tracker import FathometerConfig
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig
from sonar_imm.trackers.own_models import checked
from sonar_imm_tools.simulation.obstacle.simulator import scenario

RANGES = 17.0 + 0.05 * np.arange(200)
OF_PAPER = {'angle_two_rw': ANGLES, **{name: values(1.0) for name, values in SETS.items()}}


def config_of(name, **values):
    return BathymetryConfig(**{**OF_PAPER[name], **values})


def rmse(estimate, height):
    return float(np.sqrt(np.mean(np.square(estimate.columns()['height'] - height))))


@pytest.mark.parametrize('name', OF_PAPER)
def test_every_set_of_the_paper_finds_a_flat_floor_and_tracks_through_a_shadow(name):
    ping = floor(0.4, ranges=RANGES, shadow=slice(60, 80))
    estimate = PrintedTracker(config_of(name)).process(ping)[0]
    heard = np.delete(estimate.columns()['height'], slice(60, 90))
    assert np.sqrt(np.mean(np.square(heard - 0.4))) < 0.25
    assert estimate.extras['valid'].all() and 'surfaces' not in estimate.extras
    default = BathymetryTracker(BathymetryConfig(model_set=name)).process(ping)[0]
    assert not default.extras['valid'].all()


def test_the_slope_model_as_printed_is_a_random_walk_in_disguise():
    ranges = 17.0 + 0.05 * np.arange(800)
    height = 0.1 * (ranges - ranges[0])
    snapshot = floor(height, ranges=ranges)
    only = {'transition_matrix': (1.0, 0.0, 0.0, 1.0), 'initial_probabilities': (0.0, 1.0)}
    config = config_of('height_rw_ncs', **only)
    corrected = rmse(BathymetryTracker(config).process(snapshot)[0], height)
    assert corrected < 0.25
    assert rmse(PrintedTracker(config).process(snapshot)[0], height) > 3.0 * corrected


@pytest.fixture(scope='module')
def drift():
    """(trace, true depths) of the first 60 records of the vectors."""
    kept = load_vectors('fathometer/mvdr_traces')
    strength, depth = kept['reflector_amplitude'], kept['depth']
    there = strength > 0.4 * strength.max(axis=0)
    sigma = np.broadcast_to(np.ravel(kept['sigma']), len(strength))
    found = []
    for k in range(60):
        heard = {'amplitude': kept['amplitude'][k], 'sigma': np.full(len(depth), sigma[k])}
        trace = Trace(stamp_ns=(k + 1) * 90 * 10**9, depth=depth, **heard)
        found.append((trace, kept['reflector_depth'][k][there[k]].astype(float)))
    return found


def distance(drift, changes, **values):
    """Mean OSPA, m."""
    tracker = ChangedTracker(FathometerConfig(particles=3000, **values), **changes)
    scores = [score(tracker.process(trace)[-1], depth) for trace, depth in drift]
    return np.mean([apart for _, apart in scores])


def test_the_model_of_the_sets_is_that_of_the_paper_after_a_reset_too(drift):
    tracker = ChangedTracker(FathometerConfig(particles=50, **ENVELOPE), **PENALTY, **BOOTSTRAP)
    for _ in range(2):
        tracker.process(drift[0][0])
        model = tracker._filter.model
        assert model.amplitude_prior == 'paper' and model.walk_share == model.birth_share == 0.0
        assert model.order_min == 7 and model.independent_samples > 100.0
        tracker.reset()


@pytest.mark.statistics
def test_a_bootstrap_filter_does_not_find_the_reflectors(drift):
    assert distance(drift, BOOTSTRAP) > 5.0 * distance(drift, {})
    assert distance(drift, BOOTSTRAP, order_min=7, order_max=7) > 0.5


GRID = np.arange(-12.0, 12.025, 0.05)
NOISE_FREE = ('approach_dst+0.5_noisefree', 'approach_dst+3_noisefree')


def echoes(name):
    config = ObstacleConfig(sonar_lever=lever(name))
    measurements = approach(name)
    pings = [item for item in measurements if isinstance(item, Detections) and len(item)]
    navigation = [item for item in measurements if isinstance(item, Navigation)]
    poses, known = sonar_poses(navigation, np.array([ping.stamp_ns for ping in pings]), config)
    assert known.all()
    return np.array([[ping.range[0], -ping.bearing[0]] for ping in pings]), poses, config


@pytest.mark.parametrize('name', NOISE_FREE)
def test_without_noise_the_offset_is_exact_and_the_mirrored_one_is_not(name):
    true = meta(name)['dst_first_ping']
    for refit in (False, True):
        found = deferred(*echoes(name), refit=refit)
        assert found.best == pytest.approx(true, abs=1e-6) and found.least < 1e-6
    curve = deferred(*echoes(name), offsets=np.array([-true, true])).rmsd
    assert curve[0] == pytest.approx(meta(name)['rmsd_px_at_minus'], abs=1e-9)


@pytest.mark.parametrize('name', ['approach_dst+3_noisy', 'approach_level_mirror_noisy'])
def test_with_noise_the_curve_is_that_of_the_paper(name):
    found = deferred(*echoes(name), offsets=GRID)
    lowest = int(np.nanargmin(found.rmsd))
    assert GRID[lowest] == pytest.approx(meta(name)['rmsd_px_argmin_signed'], abs=1e-9)
    assert found.rmsd[lowest] == pytest.approx(meta(name)['rmsd_px_min'], abs=1e-9)
    assert found.least <= found.rmsd[lowest]
    assert abs(found.best - GRID[lowest]) <= 0.05


def test_poses_are_not_invented():
    name = NOISE_FREE[0]
    navigation = [item for item in approach(name) if isinstance(item, Navigation)]
    config = ObstacleConfig(max_navigation_gap=0.6)
    first, last = navigation[0].stamp_ns, navigation[-1].stamp_ns
    stamps = np.array([first - 1, first, first + 10**8, last, last + 1])
    poses, known = sonar_poses(navigation, stamps, config)
    assert known.tolist() == [False, True, True, True, False]
    assert np.isfinite(poses.position).all(axis=1).tolist() == known.tolist()
    # A tenth of the way from the first pose to the second, half a second later: a fifth.
    expected = 0.8 * navigation[0].position + 0.2 * navigation[1].position
    np.testing.assert_allclose(poses.position[2, [1, 0, 2]] * [1, 1, -1], expected, atol=1e-9)
    wide = navigation[:1] + navigation[5:]
    assert not sonar_poses(wide, stamps[2:3], config)[1][0]


@pytest.mark.parametrize('body', ['large', 'sphere'])
@pytest.mark.parametrize('echo', ['hand', 'noisy'])
def test_curves_of_the_papers_encounters(body, echo):
    """The same pings read by eye and by a noisy detector: curves computed elsewhere."""
    file = load_vectors('obstacle_sea/paper_section5')
    values = {key.removeprefix(f'{body}/'): file[key] for key in file if body in key}
    z = np.column_stack([values[f'{echo}_range'], values[f'{echo}_azimuth']])
    seen = np.isfinite(z).all(axis=1)
    poses = Pose(values['sonar_p_ned'][seen], values['sonar_R_ned'][seen])
    found = deferred(z[seen], poses, ObstacleConfig(), offsets=values['d_st'])
    np.testing.assert_allclose(found.rmsd, values[f'{echo}_rmsd'], rtol=1e-9)
    assert found.best == pytest.approx(float(values[f'{echo}_estimate']), abs=0.05)


def test_all_estimates_of_a_moored_sphere_hold_at_the_first_echo():
    found = moored(scenario('tethers', obstacle_paper.TETHERS), 1)
    assert abs(found['refitted']) < 2.0 and abs(found['online']) < 2.0
    assert abs(found['tether_m'] - 15.0) < 2.0 * found['tether_std_m'] < 3.0
    # Where the tracker has the obstacle is how long it has the tether.
    assert found['tether_m'] == pytest.approx(15.0 - found['online'], abs=0.5)


def test_the_study_has_all_its_tables():
    parts = {}
    for part in obstacle_paper.main(runs=2, seeds=1):
        parts |= part
    methods = {f'approach, {method}' for method in ('seafloor', 'deferred', 'refit')}
    assert set(parts['approach']) == methods
    assert set(parts['large']['distribution']) == set(obstacle_paper.READINGS)
    assert len(parts['sphere']['estimates']['by eye']) == 2
    assert list(parts['tether']['errors']) == ['seed 1']
    assert parts['tether']['size of the errors']['online']['runs'] == 1


PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])
REFERENCE = load_vectors('diver/imm_reference')


def learnt(chain, mu):
    """The matrix (3, 3) after the model probabilities mu (K, 1, 3) in turn."""
    P = chain.initial_counts(1)
    for before, after in zip(mu[:-1], mu[1:]):
        P = chain.learn(P, chain.transition(P, 1.0), before, after, 1.0)
    return chain.transition(P, 1.0)[0]


def constant(*mu):
    return np.tile(mu, (60, 1, 1))


@pytest.mark.parametrize('form', ['product', 'ratio'])
def test_a_guard_keeps_its_share_of_the_prior(form):
    found = [learnt(PaperChain(PRIOR, form), constant(0.98, 0.01, 0.01))]
    if form == 'ratio':  # models that were impossible
        mu = np.array([[[1.0, 0.0, 0.0]], [[0.5, 0.5, 0.0]]])
        found.append(learnt(PaperChain(PRIOR, form), mu))
        assert found[1][0, 1] > PRIOR[0, 1]
    for P in found:
        assert (P >= 0.7 * PRIOR - 1e-12).all()
        np.testing.assert_allclose(P.sum(axis=1), 1.0, atol=1e-12)


def test_the_product_without_a_guard_is_one_hot_within_five_steps():
    P = learnt(PaperChain(PRIOR, 'product', guard=0.0), constant(0.7, 0.2, 0.1)[:6])
    assert P.max(axis=1).min() > 0.97


def test_the_ratio_without_a_guard_telescopes():
    """Whatever the chain said, a column ends up weighed by mu(k) / mu(0)."""
    mu = np.random.default_rng(5).dirichlet(np.ones(3), (6, 1))
    P = PRIOR * mu[-1] / mu[0]
    found = learnt(PaperChain(PRIOR, 'ratio', guard=0.0), mu)
    np.testing.assert_allclose(found, P / P.sum(axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize('form', diver_paper.EQUATION)
def test_impossible_transitions_stay_impossible(form):
    prior = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.9]])
    P = learnt(PaperChain(prior, form), np.random.default_rng(3).dirichlet(np.ones(3), (10, 1)))
    assert (P[prior == 0.0] == 0.0).all()
    np.testing.assert_allclose(P.sum(axis=-1), 1.0)


def test_the_guarded_product_in_a_filter_is_that_of_the_reference():
    names = (name for name in REFERENCE if name.startswith('A6_world16_adaptA_guard/'))
    given = {name.partition('/')[2]: REFERENCE[name] for name in names}
    models = SimpleNamespace(
        initial_states=lambda z, R: tuple(given[name][None, None] for name in ('x0', 'P0', 'mu0')),
        motion=lambda dt: Motion(given['F'], given['Q'], given['B']),
        E=given['E'],
    )
    chain = PaperChain(given['Pi'], 'product', json.loads(str(given['opts']))['eps'])
    # The first fix begins a track, which begins otherwise here.
    z, R = (np.concatenate([part[:1], part])[None] for part in (given['Z'], given['R']))
    steps = list(diver_paper.forward(models, chain, z, R))
    for name in ('x', 'P', 'mu'):
        ours = np.concatenate([getattr(step, name) for step in steps[1:]])
        wanted = given['out_mu' if name == 'mu' else f'out_{name}j']
        np.testing.assert_allclose(ours, wanted, rtol=0.0, atol=1e-9)
    used = np.concatenate([step.transition for step in steps[2:]])
    np.testing.assert_allclose(used, given['out_Pi'][:-1], rtol=0.0, atol=1e-9)


def test_world_headings_are_those_of_the_reference(monkeypatch):
    monkeypatch.setattr(diver_paper.WorldHeadings, 'noise', 0.15)
    config = DiverConfig(heading_concentration=1.0, stay_probability=0.88)
    own = checked(diver_paper.WorldHeadings(config))
    F, Q, B = own.motion(1.0)
    ours = {'F': F, 'Q': Q, 'B': B, 'E': own.joint.E, 'Pi': own.transition}
    for key, value in ours.items():
        np.testing.assert_allclose(value, REFERENCE[f'A4_world16/{key}'], atol=1e-12)


def test_world_headings_compose_in_position():
    """Their velocity is drawn afresh at each step; the law of the position composes."""
    models = build_models(DiverConfig(model_set='bench_world_headings'))
    (x,), (P,), _ = models.initial_states(
        np.array([[3.0, -2.0]]), np.array([[[2.0, 0.5], [0.5, 1.0]]])
    )
    long_x, long_P, _ = imm.predict(x, P, *models.motion(1.0))
    for _ in range(10):
        x, P, _ = imm.predict(x, P, *models.motion(0.1))
    np.testing.assert_allclose(x[..., :2], long_x[..., :2], atol=1e-12)
    np.testing.assert_allclose(P[..., :2, :2], long_P[..., :2, :2], atol=1e-12)


def test_sixteen_directions_beat_one():
    truth, z, R = diver_paper.load(['table1'], range(8))
    errors = {'fixes': diver_paper.rmse(z, truth)}
    one = Program({'model_set': 'bench_cv_cv'})
    for name, (values, chain) in {**TRACKERS, 'one': one}.items():
        estimate, _ = diver_paper.track(DiverConfig(**values), z, R, chain)
        errors[name] = diver_paper.rmse(estimate, truth)
    assert max(errors.values()) == errors['fixes']
    assert 1.15 * errors['heading_speed'] < errors['one'] < errors['fixes']
