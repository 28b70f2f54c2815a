# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Errors of arrivals that last: the evidence is what least squares over all pings says, whatever
the motion, and what is stated of instruments is taken from it."""

from helpers.diver_runs import arrivals, fix, run
import numpy as np
import pytest

from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver import estimate, offsets
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.offsets import BiasTest, chi2_limit, RecentPairs
from sonar_imm.trackers.diver.scan import ping_measurements
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

RECEIVERS = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
STD, SPEED = 2e-4, 1500.0
EVERY = 'every'


def legs(place, tag=False):
    reach = np.linalg.norm(RECEIVERS - [*place, 0.0], axis=1)
    return reach if tag else reach + np.hypot(*place)


def ping_of(place, tag=False, error=0.0, rows=slice(None)):
    """The arrivals of a diver at `place` (2,) at the receivers `rows`, with errors (4,), m."""
    toa = (legs(place, tag) + error)[rows] / SPEED
    known = {'rx_id': np.arange(4)[rows], 'tx': [np.nan if tag else 0.0] * 3, 'var_toa': STD**2}
    return arrivals(1, RECEIVERS[rows], toa, tx_id=np.ones(len(toa)), **known)


def evidence(places, received, errors, tag=False, **stated):
    """The evidence of pings of a diver at `places` (k, 2) whose arrivals, those that were `heard`
    (k, 4), have the errors (k, 4), m of path."""
    config = DiverConfig(**stated)
    models, found = build_models(config), BiasTest()
    layout = Instruments().layout(config, models)
    for place, rows, error in zip(places, received, errors):
        ping = ping_of(place, tag, error, rows)
        seen = ping_measurements(ping, np.arange(len(ping)), config, models, layout)
        ids = np.column_stack([ping.tx_id, ping.rx_id]).astype(np.int64)
        found = found.with_ping(seen, seen.echo, ids, place + [0.3, -0.2], config)
    return found, config


def scene(pings=60, seed=1):
    """A diver who jumps as nobody can: places, which arrivals were heard, and their noise, m."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-40.0, 60.0, (pings, 2))
    received = rng.uniform(size=(pings, 4)) < 0.9
    return places, received, SPEED * STD * rng.normal(size=(pings, 4))


@pytest.mark.parametrize('tag', [False, True])
def test_the_evidence_is_what_least_squares_gains_by_an_error_of_each_pair(tag, monkeypatch):
    monkeypatch.setattr(offsets, 'MEMORY', 1e12)
    monkeypatch.setattr(offsets, 'CAPPED', 1e12)
    places, received, noise = scene()
    errors = noise + np.array([0.0, 0.8, -0.5, 0.3])
    found, config = evidence(places, received, errors, tag)
    # All unknowns at once: k of each ping and four errors.
    k, rows, residual = 3 if tag else 2, [], []
    for at, (place, seen, error) in enumerate(zip(places, received, errors)):
        if seen.sum() <= k:
            continue
        slope = [(legs(place + d, tag) - legs(place - d, tag)) / 2e-3 for d in 1e-3 * np.eye(2)]
        slope += [np.ones(4)] if tag else []
        for r in np.flatnonzero(seen):
            row = np.zeros(len(places) * k + 4)
            row[k * at : k * at + k] = [part[r] for part in slope]
            row[len(places) * k + r] = 1.0
            rows.append(row)
            residual.append(error[r])
    A, y = np.array(rows) / (SPEED * STD), np.array(residual) / (SPEED * STD)

    def left(part):
        return np.sum((y - part @ np.linalg.lstsq(part, y, rcond=None)[0]) ** 2)

    gain = left(A[:, :-4]) - left(A)
    value, rank = found.evidence(config)[EVERY]
    scatter = max((found.square - gain) / (found.freedom - rank), 1.0)
    assert value * scatter == pytest.approx(gain, rel=0.1)
    assert value > chi2_limit(rank)


def test_noise_alone_is_no_evidence_even_where_more_of_it_than_stated():
    for seed in range(5):
        places, received, noise = scene(seed=seed)
        for times in (1.0, 3.0):
            found, config = evidence(places, received, times * noise)
            assert found.warnings(config) == []


def test_what_is_stated_of_instruments_is_expected_and_no_more():
    places, received, noise = scene()
    late = noise + np.array([0.0, 0.8, -0.5, 0.3])
    found, config = evidence(places, received, late)
    (warning,) = found.warnings(config)
    assert 'receiver_clock_std' in warning and 'target_z' in warning
    assert found.warnings(DiverConfig(receiver_clock_std=5e-4)) == []
    assert found.warnings(DiverConfig(receiver_position_std=0.7)) == []
    assert found.warnings(DiverConfig(receiver_clock_std=1e-5)) != []


def test_a_single_cause_that_explains_it_all_is_named():
    places, received, noise = scene()
    deep = np.array([np.linalg.norm(RECEIVERS - [*p, -10.0], axis=1) for p in places])
    deep += np.hypot(np.hypot(*places.T), 10.0)[:, None] - np.array([legs(p) for p in places])
    found, config = evidence(places, received, noise + deep)
    assert 'Likely cause: target_z (or dimensions: 3)' in found.warnings(config)[0]
    slow = 0.01 * np.array([legs(place) for place in places])
    found, config = evidence(places, received, noise + slow)
    assert 'Likely cause: sound_speed' in found.warnings(config)[0]
    assert found.warnings(DiverConfig(sound_speed_std=15.0)) == []


