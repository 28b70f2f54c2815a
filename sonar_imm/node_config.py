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

"""What a node can be told besides the parameters of its tracker; offline tools read it too."""

from __future__ import annotations

from attrs import frozen

from msg_adapters.inputs import inputs_of, InputTopic

from .parameters import Config, inherited, parameter, ParameterSpec
from .trackers import System


@frozen(kw_only=True)
class NodeConfig(Config):
    """What every node can be told besides the parameters of its tracker."""

    queue_depth: int = parameter(
        50, 'messages an input holds while the tracker is busy', low=1, high=100000
    )
    max_wait: float = parameter(
        0.0,
        'a message that waited longer than this while the tracker was busy is dropped, '
        'and counted, so that the output does not lag; 0: never',
        unit='s',
        low=0.0,
        high=1e6,
        read_only=False,
    )
    frame_id: str = parameter(
        '', 'frame the input must be in; empty: that of the first message accepted'
    )
    world_frame_convention: str = parameter(
        'enu',
        'axes of the input: enu (world x east, y north, z up; vehicle x forward, y port, z up) or '
        'ned (world x north, y east, z down; vehicle x forward, y starboard, z down); the output '
        'is always enu',
        choices=('enu', 'ned'),
    )
    publish_revisions: bool = parameter(
        True,
        'late input changes estimates already made: publish those again too, oldest first; '
        'false: only the newest',
        read_only=False,
    )
    max_revisions: int = parameter(
        100,
        'most earlier estimates published again for one late message, the newest of them; the '
        'others are counted; 0: all',
        low=0,
        high=1_000_000,
        read_only=False,
    )
    diagnostics_period: float = parameter(
        1.0, 'time between two messages on /diagnostics', unit='s', low=0.05, high=3600.0
    )
    stale_after: float = parameter(
        10.0,
        'silence after which diagnostics call the input stale',
        unit='s',
        low=0.01,
        high=1e6,
        read_only=False,
    )
    state_file: str = parameter(
        '',
        'file in which the state of the tracker is kept, so that a node that is started again '
        'goes on with its tracks; empty: none',
    )
    state_interval: float = parameter(
        10.0,
        'time between two states saved while running; one is saved at the end in any case',
        unit='s',
        low=0.1,
        high=86400.0,
    )
    state_max_age: float = parameter(
        300.0,
        'a state is not used when it was saved longer ago, or when the first measurement is '
        'further from its last one',
        unit='s',
        low=0.0,
        high=1e6,
    )


@frozen(kw_only=True)
class PlacedNodeConfig(NodeConfig):
    """What is tracked has a place in the world."""

    use_tf_static: bool = parameter(
        False,
        'hear /tf_static, and turn what comes in another frame that is fixed to that of the '
        'tracks into it, instead of refusing it',
    )


@frozen(kw_only=True)
class BathymetryNodeConfig(PlacedNodeConfig):
    """A swath is looked at while it is surveyed, and no ping needs the one before."""

    max_wait: float = inherited(NodeConfig, 'max_wait', 0.5)


@frozen(kw_only=True)
class ReplayNodeConfig(PlacedNodeConfig):
    """A late message has its window computed again: up to a second, while others go on coming."""

    queue_depth: int = inherited(NodeConfig, 'queue_depth', 500)


@frozen(kw_only=True)
class DetectorNodeConfig(Config):
    """What the node of the detector of images can be told besides the detector."""

    queue_depth: int = inherited(
        NodeConfig,
        'queue_depth',
        10,
        description='images held while the node is busy',
        high=1000,
    )
    diagnostics_period: float = inherited(NodeConfig, 'diagnostics_period', 1.0)
    stale_after: float = inherited(NodeConfig, 'stale_after', 10.0)


def node_config_type(system: System) -> type[NodeConfig]:
    """What the node of `system` can be told besides the parameters of its tracker."""
    found: type[NodeConfig] = globals()[system.node_config]
    return found


def hears_transforms(node: NodeConfig) -> bool:
    """Whether /tf_static is heard for the frames of measurements."""
    return isinstance(node, PlacedNodeConfig) and node.use_tf_static


def type_specs(system: str) -> tuple[ParameterSpec, ...]:
    """The parameters ``<input>_type`` of the node of `system`."""
    return tuple(spec for topic in inputs_of(system) if (spec := type_spec(topic)) is not None)


def type_spec(topic: InputTopic) -> ParameterSpec | None:
    """``<input>_type``, needed where an input can be one of several message types; else None.

    In ROS one topic name has one type, so the user has to say which.
    """
    if len(topic.readers) == 1:
        return None
    return ParameterSpec(
        name=f'{topic.name}_type',
        kind='str',
        default=next(iter(topic.readers)),
        description=f"message type of the input '{topic.name}'; a recording knows its own",
        choices=tuple(topic.readers),
    )
