import subprocess
import sys

from msg_adapters.inputs import INPUTS
from sonar_imm.recordings.messages import ros_message, typestore
from sonar_imm.trackers import SYSTEMS


def test_every_tracker_has_inputs_whose_readers_say_no_politely():
    import pytest

    from sonar_imm.measurements import Rejection

    assert set(INPUTS) == set(SYSTEMS)
    for topics in INPUTS.values():
        for topic in topics:
            assert topic.description and not topic.name.startswith('/')
            for name, read in topic.readers.items():
                if name.startswith('marine_acoustic_msgs/'):  # see test_detections.py
                    continue
                assert name in typestore().types
                with pytest.raises(Rejection):  # an empty message has no stamp
                    read(ros_message(name))
                assert topic.doubt(ros_message(name)) in (None, 'zero_covariance', 'no_frame')


def test_the_adapters_load_neither_rclpy_nor_rosbags():
    code = (
        'import sys, msg_adapters.inputs, msg_adapters.estimates; '
        'sys.exit(any(name in sys.modules for name in ("rclpy", "rosbags")))'
    )
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0
