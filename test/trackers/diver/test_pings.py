# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pings as numbers and their updates: lists against the plain forms, order, quadrature."""

from attrs import evolve
from helpers.diver_runs import arrivals
from helpers.sea_vectors import vectors
import numpy as np
from oracles.student_t import student_t_maximum
from oracles.subset_update import subset_update
import pytest

from msg_adapters.arrivals import MAX_PAIRS
from sonar_imm.acoustics.arrivals_3d import BEARING, CLOCK, observe
from sonar_imm.estimation.covariance import are_sound
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.arrivals import (
    _start_positions,
    apply_updates,
    find_optima,
    make_track_update,
    Mixture,
    PingUpdate,
    TrackUpdate,
    update_by_ping,
)
from sonar_imm.trackers.diver.explanations import PingMeasurements, subset_ping
from sonar_imm.trackers.diver.heavy_tails import student_t_ping
from sonar_imm.trackers.diver.instruments import Instruments, MOST_RECEIVERS
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.scan import ping_measurements
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

N = 14


def case(seed=0):
    """A state with all nuisances, and six numbers of four kinds, one of them wild."""
    rng = np.random.default_rng(seed)
    A = 0.3 * rng.normal(size=(N, N))
    P = A @ A.T + 0.1 * np.eye(N)
    x = np.concatenate([[31.0, -12.0, 0.5, -9.0, 0.1], 0.1 * rng.normal(size=N - 5)])
    kind = np.array([0, 1, 0, 0, 2, 3])
    rx = np.vstack([RECEIVERS, RECEIVERS[:2] + 3.0])
    tx = np.zeros((6, 3))
    columns = np.array([[0, 1, 3, 5 + 2 * (r % 3), 11, 12, 13] for r in range(6)])
    columns[kind == BEARING, CLOCK] = -1  # no error that all bearings have
    value = observe(x[:, None], 0.0, kind, columns, tx, rx)[0][:, 0]
    value = value + rng.normal(size=6) * np.where(kind < 2, 0.3, 0.01)
    value[2] += 9.0
    variance = np.where(kind < 2, 0.09, 1e-4)
    nobody = np.full(6, -1)
    numbers = PingMeasurements(
        np.arange(6), nobody, kind, value, variance, np.full(6, 0.02), tx, rx, columns
    )

    def plain(c):
        def of(state):
            one = kind[[c]], columns[[c]], tx[[c]], rx[[c]]
            h, gradient = observe(state[:, None], 0.0, *one)
            return h[0, 0], gradient[0, :, 0]

        return of, value[c], variance[c]

    return x, P, numbers, [plain(c) for c in range(6)]


