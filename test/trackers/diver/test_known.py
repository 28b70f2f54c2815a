# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All that is known after a scan, one table of rows; fixes taken for certain, and the account."""

import math

from helpers.diver_runs import read_only, run, scan_of, SECOND
import numpy as np
import pytest

from sonar_imm.estimation import imm
from sonar_imm.estimation import rows as table
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver import bursts
from sonar_imm.trackers.diver.estimate import published_state
from sonar_imm.trackers.diver.fixes import compare
from sonar_imm.trackers.diver.innovations import (
    FARTHEST,
    FixConsistency,
    MEMORY,
    whiten_innovations,
)
from sonar_imm.trackers.diver.known import repair_covariances
from sonar_imm.trackers.diver.pairing import associate_gnn
from sonar_imm.trackers.diver.scales import redistribute_weights
from sonar_imm.trackers.diver.scan import Scan
from sonar_imm.trackers.diver.sensors import of_sensor
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SETS = [
    {'association': 'jipda'},
    {'association': 'gnn'},
    {'model_set': 'heading_speed', 'association': 'gnn', 'gate_probability': 0.9999},
]


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
    """And the weights of a track, with those that it borrows, sum to one."""
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
    """Divers too far apart to share a fix."""
    # No fix of another diver may be one of a burst.
    densities = {'clutter_density': 1e-5, 'birth_density': 1e-5, 'burst_rate': 0.0}
    config = DiverConfig(max_tracks=9, **densities, **settings)
    made = list(swims(3, 30, 4))
    together = run(
        DiverTracker(config),
        [scan_of(k, np.concatenate(own)) for k, (own, _) in enumerate(made, start=1)],
    )
    for d in range(3):
        by_himself = [scan_of(k, own[d]) for k, (own, _) in enumerate(made, start=1)]
        alone = run(DiverTracker(config), by_himself)
        for both, single in zip(together, alone):
            assert both.extras['track_id'][d] == d + 1 and len(single) == 1
            for name in ('state', 'covariance', 'probabilities'):
                due = getattr(single, name)[0]
                # Of a whole scan, scales without weight do not see far fixes.
                np.testing.assert_allclose(getattr(both, name)[d], due, rtol=1e-5, atol=1e-5)
            for name in ('existence', 'nis'):
                due = single.extras[name][0]
                np.testing.assert_allclose(both.extras[name][d], due, rtol=1e-4)


