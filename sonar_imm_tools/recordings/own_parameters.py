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

"""The parameter file that a recording may have beside it, which describes its instrument.

Most recordings fit the defaults of a tracker. Where the sonar is mounted elsewhere, or the array
is another one, the tracker needs these parameters: without them its estimates are wrong or
missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from sonar_imm.parameters import Config

NAME = 'parameters.yaml'
_HEAD = '# Parameters of the tracker that describe the instruments of this recording.\n'


def own_parameters(bag: Path) -> Path | None:
    """The parameter file in the folder of a recording; None when there is none."""
    path = bag / NAME
    return path if path.is_file() else None


def unusual(told: Mapping[str, Any], tracker: type[Config]) -> dict[str, Any]:
    """Those of `told` that differ from the defaults of `tracker`."""
    defaults = {spec.name: spec.default for spec in tracker.specs()}
    return {name: value for name, value in told.items() if value != defaults[name]}


def write_own_parameters(bag: Path, nodes: Mapping[str, Mapping[str, Any]]) -> Path | None:
    """Write parameters by the names of their nodes as a ROS 2 parameter file into the folder of a
    recording; without any nothing is written."""
    tree = {
        name: {
            'ros__parameters': {
                key: list(v) if isinstance(v, tuple) else v for key, v in values.items()
            }
        }
        for name, values in nodes.items()
        if values
    }
    if not tree:
        return None
    path = bag / NAME
    path.write_text(_HEAD + yaml.safe_dump(tree, sort_keys=False), encoding='utf-8')
    return path
