# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry tracker as its users see it: snapshots in, the floor out."""

import math

from attrs import evolve
from helpers.bathymetry_cases import EXACT, floor
from helpers.estimates import same
import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from sonar_imm.acoustics import array, coherence
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.bathymetry.models import UnknownHeight
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TWO_RW = {'model_set': 'height_two_rw'}
OF_SLOPE = 'cov_height_height cov_height_slope cov_slope_slope'
TERRAIN = 'level steady undulating winding scatter_1 scatter_2 scatter_3 walk break'
PATCH = np.zeros(300)
PATCH[120:200] = 0.5 * np.random.default_rng(1).normal(size=80)


def tracker_of(**values):
    return BathymetryTracker(BathymetryConfig(**values))


def run(snapshot, **values):
    return tracker_of(**values).process(snapshot)[0]


def rmse(estimate, height):
    values = estimate.columns()['height']
    return float(np.sqrt(np.mean(np.square(values - height))))


@pytest.mark.parametrize(
    'model_set, state, models',
    [
        ('height_two_rw', 'height cov_height_height', 'rw_smooth rw_rough'),
        ('angle_two_rw', 'angle cov_angle_angle', 'rw_smooth rw_rough'),
        ('height_rw_ncs', f'height slope {OF_SLOPE}', 'rw ncs'),
        ('terrain', 'height cov_height_height', TERRAIN),
    ],
)
def test_columns_are_those_of_the_contract(model_set, state, models):
    snapshot = floor(0.0)
    table = run(snapshot, model_set=model_set).columns()
    models = [f'prob_{name}' for name in models.split()]
    other = 'height' if model_set == 'angle_two_rw' else 'angle'
    after = 'valid log_likelihood label label_probability label_confidence told detectable_std'
    after += ' rough' * (model_set == 'terrain') + ' existence_2 surfaces geometry_std'
    assert list(table) == [*'xyz', *state.split(), *models, 'range', other, *after.split()]
    assert table['valid'].dtype == np.uint8
    assert all(len(column) == len(snapshot) for column in table.values())
    assert sum(table[name] for name in models) == pytest.approx(1.0)


@pytest.mark.parametrize('side, sign', [('port', 1.0), ('starboard', -1.0)])
def test_points_lie_on_their_side_and_below_the_sonar(side, sign):
    """And angle and height say the same."""
    snapshot = floor(0.0)
    estimate = run(snapshot, side=side)
    x, y, z = estimate.xyz.T
    assert (x == 0.0).all()
    assert y == pytest.approx(sign * np.sqrt(snapshot.range**2 - 15.0**2), rel=0.02)
    assert z == pytest.approx(-15.0, abs=0.5)
    assert np.hypot(y, z) == pytest.approx(snapshot.range, rel=1e-6)
    table = estimate.columns()
    depth = array.depth_of_angle(table['angle'], table['range'], math.radians(30.0))
    assert 15.0 - depth == pytest.approx(table['height'], abs=1e-9)


def test_labels_name_the_model_that_holds_and_how_sure_that_is():
    """Label 1 is the model `rw_rough`, wherever that is more probable than not."""
    table = run(floor(PATCH), **TWO_RW).columns()
    label, rough = table['label'], table['prob_rw_rough']
    assert (label[rough > 0.5] == 1).all() and (label[rough < 0.5] == 0).all()
    assert table['label_probability'] == pytest.approx(0.5 + np.abs(rough - 0.5), abs=1e-12)
    assert label[125:195].mean() > 0.9 and label[:100].mean() < 0.1


@pytest.mark.parametrize('engine', ['particles', 'gaussian'])
def test_a_ping_does_not_depend_on_other_pings(engine):
    tracker = tracker_of(engine=engine, **TWO_RW)
    pings = [floor(PATCH, seed=k, stamp_ns=1000 + k) for k in range(4)]
    forward, backward = (
        [tracker.process(ping)[0] for ping in way] for way in (pings, pings[::-1])
    )
    assert all(map(same, forward, backward[::-1]))
    assert same(forward[3], run(pings[3], engine=engine, **TWO_RW))


