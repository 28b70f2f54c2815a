# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bins with two surfaces: the likelihood, the smoother, what is marked and given."""

import math

from attrs import evolve
from helpers.bathymetry_cases import floor
from helpers.vector_files import load_vectors
import numpy as np
from oracles import two_surfaces as oracle
import pytest

from sonar_imm.acoustics import layover
from sonar_imm.acoustics.variances import mean_power, signal_variance
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry import two_surfaces as two
from sonar_imm.trackers.bathymetry.likelihood import level_geometry
from sonar_imm.trackers.bathymetry.ping import look, Ping
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

OF_GATED, NEW = ['existence_2', 'surfaces'], ['height_2', 'height_2_std']


def step(at=slice(150, 200), up=2.0, **more):
    """A flat floor on which bins `at` have a second surface `up` metres above it."""
    snapshot, above = floor(0.0, seed=1, **more), floor(up, seed=2, **more)
    iq = snapshot.iq.copy()
    iq[at] += above.iq[at]
    return evolve(snapshot, iq=iq)


def run(snapshot, layover='resolved', **values):
    tracker = BathymetryTracker(BathymetryConfig(layover=layover, **values))
    return tracker, tracker.process(snapshot)[0]


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
    y = bins(1, P, rng)[0]
    states = oracle.states_of(G, gap)
    single, packed = np.empty(G), np.empty(len(states) - G, np.float32)
    work, squares = np.empty((11, G)), np.empty((2, G, G))
    scratch = work, work.view(np.int64), *squares
    two.pair_likelihoods(y, v, sines, spacing, gap, *scratch, single, packed)
    wanted = np.array(
        [
            -np.inf if 5 in state else oracle.log_likelihood(y, v, sines[list(state)], spacing)
            for state in states
        ]
    )
    found = np.concatenate([single, packed])
    wanted = np.exp(wanted - wanted.max())
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

    states = oracle.states_of(G, 3)
    reach = len(moves.walk) - 1
    single, pair = (oracle.walk(G, w, two.STEP, reach) for w in (two.WALK, two.WALK_OF_TWO))
    step_matrix = oracle.transition(states, single, pair, 0.02, 0.1, 0.03, G)
    weights = np.zeros((n, len(states)))
    for t in np.flatnonzero(usable):
        depth = (15.0 - cells) / ranges[first + t]
        sines = np.sin(np.arcsin(depth) - math.radians(30.0))
        weights[t] = [oracle.log_likelihood(y[t], v[t], sines[list(s)], 0.5) for s in states]
    begin = np.concatenate([start, np.zeros(len(states) - G)])
    p = oracle.smooth(begin, step_matrix, weights)
    assert existence == pytest.approx(p[:, G:].sum(axis=1), abs=1e-5)
    assert 0.01 < existence.max() and existence[0] == 0.0
    for side in (0, 1):
        place = np.array([cells[s[side]] for s in states[G:]])
        for t in range(1, n):
            share = p[t, G:] / p[t, G:].sum()
            mean = share @ place
            assert height[t, side] == pytest.approx(mean, abs=1e-4)
            assert variance[t, side] == pytest.approx(share @ (place - mean) ** 2, abs=1e-4)


def test_existence_and_heights_of_the_prototype(monkeypatch):
    # Its stretches begin where the chain says so, and nowhere else.
    monkeypatch.setattr(two, 'BRIGHTER', 1e9)
    known = load_vectors('layover/pings')
    parts = known['iq'].astype(np.float32)
    iq = parts[..., 0] + 1j * parts[..., 1]
    config = BathymetryConfig(layover='resolved', gate_false_alarm=1.0)
    off, inside = [], []
    for k, chain in enumerate(known['existence_chain']):
        noise = np.ones(1200)
        snapshot = evolve(
            floor(0.0, ranges=known['r']),
            iq=iq[k].astype(np.complex64),
            noise_variance=noise,
            signal_variance=signal_variance(mean_power(iq[k]), noise),
        )
        seen = look(Ping(config, snapshot, None))
        second = seen.layover._replace(existence=chain.astype(float))
        geometry = seen.swath.geometry
        found = two.resolve(snapshot.iq, seen.likelihood, geometry, second, np.zeros(1200))
        assert (np.abs(found.existence - known['existence_2'][k]) < 0.1).mean() >= 0.98
        there = known['existence_2'][k] >= 0.5
        off.append((found.height - known['heights'][k])[there])
        inside.append(np.isfinite(found.height[:, 0]) == np.isfinite(known['heights'][k][:, 0]))
    assert np.mean(inside) > 0.999
    assert np.median(np.abs(np.concatenate(off)), axis=0) == pytest.approx(0.0, abs=0.08)
    assert np.quantile(np.abs(np.concatenate(off)), 0.9) < 0.25


SETS = ['terrain', 'height_rw_ncs', 'angle_two_rw', 'height_two_rw']


