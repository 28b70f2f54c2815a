# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Labels that say when they cannot tell, and that lean on those of neighbouring pings."""

import itertools
import math

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.ping import look, Ping, run, verdict
from sonar_imm.trackers.bathymetry.terrain_filter import run_terrain
from sonar_imm.trackers.bathymetry.tracker import (
    Alone,
    BathymetryConfig,
    BathymetryTracker,
    favour_of,
    NEIGHBOURS_NS,
)
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TERRAIN = BathymetryConfig(**EXACT)


def made(config, name='paper', seed=3, **changes):
    scene = simulate(scenario(name, changes), seed)
    tracker = BathymetryTracker(config)
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    return estimates, scene.truth


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
    y = case['iq'].astype(np.float64)
    r = case['r']
    decibels = 30.0 - 20.0 * np.log(r / 17.0) / np.log(77.0 / 17.0)
    snapshot = Snapshot(
        stamp_ns=1, range=r, iq=(y[..., 0] + 1j * y[..., 1]).astype(np.complex64),
        noise_variance=np.ones(len(r)), signal_variance=10.0 ** (0.1 * decibels),
    )  # fmt: skip
    seen = look(Ping(TERRAIN, snapshot, None))
    std = seen.swath.snapshot_std(
        seen.swath.floor(np.zeros(len(r)), np.ones(len(r))).angle,
        seen.likelihood.signal / seen.likelihood.noise,
        8,
    )
    assert std == pytest.approx(case['sd_h'], rel=1e-6)
    (estimate,) = BathymetryTracker(TERRAIN).process(snapshot)
    there = estimate.extras['rough'] > 0.5
    assert (there == (case['rough'] > 0.5)).mean() > 0.97  # those of a bank of six models


@pytest.mark.parametrize('model_set', ['height_two_rw', 'terrain'])
def test_told_is_never_smooth_beyond_what_is_detectable(model_set):
    (estimate,), _ = made(BathymetryConfig(model_set=model_set), pings=1)
    table = estimate.columns()
    given, detectable, confidence = (
        table[name] for name in ('told', 'detectable_std', 'label_confidence')
    )
    assert given.dtype == np.uint8 and detectable.dtype == confidence.dtype == np.float32
    assert (detectable[given == 0] <= 0.3).all() and (confidence[given < 2] > 0.9).all()
    assert (given == 0).sum() > 200 and (given[table['range'] > 60.0] != 0).all()
    assert (given[table['valid'] == 0] == 2).all() and (table['valid'] == 0).any()
    assert detectable[table['range'] < 20.0].max() < 0.06
    assert detectable[table['range'] > 70.0].min() > 0.7


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
    estimates, truth = made(TERRAIN, pings=3, seed=21, **changes)
    rough = np.concatenate([each.extras['rough'] > 0.5 for each in estimates])
    given = np.concatenate([each.extras['told'] for each in estimates])
    patch = np.concatenate([each.patch for each in truth])
    assert (rough & patch).sum() / (rough | patch).sum() > least
    assert (given[~patch] == 1).mean() < 0.03 and patch[given == 1].mean() > 0.9


def test_a_slope_is_smooth_floor_and_scatter_is_rough():
    rng = np.random.default_rng(2)
    ranges = 20.0 + 0.05 * np.arange(300)
    slope = 0.15 * (ranges - 20.0)
    (smooth,) = BathymetryTracker(TERRAIN).process(floor(slope, ranges=ranges, snr_db=30.0))
    assert (smooth.extras['told'] == 0).mean() > 0.9
    stones = slope + rng.normal(0.0, 0.3, 300)
    (rough,) = BathymetryTracker(TERRAIN).process(floor(stones, ranges=ranges, snr_db=30.0))
    assert (rough.extras['told'] == 1).mean() > 0.9
    error = rough.state[:, 0] - stones
    assert np.sqrt(np.mean(error**2)) < 0.1  # of the bins, not of the base
    held = np.abs(error) < 2.0 * np.sqrt(rough.covariance[:, 0, 0])
    assert held.mean() > 0.9


def told_of(height, ranges):
    (made,) = BathymetryTracker(TERRAIN).process(floor(height, ranges=ranges, snr_db=25.0))
    table = made.columns()
    return table['told'], table['rough'] + table['prob_winding'] > 0.5


