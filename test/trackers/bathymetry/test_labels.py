# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Labels that say when they cannot tell and lean on those of neighbouring pings; bins with two
surfaces: the likelihood, the smoother, what is marked and given."""

import itertools
import math

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
from oracles import terrain as oracle
import pytest
from scipy.ndimage import gaussian_filter1d

from sonar_imm.acoustics import layover
from sonar_imm.acoustics.variances import mean_power, signal_variance
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry import tracker as whole
from sonar_imm.trackers.bathymetry import two_surfaces as two
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.likelihood import level_geometry
from sonar_imm.trackers.bathymetry.ping import look, Ping, run, verdict
from sonar_imm.trackers.bathymetry.terrain_filter import run_terrain
from sonar_imm.trackers.bathymetry.tracker import Alone, BathymetryTracker, favour_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TERRAIN = BathymetryConfig(**EXACT)


def made(config, **changes):
    scene = simulate(scenario('paper', changes), 21)
    tracker = BathymetryTracker(config)
    return [tracker.process(item.measurement)[0] for item in scene.measurements], scene.truth


def test_smooth_is_said_only_where_rough_would_be_seen():
    rough = np.array([0.0, 0.0, 0.0, 0.05, 0.5, 0.95, 0.95])
    detectable = np.array([0.1, 0.4, np.nan, 0.3, 0.1, 0.1, np.nan])
    assert verdict(rough, rough, detectable, 0.3).tolist() == [0, 2, 2, 0, 2, 1, 1]
    assert verdict(rough, rough, detectable, 0.5).tolist() == [0, 0, 2, 0, 2, 1, 1]
    # Floor that may be either is neither.
    rough, either = np.array([0.0, 0.0, 0.95]), np.array([0.05, 0.95, 1.0])
    assert verdict(rough, either, np.full(3, 0.1), 0.3).tolist() == [0, 2, 1]


def test_the_error_of_one_snapshot_is_that_of_the_reference_ping():
    case = load_vectors('layover/labels')
    y, r = case['iq'].astype(np.float64), case['r']
    decibels = 30.0 - 20.0 * np.log(r / 17.0) / np.log(77.0 / 17.0)
    snapshot = Snapshot(
        stamp_ns=1, range=r, iq=(y[..., 0] + 1j * y[..., 1]).astype(np.complex64),
        noise_variance=np.ones(len(r)), signal_variance=10.0 ** (0.1 * decibels),
    )  # fmt: skip
    seen = look(Ping(TERRAIN, snapshot, None))
    angle = seen.swath.floor(np.zeros(len(r)), np.ones(len(r))).angle
    ratio = seen.likelihood.signal / seen.likelihood.noise
    assert seen.swath.snapshot_std(angle, ratio, 8) == pytest.approx(case['sd_h'], rel=1e-6)
    (estimate,) = BathymetryTracker(TERRAIN).process(snapshot)
    there = estimate.extras['rough'] > 0.5
    assert (there == (case['rough'] > 0.5)).mean() > 0.97  # those of a bank of six models


@pytest.mark.parametrize('model_set', ['height_two_rw', 'terrain'])
def test_told_is_never_smooth_beyond_what_is_detectable(model_set):
    (estimate,), _ = made(BathymetryConfig(model_set=model_set), pings=1)
    table = estimate.columns()
    names = 'told detectable_std label_confidence range valid'
    told, detectable, confidence, ranges, valid = (table[name] for name in names.split())
    assert told.dtype == np.uint8 and detectable.dtype == confidence.dtype == np.float32
    assert (detectable[told == 0] <= 0.3).all() and (confidence[told < 2] > 0.9).all()
    assert (told == 0).sum() > 200 and (told[ranges > 60.0] != 0).all()
    assert (told[valid == 0] == 2).all() and (valid == 0).any()
    assert detectable[ranges < 20.0].max() < 0.06 and detectable[ranges > 70.0].min() > 0.7


@pytest.mark.statistics
@pytest.mark.parametrize(
    'changes, least',
    [
        ({'patch_std': 0.3}, 0.7),
        ({'slope': 0.1}, 0.9),
        ({'undulation_height': 0.5, 'undulation_length': 15.0}, 0.6),
        ({'roughness_law': 'exponential', 'correlation_length': 1.0, 'patch_std': 0.3}, 0.5),
    ],
)
def test_roughness_is_found_on_slopes_and_undulations(changes, least):
    estimates, truth = made(TERRAIN, pings=3, **changes)
    rough = np.concatenate([each.extras['rough'] > 0.5 for each in estimates])
    told = np.concatenate([each.extras['told'] for each in estimates])
    patch = np.concatenate([each.patch for each in truth])
    assert (rough & patch).sum() / (rough | patch).sum() > least
    assert (told[~patch] == 1).mean() < 0.03 and patch[told == 1].mean() > 0.9


FLOOR = 20.0 + 0.05 * np.arange(600)


def seen_of(height, n=600):
    return BathymetryTracker(TERRAIN).process(floor(height, ranges=FLOOR[:n]))[0]


def test_a_slope_is_smooth_floor_and_scatter_is_rough():
    slope = 0.15 * (FLOOR[:300] - 20.0)
    assert (seen_of(slope, 300).extras['told'] == 0).mean() > 0.9
    stones = slope + np.random.default_rng(2).normal(0.0, 0.3, 300)
    rough = seen_of(stones, 300)
    assert (rough.extras['told'] == 1).mean() > 0.9
    error = rough.state[:, 0] - stones
    assert np.sqrt(np.mean(error**2)) < 0.1  # of the bins, not of the base
    assert (np.abs(error) < 2.0 * np.sqrt(rough.covariance[:, 0, 0])).mean() > 0.9


def test_roughness_over_metres_and_short_waves_are_told_neither_smooth_nor_rough():
    """The slopes and bends of both are alike: only floor that bends less is smooth."""
    for height, length, told in ((1.0, 13.0, 2), (0.7, 20.0, 0)):
        waves = height * np.sin(2.0 * np.pi * FLOOR / length)
        assert (seen_of(waves).extras['told'] == told).mean() > 0.9
    told, either = [], []
    for seed in range(8):
        stones = gaussian_filter1d(np.random.default_rng(seed).normal(size=600), 1.5 / 0.05)
        table = seen_of(0.5 * stones / stones.std()).columns()
        told.append(table['told'])
        either.append(table['rough'] + table['prob_winding'] > 0.5)
    assert (np.array(told) == 2).mean() > 0.9 and np.mean(either) > 0.75


RANGES = 20.0 + 0.05 * np.arange(60)
ALONE = BathymetryConfig()
COUPLED = evolve(ALONE, ping_coupling=0.35)
MODES = BathymetryConfig(
    model_set='height_two_rw', particles_per_model=50, smoothing='modes', ping_coupling=0.35
)


def ping(number, *, side='', seed=None, height=0.0, period_ns=10**8):
    stamp_ns, seed = 10**12 + number * period_ns, number if seed is None else seed
    return floor(height, ranges=RANGES, seed=seed, stamp_ns=stamp_ns, side=side)


def enumerated(initial, transition, favour):
    """Filtered and smoothed probabilities of a chain that no measurement tells about, over all its
    sequences."""
    T, M = favour.shape

    def marginals(upto):
        weight = np.zeros((upto, M))
        for path in itertools.product(range(M), repeat=upto):
            chance, come = 1.0, initial @ transition
            for t, j in enumerate(path):
                chance *= come[j] * favour[t, j]
                come = transition[j]
            weight[range(upto), path] += chance
        return weight / weight.sum(axis=1, keepdims=True)

    return np.array([marginals(t + 1)[t] for t in range(T)]), marginals(T)


@pytest.mark.parametrize('engine, close', [('gaussian', 1e-9), ('particles', 0.02)])
def test_favours_act_as_a_prior_of_each_bin(engine, close):
    """Equal walks: measurements say nothing of the model, and only chain and favours are left."""
    transition, initial, T = (0.9, 0.1, 0.3, 0.7), np.array([0.75, 0.25]), 6
    config = BathymetryConfig(
        model_set='height_two_rw', sigmas=(0.05, 0.05), transition_matrix=transition,
        initial_probabilities=initial, engine=engine, particles_per_model=20_000,
        gate_false_alarm=1.0,
    )  # fmt: skip
    snapshot = floor(0.0, ranges=RANGES[:T])
    favour = np.random.default_rng(1).uniform(0.2, 1.8, size=(T, 2))
    filtered, smoothed = enumerated(initial, np.reshape(transition, (2, 2)), favour)
    seen = look(Ping(config, snapshot, None))
    assert run(seen, favour).probability == pytest.approx(filtered, abs=close)
    if engine == 'gaussian':  # both ways, as `terrain` does
        models, peak = evolve(seen.models, favour=favour), seen.swath.height_from(seen.loudest)
        found = run_terrain(models, seen.likelihood, peak, smooth=True)
    else:
        found = run(look(Ping(evolve(config, smoothing='modes'), snapshot, None)), favour)
    assert found.probability == pytest.approx(smoothed, abs=close)
    assert np.abs(run(seen).probability - filtered).max() > 0.05


def alone(snapshot, rough):
    """A ping by itself that is as rough (T,), or a number, as told."""
    seen = look(Ping(COUPLED, snapshot, None))
    made, counts = Alone.of(seen, run(seen)), seen.models.rough
    rough = np.broadcast_to(rough, len(snapshot))[:, None]
    probability = np.where(counts, rough / counts.sum(), (1.0 - rough) / (~counts).sum())
    return Alone.of(seen, made.track._replace(probability=probability))


def test_the_field_is_that_of_the_two_neighbours():
    J = 0.35
    of = [alone(ping(k, seed=1), p) for k, p in enumerate((0.9, 0.5, 0.2, 0.5))]
    field = sum(
        math.log((p + (1 - p) * math.exp(-J)) / ((1 - p) + p * math.exp(-J))) for p in (0.9, 0.2)
    )
    favour, rough = favour_of(of[1], [of[0], of[2]], J), of[1].seen.models.rough
    for each, sign in ((rough, -1.0), (~rough, 1.0)):
        assert favour[:, each] == pytest.approx(2.0 / (1.0 + math.exp(sign * field)))
    assert favour_of(of[1], [of[3]], J) == pytest.approx(np.ones(favour.shape))  # undecided


def test_neighbours_are_compared_at_the_same_place_across_the_track():
    """The neighbour's bins are twice as far apart: rough from 21 m on, whatever the bin."""
    wide = floor(0.0, ranges=20.0 + 0.1 * np.arange(30), seed=1)
    rough, between = alone(wide, wide.range >= 21.0), alone(ping(1), 0.5)
    one = int(np.argmax(between.seen.models.rough))
    favour = favour_of(between, [rough], 0.35)
    inner, outer = (RANGES > 20.2) & (RANGES < 20.8), (RANGES > 21.2) & (RANGES < 22.8)
    assert (favour[inner, one] < 1.0).all() and (favour[outer, one] > 1.0).all()
    # Where the neighbour ends it has no opinion.
    short = alone(floor(0.0, ranges=RANGES[:20], seed=1), 1.0)
    favour = favour_of(between, [short], 0.35)
    assert favour[30:] == pytest.approx(np.ones(favour[30:].shape)) and favour[5, one] > 1.1


