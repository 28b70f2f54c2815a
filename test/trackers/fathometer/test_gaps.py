# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What passes between two records: missing ones, uneven stamps, and layers that dip."""

from attrs import evolve
from helpers.fathometer_runs import order_of, run
import numpy as np
import pytest

from benchmarks import fathometer_sea as gaps
from msg_adapters.displays.fathometer import Displays
from msg_adapters.displays.tracks import MODELS
from sonar_imm.measurements import GeodeticFix
from sonar_imm.trackers.fathometer import slopes
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.pressure import CompanionPlaces, Pace
from sonar_imm.trackers.fathometer.response import Lattice, MAX_MOVES
from sonar_imm.trackers.fathometer.tracker import LONGEST_GAP

OPTIONS = {'particles': 5000}


@pytest.mark.statistics
def test_after_a_gap_it_is_as_if_there_had_been_none():
    """Beside a Kalman filter for each layer, which knows the echoes apart."""
    runs, bounds, gap = [], [], 30
    for seed in range(8):
        traces, truth = gaps.scene(gap, 0.1, seed)
        runs.append(gaps.tracked(traces, truth, **OPTIONS))
        known = np.ones(truth.shape, int)
        bounds.append(
            {'right': known[:, 0], 'found': gaps.kalman(traces, truth, gap), 'ids': known}
        )
    found, bound = gaps.summary(runs), gaps.summary(bounds)
    assert found['P, 1st'] >= 0.75 and found['P, 2nd'] >= 0.875 and found['P, later'] >= 0.95
    assert found['found, 1st'] >= 0.95 and found['kept, 4th'] >= 0.95
    # 48 layers leave .03 of chance.
    assert found['inside, 1st'] >= 0.88 and found['inside, later'] >= 0.93
    assert found['error, 1st, m'] <= 1.5 * bound['error, 1st, m']


def test_the_first_record_has_no_reflector_too_many():
    """Were every number equally probable before, most first records would have one."""
    for seed in range(3):
        tracker, found = run(gaps.scene(0, 0.1, seed)[0][:1], particles=2000)
        assert [order_of(each) for each in found.values()] == [len(gaps.LAYERS)]
        assert tracker.health()['effective_sample_size'] > 400.0


def test_where_half_may_have_come_and_gone_the_set_begins_anew_and_names_stay():
    """Followed over 120 missing records, one set of 2000 is left; after too long a gap all is
    new."""
    traces, _ = gaps.scene(120, 0.1, 4)
    tracker, found = run(traces[: gaps.BEFORE], particles=2000)
    before = set(newest(found).extras['track_id'])
    tracker.process(traces[gaps.BEFORE])
    assert tracker.health()['effective_sample_size'] > 30.0
    (estimate,) = tracker.process(traces[gaps.BEFORE + 1])
    assert (
        len(estimate) == len(gaps.LAYERS) and len(before & set(estimate.extras['track_id'])) >= 5
    )
    tracker, found = run(traces[:10], max_gap=1e8, particles=2000)
    late = traces[9].stamp_ns + (LONGEST_GAP + 2) * 10 * 10**9
    (estimate,) = tracker.process(evolve(traces[10], stamp_ns=late))
    before = set(newest(found).extras['track_id'])
    assert not before & set(estimate.extras['track_id'])
    assert len(before) == len(gaps.LAYERS) and tracker.counts['gaps'] == 1


def newest(found):
    return found[max(found)]


def passed(stamps, fixes=(), **parameters):
    """How many records' time, or way, passes before each stamp, s; fixes: stamp, latitude and
    longitude."""
    pace, config, places, found = Pace(), FathometerConfig(**parameters), CompanionPlaces(), []
    for second, latitude, longitude in fixes:
        stamp_ns = round(second * 1e9)
        places.add(GeodeticFix(stamp_ns=stamp_ns, latitude=latitude, longitude=longitude))
    for stamp_ns in (round(stamp * 1e9) for stamp in stamps):
        place = places.at(stamp_ns, config)
        found.append(pace.records(stamp_ns, config, place))
        pace = pace.after(stamp_ns, place)
    return found


def test_stamps_that_are_not_even_are_no_gaps():
    rng = np.random.default_rng(0)
    stamps = 100.0 + 10.0 * np.arange(200) + rng.uniform(-2.0, 2.0, 200)
    assert passed(stamps) == [1] * 200 == passed(stamps, record_interval=10.0)
    # A burst at the beginning, then the right pace.
    assert passed([0.0, 0.001, 10.0, 20.0, 30.0, 40.0]) == [1] * 6