@pytest.mark.parametrize('turns', [-1, 1, 3])
def test_a_bearing_is_the_same_after_a_whole_turn(turns):
    """Else a diver behind a receiver, where the bearing jumps by a turn, would be an outlier."""
    x, P, numbers, _ = case()
    turned = numbers._replace(value=numbers.value + 2.0 * np.pi * turns * (numbers.kind == 2))
    mask = np.ones(N, bool)
    for update in (
        lambda m: subset_ping(x[None], P[None], mask, 0.0, m, 0.05, 128)[:2],
        lambda m: student_t_ping(x[None], P[None], mask, 0.0, m, x[None, :2], 4.0, 0.02)[:2],
    ):
        for item, other in zip(update(numbers), update(turned)):
            np.testing.assert_allclose(other, item, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('considered', [0, 6])
def test_the_list_of_subsets_is_the_plain_update(considered):
    x, P, numbers, plain = case()
    mask = np.ones(N, bool)
    mask[5 : 5 + considered] = False
    got = subset_ping(x[None], P[None], mask, 0.0, numbers, 0.05, 128)
    want = subset_update(
        x, P, plain, outlier_probability=0.05, outlier_density=0.02, estimated=mask
    )
    np.testing.assert_allclose(got[0][0], want.x, atol=1e-10)
    np.testing.assert_allclose(got[1][0], want.P, atol=1e-10)
    assert got[2][0] == pytest.approx(want.log_evidence)
    np.testing.assert_allclose(got[3][0], want.good, atol=1e-10)
    assert got[3][0][2] < 0.05


def test_numbers_of_a_node_exclude_each_other_and_angles_follow_their_echo():
    """Two echoes of a pair, the second of which is late, and the bearing of the first."""
    x, P, numbers, _ = case()
    two = np.array([0, 2, 4])
    some = PingMeasurements(*(np.ascontiguousarray(column[two]) for column in numbers))
    some = some._replace(node=np.array([0, 0, 1]), parent=np.array([-1, -1, 0]))
    _, _, _, good = subset_ping(x[None], P[None], np.ones(N, bool), 0.0, some, 0.05, 128)
    assert good[0, 0] + good[0, 1] <= 1.0 + 1e-12
    assert good[0, 0] > 0.95 and 0.9 * good[0, 0] < good[0, 2] <= good[0, 0]


def test_too_many_explanations_keep_the_best():
    x, P, numbers, _ = case()
    mask = np.ones(N, bool)
    few = subset_ping(x[None], P[None], mask, 0.0, numbers, 0.05, 4)
    many = subset_ping(x[None], P[None], mask, 0.0, numbers, 0.05, 128)
    np.testing.assert_allclose(few[0], many[0], atol=0.05)


def test_the_heavy_tailed_list_is_the_plain_update():
    x, P, numbers, plain = case()
    P = P + np.diag(np.arange(N) == 13) * 1e6
    got = student_t_ping(x[None], P[None], np.ones(N, bool), 0.0, numbers, x[None, :2], 4.0, 0.0)
    want = student_t_maximum(x, P, plain, [x])
    np.testing.assert_allclose(got[0][0], want.x, atol=2e-3)
    inlier = 1.0 / (1.0 + (5.0 / want.weights - 4.0) / 9.0)
    np.testing.assert_allclose(got[3][0], inlier, atol=2e-3)
    assert got[1][0][0, 0] > want.P[0, 0]  # widened


def ping_of(position, receivers=RECEIVERS, tx=(0.0, 0.0, 0.0), std=2e-4, rng=None, **more):
    n = len(receivers)
    path = np.linalg.norm(position - receivers, axis=1)
    if np.isfinite(tx).all():
        path = path + np.linalg.norm(position - np.array(tx))
    noise = np.zeros(n) if rng is None else std * rng.normal(size=n)
    return arrivals(10**9, receivers, path / 1500.0 + noise, tx=tx, var_toa=std**2, **more)


@pytest.mark.parametrize('passive', [False, True])
@pytest.mark.parametrize('many', [False, True])
def test_the_order_of_arrivals_changes_no_bit(passive, many):
    rng = np.random.default_rng(3)
    receivers = np.vstack([RECEIVERS, RECEIVERS + [13.0, 7.0, 0.0]]) if many else RECEIVERS
    tx = (np.nan,) * 3 if passive else (0.0, 0.0, 0.0)
    trackers = [DiverTracker(DiverConfig(max_tracks=1)) for _ in range(2)]
    for second in range(1, 8):
        place = np.array([0.7 * second, 30.0, 0.0])
        ping = evolve(ping_of(place, receivers, tx, rng=rng), stamp_ns=second * 10**9)
        late = ping.toa.copy()
        late[second % len(late)] += 0.008 * (second > 4)
        order = rng.permutation(len(ping))
        shuffled = {
            name: getattr(ping, name)[order]
            for name in ('tx_id', 'rx_id', 'tx', 'rx', 'var_toa', 'bearing', 'var_bearing')
        }
        item = trackers[0].process(evolve(ping, toa=late))[-1]
        other = trackers[1].process(evolve(ping, toa=late[order], **shuffled))[-1]
        assert item.state.tobytes() == other.state.tobytes()
        assert item.covariance.tobytes() == other.covariance.tobytes()
        assert item.probabilities.tobytes() == other.probabilities.tobytes()
    assert np.hypot(*(item.state[0, :2] - place[:2])) < 2.0


def numbers_of(measurement, **values):
    """The config, its models and instruments, and the numbers of a ping."""
    config = DiverConfig(max_tracks=1, **values)
    models = build_models(config)
    layout = Instruments().layout(config, models)
    every = np.arange(len(measurement))
    return config, models, layout, ping_measurements(measurement, every, config, models, layout)


def begun(models, position, covariance, from_fix=True):
    """The hypotheses of a diver who is first seen."""
    x, P, mu = models.initial_states(position[None], covariance[None], from_fix)
    N, n = x[0, ..., 0].size, x.shape[-1]
    K = models.rows_per_track
    scale = np.repeat(np.resize(models.row_scales, K), N // K)
    return Mixture(x.reshape(N, n), P.reshape(N, n, n), mu.ravel() / models.rows_per_track, scale)


def test_many_good_arrivals_outvote_any_prior():
    """A track that is ten standard deviations off comes to where nine receivers hear the tag."""
    rng = np.random.default_rng(4)
    receivers = rng.uniform(-80.0, 80.0, (9, 3)) * [1.0, 1.0, 0.0]
    measurement = ping_of(np.array([20.0, 35.0, 0.0]), receivers, (np.nan,) * 3, rng=rng)
    config, models, layout, numbers = numbers_of(measurement)
    before = begun(models, np.array([-30.0, 10.0]), 25.0 * np.eye(2))
    after = update_by_ping(before, numbers, config, layout).after
    assert np.hypot(*(after.mu @ after.x[:, :2] - [20.0, 35.0])) < 1.0
    assert np.hypot(*(find_optima(numbers, config)[0] - [20.0, 35.0])) < 1.0


@pytest.mark.parametrize('std', [1.0, 1e2, 1e6, 1e9])
def test_exact_arrivals_at_twin_receivers_are_judged_whatever_was_known(std):
    """After a long silence the variances of the arrivals are lost in the rounding."""
    at, origin = np.array([20.0, 35.0, 0.0]), np.array([5e5, 6e6, 0.0])
    twins = origin + np.repeat(RECEIVERS, 2, axis=0)
    measurement = ping_of(origin + at, twins, tuple(twins[0]))
    measurement = evolve(measurement, var_toa=np.full(len(twins), 1e-30))
    config, models, layout, numbers = numbers_of(measurement)
    before = begun(models, (origin + at)[:2] + 1e-4, std**2 * np.eye(2))
    after = PingUpdate(before, np.log(before.mu), np.ones(len(numbers.row)), 0.0, 0)
    update = make_track_update(before, after, numbers, config)
    assert update.dof == len(numbers.row)
    assert 0.0 <= update.nis <= update.dof


def test_each_row_keeps_a_weight_whatever_the_arrivals_say():
    """One row e^900 times as probable as another, and one that nothing explains."""
    tracker = DiverTracker(
        DiverConfig(model_set='linear', acceleration_noise=(0.1, 0.2), dimensions=3)
    )
    tracker.process(Fix(stamp_ns=10**9, position=np.zeros(3)))
    known, log = tracker._stream.state, np.array([-1.0, -2.0, -901.0, -900.0, -np.inf, -np.inf])
    before = Mixture(*(np.zeros((6, *shape)) for shape in ((6,), (6, 6), (), ())))
    update = TrackUpdate(PingUpdate(before, log, np.ones(4), 0.0, 0), np.ones(4, bool), 0.0, 0)
    rows = apply_updates(known, {0: update}, tracker.models).rows
    np.testing.assert_allclose(rows.mu.sum(axis=1), 1.0)
    np.testing.assert_allclose(rows.mu[0, 0] / rows.mu[0, 1], np.exp(1.0))
    np.testing.assert_allclose(rows.mu[1, 0] / rows.mu[1, 1], np.exp(-1.0))
    np.testing.assert_array_equal(rows.mu[2], known.rows.mu[2])
    assert (rows.weight >= 0.99e-150).all() and rows.weight[0] == pytest.approx(1.0)


def test_wild_echoes_only_leave_the_prediction():
    measurement = ping_of(np.array([20.0, 35.0, 0.0]))
    measurement = evolve(measurement, toa=measurement.toa + [0.02, 0.03, 0.025, 0.022])
    config, models, layout, numbers = numbers_of(measurement)
    before = begun(models, np.array([20.0, 35.0]), 0.25 * np.eye(2))
    found = update_by_ping(before, numbers, config, layout)
    assert (found.good < 1e-3).all()
    np.testing.assert_allclose(found.after.x, before.x, atol=0.01)
    np.testing.assert_allclose(found.after.P, before.P, atol=0.05)


def test_the_rows_at_three_depths_are_near_the_posterior_by_quadrature():
    v = vectors('depth_one_ping')
    low, high = (float(item) for item in v['depth_range'])
    values = {'dimensions': 3, 'depth_min': low, 'depth_max': high, 'outlier_probability': 1e-6}
    sigma = float(v['sigma'])
    measurement = ping_of(v['truth'], v['rx'], tuple(v['tx']), sigma / 1500.0)
    measurement = evolve(measurement, toa=v['path'] / 1500.0)
    config, models, layout, numbers = numbers_of(measurement, **values)
    before = begun(models, v['prior_mean'], float(v['prior_var']) * np.eye(2), False)
    after = update_by_ping(before, numbers, config, layout).after
    mean = after.mu @ after.x
    spread = after.x - mean
    covariance = np.einsum('j,jab->ab', after.mu, after.P + spread[:, :, None] * spread[:, None])
    z = models.height
    assert np.abs(mean[:2] - v['out_mean']).max() < 0.2
    assert abs(mean[z] - float(v['out_z_mean'])) < 1.5
    for axis in range(2):
        assert 0.5 < covariance[axis, axis] / v['out_cov'][axis, axis] < 3.0


def test_the_same_depth_report_beside_every_arrival_is_one_measurement():
    place = np.array([20.0, 35.0, -11.0])
    beside = {'depth': np.full(4, 11.0), 'var_depth': np.full(4, 0.04)}
    beside |= {'elevation': np.full(4, -0.2), 'var_elevation': np.full(4, 1e-4)}
    numbers = numbers_of(ping_of(place, **beside), dimensions=3)[3].measured
    assert numbers.kind.tolist() == [4, 0, 3, 0, 3, 0, 3, 0, 3]
    assert numbers.value[0] == -11.0
    numbers = numbers_of(ping_of(place, **beside))[3].measured
    assert numbers.kind.tolist() == [0, 0, 0, 0]


def test_a_search_begins_on_the_ellipse_of_the_shortest_path():
    """Anywhere else the first echo is late or early by what the search has to find."""
    at, tx = np.array([60.0, 35.0, 0.0]), (-40.0, -20.0, 0.0)
    measurement = ping_of(at, RECEIVERS, tx)
    measured = numbers_of(measurement)[3].measured
    starts = _start_positions(measured, passive=False)
    first = np.argmin(measured.value)
    ways = [
        np.linalg.norm(starts - place[first, :2], axis=1) for place in (measured.tx, measured.rx)
    ]
    np.testing.assert_allclose(sum(ways), measured.value[first], rtol=1e-9)
    assert np.ptp(starts, axis=0).min() > 10.0


def test_the_state_does_not_grow_with_numbers_that_wander():
    """A receiver that gives itself a new number with every ping."""
    config = DiverConfig(receiver_position_std=0.5, receiver_clock_std=1e-4)
    models, known = build_models(config), Instruments()
    for k in range(50):
        ping = evolve(ping_of(np.array([20.0, 35.0, 0.0])), rx_id=100 + 4 * k + np.arange(4))
        known = known.with_receivers(ping, config)
    layout = known.layout(config, models)
    assert len(known.known) == MOST_RECEIVERS
    assert len(layout.mask) <= models.n + 1 + 3 * MOST_RECEIVERS
    first, last = layout.measurement_columns(
        models, np.array([101, 299]), False, np.zeros(2, bool)
    )
    assert (first != last).sum() == 2  # the errors of the last one have no place


# Hard input: very many receivers, arrays and targets in one line, fixes far better than what is
# known. Covariances stay covariances, tracks go on; time and memory: test/system/test_bounds.py.


SECOND = 10**9


def ping(rx, toa, stamp_ns=SECOND, tx=(np.nan,) * 3, var_toa=1e-9, **more):
    n = len(rx)
    columns = {'rx_id': np.arange(n), 'bearing': np.full(n, np.nan)} | more
    return arrivals(
        stamp_ns, rx, toa, tx=tx, var_toa=var_toa,
        var_bearing=np.where(np.isnan(columns['bearing']), np.nan, 0.0001), **columns,
    )  # fmt: skip


def receivers(n, rng):
    return np.column_stack([rng.uniform(-500.0, 500.0, (n, 2)), np.zeros(n)])


@pytest.mark.parametrize('tag, count', [(True, MAX_PAIRS), (False, 300)])
def test_what_very_many_receivers_hear_is_one_diver(tag, count):
    rng, place = np.random.default_rng(2), np.array([20.0, 30.0, 0.0])
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 5):
        rx = receivers(count, rng)
        path = np.linalg.norm(rx - place, axis=1) + (0.0 if tag else np.linalg.norm(place))
        tx = (np.nan,) * 3 if tag else (0.0, 0.0, 0.0)
        (estimate,) = tracker.process(ping(rx, path / 1500.0, second * SECOND, tx=tx))
    assert len(estimate) == 1
    np.testing.assert_allclose(estimate.state[0, :2], place[:2], atol=0.05)


def test_a_ping_that_no_track_takes_starts_one():
    """Two tags without a number, by turns; the second one begins when the first is known."""
    places = np.array([[40.0, 30.0, 0.0], [-60.0, -50.0, 0.0]])
    turn = np.radians(45.0) * np.arange(8)
    rx = np.column_stack([90.0 * np.cos(turn), 70.0 * np.sin(turn), np.zeros(8)])
    tracker = DiverTracker(DiverConfig())
    for second, tag in enumerate([0] * 6 + [1, 0] * 3, start=1):
        toa = np.linalg.norm(rx - places[tag], axis=1) / 1500.0
        (estimate,) = tracker.process(ping(rx, toa, second * SECOND))
        assert len(estimate) == 1 + (second > 6)
    np.testing.assert_allclose(estimate.state[:, :2], places[:, :2], atol=0.1)


def in_line(rng):
    """A line array, and a target on its line or a hair beside it."""
    n = rng.integers(2, 8)
    angle = rng.uniform(0.0, 2.0 * np.pi) * rng.integers(2)
    line = np.array([np.cos(angle), np.sin(angle)])
    along = np.arange(n) * 10.0 if rng.integers(2) else rng.uniform(-100.0, 100.0, n)
    far = rng.choice([0.0, 1e4, 1e6])
    rx = np.column_stack([along[:, None] * line + far, np.zeros(n)])
    target = np.append(rng.uniform(-300.0, 300.0) * line + far, 0.0)
    target[:2] += rng.choice([0.0, 0.0, 1e-9, 1e-3])
    leg = np.linalg.norm(rx - target, axis=1)
    tag = bool(rng.integers(2))
    toa = (leg if tag else leg + leg[0]) / 1500.0
    toa += rng.choice([0.0, 1e-7, 1e-5]) * rng.normal(size=n)
    angles = np.arctan2(*(target[:2] - rx[:, :2]).T[::-1])
    return ping(
        rx, toa, tx=(np.nan,) * 3 if tag else rx[0], var_toa=10.0 ** rng.uniform(-18.0, -8.0),
        bearing=angles if rng.random() < 0.3 else np.full(n, np.nan),
    )  # fmt: skip


def test_a_target_on_the_line_of_a_line_array_breaks_nothing():
    rng = np.random.default_rng(0)
    tracker = DiverTracker(DiverConfig())
    for second in range(1, 151):
        tracker.process(evolve(in_line(rng), stamp_ns=second * SECOND))
    assert tracker.health()['broken_tracks'] == 0


SETS = [('families', ()), ('heading_speed', ()), ('linear', (1e-4,)), ('linear', (0.0, 0.1, 0.1))]


def sharp_fixes(seed, count=12):
    """Fixes whose covariances span sixteen decades, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp = 10**9
    for k in range(count):
        root = rng.normal(size=(2, 2)) * 10.0 ** rng.uniform(-8, 0, size=2)
        covariance = root @ root.T
        yield Fix(
            stamp_ns=stamp,
            position=np.array([0.5 * k + rng.normal(0.0, 0.01), 0.0, 0.0]),
            covariance=covariance + 2e-12 * np.trace(covariance) * np.eye(2),
        )
        stamp += int(10 ** rng.uniform(0.0, 9.3))


def config(model_set, noise, seed=0):
    return DiverConfig(
        model_set=model_set, covariance_scale=(1e-4, 1e-2, 1.0)[seed % 3], adaptation='fixed',
        velocity_std=20.0, acceleration_noise=noise,
    )  # fmt: skip


def all_sound(known):
    return all(are_sound(np.moveaxis(P, 0, 2)).all() for _, P in known.rows.blocks)


def least_eigenvalue(covariance):
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return np.linalg.eigvalsh(covariance / (scale[..., :, None] * scale[..., None, :]))[..., 0]


@pytest.mark.parametrize('model_set, noise', SETS)
def test_covariances_stay_positive_definite(model_set, noise):
    """Before, a correlation had an eigenvalue of -.16 for one linear model."""
    repairs = 0
    for seed in range(6):
        tracker = DiverTracker(config(model_set, noise, seed))
        for fix in sharp_fixes(seed):
            for estimate in tracker.process(fix):
                assert np.isfinite(estimate.state).all()
                assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
                np.testing.assert_allclose(estimate.probabilities.sum(axis=1), 1.0, rtol=1e-12)
            assert all_sound(tracker._stream.state)
        health = tracker.health()
        assert health['broken_tracks'] == 0
        repairs += health['covariance_repairs']
    if len(noise) > 1:
        assert repairs > 0


def test_ordinary_fixes_need_no_repair():
    tracker = DiverTracker(DiverConfig())
    for k in range(30):
        tracker.process(Fix(stamp_ns=(k + 1) * 10**9, position=np.array([0.4 * k, 0.0, 0.0])))
    assert tracker.health()['covariance_repairs'] == 0


OFF = {'receiver_position_std': 1.0, 'receiver_clock_std': 5e-4, 'sound_speed_std': 5.0}


def sharp_pings(seed, passive, count=12):
    """Pings whose arrival times are good to 1e-11 s and worse, nanoseconds to seconds apart."""
    rng = np.random.default_rng(seed)
    stamp, tx = 10**9, np.full(3, np.nan) if passive else np.zeros(3)
    for k in range(count):
        diver = np.array([5.0 + 0.5 * k, 30.0, -6.0])
        path = np.linalg.norm(diver - RECEIVERS, axis=1)
        path += 0.0 if passive else np.linalg.norm(diver)
        variance = 10.0 ** rng.uniform(-22, -7, size=4)
        yield arrivals(
            stamp, RECEIVERS, path / 1500.0 + np.sqrt(variance) * rng.normal(size=4), tx=tx,
            var_toa=variance,
        )  # fmt: skip
        stamp += int(10 ** rng.uniform(0.0, 9.3))


@pytest.mark.statistics
@pytest.mark.parametrize('passive', [False, True])
@pytest.mark.parametrize(
    'parameters',
    [{}, {'dimensions': 3}, OFF, {**OFF, 'systematic_errors': 'estimate', 'dimensions': 3}],
)
def test_covariances_stay_sound_after_sharp_pings(parameters, passive):
    """Before, a correlation had an eigenvalue of -7, and tracks of misplaced receivers broke."""
    for seed in range(3):
        tracker = DiverTracker(DiverConfig(max_tracks=1, **parameters))
        for ping in sharp_pings(seed, passive):
            for estimate in tracker.process(ping):
                assert np.isfinite(estimate.state).all()
                assert (least_eigenvalue(estimate.covariance) > -1e-14).all()
            assert all_sound(tracker._stream.state)
        assert tracker.health()['broken_tracks'] == 0