def heard(pings, config=COUPLED):
    """The tracker, what comes of each ping, all estimates."""
    tracker = BathymetryTracker(config)
    made = [tracker.process(each) for each in pings]
    return tracker, made, [*sum(made, []), *tracker.finish()]


@pytest.mark.parametrize('config', [COUPLED, MODES], ids=['states', 'modes'])
def test_estimates_come_one_ping_late_and_none_is_lost(config):
    pings = [ping(k) for k in range(4)]
    tracker, made, every = heard(pings, config)
    assert [len(each) for each in made] == [0, 1, 1, 1]
    assert [each.stamp_ns for each in every] == [each.stamp_ns for each in pings]
    assert tracker.finish() == [] and 'pings_held' not in tracker.health()
    assert tracker.counts['used'] == 4


def test_an_estimate_depends_on_its_neighbours_alone():
    first, second, third = (
        heard([ping(k, seed=seed) for k, seed in enumerate(seeds)])[2][2]
        for seeds in ((1, 2, 3, 4, 5), (9, 2, 3, 4, 9), (1, 2, 3, 9, 5))
    )
    assert same(first, second) and not same(first, third)


def test_pings_far_apart_and_other_sides_are_no_neighbours():
    far = {'period_ns': whole.NEIGHBOURS_NS + 1}
    rows = (0, 'port', 0), (0, 'starboard', 7), (1, 'port', 1), (1, 'starboard', 8)
    pings = [ping(number, side=side, seed=seed, **far) for number, side, seed in rows]
    assert all(map(same, heard(pings)[2], heard(pings, ALONE)[2]))


