"""Input topics of the diver tracker."""

from __future__ import annotations

from sonar_imm.measurements import Arrivals, Fix, Fixes

from ..arrivals import read_arrivals, write_arrivals
from ..fixes import doubt_fix, read_fix, write_fix
from ..scans import doubt_scan, read_poses, read_scan, write_scan
from .topic import InputTopic

TOPICS = (
    InputTopic(
        'fix',
        'position fixes in a local metric frame',
        measurement=Fix,
        readers={
            'geometry_msgs/msg/PoseWithCovarianceStamped': read_fix,
            'geometry_msgs/msg/PointStamped': read_fix,
        },
        write=write_fix,
        doubt=doubt_fix,
        scans=True,
    ),
    InputTopic(
        'fixes',
        'all position fixes of one scan, also when there are none',
        measurement=Fixes,
        readers={
            'sensor_msgs/msg/PointCloud2': read_scan,
            'geometry_msgs/msg/PoseArray': read_poses,
        },
        write=write_scan,
        doubt=doubt_scan,
    ),
    InputTopic(
        'arrivals',
        'arrival times of one ping, one row per transmitter-receiver pair',
        measurement=Arrivals,
        readers={'sensor_msgs/msg/PointCloud2': read_arrivals},
        write=write_arrivals,
    ),
)