@pytest.mark.parametrize('scatter', [0.5, 1.0])
@pytest.mark.parametrize('association', ['jipda', 'gnn'])
def test_rows_that_lost_their_weight_would_have_said_nothing_else(
    association, scatter, monkeypatch
):
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
    rows = known.rows
    first = rows.first[rows.target]
    same = tuple(block.select(first) for block in rows.blocks)
    agreeing = known.replace(rows=rows.replace(blocks=same, mu=rows.mu[first]))
    one = rows.select(rows.first)
    stated = np.ones(len(one))
    single = known.replace(
        rows=one.replace(logw=np.zeros(len(one)), key={**one.key, 'scale': of_sensor(stated, 0)})
    )
    wanted = published_state(single, tracker.models, 0.05)
    for each in (agreeing, redistribute_weights(agreeing, tracker.models.scales)):
        for ours, due in zip(published_state(each, tracker.models, 0.05), wanted):
            np.testing.assert_allclose(ours, due, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('settings', SETS)
def test_a_spoilt_covariance_is_repaired_alone(settings):
    tracker = DiverTracker(DiverConfig(max_tracks=3, **settings))
    made = [scan_of(k, np.concatenate(own)) for k, (own, _) in enumerate(swims(3, 21, 9), start=1)]
    run(tracker, made[:20])
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
    last = made[20].stamp_ns, [made[20]]
    healthy, other = (tracker._process_scan(each, *last) for each in (known, spoilt))
    assert other.counts['repairs'] > healthy.counts.get('repairs', 0)
    for ours, due in zip(
        published_state(other, tracker.models, 0.05),
        published_state(healthy, tracker.models, 0.05),
    ):
        np.testing.assert_array_equal(ours[[0, 2]], due[[0, 2]])
        assert np.isfinite(ours).all()


CONFIG = DiverConfig(model_set='heading_speed', association='gnn', gate_probability=0.9999)
PLACES = np.array([[0.0, 0.0], [40.0, 0.0], [80.0, 0.0]])


def scan(second, places):
    rng = np.random.default_rng(second)
    root = rng.normal(size=(len(places), 2, 2))
    return Fixes(
        stamp_ns=second * SECOND,
        position=np.pad(places, [(0, 0), (0, 1)]),
        covariance=root @ np.swapaxes(root, 1, 2) + 0.2 * np.eye(2),
    )


def predicted(item):
    """The tracker of three divers, what it expects of a scan, and the group of its fixes."""
    tracker = DiverTracker(CONFIG)
    for second in range(1, 6):
        tracker.process(scan(second, PLACES + 0.5 * second))
    now = Scan.from_items([item], tracker.config)
    known = tracker._predict(tracker._stream.state, now, item.stamp_ns)
    return tracker, known, now.fixes[0]


def test_taking_fixes_is_the_plain_update_of_those_tracks():
    item = scan(6, PLACES[[2, 0]] + 3.0)
    tracker, known, group = predicted(item)
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
    for got, plain, before in (
        (x1, want.x, x),
        (P1, want.P, P),
        (after.rows.mu, want.mu, known.rows.mu),
    ):
        np.testing.assert_allclose(got[tracks], plain, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(got[1], before[1])
    np.testing.assert_allclose(after['nis'][tracks], want.nis)
    assert after['nis_dof'].tolist() == [2, 0, 2]


def test_the_score_says_how_much_better_than_clutter_a_track_explains_its_fixes():
    item = scan(6, PLACES[:1] + 3.0)
    tracker, known, group = predicted(item)
    pairs = compare(known, group, tracker.models, 1e-6)
    found = associate_gnn(known, group, pairs)
    p, gained = CONFIG.detection_probability, found.score - known['score']
    density = pairs.track_log[0, 0] - math.log(group.clutter[0])
    np.testing.assert_allclose(gained, [math.log(p) + density, *[math.log1p(-p)] * 2])
    x, P = (part[:1] for part in tracker.models.to_common(known.rows.blocks))
    v, H = group.z[None] - x[..., :2], tracker.models.fix_matrix[None]
    want = imm.update(x, P, known.rows.mu[:1], v, H, group.R)
    np.testing.assert_allclose(pairs.track_log[0, 0], want.log_likelihood[0])


def test_tracks_whose_numbers_are_not_finite_are_found():
    tracker, known, _ = predicted(scan(6, PLACES))
    (block,) = known.rows.blocks
    block.x[0, 2, 5], block.P[2, 0, 0, 3] = np.nan, np.inf
    assert known.is_finite().tolist() == [False, True, False]


def test_the_account_of_innovations():
    rng = np.random.default_rng(2)
    mean, z = rng.normal(size=(2, 4, 2))
    root = rng.normal(size=(2, 4, 2, 2))
    covariance, R = root @ np.swapaxes(root, -1, -2) + 0.2 * np.eye(2)
    before = rng.normal(size=(4, 2))
    before[2], before[3], z[3] = np.nan, [9.0, -12.0], z[3] + 40.0  # never seen; sharp turns
    tentative = np.array([False, True, False, False])
    old = FixConsistency(MEMORY - 1.0, 30.0, 40.0, 5.0, 35.0)
    white, new = whiten_innovations(mean, covariance, z, R, before, tentative, old)
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
    tracker = DiverTracker(DiverConfig(association=pairing))
    for second in range(1, 6):
        tracker.process(scan(second, PLACES[:1] + 0.5 * second))
    item = scan(6, PLACES[:1] + 3.0)
    now = Scan.from_items([item], tracker.config)
    known = tracker._predict(tracker._stream.state, now, item.stamp_ns)
    blocks = []
    for x, P in known.rows.blocks:
        moved = x.copy()
        moved[0, :2] += 1e3
        blocks.append(Gaussians(moved, P))
    known = known.replace(rows=known.rows.replace(blocks=tuple(blocks)))
    pairs = compare(known, now.fixes[0], tracker.models, 0.01)
    assert len(known.rows) > 1 and set(pairs.assumption) == set(range(len(pairs.among.row)))
