# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The models of `terrain` and their Gaussian engine, against vectors made independently, a filter
on cells of height and slope, and floors whose shape is known."""

import math

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
from helpers.vector_files import load_vectors
import numpy as np
from oracles.bin_likelihood import log_likelihood
from oracles.terrain import smoothed
import pytest
from scipy.stats import norm

from sonar_imm.acoustics import array
from sonar_imm.acoustics.laplace import log_density
from sonar_imm.acoustics.variances import bins_alike
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.models import TerrainModels
from sonar_imm.trackers.bathymetry.ping import look, Ping
from sonar_imm.trackers.bathymetry.terrain import KINDS, SLOPE0, Terrain, terrain_of
from sonar_imm.trackers.bathymetry.terrain_filter import run_terrain
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

STEP = 2.0 * math.pi * 0.5
NINE = KINDS[:9]
"""The models of the vectors; later ones are compared with nothing."""
TERRAIN = BathymetryConfig(model_set='terrain', layover='ignored', **EXACT)


def vectors(name):
    return load_vectors(f'bathymetry_by_default/{name}')


def samples(values):
    return values[..., 0].astype(float) + 1j * values[..., 1].astype(float)


def snapshot(iq, ranges, rho):
    noise = np.ones(len(ranges))
    return Snapshot(
        stamp_ns=1_000, range=ranges, iq=iq, noise_variance=noise, signal_variance=rho * noise
    )


def test_the_models_are_those_of_the_vectors():
    case, made = vectors('models'), terrain_of(0.05, NINE)
    assert made.names == tuple(case['names']) and case['slope0'] == SLOPE0
    for name in ('rough', 'walk', 'phi', 'follow', 'scatter', 'coast', 'transition'):
        assert np.abs(case[name] - np.asarray(getattr(made, name), float)).max() < 1e-9, name
    assert made.stationary == pytest.approx(case['pi'], abs=1e-9)
    finer = terrain_of(0.02, NINE)
    assert finer.transition == pytest.approx(case['transition_02'], abs=1e-9)
    assert finer.phi == pytest.approx(case['phi_02'], abs=1e-9)
    assert finer.walk == pytest.approx(made.walk * math.sqrt(0.4), rel=1e-12)


@pytest.mark.parametrize('width', [0.001, 0.02, 0.05, 0.4, 5.0, 100.0])
def test_the_chain_is_reversible_at_any_width(width):
    made = terrain_of(width)
    flows = made.stationary[:, None] * made.transition
    assert made.transition.min() >= 0.0 and np.isfinite(made.phi).all()
    assert made.transition.sum(axis=1) == pytest.approx(1.0)
    assert flows == pytest.approx(flows.T, abs=1e-12)
    # A model is left after its stay, and at most in every second bin.
    left, stay = 1.0 - np.diag(made.transition), np.array([kind.stay for kind in KINDS])
    assert left == pytest.approx(np.minimum(width / stay, 0.5), abs=1e-9)


def of_one(mean, std, width=0.05, walk=0.0, phi=0.0, follow=False):
    """One model, that stays where it is if nothing else is said, and its start."""
    terrain = Terrain(
        names=('level',), rough=np.zeros(1, bool), walk=np.array([walk]), phi=np.array([phi]),
        follow=np.array([follow]), scatter=np.zeros(1), coast=np.zeros(1, np.int64),
        transition=np.eye(1), stationary=np.ones(1), width=width,
    )  # fmt: skip
    return of_several(terrain, mean, std)


def of_several(terrain, mean=0.0, std=1.0):
    M = len(terrain.names)
    return TerrainModels(
        names=terrain.names, state_names=('height',), F=np.ones((M, 1, 1)), G=np.zeros((M, 1, 1)),
        scale=np.zeros((1, M)), transition=terrain.transition, initial=terrain.stationary,
        mean=np.array([mean]), std=np.array([std]), coast=0, rough=terrain.rough, terrain=terrain,
    )  # fmt: skip


def looked(ping, **config):
    """What is looked at of a ping, its likelihood, its peak."""
    made = look(Ping(evolve(TERRAIN, **config), ping, None))
    return made, made.likelihood, made.swath.height_from(made.loudest)


def seen(iq, ranges, rho):
    """Likelihood and peak of samples of any ping without a gate."""
    ping = snapshot(np.array(iq, np.complex128), ranges, np.full(len(ranges), rho))
    return looked(ping, gate_false_alarm=1.0)[1:]


def process(ping, **config):
    (made,) = BathymetryTracker(evolve(TERRAIN, **config)).process(ping)
    return made


def test_a_bin_is_weighed_as_by_integration():
    case = vectors('update')
    for k, iq in enumerate(samples(case['iq'])):
        # Two bins: a ping has no fewer. The first one alone is looked at.
        told = seen([iq, iq], case['r'][k] + np.array([0.0, 0.05]), case['rho'][k])
        models = of_one(float(case['prior_mean'][k]), math.sqrt(case['prior_var'][k]))
        track, sd = run_terrain(models, *told, smooth=False), math.sqrt(case['var'][k])
        assert track.log_likelihood[0] == pytest.approx(case['evidence'][k], abs=0.005)
        assert track.mean[0, 0] == pytest.approx(case['mean'][k], abs=0.01 * sd)
        assert track.covariance[0, 0, 0] == pytest.approx(case['var'][k], rel=0.05)


@pytest.mark.parametrize('name', ['slope', 'paper', 'wave'])
def test_whole_pings_are_those_of_the_vectors(name):
    case = vectors('pings')
    names = 'iq echo mean var prob forward_log_likelihood'
    iq, echo, mean, var, prob, logs = (case[f'{name}_{each}'] for each in names.split())
    ping, likelihood, peak = looked(snapshot(samples(iq), case['r'], case['rho']))
    assert (likelihood.echo != echo).sum() <= 2
    start = float(ping.models.mean[0]), float(ping.models.std[0])
    models = of_several(terrain_of(ping.models.terrain.width, NINE), *start)
    made = run_terrain(models, likelihood._replace(echo=echo), peak, smooth=True)
    assert (np.abs(made.mean[:, 0] - mean) < 0.01 * np.sqrt(var)).all()
    assert (np.abs(made.probability - prob).max(axis=1) < 1e-3).mean() > 0.99
    assert made.covariance[:, 0, 0] == pytest.approx(var, rel=0.02)
    assert made.log_likelihood[echo].sum() == pytest.approx(logs.sum(), abs=0.1)


WIDTH, BASE, SLOPES = 1.0, np.linspace(-4.0, 4.0, 101), np.linspace(-1.05, 1.05, 15)
THREE = Terrain(
    names=('level', 'steady', 'scatter'), rough=np.array([False, False, True]),
    walk=np.array([0.1, 0.1, 0.15]), phi=np.array([0.0, 0.9, 0.0]),
    follow=np.array([False, True, False]), scatter=np.array([0.0, 0.0, 0.5]),
    coast=np.array([0, 1, 0]),
    transition=np.array([[0.86, 0.04, 0.1], [0.02, 0.93, 0.05], [0.2, 0.2, 0.6]]),
    stationary=np.array([2.0, 4.0, 1.0]) / 7.0, width=WIDTH,
)  # fmt: skip

ONE = of_one(0.0, 1.0, WIDTH, walk=0.1, phi=0.9, follow=True).terrain


def exact(terrain, silent):
    """The engine and the filter on cells on the same floor, which has a slope, a stretch that
    scatters and silent bins, at 12 dB: (outward, whole) of both."""
    ranges, echo, rho = 20.0 + WIDTH * np.arange(30), np.ones(30, bool), 10.0**1.2
    height = np.cumsum(0.25 * np.sin(0.25 * np.arange(30))) - 0.5
    height[20:] = height[20] + 0.5 * np.random.default_rng(3).normal(size=10)
    iq = floor(height, ranges=ranges, seed=3, snr_db=12.0).iq
    (likelihood, peak), models = seen(iq, ranges, rho), of_several(terrain)
    echo[silent] = False
    likelihood = likelihood._replace(echo=echo)
    made = [run_terrain(models, likelihood, peak, smooth=smooth) for smooth in (False, True)]
    sines = array.direction_sine(15.0 - BASE, ranges[:, None], math.radians(30.0))
    logs = np.array([log_likelihood(s, y, rho, 1.0, STEP) for s, y in zip(sines, iq)])
    kinds = zip(terrain.walk, terrain.phi, terrain.follow, terrain.scatter)
    cells = smoothed(
        (0.0, 1.0), BASE, SLOPES, list(kinds), terrain.transition, terrain.stationary, SLOPE0,
        WIDTH, logs, echo, terrain.coast.tolist(),
    )  # fmt: skip
    return zip(made, cells)


@pytest.mark.parametrize('silent', [slice(0), slice(8, 11)], ids=['all heard', 'three silent'])
@pytest.mark.parametrize('terrain', [ONE, THREE], ids=['one model', 'three'])
def test_both_ways_are_those_of_a_filter_on_cells(terrain, silent):
    """What Gaussians in place of densities cost: the chain of the three is not even reversible."""
    for track, cells in exact(terrain, silent):
        off = np.abs(track.mean[:, 0] - cells.mean) / np.sqrt(cells.variance)
        assert off.max() < 0.25 and off.mean() < 0.06
        assert np.abs(track.probability - cells.probability).mean() < 0.02
        ratio = track.covariance[:, 0, 0] / cells.variance
        assert 0.8 < ratio.min() and ratio.max() < 1.25
        assert track.log_likelihood == pytest.approx(cells.log_likelihood, abs=0.15)


def test_the_slope_is_turned_round_for_the_inward_filter():
    """A ping read backwards, its slopes with it, is the same floor."""
    ranges = 20.0 + 0.05 * np.arange(200)
    height = 0.15 * (ranges - 25.0)
    told = seen(floor(height, ranges=ranges).iq, ranges, 10.0**2.5)
    track = run_terrain(SEVERAL, *told, smooth=True)
    error = track.mean[:, 0] - height
    assert np.abs(error).max() < 0.06
    assert (np.abs(error) < 2.0 * np.sqrt(track.covariance[:, 0, 0])).mean() > 0.9


SEVERAL = of_several(terrain_of(0.05))


@pytest.mark.parametrize('values', [{'multipath': True}, {'likelihood': 'gaussian'}])
def test_other_laws_are_weighed_as_by_integration(values):
    ranges, heights = 30.0 + 0.05 * np.arange(40), np.linspace(-3.0, 3.0, 6001)
    _, told, peak = looked(floor(0.3, ranges=ranges, snr_db=15.0), **values)
    sines = array.direction_sine(15.0 - heights, ranges[:, None], math.radians(30.0))
    phases = np.exp(-1j * STEP * sines[..., None] * np.arange(8))
    q = np.einsum('thp,tp->th', phases, told.form).real
    gain = np.ones_like(q)
    if 'multipath' in values:
        gain += told.signal[:, None] * np.einsum('thp,tp->th', phases, told.spread).real
        q = told.base[:, None] + q / gain
    logs = (-q if 'likelihood' in values else log_density(q, 8)) - np.log(gain)
    prior = norm.pdf(heights, 0.2, 0.3) * (heights[1] - heights[0])
    for t in np.random.default_rng(4).choice(40, 12, replace=False):
        top = logs[t].max()
        mass = prior * np.exp(logs[t] - top)
        mean = (mass @ heights) / mass.sum()
        variance = mass @ np.square(heights - mean) / mass.sum()
        left = {name: getattr(told, name)[t:] for name in 'form base spread signal ranges'.split()}
        geometry = told.geometry._replace(reach=ranges[t:])
        one = told._replace(**left, echo=np.ones(40 - t, bool), geometry=geometry)
        track = run_terrain(of_one(0.2, 0.3), one, peak[t:], smooth=False)
        assert track.log_likelihood[0] == pytest.approx(top + math.log(mass.sum()), abs=0.02)
        assert track.mean[0, 0] == pytest.approx(mean, abs=0.05 * math.sqrt(variance))
        assert track.covariance[0, 0, 0] == pytest.approx(variance, rel=0.1)


def test_bent_rays_that_are_straight_change_nothing():
    """A table of launch elevations of straight sound holds the depths themselves."""
    ranges = 20.0 + 0.05 * np.arange(100)
    _, told, peak = looked(floor(0.3 + 0.1 * (ranges - 20.0), ranges=ranges))
    table = np.tile(-20.0 + 0.25 * np.arange(200), (120, 1))
    bent = told.geometry._replace(launch=table, row=ranges, first_depth=-20.0, depth_step=0.25)
    straight, track = (
        run_terrain(SEVERAL, each, peak, smooth=True)
        for each in (told, told._replace(geometry=bent))
    )
    assert track.mean == pytest.approx(straight.mean, abs=1e-9)
    assert track.probability == pytest.approx(straight.probability, abs=1e-9)


def test_half_of_the_log_likelihood_is_what_a_factor_says():
    """Counted half, two equal bins say what one says."""
    iq = floor(0.3, ranges=30.0 + 0.05 * np.arange(10)).iq[[4, 4]]
    told = seen(iq, np.array([30.0, 30.0 + 1e-9]), 10.0**2.5)
    once, half = (
        run_terrain(of_one(0.0, 1.0), *told, smooth=False, **values)
        for values in ({}, {'temper': 0.5})
    )
    assert half.mean[1] == pytest.approx(once.mean[0], abs=2e-3)
    assert half.covariance[1, 0, 0] == pytest.approx(once.covariance[0, 0, 0], rel=0.1)


def test_what_favours_a_model_counts_once():
    """Its share before the last bin is multiplied by the factor, not by its square."""
    _, *told = looked(floor(0.0, ranges=20.0 + 0.05 * np.arange(60)))
    favour, odds = np.ones((60, len(SEVERAL.names))), []
    favour[30, SEVERAL.rough] = 4.0
    for models in (SEVERAL, evolve(SEVERAL, favour=favour)):
        track = run_terrain(models, *told, smooth=True)
        rough = track.probability[30, models.rough].sum()
        odds.append(rough / (1.0 - rough))
    assert odds[1] / odds[0] == pytest.approx(4.0, rel=0.05)


RANGES = 20.0 + 0.05 * np.arange(300)
SLOPE = 0.1 * (RANGES - 20.0)


@pytest.mark.parametrize('kept', ['none', 'states'])
def test_a_shadow_widens_what_is_known(kept):
    made = process(floor(SLOPE, shadow=slice(120, 180)), smoothing=kept)
    sd, error = np.sqrt(made.covariance[:, 0, 0]), made.state[:, 0] - SLOPE
    assert not made.extras['valid'][125:175].any()
    assert sd[150] > 1.1 * sd[100] and np.abs(error[120:180]).max() < 3.0 * sd[120:180].max()
    assert np.abs(error).max() < 0.2
    assert made.probabilities.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize('silent, goes_on', [(50, True), (70, False)])
def test_the_chain_goes_on_in_narrow_gaps_only(silent, goes_on):
    made, steps = process(floor(SLOPE, shadow=slice(120, 120 + silent)), smoothing='none'), 30
    valid = np.flatnonzero(made.extras['valid'])
    last = valid[valid < 130][-1]
    assert valid[valid > last][0] >= 120 + silent
    before, after = made.probabilities[[last, last + steps]]
    if goes_on:
        before = before @ np.linalg.matrix_power(terrain_of(0.05).transition, steps)
    assert after == pytest.approx(before, abs=1e-9) and np.ptp(before) > 0.1
    assert (made.extras['log_likelihood'][last + 1 : last + steps] == 0.0).all()


def test_nothing_but_noise_is_the_start():
    made = process(floor(0.0, ranges=RANGES[:50], shadow=slice(0, 50)))
    assert np.abs(made.state).max() < 1e-9
    assert (made.covariance[:, 0, 0] > 0.9).all() and not made.extras['valid'].any()
    stationary = np.tile(terrain_of(0.05).stationary, (50, 1))
    assert made.probabilities == pytest.approx(stationary, rel=0.05)


def of_five(pings, height, tracker):
    """RMSE, share inside two deviations, share of rough bins of pings of a known floor."""
    square, inside, rough = [], [], []
    for ping in pings:
        (made,) = tracker.process(ping)
        used = made.extras['valid'] > 0
        error = (made.state[:, 0] - height)[used]
        square.append(np.square(error).mean())
        inside.append((np.abs(error) < 2.0 * np.sqrt(made.covariance[used, 0, 0])).mean())
        rough.append((made.extras['rough'][used] > 0.5).mean())
    return math.sqrt(np.mean(square)), np.mean(inside), np.mean(rough)


@pytest.mark.parametrize('slope', [0.0, 0.18, -0.28])
def test_slopes_are_followed_and_smooth(slope):
    """Five pings: the error of two walks, that cannot follow, is 0.2 m."""
    ranges = 25.0 + 0.05 * np.arange(400)
    height = slope * (ranges - 35.0)
    pings = [floor(height, ranges=ranges, seed=seed, snr_db=20.0) for seed in range(5)]
    rmse, inside, rough = of_five(pings, height, BathymetryTracker(TERRAIN))
    assert rmse < 0.06 and inside > 0.85 and rough < 0.05


def test_bins_finer_than_the_pulse_are_counted_as_the_vectors_say():
    case, none = vectors('array'), np.zeros((5, 8), complex)
    rows = [(samples(case['oversampled_iq']), float(case['tau']))]
    rows += [(ping, 1.0) for ping in samples(case['iq'])]
    for iq, alike in rows:
        assert bins_alike(iq, np.ones(len(iq), bool)) == pytest.approx(alike, abs=1e-9)
    assert bins_alike(none, np.zeros(5, bool)) == 1.0


def test_bins_finer_than_the_pulse_are_tempered_and_said():
    """A boxcar over four bins: without the factor the error is .027 m."""
    ranges, pings = 25.0 + 0.05 * np.arange(403), []
    for seed in range(5):
        one = floor(0.0, ranges=ranges, seed=seed, stamp_ns=1000 + seed)
        iq = 0.5 * sum(one.iq[k : k + 400].astype(np.complex128) for k in range(4))
        # The middle of four bins is half a bin beyond the second one.
        four = {'range': ranges[:400] + 0.075, 'iq': iq, 'noise_variance': np.ones(400)}
        pings.append(Snapshot(stamp_ns=one.stamp_ns, **four))
    tracker = BathymetryTracker(TERRAIN)
    rmse, inside, _ = of_five(pings, 0.0, tracker)
    assert rmse < 0.015 and inside > 0.9
    assert tracker.health()['independent_bins'] == pytest.approx(1.0 / 2.75, rel=0.1)
    assert any(each.startswith('bins are finer than the pulse: 2.') for each in tracker.warnings())


@pytest.mark.parametrize('tilt', [90.0, -75.0, 60.0, 59.0])
def test_an_array_that_looks_down_runs_angles_and_says_so(tilt):
    config = BathymetryConfig(tilt_deg=tilt, initial_mean=3.0, initial_std=2.0)
    tracker, down = BathymetryTracker(config), tilt != 59.0
    (made,) = tracker.process(floor(0.0, ranges=15.2 + 0.05 * np.arange(60), tilt_deg=tilt))
    assert made.state_names == ('angle' if down else 'height',) and tracker.config is config
    assert np.isfinite(made.state).all()
    told = f'the array looks down (tilt {tilt:g} deg): angle models are used'
    assert tracker.warnings().count(told) == down


def test_what_the_geometry_leaves_open_is_in_the_covariance_and_told_apart():
    ping = floor(0.0)
    auto = {'sound_speed_std': -1.0}
    plain, made = process(ping), process(ping, tilt_std_deg=0.2, spacing_std=0.01, **auto)
    common = np.square(made.extras['geometry_std'].astype(float))
    assert made.state == pytest.approx(plain.state, abs=1e-12)
    assert made.covariance[:, 0, 0] - plain.covariance[:, 0, 0] == pytest.approx(common, rel=1e-5)
    assert (plain.extras['geometry_std'] == 0.0).all() and common.min() > 0.0
    stated = evolve(ping, sound_speed=1500.0)
    for snapshot, std in ((stated, 2.0), (ping, 15.0)):
        ours, theirs = process(snapshot, **auto), process(stated, sound_speed_std=std)
        np.testing.assert_array_equal(ours.extras['geometry_std'], theirs.extras['geometry_std'])


@pytest.mark.parametrize('model_set', ['terrain', 'angle_two_rw'])
def test_an_array_that_is_not_what_it_is_said_to_be_is_inside_what_is_said(model_set):
    """Tilt, spacing and sound speed wrong in each ping: of the filter alone little is inside."""
    ranges, inside = 25.0 + 0.1 * np.arange(300), []
    for values in (EXACT, {'sound_speed_std': 2.0}):
        config = BathymetryConfig(model_set=model_set, layover='ignored', **values)
        tracker, rng = BathymetryTracker(config), np.random.default_rng(8)
        for seed in range(6):
            tilt, spacing, speed = rng.normal(size=3) * (0.2, 0.01, 2.0 / 1500.0)
            wrong = {'tilt_deg': 30.0 + tilt, 'spacing': 0.5 * (1.0 + spacing + speed)}
            true = floor(0.0, ranges=ranges * (1.0 + speed), seed=seed, **wrong)
            (made,) = tracker.process(evolve(true, range=ranges))
            error, used = made.state[:, 0], made.extras['valid'] > 0
            if model_set != 'terrain':  # the tilt is no error of an angle from broadside
                error = error - np.arcsin(15.0 / true.range) + np.radians(30.0 + tilt)
            inside.append((np.abs(error) < 2.0 * np.sqrt(made.covariance[:, 0, 0]))[used].mean())
    assert np.mean(inside[6:]) > 0.85
    if model_set == 'terrain':
        assert np.mean(inside[:6]) < 0.6
