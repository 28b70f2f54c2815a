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

"""From what was found in one period to a level that a watchdog can use.

A value at its limit is now above and now below it. So a finding counts only after it was there in
`RISE` periods in a row, and is over only after it was gone for `FALL` periods in a row. What is
final by itself (an error that was caught, a silence, which has its own patience) counts at once.
A period without a message says nothing of what only messages show, so that slow sensors count too.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)
RISE, FALL = 2, 5
"""Periods of diagnostics, of one second by default."""
_WORSE = (OK, WARN, STALE, ERROR)
"""From good to bad; the numbers of the message are in another order."""


class Finding(NamedTuple):
    """Something that is not as it should be. key: what it is, the same from period to period;
    at_once: it need not be found again to count; timed: it can be judged in a period without a
    message; passing: it is over as soon as it is not found."""

    key: str
    level: bytes
    sentence: str
    at_once: bool = False
    timed: bool = False
    passing: bool = False


class Hysteresis:
    """Decides which findings count, once a period."""

    def __init__(self, rise: int = RISE, fall: int = FALL):
        self._rise, self._fall = rise, fall
        self._found: dict[tuple[str, bytes], int] = {}
        self._missed: dict[tuple[str, bytes], int] = {}
        self._counting: dict[tuple[str, bytes], Finding] = {}

    def settle(self, findings: Iterable[Finding], *, quiet: bool = False) -> list[Finding]:
        """The findings that count now, the worst first. quiet: no message came, which says nothing
        for or against what messages show. One that is just not there keeps its last sentence until
        it is over."""
        now = {(one.key, one.level): one for one in findings}
        for name, one in now.items():
            self._found[name] = self._found.get(name, 0) + 1
            self._missed.pop(name, None)
            if one.at_once or self._found[name] >= self._rise or name in self._counting:
                self._counting[name] = one
        for name in [name for name in self._found if name not in now]:
            known = self._counting.get(name)
            if quiet and not (known and (known.timed or known.passing)):
                continue
            if known is None:
                del self._found[name]
                continue
            self._missed[name] = self._missed.get(name, 0) + 1
            if known.passing or self._missed[name] >= self._fall:
                del self._counting[name], self._found[name], self._missed[name]
        return sorted(self._counting.values(), key=lambda one: -_WORSE.index(one.level))


def worst(levels: Iterable[bytes]) -> bytes:
    """The worst of some levels: OK, WARN, STALE, ERROR."""
    return max(levels, key=_WORSE.index, default=OK)


def told(findings: list[Finding], otherwise: str) -> tuple[bytes, str]:
    """The level of a status and its text."""
    text = '; '.join(dict.fromkeys(one.sentence for one in findings))
    return worst(one.level for one in findings), text or otherwise


def summary(name: str, parts: Iterable[DiagnosticStatus]) -> DiagnosticStatus:
    """One status for a node: the worst level of its `parts`, and the sentences behind it."""
    parts = list(parts)
    level = worst(one.level for one in parts)
    text = '; '.join(dict.fromkeys(one.message for one in parts if one.level == level))
    pairs = [(one.name.rpartition(': ')[2], one.message) for one in parts]
    return DiagnosticStatus(
        level=level,
        name=name,
        message=text,
        hardware_id='sonar_imm',
        values=[KeyValue(key=key, value=value) for key, value in pairs],
    )
