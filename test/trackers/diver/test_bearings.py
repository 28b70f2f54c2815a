# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A sensor whose bearings are all off by some degrees: its mount, its heading or its compass."""

from attrs import evolve
from helpers.diver_runs import fix
import numpy as np
import pytest

from sonar_imm.acoustics.arrivals_3d import BEARING, observe
from sonar_imm.measurements import Arrivals, RelativeFix, VesselPose
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.state_space import Instruments, MOST_RECEIVERS
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

STD = np.radians(2.0)
EVERYWHERE = (0.0, 0.0, 0.0, 360.0, 0.0, 1e6)
"""A coverage that says no more than that the sensor stands at the origin."""
SINGLE = {'max_tracks': 1, 'model_set': 'cv', 'coverage_sector': EVERYWHERE}


def path(count=40):
    """Fixes of a diver who swims by at 30 to 40 m, good to .5 m."""
    rng = np.random.default_rng(3)
    places = [np.array([30.0, 0.8 * k - 16.0]) + 0.5 * rng.normal(size=2) for k in range(count)]
    return [fix(k, *place, 0.25 * np.eye(2)) for k, place in enumerate(places, start=1)]


def last(config, measurements):
    tracker = DiverTracker(DiverConfig(**config))
    made = [each for item in measurements for each in tracker.process(item)]
    return made[-1], tracker._stream.state


def layout_of(config):
    models = build_models(config)
    return Instruments().with_sensor('').layout(config, models)


def test_positions_as_a_sensor_shows_them_are_turned_about_it_and_back():
    layout = layout_of(DiverConfig(model_set='cv', bearing_bias_std_deg=2.0))
    rng, place = np.random.default_rng(1), np.array([5.0, -3.0])
    x = rng.normal(size=(2, 3, 5)) * [20.0, 20.0, 1.0, 1.0, 0.05]
    root = rng.normal(size=(2, 3, 5, 5))
    P = root @ np.swapaxes(root, -1, -2)

    def turned(state):
        c, s = np.cos(state[4]), np.sin(state[4])
        arm = state[:2] - place
        return np.append(place + [c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], state[2:])

    seen, covariance = layout.as_seen(x, P, '', place)
    for row in np.ndindex(2, 3):
        np.testing.assert_allclose(seen[row], turned(x[row]), atol=1e-12)
        T = np.stack(
            [(turned(x[row] + h) - turned(x[row] - h)) / 2e-6 for h in 1e-6 * np.eye(5)], axis=1
        )
        np.testing.assert_allclose(covariance[row], T @ P[row] @ T.T, rtol=1e-6, atol=1e-6)
    again = layout.as_seen(seen, covariance, '', place, back=True)
    np.testing.assert_allclose(again[0], x, atol=1e-12)
    np.testing.assert_allclose(again[1], P, atol=1e-9)


@pytest.mark.parametrize('association', ['gnn', 'jipda', 'kbest'])
def test_a_considered_bearing_widens_the_ellipse_across_and_moves_no_estimate(association):
    """What is added is the variance of the bearing times the distance squared, in the direction in
    which an error of the bearing moves the diver, as in closed form."""
    config = {**SINGLE, 'association': association}
    plain, _ = last(config, path())
    wide, state = last({**config, 'bearing_bias_std_deg': 2.0}, path())
    np.testing.assert_allclose(wide.state[0, :2], plain.state[0, :2], atol=1e-3)
    x, y = plain.state[0, :2]
    across = STD**2 * np.outer([-y, x], [-y, x])
    added = wide.covariance[0, :2, :2] - plain.covariance[0, :2, :2]
    np.testing.assert_allclose(added, across, atol=0.03 * np.abs(across).max())
    assert (state.x[..., 4] == 0.0).all()
    np.testing.assert_allclose(state.P[..., 4, 4], STD**2, rtol=1e-9)


def test_where_nobody_knows_where_a_sensor_stands_nothing_is_added():
    config = {'max_tracks': 1, 'model_set': 'cv'}
    plain, _ = last(config, path())
    same, _ = last({**config, 'bearing_bias_std_deg': 2.0}, path())
    np.testing.assert_array_equal(same.covariance, plain.covariance)


def around_a_diver(off):
    """A diver who lies still, seen from a vessel that circles him, its transceiver mounted wrong
    by `off` rad."""
    rng, where, made = np.random.default_rng(5), np.array([10.0, 5.0, 0.0]), []
    turn = np.array([[np.cos(off), -np.sin(off), 0.0], [np.sin(off), np.cos(off), 0.0], [0, 0, 1]])
    for k in range(1, 90):
        angle = 2.0 * np.pi * k / 60.0
        vessel = 40.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        made.append(
            VesselPose(
                stamp_ns=k * 10**9,
                position=vessel,
                orientation=(0.0, 0.0, 0.0, 1.0),
                pose_covariance=np.diag([0.01] * 3 + [1e-8] * 3),
                frame_id='map',
            )
        )
        seen = turn @ (where - vessel) + 0.3 * rng.normal(size=3)
        made.append(
            RelativeFix(stamp_ns=k * 10**9, offset=seen, covariance=0.09 * np.eye(3), target_id=1)
        )
    return made, where