@pytest.mark.parametrize('model_set', SETS)
def test_both_heights_of_a_step(model_set):
    values = {'model_set': model_set}
    snapshot = step()
    tracker, resolved = run(snapshot, **values)
    _, gated = run(snapshot, 'gated', **values)
    a, b = resolved.columns(), gated.columns()
    assert [name for name in a if name not in b] == NEW
    assert a['height_2'].dtype == a['height_2_std'].dtype == np.float32
    double = a['surfaces'] == 2
    assert double[152:198].mean() > 0.95
    assert not double[:145].any() and not double[205:].any()
    assert tracker.counts['bins_two'] == double.sum()
    for name, true in (('height', 0.0), ('height_2', 2.0)):
        error = a[name][double] - true
        assert np.sqrt(np.mean(np.square(error))) < 0.25
    std = a['height_2_std'][double]
    assert np.mean(np.abs(a['height_2'][double] - 2.0) < 2.0 * std) > 0.9 and std.max() < 1.0
    assert np.isnan(a['height_2'][~double]).all() and np.isnan(a['height_2_std'][~double]).all()
    # The lower height is the state, with its variance, and the place is its own.
    np.testing.assert_allclose(resolved.xyz[:, 2], a['height'] - 15.0, atol=1e-5)
    # Bins that one wave does not explain are no longer silent.
    assert ((run(snapshot, 'ignored', **values)[1].extras['valid'] == 0) & double).sum() > 3
    single = ~double
    for name in b:
        if name not in ('existence_2', 'surfaces', 'valid', 'told'):  # told: 2 where gated
            np.testing.assert_array_equal(a[name][single], b[name][single])
    doubt = (a['existence_2'] > 0.3) & (a['existence_2'] < 0.5)
    np.testing.assert_array_equal(a['valid'] == 0, doubt | (a['surfaces'] == 0))
    assert (np.linalg.eigvalsh(resolved.covariance) > 0.0).all()


def test_an_angle_has_the_height_of_the_lower_surface():
    resolved = run(step(), model_set='angle_two_rw')[1]
    double = resolved.extras['surfaces'] == 2
    down = resolved.state[:, 0] + math.radians(30.0)
    height = 15.0 - resolved.extras['range'] * np.sin(down)
    np.testing.assert_allclose(height, resolved.extras['height'], atol=1e-9)
    std = np.sqrt(resolved.covariance[:, 0, 0]) * resolved.extras['range'] * np.cos(down)
    assert ((0.03 < std) & (std < 1.0))[double].all()


def test_a_flat_floor_is_as_without():
    snapshot = floor(0.0)
    resolved, gated = (run(snapshot, value)[1] for value in ('resolved', 'gated'))
    for name, column in gated.columns().items():
        np.testing.assert_array_equal(resolved.columns()[name], column)
    assert (resolved.extras['surfaces'] < 2).all()


def test_a_burst_of_noise_is_no_pair():
    snapshot = floor(0.0)
    rng = np.random.default_rng(8)
    iq = snapshot.iq.copy()
    bursts = rng.uniform(size=len(iq)) < 0.1
    iq[bursts] = 300.0 * rng.normal(size=(bursts.sum(), 8, 2)).view(complex)[..., 0]
    made = run(evolve(snapshot, iq=iq))[1]
    assert (made.extras['surfaces'][bursts] == 0).mean() > 0.8
    assert (made.extras['surfaces'] == 2).mean() < 0.02


def test_few_staves_are_gated_and_it_is_said():
    tracker, made = run(step(P=3))
    gated_by, gated = run(step(P=3), 'gated')
    assert list(made.columns()) == list(gated.columns())
    np.testing.assert_array_equal(made.extras['valid'], gated.extras['valid'])
    assert any('four staves' in sentence for sentence in tracker.warnings())
    assert not any('four staves' in sentence for sentence in gated_by.warnings())
    assert not any('four staves' in sentence for sentence in run(step(P=4))[0].warnings())


def test_heights_out_of_reach_are_no_trouble():
    ranges = 14.0 + 0.02 * np.arange(120)  # the first ones end above the floor
    snapshot = floor(0.0, ranges=ranges + 1.1)
    snapshot = evolve(snapshot, range=ranges)
    config = BathymetryConfig(layover='resolved', gate_false_alarm=1.0)
    seen = look(Ping(config, snapshot, None))
    everywhere = layover.Layover(np.ones(120), 0.0, np.ones(120, bool))
    geometry = seen.swath.geometry
    for level in (0.0, -30.0):  # the second one: nothing of the grid can be reached
        found = two.resolve(
            snapshot.iq, seen.likelihood, geometry, everywhere, np.full(120, level)
        )
        assert np.isfinite(found.existence).all()
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
    config = BathymetryConfig(layover='resolved')
    seen = look(Ping(config, evolve(snapshot, iq=iq), None))
    silent = seen.layover._replace(existence=np.zeros(len(iq)))
    arguments = iq, seen.likelihood, seen.swath.geometry, silent, np.zeros(len(iq))
    double = two.resolve(*arguments).existence >= two.EXISTS
    assert double[at].mean() > 0.7
    assert not double[:145].any() and not double[167:].any()
    monkeypatch.setattr(two, 'BRIGHTER', 1e9)
    assert not two.resolve(*arguments).existence.any()


