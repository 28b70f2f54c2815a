# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pings as numbers and their updates: lists against the plain forms, order, quadrature; ranges one
at a time."""

from attrs import evolve
from helpers.diver_runs import arrivals, both_sides, followed, miss, numbers_of, SECOND
from helpers.vector_files import vectors
import numpy as np
from oracles.robust import student_t_maximum, subset_update
import pytest
from scipy.optimize import least_squares

from msg_adapters.arrivals import MAX_PAIRS
from sonar_imm.acoustics.arrivals_3d import BEARING, CLOCK, observe
from sonar_imm.estimation.covariance import are_sound
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver import arrivals as hearing
from sonar_imm.trackers.diver import ranges, sides
from sonar_imm.trackers.diver.arrivals import Mixture, PingUpdate, update_by_ping
from sonar_imm.trackers.diver.explanations import PingMeasurements, subset_ping
from sonar_imm.trackers.diver.heavy_tails import student_t_ping
from sonar_imm.trackers.diver.instruments import Instruments, MOST_RECEIVERS
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

N = 14


EVERY = np.ones(N, bool)


def case():
    """A state with all nuisances, and six numbers of four kinds, one of them wild."""
    rng = np.random.default_rng(0)
    A = 0.3 * rng.normal(size=(N, N))
    P = A @ A.T + 0.1 * np.eye(N)
    x = np.concatenate([[31.0, -12.0, 0.5, -9.0, 0.1], 0.1 * rng.normal(size=N - 5)])
    kind = np.array([0, 1, 0, 0, 2, 3])
    rx, tx = np.vstack([RECEIVERS, RECEIVERS[:2] + 3.0]), np.zeros((6, 3))
    columns = np.array([[0, 1, 3, 5 + 2 * (r % 3), 11, 12, 13] for r in range(6)])
    columns[kind == BEARING, CLOCK] = -1  # no error that all bearings have
    value = observe(x[:, None], 0.0, kind, columns, tx, rx)[0][:, 0]
    value = value + rng.normal(size=6) * np.where(kind < 2, 0.3, 0.01)
    value[2] += 9.0
    parts = kind, value, np.where(kind < 2, 0.09, 1e-4), np.full(6, 0.02), tx, rx, columns
    return x, P, PingMeasurements(np.arange(6), np.full(6, -1), *parts)


def plain(numbers):
    """The numbers as functions, values and variances, as the oracles take them."""

    def of(c):
        one = [getattr(numbers, name)[[c]] for name in ('kind', 'columns', 'tx', 'rx')]

        def expected(state):
            h, gradient = observe(state[:, None], 0.0, *one)
            return h[0, 0], gradient[0, :, 0]

        return expected, numbers.value[c], numbers.variance[c]

    return [of(c) for c in range(6)]


def subsets(x, P, numbers, mask=EVERY, most=128):
    return subset_ping(x[None], P[None], mask, 0.0, numbers, 0.05, most)


def heavy(x, P, numbers, wild=0.02):
    return student_t_ping(x[None], P[None], EVERY, 0.0, numbers, x[None, :2], 4.0, wild)


@pytest.mark.parametrize('turns', [-1, 3])
def test_a_bearing_is_the_same_after_a_whole_turn(turns):
    """Else a diver behind a receiver, where the bearing jumps by a turn, would be an outlier."""
    x, P, numbers = case()
    turned = numbers._replace(value=numbers.value + 2.0 * np.pi * turns * (numbers.kind == 2))
    for update in (subsets, heavy):
        for item, other in zip(update(x, P, numbers)[:2], update(x, P, turned)[:2]):
            np.testing.assert_allclose(other, item, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('considered', [0, 6])
def test_the_list_of_subsets_is_the_plain_update(considered):
    x, P, numbers = case()
    mask = EVERY & ~np.isin(np.arange(N), 5 + np.arange(considered))
    known = {'outlier_probability': 0.05, 'outlier_density': 0.02, 'estimated': mask}
    want, got = subset_update(x, P, plain(numbers), **known), subsets(x, P, numbers, mask)
    for found, due in zip(got, (want.x, want.P, want.log_evidence, want.good)):
        np.testing.assert_allclose(found[0], due, rtol=1e-6, atol=1e-10)
    assert got[3][0][2] < 0.05


def test_numbers_of_a_node_exclude_each_other_and_angles_follow_their_echo():
    """Two echoes of a pair, the second of which is late, and the bearing of the first."""
    x, P, numbers = case()
    some = PingMeasurements(*(np.ascontiguousarray(column[[0, 2, 4]]) for column in numbers))
    some = some._replace(node=np.array([0, 0, 1]), parent=np.array([-1, -1, 0]))
    (good,) = subsets(x, P, some)[3]
    assert good[0] + good[1] <= 1.0 + 1e-12
    assert good[0] > 0.95 and 0.9 * good[0] < good[2] <= good[0]


def test_too_many_explanations_keep_the_best():
    few, many = (subsets(*case(), most=most)[0] for most in (4, 128))
    np.testing.assert_allclose(few, many, atol=0.05)


def test_the_heavy_tailed_list_is_the_plain_update():
    x, P, numbers = case()
    P = P + np.diag(np.arange(N) == 13) * 1e6
    got, want = heavy(x, P, numbers, 0.0), student_t_maximum(x, P, plain(numbers), [x])
    np.testing.assert_allclose(got[0][0], want.x, atol=2e-3)
    inlier = 1.0 / (1.0 + (5.0 / want.weights - 4.0) / 9.0)
    np.testing.assert_allclose(got[3][0], inlier, atol=2e-3)
    assert got[1][0][0, 0] > want.P[0, 0]  # widened


AT = np.array([20.0, 35.0, 0.0])


PASSIVE = (np.nan,) * 3


def ping_of(position, receivers=RECEIVERS, tx=(0.0, 0.0, 0.0), std=2e-4, rng=None, **more):
    path = np.linalg.norm(position - receivers, axis=1)
    if np.isfinite(tx).all():
        path = path + np.linalg.norm(position - np.array(tx))
    toa = path / 1500.0 + (0.0 if rng is None else std * rng.normal(size=len(receivers)))
    return arrivals(SECOND, receivers, toa, **{'tx': tx, 'var_toa': std**2, **more})


@pytest.mark.parametrize('passive, many', [(True, False), (False, True)])
def test_the_order_of_arrivals_changes_no_bit(passive, many):
    rng = np.random.default_rng(3)
    receivers = np.vstack([RECEIVERS, RECEIVERS + [13.0, 7.0, 0.0]]) if many else RECEIVERS
    trackers = [DiverTracker(DiverConfig(max_tracks=1)) for _ in range(2)]
    columns = 'tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing'
    for second in range(1, 8):
        place = np.array([0.7 * second, 30.0, 0.0])
        ping = ping_of(place, receivers, PASSIVE if passive else (0.0, 0.0, 0.0), rng=rng)
        late = 0.008 * (second > 4) * (np.arange(len(ping)) == second % len(ping))
        ping = evolve(ping, stamp_ns=second * SECOND, toa=ping.toa + late)
        order = rng.permutation(len(ping))
        other = evolve(ping, **{name: getattr(ping, name)[order] for name in columns})
        first, second = (each.process(it)[-1] for each, it in zip(trackers, (ping, other)))
        for name in ('state', 'covariance', 'probabilities'):
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert np.hypot(*(first.state[0, :2] - place[:2])) < 2.0


def numbered(measurement, **values):
    config = DiverConfig(max_tracks=1, **values)
    models = build_models(config)
    layout = Instruments().layout(config, models)
    return config, models, layout, numbers_of(measurement, config, models, layout)


def begun(models, position, variance, from_fix=True):
    x, P, mu = models.initial_states(position[None], variance * np.eye(2)[None], from_fix)
    N, n, K = x[0, ..., 0].size, x.shape[-1], models.rows_per_track
    scale = np.repeat(np.resize(models.row_scales, K), N // K)
    return Mixture(x.reshape(N, n), P.reshape(N, n, n), mu.ravel() / K, scale)


def test_many_good_arrivals_outvote_any_prior():
    rng = np.random.default_rng(4)
    receivers = rng.uniform(-80.0, 80.0, (9, 3)) * [1.0, 1.0, 0.0]
    config, models, layout, numbers = numbered(ping_of(AT, receivers, PASSIVE, rng=rng))
    before = begun(models, np.array([-30.0, 10.0]), 25.0)
    after = update_by_ping(before, numbers, config, layout).after
    assert np.hypot(*(after.mu @ after.x[:, :2] - AT[:2])) < 1.0
    assert np.hypot(*(hearing.find_optima(numbers, config)[0] - AT[:2])) < 1.0


@pytest.mark.parametrize('std', [1.0, 1e2, 1e6, 1e9])
def test_exact_arrivals_at_twin_receivers_are_judged_whatever_was_known(std):
    """After a long silence the variances of the arrivals are lost in the rounding."""
    origin = np.array([5e5, 6e6, 0.0])
    twins = origin + np.repeat(RECEIVERS, 2, axis=0)
    measurement = ping_of(origin + AT, twins, tuple(twins[0]), var_toa=1e-30)
    config, models, layout, numbers = numbered(measurement)
    before = begun(models, (origin + AT)[:2] + 1e-4, std**2)
    after = PingUpdate(before, np.log(before.mu), np.ones(len(numbers.row)), 0.0, 0)
    update = hearing.make_track_update(before, after, numbers, config)
    assert update.dof == len(numbers.row)
    assert 0.0 <= update.nis <= update.dof


def test_each_row_keeps_a_weight_whatever_the_arrivals_say():
    """One row e^900 times as probable as another, and one that nothing explains."""
    settings = {'model_set': 'linear', 'acceleration_noise': (0.1, 0.2), 'dimensions': 3}
    tracker = DiverTracker(DiverConfig(**settings))
    tracker.process(Fix(stamp_ns=SECOND, position=np.zeros(3)))
    known, log = tracker._stream.state, np.array([-1.0, -2.0, -901.0, -900.0, -np.inf, -np.inf])
    before = Mixture(*(np.zeros((6, *shape)) for shape in ((6,), (6, 6), (), ())))
    made = PingUpdate(before, log, np.ones(4), 0.0, 0)
    update = hearing.TrackUpdate(made, np.ones(4, bool), 0.0, 0)
    rows = hearing.apply_updates(known, {0: update}, tracker.models).rows
    np.testing.assert_allclose(rows.mu.sum(axis=1), 1.0)
    np.testing.assert_allclose(rows.mu[:2, 0] / rows.mu[:2, 1], np.exp([1.0, -1.0]))
    np.testing.assert_array_equal(rows.mu[2], known.rows.mu[2])
    assert (rows.weight >= 0.99e-150).all() and rows.weight[0] == pytest.approx(1.0)


def test_wild_echoes_only_leave_the_prediction():
    measurement = ping_of(AT)
    measurement = evolve(measurement, toa=measurement.toa + [0.02, 0.03, 0.025, 0.022])
    config, models, layout, numbers = numbered(measurement)
    before = begun(models, AT[:2], 0.25)
    found = update_by_ping(before, numbers, config, layout)
    assert (found.good < 1e-3).all()
    np.testing.assert_allclose(found.after.x, before.x, atol=0.01)
    np.testing.assert_allclose(found.after.P, before.P, atol=0.05)


def test_the_rows_at_three_depths_are_near_the_posterior_by_quadrature():
    v = vectors('depth_one_ping')
    low, high = (float(item) for item in v['depth_range'])
    values = {'dimensions': 3, 'depth_min': low, 'depth_max': high, 'outlier_probability': 1e-6}
    measurement = ping_of(v['truth'], v['rx'], tuple(v['tx']), float(v['sigma']) / 1500.0)
    measurement = evolve(measurement, toa=v['path'] / 1500.0)
    config, models, layout, numbers = numbered(measurement, **values)
    before = begun(models, v['prior_mean'], float(v['prior_var']), False)
    after = update_by_ping(before, numbers, config, layout).after
    mean = after.mu @ after.x
    spread = after.x - mean
    covariance = np.einsum('j,jab->ab', after.mu, after.P + spread[:, :, None] * spread[:, None])
    assert np.abs(mean[:2] - v['out_mean']).max() < 0.2
    assert abs(mean[models.height] - float(v['out_z_mean'])) < 1.5
    ratio = np.diag(covariance)[:2] / np.diag(v['out_cov'])[:2]
    assert (ratio > 0.5).all() and (ratio < 3.0).all()


def test_the_same_depth_report_beside_every_arrival_is_one_measurement():
    place = np.array([20.0, 35.0, -11.0])
    beside = {'depth': np.full(4, 11.0), 'var_depth': np.full(4, 0.04)}
    beside |= {'elevation': np.full(4, -0.2), 'var_elevation': np.full(4, 1e-4)}
    numbers = numbered(ping_of(place, **beside), dimensions=3)[3].measured
    assert numbers.kind.tolist() == [4, 0, 3, 0, 3, 0, 3, 0, 3]
    assert numbers.value[0] == -11.0
    assert numbered(ping_of(place, **beside))[3].measured.kind.tolist() == [0] * 4


def test_a_search_begins_on_the_ellipse_of_the_shortest_path():
    """Anywhere else the first echo is late or early by what the search has to find."""
    at, tx = np.array([60.0, 35.0, 0.0]), (-40.0, -20.0, 0.0)
    measured = numbered(ping_of(at, RECEIVERS, tx))[3].measured
    starts = hearing._start_positions(measured, passive=False)
    first = np.argmin(measured.value)
    ends = np.stack([measured.tx[first, :2], measured.rx[first, :2]])[:, None]
    ways = np.linalg.norm(starts - ends, axis=2).sum(axis=0)
    np.testing.assert_allclose(ways, measured.value[first], rtol=1e-9)
    assert np.ptp(starts, axis=0).min() > 10.0


def test_the_state_does_not_grow_with_numbers_that_wander():
    """A receiver that gives itself a new number with every ping."""
    config = DiverConfig(receiver_position_std=0.5, receiver_clock_std=1e-4)
    models, known = build_models(config), Instruments()
    for k in range(50):
        ping = ping_of(AT, rx_id=100 + 4 * k + np.arange(4))
        known = known.with_receivers(ping, config)
    layout, nobody = known.layout(config, models), np.zeros(2, bool)
    assert len(known.known) == MOST_RECEIVERS
    assert len(layout.mask) <= models.n + 1 + 3 * MOST_RECEIVERS
    first, last = layout.measurement_columns(models, np.array([101, 299]), False, nobody)
    assert (first != last).sum() == 2  # the errors of the last one have no place


@pytest.mark.parametrize('tag, count', [(True, MAX_PAIRS), (False, 300)])
def test_what_very_many_receivers_hear_is_one_diver(tag, count):
    rng, pings = np.random.default_rng(2), []
    for second in range(1, 5):
        rx = np.column_stack([rng.uniform(-500.0, 500.0, (count, 2)), np.zeros(count)])
        ping = ping_of(AT, rx, PASSIVE if tag else (0.0, 0.0, 0.0), var_toa=1e-9)
        pings.append(evolve(ping, stamp_ns=second * SECOND))
    *_, estimate = followed(DiverTracker(DiverConfig()), pings)
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], AT[:2], atol=0.05)


def test_a_ping_that_no_track_takes_starts_one():
    """Two tags without a number, by turns; the second one begins when the first is known."""
    places = np.array([[40.0, 30.0, 0.0], [-60.0, -50.0, 0.0]])
    turn = np.radians(45.0) * np.arange(8)
    rx = np.column_stack([90.0 * np.cos(turn), 70.0 * np.sin(turn), np.zeros(8)])
    tracker = DiverTracker(DiverConfig())
    for second, tag in enumerate([0] * 6 + [1, 0] * 3, start=1):
        ping = ping_of(places[tag], rx, PASSIVE, var_toa=1e-9)
        (estimate,) = tracker.process(evolve(ping, stamp_ns=second * SECOND))
        assert len(estimate) == 1 + (second > 6)
    np.testing.assert_allclose(estimate.state[:, :2], places[:, :2], atol=0.1)


def in_line(rng, second):
    """A ping at a line array of a target on its line or a hair beside it."""
    n = rng.integers(2, 8)
    angle = rng.uniform(0.0, 2.0 * np.pi) * rng.integers(2)
    line = np.array([np.cos(angle), np.sin(angle)])
    along = np.arange(n) * 10.0 if rng.integers(2) else rng.uniform(-100.0, 100.0, n)
    far = rng.choice([0.0, 1e4, 1e6])
    rx = np.column_stack([along[:, None] * line + far, np.zeros(n)])
    target = np.append(rng.uniform(-300.0, 300.0) * line + far, 0.0)
    target[:2] += rng.choice([0.0, 0.0, 1e-9, 1e-3])
    known = {'tx': PASSIVE if rng.integers(2) else rx[0], 'var_bearing': 1e-4}
    known |= {'var_toa': 10.0 ** rng.uniform(-18.0, -8.0)}
    if rng.random() < 0.3:
        known['bearing'] = np.arctan2(*(target[:2] - rx[:, :2]).T[::-1])
    ping = ping_of(target, rx, std=rng.choice([0.0, 1e-7, 1e-5]), rng=rng, **known)
    return evolve(ping, stamp_ns=second * SECOND)


def test_a_target_on_the_line_of_a_line_array_breaks_nothing():
    rng = np.random.default_rng(0)
    tracker = DiverTracker(DiverConfig())
    followed(tracker, [in_line(rng, second) for second in range(1, 151)])
    assert tracker.health()['broken_tracks'] == 0


SETS = [('families', ()), ('heading_speed', ()), ('linear', (1e-4,)), ('linear', (0.0, 0.1, 0.1))]


def sharp_fixes(seed):
    """Fixes whose covariances span sixteen decades, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp = SECOND
    for k in range(12):
        root = rng.normal(size=(2, 2)) * 10.0 ** rng.uniform(-8, 0, size=2)
        covariance = root @ root.T
        covariance += 2e-12 * np.trace(covariance) * np.eye(2)
        place = np.array([0.5 * k + rng.normal(0.0, 0.01), 0.0, 0.0])
        yield Fix(stamp_ns=stamp, position=place, covariance=covariance)
        stamp += int(10 ** rng.uniform(0.0, 9.3))