def test_a_vessel_that_moves_tells_how_its_transceiver_is_turned():
    off = np.radians(4.0)
    measured, where = around_a_diver(off)
    config = {'max_tracks': 1, 'model_set': 'cv', 'acceleration_noise': (0.02,)}
    ignored, _ = last(config, measured)
    stated = {'bearing_bias_std_deg': 3.0, 'systematic_errors': 'estimate'}
    found, state = last({**config, **stated}, measured)
    assert abs(state.x[0, 0, 4] - off) < np.radians(0.6)
    error = [np.hypot(*(each.state[0, :2] - where[:2])) for each in (ignored, found)]
    assert error[1] < 0.3 * error[0]
    considered, _ = last({**config, 'bearing_bias_std_deg': 3.0}, measured)
    miss = considered.state[0, :2] - where[:2]
    assert miss @ np.linalg.solve(considered.covariance[0, :2, :2], miss) < 6.0


def test_a_bearing_of_an_arrival_has_the_error_of_its_receiver():
    x, gradient = np.array([3.0, 4.0, 0.05]), np.empty(3)
    columns = np.array([0, 1, -1, -1, 2, -1, -1])
    nowhere = np.zeros(3)
    value = observe(BEARING, x, columns, 0.0, nowhere, nowhere, gradient)
    assert value == pytest.approx(np.arctan2(4.0, 3.0) + 0.05)
    np.testing.assert_allclose(gradient, [-4.0 / 25.0, 3.0 / 25.0, 1.0])


def test_a_sonar_of_range_and_bearing_states_what_its_mount_does():
    """One receiver at the transmitter: what it hears is a range and a bearing."""
    place, nothing = np.array([30.0, 40.0, 0.0]), np.zeros((1, 3))
    pings = [
        Arrivals(
            stamp_ns=k * 10**9,
            tx_id=[1],
            rx_id=[1],
            tx=nothing,
            rx=nothing,
            toa=[100.0 / 1500.0],
            var_toa=[1e-8],
            bearing=[np.arctan2(40.0, 30.0)],
            var_bearing=[np.radians(1.0) ** 2],
        )
        for k in range(1, 30)
    ]
    config = {'max_tracks': 1, 'model_set': 'cv', 'acceleration_noise': (0.02,)}
    plain, _ = last(config, pings)
    wide, state = last({**config, 'bearing_bias_std_deg': 2.0}, pings)
    across = np.array([-0.8, 0.6])
    assert across @ plain.covariance[0, :2, :2] @ across < 0.5
    assert across @ wide.covariance[0, :2, :2] @ across > 0.9 * (50.0 * STD) ** 2
    np.testing.assert_allclose(wide.state[0, :2], place[:2], atol=0.1)
    assert [what for _, what in state.instruments.known] == ['bearings']


def test_instruments_beyond_the_most_are_taken_as_they_are():
    config = DiverConfig(model_set='cv', bearing_bias_std_deg=2.0)
    known = Instruments()
    for k in range(MOST_RECEIVERS + 2):
        known = known.with_sensor(f'sensor_{k}')
    layout = known.layout(config, build_models(config))
    x, P = np.zeros((1, layout.size)), np.eye(layout.size)[None]
    for each, before in zip(layout.as_seen(x, P, 'sensor_65', np.ones(2)), (x, P)):
        np.testing.assert_array_equal(each, before)


@pytest.mark.statistics
def test_the_covariance_of_a_turned_sonar_is_true():
    nees = {0.0: [], 2.0: []}
    for seed in range(6):
        made = simulate(
            scenario('random_heading', {'duration': 60.0, 'bearing_bias_std_deg': 2.0}), seed
        )
        track = made.truth[0]
        for stated, found in nees.items():
            config = DiverConfig(
                max_tracks=1, coverage_sector=EVERYWHERE, bearing_bias_std_deg=stated
            )
            tracker = DiverTracker(config)
            for k, item in enumerate(made.measurements):
                estimate = tracker.process(item.measurement)[-1]
                if k >= 10 and len(estimate):
                    error = estimate.state[0, :2] - track.position[k, :2]
                    found.append(error @ np.linalg.solve(estimate.covariance[0, :2, :2], error))
    assert np.mean(nees[0.0]) > 3.5 > 2.6 > np.mean(nees[2.0])


def test_the_place_of_a_sensor_is_part_of_what_a_fix_is():
    plain = fix(1.0, 3.0, 4.0)
    placed = evolve(plain, seen_from=np.zeros(2))
    assert plain.key() != placed.key() and plain.key() == evolve(plain).key()
