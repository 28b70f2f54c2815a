# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is reported of a reflector: times, depths in the sediment, and whether it is a multiple."""

import itertools

from attrs import evolve
from helpers.fathometer_runs import near_true, run, sea_scene
from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.acoustics.fathometer import sediment_thickness
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.set_members import Members
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer import multiples
from sonar_imm.trackers.fathometer import reflectors as verbs
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.multiples import Multiples, RECORDS, Seen, ways_above
from sonar_imm.trackers.fathometer.reflectors import Identified, Identities, Reflectors
from sonar_imm.trackers.fathometer.response import Lattice, pulse_of, Response
from sonar_imm.trackers.fathometer.tracker import FathometerTracker


def test_the_thickness_of_sediment_is_that_of_the_vectors():
    v = load_vectors('fathometer_sea/sediment')
    times, kinds = v['two_way_time_below_bottom'], zip(v['sound_speed'], v['gradient'])
    found = [sediment_thickness(times, float(c), float(gradient)) for c, gradient in kinds]
    assert np.array(found) == pytest.approx(v['thickness'], abs=1e-9)


def reflectors(depth, is_bottom):
    covariance = np.tile(np.diag([0.01, 1.0]), (len(depth), 1, 1))
    ones = np.ones(len(depth))
    return Reflectors(np.array(depth), ones, covariance, ones, np.array(is_bottom))


def test_depths_below_the_bottom_are_those_of_the_sediment():
    config = FathometerConfig(sediment_sound_speed=1600.0, sediment_sound_speed_std=80.0)
    depth, std = verbs.sediment_depths(reflectors([55.0, 60.0, 100.0], [0.2, 0.8, 0.0]), config)
    thickness = 40.0 * 1600.0 / 1500.0
    assert depth == pytest.approx([55.0, 60.0, 60.0 + thickness], abs=1e-12)
    assert std == pytest.approx([0.1, 0.1, np.hypot(0.1, 0.05 * thickness)])
    # Without a speed it is as the water.
    depth, std = verbs.sediment_depths(reflectors([60.0, 100.0], [1.0, 0.0]), FathometerConfig())
    assert depth == pytest.approx([60.0, 100.0]) and std == pytest.approx([0.1, 0.1])
    nothing = verbs.sediment_depths(reflectors([], []), FathometerConfig())
    assert [len(each) for each in nothing] == [0, 0]


def layers(depths, amplitudes, records=4, reference_depth=25.0):
    depth, pulse = np.arange(40.0, 72.0, 1.0 / 64.0), band_pulse(50.0, 4000.0, 1500.0)
    clean = sum(a * pulse(depth - z) for z, a in zip(depths, amplitudes))
    rng = np.random.default_rng(1)
    known = {'depth': depth, 'sigma': np.ones(len(depth)), 'reference_depth': reference_depth}
    for k in range(1, records + 1):
        amplitude = clean + 0.3 * rng.standard_normal(len(depth))
        yield Trace(stamp_ns=k * 10**9, amplitude=amplitude, **known)


def test_times_and_the_bottom_in_the_estimate():
    _, found = run(layers([47.0, 58.0], [20.0, 10.0]), particles=2000, sediment_sound_speed=1650.0)
    last, extras = found[4 * 10**9], found[4 * 10**9].extras
    z = last.state[:, 0]
    assert z == pytest.approx([47.0, 58.0], abs=0.05)
    assert extras['two_way_time'] == pytest.approx(2.0 * (z - 25.0) / 1500.0, abs=1e-12)
    assert extras['is_bottom'] == pytest.approx([1.0, 0.0], abs=0.02)
    assert extras['sediment_depth'][1] == pytest.approx(z[0] + 1.1 * (z[1] - z[0]))
    # Without the depth of the array there is no two-way time; multiples need not be marked.
    _, found = run(layers([47.0], [20.0], 2, None), particles=500, multiples='off')
    for each in found.values():
        assert np.isnan(each.extras['two_way_time']).all()
        assert np.isnan(each.extras['multiple_probability']).all()


