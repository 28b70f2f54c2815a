# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Families: the vectors of an independent prototype, and what the set promises its users."""

import math

from attrs import evolve
from helpers.diver_runs import fix, run, scan_of
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.estimation import bank, rows
from sonar_imm.measurements import NOBODY
from sonar_imm.trackers.diver import models as sets
from sonar_imm.trackers.diver.config import TARGETS
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker


def config(**values):
    # The prototype's velocities at the start, those of swimmers; what is at its default gives way.
    swimmers = np.nextafter(0.7, 1.0)
    return DiverConfig(
        **{'model_set': 'families', 'max_tracks': 1, 'velocity_std': swimmers, **values}
    )


@pytest.fixture(scope='module')
def models():
    return build_models(config())


def used(kind):
    """The components that a model has."""
    return range(4) if kind == 1 else range(3)


def test_chain_and_models_are_those_of_the_prototype(models):
    vectors = load_vectors('regret_free/mixing')
    np.testing.assert_allclose(models.chain.generator, vectors['generator'], atol=1e-12)
    for name, dt in (('transition_1s', 1.0), ('transition_07s', 0.7)):
        np.testing.assert_allclose(models.chain.transition(dt), vectors[name], atol=1e-12)
    np.testing.assert_array_equal(models.families.kind, vectors['kind'])
    assert models.families.sector == pytest.approx(vectors['sector_variance'])


def mixed(models, x, P, mu, transition):
    law = evolve(models.bank, speed=0.75, speed_variance=0.16)
    blocks, c = bank.mix(law, models.to_blocks(x[None], P[None]), mu[None], transition)
    return (part[0] for part in (*models.to_common(tuple(blocks)), c))


