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

"""The options that several kinds of ``sonar-imm convert`` share."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import click

from .common import pairs_option

FILE = click.Path(path_type=Path, dir_okay=False)


def origin(
    _ctx: click.Context, _param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(','))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise click.BadParameter(f"'{value}' is not of the form LAT,LON or LAT,LON,HEIGHT")
    return numbers


def nanoseconds(_ctx: click.Context, _param: click.Parameter, value: str) -> int:
    try:
        return int(Decimal(value) * 10**9)
    except (InvalidOperation, ValueError, OverflowError):
        raise click.BadParameter(f"'{value}' is not a number of seconds") from None


def sensor_offsets(ctx: click.Context, param: click.Parameter, value: str) -> int | dict[str, int]:
    """``-1.5`` for all sensors, or ``radar=-1.5,lidar=0.1``."""
    if '=' not in value:
        return nanoseconds(ctx, param, value)
    pairs = dict(part.partition('=')[::2] for part in value.split(','))
    return {name.strip(): nanoseconds(ctx, param, text) for name, text in pairs.items()}


def staves(
    _ctx: click.Context, _param: click.Parameter, value: str | None
) -> list[list[int]] | None:
    if value is None:
        return None
    try:
        return [[int(channel) for channel in stave.split('+')] for stave in value.split(',')]
    except ValueError:
        raise click.BadParameter(f"'{value}' is not of the form 0+3,1+2") from None


def csv_options(prefix: str = '', what: str = 'the input') -> Callable[..., Any]:
    """The options that describe a CSV file; with several files each has its `prefix`."""
    dashed, name = (f'{prefix}-', f'{prefix}_') if prefix else ('', '')

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in (
            click.option(
                f'--{dashed}delimiter',
                f'{name}delimiter',
                default='',
                help=f'Delimiter between the columns of {what}; found automatically by default.',
            ),
            click.option(
                f'--{dashed}time-offset',
                f'{name}time_offset',
                default='0',
                callback=nanoseconds,
                metavar='SECONDS',
                help=f'Added to every time of {what}.',
            ),
            click.option(
                f'--{dashed}time-unit',
                f'{name}time_unit',
                default='',
                type=click.Choice(['', 's', 'ms', 'us', 'ns']),
                metavar='UNIT',
                help=f'Unit of numeric times in {what}: s, ms, us or ns.',
            ),
            click.option(
                f'--{dashed}time-zone',
                f'{name}time_zone',
                default='',
                metavar='ZONE',
                help=f'Zone of times in {what} that do not say it: UTC, +02:00 or Europe/Berlin.',
            ),
            pairs_option(
                f'--{dashed}column',
                f'{name}columns',
                metavar='NAME=HEADER',
                help=f'Header of a column of {what}, e.g. x=easting.',
            ),
        ):
            function = option(function)
        return function

    return decorate


def place_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Frame and origin, for every kind with positions."""
    function = click.option(
        '--origin',
        callback=origin,
        metavar='LAT,LON[,HEIGHT]',
        help='Origin of local metres; by default the first good row.',
    )(function)
    return frame_option(function)


def frame_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--frame-id``."""
    return click.option(
        '--frame-id',
        default='map',
        show_default=True,
        help='Frame of the positions, east-north-up.',
    )(function)


def storage_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--storage``."""
    return click.option(
        '--storage',
        type=click.Choice(['mcap', 'sqlite3']),
        default='mcap',
        show_default=True,
        help='Storage of the bag.',
    )(function)


def truth_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """``--truth``, with its own columns."""
    function = csv_options('truth', 'the truth')(function)
    return click.option('--truth', type=FILE, help='CSV of true positions for the same bag.')(
        function
    )


def options(values: dict[str, Any], prefix: str = '') -> Any:
    """Take the options of one CSV file out of `values`."""
    from ..recordings.csv_table import CsvOptions

    return CsvOptions(
        columns=values.pop(f'{prefix}columns'),
        time_unit=values.pop(f'{prefix}time_unit'),
        time_zone=values.pop(f'{prefix}time_zone'),
        time_offset_ns=values.pop(f'{prefix}time_offset'),
        delimiter=values.pop(f'{prefix}delimiter'),
    )


def interferometer_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Where the images of an interferometer are, and what they do not say."""
    for option in (
        click.option(
            '--amplitude', default='', metavar='TOPIC', help='Topic with the amplitudes.'
        ),
        click.option(
            '--phase',
            default='',
            metavar='TOPIC',
            help='Topic with the phases, of stave 1 against stave 0, or one of each stave.',
        ),
        click.option(
            '--iq',
            multiple=True,
            metavar='TOPIC',
            help='Topic with the complex samples of a stave, the uppermost first; once for each.',
        ),
        pairs_option(
            '--field',
            'fields',
            metavar='WHAT=PATH',
            help='Where something stands in the messages, e.g. phase=sidescan.phase.',
        ),
        click.option(
            '--side', type=click.Choice(['port', 'starboard']), default=None, help='Of the array.'
        ),
        click.option(
            '--phase-scale',
            'radians_per_count',
            type=float,
            metavar='RAD',
            help='Radians of one count of the phase; by default 1 for floats, and for whole '
            'numbers the full circle over their range.',
        ),
        click.option(
            '--element-spacing',
            type=click.FloatRange(min=1e-5, max=10.0),
            metavar='METRES',
            help='Distance between staves, to be stated in the snapshots.',
        ),
        click.option(
            '--sound-speed',
            type=click.FloatRange(min=1300.0, max=1700.0),
            default=1500.0,
            show_default=True,
            help='Speed of sound in m/s, where a message states none.',
        ),
        click.option(
            '--order',
            type=click.Choice(['range_major', 'beam_major']),
            default='range_major',
            show_default=True,
            help='Order of the samples in an image with several channels.',
        ),
    ):
        function = option(function)
    return function