def test_pings_that_any_place_explains_say_nothing():
    places, received, noise = scene()
    received[:, 2:] = False
    found, config = evidence(places, received, noise + 1.0)
    assert found.freedom == 0.0 and found.warnings(config) == []


# -- what is assumed where nothing is stated -----------------------------------------------------


def heard(config, place, tag=False):
    """The pairs heard in one ping, all of whose echoes were taken, of a diver at `place` (2,)."""
    models, everyone = build_models(config), np.ones(4, bool)
    ping, layout = ping_of(place, tag), Instruments().layout(config, models)
    seen = ping_measurements(ping, np.arange(4), config, models, layout)
    at = np.asarray(place, float)
    nothing = BiasTest(), RecentPairs()
    return offsets.accumulate_residuals(*nothing, {0: at}, {0: everyone}, ping, seen, config)[1]


def placed(path, guess, receivers, tag):
    """Where path lengths (4,) put a diver, by least squares with these receivers (4, 3)."""
    x = np.array([*guess, 0.0] if tag else guess, float)

    def expected(at):
        reach = np.linalg.norm(receivers - [*at[:2], 0.0], axis=1)
        return reach + (at[2] if tag else np.hypot(*at[:2]))

    for _ in range(6):
        H = np.stack([(expected(x + d) - expected(x - d)) / 2e-4 for d in 1e-4 * np.eye(len(x))])
        x = x + np.linalg.lstsq(H.T, path - expected(x), rcond=None)[0]
    return x[:2]


@pytest.mark.parametrize('tag', [False, True])
def test_what_is_assumed_of_instruments_moves_the_place_of_a_ping_as_it_says(tag):
    """Against draws of receivers, clocks and sound speeds, and least squares of each."""
    config, place = DiverConfig(), np.array([20.0, 30.0])
    mean, nothing = np.array([[*place, 0.0, 0.0]]), np.zeros((1, 4, 4))
    wide = offsets.with_assumed_errors(heard(config, place, tag), mean, nothing, config)
    rng, found = np.random.default_rng(2), []
    off, late, slow = offsets.ASSUMED.values()
    for _ in range(1500):
        moved = RECEIVERS.copy()
        moved[0 if tag else 1 :, :2] += off * rng.normal(size=(4 if tag else 3, 2))
        reach = np.linalg.norm(moved - [*place, 0.0], axis=1)
        path = (reach + (0.0 if tag else np.hypot(*place))) * (1.0 - slow / SPEED * rng.normal())
        found.append(placed(path + late * SPEED * rng.normal(size=4), place, RECEIVERS, tag))
    np.testing.assert_allclose(wide[0, :2, :2], np.cov(np.array(found).T), rtol=0.15, atol=0.01)
    assert (wide[0, 2:] == 0.0).all()


def test_nothing_is_assumed_where_something_is_stated_or_nobody_was_heard():
    mean, nothing = np.array([[20.0, 30.0, 0.0, 0.0]]), np.zeros((1, 4, 4))
    config = DiverConfig()
    found = heard(config, mean[0, :2])
    assert offsets.with_assumed_errors(RecentPairs(), mean, nothing, config) is nothing
    exact = DiverConfig(systematic_errors='exact')
    assert offsets.with_assumed_errors(found, mean, nothing, exact) is nothing
    with pytest.raises(ConfigError, match='receiver_clock_std'):
        DiverConfig(systematic_errors='exact', receiver_clock_std=1e-4)
    for name in offsets.STDS:
        assert (
            offsets.with_assumed_errors(found, mean, nothing, DiverConfig(**{name: 1e-6}))
            is nothing
        )


def test_what_is_assumed_moves_no_estimate_and_ends_with_fixes():
    made = simulate(scenario('multistatic', {'duration': 20.0}), 1)
    tracker = DiverTracker(DiverConfig(max_tracks=1))
    assumed = run(tracker, (item.measurement for item in made.measurements))[-1]
    mean, inside = estimate.published_state(tracker._stream.state, tracker.models, 0.05)
    np.testing.assert_array_equal(assumed.state, mean)
    ratio = np.diag(assumed.covariance[0])[:2] / np.diag(inside[0])[:2]
    assert (ratio > 1.5).all() and (ratio < 30.0).all()
    last = made.measurements[-1].measurement.stamp_ns * 1e-9
    after = tracker.process(fix(last + 1.0, *mean[0, :2]))[-1]
    inside = estimate.published_state(tracker._stream.state, tracker.models, 0.05)[1]
    np.testing.assert_array_equal(after.covariance, inside)


def test_pairs_that_fell_silent_are_forgotten():
    config, place = DiverConfig(), np.array([20.0, 30.0])
    found = heard(config, place)
    nobody = found
    for _ in range(offsets.RECENT):
        nobody = nobody._replace(age=nobody.age + 1.0)
    models = build_models(config)
    layout = Instruments().layout(config, models)
    seen = ping_measurements(ping_of(place, rows=[2]), np.arange(1), config, models, layout)
    left = nobody.with_ping(seen, np.ones(1, bool), np.array([[1, 2]]))
    assert left.pairs == ((1, 2),) and len(found.pairs) == 4
