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

"""``sonar-imm convert``: one subcommand per kind of input, made from the class of its options."""

from __future__ import annotations

from collections.abc import Callable, Iterable
import inspect
from pathlib import Path
from typing import Any

import attrs
import click

from sonar_imm.texts import visible
from sonar_imm.trackers import SYSTEMS

from ..recordings.convert_options import FROM_BAGS, OPTIONS
from ..recordings.options import Group, Option, spec_of
from .common import (
    BAG,
    example,
    json_option,
    load_detector,
    pairs_option,
    print_json,
    say,
    typed_overrides,
)
from .info import track_line

FILE = click.Path(path_type=Path, dir_okay=False)


class Convert(click.Group):
    """A group whose subcommand may be left out: it is then the one that fits the file."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        named = bool(args) and args[0] not in self.commands
        if named and not Path(args[0]).exists() and Path(args[0]).suffix:
            ctx.fail(f'{args[0]} does not exist')
        if named and Path(args[0]).exists():
            from ..recordings.sniffing import sniff

            guess = sniff(Path(args[0]))
            taken = f'{args[0]} is taken for {guess.why}: convert {guess.kind}'
            click.echo(visible(taken), err=True)
            args = [guess.kind, *(args if len(args) > 1 else (*args, _beside(args[0])))]
        return super().resolve_command(ctx, args)


def _beside(source: str) -> str:
    """The bag that is made where none is named: beside the file, or in this folder."""
    return f'{Path(source).stem}.bag'


@click.group(
    cls=Convert,
    invoke_without_command=True,
    epilog=example(
        'sonar-imm convert usbl.csv dive.bag',
        'sonar-imm convert fixes usbl.csv dive.bag --column x=easting --column y=northing',
    ),
)
@click.pass_context
def command(ctx: click.Context) -> None:
    """Turn recordings in other formats into a rosbag2 bag: convert [KIND] IN OUT.

    Without KIND it is found out from the content of the file, and said. Rows that cannot be used
    are left out, counted and listed by line.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def _add_subcommand(kind: str, options: type) -> None:
    def run(source: Path, out_bag: Path, as_json: bool, **values: Any) -> None:
        chosen = _collected(options, values)
        if kind == 'images':
            chosen['parameters'] = _detector(source, chosen.get('parameters', {}))
        _convert(kind, source, out_bag, as_json, chosen)

    examples = (f'sonar-imm convert {kind} {line}' for line in options.EXAMPLES)  # type: ignore[attr-defined]
    subcommand = click.Command(
        kind, callback=run, help=inspect.getdoc(options), epilog=example(*examples)
    )
    source_type = BAG if kind in FROM_BAGS else FILE
    click.argument('source', metavar='IN', type=source_type)(subcommand)
    click.argument('out_bag', type=BAG)(subcommand)
    for decorate in _click_options(options):
        decorate(subcommand)
    json_option(subcommand)
    command.add_command(subcommand)


def _click_options(
    options: type, prefix: str = '', what: str = '', inside: str = ''
) -> Iterable[Callable[..., Any]]:
    """The options of a class for click; the name of a value is the path of its field."""
    for attribute in attrs.fields(options):
        spec, name = spec_of(attribute), f'{inside}{attribute.name}'
        if isinstance(spec, Group):
            yield from _click_options(spec.options, spec.prefix, spec.what, f'{name}.')
            continue
        words = (prefix, spec.flag or attribute.name.replace('_', '-'))
        flag = '--' + '-'.join(filter(None, words))
        yield _click_option(flag, name.replace('.', '__'), spec, attribute.default, what)


def _click_option(
    flag: str, name: str, spec: Option, default: Any, what: str
) -> Callable[..., Any]:
    text = spec.help.format(what=what) if what else spec.help
    if spec.kind == 'pairs':
        return pairs_option(flag, name, metavar=spec.metavar, help=text)
    needed = default is attrs.NOTHING
    shown = None if needed or spec.parse or default in (None, '', ()) else default
    if spec.many and shown:
        shown = list(shown)
    return click.option(
        flag,
        name,
        type=_click_type(spec),
        # None is a default like another since click 8.3, and what has one is never missing
        **({'required': True} if needed else {'default': shown}),
        show_default=shown is not None,
        multiple=spec.many,
        metavar=spec.metavar or None,
        callback=_parsed(spec.parse) if spec.parse else None,
        help=text,
    )


def _click_type(spec: Option) -> Any:
    if spec.choices:
        return click.Choice(spec.choices)
    if spec.kind not in ('float', 'int'):
        return FILE if spec.kind == 'file' else str
    low, high = spec.range
    if spec.kind == 'int':
        least, most = (None if limit is None else int(limit) for limit in (low, high))
        return click.IntRange(least, most)
    if spec.above is not None:
        return click.FloatRange(min=spec.above, min_open=True)
    return float if low is None and high is None else click.FloatRange(low, high)


def _parsed(parse: Callable[[str], Any]) -> Callable[..., Any]:
    def callback(_ctx: click.Context, _param: click.Parameter, text: str | None) -> Any:
        try:
            return None if text is None else parse(text)
        except ValueError as error:
            raise click.BadParameter(str(error)) from None

    return callback


def _collected(options: type, values: dict[str, Any], inside: str = '') -> dict[str, Any]:
    """What was chosen, by the fields of a class; what was not keeps its default."""
    chosen = {}
    for attribute in attrs.fields(options):
        spec, name = spec_of(attribute), f'{inside}{attribute.name}'
        if isinstance(spec, Group):
            chosen[attribute.name] = spec.options(**_collected(spec.options, values, f'{name}__'))
        elif values[name] is not None:
            chosen[attribute.name] = values[name]
    return chosen


def _detector(source: Path, overrides: dict[str, str]) -> dict[str, Any]:
    """The parameters of the detector of images: those beside the recording, then ``--set``."""
    from sonar_imm.trackers.obstacle.detector import DetectorConfig

    from ..recordings.own_files import own_parameters

    own = load_detector(SYSTEMS['obstacle'], own_parameters(source), {})
    return own | typed_overrides(DetectorConfig, overrides)


def _convert(
    kind: str, source: Path, out_bag: Path, as_json: bool, options: dict[str, Any]
) -> None:
    from ..recordings.convert import KINDS
    from ..recordings.reader import BagReader
    from ..recordings.topics import fitting_systems

    report = KINDS[kind](source, out_bag, **options)
    if as_json:
        print_json(
            {
                'bag': str(report.path),
                'messages': report.messages,
                'rows': report.rows,
                'bad_rows': report.bad_rows,
                'reasons': dict(report.reasons),
                'problems': report.problems,
                'notes': report.notes,
            }
        )
        return
    what = ', '.join(f'{count} on {topic}' for topic, count in sorted(report.messages.items()))
    say(f'{report.path}: {what}, from {report.rows} rows')
    for key, value in report.notes.items():
        say(f'  note: {key}: {value}')
    for problem in report.problems:
        say(f'  left out: {problem}')
    if report.bad_rows:
        why = ', '.join(f'{count} {reason}' for reason, count in report.reasons.most_common())
        say(f'  {report.bad_rows} rows left out' + (f', of them {why}' if why else ''))
    with BagReader(report.path) as bag:
        for system in fitting_systems(bag)[:1]:
            say(f'to track it: {track_line(str(report.path), system, {})}')


for _kind, _options in OPTIONS.items():
    _add_subcommand(_kind, _options)
