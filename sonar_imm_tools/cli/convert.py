# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm convert``: one subcommand per kind of input, made from the class of its options."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import inspect
from pathlib import Path
from typing import Any, TYPE_CHECKING

import attrs
import click

from sonar_imm.gone import GONE
from sonar_imm.trackers import SYSTEMS

from ..recordings.convert_options import DETECTING, FROM_BAGS, Group, Option, OPTIONS, spec_of
from . import options as opt
from .common import by_topic, load_detector, print_json, progress, say, typed_overrides, warn
from .info import track_line

if TYPE_CHECKING:
    from ..recordings.conversion import ConversionReport


class Convert(click.Group):
    """A group whose subcommand may be left out: it is then the one that fits the file."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if not args or args[0] in self.commands:
            return super().resolve_command(ctx, args)
        source = Path(args[0])
        if gone := GONE.get(f'kind {args[0]}'):
            ctx.fail(f"'{args[0]}' {gone}")
        if source.exists():
            from ..recordings.convert import sniff

            guess = sniff(source, _named_columns(args))
            warn(f'{source} is taken for {guess.why}: convert {guess.kind}')
            args = [guess.kind, *args]
        elif source.suffix:
            ctx.fail(f'{source} does not exist')
        return super().resolve_command(ctx, args)


def _named_columns(args: Sequence[str]) -> dict[str, str]:
    """What ``--column NAME=HEADER`` say, before it is known of which subcommand they are."""
    words = [word.removeprefix('--column=') for word in args if word.startswith('--column=')]
    words += [word for flag, word in zip(args, args[1:]) if flag == '--column']
    pairs = (word.partition('=') for word in words)
    return {name: header for name, equals, header in pairs if equals}


# fmt: off
@click.group(cls=Convert, invoke_without_command=True,
    epilog=opt.example('sonar-imm convert usbl.csv dive.bag',
        'sonar-imm convert fixes usbl.csv dive.bag --column x=easting --column y=northing'))
@click.pass_context
def command(ctx: click.Context) -> None:
    """Turn recordings in other formats into a rosbag2 bag: convert [KIND] IN OUT.

    Without KIND it is found out from the content of the file, and said. Rows that cannot be used
    are left out, counted and listed by line. With KIND and a folder of several, each becomes a bag
    of its name in the folder OUT_BAG.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
# fmt: on


def _add_subcommand(kind: str, options: type) -> None:
    def run(source: Path, out_bag: Path | None, jobs: int, as_json: bool, **values: Any) -> None:
        chosen = _collected(options, values)
        several = _sources(kind, source)
        # Where no bag is named it is made in the folder of the command.
        out_bag = out_bag or Path(f'{source.stem}.{"bag" if several is None else "bags"}')
        if several is not None:
            _convert_all(kind, several, out_bag, chosen, jobs, as_json)
            return
        report = convert_file(kind, source, out_bag, chosen)
        print_json(_described(report)) if as_json else _print(report)

    examples = (f'sonar-imm convert {kind} {line}' for line in options.EXAMPLES)  # type: ignore[attr-defined]
    about: dict[str, Any] = {'help': inspect.getdoc(options), 'epilog': opt.example(*examples)}
    subcommand = click.Command(kind, callback=run, **about)
    click.argument('source', metavar='IN', type=opt.PATH)(subcommand)
    click.argument('out_bag', type=opt.PATH, required=False)(subcommand)
    for decorate in _click_options(options):
        decorate(subcommand)
    opt.jobs(help='Processes, for a folder of several.')(subcommand)
    opt.json(subcommand)
    command.add_command(subcommand)


def _click_options(
    options: type, prefix: str = '', what: str = '', inside: str = ''
) -> Iterable[Callable[..., Any]]:
    """The options of a class for click; the name of a value is the path of its field."""
    fields = attrs.fields_dict(options)
    # What is special of a kind comes first, what all have last.
    names = [name for each in options.__mro__ for name in inspect.get_annotations(each)]
    for attribute in (fields[name] for name in names if name in fields):
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
        return opt.pairs(flag, name, metavar=spec.metavar, help=text)
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


class _SpeedOfSound(click.FloatRange):
    """A speed of sound, m/s: a number, or a file with a profile, of which the mean is taken."""

    name = 'm/s or FILE'

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path = Path(str(value))
        if isinstance(value, str) and path.is_file():
            from ..recordings.sound_speed import mean_speed, read_profile

            value = round(mean_speed(read_profile(path)), 3)
        return super().convert(value, param, ctx)