def test_roughness_over_metres_and_short_waves_are_told_neither_smooth_nor_rough():
    """The slopes and bends of both are alike: only floor that bends less is smooth."""
    ranges = 20.0 + 0.05 * np.arange(600)
    wave, _ = told_of(np.sin(2.0 * np.pi * ranges / 13.0), ranges)
    swell, _ = told_of(0.7 * np.sin(2.0 * np.pi * ranges / 20.0), ranges)
    assert (wave == 2).mean() > 0.9 and (swell == 0).mean() > 0.9
    told, either = [], []
    for seed in range(8):
        stones = gaussian_filter1d(np.random.default_rng(seed).normal(size=600), 1.5 / 0.05)
        for found, each in zip((told, either), told_of(0.5 * stones / stones.std(), ranges)):
            found.append(each)
    assert (np.array(told) == 2).mean() > 0.9 and np.mean(either) > 0.75


RANGES = 20.0 + 0.05 * np.arange(60)
ALONE = BathymetryConfig()
COUPLED = evolve(ALONE, ping_coupling=0.35)
MODES = BathymetryConfig(
    model_set='height_two_rw', particles_per_model=50, smoothing='modes', ping_coupling=0.35
)


def ping(number, *, side='', seed=None, height=0.0, period_ns=10**8):
    made = floor(height, ranges=RANGES, seed=number if seed is None else seed)
    return evolve(made, stamp_ns=10**12 + number * period_ns, side=side)


def enumerated(initial, transition, favour, steps):
    """Filtered and smoothed probabilities of a chain that no measurement tells about, over all its
    sequences."""
    M = len(initial)

    def marginals(upto):
        weight = np.zeros((upto, M))
        for path in itertools.product(range(M), repeat=upto):
            chance, before = 1.0, None
            for t, j in enumerate(path):
                come = initial @ transition[:, j] if before is None else transition[before, j]
                chance *= come * favour[t, j]
                before = j
            for t, j in enumerate(path):
                weight[t, j] += chance
        return weight / weight.sum(axis=1, keepdims=True)

    return np.array([marginals(t + 1)[t] for t in range(steps)]), marginals(steps)


@pytest.mark.parametrize('engine', ['gaussian', 'particles'])
def test_favours_act_as_a_prior_of_each_bin(engine):
    """Equal walks: measurements say nothing of the model, and only chain and favours are left."""
    transition, initial, T = (0.9, 0.1, 0.3, 0.7), np.array([0.75, 0.25]), 6
    config = BathymetryConfig(
        model_set='height_two_rw', sigmas=(0.05, 0.05), transition_matrix=transition,
        initial_probabilities=initial, engine=engine, particles_per_model=20_000,
        gate_false_alarm=1.0,
    )  # fmt: skip
    snapshot = floor(0.0, ranges=RANGES[:T])
    favour = np.random.default_rng(1).uniform(0.2, 1.8, size=(T, 2))
    filtered, smoothed = enumerated(initial, np.reshape(transition, (2, 2)), favour, T)
    exact = engine == 'gaussian'
    seen = look(Ping(config, snapshot, None))
    found = run(seen, favour).probability
    assert found == pytest.approx(filtered, abs=1e-9 if exact else 0.02)
    if exact:  # both ways, as `terrain` does
        peak = seen.swath.height_from(seen.loudest)
        models = evolve(seen.models, favour=favour)
        found = run_terrain(models, seen.likelihood, peak, smooth=True).probability
    else:
        whole = evolve(config, smoothing='modes')
        found = run(look(Ping(whole, snapshot, None)), favour).probability
    assert found == pytest.approx(smoothed, abs=1e-9 if exact else 0.02)
    assert np.abs(run(seen).probability - filtered).max() > 0.05


def alone(config, snapshot, rough):
    """A ping by itself that is as rough (T,) as told."""
    seen = look(Ping(config, snapshot, None))
    made = Alone.of(seen, run(seen))
    counts = seen.models.rough
    rough = rough[:, None]
    probability = np.where(counts, rough / counts.sum(), (1.0 - rough) / (~counts).sum())
    return Alone.of(seen, made.track._replace(probability=probability))


def test_the_field_is_that_of_the_two_neighbours():
    J, T = 0.35, len(RANGES)
    of = [alone(COUPLED, ping(k, seed=1), p * np.ones(T)) for k, p in enumerate((0.9, 0.5, 0.2))]
    field = sum(
        math.log((p + (1 - p) * math.exp(-J)) / ((1 - p) + p * math.exp(-J))) for p in (0.9, 0.2)
    )
    favour, rough = favour_of(of[1], [of[0], of[2]], J), of[1].seen.models.rough
    assert favour[:, rough] == pytest.approx(2.0 / (1.0 + math.exp(-field)))
    assert favour[:, ~rough] == pytest.approx(2.0 / (1.0 + math.exp(field)))
    undecided = alone(COUPLED, ping(3, seed=1), np.full(T, 0.5))
    assert favour_of(of[1], [undecided], J) == pytest.approx(np.ones(favour.shape))


