# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm echo``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
from datetime import datetime, timezone
import json
import math
import sys
from typing import Any, TYPE_CHECKING

import click

from sonar_imm.estimates import model_columns
from sonar_imm.texts import visible

from ..evaluation.numbers import counted
from . import options as opt
from .common import say, warn

if TYPE_CHECKING:
    from ..replay.listening import ReceivedTable

NAME = 'sonar_imm_echo'
Columns = Mapping[str, Any]
Rows = list[dict[str, str]]
Show = Callable[['ReceivedTable'], None]


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm echo', 'sonar-imm echo /diver/estimate --once',
        'sonar-imm echo /obstacle/estimate --json | jq .columns.range'))
@click.argument('topics', metavar='[TOPIC]...', nargs=-1)
@click.option('--once', is_flag=True, help='Show one table and end; the same as --count 1.')
@click.option('--count', type=opt.COUNT, help='End after so many tables.')
@click.option('--rows', type=opt.COUNT, default=20, show_default=True,
    help='Most rows of a table to show; --json has all.')
@click.option('--timeout', type=opt.POSITIVE, default=10.0, show_default=True,
    metavar='SECONDS', help='End with 1 when nothing is heard for so long from the start.')
@click.option('--json', 'as_json', is_flag=True, help='One line of JSON for each table.')
def command(
    topics: tuple[str, ...], once: bool, count: int | None, rows: int, timeout: float,
    as_json: bool,
) -> None:
    """Show the estimates of running nodes: a live table on a terminal, lines elsewhere.

    Without TOPIC every topic that ends in /estimate is shown; any other table of this package
    works too, e.g. /detections or /snapshot. A state stands with its standard deviation, the
    models as the most probable one. Where the output is no terminal, standard error says what is
    listened to. Ctrl-C ends it.
    """
    from ..replay.link import Link
    from ..replay.listening import TableListener

    left = 1 if once else count
    with Link(NAME) as link, _shower(rows, as_json) as show:
        with contextlib.suppress(KeyboardInterrupt):  # the usual way to end it
            listener = TableListener(link, topics)
            announced: list[str] = []
            for table in listener.tables(timeout):
                # With the first table, or a look after it subscribed: publishers know it then.
                if listener.topics != announced and not sys.stdout.isatty():
                    announced = listener.topics
                    warn(f'listening to {", ".join(announced)}')
                if table is None:
                    continue
                show(table)
                if left is not None and (left := left - 1) == 0:
                    return
# fmt: on


@contextlib.contextmanager
def _shower(most: int, as_json: bool) -> Iterator[Show]:
    if as_json:
        yield lambda table: click.echo(json_line(table))
    elif sys.stdout.isatty():
        from rich.live import Live

        newest: dict[str, ReceivedTable] = {}
        with Live(refresh_per_second=8) as live:

            def show(table: ReceivedTable) -> None:
                newest[table.topic] = table
                live.update(_picture(newest, most))

            yield show
    else:
        yield lambda table: say('\n'.join(text_lines(table, most)))


