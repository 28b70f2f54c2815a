# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Layers that dip: the slope of each reflector, what they share, and the walks that follow."""

from attrs import evolve
from helpers.fathometer_runs import run
import numpy as np
import pytest

from benchmarks.fathometer_gaps import BEFORE, DIPPING, dipping, summary, tracked
from msg_adapters.displays.fathometer import Displays
from msg_adapters.displays.tracks import MODELS
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.response import Lattice, MAX_MOVES
from sonar_imm.trackers.fathometer.slopes import (
    begun,
    Common,
    common_slope,
    learned,
    Slope,
    walks_to,
    ways,
)

CONFIG = FathometerConfig()
OPTIONS = {'particles': 4000}


@pytest.mark.statistics
@pytest.mark.parametrize(('kind', 'dip', 'gap'), [('parallel', 0.4, 0), ('parallel', 0.8, 0),
                                                 ('turn', 0.4, 0), ('fan', 0.4, 0),
                                                 ('parallel', 0.4, 30)])  # fmt: skip
def test_layers_that_dip_are_followed_without_a_parameter(kind, dip, gap):
    found = summary([tracked(*dipping(kind, dip, gap, seed), **OPTIONS) for seed in range(3)])
    assert found['P, before'] >= 0.9 and found['P, later'] >= 0.9
    assert found['inside, before'] >= 0.93 and found['inside, after'] >= 0.93
    assert found['named'] <= len(DIPPING) + 2.0 and found['kept, 4th'] >= 0.95
    assert found['dipping'] > 0.9


def test_layers_that_are_still_are_called_so():
    traces, truth = dipping('parallel', 0.0, 0, 0)
    tracker, found = run(traces, **OPTIONS)
    last = max(found.values(), key=lambda each: each.stamp_ns)
    assert len(last) == len(DIPPING) and last.extras['dipping'].mean() < 0.3
    dips, _ = dipping('parallel', -0.2, 0, 0)
    _, found = run(dips, **OPTIONS)
    last = max(found.values(), key=lambda each: each.stamp_ns)
    assert last.extras['dipping'].mean() > 0.9
    # A walk of .1 m over 30 records leaves .02 m.
    assert last.extras['slope'] == pytest.approx(-0.2, abs=0.1)
    off = (last.extras['slope'] + 0.2) / last.extras['slope_std']
    assert np.sqrt(np.mean(off**2)) < 2.5


def test_still_or_dipping_is_shown_beside_the_order():
    traces, _ = dipping('parallel', 0.2, 0, 0)
    _, found = run(traces[:6], particles=500)
    estimate = found[traces[5].stamp_ns]
    drawn = dict(Displays().of(estimate, lambda message, /, **fields: fields, lambda topic: True))
    names, values = drawn[MODELS]['name'], drawn[MODELS]['position']
    assert names[-2:] == ['still', 'dipping'] and names[0] == 'order_1'
    assert values[-1] == pytest.approx(estimate.extras['dipping'].mean())
    assert values[-2] + values[-1] == pytest.approx(1.0)


def followed(slopes, records, seed=0, config=CONFIG):
    """What is known of a slope after changes of depth by `slopes` (T,) and a walk."""
    rng = np.random.default_rng(seed)
    slope = begun(Common(), 0.0, config)
    for change in np.asarray(slopes)[:records]:
        step = change + config.depth_std * rng.standard_normal()
        slope = learned(slope, Common(), step, 0.0, 1, config)
    return slope


