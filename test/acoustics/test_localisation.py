# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fix: statistics against the bound, ghosts, singular geometry, reflections, hostile input;
and a real recording."""

import os
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

from sonar_imm.acoustics import multistatic
from sonar_imm.acoustics.localisation import Candidate, Limits, Localisation, localise, Refusal


def scene_of(rx, toa, noise, **more):
    toa = toa + noise[0] * np.random.default_rng(noise[1]).standard_normal(len(rx))
    known = {'rx': rx, 'var_toa': np.full(len(rx), SIGMA**2), 'target_z': Z}
    return {**known, 'toa': toa, 'sound_speed': SOUND_SPEED, **more}


SOUND_SPEED, Z, SIGMA = 1500.0, -5.0, 1e-4
TX = np.array([5.0, -10.0, -2.0])
RX = np.array(
    [
        [100.0, 10.0, -2.0], [-20.0, 90.0, -3.0], [70.0, 95.0, -1.0], [-60.0, 20.0, -3.0],
        [20.0, -70.0, -2.0], [110.0, 60.0, -4.0], [-70.0, 80.0, -1.0], [40.0, 40.0, -2.0],
    ]
)  # fmt: skip
TRUTH = np.array([31.0, 42.0])


def active(n, truth=TRUTH, tx=TX, rx=RX, sigma=0.0, seed=0, **more):
    """Arguments of `localise` for n receivers and one transmitter."""
    tx = np.tile(tx, (n, 1))
    toa = multistatic.range_sum(truth, tx, rx[:n], Z) / SOUND_SPEED
    return scene_of(rx[:n], toa, (sigma, seed), tx=tx, **more)


def passive(n, truth=TRUTH, rx=RX, sigma=0.0, seed=0, emission=1e9, **more):
    """Arguments of `localise` for n receivers of a tag that emits at an unknown time."""
    toa = multistatic.slant_range(truth, rx[:n], Z)[0] / SOUND_SPEED + emission
    return scene_of(rx[:n], toa, (sigma, seed), **more)


def crlb(n, kind, sigma_bearing):
    """The Cramer-Rao bound (2, 2) in m^2 on any unbiased fix of n receivers at TRUTH, by
    differences of what they hear, in standard deviations."""

    def heard(x):
        path = np.linalg.norm(np.append(x, Z) - RX[:n], axis=1)
        path += np.linalg.norm(np.append(x, Z) - TX) * (kind != 'passive')
        bearing = np.arctan2(x[1] - RX[:n, 1], x[0] - RX[:n, 0])
        return np.append(path / SOUND_SPEED / SIGMA, bearing / sigma_bearing)

    rows = np.array([heard(TRUTH + h) - heard(TRUTH - h) for h in 1e-3 * np.eye(2)]).T / 2e-3
    rows = rows if kind == 'bearings' else rows[:n]
    if kind == 'passive':  # the emission is unknown too
        rows = np.column_stack([rows, np.ones(n)])
    return np.linalg.inv(rows.T @ rows)[:2, :2]


def distance2(fix, truth):
    gap = truth - fix.position
    return float(gap @ np.linalg.solve(fix.covariance, gap))


@pytest.mark.statistics
@pytest.mark.parametrize('kind, dof', [('active', 4), ('passive', 3), ('bearings', 10)])
def test_errors_are_what_the_covariance_and_the_bound_say(kind, dof):
    runs, n, sigma_bearing = 300, 6, np.radians(0.3)
    fixes, gaps, times = [], [], []
    for seed in range(runs):
        if kind == 'passive':
            scene = passive(n, sigma=SIGMA, seed=seed, emission=3.0)
        else:
            scene = active(n, sigma=SIGMA, seed=seed)
        if kind == 'bearings':
            noise = sigma_bearing * np.random.default_rng(10_000 + seed).standard_normal(n)
            scene['bearing'] = multistatic.bearing(TRUTH, RX[:n]) + noise
            scene['var_bearing'] = np.full(n, sigma_bearing**2)
        fix = localise(**scene, limits=Limits(min_p_value=1e-9))
        assert isinstance(fix, Localisation) and not fix.ambiguous and fix.used.all()
        fixes.append(fix)
        gaps.append(fix.position - TRUTH)
        if kind == 'passive':
            times.append((fix.emission_time - 3.0) ** 2 / fix.var_emission_time)
    bound = crlb(n, kind, sigma_bearing)
    low, high = chi2.ppf([0.025, 0.975], 2 * runs) / runs
    assert low < np.mean([distance2(fix, TRUTH) for fix in fixes]) < high
    assert low < np.mean([gap @ np.linalg.solve(bound, gap) for gap in gaps]) < high
    mean = np.mean([fix.covariance for fix in fixes], axis=0)
    assert_allclose(mean, bound, rtol=0.02, atol=1e-3 * np.trace(bound))
    assert kstest([fix.p_value for fix in fixes], 'uniform').pvalue > 0.01
    assert {fix.dof for fix in fixes} == {dof}
    assert low * dof / 2 * 0.9 < np.mean([fix.cost for fix in fixes]) < high * dof / 2 * 1.1
    assert not times or 0.8 < np.mean(times) < 1.2


def test_passive_fix_minimises_the_augmented_sum_of_squares():
    scene = passive(5, sigma=SIGMA, seed=3, emission=2.0)

    def residuals(x):
        predicted = multistatic.slant_range(x[:2], scene['rx'], Z)[0] + x[2]
        return (SOUND_SPEED * scene['toa'] - predicted) / (SOUND_SPEED * SIGMA)

    joint = least_squares(residuals, np.append(TRUTH, 3000.0), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fix = localise(**scene)
    assert_allclose(fix.position, joint.x[:2], atol=1e-4)
    assert fix.emission_time == pytest.approx(joint.x[2] / SOUND_SPEED, abs=1e-7)
    assert fix.cost == pytest.approx(2.0 * joint.cost, rel=1e-5)
    covariance = np.linalg.inv(joint.jac.T @ joint.jac)
    assert_allclose(fix.covariance, covariance[:2, :2], rtol=1e-4)
    assert fix.var_emission_time == pytest.approx(covariance[2, 2] / SOUND_SPEED**2, rel=1e-3)
    assert localise(**active(4)).emission_time is None


@pytest.mark.parametrize('make', [active, passive])
def test_fix_turns_and_moves_with_the_scene(make):
    scene, rng = make(5, sigma=SIGMA, seed=8), np.random.default_rng(1)
    first, names = localise(**scene), {'rx', 'tx', 'toa', 'var_toa'} & set(scene)
    for angle in (-3.0, -0.4, 1.2):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift, order = rng.uniform(-1e4, 1e4, 2), rng.permutation(5)
        moved = {**scene, **{name: scene[name][order] for name in names}}
        for name in {'rx', 'tx'} & names:
            moved[name][:, :2] = moved[name][:, :2] @ turn.T + shift
        second = localise(**moved)
        assert_allclose(second.position, turn @ first.position + shift, atol=1e-3)
        assert_allclose(second.covariance, turn @ first.covariance @ turn.T, atol=1e-4)


def test_two_transmitters_and_a_mixture_of_active_and_passive_rows():
    tx = np.repeat([TX, [60.0, -40.0, -1.0], np.full(3, np.nan)], (2, 2, 4), axis=0)
    toa = multistatic.range_sum(TRUTH, tx[:4], RX[:4], Z) / SOUND_SPEED
    known = {'target_z': Z}
    fix = localise(RX[:4], toa, np.full(4, SIGMA**2), tx=tx[:4], **known)
    assert_allclose(fix.position, TRUTH, atol=1e-3)
    toa = np.append(toa[:2], multistatic.slant_range(TRUTH, RX[2:6], Z)[0] / SOUND_SPEED + 0.3)
    fix = localise(RX[:6], toa, np.full(6, SIGMA**2), tx=tx[[0, 1, 4, 5, 6, 7]], **known)
    assert_allclose(fix.position, TRUTH, atol=1e-3)
    assert fix.dof == 3 and fix.emission_time == pytest.approx(0.3, abs=1e-6)
    # Bearings alone triangulate.
    bearing, nothing = multistatic.bearing(TRUTH, RX[:3]), np.full(3, np.nan)
    fix = localise(RX[:3], nothing, nothing, bearing=bearing, var_bearing=np.full(3, 1e-4))
    assert_allclose(fix.position, TRUTH, atol=1e-3)
    assert not fix.used.any() and fix.used_bearing.all() and fix.dof == 1


def crossings(tx, rx, toa):
    """Where two ellipses cross, by walking around the first: positions (k, 2)."""
    c, a = 0.5 * (tx[0] + rx[0])[:2], 0.5 * SOUND_SPEED * toa[0]
    f = 0.5 * np.hypot(*(tx[0] - rx[0])[:2])
    major = (tx[0] - rx[0])[:2] / (2.0 * f)
    angle = np.linspace(0.0, 2.0 * np.pi, 400_001)
    along, across = a * np.cos(angle), np.sqrt(a * a - f * f) * np.sin(angle)
    walk = c + along[:, None] * major + across[:, None] * np.array([-major[1], major[0]])
    miss = multistatic.range_sum(walk, tx[1:], rx[1:], Z)[:, 0] - SOUND_SPEED * toa[1]
    return walk[:-1][np.sign(miss[:-1]) != np.sign(miss[1:])]


LEVEL = np.array([1.0, 1.0, 0.0])  # Flat scenes, as the walk around the ellipse needs.
HEIGHT = np.array([0.0, 0.0, Z])


def matches(fix, expected):
    found = np.array([fix.position, *(other.position for other in fix.alternatives)])
    gaps = np.linalg.norm(found[:, None] - expected, axis=-1)
    return len(found) == len(expected) and gaps.min(axis=0).max() < 0.01


def test_two_ellipses_cross_twice_and_both_positions_are_told():
    scene = active(2, tx=TX * LEVEL + HEIGHT, rx=RX * LEVEL + HEIGHT)
    expected = crossings(scene['tx'], scene['rx'], scene['toa'])
    assert len(expected) == 2
    fix = localise(**scene)
    assert fix.ambiguous and fix.dof == 0 and fix.p_value == 1.0 and matches(fix, expected)
    refused = localise(**scene, limits=Limits(refuse_ambiguous=True))
    assert refused.reason == 'ambiguous' and len(refused.alternatives) == 2
    # Without a common focus they cross four times.
    tx = np.array([[-60.0, 0.0, Z], [0.0, -60.0, Z]])
    rx, toa = -tx * [1, 1, -1], np.full(2, 170.0 / SOUND_SPEED)
    expected = crossings(tx, rx, toa)
    fix = localise(rx, toa, np.full(2, SIGMA**2), tx=tx, target_z=Z)
    assert fix.ambiguous and len(expected) == 4 and matches(fix, expected)


@pytest.mark.parametrize('seed', range(10))
def test_truth_is_the_fix_or_one_of_its_ghosts(seed):
    rng = np.random.default_rng(seed)
    rx = np.column_stack([rng.uniform(-100, 100, (3, 2)), rng.uniform(-9, -1, 3)])
    truth = rng.uniform(-150, 150, 2)
    for scene in (active(2, truth, rx=rx), passive(3, truth, rx=rx, emission=1.0)):
        fix = localise(**scene)
        if isinstance(fix, Refusal):
            assert fix.reason == 'singular_geometry'
            continue
        found = [fix.position, *(other.position for other in fix.alternatives)]
        assert min(np.linalg.norm(found - truth, axis=-1)) < 0.05


def test_a_third_receiver_or_a_bearing_settles_it_and_a_line_leaves_left_and_right_open():
    assert not localise(**active(3, sigma=SIGMA)).ambiguous
    scene = active(2, bearing=multistatic.bearing(TRUTH, RX[:2]), var_bearing=np.full(2, 1e-3))
    fix = localise(**scene)
    assert not fix.ambiguous
    assert_allclose(fix.position, TRUTH, atol=1e-3)
    rx = np.array([[x, 0.0, Z] for x in (-60.0, -20.0, 15.0, 70.0)])
    for scene in (passive(4, rx=rx), active(4, rx=rx, tx=np.array([5.0, 0.0, Z]))):
        fix = localise(**scene)
        assert fix.ambiguous and matches(fix, np.array([TRUTH, TRUTH * [1, -1]]))


def test_target_between_transmitter_and_receivers_in_line_is_refused():
    tx, rx = np.array([0.0, 0.0, Z]), np.array([[x, 0.0, Z] for x in (100.0, 140.0, 170.0)])
    for seed in range(20):
        scene = active(3, np.array([40.0, 0.0]), tx=tx, rx=rx, sigma=SIGMA, seed=seed)
        assert localise(**scene).reason in ('singular_geometry', 'diverged')


def test_near_a_baseline_a_fix_is_refused_or_near():
    """Half a metre beside the line noise alone decides: no crossing, or two a few metres apart."""
    tx, rx = np.array([0.0, 0.0, Z]), np.array([[100.0, 0.0, Z], [30.0, 80.0, Z]])
    truth, refused, nees = np.array([45.0, 0.5]), 0, []
    for seed in range(200):
        fix = localise(**active(2, truth, tx=tx, rx=rx, sigma=SIGMA, seed=seed))
        if isinstance(fix, Refusal):
            refused += 1
            assert fix.reason in ('singular_geometry', 'diverged')
            continue
        candidates = [fix, *fix.alternatives]
        assert min(np.linalg.norm(each.position - truth) for each in candidates) < 10.0
        nees.append(min(distance2(each, truth) for each in candidates))
    assert 100 < refused < 190
    # Where range goes with the square of the distance, a 2 sigma error looks like 4 sigma.
    assert np.median(nees) < 12.0 and np.max(nees) < 64.0


def test_limits():
    far = passive(6, np.array([3000.0, 100.0]), sigma=SIGMA)
    assert localise(**far, limits=Limits(max_std=5.0)).reason == 'singular_geometry'
    assert localise(**far, limits=Limits(max_condition=10.0)).reason == 'singular_geometry'
    assert isinstance(localise(**far, limits=Limits(max_std=1000.0)), Localisation)
    beyond = active(5, np.array([900.0, 0.0]), limits=Limits(max_range=500.0))
    assert localise(**beyond).reason == 'out_of_range'
    middle = 0.5 * (RX[:, :2].mean(axis=0) + TX[:2])  # of receivers, and of a transmitter for each
    for distance, wanted in ((9999.6, Localisation), (10_000.4, Refusal)):
        scene = active(8, middle + [distance, 0.0], limits=Limits(max_std=1e9, max_condition=1e30))
        assert isinstance(localise(**scene), wanted)


@pytest.mark.parametrize(
    'make, n, late',
    [(active, 4, [2]), (active, 8, [0, 2, 5]), (passive, 6, [3]), (passive, 8, [0, 6])],
)
def test_late_reflections_are_left_out(make, n, late):
    for seed in range(8):
        scene = make(n, sigma=SIGMA, seed=seed)
        scene['toa'] = scene['toa'].copy()
        scene['toa'][late] += np.linspace(4e-3, 9e-3, len(late))
        fix = localise(**scene)
        assert_array_equal(np.flatnonzero(~fix.used), late)
        assert not fix.ambiguous and distance2(fix, TRUTH) < 25.0
        assert fix.dof == n - len(late) - (2 if make is active else 3)
        alone = localise(**{**scene, 'var_toa': np.where(fix.used, SIGMA**2, np.nan)})
        assert_allclose(fix.position, alone.position, atol=1e-4)


@pytest.mark.parametrize('seed', [56, 214, 248])
def test_the_search_starts_afresh_without_a_reflection(seed):
    """In these scenes the reflection bends the sum of squares so far that no old minimum helps."""
    rng = np.random.default_rng(seed)
    rx = np.column_stack([rng.uniform(-100, 100, (5, 2)), rng.uniform(-9, -1, 5)])
    truth = rng.uniform(-150, 150, 2)
    scene = active(5, truth, rx=rx, sigma=SIGMA, seed=seed)
    scene['toa'][0] += [0.02, 0.05, 0.1][seed % 3]
    fix = localise(**scene)
    assert_array_equal(fix.used, [False, True, True, True, True])
    assert np.linalg.norm(fix.position - truth) < 1.0


def test_a_wrong_bearing_is_left_out():
    bearing = multistatic.bearing(TRUTH, RX[:4]) + [0.0, 0.0, 0.5, 0.0]
    fix = localise(**active(4, bearing=bearing, var_bearing=np.full(4, 1e-4)))
    assert fix.used.all()
    assert_array_equal(fix.used_bearing, [True, True, False, True])


def test_poor_fit_when_nothing_is_left_to_test_with():
    scene = passive(4, sigma=SIGMA)
    scene['toa'] = scene['toa'] + [0.0, 8e-3, 0.0, 0.0]
    refusal = localise(**scene)
    assert refusal.reason == 'poor_fit' and '1 degrees of freedom' in refusal.sentence
    scene = active(6)
    scene['toa'][1] += 5e-3
    assert localise(**scene, limits=Limits(max_outliers=0)).reason == 'poor_fit'


def test_two_ways_to_leave_a_row_out_are_ambiguous():
    """Rows 0 and 1 fit two mirrored positions, row 2 only the one and row 3 only the other."""
    mirror = np.array([6.0 - TRUTH[0], TRUTH[1]])
    rx = np.vstack([[3.0, 80.0, Z], [3.0, -60.0, Z], RX[0], RX[3]])
    tx = np.tile([3.0, 10.0, Z], (4, 1))
    toa = multistatic.range_sum(TRUTH, tx, rx, Z) / SOUND_SPEED
    toa[3] = multistatic.range_sum(mirror, tx[3:], rx[3:], Z)[0] / SOUND_SPEED
    fix = localise(rx, toa, np.full(4, SIGMA**2), tx=tx, target_z=Z)
    assert fix.ambiguous and fix.dof == 1
    assert matches(fix, np.array([TRUTH, mirror]))


@pytest.mark.parametrize('scene', [active(1), passive(2), passive(1), active(0), passive(0)])
def test_too_few(scene):
    assert localise(**scene).reason == 'too_few'


def test_rows_that_are_not_measured_are_not_used():
    scene = active(6, sigma=SIGMA, seed=4)
    rows = ('rx', 'tx', 'toa', 'var_toa')
    good = localise(**{**scene, **{name: scene[name][:4] for name in rows}})
    scene['toa'][4], scene['var_toa'][5] = np.nan, 0.0
    fix = localise(**scene)
    assert_array_equal(fix.used, [True] * 4 + [False] * 2)
    assert_allclose(fix.position, good.position, atol=1e-4)
    for infinity in (np.inf, -1e300):
        scene = active(5, sigma=SIGMA, seed=4)
        scene['tx'][1, 0] = infinity
        fix = localise(**scene)
        assert_array_equal(fix.used, [True, False, True, True, True])
        assert fix.emission_time is None and distance2(fix, TRUTH) < 25.0


def test_arrays_that_do_not_fit_raise():
    wrong = {'toa': np.zeros(3), 'tx': np.zeros((3, 3)), 'bearing': np.zeros(5), 'var_toa': 1e-8}
    for name, value in (*wrong.items(), ('rx', np.zeros((4, 2))), ('rx', np.full((4, 3), np.nan))):
        with pytest.raises(ValueError, match='receiver|every arrival'):
            localise(**{**active(4), name: value})


ANY = st.floats() | st.sampled_from([0.0, 1e-320, 1e308, -1e308, 1e-9, 0.05]) | st.floats(0.0, 0.2)


@settings(max_examples=150, derandomize=True, deadline=None)
@given(st.data(), st.integers(0, 6), st.booleans())
def test_no_input_raises_or_gives_nan(data, n, tag):
    toa, var_toa, bearing, var_bearing = (
        data.draw(st.lists(ANY, min_size=n, max_size=n)) for _ in range(4)
    )
    rx, tx = data.draw(arrays(float, (2, n, 3), elements=st.floats(-1e8, 1e8)))
    tx[:1] *= 1e300
    angles = {'bearing': bearing, 'var_bearing': var_bearing}
    result = localise(rx, toa, var_toa, tx=None if tag else tx, **angles)
    if isinstance(result, Refusal):
        known = {'too_few', 'singular_geometry', 'poor_fit', 'diverged', 'out_of_range'}
        assert result.reason in known
    else:
        assert np.isfinite(result.position).all() and np.isfinite(result.cost)
        assert np.linalg.eigvalsh(result.covariance)[0] > 0.0


def test_the_distance_from_a_fix_needs_no_inverse():
    """Two rows alike: rounding has left nothing of what is known across them."""
    for scale in (1e-20, 1.0, 1e20):
        candidate = Candidate(np.zeros(2), scale * np.ones((2, 2)), 0.0)
        step = np.sqrt(scale) * np.ones(2)
        np.testing.assert_allclose(candidate.distance2(step), 1.0, rtol=1e-9)
        assert candidate.distance2(step * [1.0, -1.0]) > 1e12
    rng = np.random.default_rng(2)
    for _ in range(50):
        root, gap = rng.normal(size=(2, 2)), rng.normal(size=2)
        candidate = Candidate(np.zeros(2), root @ root.T, 0.0)
        wanted = gap @ np.linalg.inv(candidate.covariance) @ gap
        np.testing.assert_allclose(candidate.distance2(gap), wanted, rtol=1e-6)


# -- a real recording: an acoustic tag towed past 19 hydrophones, GPS in hand as truth. Times have
# a standard deviation of 0.9 ms (1.4 m): with it the chi-square of residuals is what it should be.
# The tag is towed behind the receiver, and GPS itself is metres-grade ----------------------------

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get('SONAR_IMM_DATA', ROOT / '../shared/data')) / 'yaps_ssu1'
SIGMA_TOA, RECORDED_SPEED, TAG_Z = 0.9e-3, 1545.0, -1.0
recorded = pytest.mark.skipif(
    not (DATA / 'arrivals.csv').exists(),
    reason='the recording yaps_ssu1 is not here: set SONAR_IMM_DATA to the folder that holds it',
)


def table(name):
    return np.genfromtxt(DATA / name, delimiter=',', skip_header=1)


@pytest.fixture(scope='module')
def results():
    arrivals, receivers = table('arrivals.csv'), table('receivers.csv')
    places = np.column_stack([receivers[:, 1:3], -receivers[:, 3]])
    known, found = {'target_z': TAG_Z, 'sound_speed': RECORDED_SPEED}, []
    for ping in np.unique(arrivals[:, 0]):
        _, receiver, toa = arrivals[arrivals[:, 0] == ping, :3].T
        variance = np.full(len(toa), SIGMA_TOA**2)
        found.append(localise(places[receiver.astype(int)], toa, variance, **known))
    return found


@pytest.fixture(scope='module')
def fixes(results):
    return [result for result in results if isinstance(result, Localisation)]


def gps_errors(stamps, positions, lag=0.0):
    gps = table('gps_truth.csv')
    stamps = stamps + lag
    inside = (stamps >= gps[0, 0]) & (stamps <= gps[-1, 0])
    truth = np.column_stack([np.interp(stamps, gps[:, 0], gps[:, axis]) for axis in (1, 2)])
    return np.linalg.norm(positions - truth, axis=1)[inside]


@recorded
def test_every_ping_of_four_receivers_gives_a_fix_with_residuals_as_the_noise_says(results, fixes):
    assert len(fixes) == 119
    assert {each.reason for each in results if each not in fixes} == {'too_few'}
    ratio = sum(fix.cost for fix in fixes) / sum(fix.dof for fix in fixes)
    assert 0.85 < ratio < 1.15
    assert sum((~fix.used).sum() for fix in fixes) <= 10


@recorded
def test_error_against_gps_is_as_small_as_that_of_the_reference_fixes(fixes):
    stamps = np.array([fix.emission_time for fix in fixes])
    positions = np.array([fix.position for fix in fixes])
    reference = table('fixes.csv')
    ours, theirs = gps_errors(stamps, positions), gps_errors(reference[:, 0], reference[:, 1:3])
    assert len(ours) == len(theirs) == 116
    assert np.median(ours) < 1.02 * np.median(theirs)
    assert np.sqrt(np.mean(ours**2)) < 1.02 * np.sqrt(np.mean(theirs**2))
    # The tag follows the GPS receiver some seconds later.
    assert np.sqrt(np.mean(gps_errors(stamps, positions, lag=3.4) ** 2)) < 3.0
    nearest = np.abs(stamps[:, None] - reference[:, 0]).argmin(axis=1)
    assert np.abs(stamps - reference[nearest, 0]).max() < 0.01
    assert np.median(np.linalg.norm(positions - reference[nearest, 1:3], axis=1)) < 1.0
