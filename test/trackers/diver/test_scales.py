# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scales of covariances, delays of sensors, and the table of rows that holds all tracks."""

import math

from attrs import evolve
from helpers.diver_runs import fix, followed, miss, read_only, run, scan_of, SECOND
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.estimation import bank, imm
from sonar_imm.estimation import rows as table
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver import bursts, innovations
from sonar_imm.trackers.diver import scales as law
from sonar_imm.trackers.diver.estimate import published_state
from sonar_imm.trackers.diver.fixes import compare, update_stage
from sonar_imm.trackers.diver.innovations import FARTHEST, FixConsistency, MEMORY
from sonar_imm.trackers.diver.known import repair_covariances
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.pairing import associate_gnn
from sonar_imm.trackers.diver.scan import Scan
from sonar_imm.trackers.diver.sensors import of_sensor
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

WARNED = 'fix covariances too small by a factor'
OF_RADAR = {'sensors': ('radar',), 'own': (('radar.fix_std', 2.0),)}
SETS = [
    {'association': 'jipda'}, {'association': 'gnn'},
    {'model_set': 'heading_speed', 'association': 'gnn', 'gate_probability': 0.9999},
]  # fmt: skip
PLACES = np.array([[0.0, 0.0], [40.0, 0.0], [80.0, 0.0]])
GNN = DiverConfig(**SETS[-1])