def check_sound(tracker, measurements):
    """The estimates stay finite, and all covariances positive definite."""
    for measurement in measurements:
        for estimate in tracker.process(measurement):
            assert np.isfinite(estimate.state).all()
            assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
            np.testing.assert_allclose(estimate.probabilities.sum(axis=1), 1.0, rtol=1e-12)
        blocks = tracker._stream.state.rows.blocks
        assert all(are_sound(np.moveaxis(P, 0, 2)).all() for _, P in blocks)
    assert tracker.health()['broken_tracks'] == 0


def least_eigenvalue(covariance):
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return np.linalg.eigvalsh(covariance / (scale[..., :, None] * scale[..., None, :]))[..., 0]


@pytest.mark.parametrize('model_set, noise', SETS)
def test_covariances_stay_positive_definite(model_set, noise):
    """Before, a correlation had an eigenvalue of -.16 for one linear model."""
    repairs, known = 0, {'model_set': model_set, 'acceleration_noise': noise}
    for seed in range(6):
        known['covariance_scale'] = (1e-4, 1e-2, 1.0)[seed % 3]
        tracker = DiverTracker(DiverConfig(**known, adaptation='fixed', velocity_std=20.0))
        check_sound(tracker, sharp_fixes(seed))
        repairs += tracker.health()['covariance_repairs']
    assert repairs > 0 or len(noise) < 2