def test_switched_off_the_held_ping_comes_out_first():
    tracker = BathymetryTracker(COUPLED)
    assert tracker.process(ping(0)) == [] and tracker.health()['pings_held'] == 1
    tracker.reconfigure(ALONE)
    made = tracker.process(ping(1))
    assert [each.stamp_ns for each in made] == [ping(k).stamp_ns for k in range(2)]


def test_a_bin_in_doubt_goes_with_its_neighbours():
    """A patch that two pings see clearly and the one between hardly."""
    patch, rng = (np.arange(60) >= 20) & (np.arange(60) < 40), np.random.default_rng(3)
    pings = [
        ping(k, height=patch * std * rng.normal(size=60))
        for k, std in enumerate((0.5, 0.045, 0.5))
    ]
    plain, coupled = (
        heard(pings, config)[2][1].extras['rough']
        for config in (ALONE, evolve(COUPLED, ping_coupling=1.0))
    )
    gain = coupled - plain
    assert gain[patch].mean() > 0.05 and gain[patch].min() > -1e-9
    assert gain[~patch].max() < gain[patch].max()


SETS = ['terrain', 'height_rw_ncs', 'angle_two_rw', 'height_two_rw']
OF_GATED, NEW = ['existence_2', 'surfaces'], ['height_2', 'height_2_std']