def test_neighbours_are_compared_at_the_same_place_across_the_track():
    """The neighbour's bins are twice as far apart: rough from 21 m on, whatever the bin."""
    wide = floor(0.0, ranges=20.0 + 0.1 * np.arange(30), seed=1)
    rough = alone(COUPLED, wide, (wide.range >= 21.0).astype(float))
    between = alone(COUPLED, ping(1), np.full(60, 0.5))
    one = int(np.argmax(between.seen.models.rough))
    favour = favour_of(between, [rough], 0.35)
    inner, outer = (RANGES > 20.2) & (RANGES < 20.8), (RANGES > 21.2) & (RANGES < 22.8)
    assert (favour[inner, one] < 1.0).all() and (favour[outer, one] > 1.0).all()
    # Where the neighbour ends it has no opinion.
    short = alone(COUPLED, floor(0.0, ranges=RANGES[:20], seed=1), np.ones(20))
    favour = favour_of(between, [short], 0.35)
    assert favour[30:] == pytest.approx(np.ones(favour[30:].shape)) and favour[5, one] > 1.1


@pytest.mark.parametrize('config', [COUPLED, MODES], ids=['states', 'modes'])
def test_estimates_come_one_ping_late_and_none_is_lost(config):
    tracker, pings = BathymetryTracker(config), [ping(k) for k in range(4)]
    made = [tracker.process(each) for each in pings]
    assert [len(each) for each in made] == [0, 1, 1, 1]
    assert tracker.health()['pings_held'] == 1
    last = tracker.finish()
    assert tracker.finish() == [] and 'pings_held' not in tracker.health()
    stamps = [each.stamp_ns for each in [*sum(made, []), *last]]
    assert stamps == [each.stamp_ns for each in pings] and tracker.counts['used'] == 4


def test_an_estimate_depends_on_its_neighbours_alone():
    def third(*seeds):
        tracker = BathymetryTracker(COUPLED)
        made = [
            each for k, seed in enumerate(seeds) for each in tracker.process(ping(k, seed=seed))
        ]
        return [*made, *tracker.finish()][2]

    assert same(third(1, 2, 3, 4, 5), third(9, 2, 3, 4, 9))
    assert not same(third(1, 2, 3, 4, 5), third(1, 2, 3, 9, 5))


def test_pings_far_apart_and_other_sides_are_no_neighbours():
    by_itself = BathymetryTracker(ALONE)
    tracker = BathymetryTracker(COUPLED)
    pings = [
        ping(0, side='port'),
        ping(0, side='starboard', seed=7),
        ping(1, side='port', period_ns=NEIGHBOURS_NS + 1),
        ping(1, side='starboard', seed=8, period_ns=NEIGHBOURS_NS + 1),
    ]
    found = [each for p in pings for each in tracker.process(p)] + tracker.finish()
    assert len(found) == 4
    for p, each in zip(pings, found):
        assert same(by_itself.process(p)[0], each)


def test_switched_off_the_held_ping_comes_out_first():
    tracker = BathymetryTracker(COUPLED)
    assert tracker.process(ping(0)) == []
    tracker.reconfigure(ALONE)
    assert [each.stamp_ns for each in tracker.process(ping(1))] == [
        ping(0).stamp_ns,
        ping(1).stamp_ns,
    ]


def test_a_bin_in_doubt_goes_with_its_neighbours():
    """A patch that two pings see clearly and the one between hardly."""
    T = len(RANGES)
    patch = (np.arange(T) >= 20) & (np.arange(T) < 40)
    rng = np.random.default_rng(3)

    def seen(number, std):
        return ping(number, height=patch * std * rng.normal(size=T))

    pings = [seen(0, 0.5), seen(1, 0.045), seen(2, 0.5)]
    plain = BathymetryTracker(ALONE).process(pings[1])[0]
    tracker = BathymetryTracker(evolve(COUPLED, ping_coupling=1.0))
    coupled = [each for p in pings for each in tracker.process(p)][1]
    gain = coupled.extras['rough'] - plain.extras['rough']
    assert gain[patch].mean() > 0.05 and gain[patch].min() > -1e-9
    assert gain[~patch].max() < gain[patch].max()