def test_seed_stamp_and_side_name_the_random_numbers():
    snapshot = floor(PATCH)
    first, later = run(snapshot, **TWO_RW), evolve(snapshot, stamp_ns=1_001)
    assert same(first, run(snapshot, seed=0, **TWO_RW))
    for ping, values in ((snapshot, {'seed': 1}), (snapshot, {'side': 'port'}), (later, {})):
        other = run(ping, **values, **TWO_RW)
        assert not np.array_equal(first.state, other.state)
        assert rmse(first, other.columns()['height']) < 0.15


def test_staves_and_sizes_are_taken_as_they_come():
    tracker = tracker_of(gate_false_alarm=1.0)
    for P in (2, 3, 16, 64):
        (estimate,) = tracker.process(floor(PATCH, P=P))
        assert rmse(estimate, PATCH) < 0.6 / math.sqrt(P)
    for bins, P in ((2, 8), (50, 2), (1000, 16)):
        (estimate,) = tracker.process(floor(0.0, ranges=20.0 + 0.05 * np.arange(bins), P=P))
        assert len(estimate) == bins and np.isfinite(estimate.state).all()
    assert tracker.counts['used'] == 7


@pytest.mark.parametrize('scale', [1e-9, 0.3, 1e9])
def test_the_scale_of_the_samples_does_not_matter(scale):
    quiet = floor(PATCH)
    iq, noise = quiet.iq.astype(np.complex128) * math.sqrt(scale), quiet.noise_variance * scale
    loud = evolve(quiet, iq=iq, noise_variance=noise)
    assert run(loud).state == pytest.approx(run(quiet).state, abs=1e-5)


ENGINES = pytest.mark.parametrize('engine', ['particles', 'gaussian'])


@ENGINES
def test_bins_that_are_not_finite_are_passed_over(engine):
    snapshot = floor(0.0)
    iq = snapshot.iq.copy()
    iq[50:60], iq[70, 3], iq[80] = np.nan, np.inf, 0.0
    tracker = tracker_of(engine=engine, gate_false_alarm=1.0, **TWO_RW)
    (estimate,) = tracker.process(evolve(snapshot, iq=iq))
    assert np.flatnonzero(estimate.extras['valid'] == 0).tolist() == [*range(50, 60), 70, 80]
    assert tracker.counts['bins_unusable'] == 12
    assert rmse(estimate, 0.0) < 0.15


@ENGINES
def test_nothing_is_heard_before_the_floor_can_answer(engine):
    """Bins nearer than the floor is deep are impossible: the state waits for the first echo."""
    snapshot = floor(0.0, ranges=WATER, shadow=WATER < 15.0, noise_variance=None)
    estimate = run(snapshot, engine=engine, **TWO_RW)
    assert np.isfinite(estimate.state).all()
    assert np.abs(estimate.state[WATER >= 15.0][20:, 0]).mean() < 0.1


@pytest.mark.parametrize('known', ['stated', 'water column', 'blind'])
def test_the_noise_is_found(known):
    ranges = (5.0 if known == 'water column' else 20.0) + 0.05 * np.arange(600)
    noise = {} if known == 'stated' else {'noise_variance': None}
    tracker = tracker_of()
    tracker.process(floor(0.0, ranges=ranges, shadow=ranges < 15.0, **noise))
    assert 0.5 < tracker.health()['noise_variance'] < 1.6


@pytest.mark.parametrize(
    'name, values, most',
    [
        ('paper', {}, 0.165),
        ('shadow', {}, 0.18),
        ('spikes', {}, 0.20),
        ('multipath', {'multipath': True}, 0.20),
        ('slope', {'model_set': 'height_rw_ncs'}, 0.20),
    ],
)
def test_scenes_reach_what_is_attainable(name, values, most):
    assert np.sqrt(np.mean(run_scene(name, {'pings': 6}, 3, **values)[2] ** 2)) < most


def test_smoothing_helps_modes_and_states():
    def score(**config):
        made, truths, errors = run_scene('paper', {'pings': 4}, 5, **config)
        rough = np.array([each.extras.get('rough', each.extras['label']) > 0.5 for each in made])
        patch = np.array([truth.patch for truth in truths])
        return np.sqrt(np.mean(errors**2)), (rough & patch).sum() / (rough | patch).sum()

    walks = {'sigmas': (0.01, 0.7), **TWO_RW}
    none, modes = (score(smoothing=name, **walks) for name in ('none', 'modes'))
    assert modes[0] == none[0] and modes[1] >= none[1] - 0.01
    outward, states = (score(smoothing=name) for name in ('none', 'states'))
    assert states[0] < 0.95 * outward[0] and states[1] > outward[1] - 0.02


