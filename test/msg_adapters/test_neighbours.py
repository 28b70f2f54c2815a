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

"""Tracks in messages of other packages, with their definitions; the messages go through CDR."""

from helpers.marine import typestore
import numpy as np
import pytest

from msg_adapters.detections import read_detections_3d
from msg_adapters.fixes import read_geodetic, UNKNOWN_VARIANCE
from msg_adapters.neighbours import CONTACT, CONTACTS, DETECTIONS, GEO_POSE, Neighbours, TOPICS
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm_tools.recordings import messages

HARBOUR = Origin(54.3, 10.2, 40.0)
STAMP = 7 * 10**9 + 5


@pytest.fixture
def make(monkeypatch):
    monkeypatch.setattr(messages, 'typestore', typestore)
    messages._layout.cache_clear()
    yield messages.ros_message
    messages._layout.cache_clear()


def divers(states=('px', 'py', 'vx', 'vy')):
    """A confirmed, a coasting and a tentative one; the covariances differ in every element."""
    n = len(states)
    root = np.arange(1.0, 1.0 + n * n).reshape(n, n) / 10.0
    return Estimate(
        stamp_ns=STAMP,
        frame_id='map',
        xyz=np.array([[100.0, -50.0, -8.0]] * 3, np.float32),
        state_names=states,
        state=np.array([np.linspace(100.0, -3.0, n)] * 3),
        covariance=np.array([root @ root.T + np.eye(n)] * 3),
        model_names=('heading_000',),
        probabilities=np.ones((3, 1)),
        extras={
            'track_id': np.array([3, 5, 9]),
            'track_state': np.array([1, 2, 0]),
            'existence': np.array([0.9, np.nan, 0.2]),
            'target_id': np.array([17, -1, -1]),
        },
    )


def obstacle(velocity=(1.0, 0.5), z=-8.0):
    columns = {'px': 30.0, 'py': 40.0, 'pz': z, 'vx': velocity[0], 'vy': velocity[1]}
    columns |= {'vel_cov_x_x': 0.1, 'vel_cov_x_y': 0.02, 'vel_cov_y_y': 0.3}
    columns |= {'place_cov_x_x': 1.0, 'place_cov_x_y': 0.5, 'place_cov_x_z': 0.25}
    columns |= {'place_cov_y_y': 2.0, 'place_cov_y_z': 0.125, 'place_cov_z_z': 4.0}
    columns |= {'collision_probability': 0.07, 'cpa_time': np.nan, 'track_id': 12}
    columns |= {'track_state': 1}
    return Estimate(
        stamp_ns=STAMP,
        frame_id='odom',
        xyz=np.array([[30.0, 40.0, z]]),
        state_names=('range', 'bearing', 'vertical_offset'),
        state=np.array([[5.0, 0.1, 3.0]]),
        covariance=np.eye(3)[np.newaxis],
        model_names=('above', 'below'),
        probabilities=np.array([[0.25, 0.75]]),
        extras={name: np.array([value]) for name, value in columns.items()},
    )


def published(estimate, make, system='diver', types=tuple(TOPICS), origin=HARBOUR):
    """All messages by topic, written to CDR and read again."""
    found, store = {}, typestore()
    for topic, message in Neighbours(system, types, lambda: origin).of(
        estimate, make, lambda name: True
    ):
        raw = store.serialize_cdr(message, message.__msgtype__)
        found.setdefault(topic, []).append(store.deserialize_cdr(raw, message.__msgtype__))
    return found


def test_only_what_is_asked_for_and_wanted_is_made(make):
    assert set(published(divers(), make, types=(DETECTIONS,))) == {'tracks_3d'}
    neighbours = Neighbours('diver', (CONTACT, GEO_POSE), lambda: HARBOUR)
    assert neighbours.topics == {'contact': CONTACT, 'geo_pose': GEO_POSE}
    assert list(neighbours.of(divers(), make, lambda name: False)) == []


def test_a_contact_has_place_velocity_and_both_covariances(make):
    estimate = divers()
    contacts = published(estimate, make)['contact']
    assert [contact.id for contact in contacts] == ['diver_3', 'diver_5']
    first = contacts[0]
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (7, 5)
    assert first.header.frame_id == 'map' and first.source == 'sonar_imm.diver'
    assert (first.origin_kind, first.status, first.shape.type) == (0, 0, 0)
    assert first.classification[0].class_id == 'diver'
    assert first.existence_probability == pytest.approx(0.9)
    assert contacts[1].existence_probability == 1.0  # its hits are counted, and it is confirmed
    at, moving = first.kinematics.pose, first.kinematics.twist
    assert (at.pose.position.x, at.pose.position.y, at.pose.position.z) == (
        *estimate.state[0, :2],
        -8.0,
    )
    assert (moving.twist.linear.x, moving.twist.linear.y) == tuple(estimate.state[0, 2:])
    place, velocity = (c.covariance.reshape(6, 6) for c in (at, moving))
    np.testing.assert_array_equal(place[:2, :2], estimate.covariance[0, :2, :2])
    np.testing.assert_array_equal(velocity[:2, :2], estimate.covariance[0, 2:, 2:])
    assert place[2, 2] == velocity[2, 2] == place[5, 5] == UNKNOWN_VARIANCE
    assert first.kinematics.orientation_availability == 0
    assert [(each.key, each.value) for each in first.attributes] == [('target_id', '17')]


