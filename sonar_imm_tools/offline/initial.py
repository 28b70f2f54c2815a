# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files that state where divers are at first: what the topic `~/initial` says, for a recording.

One place, or a list of them, as YAML or JSON: `position` (x, y and maybe z, m), `covariance` (of x
and y, of x, y and z, or the 36 numbers of a message, m^2), and if wanted `name`, `time` and
`frame_id`. A message as ``ros2 topic echo`` prints it is such a place too. Without a time it is
that of the first measurement.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
import math
from pathlib import Path
from typing import Any

from attrs import frozen
import numpy as np

from msg_adapters.fixes import check_size
from msg_adapters.inputs.topic import tag_numbers
from sonar_imm.measurements import NOBODY, Rejection, Start
from sonar_imm.parameters import ConfigError, small_text, yaml_tree

from .. import SECOND
from ..recordings.sources import BagError
from ..recordings.times import BadRow, moment_ns

KEYS = {'position', 'covariance', 'name', 'time', 'frame_id'}
"""What a place may state."""

SIZES = {4: 2, 9: 3, 36: 6}
"""Numbers of a covariance, and its rows."""


@frozen
class Initial:
    """A place where a diver is said to be, as plain values."""

    position: tuple[float, ...]
    """x, y, z, m."""
    covariance: tuple[float, ...]
    """Of x and y, by rows, m^2."""
    name: str = ''
    stamp_ns: int | None = None
    """None: that of the first measurement."""
    frame_id: str = ''

    def start(self, first_ns: int, names: Mapping[str, int]) -> Start:
        """Return the start. first_ns: stamp of the first measurement; names: numbers of targets.

        :raises Rejection: it is no start.
        """
        if self.name and self.name not in names:
            known = ', '.join(names) or 'none'
            raise Rejection(
                'unknown_name', f"no target is called '{self.name}': {known} are known"
            )
        start = Start(
            stamp_ns=first_ns if self.stamp_ns is None else self.stamp_ns,
            position=self.position,
            covariance=np.reshape(self.covariance, (2, 2)),
            frame_id=self.frame_id,
            target_id=names[self.name] if self.name else NOBODY,
        )
        check_size(start, 'start')
        return start


def target_numbers(tags: Sequence[str], noted: Mapping[str, str]) -> dict[str, int]:
    """Return the numbers of target names. tags: the parameter; noted: names by number."""
    return {name: int(number) for number, name in noted.items()} | tag_numbers(tags)


def read_initial(path: Path) -> tuple[Initial, ...]:
    """Read the places of a file.

    :raises ConfigError: it cannot be read, or a place is none; one sentence.
    """
    try:
        content = yaml_tree(small_text(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or 'it is no text'
        raise ConfigError(f'--initial {path}: {reason}') from None
    except ConfigError as error:
        raise ConfigError(f'--initial {path}: {error}') from None
    places = content if isinstance(content, list) else [content]
    if not places or content is None:
        raise ConfigError(f'--initial {path}: the file is empty')
    found = []
    for number, place in enumerate(places, start=1):
        try:
            found.append(_read_place(place))
        except (ConfigError, Rejection) as error:
            which = f' place {number}:' if len(places) > 1 else ''
            raise ConfigError(f'--initial {path}:{which} {error}') from None
    return tuple(found)


def _read_place(place: Any) -> Initial:
    if not isinstance(place, Mapping):
        raise ConfigError('a place needs position and covariance, by name')
    if 'pose' in place:
        place = _of_message(place)
    unknown = sorted(str(key) for key in place if key not in KEYS)
    if unknown:
        raise ConfigError(f'{unknown[0]} is not one of {", ".join(sorted(KEYS))}')
    position = _numbers(place.get('position'), 'position')
    if len(position) not in (2, 3):
        raise ConfigError('position needs two or three numbers, x, y and z in m')
    found = Initial(
        (*position, 0.0)[:3],
        _covariance(place.get('covariance')),
        str(place.get('name', '') or ''),
        _stamp_ns(place.get('time')),
        str(place.get('frame_id', '') or ''),
    )
    found.start(1, {found.name: 0})  # says what is wrong with it
    return found


def _of_message(message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the place of a PoseWithCovarianceStamped."""
    inner, header = message['pose'], message.get('header') or {}
    at = (inner.get('pose') or {}).get('position') if isinstance(inner, Mapping) else None
    if not isinstance(at, Mapping) or not isinstance(header, Mapping):
        raise ConfigError('pose needs pose.position and covariance, as the message has them')
    stamp = header.get('stamp') or {}
    if not isinstance(stamp, Mapping):
        raise ConfigError('header.stamp needs sec and nanosec')
    seconds, rest = (_numbers([stamp.get(k, 0)], 'header.stamp')[0] for k in ('sec', 'nanosec'))
    return {
        'position': [at.get('x'), at.get('y'), at.get('z', 0.0)],
        'covariance': inner.get('covariance'),
        'frame_id': header.get('frame_id', ''),
        **({'time': seconds + 1e-9 * rest} if seconds or rest else {}),
    }


def _numbers(value: Any, what: str) -> list[float]:
    if isinstance(value, Mapping):
        value = list(value.values())
    if not isinstance(value, list):
        raise ConfigError(f'{what} is missing' if value is None else f'{what} is no list')
    found: list[float] = []
    for each in value:
        if isinstance(each, list):
            found += _numbers(each, what)
        elif isinstance(each, bool) or not isinstance(each, int | float):
            raise ConfigError(f"{what} has '{each}' in place of a number")
        elif not abs(each) < math.inf:
            raise ConfigError(f'{what} has a number that is not finite')
        else:
            found.append(float(each))
    return found


def _covariance(value: Any) -> tuple[float, ...]:
    numbers = _numbers(value, 'covariance')
    if len(numbers) not in SIZES:
        raise ConfigError('covariance needs 4, 9 or 36 numbers, in m^2')
    rows = SIZES[len(numbers)]
    return tuple(np.reshape(numbers, (rows, rows))[:2, :2].ravel().tolist())


def _stamp_ns(value: Any) -> int | None:
    if value is None:
        return None
    stamp_ns: int | None = None
    if isinstance(value, str | datetime):
        text = value.isoformat() if isinstance(value, datetime) else value
        try:
            stamp_ns = moment_ns(text, lambda: 'UTC')
        except (BadRow, BagError) as error:
            raise ConfigError(f"time '{value}': {error}") from None
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        stamp_ns = round(value * SECOND)
    if stamp_ns is None or not 0 < stamp_ns < 2**63:
        raise ConfigError(f"time '{value}' is neither seconds since 1970 nor a date with a time")
    return stamp_ns