@pytest.mark.parametrize('column', ['amplitude', 'sigma'])
def test_traces_beyond_numbers_are_refused(column):
    """Squares of such values would make covariances infinite."""
    depth, traces = np.arange(10.0, 40.0, 0.1), []
    for k, unit in enumerate((1e120, 1e98)):
        values = {'amplitude': np.sin(3.0 * depth), 'sigma': np.full(len(depth), 0.1)}
        values[column] = unit * np.abs(values[column])
        traces.append(Trace(stamp_ns=k + 1, depth=depth, **values))
    tracker, found = run(traces, particles=50)
    assert tracker.counts['out_of_range'] == 1
    (estimate,) = found.values()
    seen = np.isfinite(estimate.state[:, 0])
    assert np.isfinite(estimate.covariance[seen]).all()


def test_where_the_window_leaves_nothing_amplitudes_are_not_relative():
    config = FathometerConfig(window='rectangular', sound_speed=1500.0)
    where = np.array([20.0, 80.0])
    nothing = np.zeros((2, 2, 2))
    found = Reflectors(where, np.ones(2), nothing, np.ones(2), np.ones(2))
    grid = np.arange(0.0, 100.0, 1.0)
    # In a snapshot of 0.1 s sound goes to 75 m and back.
    response = Response(1, 'a', grid, grid, grid, 0.0, aperture=3.0, snapshot_seconds=0.1)
    relative = verbs.relative_amplitude(found, response, config)
    assert relative[0] == pytest.approx((2.0 * 20.0 + 3.0) / (1.0 - 40.0 / 150.0))
    assert np.isnan(relative[1])
    # Freed of spreading over the height that is true.
    response = Response(1, 'a', grid, grid, grid, 25.0)
    for heave, height in ((0.0, 30.0), (0.5, 30.5)):
        found = evolve(reflectors([55.0], [1.0]), heave=heave, heave_std=0.1)
        relative = verbs.relative_amplitude(found, response, FathometerConfig())
        assert relative == pytest.approx([2.0 * height])


def test_what_was_lost_does_not_take_over_from_what_is_still_seen():
    """Reflector 6 was lost five records ago, a hand's breadth nearer than 7 was a record ago."""
    config = FathometerConfig(depth_std=0.1)
    lost, seen = (Identified(6, 22.78, 4), Identified(7, 22.92, 0))
    assert list(verbs.nearest_ids(np.array([22.83]), [lost, seen], config)) == [7]
    # Far more probable where it was than a walk of four standard deviations.
    nearer = Identified(6, 22.54, 4)
    assert list(verbs.nearest_ids(np.array([22.53]), [nearer, seen], config)) == [6]
    # Of two that were seen equally long ago the nearest, whatever the order.
    for earlier in ([seen, Identified(8, 22.8, 0)], [Identified(8, 22.8, 0), seen]):
        assert list(verbs.nearest_ids(np.array([22.84, 23.0]), earlier, config)) == [8, 7]


def test_a_reflector_is_waited_for_as_many_records_as_is_told():
    config = FathometerConfig(track_memory=3)
    here, nothing = (np.array([22.8]), np.ones(1)), (np.empty(0), np.empty(0))
    for missed, expected in ((3, 1), (4, 2)):
        ids, (first,) = Identities().name(*here, config)
        for _ in range(missed):
            ids, _ = ids.name(*nothing, config)
        assert [each.missed for each in ids.reflectors] == ([3] if missed == 3 else [])
        assert (first, *ids.name(*here, config)[1]) == (1, expected)


def members(count):
    """Reflectors far apart, as the particles know them: in cells and units of the noise."""
    return Members(
        place=20.0 * np.arange(1, count + 1), amplitude=np.full(count, 5.0),
        covariance=np.tile([[0.25, 0.125], [0.125, 4.0]], (count, 1, 1)),
        prior_variance=np.full(count, 9.0), foremost=np.ones(count), existence=np.ones(count),
    )  # fmt: skip


