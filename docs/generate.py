# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Write what follows from the code and from the results of studies.

These are `config/<system>.yaml`, `docs/parameters/<system>.md` and the pages with measured numbers
(`result_pages.py`). Run it with ``make generate``; a test compares the files with what is there.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
import sys
import textwrap

import yaml

from sonar_imm.node_config import DetectorNodeConfig, node_config_type, NodeConfig
from sonar_imm.parameters import markdown_table, ParameterSpec
from sonar_imm.trackers import System, SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'docs'))

from result_pages import pages  # noqa: E402

YAML_HEAD = """\
# Parameters of {name}_node with their defaults; every line may be left out.
# Written by `make docs` from the configuration classes. Copy it, then change the copy:
#   ros2 run sonar_imm {name}_node --ros-args --params-file my_{name}.yaml
#   sonar-imm track BAG OUT_DIR --params my_{name}.yaml
# Doubles need their decimal point (1500.0, not 1500), or ROS 2 refuses them.
/**:
  ros__parameters:
"""

MARKDOWN = """\
# Parameters of the {what}

{summary}. `config/{name}.yaml` has all with their ranges, ready to copy.
A star: may change while the node runs. [Types of values](nodes.md).

## The ten that matter

{matter}
## {part}

{tracker}
## Node

{node}"""

NODES = """\
# Parameters of every node

Offline tracking ignores them. A wrong value is refused with one sentence, a misspelt name gives a
warning. A default with a decimal point is a double, one without an integer, one in quotes a
string.

{node}"""

DETECTOR = (
    'Echoes in images of a forward-looking sonar, for the obstacle tracker. Offline: section '
    '`fls_detector` of a parameter file, or `--set`'
)

# Parameters that most users set, and when; everything else holds for most sonars.
MATTER = {
    'diver': {
        'fix_std': 'fixes state no covariance',
        'covariance_scale': 'a warning says that fixes scatter more, or less, than stated',
        'target': 'not a diver: `rov`, `fish`, `boat` or `ship`',
        'dimensions': '3 for the depth, from fixes with z or from arrival times',
        'max_tracks': '1 when a single target is there',
        'detection_probability': 'not nine of ten scans show a target',
        'clutter_density': 'the density of false fixes is known',
        'coverage_sector': 'the sensor sees a sector only',
        'sound_speed': 'arrival times; with `sound_speed_std` if unsure',
        'receiver_position_std': 'arrival times: how well receivers were surveyed',
    },
    'obstacle': {
        'sonar_lever': 'where the sonar sits on the vehicle',
        'sonar_mount_rpy_deg': 'how it is turned there; a pitch of some degrees is usual',
        'bearing_positive': 'bearings grow to starboard',
        'vertical_fov_deg': 'vertical opening of the beam',
        'horizontal_fov_deg': 'width of the sector',
        'max_range': 'range that the sonar is set to',
        'range_std': 'detections state no variance; `bearing_std_deg` likewise',
        'detection_probability': 'not nine of ten pings show an obstacle',
        'navigation_grade': 'nav is worse than an inertial system with a DVL',
        'safety_radius': 'distance of a collision; with `safety_height`',
    },
    'bathymetry': {
        'sonar_height': 'height at the start, unless altitudes come',
        'side': '`port` for an array that looks there',
        'tilt_deg': 'tilt of the array below the horizon',
        'element_spacing_wavelengths': 'staves are not half a wavelength apart',
        'conjugate': 'the floor comes out mirrored',
        'sound_speed_profile': 'rays bend; else `sound_speed`',
        'noise_variance': 'the water column is not clean',
        'sonar_lever': 'where the array sits on the ship; with `sonar_mount_rpy_deg`',
        'layover': '`resolved` for both surfaces of a ledge',
        'attitude_std_deg': 'quality of the motion sensor',
    },
    'fathometer': {
        'phones': 'hydrophones of the array',
        'element_spacing': 'metres between them',
        'frequency_max': 'processed band; with `frequency_min`',
        'array_depth': 'unless it is published; reflectors are below it',
        'depth_min': 'window of depths; with `depth_max`',
        'sound_speed': 'of the water; with `sound_speed_std`',
        'order_max': 'more reflectors at a time',
        'polarity': '`both` where a layer may be softer than the one above',
        'pulse_width': 'traces of an instrument: width of its pulse',
        'record_seconds': 'sound of a vertical array: seconds in one record',
    },
    'fls_detector': {
        'image_scale': 'samples are powers, or levels in decibels',
        'image_order': 'all ranges of a beam come together',
        'image_near_range': 'images state no ranges; with `image_far_range` and `image_fov_deg`',
        'image_first_beam': 'images state no bearings and begin to starboard',
        'beam_width_deg': 'width of a beam of your sonar',
        'range_resolution': 'length of the echo of a point',
        'threshold_margin_db': 'too many false echoes, or too few echoes',
        'join_distance': 'one obstacle gives several echoes, or two give one',
        'min_range': 'echoes of the own vehicle reach farther',
        'sweep_sector_deg': 'a scanning sonar: sector that is used',
    },
}


