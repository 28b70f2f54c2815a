# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from msg_adapters.arrivals import write_arrivals
from sonar_imm.measurements import Arrivals, Fix, Rejection
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.topics import fitting_topics
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.recordings.writer import BagWriter

POINT = 'geometry_msgs/msg/PointStamped'


def ping():
    return write_arrivals(
        Arrivals(
            stamp_ns=10**18, tx_id=[0], rx_id=[1], tx=[[0.0, 0.0, 0.0]], rx=[[1.0, 0.0, 0.0]],
            toa=[0.1], var_toa=[np.nan], bearing=[np.nan], var_bearing=[np.nan], frame_id='map',
        ),
        ros_message,
    )  # fmt: skip


@pytest.fixture
def mixed(tmp_path, fix_message):
    """A bag with inputs, a refused fix, truth, and things that are not for the tracker."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/usbl/fix', fix_message(0), 1)
        bag.write('/usbl/fix', fix_message(1, covariance=None), 2)
        bad = fix_message(2)
        bad.pose.covariance[1] = 0.7
        bag.write('/usbl/fix', bad, 3)
        zero = fix_message(3)
        zero.pose.covariance[:] = 0.0
        bag.write('/usbl/fix', zero, 4)
        bag.write('/arrivals', ping(), 5)
        bag.write('/truth/fix', fix_message(9), 6)
        bag.write('/pose', fix_message(5), 7)
        true = TrueTrack(1, np.array([5]), np.array([[1, 2]]), np.zeros((1, 2)))
        for _, topic, message in records_of(true, 'm'):
            bag.write(topic, message, 8)
        bag.write('/other/fix', ros_message('std_msgs/msg/String', data='no fix'), 9)
    return tmp_path / 'bag'


def test_inputs_are_found_by_type_and_last_name(mixed):
    with BagReader(mixed) as bag:
        fitting = fitting_topics(bag, 'diver')
        assert {name: entry.name for name, entry in fitting.items()} == {
            '/usbl/fix': 'fix',
            '/arrivals': 'arrivals',
        }


def test_measurements_and_rejections_come_in_recorded_order(mixed):
    with BagReader(mixed) as bag:
        received = list(measurements_of(bag, 'diver'))
        assert [(item.topic, item.log_ns) for item in received] == [
            ('/usbl/fix', 1),
            ('/usbl/fix', 2),
            ('/usbl/fix', 3),
            ('/usbl/fix', 4),
            ('/arrivals', 5),
        ]
        kinds = [type(item.measurement) for item in received]
        assert kinds == [Fix, Fix, Rejection, Fix, Arrivals]
        assert received[2].measurement.reason == 'bad_covariance'
        assert (
            received[1].measurement.covariance is None
            and received[3].measurement.covariance is None
        )
        assert bag.problems == [
            'topic /usbl/fix: 1 messages have a covariance of zeros, which is taken as unknown'
        ]


def test_a_topic_map_chooses(mixed):
    with BagReader(mixed) as bag:
        received = list(measurements_of(bag, 'diver', {'/pose': 'fix'}, world_frame='ned'))
        assert len(received) == 1 and received[0].measurement.position.tolist() == [2.0, 5.0, 0.0]


@pytest.mark.parametrize(
    'topics, words',
    [
        ({'/pose': 'fixx'}, ["no input 'fixx'", "'fix'"]),
        ({'/posee': 'fix'}, ["'/pose'"]),
        ({'/other/fix': 'fix'}, ['std_msgs/msg/String', POINT]),
    ],
)
def test_a_wrong_topic_map_is_explained(mixed, topics, words):
    with BagReader(mixed) as bag, pytest.raises(BagError) as caught:
        list(measurements_of(bag, 'diver', topics))
    assert all(word in caught.value.sentence for word in words)


def test_when_nothing_fits_it_lists_what_is_there(tmp_path, fix_message):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/pose', fix_message(5), 7)
        bag.write('/text', ros_message('std_msgs/msg/String'), 7)
    with BagReader(tmp_path / 'bag') as bag, pytest.raises(BagError) as caught:
        fitting_topics(bag, 'diver')
    for words in ("'fix'", "'fixes'", "'arrivals'", '/text (std_msgs/msg/String)', '/pose as fix'):
        assert words in caught.value.sentence


def test_an_empty_bag_says_so(tmp_path):
    with BagWriter(tmp_path / 'bag'):
        pass
    with BagReader(tmp_path / 'bag') as bag, pytest.raises(BagError, match='is empty'):
        fitting_topics(bag, 'diver')


def test_one_topic_with_two_types_is_rejected_message_by_message(tmp_path, fix_message):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/fix', fix_message(0), 1)
        bag.write('/fix', ros_message('std_msgs/msg/String'), 2)
    with BagReader(tmp_path / 'bag') as bag:
        received = [item.measurement for item in measurements_of(bag, 'diver')]
    assert isinstance(received[0], Fix) and received[1].reason == 'bad_type'