def test_an_even_floor_has_no_bright_bins():
    seen = look(Ping(BathymetryConfig(layover='resolved'), floor(0.0), None))
    quiet = seen.layover._replace(existence=np.zeros(len(seen.likelihood.echo)))
    assert two.possible_bins(seen.ping.snapshot.iq, quiet).mean() < 0.02
    short = quiet._replace(existence=np.zeros(8), usable=np.ones(8, bool))
    assert not two.possible_bins(np.ones((8, 8)), short).any()


def test_the_grid_holds_both_ends_of_a_stretch():
    ledge = np.concatenate([np.zeros(60), np.full(60, 3.0)])
    cells = two._cells(ledge, 50, 70)
    assert cells[0] == pytest.approx(-1.5) and cells[-1] == pytest.approx(4.5)
    high = two._cells(2.0 * ledge, 50, 70)
    assert high[0] == pytest.approx(-1.5) and high[-1] == pytest.approx(7.5)
    assert len(two._cells(20.0 * ledge, 50, 70)) == two.MOST_CELLS


@pytest.mark.parametrize('value', ['gated', 'resolved'])
def test_warm_compiles_what_two_surfaces_need(value):
    tracker = BathymetryTracker(BathymetryConfig(layover=value))
    tracker.warm({Snapshot})
    compiled = two.pair_likelihoods, two.step_orders, two.weigh_orders
    before = [list(each.signatures) for each in compiled]
    assert all(before)
    run(step())
    assert [each.signatures for each in compiled] == before


def test_surface_echoes_leave_layover_alone():
    assert not {*OF_GATED, *NEW} & set(run(floor(0.0), multipath=True)[1].extras)


@pytest.mark.parametrize('staves, values', [(8, {}), (8, {'model_set': 'height_two_rw'}), (3, {})])
def test_a_gated_bin_is_marked_and_nothing_else_changes(staves, values):
    snapshot = step(P=staves)
    tracker, gated = run(snapshot, 'gated', **values)
    ignored_by, ignored = run(snapshot, 'ignored', **values)
    a, b = gated.columns(), ignored.columns()
    assert [name for name in a if name not in b] == OF_GATED
    for name in b:
        if name not in ('valid', 'told'):
            np.testing.assert_array_equal(a[name], b[name])
    double = a['surfaces'] == 2
    outside = np.delete(double, slice(145, 205)).mean()
    assert double[150:200].mean() > (0.95 if staves == 8 else 0.5)
    assert outside == 0.0 if staves == 8 else outside < 0.1
    np.testing.assert_array_equal(a['valid'], b['valid'] & ~double)
    np.testing.assert_array_equal(a['told'], np.where(double, 2, b['told']))
    np.testing.assert_array_equal(a['surfaces'] == 0, (b['valid'] == 0) & ~double)
    np.testing.assert_array_equal(double, a['existence_2'] > np.float32(layover.GATE))
    assert a['existence_2'].dtype == np.float32 and a['surfaces'].dtype == np.uint8
    assert tracker.counts['bins_two'] == double.sum() > 0
    assert 'bins_two' not in ignored_by.counts and 'array_error' not in ignored_by.health()
    assert tracker.health()['array_error'] >= layover.LEAST_ERROR


@pytest.mark.parametrize('value', ['gated', 'resolved'])
def test_silent_bins_have_no_second_surface(value):
    _, made = run(step(shadow=slice(150, 200), at=slice(0, 0)), value)
    silent = made.extras['surfaces'] == 0
    assert silent[150:200].mean() > 0.9
    assert (made.extras['existence_2'][silent] == 0.0).all()


@pytest.mark.parametrize('staves', [2, 3, 4])
def test_a_flat_floor_has_one_surface_whatever_the_staves(staves):
    tracker, made = run(floor(0.0, P=staves), 'gated')
    assert tracker.counts['bins_two'] <= 2 and 'surfaces' in made.extras


def test_a_wrong_array_is_warned_of():
    rng = np.random.default_rng(1)
    snapshot = floor(0.0, snr_db=35.0)
    off = np.exp(1j * np.radians(rng.normal(0.0, 12.0, 8)))
    assert not run(snapshot, 'gated')[0].warnings()
    wrong = evolve(snapshot, iq=snapshot.iq * off)
    assert run(wrong, 'gated')[0].health()['array_error'] < 0.002
    tracker, made = run(wrong, 'gated', calibrate_array=False)
    assert any('plane wave' in sentence for sentence in tracker.warnings())
    assert tracker.health()['array_error'] > 0.01
    assert (made.extras['surfaces'] == 2).mean() < 0.05