def step(at=slice(150, 200), up=2.0, **more):
    """A flat floor on which bins `at` have a second surface `up` metres above it."""
    snapshot, above = floor(0.0, seed=1, **more), floor(up, seed=2, **more)
    iq = snapshot.iq.copy()
    iq[at] += above.iq[at]
    return evolve(snapshot, iq=iq)


def made_of(snapshot, layover='resolved', **values):
    tracker = BathymetryTracker(BathymetryConfig(layover=layover, **values))
    return tracker, tracker.process(snapshot)[0]


def looked(snapshot, **values):
    """The samples, the likelihood, the geometry of a ping, and what is known of its layover."""
    seen = look(Ping(BathymetryConfig(layover='resolved', **values), snapshot, None))
    return seen.ping.snapshot.iq, seen.likelihood, seen.swath.geometry, seen.layover


def bins(n, P, rng):
    """Bins (n, P) with an echo or two, and noise."""
    waves = rng.normal(size=(n, 2, 2)).view(complex) * 4.0
    sines = rng.uniform(-0.3, 0.3, (n, 2, 1))
    y = (waves * np.exp(1j * math.pi * sines * np.arange(P))).sum(axis=1)
    return y + rng.normal(size=(n, P, 2)).view(complex)[..., 0]


@pytest.mark.parametrize('P, spacing', [(4, 0.5), (8, 0.5), (8, -0.5), (5, 3.66)])
def test_likelihoods_are_those_of_normal_echoes_in_noise(P, spacing):
    rng = np.random.default_rng(P)
    G, gap, v = 14, 3, 17.0
    sines = np.sort(rng.uniform(-0.4, 0.2, G))
    sines[5] = np.nan
    y, states = bins(1, P, rng)[0], oracle.states_of(G, gap)
    single, packed = np.empty(G), np.empty(len(states) - G, np.float32)
    work, squares = np.empty((11, G)), np.empty((2, G, G))
    scratch = work, work.view(np.int64), *squares
    two.pair_likelihoods(y, v, sines, spacing, gap, *scratch, single, packed)
    logs = np.array([
        -np.inf if 5 in state else oracle.log_likelihood(y, v, sines[list(state)], spacing)
        for state in states
    ])  # fmt: skip
    found, wanted = np.concatenate([single, packed]), np.exp(logs - logs.max())
    np.testing.assert_allclose(found / found.max(), wanted, rtol=2e-7, atol=1e-30)


