# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Bursts: the vectors of an independent prototype, and what users see of fixes that are off."""

from pathlib import Path

from attrs import evolve
from helpers.diver_runs import fix, SECOND
import numpy as np
import pytest

from sonar_imm.estimation import bank
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver import bursts
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

VECTORS = Path(__file__).parents[2] / 'vectors/diver_in_the_field'


def config(**values):
    # The prototype's velocities at the start; what is at its default gives way to those of a boat.
    return DiverConfig(**{'max_tracks': 1, 'velocity_std': np.nextafter(0.7, 1.0), **values})


@pytest.fixture(scope='module')
def models():
    return build_models(config())


def used(kind):
    """The components (6,) of models (M,) that exist, offset last."""
    return np.where((kind == 1)[:, None], [1, 1, 1, 1, 1, 1], [1, 1, 1, 0, 1, 1]).astype(bool)


def assert_states(models, blocks, x, P, mask, skip=()):
    own_x, own_P = (part[0] for part in models.to_common(tuple(blocks)))
    for j in sorted(set(range(len(x))) - set(skip)):
        here = mask[j]
        np.testing.assert_allclose(own_x[j][here], x[j][here], rtol=1e-9, atol=1e-9)
        square = np.ix_(here, here)
        np.testing.assert_allclose(own_P[j][square], P[j][square], rtol=1e-9, atol=1e-9)


def test_an_offset_is_mixed_and_predicted_as_by_the_prototype(models):
    with np.load(VECTORS / 'offset_mix.npz') as v:
        law = evolve(
            models.bank,
            speed=float(v['speed_mean']),
            speed_variance=float(v['speed_var']),
            sector=float(v['sigma2']),
        )
        blocks = models.to_blocks(v['x'][None], v['P'][None])
        mixed, c = bank.mix(law, blocks, v['mu'][None], v['transition'][None], bursts.TAIL)
        np.testing.assert_allclose(c[0], v['mixed_mu'], atol=1e-12)
        mask = used(v['kind'])
        assert_states(models, mixed, v['mixed_x'], v['mixed_P'], mask)
        moved = [bank.predict(block, move) for block, move in zip(mixed, models.moves(1.0))]
        # Hovers forget their speed, which those of the prototype do not.
        hovers = np.flatnonzero(v['kind'] == 2)
        assert_states(models, moved, v['predicted_x'], v['predicted_P'], mask, hovers)


def test_an_offset_begins_as_in_the_prototype(models):
    with np.load(VECTORS / 'offset.npz') as v:
        blocks = models.to_blocks(v['x'][None], v['P'][None])
        z, R, one = v['z'][None], v['R'][None], np.ones(1)
        assert (v['P'][:, 4:] == 0.0).all()

        def log_density(blocks, factor):
            found = [
                bank.compare(*bank.predict_fix(b, p.measured, factor), np.zeros(1, int), z, R)
                for b, p in zip(blocks, models.parts)
            ]
            return found, bank.mixture_log_density(v['mu'][None], found)[0]

        _, log = log_density(blocks, np.zeros(1))
        assert log == pytest.approx(float(v['log_density']), rel=1e-9)
        wide = bursts._with_prior(blocks, np.array([True]), np.full(1, float(v['variance'])))
        compared, log = log_density(wide, one)
        assert log == pytest.approx(float(v['log_density_offset']), rel=1e-9)
        after, mu = [], []
        for block, part, pairs in zip(wide, models.parts, compared):
            ratio = np.exp(pairs.log - log)
            done = bank.update(
                block, pairs, np.zeros(1, int), ratio, np.zeros(1), part.measured, None, one
            )
            after.append(done[0])
            mu.append(done[1])
        assert_states(models, after, v['after_x'], v['after_P'], used(v['kind']))
        mu = np.concatenate(mu, axis=1)[0] * v['mu']
        np.testing.assert_allclose(mu / mu.sum(), v['after_mu'], atol=1e-9)


def test_odds_of_the_two_readings():
    with np.load(VECTORS / 'jump.npz') as v:
        odds = bursts.jump_log_odds(*v['counts'].T, 0.05)
        np.testing.assert_allclose(odds, v['log_odds'], atol=1e-12)
    # An established track resists 135 fixes to even odds, 224 until it moves.
    n = np.arange(1, 400)
    odds = bursts.jump_log_odds(np.full(399, 500), np.zeros(399), n, 0.05)
    assert n[odds < 0.0][-1] == 134
    assert n[odds < np.log(99.0)][-1] == 224


def fixes(t, z, R, **more):
    """Fixes z (n, 2) at t (n,), s."""
    for stamp, place, covariance in zip(t, z, R):
        yield evolve(fix(1.0 + stamp, *place, covariance), **more)


