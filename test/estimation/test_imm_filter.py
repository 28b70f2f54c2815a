# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The ready filter against FilterPy and Stone Soup, closed forms and its own parts."""

from datetime import datetime

from filterpy.kalman import IMMEstimator, KalmanFilter
import numpy as np
import pytest
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from sonar_imm import (
    ca,
    ct,
    cv,
    hover,
    IMM,
    MeasurementModel,
    Model,
    Motion,
    position,
    range_bearing,
)
from sonar_imm.estimation.markov import RateChain
from sonar_imm.estimation.motion import turning, white_acceleration

T = np.array([[0.95, 0.05], [0.2, 0.8]])  # asymmetric: a transposed matrix would show
START = {'mean': [50.0, 10.0, 0.5, 1.0], 'covariance': np.diag([9.0, 9.0, 1.0, 1.0])}
MODELS = [cv(noise=0.05), ct(noise=0.2, turn_rate=0.15)]


def walk(steps=60):
    """Positions (steps, 2) of a walker who turns half way, with the state after each."""
    rng = np.random.default_rng(3)
    x, truth = np.array([50.0, 10.0, 0.5, 1.0]), []
    for k in range(steps):
        x = turning(0.15 * (k >= steps // 2), 1.0) @ x
        truth.append(x)
    truth = np.array(truth)
    return truth[:, :2] + rng.normal(0.0, 1.0, (steps, 2)), truth


def filterpy_imm():
    filters = []
    for rate, noise in ((0.0, 0.05), (0.15, 0.2)):
        kf = KalmanFilter(dim_x=4, dim_z=2)
        kf.x, kf.P = np.array(START['mean']), START['covariance'].copy()
        kf.F, kf.Q = turning(rate, 1.0), white_acceleration(noise**2, rate, 1.0)
        kf.H, kf.R = np.eye(2, 4), np.eye(2)
        filters.append(kf)
    return IMMEstimator(filters, np.array([0.5, 0.5]), T)


def test_equals_filterpy_on_an_asymmetric_chain():
    imm, peer = IMM(MODELS, T, **START, measurement=position(1.0)), filterpy_imm()
    for z in walk()[0]:
        imm.step(z)
        peer.predict()
        peer.update(z)
        assert imm.estimate.mean == pytest.approx(peer.x, rel=1e-11, abs=1e-11)
        assert imm.estimate.covariance == pytest.approx(peer.P, rel=1e-10, abs=1e-11)
        assert imm.model_probabilities == pytest.approx(peer.mu, rel=1e-10, abs=1e-12)


class StoneSoupIMM:
    """Stone Soup has no IMM: its extended filter as the members of one written with loops."""

    def __init__(self, sensor):
        self.updater, self.mu = ExtendedKalmanUpdater(sensor), np.array([0.5, 0.5])
        self.x = [np.array(START['mean'])] * 2
        self.P = [START['covariance']] * 2

    def step(self, z):
        c, mixed = self.mu @ T, []
        for j in range(2):
            w = T[:, j] * self.mu / c[j]
            x = w[0] * self.x[0] + w[1] * self.x[1]
            P = sum(w[i] * (self.P[i] + np.outer(self.x[i] - x, self.x[i] - x)) for i in range(2))
            mixed.append((x, P))
        weight = np.empty(2)
        for j, (rate, noise) in enumerate(((0.0, 0.05), (0.15, 0.2))):
            F, Q = turning(rate, 1.0), white_acceleration(noise**2, rate, 1.0)
            x, P = F @ mixed[j][0], F @ mixed[j][1] @ F.T + Q
            when = datetime(2026, 1, 1)
            predicted = GaussianStatePrediction(x[:, None], P, timestamp=when)
            seen = Detection(np.array([[z[1]], [z[0]]]), timestamp=when)
            expected = self.updater.predict_measurement(predicted)
            after = self.updater.update(SingleHypothesis(predicted, seen, expected))
            off = np.array([z[1], z[0]]) - np.ravel(expected.state_vector).astype(float)
            off[0] = (off[0] + np.pi) % (2.0 * np.pi) - np.pi
            S = np.asarray(expected.covar, float)
            weight[j] = c[j] * np.exp(-0.5 * off @ np.linalg.solve(S, off))
            weight[j] /= np.sqrt(np.linalg.det(S))
            self.x[j] = np.ravel(after.state_vector).astype(float)
            self.P[j] = np.asarray(after.covar, float)
        self.mu = weight / weight.sum()


class ExactSlopes(CartesianToBearingRange):
    """Stone Soup's Jacobian is by differences, which leave eight digits."""

    def jacobian(self, state, **_):
        dx, dy = np.ravel(state.state_vector)[:2].astype(float) - np.ravel(self.translation_offset)
        r = np.hypot(dx, dy)
        return np.array([[-dy / r**2, dx / r**2, 0.0, 0.0], [dx / r, dy / r, 0.0, 0.0]])


def test_equals_an_imm_of_stone_soups_extended_filters():
    """Range and bearing across the cut at 180 degrees."""
    at = (110.0, 30.0)
    noise, place = np.diag([0.01**2, 1.0]), np.array(at)[:, None]
    sensor = ExactSlopes(4, (0, 1), noise, translation_offset=place)
    imm = IMM(MODELS, T, **START, measurement=range_bearing(1.0, 0.01, at))
    peer, rng = StoneSoupIMM(sensor), np.random.default_rng(1)
    bearings = []
    for x in walk()[1]:
        off = x[:2] - at
        z = [np.hypot(*off), np.arctan2(off[1], off[0])] + rng.normal(0.0, [1.0, 0.01])
        bearings.append(z[1])
        imm.step(z)
        peer.step(z)
        mean = peer.mu @ np.array(peer.x)
        assert imm.estimate.mean == pytest.approx(mean, rel=1e-10, abs=1e-10)
        assert imm.model_probabilities == pytest.approx(peer.mu, rel=1e-10)
    assert max(bearings) > 3.0 and min(bearings) < -3.0


def test_a_jacobian_by_differences_is_the_one_stated():
    sensor = range_bearing(1.0, 0.01)
    plain = MeasurementModel(sensor.h, sensor.R, angles=(1,))
    for x in ([30.0, -40.0], [-50.0, 1e-7]):
        assert plain.jacobian(np.array(x)) == pytest.approx(sensor.jacobian(np.array(x)), abs=1e-8)


def test_late_measurements_give_the_bits_of_sorted_ones():
    z, stamps = walk(12)[0], np.arange(12) * 0.7
    sorted_, shuffled = (
        IMM(MODELS, T, **START, measurement=position(1.0), stamp=0.0) for _ in range(2)
    )
    for k in range(12):
        assert sorted_.step(z[k], stamp=stamps[k]) == 'used'
    for k in np.random.default_rng(0).permutation(12):
        assert shuffled.step(z[k], stamp=stamps[k]) == 'used'
    assert (sorted_.estimate.mean == shuffled.estimate.mean).all()
    assert (sorted_.estimate.covariance == shuffled.estimate.covariance).all()
    assert sorted_.step(z[3], stamp=stamps[3]) == 'duplicate'
    assert sorted_.step(z[3], stamp=-1.0) == 'too_late'


def test_ten_short_steps_without_measurement_are_a_long_one():
    """Of a linear model that is alone, and of the chain."""
    models = [cv(noise=0.3), cv(noise=0.3, name='same')]
    long, short = (IMM(models, T, **START) for _ in range(2))
    long.step(None)
    for _ in range(10):
        short.step(None, dt=0.1)
    assert short.stamp == long.stamp == 1.0
    assert short.estimate.covariance == pytest.approx(long.estimate.covariance, rel=1e-12)
    assert short.model_probabilities == pytest.approx(long.model_probabilities, rel=1e-12)


def test_a_chain_of_rates_is_its_matrix():
    for chain in (RateChain(T, 1.0), RateChain(RateChain(T, 1.0).transition(0.5), 0.5)):
        imm, plain = (IMM(MODELS, each, **START, measurement=position(1.0)) for each in (chain, T))
        for z, dt in zip(walk(10)[0], (None, 0.3, 1.0, 0.7, None, 2.0, 0.0, 1.0, 1.0, 0.1)):
            imm.step(z, dt)
            plain.step(z, dt)
        assert imm.transition == pytest.approx(T, abs=1e-12)
        assert imm.estimate.mean == pytest.approx(plain.estimate.mean, rel=1e-11)


def test_a_chain_without_generator_takes_its_own_step_only():
    imm = IMM(MODELS, [[0.1, 0.9], [0.9, 0.1]], **START)
    assert imm.step(None) == 'used'
    with pytest.raises(ValueError, match='no generator'):
        imm.step(None, dt=0.5)


@pytest.mark.parametrize('rate', [0.0, 1e-6, -0.2, 0.9])
def test_an_unknown_turn_is_linearised_rightly(rate):
    model, x = ct(noise=0.1), np.array([1.0, 2.0, 0.7, -0.4, rate])
    F, _, B = model.motion(x, 1.3)

    def f(x):
        return np.append(turning(x[4], 1.3) @ x[:4], x[4])

    slopes = [(f(x + h) - f(x - h)) / 2e-6 for h in 1e-6 * np.eye(5)]
    assert F == pytest.approx(np.transpose(slopes), abs=1e-8)
    assert F @ x + B == pytest.approx(f(x), abs=1e-12)


def test_unequal_states_are_mixed_by_their_components():
    """Standing, straight, turning at an unknown rate: 2, 4 and 5 components."""
    imm = IMM(
        [hover(noise=0.05), cv(noise=0.02), ct(noise=0.02)],
        np.full((3, 3), 0.02) + 0.94 * np.eye(3),
        mean=[50.0, 10.0, 0.0, 0.0, 0.0],
        covariance=np.diag([9.0, 9.0, 1.0, 1.0, 0.04]),
        measurement=position(0.2),
    )
    assert imm.components == imm.outputs == ('px', 'py', 'vx', 'vy', 'turn')
    rng, x, won = np.random.default_rng(5), np.array([50.0, 10.0, 0.6, 0.8]), []
    for k in range(120):
        if k >= 40:
            x = turning(0.15 * (k >= 80), 1.0) @ x
        imm.step(x[:2] + rng.normal(0.0, 0.2, 2))
        if k in (39, 79, 119):
            won.append(imm.names[int(imm.model_probabilities.argmax())])
            speed = np.hypot(*imm.estimate.mean[2:4])
            assert speed == pytest.approx(0.0 if k == 39 else 1.0, abs=0.15)
    assert won == ['hover', 'cv', 'ct']
    assert imm.estimate.mean[4] == pytest.approx(0.15, abs=0.05)
    smoothed = imm.smooth()
    assert smoothed.stamps[-1] == 120.0 and smoothed.mean.shape == (120, 5)
    assert smoothed.mean[-1] == pytest.approx(imm.estimate.mean)
    assert smoothed.model_probabilities[60:75, 1].min() > 0.9


def test_a_model_with_outputs_of_its_own_is_the_same_model():
    """East at a speed that is a state: a velocity is no component, and may be measured."""

    def motion(x, dt):
        F = np.eye(3)
        F[0, 2] = dt
        return Motion(F, 0.01 * dt * np.eye(3), np.zeros(3))

    east = Model('east', ('px', 'py', 'speed'), motion, {'vx': (0, 0, 1), 'vy': (0, 0, 0)})
    doppler = MeasurementModel(lambda v: v, [[0.01]], components=('vx',))
    imm = IMM([east, hover(noise=0.1)], T, [0.0, 0.0, 0.5], np.eye(3), position(0.5))
    assert imm.outputs == ('px', 'py', 'speed', 'vx', 'vy')
    for k in range(1, 20):
        imm.step([0.9 * k, 0.0])
        assert imm.step([0.9], stamp=k, measurement=doppler) == 'used'
    assert imm.estimate.mean[[0, 3]] == pytest.approx([17.1, 0.9], abs=0.1)
    assert imm.model_probabilities[0] > 0.99


def test_constant_acceleration_composes():
    F1, Q1, _ = ca(noise=0.1).motion(np.zeros(6), 0.4)
    F2, Q2, _ = ca(noise=0.1).motion(np.zeros(6), 0.8)
    assert F1 @ F1 == pytest.approx(F2) and F1 @ Q1 @ F1.T + Q1 == pytest.approx(Q2)


@pytest.mark.parametrize(
    'values, problem',
    [
        ({'mean': [0.0, 0.0]}, 'mean and covariance need 4 and 4 x 4 values, for px, py, vx, vy'),
        ({'covariance': -np.eye(4)}, 'positive definite'),
        ({'transition': np.eye(3)}, '2 x 2 and 2 probabilities'),
        ({'transition': [[0.5, 0.4], [0.0, 1.0]]}, 'row 0 of the transition matrix sums to 0.9'),
        ({'models': [cv(noise=0.1)] * 2}, 'names of their own'),
        ({'initial': [0.5, 0.6]}, '2 probabilities'),
        ({'initial': [1.5, -0.5]}, '2 probabilities'),
        ({'dt': 0.0}, 'dt has to be positive'),
    ],
)
def test_what_does_not_fit_is_refused(values, problem):
    with pytest.raises(ValueError, match=problem):
        IMM(**{'models': MODELS, 'transition': T, **START, **values})


def test_measurements_that_do_not_fit_are_refused():
    imm = IMM(MODELS, T, **START, measurement=position(1.0))
    with pytest.raises(ValueError, match='2 finite values, or None'):
        imm.step([1.0, np.nan])
    with pytest.raises(ValueError, match="'turn' is measured, but no model has it"):
        imm.step([0.1], measurement=MeasurementModel(lambda x: x, 1.0, ('turn',)))
    with pytest.raises(ValueError, match='not both'):
        imm.step(None, 1.0, stamp=3.0)
    with pytest.raises(ValueError, match='needs a measurement model'):
        IMM(MODELS, T, **START).step([1.0, 2.0])
    with pytest.raises(ValueError, match='nothing to smooth'):
        imm.smooth()
