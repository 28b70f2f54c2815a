# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A scene that is turned, moved, mirrored, dated otherwise or numbered otherwise gives the same
answer, so transformed.

Random numbers come from the stamps: at another time trackers without particles agree to the last
bit, the others within what they say themselves.
"""

import functools
import math

from helpers.diver_runs import arrivals
from helpers.faults.figures import Figures
import numpy as np
import pytest

from msg_adapters.estimates import read_estimate, write_estimate
from msg_adapters.soundings import read_soundings, write_soundings
from sonar_imm.measurements import Detections, Fixes, Navigation, Snapshot, Trace
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

SECOND = 10**9
T0 = 1_700_000_000 * SECOND
UTM = np.array([5e5, 4e6, 0.0])
LATER = 10**9 * SECOND // 4
"""A quarter of 1e9 s: after more, the seconds of a header are over."""
FIGURES = Figures('metamorphic')
FEW = {'particles': 2000, 'order_max': 4, 'pulse': 'gaussian', 'pulse_width': 0.18}


class Motion:
    """Of the whole scene: mirrored at the x axis, then turned, then moved, then later."""

    def __init__(self, turn_deg=0.0, shift=(0.0, 0.0, 0.0), mirror=False, late_ns=0):
        angle = math.radians(turn_deg)
        self.turn = np.array([
            [math.cos(angle), -math.sin(angle), 0.0],
            [math.sin(angle), math.cos(angle), 0.0],
            [0.0, 0.0, 1.0],
        ])  # fmt: skip
        self.half = math.sin(angle / 2), math.cos(angle / 2)
        self.sign = -1.0 if mirror else 1.0
        self.A = self.turn @ np.diag([1.0, self.sign, 1.0])
        self.shift, self.late_ns = np.asarray(shift), late_ns

    def point(self, x):
        return np.asarray(x, float) @ self.A.T + self.shift

    def covariance(self, P):
        n = P.shape[-1] // 2
        A = np.kron(np.eye(n), self.A[:2, :2])
        return A @ P @ A.T

    def quaternion(self, q):
        """Mirrored at the x-z plane, then turned about the vertical; x, y, z, w."""
        x, y, z, w = q[0] * self.sign, q[1], q[2] * self.sign, q[3]
        s, c = self.half
        return np.array([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])


MOTIONS = {
    'turned by a quarter': Motion(turn_deg=90.0), 'turned by 22.5 degrees': Motion(turn_deg=22.5),
    'moved to UTM': Motion(shift=UTM), 'mirrored': Motion(mirror=True),
    'mirrored, turned and moved': Motion(45.0, UTM, True), 'later': Motion(late_ns=LATER),
    'in 1970': Motion(late_ns=SECOND - T0),
}  # fmt: skip


def agree(given, kind, got, wanted, tolerance, relative=False):
    """Hold two arrays to a tolerance, for `relative` of one plus what is wanted; told[kind] is the
    worst difference seen."""
    got, wanted = np.asarray(got, float), np.asarray(wanted, float)
    assert got.shape == wanted.shape
    same = (got == wanted) | (np.isnan(got) & np.isnan(wanted))
    scale = 1.0 + np.abs(wanted) if relative else np.ones(wanted.shape)
    worst = float(np.max(np.abs(got - wanted)[~same] / scale[~same], initial=0.0))
    given[kind] = max(given.get(kind, 0.0), worst)
    assert worst <= tolerance, f'{kind}: {worst}'


def run(system, measurements, **parameters):
    entry = SYSTEMS[system]
    tracker = entry.build(entry.config_type().from_mapping(parameters))
    return [estimate for item in measurements for estimate in tracker.process(item)]


def divers(motion, order=(0, 1), receivers=(0, 1, 2, 3)):
    """Two divers, seen as scans of fixes and by echoes of pings."""
    rng, found = np.random.default_rng(4), []
    order, receivers = list(order), list(receivers)
    R = np.tile(motion.covariance(np.array([[0.2, 0.05], [0.05, 0.1]])), (2, 1, 1))
    for k in range(14):
        stamp = T0 + k * SECOND + motion.late_ns
        at = np.array([[0.7 * k, 5.0, 0.0], [30.0, 40.0 - 0.6 * k, 0.0]])
        at[:, :2] += rng.normal(0.0, 0.3, (2, 2))
        if k % 4 == 3:
            legs = np.linalg.norm(RECEIVERS[:, None] - at, axis=2)
            toa = ((legs + legs[0])[:, order] / 1500.0)[receivers].ravel()
            rx = np.repeat(motion.point(RECEIVERS)[receivers], 2, axis=0)
            known = {'rx_id': np.repeat(receivers, 2), 'tx': motion.point(RECEIVERS[0])}
            found.append(arrivals(stamp, rx, toa, **known))
        else:
            moved = motion.point(at)[order]
            found.append(Fixes(stamp_ns=stamp, frame_id='map', position=moved, covariance=R))
    return found


def same_divers(plain, moved, motion, tolerance):
    values = {}
    assert len(plain) == len(moved) and max(len(first) for first in plain) == 2
    for first, other in zip(plain, moved):
        assert other.stamp_ns == first.stamp_ns + motion.late_ns and len(first) == len(other)
        place = motion.point(np.column_stack([first.state[:, :2], np.zeros(len(first))]))[:, :2]
        velocity = first.state[:, 2:4] @ motion.A[:2, :2].T
        gap = np.abs(place[:, None] - other.state[None, :, :2]).sum(axis=2)
        row = gap.argmin(axis=1)  # tracks begin in the order of the fixes
        assert sorted(row) == list(range(len(row)))
        agree(values, 'places', other.state[row, :2], place, tolerance)
        agree(values, 'states', other.state[row, 2:4], velocity, tolerance)
        turned = motion.covariance(first.covariance)
        agree(values, 'covariances', other.covariance[row], turned, tolerance)
        permuted = np.empty_like(first.probabilities)
        permuted[:, _headings(first.model_names, motion)] = first.probabilities
        agree(values, 'probabilities', other.probabilities[row], permuted, tolerance)
    return values


def _headings(names, motion):
    """Which model each model is after the motion, by the direction in its name."""
    found = []
    for k, name in enumerate(names):
        family, heading, _ = name.partition('heading_')
        headings = [each for each in names if heading and each.startswith(family + heading)]
        if headings:
            direction = 2.0 * math.pi * headings.index(name) / len(headings)
            x, y, _ = motion.A @ [math.cos(direction), math.sin(direction), 0.0]
            turned = round(math.atan2(y, x) / (2.0 * math.pi) * len(headings)) % len(headings)
            k = names.index(headings[turned])
        found.append(k)
    return found


def obstacles(motion, order=(0, 1)):
    """Two fixed obstacles ahead of a vehicle that yaws and rolls."""
    world, order = np.array([[60.0, 4.0, -6.0], [52.0, -6.0, -12.0]]), list(order)
    found = []
    for k in range(24):
        stamp = T0 + k * SECOND // 2 + motion.late_ns
        yaw, roll = 0.05 * math.sin(0.5 * k), 0.1 * math.sin(0.9 * k)
        position = np.array([0.7 * k, 0.1 * k, -9.0])
        (sy, cy), (sr, cr) = ((math.sin(angle / 2), math.cos(angle / 2)) for angle in (yaw, roll))
        found.append(Navigation(
            stamp_ns=stamp, frame_id='odom', child_frame_id='base',
            position=motion.point(position), velocity=[1.4, 0.2 * motion.sign, 0.0],
            orientation=motion.quaternion([sr * cy, sr * sy, cr * sy, cr * cy]),
        ))  # fmt: skip
        offset = (world - position)[order]
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - yaw
        bearing = bearing + roll * offset[:, 2] / np.hypot(offset[:, 0], offset[:, 1])
        seen = {'range': np.linalg.norm(offset, axis=1), 'bearing': motion.sign * bearing}
        found.append(Detections(stamp_ns=stamp, frame_id='sonar', **seen))
    return found


def same_obstacles(plain, moved, motion, tolerance):
    values = {}

    def close(kind, got, wanted):
        agree(values, kind, got, wanted, tolerance, relative=True)

    assert len(plain) == len(moved)
    assert sum(len(first) > 0 for first in plain) > 20 and max(map(len, plain)) == 2
    for first, other in zip(plain, moved):
        assert other.stamp_ns == first.stamp_ns + motion.late_ns and len(first) == len(other)
        if not len(first):  # an echo alone is no track yet
            continue
        side = np.array([1.0, motion.sign, 1.0])
        state = first.state * side
        row = np.abs(state[:, None] - other.state[None]).sum(axis=2).argmin(axis=1)
        close('states', other.state[row], state)
        close('covariances', other.covariance[row], first.covariance * np.outer(side, side))
        close('probabilities', other.probabilities[row], first.probabilities)
        close('existence', other.extras['existence'][row], first.extras['existence'])
        agree(values, 'places', other.xyz[row], motion.point(first.xyz), max(tolerance, 1e-8) * 10)
    return values


def side_of(motion):
    return 'port' if motion.sign < 0.0 else 'starboard'


def pings(motion):
    """A ship over a slope, with an array that looks to one side."""
    rng = np.random.default_rng(9)
    ranges = 18.0 + 0.2 * np.arange(40)
    found = []
    for k in range(4):
        stamp = T0 + k * SECOND // 5 + motion.late_ns
        roll = 0.03 * math.sin(2.0 * k)
        found.append(Navigation(
            stamp_ns=stamp, frame_id='odom', position=motion.point([0.4 * k, 0.02 * k, 0.0]),
            orientation=motion.quaternion([math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)]),
        ))  # fmt: skip
        angle = np.arcsin(15.0 / ranges)
        phase = np.pi * np.sin(angle - math.radians(30.0))[:, None] * np.arange(6)
        loud = rng.normal(size=(40, 1)) + 1j * rng.normal(size=(40, 1))
        noise = 0.1 * (rng.normal(size=(40, 6)) + 1j * rng.normal(size=(40, 6)))
        found.append(Snapshot(
            stamp_ns=stamp, range=ranges, iq=loud * np.exp(1j * phase) + noise,
            noise_variance=np.full(40, 0.02), frame_id='sonar', sound_speed=1500.0,
            side=side_of(motion),
        ))  # fmt: skip
    return found


def same_floor(plain, moved, motion, tolerance):
    values = {}
    assert len(plain) == len(moved) >= 3
    for first, other in zip(plain, moved):
        assert other.stamp_ns == first.stamp_ns + motion.late_ns
        np.testing.assert_array_equal(first.extras['valid'], other.extras['valid'])
        assert first.extras['valid'].mean() > 0.5
        agree(values, 'states', other.state, first.state, tolerance)
        agree(values, 'covariances', other.covariance, first.covariance, tolerance)
        agree(values, 'probabilities', other.probabilities, first.probabilities, tolerance)
        agree(values, 'places', other.xyz, motion.point(first.xyz), 1e-6)
    return values


def traces(deeper=0.0, late_ns=0, louder=1.0):
    rng = np.random.default_rng(3)
    depth = 20.0 + 0.1 * np.arange(120)
    found = []
    for k in range(6):
        amplitude = 5.0 * np.exp(-np.square((depth - 23.0) / 0.25))
        amplitude += 3.0 * np.exp(-np.square((depth - 27.0 - 0.05 * k) / 0.25))
        amplitude += 0.3 * rng.normal(size=len(depth))
        found.append(Trace(
            stamp_ns=T0 + k * SECOND + late_ns, depth=depth + deeper, frame_id='array',
            amplitude=louder * amplitude, sigma=np.full(120, 0.3 * louder),
            reference_depth=10.0 + deeper,
        ))  # fmt: skip
    return found


def note(system, how, moved, tolerance, given):
    FIGURES.add({'system': system, 'how': how, 'moved': moved}, tolerance=tolerance, **given)


SWATH = {'max_gap': 5.0}
EVERY = ('fixed', 'swaying', 'moving', 'seabed')
CASES = {
    'diver gnn': (divers, same_divers, {'association': 'gnn'}, 1e-5),
    'diver jipda': (divers, same_divers, {'association': 'jipda'}, 1e-5),
    'obstacle fixed ones': (obstacles, same_obstacles, {'behaviours': ('fixed',)}, 1e-5),
    # Sigma points of a moving obstacle lie along north and east: what they miss turns with them.
    'obstacle all behaviours': (obstacles, same_obstacles, {'behaviours': EVERY}, 2e-4),
    'bathymetry grid': (pings, same_floor, SWATH, 1e-6),
}


@functools.cache
def where_it_is(case):
    scene, _, parameters, _ = CASES[case]
    return run(case.partition(' ')[0], scene(Motion()), **parameters)


@pytest.mark.parametrize('name', MOTIONS)
@pytest.mark.parametrize('case', CASES)
def test_a_scene_that_is_elsewhere_or_at_another_time(case, name):
    """What lies to port of a mirrored ship is what lay to starboard."""
    motion, (system, _, how) = MOTIONS[name], case.partition(' ')
    scene, same, parameters, tolerance = CASES[case]
    tolerance = 0.0 if motion.late_ns else tolerance
    side = {'side': side_of(motion)} if system == 'bathymetry' else {}
    moved = run(system, scene(motion), **parameters, **side)
    note(system, how, name, tolerance, same(where_it_is(case), moved, motion, tolerance))


@pytest.mark.parametrize('case, name, other', [
    ('diver gnn', 'divers in another order', {'order': (1, 0)}),
    ('diver gnn', 'receivers in another order', {'receivers': (2, 0, 3, 1)}),
    ('obstacle all behaviours', 'echoes in another order', {'order': (1, 0)}),
])  # fmt: skip
def test_what_is_told_in_another_order(case, name, other):
    scene, same, parameters, _ = CASES[case]
    system, _, how = case.partition(' ')
    moved = run(system, scene(Motion(), **other), **parameters)
    note(system, how, name, 1e-6, same(where_it_is(case), moved, Motion(), 1e-6))


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_places_keep_millimetres_in_messages(system):
    """x y z are drawn, and a quarter of a metre coarse at a northing of 4e6; the rest is not."""
    scene, parameters = (obstacles, {}) if system == 'obstacle' else (pings, SWATH)
    motion = MOTIONS['moved to UTM']
    plain, moved = (run(system, scene(each), **parameters)[-1] for each in (Motion(), motion))
    read = read_estimate(write_estimate(moved, ros_message))
    wanted, names = motion.point(plain.xyz), ('px', 'py', 'pz')
    assert np.abs(read.columns()['y'] - wanted[:, 1]).max() > 0.01
    np.testing.assert_allclose(read.xyz, wanted, rtol=0, atol=1e-4)
    columns = np.column_stack([read.columns()[name] for name in names])
    np.testing.assert_allclose(columns, wanted, rtol=0, atol=1e-4)
    if system == 'bathymetry':
        sounded = read_soundings(write_soundings(soundings_of(read), ros_message))
        assert len(sounded) > 10
        kept = np.column_stack([sounded.columns[name] for name in names])
        assert np.abs(kept[:, None] - wanted).min(axis=1).max() < 1e-4


@functools.cache
def reflectors():
    """What is found of the traces as they are."""
    plain = run('fathometer', traces(), **FEW)
    assert all((each.extras['existence'] > 0.5).sum() == 2 for each in plain[1:])
    return plain


def test_reflectors_twice_as_loud():
    """Powers of two change no digit."""
    values, louder = {}, run('fathometer', traces(louder=1024.0), **FEW)
    for first, other in zip(reflectors(), louder, strict=True):
        agree(values, 'states', other.state, first.state * [1, 1024], 0.0)
        scale = np.outer([1, 1024], [1, 1024])
        agree(values, 'covariances', other.covariance, first.covariance * scale, 0.0)
        agree(values, 'probabilities', other.probabilities, first.probabilities, 0.0)
    note('fathometer', 'particles', '1024 times as loud', 0.0, values)


def stds(estimate):
    return np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2))


def test_reflectors_deeper():
    """Deeper depths have fewer digits behind the point: a particle or two is drawn otherwise."""
    values, deeper = {}, run('fathometer', traces(deeper=100.0), **FEW)
    for first, other in zip(reflectors(), deeper, strict=True):
        off = (other.state - first.state - [100.0, 0.0]) / stds(first)
        agree(values, 'states', off, 0.0 * off, 0.1)
        agree(values, 'probabilities', other.probabilities, first.probabilities, 0.02)
    note('fathometer', 'particles', '100 m deeper', 0.1, values)


def test_reflectors_at_another_time():
    """Other random numbers: the same within a posterior standard deviation."""
    plain, later, values = reflectors(), run('fathometer', traces(late_ns=LATER), **FEW), {}
    assert [item.stamp_ns + LATER for item in plain] == [other.stamp_ns for other in later]
    for first, other in zip(plain[1:], later[1:], strict=True):
        assert len(first) == len(other) == 2
        off = (other.state - first.state) / stds(first)
        agree(values, 'states', off, 0.0 * off, 1.0)
    agree(values, 'probabilities', later[-1].probabilities, plain[-1].probabilities, 0.2)
    note('fathometer', 'particles', 'later', 1.0, values)
