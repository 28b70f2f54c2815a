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

"""Where the numbers of the pages come from, and whether they are still those.

    make docs-numbers                                    what is wrong, and how old each result is
    python docs/check_numbers.py --run diver_accuracy    makes a result anew, then checks again

A table with measured numbers has a comment above it, which the site shows below it:

    <!-- numbers: read 2026-11-20 1f; COMMAND -->     what COMMAND printed on that day; 1f is the
                                                      digest of all numbers of the table
    <!-- numbers: none; REASON -->                    nothing in it was measured
    <!-- numbers: sea.json; made by MODULE -->        what `page_of` of that module makes of it
    <!-- numbers: sea.json; CELLS; rows: KEYS; rest: 1f -->
                                                      each cell is bound to values of that file; 1f
                                                      is the digest of the numbers that are not:
                                                      in heads, in names of rows, those of others

A digest that is missing or wrong is told with the right one: copy it when the numbers are right.
Figures in code or in a word (`table1`) are parts of names, and not checked.
Numbers that nobody measured, in words or under `none`, have to stay as they were read, too:
`docs/unmeasured.json` has the digests of their tables, by page.
`docs/results/sources.json` says by which command a file of `docs/results` was made, and when.

CELLS are paths into the file, one for each of the last columns, divided by `|`; a single one with
`{col}` holds for all columns but the first. The keys of a path are divided by `>`, and what stands
before `>>` belongs to all of them:

    cases>{row}>> rmse | nees_2d & nees_3d | - | rmse ~ prototype>rmse

    &        between the paths of a cell that has several numbers; a path may lead to a list, too
    {a,b}    two paths, one with a and one with b
    [k=v]    as a key: the only item of a list that has v under k
    a.json   as the first key: the path goes into that file instead
    {row}    the first cell of the row (if empty, of the row above), or its entry in KEYS, which
             are divided by `|`, with `=` where the first cell is the key
    {col}    the head of the column; {n}: its place after the first
    {2}      the second cell of the row; {1.2}: what follows the first comma in the first
    -        as a path or a row: others measured it; so are numbers in parentheses, unless
    ~        is followed by their paths

A cell has to hold as many numbers as its paths have values (NaN, null and missing keys are none),
in that order, each the value at the digits shown, or 100 times the value where `%` follows. A cell
may be `-` in any case, which says that it is left out.

How old a result is, in commits, says `result_ages`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from datetime import date
from functools import lru_cache
import hashlib
import importlib
import json
import math
from pathlib import Path
import re
import shlex
import subprocess
import sys
from typing import Any

from attrs import frozen
from result_ages import (
    age_since,
    commit_of_reading,
    commit_of_result,
    history,
    module_file,
    paths_of,
    script_of,
)

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / 'docs'
RESULTS = DOCS / 'results'
SOURCES = RESULTS / 'sources.json'
UNMEASURED = DOCS / 'unmeasured.json'

MARK = re.compile(r'^<!-- numbers: (.+?) -->$', re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r'(?<![\w.])[-+]?(?:\d+(?:,\d{3})*(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?(?![\w.]*\w)')
ALONE = re.compile(rf'^(?:{NUMBER.pattern}\s*[^\W\d]*\W*)+$')
"""A cell of numbers, with units at most."""
MADE = {'parameters'}
"""Folders of docs/ whose pages hold no measurement: they are generated."""


@frozen
class Table:
    """A table of a page: where it begins, its mark, '' for none, and the cells of each line."""

    page: str
    line: int
    mark: str
    rows: tuple[tuple[str, ...], ...]

    @property
    def place(self) -> str:
        return f'{self.page}:{self.line}'

    def numbers(self) -> list[str]:
        return [number for row in self.rows for cell in row for number in numbers_in(cell)]

    def measured(self) -> bool:
        """Whether it looks like measurements: a decimal number, a share, or a cell of numbers."""
        cells = [cell for row in self.rows[2:] for cell in row[1:]]
        return any(ALONE.match(cell) for cell in cells) or any(
            '.' in n or n.endswith('%') for cell in cells for n in numbers_in(cell)
        )

    def exempt(self) -> str:
        """Why its numbers are those of no result, '' where they are, or where there are none."""
        kind, _, reason = self.mark.partition(';')
        if kind not in {'', 'none'} or not self.numbers():
            return ''
        return reason.strip() or 'in words, none of them measured'


def digest(numbers: list[str]) -> str:
    """Of numbers that were read by hand: they have to stay as they were read."""
    return hashlib.sha256(' '.join(numbers).encode()).hexdigest()[:6]


def pages() -> list[Path]:
    found = [ROOT / 'README.md', *sorted(DOCS.rglob('*.md'))]
    return [path for path in found if path.parent.name not in MADE]


def tables(page: Path) -> list[Table]:
    return tables_of(page.relative_to(ROOT).as_posix(), page.read_text(encoding='utf-8'))


def tables_of(page: str, text: str) -> list[Table]:
    found, fenced, mark, block, start = [], False, '', [], 0
    for number, line in enumerate([*on_one_line(text).splitlines(), ''], start=1):
        fenced ^= line.startswith('```')
        if line.startswith('|') and not fenced:
            start = start or number
            block.append(tuple(cell.strip() for cell in line.strip().strip('|').split('|')))
            continue
        if block:
            found.append(Table(page, start, mark, tuple(block)))
            mark, block, start = '', [], 0
        if marked := MARK.match(line):
            mark = marked.group(1)
        elif line.strip():
            mark = ''
    return found


def on_one_line(text: str) -> str:
    """A page with each mark on one line; empty lines before it keep the numbers of the lines."""

    def joined(found: re.Match[str]) -> str:
        return '\n' * found.group().count('\n') + f'<!-- numbers: {" ".join(found[1].split())} -->'

    return MARK.sub(joined, text)


def numbers_in(cell: str) -> list[str]:
    """Its numbers but those in code, each with `%` where it is a share."""
    bare = without_code(cell)
    return [
        found.group() + '%' * bare[found.end() :].lstrip().startswith('%')
        for found in NUMBER.finditer(bare)
    ]


def without_code(cell: str) -> str:
    """A cell with blanks for its code, as long as it was."""
    return re.sub(r'`[^`]*`', lambda found: ' ' * len(found.group()), cell)


def agrees(number: str, value: float) -> bool:
    """Whether `value` is shown as `number`."""
    text = number.rstrip('%').replace(',', '')
    mantissa, _, exponent = text.partition('e')
    unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition('.')[2]))
    return abs((100.0 if number.endswith('%') else 1.0) * value - float(text)) <= 0.5001 * unit


INNER = re.compile(r'\([^)]*\)')
FIELD = re.compile(r'\{(row|col|n|\d+(?:\.\d+)?)\}')


@frozen
class Binding:
    """The mark of a table that is bound to a file: a path for each column, and a key for each row.

    Raises ValueError when it does not fit the table."""

    content: Any
    table: Table
    paths: tuple[str, ...]
    keys: tuple[str, ...]
    rest: str
    """The digest of the numbers that are not compared."""

    @classmethod
    def of(cls, table: Table) -> Binding:
        file, cells, *parts = (part.strip() for part in table.mark.split(';'))
        named = dict(part.split(':', 1) for part in parts if ':' in part)
        head, _, *body = table.rows
        base, _, columns = cells.rpartition('>>')
        paths = [path.strip() for path in columns.split('|')]
        if len(paths) == 1 and '{col}' in cells:
            paths *= len(head) - 1
        if len(paths) >= len(head):
            raise ValueError(f'{len(paths)} paths for {len(head)} columns')
        labels = [label(row[0]) for row in body]
        given = named['rows'].split('|') if 'rows' in named else ['='] * len(body)
        if len(given) != len(body):
            raise ValueError(f'{len(given)} keys for {len(body)} rows')
        keys: list[str] = []
        for row, key in zip(labels, map(str.strip, given)):
            keys.append((row if key == '=' else key) or keys[-1])
        unbound = ['-'] * (len(head) - len(paths))
        full = [path if path == '-' else with_base(base.strip(), path) for path in paths]
        rest = named.get('rest', '').strip()
        return cls(contents(file), table, (*unbound, *full), tuple(keys), rest)

    def compares(self, row: int, column: int) -> bool:
        return self.paths[column] != '-' and self.keys[row] != '-'

    def wrong(self, row: int, column: int, cell: str) -> list[str]:
        """What is wrong with a cell, were it `cell`: row of the body, column of the table."""
        if not self.compares(row, column) or cell == '-':
            return []
        mine, _, others = self.filled(row, column).partition('~')
        found = self.compared(INNER.sub(' ', cell), mine)
        if others:
            found += self.compared(' '.join(INNER.findall(cell)), others)
        return found

    def not_compared(self) -> list[str]:
        """Numbers of heads, of names of rows, of cells without a path, and those of others."""
        head, _, *body = self.table.rows
        left = list(head)
        for row, cells in enumerate(body):
            for column, cell in enumerate(cells):
                if not self.compares(row, column):
                    left.append(cell)
                elif '~' not in self.filled(row, column):
                    left += INNER.findall(cell)
        return [number for cell in left for number in numbers_in(cell)]

    def filled(self, row: int, column: int) -> str:
        cells = self.table.rows[row + 2]

        def word(found: re.Match[str]) -> str:
            name = found[1]
            if name == 'row':
                return self.keys[row]
            if name == 'col':
                return label(self.table.rows[0][column])
            if name == 'n':
                return str(column - 1)
            place, _, part = name.partition('.')
            parts = [label(cell) for cell in cells[int(place) - 1 : int(place)]]
            if part and parts:
                parts = parts[0].split(', ')[int(part) - 1 :]
            return parts[0] if parts else found[0]

        path = self.paths[column]
        for _ in range(2):  # the key of a row may name its column
            path = FIELD.sub(word, path)
        return path

    def compared(self, cell: str, paths: str) -> list[str]:
        numbers = numbers_in(cell)
        values = [value for path in expanded(paths) for value in values_at(self.content, path)]
        if len(numbers) != len(values):
            shown = ', '.join(numbers) or 'nothing'
            return [f'{shown} for {len(values)} values at {paths.strip()}']
        return [
            f'{number} is {value:.6g} at {paths.strip()}'
            for number, value in zip(numbers, values)
            if not agrees(number, value)
        ]

    def doubts(self) -> list[str]:
        body = enumerate(self.table.rows[2:])
        cells = ((row, column, cell) for row, line in body for column, cell in enumerate(line))
        found = [wrong for cell in cells for wrong in self.wrong(*cell)]
        left = self.not_compared()
        right = digest(left) if left else ''
        if self.rest == right:
            return found
        end = f'`; rest: {right}`' if right else 'no `rest`'
        return [
            *found,
            f'{len(left)} numbers have no value in the file (heads, names of rows, numbers of '
            f'others): are they as they should be? Then the mark ends with {end}',
        ]


def with_base(base: str, path: str) -> str:
    """`path` with `base` before each of the paths that it consists of."""
    if not base:
        return path
    return re.sub(r'(^|[&~])\s*', lambda found: f'{found[1]} {base}>', path.strip())


def label(cell: str) -> str:
    return re.sub(r'[*`]', '', cell).strip()


@lru_cache
def contents(file: str) -> Any:
    return json.loads((RESULTS / file).read_text(encoding='utf-8'))


def expanded(paths: str) -> Iterator[str]:
    """Each path of `paths`, which are divided by `&` and may hold `{a,b}`."""
    for path in paths.split('&'):
        found = re.search(r'\{([^{}]*,[^{}]*)\}', path)
        if found:
            for choice in found[1].split(','):
                yield from expanded(path[: found.start()] + choice + path[found.end() :])
        else:
            yield path.strip()


def values_at(content: Any, path: str) -> list[float]:
    """The numbers at a path: none where there is none, several in a list."""
    first, _, rest = path.strip().partition('>')
    if first.endswith('.json'):
        content, path = contents(first), rest
    for key in path.split('>'):
        content = item(content, key.strip())
    found = content if isinstance(content, list) else [content]
    kept = [value for value in found if isinstance(value, (int, float))]
    return [float(value) for value in kept if math.isfinite(value)]


def item(content: Any, key: str) -> Any:
    """What is under a key of a mapping, at a place of a list, or picked from one; or None."""
    if isinstance(content, dict):
        return next((value for name, value in content.items() if name.strip() == key), None)
    if not isinstance(content, list):
        return None
    if not key.startswith('['):
        return content[int(key)] if key.isdigit() and int(key) < len(content) else None
    wanted = dict(part.split('=', 1) for part in key[1:-1].split(','))
    found = [entry for entry in content if all(same(entry.get(k), v) for k, v in wanted.items())]
    return found[0] if len(found) == 1 else None


def same(value: Any, text: str) -> bool:
    """Whether `text` is `value`, or begins with that number."""
    if isinstance(value, float):
        numbers = NUMBER.findall(text)
        return bool(numbers) and float(numbers[0]) == value
    return str(value) == text


def doubts(table: Table, sources: dict[str, dict[str, str]]) -> list[str]:
    """What is wrong with the numbers of a table, in sentences."""
    kind, _, rest = table.mark.partition(';')
    if not table.mark:
        without = (
            f'{table.place}: numbers without a source: write above it '
            f'`<!-- numbers: read {date.today()} {digest(table.numbers())}; COMMAND -->` with the '
            'command that prints them, or `<!-- numbers: none; REASON -->` if none was measured'
        )
        return [without] if table.measured() else []
    if kind == 'none':
        return [] if rest else [f'{table.place}: `none` needs a reason: `none; REASON`']
    if kind.startswith('read '):
        day, _, given = kind.removeprefix('read ').strip().partition(' ')
        found = dated(table.place, day, rest.strip())
        if given != (right := digest(table.numbers())):
            found.append(
                f'{table.place}: not the numbers that were read on {day}. If `{rest.strip()}` '
                f'prints them now, the mark begins with `read {date.today()} {right};`'
            )
        return found
    if kind not in sources or not (RESULTS / kind).is_file():
        return [f'{table.place}: {SOURCES.name} does not know {kind}']
    if not rest:
        return [f'{table.place}: not bound to the values of {kind}']
    try:
        found = unlike_made(table) if 'made by ' in rest else Binding.of(table).doubts()
    except ValueError as error:
        found = [str(error)]
    return [f'{table.place}: {kind}: {wrong}' for wrong in found]


def unlike_made(table: Table) -> list[str]:
    made = made_tables(table.page, table.mark.split('made by ')[1])
    return [] if table.rows in [other.rows for other in made] else ['is not what its module makes']


@lru_cache
def made_tables(page: str, module: str) -> list[Table]:
    """The tables of a page as a module makes them of its result."""
    sys.path.insert(0, str(ROOT))
    maker = importlib.import_module(module)
    text = (ROOT / page).read_text(encoding='utf-8')
    return tables_of(page, maker.page_of(text, contents(maker.RESULT.name)))


def dated(place: str, day: str, command: str) -> list[str]:
    """What is wrong with the day and the command of numbers; a command of ours has to exist."""
    try:
        if date.fromisoformat(day) > date.today():
            return [f'{place}: {day} has not come yet']
    except ValueError:
        return [f'{place}: {day!r} is no date']
    script = script_of(command)
    if script and not module_file(script):
        return [f'{place}: there is no {script}']
    return [] if command else [f'{place}: no command']


def unread(table: Table) -> list[str]:
    """What is wrong with the numbers of a table that were not measured."""
    right = digest(table.numbers())
    if not table.exempt() or right in unmeasured().get(table.page, []):
        return []
    return [
        f'{table.place}: not the numbers that were read. If they are right, {UNMEASURED.name} has '
        f'"{right}" for this page'
    ]


@lru_cache
def unmeasured() -> dict[str, list[str]]:
    """Of each page the digests of the numbers of its tables in which none was measured."""
    return json.loads(UNMEASURED.read_text(encoding='utf-8'))


def known_sources() -> dict[str, dict[str, str]]:
    return json.loads(SOURCES.read_text(encoding='utf-8'))


def all_doubts() -> list[str]:
    """Everything that is wrong, with tables and with the list of sources."""
    sources = known_sources()
    every = [table for page in pages() for table in tables(page)]
    found = [doubt for table in every for doubt in [*doubts(table, sources), *unread(table)]]
    there = {(table.page, digest(table.numbers())) for table in every if table.exempt()}
    known = {(page, each) for page, digests in unmeasured().items() for each in digests}
    found += [f'{UNMEASURED.name}: no table of {page} is {each}' for page, each in known - there]
    for path in sorted(RESULTS.glob('*.json')):
        if path != SOURCES and path.name not in sources:
            found.append(f'{SOURCES.name} does not say what made {path.name}')
    for name, source in sources.items():
        if not (RESULTS / name).is_file():
            found.append(f'{SOURCES.name} names {name}, which is not there')
            continue
        found += dated(f'{SOURCES.name}, {name}', source['date'], source['command'])
        stated = re.search(r'--runs (\d+)', source['command'])
        if stated and contents(name).get('runs', int(stated[1])) != int(stated[1]):
            found.append(f'{SOURCES.name}: {name} is of {contents(name)["runs"]} runs')
    return found


def aged(result: str) -> str:
    """How many commits to what a result depends on there were since it was made."""
    made = commit_of_result(history(), f'docs/results/{result}')
    return since(made, paths_of(result, known_sources()[result]['command']))


def aged_reading(mark: str) -> str:
    """The same for a mark of numbers that were read by hand."""
    kind, _, command = mark.partition(';')
    return since(
        commit_of_reading(kind.split()[1], command.strip()), paths_of('', command.strip())
    )


def since(made: str, paths: frozenset[str]) -> str:
    commits = age_since(history(), made, paths)
    return 'age unknown' if commits is None else f'{commits} commits to its code since'


def run(name: str) -> int:
    """Make a result anew by its command, and note the day."""
    sources = known_sources()
    file = f'{name.removesuffix(".json")}.json'
    if file not in sources:
        print(f'no source of {file}; there are {", ".join(sources)}', file=sys.stderr)
        return 2
    command = shlex.split(sources[file]['command'])
    command[0] = sys.executable if command[0] == 'python' else command[0]
    if status := subprocess.run(command, cwd=ROOT).returncode:
        return status
    sources[file]['date'] = date.today().isoformat()
    SOURCES.write_text(json.dumps(sources, indent=1) + '\n', encoding='utf-8')
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--run', metavar='RESULT', help='make this result anew first')
    given = parser.parse_args()
    if given.run and (status := run(given.run)):
        return status
    for name, source in known_sources().items():
        print(f'{source["date"]}  {name}: {aged(name)}; {source["command"]}')
    every = [table for page in pages() for table in tables(page)]
    read = [table for table in every if table.mark.startswith('read ')]
    for table in read:
        print(f'{table.place}: {table.mark}; {aged_reading(table.mark)}')
    for table in every:
        if reason := table.exempt():
            print(f'{table.place}: {len(table.numbers())} numbers of no result: {reason}')
    bound = sum('.json' in table.mark.partition(';')[0] for table in every)
    print(f'{bound} tables bound to results, {len(read)} read by hand')
    found = all_doubts()
    for doubt in found:
        print(doubt, file=sys.stderr)
    return 1 if found else 0


if __name__ == '__main__':
    sys.exit(main())
