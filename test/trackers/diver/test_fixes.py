# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fixes taken for certain against the plain update, and the account of their innovations."""

import math

from helpers.diver_runs import SECOND
import numpy as np
import pytest

from sonar_imm.estimation import imm
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.fixes import compare
from sonar_imm.trackers.diver.innovations import (
    FARTHEST,
    FixConsistency,
    MEMORY,
    whiten_innovations,
)
from sonar_imm.trackers.diver.pairing import associate_gnn
from sonar_imm.trackers.diver.scan import Scan
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

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