def test_mixing_is_that_of_the_prototype(models):
    vectors = load_vectors('regret_free/mixing')
    assert vectors['speed_mean'] == 0.75 and vectors['speed_variance'] == pytest.approx(0.16)
    parts = (vectors[name] for name in ('x', 'P', 'mu'))
    x, P, c = mixed(models, *parts, vectors['transition_1s'][None])
    np.testing.assert_allclose(c, vectors['out_c'], rtol=1e-12)
    for kind, mean, covariance, due_x, due_P in zip(
        vectors['kind'], x, P, vectors['out_x'], vectors['out_P']
    ):
        own = used(kind)
        square = np.ix_(own, own)
        np.testing.assert_allclose(mean[own], due_x[own], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(covariance[square], due_P[square], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    'pair', ['heading_to_cv', 'cv_to_heading', 'cv_to_hover', 'hover_to_cv', 'heading_to_heading']
)
def test_image_of_one_model_in_the_components_of_another(models, pair):
    vectors = load_vectors('regret_free/mixing')
    source, target = int(vectors[f'{pair}/in_model']), int(vectors[f'{pair}/out_model'])
    only = np.zeros(37)
    only[source] = 1.0
    everywhere = np.full((1, 37, 37), 1.0 / 37.0)
    x, P, _ = mixed(models, vectors['x'], vectors['P'], only, everywhere)
    own = used(models.families.kind[target])
    np.testing.assert_allclose(x[target][own], vectors[f'{pair}/x'][own], atol=1e-12)
    covariance = vectors[f'{pair}/P'][np.ix_(own, own)]
    np.testing.assert_allclose(P[target][np.ix_(own, own)], covariance, atol=1e-12)


def test_a_velocity_goes_to_the_headings_it_may_have(models):
    """The probability is shared by the direction of the velocity, not by the chain."""
    vectors = load_vectors('regret_free/mixing')
    source = int(vectors['cv_to_heading/in_model'])
    only = np.zeros(37)
    only[source] = 1.0
    transition = vectors['transition_1s'][None]
    _, _, c = mixed(models, vectors['x'], 0.01 * vectors['P'], only, transition)
    velocity = vectors['x'][source, 2:]
    headings = models.families.kind == 0
    likeliest = models.families.units[headings][c[headings].argmax()]
    assert likeliest @ velocity > 0.9 * np.hypot(*velocity)
    np.testing.assert_allclose(c[headings].sum(), transition[0, source, headings].sum())
    np.testing.assert_allclose(c[~headings], transition[0, source, ~headings], atol=1e-15)


def test_a_run_is_that_of_the_prototype(monkeypatch):
    """Its steps are rounded and not learnt; who stands keeps his pace, each scale its row."""
    monkeypatch.setattr(sets, 'SPEED_MEMORY', 1e12)
    monkeypatch.setattr(rows, 'ROW_LOST', 1e-300)
    fixed = {'association': 'gnn', 'adaptation': 'fixed', 'confirm_hits': 1}
    tracker = DiverTracker(config(**fixed, covariance_scales=(1.0, 3.0, 10.0)))
    exact = tracker.models.chain.transition
    tracker._chain.transition = lambda learnt, dt: np.array(exact(round(dt, 6))[None])
    run = load_vectors('regret_free/run')
    np.testing.assert_allclose(tracker.models.initial, run['start_mu'], atol=1e-15)
    assert tuple(run['scales']) == tracker.config.covariance_scales
    for k, t in enumerate(run['t']):
        estimate = tracker.process(fix(1.0 + t, *run['z'][k], run['R'][k]))[-1]
        known = tracker._stream.state.rows
        for found, name in (
            (estimate.state[0], 'out_x'),
            (estimate.covariance[0], 'out_P'),
            (known.weight, 'out_scale_probability'),
            *((known.mu[copy], f'copy{copy}/mu') for copy in range(3)),
        ):
            np.testing.assert_allclose(found, run[name][k], atol=1e-9)


def test_who_stood_for_minutes_goes_on_at_a_pace_of_his_own(monkeypatch):
    """Fixes half a minute apart, as of a towed tag: who keeps the crawl stays behind."""

    def errors():
        rng, tracker, out = np.random.default_rng(4), DiverTracker(config(association='gnn')), []
        for k in range(27):
            swum = 20.0 * (min(k, 8) + max(k - 24, 0))
            std = 9.0 if k > 24 else 4.0 if k > 8 else 1.5
            offset = 3.0 * rng.normal(size=2) / math.sqrt(2.0)
            estimate = tracker.process(
                fix(100 + 30 * k, swum + offset[0], offset[1], std**2 * np.eye(2))
            )[-1]
            out.append(np.hypot(estimate.state[0, 0] - swum, estimate.state[0, 1]))
        return out

    found = errors()
    monkeypatch.setattr(sets, 'SPEED_MEMORY', 1e12)
    assert max(found[25:]) < 0.75 * max(errors()[25:])


def path(count, speed=0.7, std=0.5, seed=1, every=1.0, scale=1.0, **more):
    """Fixes of a diver who swims east, their covariances `scale` times what is true."""
    rng, items = np.random.default_rng(seed), []
    for k in range(count):
        x, y = [speed * every * k, 0.0] + std * rng.normal(size=2)
        item = fix(100.0 + every * k, x, y, np.eye(2) * std**2 * scale, frame_id='')
        items.append(evolve(item, **more))
    return items


def moved(item, x, y):
    """The same fix elsewhere."""
    return evolve(item, position=item.position + [x, y, 0.0])


@pytest.mark.parametrize('stated', [1.0, 1.0 / 6.0, 6.0])
def test_scale_of_the_stated_covariances(stated):
    """Rows find out what is stated too small, and never take a covariance for too large."""
    tracker = DiverTracker(config())
    estimates = run(tracker, path(300, std=1.0, scale=stated))
    scale = np.mean([e.extras['covariance_scale'][0] for e in estimates[100:]])
    warned = ' '.join(tracker.warnings())
    if stated < 1.0:
        assert 3.0 < scale < 10.0 and 'fix covariances too small' in warned
    else:
        assert 1.0 <= scale < 1.6 and 'fix covariances too small' not in warned


def test_scales_below_one_say_where_the_diver_is_but_not_how_well_that_is_known():
    """Errors of a source that filters look as covariances do that are stated too large."""
    items, found = path(150, speed=0.9, std=0.3, scale=10.0), []
    truth = np.column_stack([0.9 * np.arange(60, 150), np.zeros(90)])
    for scales in ((0.15, 1.0, 3.0, 10.0), (0.1,)):
        tracker = DiverTracker(config(covariance_scales=scales))
        made = run(tracker, items)[60:]
        off = np.array([e.state[0, :2] for e in made]) - truth
        nees = [d @ np.linalg.solve(e.covariance[0, :2, :2], d) for d, e in zip(off, made)]
        scale = np.mean([e.extras['covariance_scale'][0] for e in made])
        found.append((np.mean(nees), scale, np.square(off).sum()))
    (cautious, scale, error), (bold, _, least) = found
    # Both covariances include that of a fix: errors may last.
    assert error < 1.1 * least and 1.0 <= scale < 1.6 and cautious < bold < 0.5


def test_what_is_stated_and_how_far_the_rows_are_apart(monkeypatch):
    """A row below 1 adds the square of how far the means are apart; NIS and scale stay."""
    monkeypatch.setattr(rows, 'ROW_LOST', 1e-300)
    items, runs = path(60, std=0.4, scale=6.0), []
    for scales in ((0.15, 1.0, 3.0, 10.0), (1.0, 3.0, 10.0)):
        settings = {'association': 'gnn', 'adaptation': 'fixed', 'covariance_scales': scales}
        runs.append(run(DiverTracker(config(**settings)), items))
    with_it, without = runs
    apart = 0.0
    for one, other in zip(with_it[5:], without[5:]):
        off = one.state[0] - other.state[0]
        due = other.covariance[0] + np.outer(off, off)
        np.testing.assert_allclose(one.covariance[0], due, atol=1e-9)
        for name in ('nis', 'covariance_scale'):
            np.testing.assert_allclose(one.extras[name], other.extras[name], rtol=1e-9)
        apart = max(apart, np.hypot(*off[:2]))
    assert apart > 0.1


def test_a_name_does_not_make_a_fix_good():
    """Wild fixes with a name, which the rows take for outliers, spoil no more than without."""
    plain, named = path(200, std=0.9), path(200, std=0.9, target_id=7)
    rng = np.random.default_rng(3)
    for k in np.flatnonzero(rng.uniform(size=200) < 0.05)[1:]:
        far = 40.0 * rng.normal(size=2)
        plain[k], named[k] = moved(plain[k], *far), moved(named[k], *far)
    error = []
    for items in (plain, named):
        estimates = run(DiverTracker(config(association='gnn', max_tracks=20)), items)
        rows = [np.flatnonzero(e.extras['track_id'] == 1)[0] for e in estimates]
        at = np.array([e.state[row, :2] for e, row in zip(estimates, rows)])
        error.append(at - np.column_stack([0.7 * np.arange(200), np.zeros(200)]))
    plain_rmse, named_rmse = (np.sqrt(np.mean(np.sum(e[10:] ** 2, axis=1))) for e in error)
    # At an outlier, the place of the fix is published with its weight.
    assert plain_rmse < 0.9 and np.median(np.hypot(*(error[1] - error[0]).T)) < 0.01
    assert named_rmse < 1.2


def test_two_false_fixes_in_clutter_do_not_move_a_track():
    """Where so many are false that two may well agree, tracks begin by their hits."""
    items = path(40)
    for k in (30, 31):
        items[k] = moved(items[k], 50.0, 50.0)
    tracker = DiverTracker(config(max_tracks=5, clutter_density=1e-2))
    estimates = run(tracker, [evolve(item, sensor='') for item in items])
    row = np.flatnonzero(estimates[31].extras['track_id'] == 1)[0]
    assert np.abs(estimates[31].state[row, :2] - [21.7, 0.0]).max() < 5.0


def test_nobody_coasts_while_his_fixes_are_refused():
    """Fixes of a name that agree with nothing are outliers: its track grows wide, and ends."""
    rng = np.random.default_rng(0)
    items = path(60, target_id=7)
    wild = [moved(item, *(3000.0 * rng.normal(size=2))) for item in items[30:50]]
    tracker = DiverTracker(config(max_tracks=5, max_coast=15.0))
    before = run(tracker, items[:30])[-1]
    after = run(tracker, wild)
    assert before.extras['target_id'].tolist() == [7]
    assert after[10].covariance[0, 0, 0] > 10.0 * before.covariance[0, 0, 0]
    assert any(1 not in e.extras['track_id'] for e in after)


def test_transitions_are_learnt_inside_families_only():
    tracker = DiverTracker(config())
    run(tracker, path(200))
    family = tracker.models.families.family
    nominal = tracker.models.chain.transition(1.0)
    learnt = tracker._chain.transition(tracker._stream.state['learnt'], 1.0)[0]
    inside = family[:, None] == family[None]
    np.testing.assert_allclose(learnt[~inside], nominal[~inside], atol=1e-15)
    np.testing.assert_allclose(learnt.sum(axis=1), 1.0)
    assert np.abs(learnt - nominal)[inside].max() > 0.01


def test_smoothing_is_better_than_the_filter():
    rng = np.random.default_rng(2)
    heading = np.cumsum(np.where(rng.uniform(size=80) < 0.06, rng.normal(size=80), 0.0))
    truth = np.cumsum(0.7 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    tracker = SmoothingDiverTracker(config(confirm_hits=1))
    filtered = [
        tracker.process(fix(k + 1, *(z + rng.normal(size=2)), np.eye(2)))[-1]
        for k, z in enumerate(truth)
    ]
    smoothed = tracker.smoothed()
    errors = [np.array([e.state[0, :2] for e in each]) - truth for each in (filtered, smoothed)]
    plain, smooth = (np.sqrt(np.mean(np.sum(e**2, axis=1))) for e in errors)
    assert smooth < 0.85 * plain
    assert [item.stamp_ns for item in smoothed] == [item.stamp_ns for item in filtered]
    assert same(smoothed[-1], filtered[-1])
    for estimate in smoothed:
        assert np.linalg.eigvalsh(estimate.covariance[0]).min() > 0.0
        assert estimate.probabilities.sum() == pytest.approx(1.0)


def test_smoothing_knows_when_behaviour_changed():
    """A scooter that stops: what the families weigh is smoothed too."""
    rng = np.random.default_rng(4)
    x = np.concatenate([2.0 * np.arange(40), np.full(40, 78.0)])
    tracker = SmoothingDiverTracker(config(confirm_hits=1))
    for k, place in enumerate(x):
        tracker.process(fix(k + 1, *([place, 0.0] + 0.3 * rng.normal(size=2)), 0.09 * np.eye(2)))
    smoothed = tracker.smoothed()
    assert np.mean([e.extras['hover'][0] for e in smoothed[52:]]) > 0.7
    speed = [np.hypot(*e.state[0, 2:]) for e in smoothed]
    np.testing.assert_allclose(speed[10:34], 2.0, atol=0.4)


def test_one_row_and_no_hover():
    tracker = DiverTracker(config(covariance_scales=(1.0,), hover=False, directions=8))
    assert len(tracker.models.names) == 19
    estimate = run(tracker, path(30))[-1]
    assert estimate.extras['covariance_scale'].tolist() == [1.0]
    assert estimate.extras['hover'].tolist() == [0.0]
    assert np.abs(estimate.state[0, :2] - [20.3, 0.0]).max() < 1.0


def boat(speed, count, std, name=NOBODY):
    """Fixes of a boat that turns slowly, and its true path (count, 2)."""
    turn = 0.01 * np.arange(count)
    truth = speed / 0.01 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])
    at = truth + std * np.random.default_rng(3).normal(size=truth.shape)
    ids = None if name == NOBODY else [name]
    return [scan_of(1 + k, [z], std, target_id=ids) for k, z in enumerate(at)], truth