def test_the_interval_is_learned_from_the_first_records():
    stamps = np.delete(10.0 * np.arange(100), [4, 5, 40, 41, 42])
    steps = passed(stamps)
    assert steps[4] == 3 and steps[38] == 4 and sum(steps) == 100
    # From then on it stays: half as many records are each two records' time.
    assert passed([*range(20), *range(21, 41, 2)])[-9:] == [2] * 9
    assert passed([*range(20), *range(21, 41, 2)], record_interval=2.0) == [1] * 30


METRE = 360.0 / (2.0 * np.pi * 6_378_137.0)
"""In degrees of longitude at the equator."""


def test_by_distance_the_way_counts_and_not_the_time():
    # 2 m/s, then 6 m/s, then at rest, across the date line; fixes between the records.
    at = np.concatenate([2.0 * np.arange(60), 120.0 + 6.0 * np.arange(60), np.full(60, 480.0)])
    fixes = [
        (k + 0.5, 0.0, (179.999 + METRE * x + 180.0) % 360.0 - 180.0) for k, x in enumerate(at)
    ]
    stamps = np.arange(1.0, 171.0, 10.0)
    steps = passed(stamps, fixes, record_distance=20.0)
    assert steps == [1] * 7 + [3] * 6 + [1] * 4
    assert passed(stamps, fixes) == [1] * 17
    # Without a fix that is near enough time counts: 100 m, but one interval.
    lost = [fix for fix in fixes if not 55.0 < fix[0] < 115.0]
    near = passed(stamps, lost, record_distance=20.0, array_depth_age=2.0)
    assert near == [1] * 17
    assert passed(stamps[::12], lost, record_distance=20.0, array_depth_age=2.0) == [1, 24]


def test_what_a_long_way_changes_is_expected_by_distance_only():
    """Records at even times, 30 records' way between two of them."""
    traces, _ = gaps.scene(30, 0.1, 0)
    still = {'slope_std': 0.0, 'sound_speed_std': 0.0, **OPTIONS}
    for record_distance in (0.0, 5.0):
        items = []
        for k, trace in enumerate(traces):
            stamp_ns = round((k + 1) * gaps.SECONDS * 1e9)
            way = METRE * 5.0 * (k + 30 * (k >= gaps.BEFORE))
            fix = GeodeticFix(stamp_ns=stamp_ns, latitude=0.0, longitude=way)
            items += [fix, evolve(trace, stamp_ns=stamp_ns)]
        tracker, found = run(items, record_distance=record_distance, **still)
        right = np.array([order_of(found[stamp]) == len(gaps.LAYERS) for stamp in sorted(found)])
        assert tracker.counts['positions'] == len(traces) and right[: gaps.BEFORE].mean() >= 0.9
        assert tracker.counts['gaps'] == (record_distance > 0.0)
        if record_distance:
            assert right[gaps.BEFORE + 1 :].all()
        else:
            assert not right[gaps.BEFORE : gaps.BEFORE + 2].any()


@pytest.mark.parametrize('options', [{'heave': 'memory', 'array_depth_std': 0.1},
                                     {'polarity': 'both', 'amplitude_memory': 0.9},
                                     {'smoothing_lag': 2}])  # fmt: skip
def test_every_kind_of_state_crosses_a_gap(options):
    traces, truth = gaps.scene(10, 0.1, 3)
    tracker, found = run(traces, **options, **OPTIONS)
    assert tracker.counts['unexplained'] == 0 and tracker.counts['gaps'] == 1
    assert newest(found).state[:, 0] == pytest.approx(truth[-1], abs=0.3)


CONFIG = FathometerConfig()


@pytest.mark.statistics
@pytest.mark.parametrize('layers', [('parallel', 0.8, 0), ('turn', 0.4, 0), ('fan', 0.4, 0),
                                    ('parallel', 0.4, 30)])  # fmt: skip
def test_layers_that_dip_are_followed_without_a_parameter(layers):
    runs = [gaps.tracked(*gaps.dipping(*layers, seed), particles=4000) for seed in range(3)]
    found = gaps.summary(runs)
    assert found['P, before'] >= 0.9 and found['P, later'] >= 0.9
    assert found['inside, before'] >= 0.93 and found['inside, after'] >= 0.93
    assert found['named'] <= len(gaps.DIPPING) + 2.0 and found['kept, 4th'] >= 0.95
    assert found['dipping'] > 0.9


