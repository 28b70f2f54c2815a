# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Multiples: marked where they are, and not where they are not."""

from helpers.fathometer_runs import run
from helpers.sea_scenes import sea_scene
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.trackers.fathometer import multiples
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.multiples import Multiples, RECORDS, Seen, ways_above

PRIMARIES = np.array([9.0, 12.5, 17.0, 23.0])


def record(depth, sign=None, std=0.03, ids=None):
    depth = np.asarray(depth, float)
    K = len(depth)
    ids = np.arange(1, K + 1) if ids is None else np.asarray(ids)
    sign = np.ones(K) if sign is None else np.asarray(sign, float)
    return Seen(ids.astype(np.uint32), depth, np.full(K, std**2), sign, 0.03**2)


def after(depths, config, **options):
    """Probabilities (K,) after records of reflectors at depths (T, K)."""
    marked = Multiples()
    for row in depths[:-1]:
        marked = marked.after(record(row, **options))
    return marked.probabilities(record(depths[-1], **options), config, 40.0)


def drawn(rng, records, walk=0.0, std=0.03):
    """Depths (T, 6), ascending, with errors: the primaries, a surface multiple, a peg-leg."""
    z = PRIMARIES + walk * np.cumsum(rng.standard_normal((records, 4)), axis=0)
    surface, leg = z[:, 0] + z[:, 2], 2.0 * z[:, 3] - z[:, 0]
    found = np.column_stack([z, surface, leg]) + std * rng.standard_normal((records, 6))
    found[:, 4] += 0.03 * rng.standard_normal(records)
    return found


def test_the_ways_are_pairs_and_triples_above():
    depth, sign = np.array([10.0, 14.0, 20.0]), np.array([1.0, -1.0, 1.0])
    ways = ways_above(sign, 2)
    ends = (depth[ways.member] * ways.factor).sum(axis=1)
    assert sorted(ends) == pytest.approx([18.0, 20.0, 24.0, 28.0])  # 2 x 14 - 10 and three pairs
    by_end = dict(zip(np.round(ends), ways.sign, strict=True))
    assert by_end == {20.0: -1.0, 24.0: 1.0, 28.0: -1.0, 18.0: -1.0}
    assert sorted(ways.datum) == [0.0, 1.0, 1.0, 1.0]
    assert len(ways_above(sign, 0).sign) == 0


@pytest.mark.parametrize('walk, records', [(0.0, 20), (0.05, 20), (0.05, 5)])
def test_drawn_multiples_are_found_and_primaries_are_not(walk, records):
    rng, config = np.random.default_rng(1), FathometerConfig(depth_std=0.05)
    found = np.array([after(drawn(rng, records, walk), config) for _ in range(60)]) > 0.5
    assert found[:, 4:].mean() >= 0.85
    assert found[:, :4].mean() <= 0.05


def test_a_primary_that_starts_where_a_multiple_would_be_walks_away():
    rng, config = np.random.default_rng(2), FathometerConfig(depth_std=0.1)
    depth = np.tile([9.0, 18.0], (RECORDS, 1)) + 0.01 * rng.standard_normal((RECORDS, 2))
    assert after(depth[:1], config)[1] > 0.5
    assert after(depth, config)[1] > 0.99
    depth[:, 1] += 0.1 * np.cumsum(np.abs(rng.standard_normal(RECORDS)))
    assert after(depth, config)[1] < 0.01


def test_one_wrong_record_does_not_decide():
    config, depth = FathometerConfig(), np.tile([9.0, 18.0], (20, 1))
    depth[10, 1] += 1.5
    assert after(depth, config)[1] > 0.9


def test_all_ways_share_one_prior():
    """More reflectors above are more ways by which one may lie there by chance."""
    config = FathometerConfig()
    few, many = np.array([[9.0, 18.05]]), np.array([[5.1, 7.7, 9.0, 18.05]])

    def odds(depth):
        p = after(depth, config)[-1]
        return p / (1.0 - p)

    ways = [len(ways_above(np.ones(d.shape[1]), d.shape[1] - 1).sign) for d in (few, many)]
    assert ways == [1, 10]
    assert odds(few) / odds(many) == pytest.approx(10.0, rel=0.05)


def test_of_very_many_ways_the_nearest_count(monkeypatch):
    """Here both reflectors together alone, and not twice either, which ends 0.05 m beside it."""
    odds = []
    for most in (multiples.MOST_WAYS, 1):
        monkeypatch.setattr(multiples, 'MOST_WAYS', most)
        p = after(np.array([[9.0, 9.05, 18.05]]), FathometerConfig())[-1]
        odds.append(p / (1.0 - p))
    assert 2.0 < odds[0] / odds[1] < 3.0


def test_the_sign_counts_where_there_are_two():
    depth = np.tile([9.0, 18.05], (1, 1))
    both, positive = FathometerConfig(polarity='both'), FathometerConfig()
    right, wrong = {'sign': [1.0, -1.0]}, {'sign': [1.0, 1.0]}
    right_odds, wrong_odds = (
        p / (1.0 - p) for p in (after(depth, both, **kind)[1] for kind in (right, wrong))
    )
    # Told right .95 times against .05, where .05 and .95 of the primaries have that sign.
    assert right_odds / wrong_odds == pytest.approx((0.95 / 0.05) ** 2)
    assert after(depth, positive, **right)[1] == after(depth, positive, **wrong)[1]


@settings(max_examples=40, deadline=None)
@given(
    depth=st.lists(st.floats(-10.0, 12_000.0), max_size=9),
    ids=st.permutations(range(1, 10)),
    std=st.floats(0.0, 1e4),
)
def test_probabilities_are_probabilities(depth, ids, std):
    depth = sorted(depth)
    config = FathometerConfig(polarity='both')
    first = record(depth, std=max(std, 1e-3), ids=ids[: len(depth)])
    found = Multiples().after(first).probabilities(first, config, 40.0)
    assert found.shape == (len(depth),)
    assert ((found >= 0.0) & (found <= 1.0)).all()


def test_multiples_of_the_vectors_are_marked_through_the_filter():
    scene = sea_scene('multiples')
    multiple = scene.file['is_multiple'].astype(bool)
    _, found = run(scene.traces(), particles=2000, polarity='both')
    flagged, wrongly = [], []
    for stamp, estimate in found.items():
        if stamp > 10 * 10**9:
            distance = np.abs(estimate.state[:, :1] - scene.depth_at(stamp))
            true, near = multiple[distance.argmin(axis=1)], distance.min(axis=1) < 0.3
            marked = estimate.extras['multiple_probability'] > 0.5
            flagged += list(marked[near & true])
            wrongly += list(marked[near & ~true])
    assert len(flagged) > 80 and len(wrongly) > 140
    assert np.mean(flagged) >= 0.85 and np.mean(wrongly) <= 0.05


def test_they_need_not_be_marked():
    scene = sea_scene('multiples')
    _, found = run(scene.traces(range(2)), particles=200, multiples='off')
    assert all(np.isnan(each.extras['multiple_probability']).all() for each in found.values())
