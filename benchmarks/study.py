# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The harness of all studies: a command line, progress, tables to read and a file of numbers.

A study is a module with a generator `main`, whose parameters are the options of its command line,
each with its default, and which yields its numbers as parts of one JSON object:

    def main(runs: int = 100, cases: Sequence[str] = tuple(CASES)) -> Parts:
        yield {'runs': runs}
        for name in cases:
            yield {'table': {name: case(name, range(runs))}}


    if __name__ == '__main__':
        study(main, cases={'choices': list(CASES)})

Parts are merged; what is a table, or a row of one, is printed as it comes, and ``--out FILE``
holds all that is known so far; with ``--add`` beside what is in the file already. The rest of this
module is what several studies compute.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from functools import cache
import inspect
from itertools import groupby
import json
from multiprocessing import get_context
import os
from pathlib import Path
import shlex
import subprocess
import sys
from typing import Any, TypeVar

import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.truth import Scene

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get('SONAR_IMM_DATA', ROOT / '../shared/data'))
"""Where the recordings of others lie."""
ENTRY = str(ROOT / 'benchmarks' / 'entry')
"""Where the models of `diver_paper` are registered, as those of an installed package are."""
if ENTRY not in sys.path:
    sys.path.append(ENTRY)

Parts = Iterator[Mapping[str, Any]]
Row = Mapping[str, Any]
T = TypeVar('T')


