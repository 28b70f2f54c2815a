"""Which topics each tracker subscribes to, and how to read every message type it takes there.

The nodes subscribe by this table and recordings are read by it, so that live and recorded data are
read by the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from attrs import frozen

from .array_depth import read_array_depth
from .array_records import read_csdm, read_pressure, read_trace
from .arrivals import read_arrivals
from .detections import (
    read_detections,
    read_laser_scan,
    read_pose_array,
    read_sonar_detections,
    read_sonar_ranges,
)
from .fixes import doubt_fix, read_fix
from .navigation import doubt_navigation, read_dvl, read_navigation, read_range
from .snapshots import read_snapshot


@frozen
class InputTopic:
    """One input of a tracker.

    name: relative topic name; readers: measurement readers by message type. A reader takes
    ``(message, *, world_frame='enu')`` and raises `Rejection` for a message it cannot use.
    doubt: gives a reason code to count when a message can be used but deserves a warning.
    scans: several messages with one stamp are one scan, so that equal stamps are no mistake.
    one_topic: several topics are several instruments, each for a tracker of its own.
    settings: parameters of the tracker that its readers take as keywords too: what messages do not
    say themselves.
    companion: describes another input; found by its topic name, never enough alone.
    """

    name: str
    description: str
    readers: Mapping[str, Callable[..., Any]]
    doubt: Callable[[Any], str | None] = lambda message: None
    scans: bool = False
    one_topic: bool = False
    settings: tuple[str, ...] = ()

    def reader(
        self, type_name: str, world_frame: str, settings: Mapping[str, Any]
    ) -> Callable[[Any], Any]:
        """Give the reader of a message type with its settings; `settings` may hold more."""
        told = {name: settings[name] for name in self.settings if name in settings}
        return partial(self.readers[type_name], world_frame=world_frame, **told)

    companion: bool = False


INPUTS: dict[str, tuple[InputTopic, ...]] = {
    'bathymetry': (
        InputTopic(
            'snapshot',
            'complex snapshots of a side-scan array, one row per range bin',
            {
                'sensor_msgs/msg/PointCloud2': read_snapshot,
            },
            one_topic=True,
        ),
    ),
    'diver': (
        InputTopic(
            'fix',
            'position fixes in a local metric frame',
            {
                'geometry_msgs/msg/PoseWithCovarianceStamped': read_fix,
                'geometry_msgs/msg/PointStamped': read_fix,
            },
            doubt=doubt_fix,
            scans=True,
        ),
        InputTopic(
            'arrivals',
            'arrival times of one ping, one row per transmitter-receiver pair',
            {
                'sensor_msgs/msg/PointCloud2': read_arrivals,
            },
        ),
    ),
    'fathometer': (
        InputTopic(
            'csdm',
            'cross-spectra of a vertical array, one row per frequency',
            {
                'sensor_msgs/msg/PointCloud2': read_csdm,
            },
            one_topic=True,
        ),
        InputTopic(
            'pressure',
            'pressure at the hydrophones of a vertical array, one row per sample',
            {
                'sensor_msgs/msg/PointCloud2': read_pressure,
            },
            one_topic=True,
        ),
        InputTopic(
            'trace',
            'ready-made traces, one row per depth',
            {
                'sensor_msgs/msg/PointCloud2': read_trace,
            },
            one_topic=True,
        ),
        InputTopic(
            'array_depth',
            'depth of the deepest hydrophone, from a companion instrument',
            {
                'geometry_msgs/msg/PointStamped': read_array_depth,
                'geometry_msgs/msg/PoseWithCovarianceStamped': read_array_depth,
            },
            companion=True,
        ),
    ),
    'obstacle': (
        InputTopic(
            'detections',
            'echoes of one ping of a forward-looking sonar, also when there are none',
            {
                'sensor_msgs/msg/PointCloud2': read_detections,
                'sensor_msgs/msg/LaserScan': read_laser_scan,
                'geometry_msgs/msg/PoseArray': read_pose_array,
                'marine_acoustic_msgs/msg/SonarDetections': read_sonar_detections,
                'marine_acoustic_msgs/msg/SonarRanges': read_sonar_ranges,
            },
            settings=('beam_axes', 'sound_speed'),
        ),
        InputTopic(
            'nav',
            'pose of the vehicle',
            {
                'nav_msgs/msg/Odometry': read_navigation,
            },
            doubt=doubt_navigation,
            settings=('nav_twist_frame',),
        ),
        InputTopic(
            'altitude',
            'height above the sea floor',
            {
                'sensor_msgs/msg/Range': read_range,
                'marine_acoustic_msgs/msg/Dvl': read_dvl,
            },
        ),
    ),
}