def test_the_smoother_is_that_of_one_matrix_over_all_heights_and_pairs():
    rng = np.random.default_rng(4)
    n, P, G, first = 5, 6, 15, 2
    moves = two.Moves(0.02, 0.1, 0.03, *(two._taps(w) for w in (two.WALK, two.WALK_OF_TWO)), 3)
    moves = moves._replace(walk_of_two=moves.walk_of_two.astype(np.float32))
    cells = -0.4 + two.STEP * np.arange(G)
    ranges = 20.0 + 0.5 * np.arange(n + first)
    geometry = level_geometry(ranges, 15.0, math.radians(30.0), 0.5)
    y, v, usable = bins(n, P, rng), rng.uniform(2.0, 9.0, n), np.ones(n, bool)
    y[1:4] *= 0.5
    usable[3] = False
    start = rng.dirichlet(np.ones(G))
    seen = two._sines(cells, geometry, slice(first, first + n))
    existence, height, variance = two.smooth_stretch(start, cells, y, v, usable, seen, 0.5, moves)

    states, reach = oracle.states_of(G, 3), len(moves.walk) - 1
    single, pair = (oracle.walk(G, w, two.STEP, reach) for w in (two.WALK, two.WALK_OF_TWO))
    step_matrix = oracle.transition(states, single, pair, 0.02, 0.1, 0.03, G)
    weights = np.zeros((n, len(states)))
    for t in np.flatnonzero(usable):
        sines = np.sin(np.arcsin((15.0 - cells) / ranges[first + t]) - math.radians(30.0))
        weights[t] = [oracle.log_likelihood(y[t], v[t], sines[list(s)], 0.5) for s in states]
    begin = np.concatenate([start, np.zeros(len(states) - G)])
    p = oracle.smooth(begin, step_matrix, weights)
    assert existence == pytest.approx(p[:, G:].sum(axis=1), abs=1e-5)
    assert 0.01 < existence.max() and existence[0] == 0.0
    place = cells[np.array(states[G:])]
    for t in range(1, n):
        share = p[t, G:] / p[t, G:].sum()
        mean = share @ place
        assert height[t] == pytest.approx(mean, abs=1e-4)
        assert variance[t] == pytest.approx(share @ (place - mean) ** 2, abs=1e-4)


def test_existence_and_heights_of_the_prototype(monkeypatch):
    # Its stretches begin where the chain says so, and nowhere else.
    monkeypatch.setattr(two, 'BRIGHTER', 1e9)
    known = load_vectors('layover/pings')
    parts, noise, off = known['iq'].astype(np.float32), np.ones(1200), []
    for iq, chain, exists, heights in zip(
        parts[..., 0] + 1j * parts[..., 1],
        *(known[name] for name in ('existence_chain', 'existence_2', 'heights')),
    ):
        signal = signal_variance(mean_power(iq), noise)
        ping = floor(0.0, ranges=known['r'], noise_variance=noise, signal_variance=signal)
        *seen, second = looked(evolve(ping, iq=iq), gate_false_alarm=1.0)
        second = second._replace(existence=chain.astype(float))
        found = two.resolve(*seen, second, np.zeros(1200))
        assert (np.abs(found.existence - exists) < 0.1).mean() >= 0.98
        off.append(np.abs(found.height - heights)[exists >= 0.5])
        assert (np.isfinite(found.height[:, 0]) == np.isfinite(heights[:, 0])).mean() > 0.999
    off = np.concatenate(off)
    assert np.median(off, axis=0) == pytest.approx(0.0, abs=0.08)
    assert np.quantile(off, 0.9) < 0.25


@pytest.mark.parametrize('model_set', SETS)
def test_both_heights_of_a_step(model_set):
    snapshot, values = step(), {'model_set': model_set}
    tracker, resolved = made_of(snapshot, **values)
    a, b = resolved.columns(), made_of(snapshot, 'gated', **values)[1].columns()
    assert [name for name in a if name not in b] == NEW
    assert a['height_2'].dtype == a['height_2_std'].dtype == np.float32
    double = a['surfaces'] == 2
    single = ~double
    assert double[152:198].mean() > 0.95
    assert not double[:145].any() and not double[205:].any()
    assert tracker.counts['bins_two'] == double.sum()
    for name, true in (('height', 0.0), ('height_2', 2.0)):
        assert np.sqrt(np.mean(np.square(a[name][double] - true))) < 0.25
    std = a['height_2_std'][double]
    assert np.mean(np.abs(a['height_2'][double] - 2.0) < 2.0 * std) > 0.9 and std.max() < 1.0
    assert np.isnan([a['height_2'][single], a['height_2_std'][single]]).all()
    # The lower height is the state, with its variance, and the place is its own.
    np.testing.assert_allclose(resolved.xyz[:, 2], a['height'] - 15.0, atol=1e-5)
    # Bins that one wave does not explain are no longer silent.
    assert ((made_of(snapshot, 'ignored', **values)[1].extras['valid'] == 0) & double).sum() > 3
    for name in b.keys() - {'existence_2', 'surfaces', 'valid', 'told'}:  # told: 2 where gated
        np.testing.assert_array_equal(a[name][single], b[name][single])
    doubt = (a['existence_2'] > 0.3) & (a['existence_2'] < 0.5)
    np.testing.assert_array_equal(a['valid'] == 0, doubt | (a['surfaces'] == 0))
    assert (np.linalg.eigvalsh(resolved.covariance) > 0.0).all()
    if model_set == 'angle_two_rw':  # an angle has the height of the lower surface
        down = resolved.state[:, 0] + math.radians(30.0)
        np.testing.assert_allclose(15.0 - a['range'] * np.sin(down), a['height'], atol=1e-9)
        std = np.sqrt(resolved.covariance[:, 0, 0]) * a['range'] * np.cos(down)
        assert ((0.03 < std) & (std < 1.0))[double].all()