def swim(seed, count=110, std=1.0, stated=1.0, lasting=0.0):
    """Fixes each second of a diver who turns now and then, and the positions (count, 2).

    `stated` is the factor between what the fixes state and the variance `std`^2; `lasting` is the
    standard deviation of a Gauss-Markov error of a minute that they do not state.
    """
    rng = np.random.default_rng(seed)
    heading = np.cumsum(np.where(rng.uniform(size=count) < 0.07, rng.normal(0.0, 1.2, count), 0))
    truth = np.cumsum(0.75 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    bias, kept = lasting * rng.normal(size=2), np.exp(-1.0 / 60.0)
    items = []
    for k, place in enumerate(truth, start=1):
        bias = kept * bias + lasting * np.sqrt(1.0 - kept**2) * rng.normal(size=2)
        z = place + bias + std * rng.normal(size=2)
        items.append(fix(k, *z, std**2 * stated * np.eye(2)))
    return items, truth


def held(known, sensor=0):
    """The scales of a sensor and their weights, of all rows and of what is borrowed."""
    tables = known.rows, known.borrowed
    scale = np.concatenate([table.key['scale'][:, sensor] for table in tables])
    return scale, np.exp(np.concatenate([table.logw for table in tables]))


def in_turn(seed, count=160, std=0.3, worse=1.0, late=0.0, speed=0.75):
    """Fixes of two sensors a and b in turn, and the positions: b has `worse` times the standard
    deviation that it states, and shows where the target was `late` seconds ago."""
    rng = np.random.default_rng([seed, 5])
    heading = np.cumsum(np.where(rng.uniform(size=10 * count) < 0.007, rng.normal(0, 1.2), 0))
    step = 0.1 * speed * np.column_stack([np.cos(heading), np.sin(heading)])
    fine, items, truth = np.cumsum(step, axis=0), [], []
    for k in range(10, count):
        of_b = k % 2 == 1
        place = fine[10 * k - round(10 * late) * of_b]
        z = place + std * (worse if of_b else 1.0) * rng.normal(size=2)
        item = fix(k, *z, std**2 * np.eye(2))
        items.append(evolve(item, sensor='b' if of_b else 'a'))
        truth.append(fine[10 * k])
    return items, np.array(truth)


def scored(items, truth, first=20, **values):
    tracker = DiverTracker(DiverConfig(max_tracks=1, **values))
    made = followed(tracker, items)
    off, nees = np.array([miss(*pair) for pair in zip(made[first:], truth[first:])]).T
    return np.sqrt(np.mean(off**2)), np.mean(nees), tracker


@pytest.mark.parametrize('excess', [1e2, 1e4])
def test_covariances_that_are_far_too_small_cost_nothing_and_the_factor_is_named(excess):
    items, truth = swim(3, stated=1.0 / excess)
    rmse, nees, tracker = scored(items, truth)
    due, _, _ = scored(items, truth, covariance_scale=excess)
    # Until the scale is found, some fixes look like the first of a burst.
    assert rmse < 1.12 * due and 1.0 < nees < 3.0
    (warned,) = tracker.warnings()
    factor = float(warned.removeprefix(WARNED).partition(':')[0])
    assert 0.6 < factor / excess < 1.7 and 'e+' not in warned
    assert len(tracker._stream.state.rows) <= 4


def test_a_scale_is_found_also_beside_false_fixes():
    """A track gets one fix of a scan at most; the others are not of it."""
    rng, tracker = np.random.default_rng(3), DiverTracker(DiverConfig())
    for k, place in enumerate(swim(7, count=80)[1], start=1):
        places = np.vstack([place + rng.normal(size=2), rng.uniform(-200.0, 200.0, (2, 2))])
        (estimate,) = tracker.process(scan_of(k, places, std=0.1))
    firm = estimate.extras['track_state'] > 0
    assert estimate.extras['covariance_scale'][firm].max() > 50.0


def steer(seed, std, stated, count=60):
    """Fixes each second of a boat at 6 m/s that turns, and the positions (count, 2)."""
    rng = np.random.default_rng([seed, 6])
    rate = np.repeat(np.deg2rad(8.0) * rng.choice([-1.0, 0.0, 1.0], count // 10), 10)
    heading = np.cumsum(rate)
    truth = np.cumsum(6.0 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    z = truth + std * rng.normal(size=truth.shape)
    return [fix(k, *each, stated**2 * np.eye(2)) for k, each in enumerate(z, start=1)], truth


@pytest.mark.parametrize('std', [1.0, 0.01])
def test_of_a_boat_a_centimetre_that_is_a_metre_is_found_and_a_true_one_left(std):
    """Both look like fixes far more accurate than the boat moves, at first."""
    scales, squares, warned = [], [], 0
    for seed in range(4):
        items, truth = steer(seed, std, 0.01)
        tracker = DiverTracker(DiverConfig(max_tracks=1, target='boat'))
        made = followed(tracker, items)
        squares += [miss(*pair)[1] for pair in zip(made[25:], truth[25:])]
        scales.append(made[-1].extras['covariance_scale'][0])
        said = tracker.warnings()
        assert len(said) == (std == 1.0), said
        warned += sum(text.startswith(WARNED) for text in said)
    if std == 1.0:
        assert 1e3 < np.median(scales) < 1e5 and warned >= 3
    else:
        assert max(scales) <= 10.0
    assert np.mean(squares) < 4.0


def test_covariances_six_times_too_small_are_found_and_not_taken_for_two_sensors():
    """Two places nearer than a fix scatters would fill the gap between the scales 3 and 10."""
    for seed in range(2):
        tracker = DiverTracker(DiverConfig(max_tracks=1))
        made = followed(tracker, swim(seed, count=200, stated=1.0 / 6.0)[0])
        assert 3.0 < np.mean([e.extras['covariance_scale'][0] for e in made[100:]]) < 10.0
        (said,) = tracker.warnings()
        assert said.startswith(WARNED) and 'two groups' not in said


def test_beyond_the_last_scale_no_factor_is_named():
    items, truth = swim(4, stated=1e-6)
    rmse, _, tracker = scored(items, truth, first=40)
    assert rmse < 1.0
    assert f'{WARNED} of more than a million: errors' in tracker.warnings()[0]
    items, _ = swim(4, count=50, stated=1.0 / 300.0)
    *_, tracker = scored(items, truth[:50], covariance_scales=(1.0, 10.0, 100.0))
    assert f'{WARNED} of more than 100: errors' in tracker.warnings()[0]


def test_covariances_that_are_far_too_large_leave_the_mean_alone():
    items, truth = swim(5, stated=50.0)
    rmse, nees, tracker = scored(items, truth)
    due, _, _ = scored(items, truth, covariance_scale=1.0 / 50.0)
    assert rmse < 1.05 * due and nees < 0.5
    assert 'covariances are too large' in tracker.warnings()[0]


def test_the_priors_are_what_redistribution_tends_to():
    """Inside the scales from 1 on and inside the smaller ones; half of the weight each."""
    tracker = DiverTracker(DiverConfig())
    run(tracker, swim(8, count=30)[0])
    known = tracker._stream.state
    for _ in range(40000):
        known = law.redistribute_weights(known, tracker.models.scales)
    scale, weight = held(known)
    prior, large = law.scale_priors(scale), scale >= 1.0
    due = 0.5 * np.where(large, prior / prior[large].sum(), prior / prior[~large].sum())
    np.testing.assert_allclose(weight, due, rtol=1e-6)


def test_a_rejected_fix_weighs_the_scales_by_the_chance_that_it_is_of_the_track():
    """The two readings, enumerated: missed beside a false fix, or seen there under the scale."""
    # With bursts, the fix is an outlier or begins one.
    config = DiverConfig(max_tracks=1, clutter_density=1e-6, burst_rate=0.0)
    tracker, (items, _) = DiverTracker(config), swim(9, count=40, std=0.1)
    run(tracker, items)
    far = fix(41, *(items[-1].position[:2] + [3.0, 0.0]), 0.01 * np.eye(2))
    scan = Scan.from_items([far], config)
    known, (group,) = tracker._predict(tracker._stream.state, scan, far.stamp_ns), scan.fixes
    pairs = compare(known, group, tracker.models, 0.01)
    missed = (1.0 - config.detection_probability) * 1e-6
    before = np.exp(pairs.among.logw)
    due = before * (missed + config.detection_probability * np.exp(pairs.log))
    due = dict(zip(pairs.among.scale, due / due.sum()))
    update = update_stage(tracker.models, lambda _: (None, None))
    scale, weight = held(update(tracker._associate(known, group), group))
    assert not group.association.beta.any()
    np.testing.assert_allclose(weight, [due[each] for each in scale], rtol=1e-9)
    assert due[1000.0] > 100.0 * before[pairs.among.scale == 1000.0][0]


@pytest.mark.parametrize('sensor, values, said', [
    ('', {}, True), ('', {'fix_std': 2.0}, False), ('radar', OF_RADAR, False),
    ('lidar', OF_RADAR, True),
])  # fmt: skip
def test_a_covariance_that_no_message_states_is_said_from_the_first_fix(sensor, values, said):
    tracker = DiverTracker(DiverConfig(**values))
    first = Fix(stamp_ns=10**9, position=[0.0, 0.0, 0.0], frame_id='map', sensor=sensor)
    tracker.process(first)
    due = 'no message states a covariance: fix_std 1 m is assumed, and no ellipse is better'
    assert any(due in text for text in tracker.warnings()) == said
    tracker.process(fix(2, 0.5, 0.0))
    assert not any(due in text for text in tracker.warnings())


def test_errors_that_last_widen_what_is_published():
    """They are in no innovation: no filter that knows only the covariances has a true ellipse."""
    found = []
    for seed in range(2):
        items, truth = swim(20 + seed, count=120, std=0.1, lasting=1.0, stated=100.0)
        _, nees, tracker = scored(items, truth, first=60)
        assert 'set fix_bias_std' in tracker.warnings()[0]
        found.append(nees)
        last = tracker._stream.state
        own = last.memory['fixes'].of(0)._replace(cross=0.0, nis=50.0)
        calm = last.with_memory(fixes=last.memory['fixes'].with_sensor(0, own))
        R = tracker._estimate(last).covariance - tracker._estimate(calm).covariance
        np.testing.assert_allclose(R[0, :2, :2], last['reported'][0, 0] * np.eye(2), atol=1e-9)
        assert last['reported'][0, 0] >= 1.0 and not R[0, 2:].any()
    assert np.mean(found) < 2.5


def test_a_sensor_that_is_worse_than_it_states_does_not_spoil_the_other_one():
    items, truth = in_turn(1, worse=4.0)
    rmse, nees, tracker = scored(items, truth)
    worse = {'a': 1.0, 'b': 16.0}
    stated = [evolve(item, covariance=worse[item.sensor] * item.covariance) for item in items]
    due, _, _ = scored(stated, truth, sensors=('a', 'b'))
    assert rmse < 1.15 * due and 0.8 < nees < 2.8
    (warned,) = tracker.warnings()
    factor = float(warned.partition('of sensor b too small by a factor ')[2].partition(':')[0])
    assert 10.0 < factor < 25.0 and 'Correct its covariances' in warned
    known = tracker._stream.state
    good, bad = (law.estimated_scales(known.rows, sensor)[0] for sensor in (0, 1))
    assert good < 1.5 < 8.0 < bad


def test_two_sensors_that_state_the_truth_cost_nothing_and_are_not_warned_about():
    items, truth = in_turn(2)
    rmse, nees, tracker = scored(items, truth)
    due, _, _ = scored([evolve(item, sensor='') for item in items], truth)
    assert rmse < 1.01 * due and 0.8 < nees < 2.8
    assert not tracker.warnings() and len(tracker._stream.state.borrowed) <= law.MOST_BORROWED


@pytest.mark.parametrize(('target', 'speed', 'std'), [('diver', 0.75, 0.3), ('boat', 6.0, 1.0)])
def test_stamps_that_are_late_are_found_and_said(target, speed, std):
    items, truth = in_turn(3, late=2.0, speed=speed, std=std)
    rmse, nees, tracker = scored(items, truth, first=60, target=target)
    due, _, _ = scored([i for i in items if i.sensor == 'a'], truth[::2], first=30, target=target)
    assert rmse < 1.1 * due and nees < 3.0
    assert any('stamps of sensor b are 2 s late (1)' in text for text in tracker.warnings())
    off, *_, blind = scored(items, truth, first=60, target=target, sensor_delays=())
    assert off > 1.3 * rmse and not any('late' in text for text in blind.warnings())


def test_a_delay_is_measured_as_a_move_back_along_the_velocity():
    """Against H = [I, -tau dv] of each model, in common components."""
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    run(tracker, swim(10, count=15)[0])
    rows, models = tracker._stream.state.rows, tracker.models
    dt = np.linspace(-2.0, 1.0, len(rows))

    def moved(blocks, dt):
        pairs = zip(blocks, models.parts)
        return tuple(bank.move_along(block, part.outputs[2:4], dt) for block, part in pairs)

    x, P = models.to_common(rows.blocks)
    seen = models.to_common(moved(rows.blocks, dt))
    for row in range(len(rows)):
        T = np.repeat(np.eye(models.n)[None], len(models.names), axis=0)
        T[:, :2] += dt[row] * models.E[:, 2:4]
        np.testing.assert_allclose(seen[0][row], np.einsum('mab,mb->ma', T, x[row]), atol=1e-12)
        due = np.einsum('mab,mbc,mdc->mad', T, P[row], T)
        np.testing.assert_allclose(seen[1][row][:, :3, :3], due[:, :3, :3], atol=1e-12)
    for block, before in zip(moved(moved(rows.blocks, dt), -dt), rows.blocks):
        np.testing.assert_allclose(block.P, before.P, atol=1e-12)


def test_late_density_is_that_of_the_prototype():
    """The fix of `offset.npz` with each delay: position minus delay times velocity."""
    v = load_vectors('diver_in_the_field/offset')
    models = build_models(DiverConfig())
    x, P = v['x'][:, :4].copy(), v['P'][:, :4, :4].copy()
    blocks = models.to_blocks(x[None], P[None])
    for delay, due in zip(v['delays'], v['delay_log_density']):
        compared = []
        for block, part in zip(blocks, models.parts):
            moved = bank.move_along(block, part.outputs[2:4], np.array([-delay]))
            compared.append(bank.weigh(moved, np.zeros(1, int), v['delay_z'][None], v['R'][None]))
        log = np.log(v['mu']) + np.concatenate([each.log[0] for each in compared])
        assert np.logaddexp.reduce(log) == pytest.approx(due, abs=1e-9)


def swims(divers, seconds, seed, apart=60.0, false=0.0, detected=0.9, scatter=1.0):
    """Scans of divers who turn, `apart` from each other, one array (k, 2) of each diver, and false
    fixes; the scatter of the fixes in terms of what they state."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(0.3 * rng.normal(size=(seconds, divers)), axis=0)
    place = np.cumsum(0.7 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    place[..., 1] += apart * np.arange(divers)
    for second in range(seconds):
        seen = place[second] + scatter * 0.5 * rng.normal(size=(divers, 2))
        there = rng.uniform(size=divers) < (detected if second > 5 else 1.0)
        wild = rng.uniform(-30.0, 30.0, (rng.poisson(false), 2)) + [0.35 * second, 0.0]
        yield [seen[[d]] if there[d] else seen[:0] for d in range(divers)], wild


def scans(*arguments, **settings):
    for second, (own, wild) in enumerate(swims(*arguments, **settings), start=1):
        yield scan_of(second, np.concatenate([*own, wild]))


@pytest.mark.parametrize('settings', SETS)
def test_every_row_is_that_of_its_track_whoever_begins_and_ends(settings):
    tracker = DiverTracker(DiverConfig(max_tracks=5, **settings))
    scales = np.sort(tracker.models.scales)
    ended, lent, before = 0, 0, tracker._stream.state
    for item in scans(3, 50, 0, apart=5.0, false=3.0, scatter=1.5):
        tracker.process(item)
        known = tracker._stream.state
        rows, borrowed, ids = known.rows, known.borrowed, known.life.track_id
        assert all(len(column) == len(known) for column in known.features.values())
        assert (np.diff(rows.target) >= 0).all()
        assert np.array_equal(np.unique(rows.target), np.arange(len(known)))
        total = np.bincount(rows.target, np.exp(rows.logw), len(known))
        total += np.bincount(borrowed.target, np.exp(borrowed.logw), len(known))
        np.testing.assert_allclose(total, 1.0, rtol=1e-9)
        np.testing.assert_allclose(rows.mu.sum(axis=1), 1.0)
        for track in range(len(known)):
            these = known.row_indices(track)
            plain = (rows.key['offset'] < 0) & ~rows.key['aside']
            own = rows.key['scale'][these][plain[these]]
            own = np.append(own, borrowed.key['scale'][borrowed.target == track], axis=0)
            assert not own[:, 1:].any()
            # The improbable scales of a new or restarted track follow with its second scan.
            begun = (rows.parent[these] < 0).all()
            due = tracker.models.row_scales if begun else scales
            # A scale has several rows where a burst may have begun.
            assert np.array_equal(np.unique(own[:, 0]), due)
        old = rows.parent >= 0
        parents = before.life.track_id[before.rows.target[rows.parent[old]]]
        assert np.array_equal(parents, ids[rows.target[old]])
        ended += len(np.setdiff1d(before.life.track_id, ids))
        lent, before = lent + len(borrowed), known
    assert ended > 10 and (lent > 100) == (len(scales) > 1)


@pytest.mark.parametrize('settings', SETS)
def test_tracks_in_one_table_are_trackers_of_one(settings):
    # No fix of another diver may be one of a burst.
    densities = {'clutter_density': 1e-5, 'birth_density': 1e-5, 'burst_rate': 0.0}
    config = DiverConfig(max_tracks=9, **densities, **settings)
    made = [own for own, _ in swims(3, 30, 4)]

    def followed(of):
        return run(DiverTracker(config), [scan_of(k, of(own)) for k, own in enumerate(made, 1)])

    together = followed(np.concatenate)
    for d in range(3):
        for both, single in zip(together, followed(lambda own, d=d: own[d])):
            assert both.extras['track_id'][d] == d + 1 and len(single) == 1
            for name in ('state', 'covariance', 'probabilities'):
                due = getattr(single, name)[0]
                # Of a whole scan, scales without weight do not see far fixes.
                np.testing.assert_allclose(getattr(both, name)[d], due, rtol=1e-5, atol=1e-5)
            for name in ('existence', 'nis'):
                due = single.extras[name][0]
                np.testing.assert_allclose(both.extras[name][d], due, rtol=1e-4)


@pytest.mark.parametrize('association, scatter', [('jipda', 1.0), ('gnn', 0.5)])
def test_rows_that_lost_their_weight_say_nothing_else(association, scatter, monkeypatch):
    """A tracker that computes every scale gives the same to a tenth of a standard deviation."""
    config = DiverConfig(max_tracks=5, association=association)
    items = list(scans(2, 60, 7, apart=25.0, scatter=scatter))
    trackers, off, wide = [DiverTracker(config) for _ in range(2)], [], []
    thin = run(trackers[0], items)
    for module in (table, bursts):
        monkeypatch.setattr(module, 'ROW_LOST', 1e-300)
    for one, two in zip(thin, run(trackers[1], items)):
        assert np.array_equal(one.extras['track_id'], two.extras['track_id'])
        std, its = (np.sqrt(np.diagonal(e.covariance, axis1=1, axis2=2)) for e in (two, one))
        off.append(np.abs((one.state - two.state) / std).max(initial=0.0))
        wide.append(np.abs(its / std - 1.0).max(initial=0.0))
    assert len(trackers[0]._stream.state.rows) < len(trackers[1]._stream.state.rows)
    assert np.median(off) < 2e-3 and np.median(wide) < 1e-3
    assert max(off) < 0.1 and max(wide) < 0.02


def test_the_covariance_of_a_track_whose_scales_agree_is_that_of_one():
    """An assumption without a row of its own has its weight, and is in no mixture twice."""
    tracker = DiverTracker(DiverConfig())
    run(tracker, scans(2, 20, 8))
    known = tracker._stream.state
    rows, first = known.rows, known.rows.first[known.rows.target]
    same = tuple(block.select(first) for block in rows.blocks)
    agreeing = known.replace(rows=rows.replace(blocks=same, mu=rows.mu[first]))
    one = rows.select(rows.first)
    key = {**one.key, 'scale': of_sensor(np.ones(len(one)), 0)}
    single = known.replace(rows=one.replace(logw=np.zeros(len(one)), key=key))
    wanted = published_state(single, tracker.models, 0.05)
    for each in (agreeing, law.redistribute_weights(agreeing, tracker.models.scales)):
        for ours, due in zip(published_state(each, tracker.models, 0.05), wanted):
            np.testing.assert_allclose(ours, due, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('settings', SETS)
def test_a_spoilt_covariance_is_repaired_alone(settings):
    tracker = DiverTracker(DiverConfig(max_tracks=3, **settings))
    *made, last = scans(3, 21, 9)
    run(tracker, made)
    known = tracker._stream.state
    P = [block.P.copy() for block in known.rows.blocks]
    row = int(known.row_indices(1)[0])

    def spoil(P, of=slice(None)):
        across = 1.5 * np.sqrt(P[row, 0, 0, of] * P[row, 1, 1, of])
        P[row, 0, 1, of] = P[row, 1, 0, of] = across

    spoil(P[0], 2)
    blocks = tuple(Gaussians(block.x, part) for block, part in zip(known.rows.blocks, P))
    after, count = repair_covariances(blocks)
    assert count == 1 and repair_covariances(after)[1] == 0
    for block, before in zip(after, blocks):
        different = np.argwhere((block.P != before.P).any(axis=(1, 2))).tolist()
        assert different == ([[row, 2]] if block is after[0] else [])
    for part in P:
        spoil(part)
    spoilt = known.replace(rows=known.rows.replace(blocks=blocks))
    read_only(spoilt)
    healthy, other = (
        tracker._process_scan(each, last.stamp_ns, [last]) for each in (known, spoilt)
    )
    assert other.counts['repairs'] > healthy.counts.get('repairs', 0)
    other, healthy = (published_state(each, tracker.models, 0.05) for each in (other, healthy))
    for ours, due in zip(other, healthy):
        np.testing.assert_array_equal(ours[[0, 2]], due[[0, 2]])
        assert np.isfinite(ours).all()


def scan(second, places):
    root = np.random.default_rng(second).normal(size=(len(places), 2, 2))
    P = root @ np.swapaxes(root, 1, 2) + 0.2 * np.eye(2)
    places = np.pad(places, [(0, 0), (0, 1)])
    return Fixes(stamp_ns=second * SECOND, position=places, covariance=P)


def predicted(item, config=GNN, places=PLACES):
    tracker = DiverTracker(config)
    run(tracker, [scan(second, places + 0.5 * second) for second in range(1, 6)])
    now = Scan.from_items([item], tracker.config)
    return tracker, tracker._predict(tracker._stream.state, now, item.stamp_ns), now.fixes[0]


def test_taking_fixes_is_the_plain_update_of_those_tracks():
    tracker, known, group = predicted(scan(6, PLACES[[2, 0]] + 3.0))
    x, P = tracker.models.to_common(known.rows.blocks)
    after = known
    for stage in tracker._group_stages:
        after = stage(after, group)
    assert group.association.fix.tolist() == [1, -1, 0]
    tracks, H = np.array([0, 2]), tracker.models.fix_matrix[None]
    z, R = group.z[[1, 0]], group.R[[1, 0]]
    v = z[:, None] - x[tracks, :, :2]
    want = imm.update(x[tracks], P[tracks], known.rows.mu[tracks], v, H, R)
    x1, P1 = tracker.models.to_common(after.rows.blocks)
    pairs = (x1, want.x, x), (P1, want.P, P), (after.rows.mu, want.mu, known.rows.mu)
    for got, plain, before in pairs:
        np.testing.assert_allclose(got[tracks], plain, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(got[1], before[1])
    np.testing.assert_allclose(after['nis'][tracks], want.nis)
    assert after['nis_dof'].tolist() == [2, 0, 2]


def test_the_score_says_how_much_better_than_clutter_a_track_explains_its_fixes():
    tracker, known, group = predicted(scan(6, PLACES[:1] + 3.0))
    pairs = compare(known, group, tracker.models, 1e-6)
    found = associate_gnn(known, group, pairs)
    p, gained = GNN.detection_probability, found.score - known['score']
    density = pairs.track_log[0, 0] - math.log(group.clutter[0])
    np.testing.assert_allclose(gained, [math.log(p) + density, *[math.log1p(-p)] * 2])
    x, P = (part[:1] for part in tracker.models.to_common(known.rows.blocks))
    v, H = group.z[None] - x[..., :2], tracker.models.fix_matrix[None]
    want = imm.update(x, P, known.rows.mu[:1], v, H, group.R)
    np.testing.assert_allclose(pairs.track_log[0, 0], want.log_likelihood[0])


def test_the_account_of_innovations():
    rng = np.random.default_rng(2)
    mean, z = rng.normal(size=(2, 4, 2))
    root = rng.normal(size=(2, 4, 2, 2))
    covariance, R = root @ np.swapaxes(root, -1, -2) + 0.2 * np.eye(2)
    before = rng.normal(size=(4, 2))
    before[2], before[3], z[3] = np.nan, [9.0, -12.0], z[3] + 40.0  # never seen; sharp turns
    tentative = np.array([False, True, False, False])
    old = FixConsistency(MEMORY - 1.0, 30.0, 40.0, 5.0, 35.0)
    white, new = innovations.whiten_innovations(mean, covariance, z, R, before, tentative, old)
    root = np.linalg.cholesky(covariance + R)
    now = np.linalg.solve(root, (z - mean)[..., None])[..., 0]
    np.testing.assert_allclose(white, now)

    def short(v):
        square = np.sum(v**2, axis=1)
        return v * np.minimum(1.0, np.sqrt(2.0 * FARTHEST / square))[:, None]

    firm, own, earlier = short(now[[0, 2, 3]]), short(now[[0, 3]]), short(before[[0, 3]])
    assert np.sum(now[3] ** 2) > 2.0 * FARTHEST and np.sum(now[0] ** 2) < 2.0 * FARTHEST
    want = np.array(old[:5]) + [
        3.0, 0.5 * np.sum(firm**2), 2.0, np.sum(own * earlier), 0.5 * np.sum(own**2 + earlier**2),
    ]  # fmt: skip
    np.testing.assert_allclose(new[:5], want * MEMORY / want[0])


@pytest.mark.parametrize('pairing', ['jipda', 'gnn'])
def test_a_row_that_is_far_away_sees_the_fixes_of_its_track(pairing):
    """Otherwise the row would keep its prediction for ever."""
    config = DiverConfig(association=pairing)
    tracker, known, group = predicted(scan(6, PLACES[:1] + 3.0), config, PLACES[:1])
    blocks = []
    for x, P in known.rows.blocks:
        moved = x.copy()
        moved[0, :2] += 1e3
        blocks.append(Gaussians(moved, P))
    known = known.replace(rows=known.rows.replace(blocks=tuple(blocks)))
    pairs = compare(known, group, tracker.models, 0.01)
    assert len(known.rows) > 1 and set(pairs.assumption) == set(range(len(pairs.among.row)))
