# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Text that names what others have named: topics and frames can hold anything."""

from __future__ import annotations

import re

_CONTROLS = re.compile(
    '[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]'
)
_LONGEST = 1000
"""Characters of a sentence; a name in a message may have millions."""


def visible(text: str) -> str:
    """`text` without what would steer a terminal, or what no text file can hold: bytes of a file
    name that are not UTF-8. Lines and tabs stay."""
    return _CONTROLS.sub(lambda found: ascii(found.group())[1:-1], text)


def in_one_line(text: str) -> str:
    """`visible` text on one line, cut where it is very long."""
    short = text if len(text) <= _LONGEST else f'{text[:_LONGEST]} ...'
    return visible(' '.join(short.splitlines()).replace('\t', ' '))
