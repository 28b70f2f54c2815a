"""Scenes become bags: each class by its own writer, in the order of reception."""

from attrs import frozen
import numpy as np
import pytest

from msg_adapters.estimates import write_truth
from sonar_imm.measurements import Fix
from sonar_imm.recordings import scenes
from sonar_imm.recordings.messages import ros_message
from sonar_imm.recordings.reader import BagReader
from sonar_imm.simulation.scene import Received, Scene, TrueTrack

START_NS = 1_700_000_000_000_000_000


def fix(offset_ns):
    return Fix(stamp_ns=START_NS + offset_ns, position=(1.0, 2.0, 0.0), frame_id='map')


def logged(path):
    with BagReader(path) as bag:
        return [(item.topic, item.log_ns - START_NS) for item in bag.messages()]


def test_late_measurements_are_recorded_when_they_were_received(tmp_path):
    scene = Scene(
        (Received(START_NS + 9, fix(1)), Received(START_NS + 4, fix(3))),
        (TrueTrack(7, START_NS + np.array([2, 6]), np.zeros((2, 3)), np.ones((2, 2))),),
    )
    report = scenes.write_scene(scene, tmp_path / 'bag', provenance={})
    assert report.messages == {'/fix': 2, '/truth/estimate': 2}
    assert logged(tmp_path / 'bag') == [
        ('/truth/estimate', 2),
        ('/fix', 4),
        ('/truth/estimate', 6),
        ('/fix', 9),
    ]


def test_another_system_adds_a_writer_of_its_truth(tmp_path, monkeypatch):
    @frozen
    class Buoy:
        stamp_ns: int

    def buoy_records(buoy, frame_id):
        yield (
            buoy.stamp_ns,
            '/truth/buoy',
            write_truth(
                [[0.0, 0.0]],
                [[0.0, 0.0]],
                [1],
                stamp_ns=buoy.stamp_ns,
                frame_id=frame_id,
                make=ros_message,
            ),
        )

    scene = Scene((Received(START_NS + 1, fix(0)),), (Buoy(START_NS + 2),))
    with pytest.raises(KeyError):
        scenes.write_scene(scene, tmp_path / 'unknown', provenance={})
    assert not (tmp_path / 'unknown').exists()
    monkeypatch.setitem(scenes.TRUTHS, Buoy, buoy_records)
    scenes.write_scene(scene, tmp_path / 'bag', provenance={})
    assert logged(tmp_path / 'bag') == [('/fix', 1), ('/truth/buoy', 2)]