def test_a_snapshot_of_another_array_is_counted():
    tracker = tracker_of(element_spacing_wavelengths=0.5)
    other = {'element_spacing': 0.01, 'frequency': 300e3, 'sound_speed': 1500.0}
    for frequency in (300e3, 37.5e3):  # two wavelengths, and a quarter of one
        assert tracker.process(floor(0.0, **{**other, 'frequency': frequency})) == []
    assert tracker.counts == {'other_spacing': 2}
    assert rmse(run(floor(0.0, spacing=2.0, **other)), 0.0) < 0.1


@pytest.mark.parametrize(
    'values, words',
    [
        ({**TWO_RW, 'sigmas': [0.1]}, 'sigmas needs 2 values'),
        ({'model_set': 'angle_two_rw', 'sigmas': [0.1, 1.0]}, 'takes sigmas_deg'),
        ({'model_set': 'angle_two_rw', 'sigmas_deg': [0.1]}, 'sigmas_deg needs three'),
        ({**TWO_RW, 'sigmas_deg': [0.1, 0.1, 2.0]}, 'angle_two_rw only'),
        ({**TWO_RW, 'transition_matrix': [1.0, 0.0]}, 'transition_matrix needs 2 x 2'),
        ({**TWO_RW, 'transition_matrix': [1.0, 0.1, 0.0, 1.0]}, 'row 0 of transition_matrix'),
        ({**TWO_RW, 'initial_probabilities': [1.0]}, 'initial_probabilities needs 2'),
        ({**TWO_RW, 'initial_probabilities': [0.7, 0.7]}, 'sum to 1.4'),
        ({**TWO_RW, 'smoothing': 'states'}, 'other sets smooth modes'),
        ({'gate_false_alarm': 0.7}, 'at most 0.5, or 1 for no test'),
        ({'model_set': 'height_two_rws'}, "did you mean 'height_two_rw'"),
        ({'particles_per_model': 1}, 'between 2 and'),
        ({'sigmas': [0.1, 0.2]}, 'takes no sigmas'),
        ({'stay_probability': 0.99}, 'takes no stay_probability'),
        ({'transition_matrix': [1.0]}, 'takes no transition_matrix'),
        ({'engine': 'particles'}, 'terrain runs on engine gaussian, not on particles'),
        ({'smoothing': 'modes'}, 'terrain smooths states, or nothing'),
        ({'model_set': 'angle_two_rw', 'engine': 'gaussian'}, 'for terrain and height_two_rw'),
        ({'ping_coupling': 0.3, 'smoothing': 'none'}, 'ping_coupling needs'),
        ({'sonar_lever': [1.0, 2.0]}, 'sonar_lever needs three'),
        ({'sound_speed_profile': [0.0, 1500.0, 1.0]}, 'in turn'),
        ({'sound_speed_profile': [0.0, 1500.0], 'navigation': 'ignored'}, 'needs navigation'),
    ],
)
def test_a_config_that_cannot_be_is_named(values, words):
    with pytest.raises(ConfigError, match=words):
        BathymetryConfig(**values)


def test_health_says_how_many_particles_count_and_how_much_is_heard():
    system = SYSTEMS['bathymetry']
    tracker = system.build(system.config_type()(**TWO_RW))
    assert tracker.counts == {} and tracker.health() == {}
    tracker.process(floor(0.0))
    assert 50 < tracker.health()['effective_sample_size'] <= 100
    assert tracker.health()['heard_share'] > 0.9
    tracker.reconfigure(system.config_type()())
    tracker.process(floor(0.0))
    assert math.isnan(tracker.health()['effective_sample_size'])