def _click_type(spec: Option) -> Any:
    if spec.choices:
        return click.Choice(spec.choices)
    if spec.kind == 'speed':
        return _SpeedOfSound(*spec.range)
    if spec.kind not in ('float', 'int'):
        return opt.FILE if spec.kind == 'file' else str
    low, high = spec.range
    if spec.kind == 'int':
        least, most = (None if limit is None else int(limit) for limit in (low, high))
        return click.IntRange(least, most)
    if spec.above is not None:
        return click.FloatRange(min=spec.above, min_open=True)
    return float if low is None and high is None else click.FloatRange(low, high)


def _parsed(parse: Callable[[str], Any]) -> Callable[..., Any]:
    def callback(_ctx: Any, _param: Any, text: str | None) -> Any:
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


def _sources(kind: str, source: Path) -> list[Path] | None:
    """What lies in a folder of several recordings, by path; None for a single one."""
    if not source.is_dir() or kind == 'pictures':
        return None
    inside = sorted(path for path in source.iterdir() if not path.name.startswith('.'))
    if kind not in FROM_BAGS:
        return [path for path in inside if path.is_file()]
    from ..recordings.sources import is_recording

    return None if is_recording(source) else [path for path in inside if is_recording(path)]


def convert_file(
    kind: str, source: Path, out_bag: Path, options: dict[str, Any]
) -> ConversionReport:
    """Convert a recording. Raises `BagError`."""
    from ..recordings.convert import KINDS

    if kind in DETECTING:
        options = {**options, 'parameters': _detector(source, options.get('parameters', {}))}
    return KINDS[kind](source, out_bag, **options)


def _convert_all(
    kind: str, sources: list[Path], out: Path, options: dict[str, Any], jobs: int, as_json: bool
) -> None:
    """Convert all into the folder `out`; ends with 1 when one failed."""
    from ..offline.jobs import workers
    from ..recordings.sources import BagError

    if not sources:
        raise BagError('the folder holds nothing to convert')
    bags = [out / (path.name if path.is_dir() else path.stem) for path in sources]
    for bag in bags:
        if bags.count(bag) > 1:
            raise click.UsageError(f'two recordings would be converted into {bag}')
    content: list[dict[str, Any]] = [{} for _ in sources]
    calls = [(kind, source, bag, options) for source, bag in zip(sources, bags)]
    with (
        progress('recordings', len(sources), quiet=as_json) as advance,
        workers(min(jobs, len(sources))) as run,
    ):
        for k, report, failure in run(convert_file, calls):
            if failure:
                warn(f'{sources[k]}: {failure}')
            content[k] = {'source': str(sources[k]), 'failure': failure}
            if report is not None:
                content[k] |= _described(report)
            advance(1)
    failed = sum(bool(entry['failure']) for entry in content)
    if as_json:
        print_json({'bags': content})
    else:
        for entry in content:
            if not entry['failure']:
                say(f'{entry["bag"]}: {by_topic(entry["messages"])}, from {entry["rows"]} rows')
        say(f'{len(sources) - failed} bags in {out}' + (f', {failed} failed' if failed else ''))
    if failed:
        raise click.exceptions.Exit(1)


def _described(report: ConversionReport) -> dict[str, Any]:
    return {
        'bag': str(report.path),
        'messages': report.messages,
        'rows': report.rows,
        'bad_rows': report.bad_rows,
        'reasons': dict(report.reasons),
        'problems': report.problems,
        'questions': report.questions,
        'notes': report.notes,
    }


def _print(report: ConversionReport) -> None:
    from ..evaluation.numbers import counted
    from ..recordings.measurements import ready_systems
    from ..recordings.reader import BagReader

    say(f'{report.path}: {by_topic(report.messages)}, from {report.rows} rows')
    for key, value in report.notes.items():
        say(f'  note: {key}: {value}')
    for problem in report.problems:
        say(f'  left out: {problem}')
    for question in report.questions:
        say(f'  question: {question}')
    if report.bad_rows:
        why = ', '.join(f'{count} {reason}' for reason, count in report.reasons.most_common())
        say(f'  {counted(report.bad_rows, "row")} left out' + (f', of them {why}' if why else ''))
    with BagReader(report.path) as bag:
        for system in ready_systems(bag)[:1]:
            say(f'to track it: {track_line(str(report.path), system, {})}')


for _kind, _options in OPTIONS.items():
    _add_subcommand(_kind, _options)
