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

"""The Foxglove layouts that are shipped, and the same with the names of other topics."""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from sonar_imm.trackers import SYSTEMS

from ..resources import shared_file


def fitting_layouts(topics: Sequence[str]) -> dict[str, Path]:
    """The shipped layouts of the systems whose estimates are among `topics`."""
    return {
        system: shared_file(f'config/foxglove_{system}.json')
        for system in SYSTEMS
        if _estimates(system, topics)
    }


def write_layout(file: Path, system: str, topics: Sequence[str]) -> None:
    """Write the layout of `system` to `file`, its topics named as they are in `topics`.

    The node may run in a namespace, and its inputs may be remapped: an input goes by the last
    part of its name, when only one topic has it.
    """
    layout = json.loads(shared_file(f'config/foxglove_{system}.json').read_text(encoding='utf-8'))
    namespace = _estimates(system, topics)[0].removesuffix(f'/{system}/estimate')
    own = f'/{system}/'

    def renamed(name: str) -> str:
        topic, dot, rest = name.partition('.')
        if topic.startswith(own):
            topic = namespace + topic
        elif topic not in topics:
            same = [name for name in topics if name.endswith(topic)]
            topic = same[0] if len(same) == 1 else topic
        return topic + dot + rest

    file.write_text(json.dumps(_with_names(layout, renamed), indent=2) + '\n', encoding='utf-8')


def _estimates(system: str, topics: Sequence[str]) -> list[str]:
    return [name for name in topics if name.endswith(f'/{system}/estimate')]


def _with_names(value: Any, renamed: Any) -> Any:
    """The same tree; every text that is a topic, with a field or without, is `renamed`."""
    if isinstance(value, dict):
        return {
            _with_names(key, renamed): _with_names(item, renamed) for key, item in value.items()
        }
    if isinstance(value, list):
        return [_with_names(item, renamed) for item in value]
    return renamed(value) if isinstance(value, str) and value.startswith('/') else value
