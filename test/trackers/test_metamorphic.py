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

"""A scene that is turned, moved, mirrored, dated otherwise or numbered otherwise gives the same
answer, so transformed.

What must not matter is where the map begins, where north is, what time it is, which side is port
and in which order echoes are told. Random numbers come from the stamps, so that another time gives
other ones: there the trackers without particles agree to the last bit, the others within what they
say themselves.
"""

from attrs import evolve
from helpers.faults.figures import Figures
from helpers.moved_scenes import (
    agree,
    divers,
    LATER,
    Motion,
    MOTIONS,
    obstacles,
    pings,
    run,
    same_divers,
    same_floor,
    same_obstacles,
    SECOND,
    T0,
    traces,
    UTM,
)
import numpy as np
import pytest

from msg_adapters.displays.obstacle import write_markers, write_poses
from msg_adapters.estimates import read_estimate, write_estimate
from msg_adapters.soundings import read_soundings, write_soundings
from sonar_imm.measurements import Fix
from sonar_imm.soundings import soundings_of
from sonar_imm_tools.recordings.messages import ros_message

BILLION = 10**9 * SECOND
"""From 1970 on a stamp may be so much later."""


FIGURES = Figures('metamorphic')


def note(system, how, moved, tolerance, given):
    FIGURES.add({'system': system, 'how': how, 'moved': moved}, tolerance=tolerance, **given)


# -- divers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('association', ['gnn', 'jipda', 'kbest'])
@pytest.mark.parametrize('name', MOTIONS)
def test_divers(name, association):
    motion = MOTIONS[name]
    plain = run('diver', divers(Motion()), association=association)
    moved = run('diver', divers(motion), association=association)
    assert max(len(item) for item in plain) == 2
    tolerance = 0.0 if name == 'later' else 1e-5
    given = same_divers(plain, moved, motion, tolerance)
    note('diver', association, name, tolerance, given)


@pytest.mark.parametrize(
    'name, other',
    [
        ('divers in another order', {'order': (1, 0)}),
        ('receivers in another order', {'receivers': (2, 0, 3, 1)}),
    ],
)
def test_divers_and_receivers_in_another_order(name, other):
    plain, moved = run('diver', divers(Motion())), run('diver', divers(Motion(), **other))
    given = same_divers(plain, moved, Motion(), 1e-6)
    note('diver', 'gnn', name, 1e-6, given)


# -- obstacles ------------------------------------------------------------------------------------


@pytest.mark.parametrize('behaviours', [['fixed'], ['fixed', 'swaying', 'moving', 'seabed']])
@pytest.mark.parametrize('name', MOTIONS)
def test_obstacles(name, behaviours):
    """The sigma points of a moving obstacle lie along north and east: what they miss of the second
    order turns with those axes."""
    motion = MOTIONS[name]
    plain = run('obstacle', obstacles(Motion()), behaviours=behaviours)
    assert max(len(item) for item in plain) == 2
    moved = run('obstacle', obstacles(motion), behaviours=behaviours)
    tolerance = 1e-5 if behaviours == ['fixed'] else 2e-4
    tolerance = 0.0 if name == 'later' else tolerance
    given = same_obstacles(plain, moved, motion, tolerance)
    how = 'fixed ones' if behaviours == ['fixed'] else 'all behaviours'
    note('obstacle', how, name, tolerance, given)


def test_obstacles_in_another_order():
    plain = run('obstacle', obstacles(Motion()))
    moved = run('obstacle', obstacles(Motion(), order=(1, 0)))
    given = same_obstacles(plain, moved, Motion(), 1e-6)
    name = 'echoes in another order'
    note('obstacle', 'all behaviours', name, 1e-6, given)


# -- the sea floor --------------------------------------------------------------------------------


SWATH = {'engine': 'grid', 'grid_step': 0.1, 'smoothing': 'states', 'max_gap': 5.0}


@pytest.mark.parametrize('name', MOTIONS)
def test_the_sea_floor(name):
    """What lies to port of a mirrored ship is what lay to starboard."""
    motion = MOTIONS[name]
    plain = run('bathymetry', pings(Motion()), **SWATH)
    side = 'port' if motion.sign < 0.0 else 'starboard'
    moved = run('bathymetry', pings(motion, side), **{**SWATH, 'side': side})
    tolerance = 0.0 if name == 'later' else 1e-6
    given = same_floor(plain, moved, motion, tolerance, 1e-6)
    note('bathymetry', 'grid', name, tolerance, given)


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_places_keep_millimetres_in_messages_and_displays(system):
    """x y z are drawn, and a quarter of a metre coarse at a northing of 4e6; the rest is not."""
    scene = obstacles if system == 'obstacle' else pings
    parameters = {} if system == 'obstacle' else SWATH
    motion = MOTIONS['moved to UTM']
    plain = run(system, scene(Motion()), **parameters)[-1]
    moved = run(system, scene(motion), **parameters)[-1]
    read = read_estimate(write_estimate(moved, ros_message))
    wanted = motion.point(plain.xyz)
    assert np.abs(read.columns()['y'] - wanted[:, 1]).max() > 0.01
    np.testing.assert_allclose(read.xyz, wanted, rtol=0, atol=1e-4)
    np.testing.assert_allclose(
        np.column_stack([read.columns()[name] for name in ('px', 'py', 'pz')]),
        wanted,
        rtol=0,
        atol=1e-4,
    )
    if system == 'obstacle':
        poses = write_poses(read, range(len(read)), ros_message).poses
        drawn = [[pose.position.x, pose.position.y, pose.position.z] for pose in poses]
        np.testing.assert_allclose(drawn, wanted, rtol=0, atol=1e-4)
        first = write_markers(read, [0], ros_message).markers[1].pose.position
        assert abs(first.y - wanted[0, 1]) < 1e-4
        return
    sounded = read_soundings(write_soundings(soundings_of(read), ros_message))
    kept = sounded.columns
    assert len(sounded) > 10
    for name, axis in zip(('px', 'py', 'pz'), range(3)):
        gap = np.abs(kept[name][:, None] - wanted[None, :, axis]).min(axis=1)
        assert gap.max() < 1e-4, name


