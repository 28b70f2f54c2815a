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

"""Files that a recording may have beside it: parameters of its instruments, and a limit of error.

Most recordings fit the defaults of a tracker. Where the sonar is mounted elsewhere, or the array
is another one, the tracker needs these parameters: without them its estimates are wrong or
missing.

The limit is the largest error that `check` allows, with the arguments of `simulate` that make the
recording again where an installation left it out. A simulated recording is one draw of many: what
its error may be follows from the errors of the same scene under other seeds, and not from the
system.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import shlex
from typing import Any

import yaml

from sonar_imm.files import whole
from sonar_imm.parameters import Config, ConfigError, small_text, yaml_tree

from .sources import BagError

PARAMETERS = 'parameters.yaml'
LIMIT = 'check.yaml'
_HEADS = {
    PARAMETERS: '# Parameters of the tracker that describe the instruments of this recording.\n',
    LIMIT: '# The largest error that `sonar-imm check` allows on this recording, and what makes\n'
    '# it again; see README.md.\n',
}


def own_parameters(bag: Path) -> Path | None:
    """The parameter file in the folder of a recording; None when there is none."""
    path = bag / PARAMETERS
    return path if path.is_file() else None


def unusual(known: Mapping[str, Any], tracker: type[Config]) -> dict[str, Any]:
    """Those of `known` that differ from the defaults of `tracker`."""
    defaults = {spec.name: spec.default for spec in tracker.specs()}
    return {name: value for name, value in known.items() if value != defaults[name]}


def write_own_parameters(bag: Path, nodes: Mapping[str, Mapping[str, Any]]) -> Path | None:
    """Write parameters by the names of their nodes as a ROS 2 parameter file into the folder of a
    recording; without any nothing is written."""
    if not any(nodes.values()):
        return None
    path = bag / PARAMETERS
    write_ros_parameters(path, nodes, _HEADS[PARAMETERS])
    return path


def write_ros_parameters(
    path: Path, nodes: Mapping[str, Mapping[str, Any]], head: str = ''
) -> None:
    """Write parameters by the names of their nodes as a ROS 2 parameter file, after the comment
    `head`; nodes without any are left out."""
    tree = {
        name: {
            'ros__parameters': {
                key: list(v) if isinstance(v, tuple) else v for key, v in values.items()
            }
        }
        for name, values in nodes.items()
        if values
    }
    with whole(path) as unfinished:
        unfinished.write_text(head + yaml.safe_dump(tree, sort_keys=False), encoding='utf-8')


def own_limit(bag: Path) -> float | None:
    """The limit in the folder of a recording; None when it states none.

    Raises `BagError` for a file that states something else.
    """
    path = bag / LIMIT
    if not path.is_file():
        return None
    limit = _stated(path).get('limit')
    if isinstance(limit, bool) or not isinstance(limit, (int, float)):
        raise BagError(f'{path} states no number as limit')
    if not (math.isfinite(limit) and limit >= 0.0):
        raise BagError(f'{path}: the limit of an error is finite and not negative, got {limit}')
    return float(limit)


def own_recipe(bag: Path) -> list[str]:
    """The arguments after ``sonar-imm simulate SYSTEM OUT_BAG`` that make a recording again.

    Raises `BagError` when its folder states none.
    """
    path = bag / LIMIT
    recipe = _stated(path).get('simulate') if path.is_file() else None
    if not isinstance(recipe, str):
        raise BagError(f'{path} does not state how the recording is simulated')
    return shlex.split(recipe)


def _stated(path: Path) -> dict[str, Any]:
    try:
        stated = yaml_tree(small_text(path))
    except (ConfigError, UnicodeDecodeError):
        raise BagError(f'{path} is not YAML') from None
    return stated if isinstance(stated, dict) else {}


def write_own_limit(bag: Path, limit: float, recipe: Sequence[str] = ()) -> None:
    """Write the limit, and how the recording is made again, into the folder of a recording."""
    stated: dict[str, Any] = {'limit': limit}
    if recipe:
        stated['simulate'] = shlex.join(recipe)
    with whole(bag / LIMIT) as unfinished:
        text = _HEADS[LIMIT] + yaml.safe_dump(stated, width=1000)
        unfinished.write_text(text, encoding='utf-8')