def test_members_of_sets_become_metres_and_amplitudes_with_what_is_not_known_of_them():
    config = FathometerConfig(array_depth_std=0.5)
    lattice = Lattice(50.0, 0.1, 200)
    sigma = 2.0 + np.arange(200) / 100.0
    response = Response(1, 'array', lattice.depth, np.zeros(200), sigma)
    found = verbs.reflectors_of(members(2), response, lattice, pulse_of(config), config)
    assert found.depth == pytest.approx([52.0, 54.0])
    assert found.amplitude == pytest.approx(5.0 * sigma[[20, 40]])
    for covariance, noise in zip(found.covariance, sigma[[20, 40]]):
        # The cell's own width; the depth of the array; the amplitude given the place.
        depth = 0.1**2 * (0.25 + 1.0 / 12.0) + 0.5**2
        amplitude = noise**2 * (4.0 + 1.0 / (1.0 + 1.0 / 9.0))
        expected = [[depth, 0.1 * noise * 0.125], [0.1 * noise * 0.125, amplitude]]
        assert covariance == pytest.approx(np.array(expected), rel=1e-3)
    # Where heave is a state the particles are spread by it, and the noise is that of the place
    # where the echo lies in the record.
    known = response, lattice, pulse_of(config), config
    heaved = verbs.reflectors_of(members(2), *known, heave=(1.0, 0.25))
    assert heaved.covariance[:, 0, 0] == pytest.approx(0.1**2 * (0.25 + 1.0 / 12.0))
    assert heaved.amplitude == pytest.approx(5.0 * sigma[[30, 50]])
    assert (heaved.heave, heaved.heave_std) == (1.0, 0.25)


def test_identities_beyond_32_bits_are_those_that_no_reflector_has():
    here = np.array([10.0, 14.0, 18.0]), np.array([1.0, 0.0, 0.0])
    first, ids = Identities(next_id=2**32 - 2).name(*here, FathometerConfig())
    again, same = first.name(*here, FathometerConfig())
    assert ids.tolist() == same.tolist() == [2**32 - 2, 2**32 - 1, 1]
    assert (first.next_id, again.next_id) == (2, 2)


def test_pmf_of_what_is_detectable_is_that_of_independent_reflectors():
    config = FathometerConfig(order_max=4, detectable_sigmas=4.0)
    rows = zip((1, 2, 3), (10.0, 12.0, 14.0), (9.0, -4.1, 2.0), (20, 5, 1))
    known = Identities(tuple(Identified(k, z, 0, strength=s, shown=n) for k, z, s, n in rows))
    existence = np.array([0.9, 0.8, 0.7])
    pmf = known.detectable(np.array([1, 2, 3], np.uint32), existence, config)
    off = np.array([5.0, 0.1, -2.0]) / np.sqrt(1.0 / np.array([20, 5, 1]) + 0.15**2)
    p = existence * norm.cdf(off)
    expected = np.zeros(5)
    for there in itertools.product((0, 1), repeat=3):
        expected[sum(there)] += np.prod(np.where(there, p, 1.0 - p))
    assert pmf == pytest.approx(expected) and pmf.sum() == pytest.approx(1.0)


def test_strength_is_a_mean_of_the_last_twenty_records():
    known, here = (Identities(), (np.array([10.0]), np.ones(1), FathometerConfig()))
    for strength in [3.0] * 30 + [5.0]:
        known, _ = known.name(*here, strength=np.array([strength]))
    (only,) = known.reflectors
    assert only.shown == 20 and only.strength == pytest.approx(3.0 + 2.0 / 20.0)