@pytest.mark.parametrize(
    'association, name, speed, std',
    [
        ('gnn', NOBODY, 8.0, 0.3),
        ('gnn', 7, 12.0, 1.0),
        ('jipda', NOBODY, 12.0, 1.0),
        ('jipda', 7, 8.0, 0.3),
    ],
)
def test_what_is_faster_than_any_diver_is_tracked_from_its_third_fix(
    association, name, speed, std
):
    tracker = DiverTracker(DiverConfig(association=association))
    fixes, truth = boat(speed, 20, std, name)
    made = [tracker.process(item)[-1] for item in fixes]
    assert {tuple(each.extras['track_id'].tolist()) for each in made} == {(1,)}
    assert all(each.extras['track_state'][0] > 0 for each in made[2:])
    miss = np.array([each.state[0, :2] for each in made[4:]]) - truth[4:]
    P = np.array([each.covariance[0, :2, :2] for each in made[4:]])
    assert np.sqrt(np.square(miss).sum(axis=1).mean()) < 2.0 * std
    assert np.einsum('ka,kab,kb->k', miss, np.linalg.inv(P), miss).mean() < 4.0
    assert not tracker.warnings()


def test_fixes_that_nothing_that_swims_can_cause_are_no_track_and_warn():
    """In millimetres, as it may be."""
    tracker = DiverTracker(DiverConfig())
    fixes, _ = boat(800.0, 30, 0.3)
    made = [tracker.process(item)[-1] for item in fixes]
    assert not any((each.extras['track_state'] > 0).any() for each in made)
    (sentence,) = tracker.warnings()
    assert sentence.startswith('no track takes the fixes') and 'target' in sentence


