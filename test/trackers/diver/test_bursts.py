# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Fixes that are off for a while, in two groups, or in turns: followed as they are, and said."""

import re

from attrs import evolve
from helpers.diver_runs import fix, followed, miss, run, scan_of
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from benchmarks.diver_field import fixes_of, SINGLE
from sonar_imm.estimation import bank
from sonar_imm.trackers.diver import bursts
from sonar_imm.trackers.diver.disagreement import two_places
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.polling import BEFORE, MOST_FIXES, turn_of
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker


def config(**values):
    # The prototype's velocities at the start; what is at its default gives way to those of a boat.
    return DiverConfig(**{'max_tracks': 1, 'velocity_std': np.nextafter(0.7, 1.0), **values})


@pytest.fixture(scope='module')
def models():
    return build_models(config())


def used(kind):
    return (np.arange(6) != 3) | (kind == 1)[:, None]


def assert_states(models, blocks, x, P, mask, skip=()):
    own_x, own_P = (part[0] for part in models.to_common(tuple(blocks)))
    for j in sorted(set(range(len(x))) - set(skip)):
        here, square = mask[j], np.ix_(mask[j], mask[j])
        np.testing.assert_allclose(own_x[j][here], x[j][here], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(own_P[j][square], P[j][square], rtol=1e-9, atol=1e-9)


def test_an_offset_is_mixed_and_predicted_as_by_the_prototype(models):
    v = load_vectors('diver_in_the_field/offset_mix')
    speed = {'speed': float(v['speed_mean']), 'speed_variance': float(v['speed_var'])}
    law = evolve(models.bank, sector=float(v['sigma2']), **speed)
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
    v = load_vectors('diver_in_the_field/offset')
    blocks = models.to_blocks(v['x'][None], v['P'][None])
    z, R, one, nobody = v['z'][None], v['R'][None], np.ones(1), np.zeros(1, int)
    assert (v['P'][:, 4:] == 0.0).all()

    def log_density(blocks, factor):
        found = [
            bank.compare(*bank.predict_fix(b, p.measured, factor), nobody, z, R)
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
        ratio, how = np.exp(pairs.log - log), (np.zeros(1), part.measured, None, one)
        done = bank.update(block, pairs, nobody, ratio, *how)
        after.append(done[0])
        mu.append(done[1])
    assert_states(models, after, v['after_x'], v['after_P'], used(v['kind']))
    mu = np.concatenate(mu, axis=1)[0] * v['mu']
    np.testing.assert_allclose(mu / mu.sum(), v['after_mu'], atol=1e-9)


def test_odds_of_the_two_readings():
    v = load_vectors('diver_in_the_field/jump')
    odds = bursts.jump_log_odds(*v['counts'].T, 0.05)
    np.testing.assert_allclose(odds, v['log_odds'], atol=1e-12)
    # An established track resists 135 fixes to even odds, 224 until it moves.
    n = np.arange(1, 400)
    odds = bursts.jump_log_odds(np.full(399, 500), np.zeros(399), n, 0.05)
    assert n[odds < 0.0][-1] == 134
    assert n[odds < np.log(99.0)][-1] == 224


def fixes(z, std=1.0, **more):
    """Fixes z (n, 2), one a second, good to `std` m."""
    made = (fix(1.0 + k, *place, std**2 * np.eye(2)) for k, place in enumerate(z))
    return [evolve(each, **more) for each in made]


def test_two_bursts_are_those_of_the_prototype():
    v = load_vectors('diver_in_the_field/rows')
    tracker = DiverTracker(config(adaptation='fixed'))
    made = followed(tracker, [fix(1.0 + t, *z, R) for t, z, R in zip(v['t'], v['z'], v['R'])])
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
    (warning,) = tracker.warnings()
    assert '20 fixes in 2 runs' in warning


def swim(n, seed=0, std=1.0):
    """Truth (n, 2) and fixes (n, 2) of a diver on a circle, a fix a second."""
    truth = way(np.arange(float(n)))
    return truth, truth + std * np.random.default_rng(seed).normal(size=truth.shape)


def errors(made, truth):
    return np.array([miss(*pair)[0] for pair in zip(made, truth)])


OTHERS = {
    'single': ({}, {}), 'named': ({'target_id': 7}, {'max_tracks': 20}),
    'gnn': ({}, {'association': 'gnn'}), 'with depth': ({}, {'dimensions': 3}),
}  # fmt: skip


@pytest.mark.parametrize('other', OTHERS)
def test_a_burst_and_outliers_do_not_take_the_diver_along(other):
    more, settings = OTHERS[other]
    truth, z = swim(70)
    z[30:40] += [18.0, -17.0]
    z[[50, 55]] += [[40.0, 0.0], [0.0, 60.0]]
    items = fixes(z, **more)
    made = followed(DiverTracker(config(**settings)), items)
    assert errors(made[41:], truth[41:]).max() < 3.0
    assert {tuple(each.extras['track_id']) for each in made[5:]} == {(1,)}
    # During the burst both places are published.
    assert made[38].covariance[0, 0, 0] > 9.0
    before = followed(DiverTracker(config(burst_rate=0.0, **settings)), items[:42])
    assert errors(before[38:], truth[38:]).max() > 10.0


def test_a_burst_that_goes_on_is_said_and_becomes_the_truth():
    truth, z = swim(100)
    z[20:] += [30.0, 0.0]
    tracker = DiverTracker(config(burst_end=0.1))
    made = followed(tracker, fixes(z)[:60])
    (said,) = (each for each in tracker.warnings() if each.startswith('for '))
    assert said.startswith('for 39 s the fixes of track 1 have been')
    assert 'the estimate holds both' in said
    made += followed(tracker, fixes(z)[60:])
    # Twenty fixes before, then as many as make the odds 99, at ln .9 each.
    first = [int(each.extras['track_id'][0]) for each in made].index(2)
    assert first - 20 == pytest.approx(20 + np.log(99.0) / -np.log(0.9), abs=2.0)
    assert errors(made, truth + [30.0, 0.0])[first:].max() < 3.0


def scans(truth, seed, std=0.7):
    """Scans of divers at truth (n, T, 2), NaN where not seen, with two false fixes each."""
    rng = np.random.default_rng(seed)
    for k, places in enumerate(truth, start=1):
        seen = places[np.isfinite(places[:, 0]) & (rng.uniform(size=len(places)) < 0.95)]
        z = seen + std * rng.normal(size=seen.shape)
        yield scan_of(k, np.concatenate([z, rng.uniform(-50.0, 50.0, (rng.poisson(2), 2))]), std)


def straight(n):
    return np.column_stack([0.5 * np.arange(n) - 20.0, np.zeros(n)])


BURST = [15.0, -20.0]


def confirmed(estimate):
    """Track IDs and positions (k, 2) of confirmed tracks."""
    firm = estimate.extras['track_state'] > 0
    return estimate.extras['track_id'][firm].tolist(), estimate.state[firm, :2]


def test_a_burst_among_several_divers_takes_no_identity():
    truth = np.stack([straight(80), np.tile([0.0, 30.0], (80, 1))], 1)
    seen = truth.copy()
    seen[40:50, 0] += BURST
    tracker = DiverTracker(DiverConfig())
    made = followed(tracker, scans(seen, seed=1))
    before, after = confirmed(made[38]), confirmed(made[-1])
    assert sorted(before[0]) == sorted(after[0]) and len(after[0]) == 2
    for (ids, place), due in ((before, truth[38]), (after, truth[-1])):
        at = place[np.argsort(ids)]
        assert min(np.hypot(*(at - order).T).max() for order in (due, due[::-1])) < 3.0
    # The new track beside the burst is not published, and the burst is said.
    assert max(len(confirmed(each)[0]) for each in made[40:]) == 2
    assert any('taken for bursts' in each for each in tracker.warnings())


def test_a_burst_excludes_a_track_though_its_second_fix_is_missing():
    """What its first fix begins does not end before it: a new target would be lost to it."""
    seen = straight(60)[:, None]
    seen[40:48, 0] += BURST
    seen[41, 0] = np.nan
    tracker, excluded = DiverTracker(DiverConfig()), 0
    for scan in scans(seen, seed=1):
        (made,) = tracker.process(scan)
        known = tracker._stream.state
        link = known.rows.key['link']
        assert np.isin(link[link != 0], known.life.track_id).all()
        excluded += (link > 0).any()
    assert excluded >= 8
    _, (place,) = confirmed(made)
    assert np.hypot(*(place - straight(60)[-1])) < 3.0


def test_two_false_fixes_that_agree_are_not_said():
    for fixes_off, said in ((2, False), (5, True)):
        seen = straight(60)[:, None]
        seen[40 : 40 + fixes_off, 0] += BURST
        tracker = DiverTracker(DiverConfig())
        run(tracker, scans(seen, seed=5))
        assert any('taken for bursts' in each for each in tracker.warnings()) == said


def test_a_new_diver_beside_one_who_is_missed_is_no_burst():
    t = np.arange(80.0)
    second = np.column_stack([5.0 + 0.3 * (t - 40.0), np.full(80, -18.0)])
    seen = np.stack([straight(80), second], 1)
    seen[40:42, 0] = np.nan
    seen[:40, 1] = np.nan
    made = followed(DiverTracker(DiverConfig()), scans(seen, seed=2))
    ids, _ = confirmed(made[38])
    after, place = confirmed(made[-1])
    assert len(ids) == 1 and len(after) == 2 and ids[0] in after
    old = after.index(ids[0])
    assert np.hypot(*(place[[old, 1 - old]] - seen[-1]).T).max() < 3.0


def test_smoothing_leaves_bursts_out():
    truth, z = swim(50)
    z[25:33] += [25.0, 0.0]
    tracker = SmoothingDiverTracker(config())
    run(tracker, fixes(z))
    smoothed = tracker.smoothed()
    assert len(smoothed) == 50
    assert errors(smoothed, truth)[5:].max() < 3.0


def test_clean_fixes_are_not_doubted():
    items = fixes(swim(70, seed=3)[1])
    trackers = DiverTracker(config()), DiverTracker(config(burst_rate=0.0))
    for a, b in zip(*(followed(tracker, items) for tracker in trackers)):
        # A row of a small scale may doubt a fix.
        np.testing.assert_allclose(a.state, b.state, atol=1e-2)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-2)
    assert not any(tracker.warnings() for tracker in trackers)


def way(t):
    return 20.0 * np.stack([np.cos(0.03 * t), np.sin(0.03 * t)], axis=-1)


@pytest.mark.parametrize('offset, std, settings', [
    ((6.0, 8.0), 0.3, {}), ((1.8, 2.4), 0.3, {}), ((-6.0, 0.0), 1.0, {'association': 'gnn'}),
    ((60.0, 80.0), 1.0, {}),
])  # fmt: skip
def test_both_places_are_held_and_said(offset, std, settings):
    truth, z = swim(90, std=std)
    z[1::2] += offset
    tracker = DiverTracker(DiverConfig(max_tracks=1, **settings))
    made = followed(tracker, fixes(z, std))
    nees = np.array([miss(*pair)[1] for pair in zip(made[30:], truth[30:])])
    assert nees.mean() < 3.0 and np.mean(nees < 5.99) > 0.85
    # The ellipse is long along the offset only.
    far, P = np.hypot(*offset), made[-1].covariance[0, :2, :2]
    along = np.array(offset) / far
    across = np.array([-along[1], along[0]])
    assert np.sqrt(along @ P @ along) == pytest.approx(0.5 * far, rel=0.2)
    assert across @ P @ across < std**2
    (sentence,) = tracker.warnings()
    assert sentence.startswith('fixes fall in two groups') and 'two sensors' in sentence
    assert float(re.search(r'\d[\d.e+]*', sentence)[0]) == pytest.approx(far, rel=0.1)
    assert {tuple(each.extras['track_id']) for each in made[30:]} == {(1,)}


def test_a_place_without_fixes_is_given_up():
    truth, z = swim(100, std=0.5)
    z[1:50:2] += [0.0, 8.0]
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    made = followed(tracker, fixes(z, 0.5))
    assert made[49].covariance[0, 1, 1] > 9.0
    assert made[-1].covariance[0, 1, 1] < 1.0
    assert miss(made[-1], truth[-1])[0] < 1.5
    assert not tracker.warnings()


@pytest.mark.parametrize('scene, seed, due', [
    # A row with an offset and hardly any weight is there first.
    ('diver, unnamed, 10 m', 701, 'two groups'), ('diver, b 3 m off', 602, '3 m apart'),
    ('boat, b 2 s late', 600, '2 s late'), ('boat, two sensors', 600, ''),
])  # fmt: skip
def test_an_offset_or_a_delay_is_said_and_nothing_else(scene, seed, due):
    items, truth = fixes_of(SINGLE[scene], seed)
    tracker = DiverTracker(DiverConfig(target=SINGLE[scene].target, max_tracks=1))
    made = followed(tracker, items[:140])
    assert np.mean([miss(*pair)[1] for pair in zip(made, truth) if len(pair[0])][50:]) < 4.0
    said = tracker.warnings()
    assert len(said) == bool(due) and all(due in text for text in said)
    # Scales that stood for the offset at first are left.
    rows = tracker._stream.state.rows
    assert (rows.key['scale'][rows.logw.argmax(), :2] <= 1.0).all()


def test_one_place_is_not_two():
    rng = np.random.default_rng(0)
    v = rng.normal(size=(4, 16, 2))
    v[1, ::2] += [8.0, 6.0]  # in turns
    v[2, 8:] += [8.0, 6.0]  # it moved
    v[3, ::5] += 30.0 * rng.normal(size=(4, 2))  # outliers
    distance, std = two_places(v)
    assert distance[1] == pytest.approx(10.0, abs=1.0) and std[1] < 2.0
    assert (distance[[0, 2, 3]] < 4.5 * std[[0, 2, 3]]).all()
    v[1, 0] = np.nan
    assert two_places(v)[0][1] == 0.0


def in_turn(paths, rate, missing=0.1):
    """120 fixes of targets one after the other; paths: (place at a time) of each."""
    rng, made = np.random.default_rng(0), []
    for k in range(120):
        when = 5.0 + k / rate
        place = paths[k % len(paths)](when) + 0.3 * rng.normal(size=2)
        if rng.uniform() > missing:
            made.append(fix(when, *place, 0.09 * np.eye(2)))
    return made


def circles(count, apart):
    return [lambda t, k=k: circle(t, 1.6 * k, apart * k) for k in range(count)]


def circle(t, phase, x=0.0):
    return np.array([x + 8.0 * np.cos(t / 12 + phase), 8.0 * np.sin(t / 12 + phase)])


def said(items, **settings):
    tracker = DiverTracker(DiverConfig(directions=4, covariance_scales=(1.0,), **settings))
    run(tracker, items)
    return tracker, tracker.warnings()


@pytest.mark.parametrize('targets, rate', [(4, 4.0), (2, 0.5)])
def test_the_advice_once_followed_ends_the_sentence(targets, rate):
    items = in_turn(circles(targets, 30.0), rate)
    tracker, (sentence,) = said(items)  # of tracks that starve, the fixes tell nothing else
    period = targets / rate
    assert f'Set scan_period to {period:.3g}' in sentence and 'covariance' not in sentence
    assert len(tracker._stream.state.memory['single'].stamps) <= MOST_FIXES
    for scan_period in (period, -1.0):
        assert not any('scan_period' in text for text in said(items, scan_period=scan_period)[1])


def test_names_scans_and_single_targets_are_not_polled():
    one = in_turn(circles(1, 0.0), 1.0)
    named = in_turn(circles(3, 12.0), 3.0, 0.0)
    named = [evolve(item, target_id=k % 3) for k, item in enumerate(named)]
    together = [fix(5.0 + k, *circle(k, 2.0 * d)) for k in range(100) for d in range(2)]
    for items in (one, named, together):
        assert not any('scan_period' in text for text in said(items)[1])


@pytest.mark.parametrize('offset, missing', [(6.0, 0.1), (30.0, 0.0)])
def test_two_at_a_constant_offset_are_two_targets_or_two_sensors(offset, missing):
    """They take turns as two targets would: which it is cannot be known, so both are said."""
    paths = [lambda t: circle(t, 0.0), lambda t: circle(t, 0.0) + (offset, 1.0)]
    (sentence,) = said(in_turn(paths, 1.0, missing))[1]
    assert 'two groups of fixes' in sentence and 'offset' in sentence
    assert 'set scan_period to 2' in sentence and 'covariance' not in sentence
    far = float(sentence.partition(' m apart')[0].split()[-1])
    assert far == pytest.approx(np.hypot(offset, 1.0), abs=0.5)


@pytest.mark.parametrize('offset, std', [(3.0, 1.0), (6.0, 0.5)])
def test_a_constant_offset_is_no_second_target_in_any_stretch(offset, std):
    t, rng = np.arange(300.0), np.random.default_rng(4)
    way = np.column_stack([25.0 * np.sin(t / 50.0) + 0.1 * t, 15.0 * np.cos(t / 35.0)])
    places = way + np.outer(t % 2, (offset, 0.0)) + std * rng.normal(size=way.shape)
    stamps = (t * 1e9).astype(np.int64)
    for end in range(2 * BEFORE, 300, 10):
        last = slice(max(0, end - MOST_FIXES), end)
        turn = turn_of(stamps[last], places[last])
        assert turn is None or turn.offset == pytest.approx(offset, abs=1.0)
    # A second target goes his own way.
    other = places + np.outer(t % 2, (8.0, 0.15)) * np.column_stack([np.ones(300), t])
    turn = turn_of(stamps[:MOST_FIXES], other[:MOST_FIXES])
    assert turn.seconds == pytest.approx(2.0) and turn.offset is None