def study(
    main: Callable[..., Parts],
    *,
    digits: int = 3,
    shown: Callable[[Row], Row] = dict,
    **options: Mapping[str, Any],
) -> None:
    """Run `main` with the options given on the command line, print its tables and write its file.

    digits: of the numbers in tables. shown: what is printed of a row. options: by parameter of
    `main`, what `argparse` is told beside its type and default, or instead of them. A default that
    is a tuple takes any number of values, False is a flag. A parameter `out` is the file itself.
    """
    module = sys.modules[main.__module__]
    parser = argparse.ArgumentParser(
        description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parameters = inspect.signature(main).parameters
    for name, parameter in parameters.items():
        if name != 'out':
            settings = {**_inferred(parameter.default), **options.get(name, {})}
            parser.add_argument(f'--{name.replace("_", "-")}', **settings)
    file = {'type': Path, 'help': 'write the numbers here, as JSON', **options.get('out', {})}
    parser.add_argument('--out', **file)
    parser.add_argument('--add', action='store_true', help='keep what is in the file')
    given = vars(parser.parse_args())
    out = given['out'] if 'out' in parameters else given.pop('out')
    content, before = known_with_made(out) if given.pop('add') else ({}, {})
    printed: dict[str, int] = {}
    for part in main(**given):
        merge(content, part)
        for title, table in tables(part, shown):
            printed[title] = len(table)
            if len(table) > 1:
                print(f'\n{title}\n\n{markdown(table, digits)}')
            else:
                ((name, row),) = table.items()
                words = ', '.join(f'{key} {cell(value, digits)}' for key, value in row.items())
                print(f'{name}: {words}')
        sys.stdout.flush()
        write_json(out, content, before)
    for title, table in tables(content, shown):
        if len(table) != printed.get(title, len(table)):
            print(f'\n{title}\n\n{markdown(table, digits)}')


def _inferred(default: Any) -> dict[str, Any]:
    """What `argparse` is told of an option with this default."""
    if default is False:
        return {'action': 'store_true'}
    if isinstance(default, tuple):
        return {'nargs': '*', 'type': type(default[0]) if default else str, 'default': default}
    return {'type': type(default), 'default': default} if default is not None else {}


def merge(content: dict[str, Any], part: Mapping[str, Any]) -> None:
    """Put a part into what is there: into mappings, behind lists, in place of all else."""
    for key, value in part.items():
        there = content.get(key)
        if isinstance(value, Mapping) and isinstance(there, dict):
            merge(there, value)
        elif isinstance(value, list) and isinstance(there, list):
            there += value
        else:
            content[key] = list(value) if isinstance(value, list) else value
            if isinstance(value, Mapping):
                content[key] = {}
                merge(content[key], value)


def tables(
    content: Any, shown: Callable[[Row], Row] = dict, title: str = ''
) -> Iterator[tuple[str, dict[str, Row]]]:
    """The tables in nested mappings, each with its title: rows by name, or a list of rows."""
    if isinstance(content, list):
        content = {str(number): row for number, row in enumerate(content, start=1)}
    if not isinstance(content, Mapping):
        return
    rows = {key: _flat(row, shown) for key, row in content.items()}
    if flat := {key: row for key, row in rows.items() if row}:
        yield title, flat
    for key, value in content.items():
        if key not in flat:
            yield from tables(value, shown, f'{title}, {key}' if title else key)


def _flat(row: Any, shown: Callable[[Row], Row]) -> Row | None:
    """What is printed of a row; None of what is no row."""
    if not isinstance(row, Mapping) or not row:
        return None
    try:
        picked = shown(row)
    except (KeyError, TypeError):
        return None
    plain = all(isinstance(v, (int, float, str, type(None))) for v in picked.values())
    return picked if plain else None


def cell(value: Any, digits: int = 3) -> str:
    if value is None:
        return '-'
    return f'{value:.{digits}f}' if isinstance(value, float) else str(value)


def markdown(table: Mapping[str, Row], digits: int = 3) -> str:
    """A row for each entry, a column for each of its numbers; rows of other columns follow in a
    table of their own."""
    parts = []
    for columns, rows in groupby(table.items(), lambda item: list(item[1])):
        lines = ['| | ' + ' | '.join(columns) + ' |', '|---' * (len(columns) + 1) + '|']
        lines += [
            f'| {name} | ' + ' | '.join(cell(value, digits) for value in row.values()) + ' |'
            for name, row in rows
        ]
        parts.append('\n'.join(lines))
    return '\n\n'.join(parts)


def write_json(
    path: Path | None,
    content: Mapping[str, Any],
    before: Mapping[str, str] | None = None,
    command: str = '',
) -> None:
    """Write `content` with how it was made, and the folders to it; nothing without a path.

    before: how the file that this adds to was made; command: in place of that of this process.
    """
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        now = made() | ({'command': command} if command else {})
        how = added(before, now) if before else now
        text = json.dumps({'made': how, **content}, indent=1)
        path.write_text(text + '\n', encoding='utf-8')


def added(before: Mapping[str, str], now: Mapping[str, str]) -> dict[str, str]:
    """How a file was made that was there and was added to: day and commit are those of the first
    command, each other one says its commit."""
    first, *others = before['command'].split('; ')
    kept = [each for each in others if each.partition(' at commit ')[0] != now['command']]
    again = f'{now["command"]} at commit {now["commit"]}'
    return {**before, 'command': '; '.join([first, *kept, again])}


def known(path: Path | None) -> dict[str, Any]:
    """What is in the file of an earlier run but how it was made; nothing when there is none."""
    return known_with_made(path)[0]


def known_with_made(path: Path | None) -> tuple[dict[str, Any], dict[str, str]]:
    """As `known`, and how it was made."""
    if path is None or not path.is_file():
        return {}, {}
    content: dict[str, Any] = json.loads(path.read_text(encoding='utf-8'))
    how: dict[str, str] = content.pop('made', {})
    return content, how


@cache
def made() -> dict[str, str]:
    """Return the command, the day and the commit of the numbers that this process makes."""
    spec = sys.modules['__main__'].__spec__
    program = (
        ['-m', spec.name.removesuffix('.__main__')]
        if spec
        else [os.path.relpath(sys.argv[0], ROOT)]
    )
    commit = _git('rev-parse', '--short=8', 'HEAD')
    if _git('status', '--porcelain', '--untracked-files=no', '--', ':!docs/results'):
        commit += ' with changes'
    return {
        'command': shlex.join(['python', *program, *sys.argv[1:]]),
        'date': date.today().isoformat(),
        'commit': commit or 'not known',
    }


def _git(*arguments: str) -> str:
    """Give what git says of the source tree; nothing where there is no git, or no history."""
    try:
        found = subprocess.run(['git', *arguments], cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ''
    return found.stdout.strip() if found.returncode == 0 else ''


def mean_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The mean of every number of some rows, by name."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def standard_error(values: Sequence[float] | np.ndarray) -> float:
    """Of the mean of `values` (n,); 0 of a single one."""
    return float(np.std(values) / max(1, np.size(values) - 1) ** 0.5)


def rms(values: Sequence[float] | np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def final_estimates(tracker: Any, measurements: Iterable[Any]) -> dict[int, Estimate]:
    """The last estimate of every stamp, by stamp."""
    final: dict[int, Estimate] = {}
    for measurement in measurements:
        final.update((each.stamp_ns, each) for each in tracker.process(measurement))
    return final


def first_track(estimate: Estimate, place: FloatArray) -> tuple[FloatArray, float] | None:
    """Error (m,) of the first confirmed track against where the target is (m,), and its NEES; None
    without one."""
    firm, m = np.flatnonzero(estimate.extras['track_state'] > 0), len(place)
    if not len(firm):
        return None
    error = estimate.state[firm[0], :m] - place
    P = estimate.covariance[firm[0], :m, :m]
    return error, float(error @ np.linalg.solve(P, error))


def truths(scene: Scene, kind: type[T]) -> tuple[T, ...]:
    """What is true of a scene, by its type."""
    return tuple(truth for truth in scene.truth if isinstance(truth, kind))


def in_fresh_process(function: Callable[..., T], *arguments: Any) -> T:
    """The result of a call in a process of its own, with nothing compiled or kept from before."""
    with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
        return pool.submit(function, *arguments).result()