def test_weak_layers_are_not_counted_among_the_detectable():
    rng, depth = np.random.default_rng(5), 0.1 * np.arange(400)
    echo = np.exp(-0.5 * np.square((depth[:, None] - [10.0, 18.0, 27.0]) / 0.3)) @ [12.0, 8.0, 2.4]
    pulse = np.exp(-0.5 * np.square(np.arange(-15, 16) / 3.0 * 1.41))
    config = FathometerConfig(pulse='gaussian', pulse_width=0.3, particles=1000)
    tracker, late = FathometerTracker(config), []
    for k in range(1, 41):
        noise = np.convolve(rng.standard_normal(430), pulse, 'same')[15:415]
        seen = {'depth': depth, 'amplitude': echo + noise / noise.std(), 'sigma': np.ones(400)}
        (estimate,) = tracker.process(Trace(stamp_ns=k * 10**9, **seen))
        late += [estimate.columns()] if k > 10 else []
    assert np.mean([row['prob_detectable_2'][0] for row in late]) > 0.95
    assert late[0]['detectable_amplitude'][0] == pytest.approx(4.0)
    assert sum(late[-1][f'prob_detectable_{k}'][0] for k in range(13)) == pytest.approx(1.0)


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


def drawn(rng, records, walk):
    """Depths (T, 6), ascending, with errors: the primaries, a surface multiple, a peg-leg."""
    primaries = np.array([9.0, 12.5, 17.0, 23.0])
    z = primaries + walk * np.cumsum(rng.standard_normal((records, 4)), axis=0)
    surface, leg = z[:, 0] + z[:, 2], 2.0 * z[:, 3] - z[:, 0]
    found = np.column_stack([z, surface, leg]) + 0.03 * rng.standard_normal((records, 6))
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


@pytest.mark.parametrize('walk, records', [(0.0, 20), (0.05, 5)])
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
    # One wrong record does not decide.
    depth = np.tile([9.0, 18.0], (20, 1))
    depth[10, 1] += 1.5
    assert after(depth, FathometerConfig())[1] > 0.9


def odds(depths, config, **options):
    """Of the last reflector."""
    p = after(np.array([depths]), config, **options)[-1]
    return p / (1.0 - p)


def test_all_ways_share_one_prior():
    """More reflectors above are more ways by which one may lie there by chance."""
    config, few, many = FathometerConfig(), [9.0, 18.05], [5.1, 7.7, 9.0, 18.05]
    assert [len(ways_above(np.ones(len(z)), len(z) - 1).sign) for z in (few, many)] == [1, 10]
    assert odds(few, config) / odds(many, config) == pytest.approx(10.0, rel=0.05)


def test_of_very_many_ways_the_nearest_count(monkeypatch):
    """Here both reflectors together alone, and not twice either, which ends 0.05 m beside it."""
    depths, config = [9.0, 9.05, 18.05], FathometerConfig()
    all_ways = odds(depths, config)
    monkeypatch.setattr(multiples, 'MOST_WAYS', 1)
    assert 2.0 < all_ways / odds(depths, config) < 3.0


def test_the_sign_counts_where_there_are_two():
    depths, right, wrong = [9.0, 18.05], {'sign': [1.0, -1.0]}, {'sign': [1.0, 1.0]}
    both, positive = FathometerConfig(polarity='both'), FathometerConfig()
    # Told right .95 times against .05, where .05 and .95 of the primaries have that sign.
    ratio = odds(depths, both, **right) / odds(depths, both, **wrong)
    assert ratio == pytest.approx((0.95 / 0.05) ** 2)
    assert odds(depths, positive, **right) == odds(depths, positive, **wrong)


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
            nearest, distance = near_true(estimate, scene.depth_at(stamp))
            true, near = multiple[nearest], distance < 0.3
            marked = estimate.extras['multiple_probability'] > 0.5
            flagged += list(marked[near & true])
            wrongly += list(marked[near & ~true])
    assert len(flagged) > 80 and len(wrongly) > 140
    assert np.mean(flagged) >= 0.85 and np.mean(wrongly) <= 0.05