def test_ordinary_fixes_need_no_repair():
    tracker = DiverTracker(DiverConfig())
    fixes = (Fix(stamp_ns=k * SECOND, position=[0.4 * k, 0.0, 0.0]) for k in range(1, 31))
    followed(tracker, fixes)
    assert tracker.health()['covariance_repairs'] == 0


OFF = {'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4, 'sound_speed_std': 5.0}


def sharp_pings(seed, passive):
    """Pings whose arrival times are good to 1e-11 s and worse, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp, tx = SECOND, PASSIVE if passive else (0.0, 0.0, 0.0)
    for k in range(12):
        std = np.sqrt(10.0 ** rng.uniform(-22, -7, size=4))
        ping = ping_of(np.array([5.0 + 0.5 * k, 30.0, -6.0]), tx=tx, std=std, rng=rng)
        yield evolve(ping, stamp_ns=stamp)
        stamp += int(10 ** rng.uniform(0.0, 9.3))


BLURRED = {**OFF, 'systematic_errors': 'estimate', 'dimensions': 3}


@pytest.mark.statistics
@pytest.mark.parametrize('passive', [False, True])
@pytest.mark.parametrize('parameters', [{}, {'dimensions': 3}, OFF, BLURRED])
def test_covariances_stay_sound_after_sharp_pings(parameters, passive):
    """Before, a correlation had an eigenvalue of -7, and tracks of misplaced receivers broke."""
    for seed in range(3):
        tracker = DiverTracker(DiverConfig(max_tracks=1, **parameters))
        check_sound(tracker, sharp_pings(seed, passive))


BUOYS = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
START, SWUM, STD = np.array([-20.0, 15.0]), np.array([0.5, -0.3]), 0.5


def single(second, place, target, rng, std=STD):
    at = np.append(place, 0.0)[None]
    path = 2.0 * np.linalg.norm(np.append(target, 0.0) - at) + 2.0 * std * rng.normal()
    return arrivals(
        round(second * SECOND), at, np.array([path / 1500.0]), tx_id=np.ones(1), rx_id=np.zeros(1),
        tx=at, var_toa=(2.0 * std / 1500.0) ** 2,
    )  # fmt: skip


def swim(place_of, steps, swum=SWUM, **config):
    rng, tracker = np.random.default_rng(1), DiverTracker(DiverConfig(**config))
    targets = START + np.arange(1, steps + 1)[:, None] * swum
    pings = [single(k + 1, place_of(k + 1), at, rng) for k, at in enumerate(targets)]
    return tracker, followed(tracker, pings), targets


@pytest.mark.parametrize('model_set', ['families', 'heading_speed'])
def test_four_buoys_in_turn_begin_a_track_after_five_pings_and_no_other(model_set):
    tracker, estimates, targets = swim(lambda s: BUOYS[s % 4], 60, model_set=model_set)
    assert [len(estimate) for estimate in estimates[:5]] == [0, 0, 0, 0, 1]
    off, nees = np.array([miss(*pair) for pair in zip(estimates[8:], targets[8:])]).T
    assert nees.max() < 14.0 and off[-1] < 2.0
    assert {tuple(each.extras['track_id']) for each in estimates[6:]} == {(1,)}
    assert estimates[-1].extras['track_state'].tolist() == [1]
    assert np.isnan(estimates[-1].extras['side_probability'][0]) and not tracker.warnings()


def test_a_ship_on_a_circle_finds_a_target():
    def circled(second):
        angle = 2.0 * np.pi * second / 60.0
        return 50.0 * np.array([np.cos(angle), np.sin(angle)])

    _, estimates, targets = swim(circled, 90, swum=np.zeros(2))
    assert miss(estimates[-1], targets[-1])[0] < 3.0


def test_one_place_begins_no_track_and_says_so():
    tracker, estimates, _ = swim(lambda s: np.zeros(2), 30)
    assert not any(len(estimate) for estimate in estimates)
    assert tracker.warnings() == [ranges.NO_TRACK]


def test_ranges_from_a_line_have_two_sides():
    def on_a_line(second):
        return np.array([40.0 * ((second % 3) - 1.0) - 10.0, -30.0])

    tracker, (*_, estimate), targets = swim(on_a_line, 40)
    assert len(estimate) == 1 and sides.NOT_TOLD in tracker.warnings()
    assert estimate.extras['side_probability'][0] == pytest.approx(0.5, abs=1e-6)
    image, other = both_sides(estimate)
    assert min(np.hypot(*(side - targets[-1])) for side in (image, other)) < 2.0
    np.testing.assert_allclose(image * [1.0, -1.0] - [0.0, 60.0], other, atol=0.5)


def problem(rng, acceleration=0.0, count=9):
    time = np.arange(count) - (count - 1.0)
    at = np.column_stack([BUOYS[np.arange(count) % 4], np.zeros(count)])
    target = START + time[:, None] * SWUM
    path = 2.0 * np.hypot(*(target - at[:, :2]).T) + 2.0 * STD * rng.normal(size=count)
    variance = np.full(count, 4.0 * STD**2)
    return ranges.Problem(time, at, at, path, variance, 0.0, 0.7, acceleration)


def test_the_fit_is_that_of_another_solver():
    given = problem(np.random.default_rng(4))
    fit = ranges.fit_ranges(given, None)

    def residuals(x):
        place = x[:2] + given.time[:, None] * x[2:]
        expected = 2.0 * np.hypot(*(place - given.tx[:, :2]).T)
        prior = x[2:] / given.velocity_std
        return np.append((given.path - expected) / np.sqrt(given.variance), prior)

    found = least_squares(residuals, np.append(START, SWUM), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(fit.x[0], found.x, atol=1e-3)
    np.testing.assert_allclose(fit.P[0], np.linalg.inv(found.jac.T @ found.jac), rtol=1e-2)
    assert fit.weight.tolist() == [1.0]


def test_accelerations_are_in_the_covariance_of_the_fit():
    """The error of the last position, of targets that turn as assumed."""
    rng, squared = np.random.default_rng(7), []
    for _ in range(120):
        given = problem(rng, acceleration=0.05, count=12)
        # An integrated random walk backwards from the last range.
        steps = 100
        fine = rng.normal(size=(11 * steps, 2)) * np.sqrt(0.05 / steps)
        velocity = np.cumsum(fine, axis=0)
        way = np.vstack([np.zeros(2), np.cumsum(velocity, axis=0) / steps])[::steps][::-1]
        place = START + given.time[:, None] * SWUM + way
        noise = 2.0 * STD * rng.normal(size=12)
        path = 2.0 * np.hypot(*(place - given.tx[:, :2]).T) + noise
        fit = ranges.fit_ranges(given._replace(path=path), None)
        if fit is not None:
            error = fit.x[0, :2] - START
            squared.append(error @ np.linalg.solve(fit.P[0, :2, :2], error))
    assert len(squared) > 100
    assert np.mean(squared) == pytest.approx(2.0, abs=0.55)


def test_ranges_that_fit_no_target_begin_no_track():
    given = problem(np.random.default_rng(4))
    wild = given._replace(path=given.path + 30.0 * np.random.default_rng(5).normal(size=9))
    assert ranges.fit_ranges(wild, None) is None
