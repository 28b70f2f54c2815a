# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracks from pings of which one arrival is received."""

from helpers.diver_runs import arrivals, SECOND
import numpy as np
import pytest
from scipy.optimize import least_squares

from sonar_imm.trackers.diver import ranges, sides
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

BUOYS = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
START, SWUM, STD = np.array([-20.0, 15.0]), np.array([0.5, -0.3]), 0.5


def single(second, place, target, rng, std=STD):
    """The two-way range of a target from one place."""
    at = np.append(place, 0.0)[None]
    path = 2.0 * np.linalg.norm(np.append(target, 0.0) - at) + 2.0 * std * rng.normal()
    return arrivals(
        round(second * SECOND), at, np.array([path / 1500.0]), tx_id=np.ones(1), rx_id=np.zeros(1),
        tx=at, var_toa=(2.0 * std / 1500.0) ** 2,
    )  # fmt: skip


def swim(place_of, steps, seed=1, swum=SWUM, **config):
    """Estimates and targets of a diver whose ranges come from ``place_of(second)``."""
    rng, tracker = np.random.default_rng(seed), DiverTracker(DiverConfig(**config))
    targets = START + np.arange(1, steps + 1)[:, None] * swum
    pings = [single(k + 1, place_of(k + 1), at, rng) for k, at in enumerate(targets)]
    return tracker, [tracker.process(ping)[-1] for ping in pings], targets


def circled(second):
    angle = 2.0 * np.pi * second / 60.0
    return 50.0 * np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize('model_set', ['families', 'heading_speed'])
def test_four_buoys_in_turn_begin_a_track_after_five_pings(model_set):
    tracker, estimates, targets = swim(lambda s: BUOYS[s % 4], 40, model_set=model_set)
    assert [len(estimate) for estimate in estimates[:5]] == [0, 0, 0, 0, 1]
    for estimate, target in list(zip(estimates, targets))[8:]:
        error = estimate.state[0, :2] - target
        assert error @ np.linalg.solve(estimate.covariance[0, :2, :2], error) < 14.0
    assert np.hypot(*error) < 2.0 and estimate.extras['track_state'].tolist() == [1]
    assert np.isnan(estimate.extras['side_probability'][0]) and not tracker.warnings()


def test_a_ship_on_a_circle_finds_a_target():
    _, estimates, targets = swim(circled, 90, swum=np.zeros(2))
    error = estimates[-1].state[0, :2] - targets[-1]
    assert np.hypot(*error) < 3.0


def test_one_place_begins_no_track_and_says_so():
    tracker, estimates, _ = swim(lambda s: np.zeros(2), 30)
    assert not any(len(estimate) for estimate in estimates)
    assert tracker.warnings() == [ranges.NO_TRACK]


def test_ranges_from_a_line_have_two_sides():
    tracker, estimates, targets = swim(
        lambda s: np.array([40.0 * ((s % 3) - 1.0) - 10.0, -30.0]), 40
    )
    estimate = estimates[-1]
    assert len(estimate) == 1 and sides.NOT_TOLD in tracker.warnings()
    extras = estimate.extras
    assert extras['side_probability'][0] == pytest.approx(0.5, abs=1e-6)
    mirror = np.array([extras['mirror_x'][0], extras['mirror_y'][0]])
    other = 2.0 * estimate.state[0, :2] - mirror
    assert min(np.hypot(*(side - targets[-1])) for side in (mirror, other)) < 2.0
    np.testing.assert_allclose(mirror * [1.0, -1.0] - [0.0, 60.0], other, atol=0.5)


def test_a_range_of_a_track_begins_no_other():
    tracker, estimates, _ = swim(lambda s: BUOYS[s % 4], 60)
    assert {tuple(e.extras['track_id']) for e in estimates[6:]} == {(1,)}


def problem(rng, place_of=lambda k: BUOYS[k % 4], acceleration=0.0, count=9):
    time = np.arange(count) - (count - 1.0)
    at = np.column_stack([np.array([place_of(k) for k in range(count)]), np.zeros(count)])
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