def test_layers_that_are_still_are_called_so():
    """Also beside the order, in displays."""
    last = newest(run(gaps.dipping('parallel', 0.0, 0, 0)[0], particles=2000)[1])
    assert len(last) == len(gaps.DIPPING) and last.extras['dipping'].mean() < 0.3
    last = newest(run(gaps.dipping('parallel', -0.2, 0, 0)[0], particles=2000)[1])
    assert last.extras['dipping'].mean() > 0.9
    # A walk of .1 m over 30 records leaves .02 m.
    assert last.extras['slope'] == pytest.approx(-0.2, abs=0.1)
    off = (last.extras['slope'] + 0.2) / last.extras['slope_std']
    assert np.sqrt(np.mean(off**2)) < 2.5
    drawn = dict(Displays().of(last, lambda message, /, **fields: fields, lambda topic: True))
    names, values = drawn[MODELS]['name'], drawn[MODELS]['position']
    assert names[-2:] == ['still', 'dipping'] and names[0] == 'order_1'
    assert values[-1] == pytest.approx(last.extras['dipping'].mean())
    assert values[-2] + values[-1] == pytest.approx(1.0)
    for options in ({'slope_std': 0.0}, {'heave': 'independent'}):
        found = run(gaps.dipping('parallel', 0.0, 0, 1)[0][:8], particles=500, **options)[1]
        for each in found.values():
            assert not each.extras['dipping'].any() and not each.extras['slope_std'].any()


def followed(changes, seed=0):
    """What is known of a slope after these changes of depth (T,) and a walk."""
    rng, slope = np.random.default_rng(seed), slopes.begun(slopes.Common(), 0.0, CONFIG)
    for change in changes:
        step = change + CONFIG.depth_std * rng.standard_normal()
        slope = slopes.learned(slope, slopes.Common(), step, 0.0, 1, CONFIG)
    return slope


def test_the_slope_is_that_of_a_kalman_filter_while_it_dips_for_sure():
    """Of changes that are all of one slope: the mean with the prior of slope_std."""
    config = evolve(CONFIG, slope_switch_probability=1e-6)
    rng = np.random.default_rng(2)
    changes = 0.8 + 0.1 * rng.standard_normal(20)
    slope = slopes.begun(slopes.Common(), 0.0, config)
    for change in changes:
        slope = slopes.learned(slope, slopes.Common(), float(change), 0.0, 1, config)
    precision = 20 / 0.1**2 + 1 / 0.4**2
    assert slope.dipping == pytest.approx(1.0, abs=1e-3)
    assert slope.mean == pytest.approx(changes.sum() / 0.1**2 / precision, rel=1e-3)
    assert slope.variance == pytest.approx(1.0 / precision, rel=1e-2)
    # A gap says as much of the slope as its walk leaves.
    after = slopes.learned(slope, slopes.Common(), 8.0, 0.0, 10, config)
    more = precision + 100 / (10 * 0.1**2)
    assert after.variance == pytest.approx(1.0 / more, rel=1e-2)


def test_a_slope_begins_ends_and_turns():
    down, flat, back = np.full(15, 0.4), np.zeros(15), np.full(6, -0.4)
    for more, mean, dips in (([], 0.4, True), (flat, 0.0, False), (back, -0.4, True)):
        found = followed(np.append(down, more))
        assert found.dipping > 0.9 if dips else found.dipping < 0.6
        assert found.mean == pytest.approx(mean, abs=0.12)


def test_parallel_layers_share_a_slope_and_others_do_not():
    alike = [slopes.Slope(1.0, mean, 0.01) for mean in (0.38, 0.42, 0.4, 0.41, 0.39)]
    common = slopes.common_slope(alike)
    assert common.mean == pytest.approx(0.4, abs=0.01) and common.dipping > 0.8
    assert np.sqrt(common.variance) < 0.1
    apart = slopes.common_slope(
        [slopes.Slope(1.0, mean, 1e-4) for mean in (0.1, 0.3, -0.2, 0.5, 0.4)]
    )
    assert np.sqrt(apart.variance) > 0.2
    # Of one other, or of those that are still, nothing is known.
    assert slopes.common_slope(alike[:1]).variance == np.inf
    still = slopes.common_slope([slopes.Slope(0.02, 0.3, 0.01)] * 5)
    assert still.variance == np.inf and still.dipping < 0.15
    # A new layer below layers that dip is expected to dip with them.
    new = slopes.ways(slopes.begun(common, 0.0, CONFIG), common, 1, CONFIG)
    assert new.mean[1] == pytest.approx(0.4, abs=0.03) and new.weight[1] > 0.8
    assert new.weight.sum() == pytest.approx(1.0)


def test_walks_lead_where_slopes_do():
    lattice = Lattice(40.0, 1.0 / 64.0, 2000)
    down, still = slopes.Slope(0.98, 0.8, 1e-4), slopes.Slope(0.05, 0.0, 0.01)
    known = [(60.0, still, slopes.Common()), (50.0, down, slopes.Common())]
    walks = slopes.walks_to(known, slopes.Common(), lattice, 1, CONFIG)
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
    far = slopes.walks_to(known, slopes.Common(), lattice, 3000, CONFIG)
    assert far.probability.shape[1] * lattice.cells <= MAX_MOVES + 4 * lattice.cells
    assert far.probability.sum(axis=1) == pytest.approx(1.0)