def test_two_bursts_are_those_of_the_prototype():
    with np.load(VECTORS / 'rows.npz') as v:
        v = dict(v)
    tracker = DiverTracker(config(adaptation='fixed'))
    made = [tracker.process(each)[-1] for each in fixes(v['t'], v['z'], v['R'])]
    state = np.array([each.state[0] for each in made])
    sd = np.sqrt([np.diag(each.covariance[0])[:2] for each in made])
    apart = np.hypot(*(state - v['mean'])[:, :2].T)
    due = np.sqrt(np.diagonal(v['cov'], axis1=1, axis2=2)[:, :2])
    # After the first fixes, whose scales are pruned otherwise.
    assert (apart[6:] < 0.2).all() and np.median(apart) < 0.02
    assert (np.abs(sd / due - 1.0)[6:] < 0.15).all()
    burst = np.array([each.extras['burst'][0] for each in made])
    second = np.flatnonzero(v['bad'])
    assert (burst[~v['bad']] < 1e-3).all()
    assert (burst[np.setdiff1d(second, [30, 60])] > 0.9).all()
    offset = np.array([(each.extras['offset_x'][0], each.extras['offset_y'][0]) for each in made])
    assert np.isfinite(offset).all(axis=1).sum() == (burst > 0.5).sum()
    assert np.abs(np.hypot(*offset[[35, 65]].T) - 25.0).max() < 2.0
    assert {int(each.extras['track_id'][0]) for each in made} == {1}
    assert tracker._stream.state.rows.tail == 0
    warnings = tracker.warnings()
    assert len(warnings) == 1 and '20 fixes in 2 runs' in warnings[0]