def test_a_flat_floor_is_as_without():
    """And what echoes of the surface explain is no layover."""
    resolved, gated = (made_of(floor(0.0), value)[1].columns() for value in ('resolved', 'gated'))
    for name, column in gated.items():
        np.testing.assert_array_equal(resolved[name], column)
    assert (resolved['surfaces'] < 2).all()
    assert not {*OF_GATED, *NEW} & set(made_of(floor(0.0), multipath=True)[1].extras)


def test_a_burst_of_noise_is_no_pair():
    rng, iq = np.random.default_rng(8), floor(0.0).iq.copy()
    bursts = rng.uniform(size=len(iq)) < 0.1
    iq[bursts] = 300.0 * rng.normal(size=(bursts.sum(), 8, 2)).view(complex)[..., 0]
    surfaces = made_of(evolve(floor(0.0), iq=iq))[1].extras['surfaces']
    assert (surfaces[bursts] == 0).mean() > 0.8 and (surfaces == 2).mean() < 0.02


def test_few_staves_are_gated_and_it_is_said():
    made, said = [], []
    for staves, value in ((3, 'resolved'), (3, 'gated'), (4, 'resolved')):
        tracker, estimate = made_of(step(P=staves), value)
        made.append(estimate)
        said.append(any('four staves' in sentence for sentence in tracker.warnings()))
    assert list(made[0].columns()) == list(made[1].columns()) and said == [True, False, False]
    np.testing.assert_array_equal(made[0].extras['valid'], made[1].extras['valid'])


@pytest.mark.parametrize('height', [0.0, -30.0])
def test_heights_out_of_reach_are_no_trouble(height):
    """The first ranges end above the floor, and nothing of the second grid can be reached."""
    ranges = 14.0 + 0.02 * np.arange(120)
    snapshot = evolve(floor(0.0, ranges=ranges + 1.1), range=ranges)
    *seen, _ = looked(snapshot, gate_false_alarm=1.0)
    everywhere = layover.Layover(np.ones(120), 0.0, np.ones(120, bool))
    found = two.resolve(*seen, everywhere, np.full(120, height))
    assert ((found.existence >= 0.0) & (found.existence <= 1.0)).all()
    assert np.isfinite(found.height[1:]).all()


def test_stretches_have_a_margin_and_are_cut_where_they_are_long():
    existence = np.zeros(10_000)
    existence[[100, 115, 400]] = 1.0
    existence[2000:9000] = 0.06
    cut = [(90, 126), (390, 411), (1990, 5990), (5990, 9010)]
    assert two.stretches(existence > two.POSSIBLE) == cut
    assert two.stretches(np.zeros(50, bool)) == []
    assert two.stretches(np.ones(5, bool)) == [(0, 5)]


def test_a_bright_face_begins_a_stretch_where_the_chain_says_nothing(monkeypatch):
    snapshot, face = floor(0.0, seed=1, snr_db=8.0), floor(3.0, seed=2, snr_db=16.0)
    at, iq = slice(150, 162), snapshot.iq.copy()
    iq[at] += face.iq[at]
    *seen, second = looked(evolve(snapshot, iq=iq))
    given = *seen, second._replace(existence=np.zeros(300)), np.zeros(300)
    double = two.resolve(*given).existence >= two.EXISTS
    assert double[at].mean() > 0.7
    assert not double[:145].any() and not double[167:].any()
    monkeypatch.setattr(two, 'BRIGHTER', 1e9)
    assert not two.resolve(*given).existence.any()


