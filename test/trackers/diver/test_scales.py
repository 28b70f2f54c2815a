# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Covariance scales: found over eight orders of magnitude, named truly, and cheap when absurd."""

from attrs import evolve
from helpers.diver_runs import fix, scan_of
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.estimation import bank
from sonar_imm.estimation.rows import ROW_LOST
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.fixes import compare, update_stage
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.scales import (
    estimated_scales,
    MOST_BORROWED,
    redistribute_weights,
    scale_priors,
)
from sonar_imm.trackers.diver.scan import Scan
from sonar_imm.trackers.diver.tracker import DiverTracker

WARNED = 'fix covariances too small by a factor'


def swim(seed, count=110, std=1.0, stated=1.0, lasting=0.0, time=60.0):
    """Fixes each second of a diver who turns now and then, and the positions (count, 2).

    `stated` is the factor between what the fixes state and the variance `std`^2; `lasting` is the
    standard deviation of a Gauss-Markov error of `time` seconds that they do not state.
    """
    rng = np.random.default_rng(seed)
    heading = np.cumsum(np.where(rng.uniform(size=count) < 0.07, rng.normal(0.0, 1.2, count), 0))
    truth = np.cumsum(0.75 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    bias, kept = lasting * rng.normal(size=2), np.exp(-1.0 / time)
    items = []
    for k, place in enumerate(truth, start=1):
        bias = kept * bias + lasting * np.sqrt(1.0 - kept**2) * rng.normal(size=2)
        z = place + bias + std * rng.normal(size=2)
        items.append(fix(k, *z, std**2 * stated * np.eye(2)))
    return items, truth


def held_scales(known, sensor=0):
    """The scales of a sensor, of all rows and of what is borrowed."""
    tables = known.rows, known.borrowed
    return np.concatenate([table.key['scale'][:, sensor] for table in tables])


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
    """RMSE, NEES and the tracker."""
    tracker, error, squared = DiverTracker(DiverConfig(max_tracks=1, **values)), [], []
    for k, item in enumerate(items):
        last = tracker.process(item)[-1]
        if k >= first:
            error.append(last.state[0, :2] - truth[k])
            squared.append(error[-1] @ np.linalg.solve(last.covariance[0, :2, :2], error[-1]))
    return np.sqrt(np.mean(np.square(error).sum(axis=1))), np.mean(squared), tracker


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
    for seed in range(6):
        items, truth = steer(seed, std, 0.01)
        tracker = DiverTracker(DiverConfig(max_tracks=1, target='boat'))
        for item, place in zip(items, truth):
            (estimate,) = tracker.process(item)
            if item.stamp_ns > 25 * 10**9:
                error = estimate.state[0, :2] - place
                squares.append(error @ np.linalg.solve(estimate.covariance[0, :2, :2], error))
        scales.append(estimate.extras['covariance_scale'][0])
        said = tracker.warnings()
        assert len(said) == (std == 1.0), said
        warned += sum(text.startswith(WARNED) for text in said)
    if std == 1.0:
        assert 1e3 < np.median(scales) < 1e5 and warned >= 5
    else:
        assert max(scales) <= 10.0
    assert np.mean(squares) < 4.0


def test_covariances_six_times_too_small_are_not_taken_for_two_sensors():
    """Two places nearer than a fix scatters would fill the gap between the scales 3 and 10."""
    for seed in range(4):
        tracker = DiverTracker(DiverConfig(max_tracks=1))
        for item in swim(seed, count=200, stated=1.0 / 6.0)[0]:
            tracker.process(item)
        assert not any('two groups' in text for text in tracker.warnings())


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


def test_a_new_track_has_no_rows_of_improbable_scales():
    tracker = DiverTracker(DiverConfig())
    items, _ = swim(7, count=3)
    tracker.process(items[0])
    assert sorted(tracker._stream.state.rows.key['scale'][:, 0]) == [0.15, 1.0, 3.0, 10.0]
    tracker.process(items[1])
    known = tracker._stream.state
    held = held_scales(known)
    assert sorted(held) == list(tracker.models.scales)
    weight = np.exp(np.concatenate([known.rows.logw, known.borrowed.logw]))
    assert weight.sum() == pytest.approx(1.0)
    assert (weight[held > 10.0] < ROW_LOST).all()


def test_the_priors_are_what_redistribution_tends_to():
    """Inside the scales from 1 on and inside the smaller ones; half of the weight each."""
    tracker = DiverTracker(DiverConfig())
    items, _ = swim(8, count=30)
    for item in items:
        tracker.process(item)
    known = tracker._stream.state
    for _ in range(40000):
        known = redistribute_weights(known, tracker.models.scales)
    scale = held_scales(known)
    weight = np.exp(np.concatenate([known.rows.logw, known.borrowed.logw]))
    prior, large = scale_priors(scale), scale >= 1.0
    due = 0.5 * np.where(large, prior / prior[large].sum(), prior / prior[~large].sum())
    np.testing.assert_allclose(weight, due, rtol=1e-6)


def test_a_rejected_fix_weighs_the_scales_by_the_chance_that_it_is_of_the_track():
    """The two readings, enumerated: missed beside a false fix, or seen there under the scale."""
    # With bursts, the fix is an outlier or begins one.
    config = DiverConfig(max_tracks=1, clutter_density=1e-6, burst_rate=0.0)
    tracker = DiverTracker(config)
    items, _ = swim(9, count=40, std=0.1)
    for item in items:
        tracker.process(item)
    far = fix(41, *(items[-1].position[:2] + [3.0, 0.0]), 0.01 * np.eye(2))
    scan = Scan.from_items([far], config)
    known, (group,) = tracker._predict(tracker._stream.state, scan, far.stamp_ns), scan.fixes
    pairs = compare(known, group, tracker.models, 0.01)
    missed = (1.0 - config.detection_probability) * 1e-6
    due = np.exp(pairs.among.logw)
    due *= missed + config.detection_probability * np.exp(pairs.log)
    due = dict(zip(pairs.among.scale, due / due.sum()))
    update = update_stage(tracker.models, lambda _: (None, None))
    after = update(tracker._associate(known, group), group)
    assert not group.association.beta.any()
    held = held_scales(after)
    weight = np.exp(np.concatenate([after.rows.logw, after.borrowed.logw]))
    np.testing.assert_allclose(weight, [due[scale] for scale in held], rtol=1e-9)
    assert due[1000.0] > 100.0 * np.exp(pairs.among.logw[pairs.among.scale == 1000.0][0])


@pytest.mark.parametrize(
    ('sensor', 'values', 'said'),
    [
        ('', {}, True),
        ('', {'fix_std': 2.0}, False),
        ('radar', {'sensors': ('radar',), 'own': (('radar.fix_std', 2.0),)}, False),
        ('lidar', {'sensors': ('radar',), 'own': (('radar.fix_std', 2.0),)}, True),
    ],
)
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
    own = {'sensors': ('a', 'b')}
    stated = [
        evolve(item, covariance=16.0 * item.covariance) if item.sensor == 'b' else item
        for item in items
    ]
    due, _, _ = scored(stated, truth, **own)
    assert rmse < 1.15 * due and 0.8 < nees < 2.8
    (warned,) = tracker.warnings()
    factor = float(warned.partition('of sensor b too small by a factor ')[2].partition(':')[0])
    assert 10.0 < factor < 25.0 and 'Correct its covariances' in warned
    known = tracker._stream.state
    assert estimated_scales(known.rows, 0)[0] < 1.5 < 8.0 < estimated_scales(known.rows, 1)[0]


def test_two_sensors_that_state_the_truth_cost_nothing_and_are_not_warned_about():
    items, truth = in_turn(2)
    rmse, nees, tracker = scored(items, truth)
    due, _, _ = scored([evolve(item, sensor='') for item in items], truth)
    assert rmse < 1.01 * due and 0.8 < nees < 2.8
    assert not tracker.warnings() and len(tracker._stream.state.borrowed) <= MOST_BORROWED


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
    for item in swim(10, count=15)[0]:
        tracker.process(item)
    rows, models = tracker._stream.state.rows, tracker.models
    dt = np.linspace(-2.0, 1.0, len(rows))
    moved = tuple(
        bank.move_along(block, part.outputs[2:4], dt)
        for block, part in zip(rows.blocks, models.parts)
    )
    x, P = models.to_common(rows.blocks)
    seen = models.to_common(moved)
    for row in range(len(rows)):
        T = np.repeat(np.eye(models.n)[None], len(models.names), axis=0)
        T[:, :2] += dt[row] * models.E[:, 2:4]
        np.testing.assert_allclose(seen[0][row], np.einsum('mab,mb->ma', T, x[row]), atol=1e-12)
        due = np.einsum('mab,mbc,mdc->mad', T, P[row], T)
        own = slice(0, 3)
        np.testing.assert_allclose(seen[1][row][:, own, own], due[:, own, own], atol=1e-12)
    same = tuple(
        bank.move_along(block, part.outputs[2:4], -dt) for block, part in zip(moved, models.parts)
    )
    for block, before in zip(same, rows.blocks):
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
