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

"""Write what follows from the code: `config/<system>.yaml` and `docs/parameters/<system>.md`.

Run it with ``make docs``; a test compares the files with what the code says now.
"""

from __future__ import annotations

from pathlib import Path
import textwrap

import yaml

from sonar_imm.node_config import DetectorNodeConfig, node_config_type, type_specs
from sonar_imm.parameters import markdown_table, ParameterSpec
from sonar_imm.trackers import System, SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig

ROOT = Path(__file__).resolve().parents[1]

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

{summary}.
Written by `make docs` from the configuration classes; `ros2 param describe` shows the same.
`config/{name}.yaml` holds the defaults, ready to copy.

A parameter that may change while running keeps the tracks; every other one is read at start.
A wrong value is refused with one sentence that names it, a misspelt name is warned about.

## {part}

{tracker}
## Node

The live node takes these besides; offline tracking ignores them.

{node}"""

DETECTOR = (
    'Echoes in images of a forward-looking sonar, for the obstacle tracker. Offline the same '
    'parameters are taken from the section `fls_detector` of a parameter file, and from `--set`'
)


def generated() -> dict[str, str]:
    """Give every generated file: its text by its path below the project root."""
    files = {}
    for system in SYSTEMS.values():
        tracker = system.config_type().specs()
        files[f'config/{system.name}.yaml'] = parameter_file(system)
        files[f'docs/parameters/{system.name}.md'] = MARKDOWN.format(
            name=system.name,
            what=f'{system.name} tracker',
            part='Tracker',
            summary=system.summary[0].upper() + system.summary[1:],
            tracker=markdown_table(tracker),
            node=markdown_table(node_specs(system)),
        )
    detector = DetectorConfig.specs()
    node = (*type_specs('fls_detector'), *DetectorNodeConfig.specs())
    files['config/fls_detector.yaml'] = _parameter_file('fls_detector', (*detector, *node))
    files['docs/parameters/fls_detector.md'] = MARKDOWN.format(
        name='fls_detector',
        what='detector of sonar images',
        part='Detector',
        summary=DETECTOR,
        tracker=markdown_table(detector),
        node=markdown_table(node),
    )
    return files


def parameter_file(system: System) -> str:
    """Give the ROS 2 parameter file of `system`, every parameter with its description above."""
    return _parameter_file(system.name, (*system.config_type().specs(), *node_specs(system)))


def _parameter_file(name: str, specs: tuple[ParameterSpec, ...]) -> str:
    return YAML_HEAD.format(name=name) + '\n'.join(_entry(spec) for spec in specs)


def node_specs(system: System) -> tuple[ParameterSpec, ...]:
    """Give the parameters of the live node of `system` besides the parameters of its tracker."""
    own = {spec.name for spec in system.config_type().specs()}
    specs = (*type_specs(system.name), *node_config_type(system).specs())
    return tuple(spec for spec in specs if spec.name not in own)


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