def test_particles_that_are_all_alike_are_not_sure():
    """A floor far from all particles, without a gate: one of them has all the weight."""
    values = {'particles_per_model': 2, 'gate_false_alarm': 1.0, 'initial_std': 0.01, 'seed': 3}
    made = run(floor(-9.0, snr_db=40.0), **values, **TWO_RW, **EXACT)
    assert made.covariance[:, 0, 0].min() >= 0.005**2
    angles = run(floor(0.0), model_set='angle_two_rw', particles_per_model=2, **EXACT)
    assert angles.covariance[:, 0, 0].min() >= np.radians(0.05) ** 2


WATER = 5.0 + 0.05 * np.arange(900)


def run_scene(name, changes, seed=1, **config):
    """The estimates and truths of a scene, and the errors (n, T)."""
    made = scenario(name, changes)
    scene = simulate(made, seed)
    tracker = tracker_of(**{**made.instruments(), **config})
    pings = [tracker.process(each.measurement) for each in scene.measurements]
    made = [each for ping in pings for each in ping]
    pairs = zip(made, scene.truth, strict=True)
    return made, scene.truth, np.array([a.columns()['height'] - b.height for a, b in pairs])


def worst(truths, errors):
    rms = [np.sqrt(np.mean(error[truth.valid] ** 2)) for truth, error in zip(truths, errors)]
    return max(rms)


@pytest.mark.parametrize('staves', [2, 8])
def test_the_first_return_is_found_in_the_water_column(staves):
    shadow = slice(0, 200)  # up to 15 m there is water
    iq = floor(0.0, ranges=WATER, P=staves, shadow=shadow, snr_db=30.0).iq.copy()
    rng = np.random.default_rng(1)
    iq[shadow] = rng.normal(size=(200, staves)) + 1j * rng.normal(size=(200, staves))
    first = coherence.first_return(coherence.coherence(iq, 0.5)[0], staves)
    assert abs(WATER[first] - 15.0) <= (0.3 if staves == 2 else 0.15)
    # Without any echo the first bin stands for it.
    for silent in (np.full(50, 0.2), np.ones(3), np.full(50, np.nan)):
        assert coherence.first_return(silent, 8) == 0


def test_an_unknown_height_is_a_normal_law_cut_at_the_first_return():
    start = UnknownHeight(mean=-20.0, std=5.0, lowest=-17.0, view=None)
    levels = (np.arange(4000) + 0.5) / 4000
    law = truncnorm((-17.0 + 20.0) / 5.0, np.inf, loc=-20.0, scale=5.0)
    assert kstest(start.quantile(levels), law.cdf).statistic < 1e-3
    # The same as angles, from 5 m below the surface to 25 m beside and below.
    angles = UnknownHeight(-20.0, 5.0, -17.0, (-5.0, 25.0, 0.5)).quantile(levels)
    assert kstest(-5.0 - 25.0 * np.sin(angles + 0.5), law.cdf).statistic < 1e-3


@pytest.mark.parametrize('model_set', ['height_two_rw', 'angle_two_rw'])
@pytest.mark.parametrize('height', [10.0, 20.0])
def test_a_wrong_height_of_the_sonar_is_survived(model_set, height):
    changes = {'pings': 2, 'ping_rate': 0.3, 'patch_along': [], 'moving': True}
    changes |= {'sonar_height': height, 'first_range': 5.0}
    told = {'sonar_height': 15.0, 'sonar_height_std': 5.0, 'model_set': model_set}
    assert worst(*run_scene('moving', changes, 2, **told)[1:]) < 0.3


def test_without_navigation_the_unknown_height_is_in_the_variance():
    sure, unsure = (run(floor(0.0), **values) for values in ({}, {'sonar_height_std': 2.0}))
    assert (unsure.covariance[:, 0, 0] > 4.0).all() and (sure.covariance[20:, 0, 0] < 0.1).all()


@pytest.mark.statistics
def test_angles_hold_the_floor_near_nadir():
    """The paper's walk cannot follow: a flat floor is called rough."""
    shares = []
    for drifts in (True, False):
        values = {'model_set': 'angle_two_rw', 'angle_drift': drifts}
        made, truths, errors = run_scene('paper', {'pings': 5, 'first_range': 15.1}, **values)
        near = truths[0].range < 20.0
        shares.append(np.mean([each.probabilities[near, 1] > 0.5 for each in made]))
        assert not drifts or worst(truths, errors) < 0.3
    assert shares[0] < 0.15 and shares[1] > 0.6
