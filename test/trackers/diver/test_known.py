# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All that is known after a scan: one table of rows for all tracks, none of which knows of another
but by the fixes that they share."""

from helpers.diver_runs import read_only, run, scan_of
import numpy as np
import pytest

from sonar_imm.estimation import rows as table
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.trackers.diver import bursts
from sonar_imm.trackers.diver.estimate import published_state
from sonar_imm.trackers.diver.known import repair_covariances
from sonar_imm.trackers.diver.scales import redistribute_weights
from sonar_imm.trackers.diver.sensors import of_sensor
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SETS = [
    {'association': 'jipda'},
    {'association': 'gnn'},
    {'model_set': 'heading_speed', 'association': 'gnn', 'gate_probability': 0.9999},
]


def scan(second, places, std=0.5):
    return scan_of(second, places, std)


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
        yield scan(second, np.concatenate([*own, wild]))


@pytest.mark.parametrize('settings', SETS)
@pytest.mark.parametrize('seed', range(2))
def test_every_row_is_that_of_its_track_whoever_begins_and_ends(seed, settings):
    """And the weights of a track, with those that it borrows, sum to one."""
    tracker = DiverTracker(DiverConfig(max_tracks=5, **settings))
    scales = np.sort(tracker.models.scales)
    ended, lent, before = 0, 0, tracker._stream.state
    for item in scans(3, 50, seed, apart=5.0, false=3.0, scatter=1.5):
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
        [scan(k, np.concatenate(own)) for k, (own, _) in enumerate(made, start=1)],
    )
    for d in range(3):
        alone = run(DiverTracker(config), [scan(k, own[d]) for k, (own, _) in enumerate(made, 1)])
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
    for ours, due in zip(
        published_state(agreeing, tracker.models, 0.05),
        published_state(single, tracker.models, 0.05),
    ):
        np.testing.assert_allclose(ours, due, rtol=1e-9, atol=1e-12)
    spread = redistribute_weights(agreeing, tracker.models.scales)
    for ours, due in zip(
        published_state(spread, tracker.models, 0.05),
        published_state(single, tracker.models, 0.05),
    ):
        np.testing.assert_allclose(ours, due, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('settings', SETS)
def test_a_spoilt_covariance_is_repaired_alone(settings):
    tracker = DiverTracker(DiverConfig(max_tracks=3, **settings))
    made = [scan(k, np.concatenate(own)) for k, (own, _) in enumerate(swims(3, 21, 9), start=1)]
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
