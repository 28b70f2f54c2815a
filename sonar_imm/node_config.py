# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of a node besides those of its tracker; offline tools read them too."""

from __future__ import annotations

from collections.abc import Sequence

from attrs import frozen

from msg_adapters.inputs import inputs_of

from .acoustics.geodesy import Origin
from .parameters import Config, ConfigError, constant, did_you_mean, inherited, live, parameter
from .trackers import System
from .trackers.shared_parameters import OriginParameters


@frozen(kw_only=True)
class NodeConfig(Config):
    """Parameters of every node besides those of its tracker."""

    # fmt: off
    # ROS 2 has a parameter for it, qos_overrides.TOPIC.subscription.depth.
    queue_depth: int = constant(50, '',
        'messages that an input queue holds while the tracker is busy', range=(1, 100000))
    max_wait: float = live(0.0, 's',
        'messages that waited longer are dropped and counted; 0: never',
        range=(0.0, 1e6))
    frame_id: str = parameter('', '',
        'frame that the input must be in; empty: the frame of the first message accepted')
    world_frame_convention: str = parameter('enu', '',
        'axes of the input: enu (world east, north, up; vehicle forward, port, up) or ned '
        '(north, east, down; forward, starboard, down); the output is always enu',
        choices=('enu', 'ned'))
    input_types: tuple[str, ...] = parameter((), '',
        'message types of inputs that have several, e.g. fix=geometry_msgs/msg/PointStamped; '
        'else the first type in docs/topics.md', kind='str[]')
    max_revisions: int = live(100, '',
        'most estimates, changed by one late message, that are published again, oldest first; 0: '
        'only the newest estimate',
        range=(0, 1_000_000))
    autostart: bool = parameter(True, '',
        'configure and activate at the start; false: a lifecycle manager or `ros2 lifecycle set` '
        'does')
    stale_after: float = live(10.0, 's',
        'time after which diagnostics call an input stale', range=(0.01, 1e6))
    max_age: float = live(0.0, 's',
        'age of the newest estimate above which diagnostics warn; 0: one second, or three '
        'periods of the estimates if that is longer', range=(0.0, 1e6))
    state_file: str = parameter('', '',
        'file that keeps the state, so that a restarted node continues its tracks; empty: none')
    state_max_age: float = parameter(300.0, 's',
        'state_file is not used when saved longer ago than this, or further from the first '
        'measurement', range=(0.0, 1e6))
    # fmt: on

    def stated_origin(self) -> Origin | None:
        """Where the frame of the navigation lies on Earth, None where that is not stated."""
        return None


@frozen(kw_only=True)
class BathymetryNodeConfig(OriginParameters, NodeConfig):
    """A swath is looked at while it is surveyed, and no ping needs the one before. Besides, where
    the frame of the navigation lies on Earth, for charts."""

    # fmt: off
    max_wait: float = inherited(NodeConfig, 'max_wait', 0.5)
    # fmt: on


@frozen(kw_only=True)
class TracksNodeConfig(NodeConfig):
    """A late message has its window computed again: up to a second, while others go on coming.
    Whoever steers by a track needs the one of now."""

    # fmt: off
    queue_depth: int = inherited(NodeConfig, 'queue_depth', 500, constant=True)
    max_wait: float = inherited(NodeConfig, 'max_wait', 2.0)
    # fmt: on


@frozen(kw_only=True)
class ObstacleNodeConfig(OriginParameters, TracksNodeConfig):
    """Besides, where the frame of the navigation lies on Earth, for exports."""


@frozen(kw_only=True)
class DetectorNodeConfig(Config):
    """Parameters of the node that detects echoes in images, besides those of the detector."""

    # fmt: off
    queue_depth: int = inherited(NodeConfig, 'queue_depth', 10, constant=True)
    autostart: bool = inherited(NodeConfig, 'autostart', True)
    input_types: tuple[str, ...] = inherited(NodeConfig, 'input_types', (),
        description='message type of the images, e.g. image=sensor_msgs/msg/Image; empty: '
        'marine_acoustic_msgs/msg/ProjectedSonarImage')
    stale_after: float = inherited(NodeConfig, 'stale_after', 10.0)
    # fmt: on


def node_config_type(system: System) -> type[NodeConfig]:
    """Class of the parameters of the node of `system`, besides those of its tracker."""
    found: type[NodeConfig] = globals()[system.node_config]
    return found


def chosen_types(system: str, given: Sequence[str]) -> dict[str, str]:
    """Return the message type of each input of the node of `system` that can be one of several: in
    ROS one topic name has one type, so the user has to say which.

    :param given: parameter ``input_types``.
    :returns: type by input name; the first type of an input that `given` does not name.
    :raises ConfigError: with one sentence for each mistake.
    """
    several = {topic.name: topic.readers for topic in inputs_of(system) if len(topic.readers) > 1}
    chosen, problems = {name: next(iter(readers)) for name, readers in several.items()}, []
    for entry in given:
        name, _, kind = entry.partition('=')
        if name not in several:
            problems.append(
                f"input_types: '{entry}' is not <input>=<type> of one of "
                f'{", ".join(several)}{did_you_mean(name, several)}'
            )
        elif kind not in several[name]:
            problems.append(
                f"input_types: {name} must be one of {', '.join(several[name])}, got '{kind}'"
                f'{did_you_mean(kind, several[name])}'
            )
        chosen[name] = kind
    if problems:
        raise ConfigError(*problems)
    return chosen