# -- reflectors -----------------------------------------------------------------------------------


FEW = {'particles': 2000, 'order_max': 4, 'pulse': 'gaussian', 'pulse_width': 0.18}


def found_reflectors(estimates):
    return [estimate.state[estimate.extras['existence'] > 0.5] for estimate in estimates]


def test_reflectors_twice_as_loud():
    """Powers of two change no digit."""
    plain = run('fathometer', traces(), **FEW)
    assert all(len(item) == 2 for item in found_reflectors(plain)[1:])
    values = {}
    for first, other in zip(plain, run('fathometer', traces(louder=1024.0), **FEW), strict=True):
        agree(values, 'states', other.state, first.state * [1, 1024], 0.0)
        scale = np.outer([1, 1024], [1, 1024])
        agree(values, 'covariances', other.covariance, first.covariance * scale, 0.0)
        agree(values, 'probabilities', other.probabilities, first.probabilities, 0.0)
    note('fathometer', 'particles', '1024 times as loud', 0.0, values)


def test_reflectors_deeper():
    """Deeper depths have fewer digits behind the point: a particle or two is drawn otherwise."""
    plain = run('fathometer', traces(), **FEW)
    values = {}
    for first, other in zip(plain, run('fathometer', traces(deeper=100.0), **FEW), strict=True):
        std = np.sqrt(np.diagonal(first.covariance, axis1=1, axis2=2))
        agree(values, 'states', (other.state - first.state - [100.0, 0.0]) / std, 0.0 * std, 0.1)
        agree(values, 'probabilities', other.probabilities, first.probabilities, 0.02)
    note('fathometer', 'particles', '100 m deeper', 0.1, values)


def test_reflectors_at_another_time():
    """Other random numbers: the same within a posterior standard deviation."""
    plain = run('fathometer', traces(), **FEW)
    later = run('fathometer', traces(late_ns=LATER), **FEW)
    assert [item.stamp_ns + LATER for item in plain] == [other.stamp_ns for other in later]
    values = {}
    for first, other in zip(plain[1:], later[1:], strict=True):
        assert len(first) == len(other) == 2
        std = np.sqrt(np.diagonal(first.covariance, axis1=1, axis2=2))
        agree(values, 'states', (other.state - first.state) / std, 0.0 * std, 1.0)
    agree(values, 'probabilities', later[-1].probabilities, plain[-1].probabilities, 0.2)
    note('fathometer', 'particles', 'later', 1.0, values)


# -- a billion seconds ----------------------------------------------------------------------------


def test_a_billion_seconds_later_every_bit_is_the_same():
    """From early in 1970 to 2001: no stamp loses digits on the way."""
    names = {'places': 'xyz', 'states': 'state', 'covariances': 'covariance'}
    for system, scene, parameters in (
        ('diver', divers, {}),
        ('obstacle', obstacles, {}),
        ('bathymetry', pings, SWATH),
    ):
        early = [evolve(item, stamp_ns=item.stamp_ns - T0 + SECOND) for item in scene(Motion())]
        late = [evolve(item, stamp_ns=item.stamp_ns + BILLION) for item in early]
        pair = run(system, early, **parameters), run(system, late, **parameters)
        assert len(pair[0]) == len(pair[1]) > 2
        values = {}
        for first, other in zip(*pair):
            assert other.stamp_ns == first.stamp_ns + BILLION
            for kind, name in (names | {'probabilities': 'probabilities'}).items():
                agree(values, kind, getattr(other, name), getattr(first, name), 0.0)
        name = 'later by 1e9 s'
        note(system, 'defaults', name, 0.0, values)


def test_single_fixes_far_from_the_origin_keep_their_digits():
    """A diver who swims a millimetre between fixes of a millimetre, at UTM coordinates."""
    for shift in (np.zeros(3), UTM):
        fixes = [
            Fix(
                stamp_ns=T0 + k * SECOND,
                position=shift + [1e-3 * k, 0.0, 0.0],
                covariance=np.eye(2) * 1e-8,
                frame_id='map',
            )
            for k in range(10)
        ]
        last = run('diver', fixes, model_set='cv')[-1]
        assert abs(last.state[0, 0] - shift[0] - 9e-3) < 1e-4
        assert abs(last.state[0, 2] - 1e-3) < 2e-4