def test_a_diver_with_a_depth_has_its_variance_and_a_height(make):
    estimate = divers(('px', 'py', 'pz', 'vx', 'vy', 'vz'))
    found = published(estimate, make)
    place = found['contact'][0].kinematics.pose.covariance.reshape(6, 6)
    np.testing.assert_array_equal(place[:3, :3], estimate.covariance[0, :3, :3])
    expected = HARBOUR.geodetic(estimate.state[0, :3])
    assert found['geo_pose'][0].pose.position.altitude == pytest.approx(expected[2], abs=1e-9)


def test_a_geo_pose_reads_back_as_a_fix(make):
    (first, second) = published(divers(), make)['geo_pose']
    assert (first.header.frame_id, second.header.frame_id) == ('diver_3', 'diver_5')
    fix = read_geodetic(first)
    back = HARBOUR.local(fix.latitude, fix.longitude, 32.0)
    np.testing.assert_allclose(back[:2], divers().state[0, :2], atol=1e-3)
    assert np.isnan(first.pose.position.altitude)  # the depth is not estimated
    turn = first.pose.orientation
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 0.0)


def test_without_an_origin_contacts_are_unresolved_and_geo_poses_stay_away(make):
    found = published(divers(), make, origin=None)
    assert set(found) == {'contact', 'contacts', 'tracks_3d'}
    assert np.isnan(found['contact'][0].geo_pose.position.latitude)


def test_the_array_holds_the_same_contacts_and_is_empty_without_tracks(make):
    found = published(divers(), make)
    (array,) = found['contacts']
    assert [contact.id for contact in array.contacts] == ['diver_3', 'diver_5']
    tentative = divers()
    tentative.extras['track_state'][:] = 0
    nobody = published(tentative, make, types=(CONTACTS, DETECTIONS))
    assert len(nobody['contacts'][0].contacts) == len(nobody['tracks_3d'][0].detections) == 0


def test_an_obstacle_has_the_columns_of_place_and_velocity(make):
    (contact,) = published(obstacle(), make, 'obstacle')['contact']
    place, velocity = (
        c.covariance.reshape(6, 6) for c in (contact.kinematics.pose, contact.kinematics.twist)
    )
    np.testing.assert_array_equal(
        place[:3, :3], [[1.0, 0.5, 0.25], [0.5, 2.0, 0.125], [0.25, 0.125, 4.0]]
    )
    np.testing.assert_array_equal(velocity[:2, :2], [[0.1, 0.02], [0.02, 0.3]])
    shown = {each.key: each.value for each in contact.attributes}
    assert shown == {'above': '0.25', 'collision_probability': '0.07'}


def test_velocity_and_height_that_are_not_known_are_marked(make):
    found = published(obstacle((np.nan, np.nan), np.nan), make, 'obstacle')
    (contact,) = found['contact']
    assert contact.kinematics.twist.covariance[0] == -1.0
    assert contact.kinematics.pose.pose.position.z == 0.0
    covariance = contact.kinematics.pose.covariance.reshape(6, 6)
    assert covariance[2].tolist() == [0.0, 0.0, UNKNOWN_VARIANCE, 0.0, 0.0, 0.0]
    assert np.isnan(contact.geo_pose.position.altitude)


def test_a_track_without_a_place_is_left_out(make):
    nowhere = obstacle()
    nowhere.extras['px'][0] = np.nan
    found = published(nowhere, make, 'obstacle')
    assert set(found) == {'contacts', 'tracks_3d'} and not len(found['contacts'][0].contacts)


def test_detections_hold_place_score_and_no_size(make):
    estimate = divers()
    (array,) = published(estimate, make)['tracks_3d']
    first = array.detections[0]
    result = first.results[0]
    assert (first.id, result.hypothesis.class_id) == ('diver_3', 'diver')
    assert result.hypothesis.score == pytest.approx(0.9)
    assert first.bbox.center.position.x == result.pose.pose.position.x == estimate.state[0, 0]
    assert first.bbox.size.x == 0.0
    np.testing.assert_array_equal(
        result.pose.covariance.reshape(6, 6)[:2, :2], estimate.covariance[0, :2, :2]
    )
    ahead = read_detections_3d(array)  # our own reader takes them for echoes of those places
    assert len(ahead.range) == 2