def test_the_slope_is_that_of_a_kalman_filter_while_it_dips_for_sure():
    """Of changes that are all of one slope: the mean with the prior of slope_std."""
    config = evolve(CONFIG, slope_switch_probability=1e-6)
    rng = np.random.default_rng(2)
    changes = 0.8 + 0.1 * rng.standard_normal(20)
    slope = begun(Common(), 0.0, config)
    for change in changes:
        slope = learned(slope, Common(), float(change), 0.0, 1, config)
    precision = 20 / 0.1**2 + 1 / 0.4**2
    assert slope.dipping == pytest.approx(1.0, abs=1e-3)
    assert slope.mean == pytest.approx(changes.sum() / 0.1**2 / precision, rel=1e-3)
    assert slope.variance == pytest.approx(1.0 / precision, rel=1e-2)
    # A gap says as much of the slope as its walk leaves.
    after = learned(slope, Common(), 8.0, 0.0, 10, config)
    more = precision + 100 / (10 * 0.1**2)
    assert after.variance == pytest.approx(1.0 / more, rel=1e-2)


def test_a_slope_begins_ends_and_turns():
    down = followed(np.full(15, 0.4), 15)
    assert down.dipping > 0.9 and down.mean == pytest.approx(0.4, abs=0.1)
    flat = followed(np.append(np.full(15, 0.4), np.zeros(15)), 30)
    assert flat.dipping < 0.6 and abs(flat.mean) < 0.1
    up = followed(np.append(np.full(15, 0.4), np.full(6, -0.4)), 21)
    assert up.dipping > 0.9 and up.mean == pytest.approx(-0.4, abs=0.12)


def test_parallel_layers_share_a_slope_and_others_do_not():
    alike = [Slope(1.0, mean, 0.01) for mean in (0.38, 0.42, 0.4, 0.41, 0.39)]
    common = common_slope(alike)
    assert common.mean == pytest.approx(0.4, abs=0.01) and common.dipping > 0.8
    assert np.sqrt(common.variance) < 0.1
    apart = common_slope([Slope(1.0, mean, 1e-4) for mean in (0.1, 0.3, -0.2, 0.5, 0.4)])
    assert np.sqrt(apart.variance) > 0.2
    # Of one other, or of those that are still, nothing is known.
    assert common_slope(alike[:1]).variance == np.inf
    still = common_slope([Slope(0.02, 0.3, 0.01)] * 5)
    assert still.variance == np.inf and still.dipping < 0.15
    # A new layer below layers that dip is expected to dip with them.
    new = ways(begun(common, 0.0, CONFIG), common, 1, CONFIG)
    assert new.mean[1] == pytest.approx(0.4, abs=0.03) and new.weight[1] > 0.8
    assert new.weight.sum() == pytest.approx(1.0)


def test_walks_lead_where_slopes_do():
    lattice = Lattice(40.0, 1.0 / 64.0, 2000)
    down, still = Slope(0.98, 0.8, 1e-4), Slope(0.05, 0.0, 0.01)
    known = [(60.0, still, Common()), (50.0, down, Common())]
    walks = walks_to(known, Common(), lattice, 1, CONFIG)
    assert walks.probability.sum(axis=1) == pytest.approx(1.0)
    assert walks.wide

    def mean(depth):
        kind = walks.kind[round((depth - 40.0) * 64.0)]
        places = walks.centre[kind] + np.arange(walks.probability.shape[1])
        return (walks.probability[kind] @ (places - walks.probability.shape[1] // 2)) / 64.0

    assert mean(50.0) == pytest.approx(0.96 * 0.98 * 0.8, abs=0.02) == mean(50.39)
    assert mean(60.2) == pytest.approx(0.0, abs=0.01)
    assert walks.kind[0] == 0 and walks.kind[640 + 30] == 0
    # However far a gap leads, tables stay as large as they may be.
    far = walks_to(known, Common(), lattice, 3000, CONFIG)
    assert far.probability.shape[1] * lattice.cells <= MAX_MOVES + 4 * lattice.cells
    assert far.probability.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize('options', [{'slope_std': 0.0}, {'heave': 'independent'}])
def test_where_no_slopes_are_followed_all_are_still(options):
    traces, _ = dipping('parallel', 0.0, 0, 1)
    _, found = run(traces[: BEFORE // 2], particles=500, **options)
    for estimate in found.values():
        assert not estimate.extras['dipping'].any() and not estimate.extras['slope_std'].any()