def _picture(newest: Mapping[str, ReceivedTable], most: int) -> Any:
    """The newest table of each topic, one below the other."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    def plain(text: str) -> Text:
        return Text(visible(text))  # a str would be read for markup

    parts: list[Text | Table] = []
    for name in sorted(newest):
        table = newest[name]
        if table.problem:
            parts.append(plain(f'{table.topic}: {table.problem}'))
            continue
        names, rows = readable(table.columns or {}, most)
        picture = Table()
        for column in names:
            picture.add_column(plain(column), justify='right')
        for row in rows:
            picture.add_row(*(plain(row[column]) for column in names))
        parts += [plain(_head(table)), picture]
        if further := _further(table, most):
            parts.append(plain(further))
    return Group(*parts)


def text_lines(table: ReceivedTable, most: int) -> list[str]:
    """A table as lines of text: where and when, one line per row, and how many are not shown."""
    if table.problem:
        return [f'{table.topic}: {table.problem}']
    names, rows = readable(table.columns or {}, most)
    widths = {name: max([len(name), *(len(row[name]) for row in rows)]) for name in names}
    shown = [dict(zip(names, names)), *rows]
    lines = ['  '.join(f'{row[name]:>{widths[name]}}' for name in names) for row in shown]
    return [line for line in (_head(table), *lines, _further(table, most)) if line]


def json_line(table: ReceivedTable) -> str:
    """A table as one line of JSON: all columns with their types; no NaN, which JSON lacks."""
    from ..offline.run_folder import finite

    columns = table.columns or {}
    content = {
        'topic': table.topic,
        'stamp_ns': table.stamp_ns,
        'frame_id': table.frame_id,
        **({'problem': table.problem} if table.problem else {}),
        'types': {name: value.dtype.str.lstrip('<|>') for name, value in columns.items()},
        'columns': {name: value.tolist() for name, value in columns.items()},
    }
    return json.dumps(finite(content))


def _head(table: ReceivedTable) -> str:
    moment = datetime.fromtimestamp(table.stamp_ns // 10**9, timezone.utc)
    millis = table.stamp_ns % 10**9 // 10**6
    return (
        f'{table.topic}  {moment:%Y-%m-%d %H:%M:%S}.{millis:03d} UTC  '
        f'frame {table.frame_id or "(none)"}  {counted(_count(table), "row")}'
    )


def _count(table: ReceivedTable) -> int:
    return len(next(iter((table.columns or {}).values()), ()))


def _further(table: ReceivedTable, most: int) -> str:
    left = _count(table) - most
    return f'... {left} more rows (--rows)' if left > 0 else ''


def readable(columns: Columns, most: int) -> tuple[list[str], Rows]:
    """What is shown of a table, and its first `most` rows as text by column.

    A state with a variance becomes one column with its standard deviation; probabilities of models
    become the most probable model; the other covariances, and x y z where they only repeat a
    state, are left out.
    """
    states = [name for name in columns if f'cov_{name}_{name}' in columns]
    models = model_columns(columns)
    drawn = {'x', 'y', 'z'} if {'px', 'py'} <= columns.keys() else set()
    plain = [
        name
        for name in columns
        if '_cov_' not in f'_{name}' and name not in models and name not in drawn
    ]
    first = [name for name in ('track_id', 'target_id') if name in plain]
    names = [*first, *states, *(['model'] if len(models) > 1 else models)]
    names += [name for name in plain if name not in names]
    count = len(next(iter(columns.values()), ()))
    rows: Rows = []
    for k in range(min(count, most)):
        row = {name: _cell(columns[name][k]) for name in plain}
        for name in states:
            row[name] = _with_deviation(columns[name][k], columns[f'cov_{name}_{name}'][k])
        if len(models) > 1:
            best = max(models, key=lambda name: float(columns[name][k]))
            row['model'] = f'{best.removeprefix("prob_")} {float(columns[best][k]):.0%}'
        elif models:
            row[models[0]] = _cell(columns[models[0]][k])
        rows.append(row)
    return names, rows


def _cell(value: Any) -> str:
    if getattr(value, 'ndim', 0):
        return f'{len(value)} values'
    if value.dtype.kind in 'iu':
        return str(int(value))
    return _number(float(value))


def _number(value: float) -> str:
    if math.isnan(value):
        return '-'
    if value and not 1e-3 <= abs(value) < 1e9:
        return f'{value:.3g}'
    text = f'{value:.3f}'
    return text.rstrip('0').rstrip('.')


def _with_deviation(value: Any, variance: Any) -> str:
    """A number with as many digits as its standard deviation carries."""
    deviation = math.sqrt(float(variance)) if float(variance) >= 0.0 else math.nan
    if not math.isfinite(deviation) or not math.isfinite(float(value)):
        return _number(float(value))
    digits = 3 if deviation == 0.0 else min(max(1 - math.floor(math.log10(deviation)), 0), 6)
    return f'{float(value):.{digits}f} ± {deviation:.{digits}f}'