def test_an_even_floor_has_no_bright_bins():
    iq, *_, second = looked(floor(0.0))
    quiet = second._replace(existence=np.zeros(300))
    assert two.possible_bins(iq, quiet).mean() < 0.02
    short = quiet._replace(existence=np.zeros(8), usable=np.ones(8, bool))
    assert not two.possible_bins(np.ones((8, 8)), short).any()


@pytest.mark.parametrize('factor, top', [(1.0, 4.5), (2.0, 7.5)])
def test_the_grid_holds_both_ends_of_a_stretch(factor, top):
    ledge = np.concatenate([np.zeros(60), np.full(60, 3.0)])
    assert two._cells(factor * ledge, 50, 70)[[0, -1]] == pytest.approx([-1.5, top])
    assert len(two._cells(20.0 * ledge, 50, 70)) == two.MOST_CELLS


@pytest.mark.parametrize('value', ['gated', 'resolved'])
def test_warm_compiles_what_two_surfaces_need(value):
    tracker = BathymetryTracker(BathymetryConfig(layover=value))
    tracker.warm({Snapshot})
    compiled = two.pair_likelihoods, two.step_orders, two.weigh_orders
    before = [list(each.signatures) for each in compiled]
    assert all(before)
    made_of(step())
    assert [each.signatures for each in compiled] == before


@pytest.mark.parametrize('staves, values', [(8, {}), (8, {'model_set': 'height_two_rw'}), (3, {})])
def test_a_gated_bin_is_marked_and_nothing_else_changes(staves, values):
    snapshot = step(P=staves)
    tracker, gated = made_of(snapshot, 'gated', **values)
    ignored_by, ignored = made_of(snapshot, 'ignored', **values)
    a, b = gated.columns(), ignored.columns()
    assert [name for name in a if name not in b] == OF_GATED
    double = a['surfaces'] == 2
    changed = {'valid': b['valid'] & ~double, 'told': np.where(double, 2, b['told'])}
    for name, column in {**b, **changed}.items():
        np.testing.assert_array_equal(a[name], column)
    outside = np.delete(double, slice(145, 205)).mean()
    assert double[150:200].mean() > (0.95 if staves == 8 else 0.5)
    assert outside == 0.0 if staves == 8 else outside < 0.1
    np.testing.assert_array_equal(a['surfaces'] == 0, (b['valid'] == 0) & ~double)
    np.testing.assert_array_equal(double, a['existence_2'] > np.float32(layover.GATE))
    assert a['existence_2'].dtype == np.float32 and a['surfaces'].dtype == np.uint8
    assert tracker.counts['bins_two'] == double.sum() > 0
    assert 'bins_two' not in ignored_by.counts and 'array_error' not in ignored_by.health()
    assert tracker.health()['array_error'] >= layover.LEAST_ERROR


@pytest.mark.parametrize('value', ['gated', 'resolved'])
def test_silent_bins_have_no_second_surface(value):
    _, made = made_of(step(shadow=slice(150, 200), at=slice(0, 0)), value)
    silent = made.extras['surfaces'] == 0
    assert silent[150:200].mean() > 0.9
    assert (made.extras['existence_2'][silent] == 0.0).all()


@pytest.mark.parametrize('staves', [2, 3, 4])
def test_a_flat_floor_has_one_surface_whatever_the_staves(staves):
    tracker, made = made_of(floor(0.0, P=staves), 'gated')
    assert tracker.counts['bins_two'] <= 2 and 'surfaces' in made.extras


def test_a_wrong_array_is_warned_of():
    rng = np.random.default_rng(1)
    snapshot = floor(0.0, snr_db=35.0)
    off = np.exp(1j * np.radians(rng.normal(0.0, 12.0, 8)))
    assert not made_of(snapshot, 'gated')[0].warnings()
    wrong = evolve(snapshot, iq=snapshot.iq * off)
    assert made_of(wrong, 'gated')[0].health()['array_error'] < 0.002
    tracker, made = made_of(wrong, 'gated', calibrate_array=False)
    assert any('plane wave' in sentence for sentence in tracker.warnings())
    assert tracker.health()['array_error'] > 0.01
    assert (made.extras['surfaces'] == 2).mean() < 0.05
