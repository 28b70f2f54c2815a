"""Input topics of the bathymetry tracker."""

from __future__ import annotations

from sonar_imm.measurements import Snapshot

from ..snapshots import read_snapshot, write_snapshot
from .topic import InputTopic

TOPICS = (
    InputTopic(
        'snapshot',
        'complex snapshots of a side-scan array, one row per range bin',
        measurement=Snapshot,
        readers={'sensor_msgs/msg/PointCloud2': read_snapshot},
        write=write_snapshot,
        one_topic=True,
    ),
)