def generated() -> dict[str, str]:
    """Give every generated file: its text by its path below the project root."""
    files = {}
    files['docs/parameters/nodes.md'] = NODES.format(node=markdown_table(NodeConfig.specs()))
    for system in SYSTEMS.values():
        tracker = system.config_type().specs()
        files[f'config/{system.name}.yaml'] = parameter_file(system)
        files[f'docs/parameters/{system.name}.md'] = MARKDOWN.format(
            name=system.name,
            what=f'{system.name} tracker',
            part='Tracker',
            summary=system.summary[0].upper() + system.summary[1:],
            matter=matter_table(system.name, tracker),
            tracker=markdown_table(tracker),
            node=of_this_node(node_specs(system)),
        )
    detector = DetectorConfig.specs()
    node = DetectorNodeConfig.specs()
    files['config/fls_detector.yaml'] = _parameter_file('fls_detector', (*detector, *node))
    files['docs/parameters/fls_detector.md'] = MARKDOWN.format(
        name='fls_detector',
        what='detector of sonar images',
        part='Detector',
        summary=DETECTOR,
        matter=matter_table('fls_detector', detector),
        tracker=markdown_table(detector),
        node=of_this_node(node),
    )
    return files | pages()


def matter_table(name: str, specs: Sequence[ParameterSpec]) -> str:
    """The parameters that most users set, in the order in which they meet them."""
    known = {spec.name for spec in specs}
    rows = ['| parameter | when to set it |', '|---|---|']
    for parameter, when in MATTER[name].items():
        if parameter not in known:
            raise LookupError(f'{name} has no parameter {parameter}')
        rows.append(f'| `{parameter}` | {when} |')
    return '\n'.join(rows) + '\n'


def parameter_file(system: System) -> str:
    """Give the ROS 2 parameter file of `system`, every parameter with its description above."""
    return _parameter_file(system.name, (*system.config_type().specs(), *node_specs(system)))


def _parameter_file(name: str, specs: tuple[ParameterSpec, ...]) -> str:
    return YAML_HEAD.format(name=name) + '\n'.join(_entry(spec) for spec in specs)


def node_specs(system: System) -> tuple[ParameterSpec, ...]:
    """Give the parameters of the live node of `system` besides the parameters of its tracker."""
    own = {spec.name for spec in system.config_type().specs()}
    return tuple(spec for spec in node_config_type(system).specs() if spec.name not in own)


def of_this_node(specs: Sequence[ParameterSpec]) -> str:
    """Give what a node has of its own: other defaults, other meanings, further parameters."""
    shared = {spec.name: spec for spec in NodeConfig.specs()}
    own = [
        spec
        for spec in specs
        if spec.name not in shared or spec.description != shared[spec.name].description
    ]
    defaults = [
        f'`{spec.name}` is `{json.dumps(spec.default)}` {spec.unit}'.rstrip()
        for spec in specs
        if spec not in own and spec.default != shared[spec.name].default
    ]
    common = [f'`{spec.name}`' for spec in specs if spec not in own]
    those = 'Those' if len(common) > 5 else ' and '.join(common)
    parts = [f'{"; ".join([f"{those} of [every node](nodes.md)", *defaults])}.\n']
    return '\n'.join([*parts, *([markdown_table(own)] if own else [])])


def _entry(spec: ParameterSpec) -> str:
    facts = '; '.join(filter(None, (', '.join(spec.choices) or spec.range_text(), spec.unit)))
    comment = textwrap.wrap(spec.description + (f' [{facts}]' if facts else ''), 92)
    value = list(spec.default) if isinstance(spec.default, tuple) else spec.default
    # One-line YAML; PyYAML ends a bare scalar with a document end mark.
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix('...\n')
    lines = [f'# {line}' for line in comment] + [f'{spec.name}: {text.strip()}']
    return textwrap.indent('\n'.join(lines) + '\n', '    ')


if __name__ == '__main__':
    for name, text in generated().items():
        path = ROOT / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding='utf-8')
        print(name)
