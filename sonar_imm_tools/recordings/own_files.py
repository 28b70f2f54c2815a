# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files that a recording may have beside it: parameters of its instruments, and a limit of error.

Where the sonar is mounted elsewhere, or the array is another one, a tracker needs the parameters.
A recording may come from anybody, so they are data: `taken` gives those that describe what is
tracked and how it was measured, and a file that they name has to lie beside the recording. Where a
node keeps files, or what it listens to, only its user says.

The limit is the largest error that `check` allows, with the arguments of `simulate` that make the
recording again where an installation left it out. It follows from the errors of the same scene
under other seeds.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
import math
from pathlib import Path
import shlex
import stat
from typing import Any

from attrs import frozen
import yaml

from sonar_imm.files import whole
from sonar_imm.parameters import Config, ConfigError, parameters_from_yaml, small_text, yaml_tree

from .sources import BagError

PARAMETERS = 'parameters.yaml'
LIMIT = 'check.yaml'
MOST_BYTES = 1_000_000
"""Bytes of a file that the parameters of a recording name."""
OF_FRAMES = ('frame_id', 'world_frame_convention', 'origin', 'input_types')
"""Parameters of a node that a recording may state: in what frames it was measured, and of which
types its messages are."""
_HEADS = {
    PARAMETERS: '# Parameters of the tracker that describe the instruments of this recording.\n',
    LIMIT: '# The largest error that `sonar-imm check` allows on this recording, and what makes\n'
    '# it again; see README.md.\n',
}


@frozen
class OwnParameters:
    """The parameter file `path` in the folder of a recording."""

    path: Path

    def __str__(self) -> str:
        return str(self.path)

    def taken(
        self, node: str, allowed: Collection[str], known: Collection[str]
    ) -> tuple[dict[str, Any], list[str]]:
        """What the file says for `node` but for the parameters that are `known` and not `allowed`,
        and a sentence for each of these, and for each file that may not be read. Raises
        `ConfigError`."""
        try:
            inside(self.path.parent, self.path.name)
            stated = parameters_from_yaml(small_text(self.path), node_name=node)
        except UnicodeDecodeError:
            raise ConfigError(f'{self.path} is not a text file') from None
        except ConfigError as error:
            raise ConfigError(f'{self.path}: {error}') from None
        found, sentences = {}, []
        for name, value in stated.items():
            try:
                if name in known and name not in allowed:
                    raise ConfigError(
                        'it is a parameter of the node, which a recording does not set; give it '
                        'with --params or --set'
                    )
                found[name] = self._placed(value) if name.endswith('_file') else value
            except ConfigError as error:
                sentences.append(f"{self.path}: '{name}' is not used: {error}")
        return found, sentences

    def _placed(self, value: Any) -> Any:
        """The file, or the files, that a parameter names, beside the recording."""
        if isinstance(value, (list, tuple)):
            return [self._placed(item) for item in value]
        if not isinstance(value, str) or not value:
            return value
        return str(inside(self.path.parent, value))


def inside(folder: Path, name: str) -> Path:
    """The file `name` in `folder`, without links. Raises `ConfigError` for one that is elsewhere,
    is not a regular file, or is too large."""
    try:
        root, path = folder.resolve(strict=True), (folder / name).resolve(strict=True)
        status = path.stat()
    except (OSError, ValueError, RuntimeError):
        raise ConfigError(f"there is no file '{name}' in the folder of the recording") from None
    if not path.is_relative_to(root):
        raise ConfigError(f"'{name}' lies outside of the folder of the recording")
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(f"'{name}' is no regular file")
    if status.st_size > MOST_BYTES:
        raise ConfigError(f"'{name}' has more than {MOST_BYTES} bytes")
    return path


def own_parameters(bag: Path) -> OwnParameters | None:
    """The parameter file in the folder of a recording; None when there is none."""
    path = bag / PARAMETERS
    return OwnParameters(path) if path.is_file() else None


def unusual(known: Mapping[str, Any], tracker: type[Config]) -> dict[str, Any]:
    """Those of `known` that differ from the defaults of `tracker`."""
    defaults = {spec.name: spec.default for spec in tracker.specs()}
    return {name: value for name, value in known.items() if value != defaults[name]}


def write_own_parameters(bag: Path, nodes: Mapping[str, Mapping[str, Any]]) -> Path | None:
    """Write parameters by the names of their nodes as a ROS 2 parameter file into the folder of a
    recording; without any nothing is written."""
    path = bag / PARAMETERS if any(nodes.values()) else None
    if path is not None:
        write_ros_parameters(path, nodes, _HEADS[PARAMETERS])
    return path


def write_ros_parameters(
    path: Path, nodes: Mapping[str, Mapping[str, Any]], head: str = ''
) -> None:
    """Write parameters by the names of their nodes as a ROS 2 parameter file, after the comment
    `head`; nodes without any are left out."""
    tree = {}
    for name, values in nodes.items():
        if values:
            plain = {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}
            tree[name] = {'ros__parameters': plain}
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
        inside(path.parent, path.name)
        stated = yaml_tree(small_text(path))
    except (ConfigError, UnicodeDecodeError):
        raise BagError(f'{path} is not YAML') from None
    return stated if isinstance(stated, dict) else {}


def write_own_limit(bag: Path, limit: float, recipe: Sequence[str] = ()) -> None:
    """Write the limit, and how the recording is made again, into the folder of a recording."""
    stated = {'limit': limit, **({'simulate': shlex.join(recipe)} if recipe else {})}
    with whole(bag / LIMIT) as unfinished:
        text = _HEADS[LIMIT] + yaml.safe_dump(stated, width=1000)
        unfinished.write_text(text, encoding='utf-8')
