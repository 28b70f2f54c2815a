# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the options of a conversion are declared, once for the converter and for the command.

A converter is told its options as an attrs class. Every field is made with `option`, which keeps
what the command line needs beside the default, or is a group of options of its own, such as those
of a CSV file, made with `group`.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from typing import Any

import attrs
from attrs import field, frozen

from sonar_imm.parameters import Range

_KEY, _GROUP = 'sonar_imm.option', 'sonar_imm.group'


@frozen(kw_only=True)
class Option:
    """An option of the command line.

    metavar: what the help page shows for its value; empty for the name of the type. flag: its
    spelling where that is not the name of the field. kind: ``text``, ``float``, ``int``, ``file``,
    ``speed`` for that of sound, a number or a file with a profile, or ``pairs`` for NAME=VALUE,
    which may be repeated. range: of a number, inclusive; above: a
    limit it has to exceed. parse: from the text to the value; raises ValueError with a sentence.
    many: may be repeated.
    """

    help: str
    metavar: str = ''
    flag: str = ''
    kind: str = 'text'
    range: Range = (None, None)
    above: float | None = None
    choices: tuple[str, ...] = ()
    parse: Callable[[str], Any] | None = None
    many: bool = False


@frozen
class Group:
    """Options of an attrs class as a field of another one: their flags begin with `prefix`, and
    `what` takes the place of ``{what}`` in their help texts."""

    options: type
    prefix: str
    what: str


def option(default: Any, metavar: str, help: str, **more: Any) -> Any:
    """A field that is one option; `more` is as in `Option`. With the default attrs.NOTHING it has
    to be given."""
    default = attrs.Factory(dict) if default == {} else default
    spec = Option(help=help, metavar=metavar, **more)
    return field(default=default, metadata={_KEY: spec})


def group(options: type, prefix: str = '', what: str = 'the input') -> Any:
    """A field that is a group of options."""
    return field(factory=options, metadata={_GROUP: Group(options, prefix, what)})


def spec_of(attribute: attrs.Attribute[Any]) -> Option | Group:
    """What was declared of a field."""
    found: Option | Group = attribute.metadata.get(_KEY) or attribute.metadata[_GROUP]
    return found


def nanoseconds(text: str) -> int:
    """Integer nanoseconds of a number of seconds."""
    try:
        return int(Decimal(text) * 10**9)
    except (InvalidOperation, ValueError, OverflowError):
        raise ValueError(f"'{text}' is not a number of seconds") from None