def test_the_second_of_two_divers_is_not_taken_for_the_first():
    """Two that were seen in the same scan are two."""
    tracker = DiverTracker(DiverConfig())
    for k in range(8):
        seen = [[0.5 * k, 0.0], [0.5 * k, 12.0]][: 1 if k == 0 else 2]
        made = tracker.process(scan_of(k + 1, seen, 0.2))[-1]
    assert (made.extras['track_state'] > 0).sum() == 2


@pytest.mark.parametrize('target', TARGETS)
def test_each_kind_is_what_its_parameters_say(target):
    named, spelt = DiverConfig(target=target), DiverConfig(**TARGETS[target])
    assert named.for_target() == evolve(spelt, target=target)
    assert DiverTracker(named).config == named.for_target()


def test_what_is_stated_is_kept():
    config = DiverConfig(target='ship', speed_mean=9.0)
    assert config.for_target().speed_mean == 9.0
    assert config.for_target().speed_std == TARGETS['ship']['speed_std']
    tracker = DiverTracker(config)
    tracker.reconfigure(evolve(config, fix_std=2.0))
    assert tracker.config.speed_mean == 9.0
    with pytest.raises(ValueError, match='target'):
        tracker.reconfigure(evolve(config, target='fish'))


def test_another_set_is_not_changed_by_the_kind():
    config = DiverConfig(model_set='heading_speed', target='boat')
    assert config.for_target() == config
