# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Options that several commands have, and the types of their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import functools
from pathlib import Path
from typing import Any

import click

from sonar_imm.gone import GONE
from sonar_imm.trackers import SYSTEMS

PATH = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)
COUNT = click.IntRange(min=1)
POSITIVE = click.FloatRange(min=0.0, min_open=True)
NOT_NEGATIVE = click.FloatRange(min=0.0)


def example(*lines: str) -> str:
    """The epilog of a help page: example command lines, kept as they are."""
    return '\b\nExample:\n' + '\n'.join(f'  {line}' for line in lines)


def _coordinates(_ctx: Any, _param: Any, value: str) -> tuple[float, float, float]:
    try:
        numbers = tuple(float(part) for part in value.split(','))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise click.BadParameter(f"'{value}' is not of the form X,Y or X,Y,Z")
    x, y, z = (*numbers, 0.0)[:3]
    return x, y, z


def pairs(*names: str, metavar: str, help: str) -> Callable[..., Any]:
    """An option of the form NAME=VALUE that may be repeated; the command gets a dict."""

    def split(_ctx: Any, _param: Any, values: Iterable[str]) -> dict[str, str]:
        pairs = {}
        for value in values:
            name, equals, text = value.partition('=')
            if not equals or not name.strip():
                raise click.BadParameter(f"'{value}' is not of the form {metavar}")
            pairs[name.strip()] = text.strip()
        return pairs

    return click.option(*names, metavar=metavar, multiple=True, callback=split, help=help)


# fmt: off
json = click.option('--json', 'as_json', is_flag=True, help='Print the result as JSON.')
overrides = pairs('--set', 'overrides', metavar='NAME=VALUE',
    help='Change one parameter; may be given several times.')
topics = pairs('--topic', 'topics', metavar='INPUT=TOPIC',
    help='Topic of an input, e.g. fix=/usbl/pose; may be given several times.')
system = click.option('--system', type=click.Choice(list(SYSTEMS)), default=None,
    help='Which tracker; by default the one whose inputs are in the bag.')
crs = click.option('--crs', '--epsg', 'epsg', type=click.IntRange(min=1),
    help='Coordinate system, by its EPSG number.')
origin = click.option('--origin', default='0,0', callback=_coordinates, metavar='X,Y[,Z]',
    help='Coordinates in that system of the origin of the navigation.')
params = functools.partial(click.option, '--params', type=FILE)
jobs = functools.partial(click.option, '--jobs', type=COUNT, default=1, show_default=True)
systems = click.argument('systems', nargs=-1, type=click.Choice(list(SYSTEMS)))
# fmt: on


class Renewed(click.Command):
    """A command that says what took the place of its removed options."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        for word in args:
            option = word.partition('=')[0]
            if gone := GONE.get(f'option {ctx.info_name} {option}'):
                ctx.fail(f"'{option}' {gone}")
        return super().parse_args(ctx, args)