def swim(n, seed=0, std=1.0):
    """Times, truth (n, 2), fixes (n, 2) and covariances of a diver on a circle, a fix a second."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(n))
    truth = 20.0 * np.column_stack([np.cos(0.03 * t), np.sin(0.03 * t)])
    R = np.tile(np.diag([std**2, std**2, np.nan]), (n, 1, 1))
    return t, truth, truth + std * rng.normal(size=truth.shape), R


def errors(made, truth):
    return np.array([np.hypot(*(e.state[0, :2] - p)) for e, p in zip(made, truth)])


@pytest.mark.parametrize(
    'more, settings',
    [
        ({}, {}),
        ({'target_id': 7}, {'max_tracks': 20}),
        ({}, {'association': 'gnn'}),
        ({}, {'dimensions': 3}),
    ],
    ids=['single', 'named', 'gnn', 'with depth'],
)
def test_a_burst_and_outliers_do_not_take_the_diver_along(more, settings):
    t, truth, z, R = swim(70)
    z[30:40] += [18.0, -17.0]
    z[50] += [40.0, 0.0]
    z[55] += [0.0, 60.0]
    tracker = DiverTracker(config(**settings))
    made = [tracker.process(each)[-1] for each in fixes(t, z, R, **more)]
    assert errors(made[41:], truth[41:]).max() < 3.0
    assert {tuple(each.extras['track_id']) for each in made[5:]} == {(1,)}
    # During the burst both places are published.
    assert made[38].covariance[0, 0, 0] > 9.0
    off = DiverTracker(config(burst_rate=0.0, **settings))
    before = [off.process(each)[-1] for each in fixes(t, z, R, **more)]
    assert errors(before[38:42], truth[38:42]).max() > 10.0


def test_a_burst_that_goes_on_is_said_and_becomes_the_truth():
    t, truth, z, R = swim(100)
    z[20:] += [30.0, 0.0]
    tracker = DiverTracker(config(burst_end=0.1))
    made = [tracker.process(each)[-1] for each in fixes(t[:60], z, R)]
    (said,) = (each for each in tracker.warnings() if each.startswith('for '))
    assert said.startswith('for 39 s the fixes of track 1 have been')
    assert 'the estimate holds both' in said
    made += [tracker.process(each)[-1] for each in fixes(t[60:], z[60:], R[60:])]
    # Twenty fixes before, then as many as make the odds 99, at ln .9 each.
    moved = [int(each.extras['track_id'][0]) for each in made]
    first = moved.index(2)
    assert first - 20 == pytest.approx(20 + np.log(99.0) / -np.log(0.9), abs=2.0)
    assert errors(made, truth + [30.0, 0.0])[first:].max() < 3.0


def scans(truth, seed, std=0.7, false=2, half=50.0):
    """Scans of divers at truth (n, T, 2), NaN where not seen, with false fixes."""
    rng = np.random.default_rng(seed)
    for k, places in enumerate(truth, start=1):
        seen = places[np.isfinite(places[:, 0]) & (rng.uniform(size=len(places)) < 0.95)]
        z = seen + std * rng.normal(size=seen.shape)
        z = np.concatenate([z, rng.uniform(-half, half, (rng.poisson(false), 2))])
        covariance = np.tile(std**2 * np.eye(2), (len(z), 1, 1))
        position = np.column_stack([z, np.zeros(len(z))])
        yield Fixes(stamp_ns=k * SECOND, position=position, covariance=covariance, frame_id='map')


def confirmed(estimate):
    """Track IDs and positions (k, 2) of confirmed tracks."""
    firm = estimate.extras['track_state'] > 0
    return estimate.extras['track_id'][firm].tolist(), estimate.state[firm, :2]


def test_a_burst_among_several_divers_takes_no_identity():
    t = np.arange(80.0)
    truth = np.stack(
        [np.column_stack([0.5 * t - 20.0, 0.0 * t]), np.tile([0.0, 30.0], (80, 1))], 1
    )
    seen = truth.copy()
    seen[40:50, 0] += [15.0, -20.0]
    tracker = DiverTracker(DiverConfig())
    made = [tracker.process(scan)[-1] for scan in scans(seen, seed=1)]
    before, after = confirmed(made[38]), confirmed(made[-1])
    assert sorted(before[0]) == sorted(after[0]) and len(after[0]) == 2
    for ids, place in (before, after):
        at = place[np.argsort(ids)]
        due = truth[38 if ids is before[0] else -1]
        assert min(np.hypot(*(at - order).T).max() for order in (due, due[::-1])) < 3.0
    # The new track beside the burst is not published, and the burst is said.
    assert max(len(confirmed(each)[0]) for each in made[40:]) == 2
    assert any('taken for bursts' in each for each in tracker.warnings())


def test_a_burst_excludes_a_track_though_its_second_fix_is_missing():
    """What its first fix begins does not end before it: a new target would be lost to it."""
    t = np.arange(60.0)
    truth = np.column_stack([0.5 * t - 20.0, 0.0 * t])[:, None]
    seen = truth.copy()
    seen[40:48, 0] += [15.0, -20.0]
    seen[41, 0] = np.nan
    tracker, excluded = DiverTracker(DiverConfig()), 0
    for scan in scans(seen, seed=1):
        made = tracker.process(scan)[-1]
        known = tracker._stream.state
        link = known.rows.key['link']
        assert np.isin(link[link != 0], known.life.track_id).all()
        excluded += (link > 0).any()
    assert excluded >= 8
    _, (place,) = confirmed(made)
    assert np.hypot(*(place - truth[-1, 0])) < 3.0


def test_two_false_fixes_that_agree_are_not_said():
    t = np.arange(60.0)
    truth = np.column_stack([0.5 * t - 20.0, 0.0 * t])[:, None]
    for fixes_off, said in ((2, False), (5, True)):
        seen = truth.copy()
        seen[40 : 40 + fixes_off, 0] += [15.0, -20.0]
        tracker = DiverTracker(DiverConfig())
        for scan in scans(seen, seed=5):
            tracker.process(scan)
        assert any('taken for bursts' in each for each in tracker.warnings()) == said


def test_a_new_diver_beside_one_who_is_missed_is_no_burst():
    t = np.arange(80.0)
    first = np.column_stack([0.5 * t - 20.0, 0.0 * t])
    second = np.column_stack([5.0 + 0.3 * (t - 40.0), -18.0 + 0.0 * t])
    truth = np.stack([first, second], 1)
    seen = truth.copy()
    seen[40:42, 0] = np.nan
    seen[:40, 1] = np.nan
    tracker = DiverTracker(DiverConfig())
    made = [tracker.process(scan)[-1] for scan in scans(seen, seed=2)]
    ids, _ = confirmed(made[38])
    after, place = confirmed(made[-1])
    assert len(ids) == 1 and len(after) == 2 and ids[0] in after
    old = place[after.index(ids[0])]
    assert np.hypot(*(old - truth[-1, 0])) < 3.0
    assert np.hypot(*(place[1 - after.index(ids[0])] - truth[-1, 1])) < 3.0


def test_smoothing_leaves_bursts_out():
    t, truth, z, R = swim(50)
    z[25:33] += [25.0, 0.0]
    tracker = SmoothingDiverTracker(config())
    for each in fixes(t, z, R):
        tracker.process(each)
    smoothed = tracker.smoothed()
    assert len(smoothed) == 50
    assert errors(smoothed, truth)[5:].max() < 3.0


def test_clean_fixes_are_not_doubted():
    t, truth, z, R = swim(70, seed=3)
    with_bursts, without = DiverTracker(config()), DiverTracker(config(burst_rate=0.0))
    for each in fixes(t, z, R):
        a, b = (tracker.process(each)[-1] for tracker in (with_bursts, without))
        # A row of a small scale may doubt a fix.
        np.testing.assert_allclose(a.state, b.state, atol=1e-2)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-2)
    assert with_bursts.warnings() == without.warnings() == []
