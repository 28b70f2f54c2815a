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

    <!-- numbers: diver_accuracy.json -->             the numbers are in docs/results of that name
    <!-- numbers: diver_accuracy.json; not RMSE, 4 -->   but those of columns with RMSE in their
                                                      title, and of the fourth column
    <!-- numbers: read 2026-11-20; COMMAND -->        what COMMAND printed on that day
    <!-- numbers: none -->                            nothing in it was measured

`docs/results/sources.json` says by which command a result was made, and when. Not compared are the
first column of a table, and numbers in parentheses, which are those of others. A number of d
decimals agrees with a value that rounds to it, or 100 times the value where `%` follows.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from datetime import date
import json
import math
from pathlib import Path
import re
import shlex
import subprocess
import sys
from typing import Any

from attrs import frozen

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / 'docs'
RESULTS = DOCS / 'results'
SOURCES = RESULTS / 'sources.json'

MARK = re.compile(r'^<!-- numbers: (.+) -->$')
NUMBER = re.compile(r'(?<![\w.])[-+]?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?(?![\w.]*\w)')
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

    def numbers(self, left_out: tuple[str, ...] = ()) -> Iterator[str]:
        """Each number below the head, but for the first column, with `%` where it is a share."""
        head, _, *body = self.rows
        for row in body:
            for place, (title, cell) in list(enumerate(zip(head, row), start=1))[1:]:
                if not any(word in title or word == str(place) for word in left_out):
                    bare = re.sub(r'`[^`]*`|\([^)]*\)', ' ', cell)
                    for found in NUMBER.finditer(bare):
                        share = bare[found.end() :].lstrip().startswith('%')
                        yield found.group() + '%' * share

    def measured(self) -> bool:
        """Whether it looks like measurements: a decimal number or a share somewhere."""
        return any('.' in number or '%' in number for number in self.numbers())


def pages() -> list[Path]:
    found = [ROOT / 'README.md', *sorted(DOCS.rglob('*.md'))]
    return [path for path in found if path.parent.name not in MADE]


def tables(page: Path) -> Iterator[Table]:
    name = page.relative_to(ROOT).as_posix()
    lines = page.read_text(encoding='utf-8').splitlines()
    fenced, mark, block, start = False, '', [], 0
    for number, line in enumerate([*lines, ''], start=1):
        fenced ^= line.startswith('```')
        if line.startswith('|') and not fenced:
            start = start or number
            block.append(tuple(cell.strip() for cell in line.strip().strip('|').split('|')))
            continue
        if block:
            yield Table(name, start, mark, tuple(block))
            mark, block, start = '', [], 0
        if found := MARK.match(line):
            mark = found.group(1)
        elif line.strip():
            mark = ''


def values_in(content: Any) -> Iterator[float]:
    """Every number in JSON, those in texts too."""
    if isinstance(content, bool) or content is None:
        return
    if isinstance(content, (int, float)):
        yield float(content)
    elif isinstance(content, str):
        for text in NUMBER.findall(content):
            yield float(text.replace(',', ''))
    else:
        for one in content.values() if isinstance(content, dict) else content:
            yield from values_in(one)


def agrees(number: str, values: list[float]) -> bool:
    share = number.endswith('%')
    text = number.rstrip('%').replace(',', '')
    mantissa = text.split('e')[0]
    decimals = len(mantissa.partition('.')[2])
    unit = 10.0 ** (int(text.split('e')[1]) if 'e' in text else 0) * 10.0**-decimals
    wanted = float(text)
    return any(
        math.isfinite(value) and abs(factor * value - wanted) <= 0.5001 * unit
        for value in values
        for factor in ((100.0, 1.0) if share else (1.0,))
    )


def doubts(table: Table, sources: dict[str, dict[str, str]]) -> list[str]:
    """What is wrong with the numbers of a table, in sentences."""
    kind, _, rest = table.mark.partition(';')
    if not table.mark:
        return [f'{table.place}: numbers without a source'] if table.measured() else []
    if kind == 'none':
        return []
    if kind.startswith('read '):
        return dated(table.place, kind.removeprefix('read ').strip(), rest.strip())
    path = RESULTS / kind.strip()
    if path.name not in sources or not path.is_file():
        return [f'{table.place}: {SOURCES.name} does not know {path.name}']
    left_out = tuple(
        word.strip() for word in rest.replace(' not ', '', 1).split(',') if word.strip()
    )
    values = list(values_in(json.loads(path.read_text(encoding='utf-8'))))
    wrong = [number for number in table.numbers(left_out) if not agrees(number, values)]
    return [f'{table.place}: not in {path.name}: {", ".join(wrong)}'] if wrong else []


def dated(place: str, day: str, command: str) -> list[str]:
    try:
        read = date.fromisoformat(day)
    except ValueError:
        return [f'{place}: {day!r} is no date']
    if read > date.today():
        return [f'{place}: {day} has not come yet']
    return command_doubts(place, command)


def command_doubts(place: str, command: str) -> list[str]:
    """A command of ours has to exist."""
    if not command:
        return [f'{place}: no command']
    if found := re.search(r'python -m (benchmarks(?:\.\w+)+)', command):
        if not ROOT.joinpath(*found.group(1).split('.')).with_suffix('.py').is_file():
            return [f'{place}: there is no {found.group(1)}']
    return []


def known_sources() -> dict[str, dict[str, str]]:
    return json.loads(SOURCES.read_text(encoding='utf-8'))


def all_doubts() -> list[str]:
    """Everything that is wrong, with tables and with the list of sources."""
    sources = known_sources()
    found = [
        doubt for page in pages() for table in tables(page) for doubt in doubts(table, sources)
    ]
    for path in sorted(RESULTS.glob('*.json')):
        if path != SOURCES and path.name not in sources:
            found.append(f'{SOURCES.name} does not say what made {path.name}')
    for name, source in sources.items():
        if not (RESULTS / name).is_file():
            found.append(f'{SOURCES.name} names {name}, which is not there')
        found += dated(f'{SOURCES.name}, {name}', source['date'], source['command'])
    return found


def caption(mark: str, up: str) -> str:
    """What the site shows below a table for its mark; `up` leads from the page to docs/."""
    kind, _, rest = mark.partition(';')
    if kind == 'none':
        return ''
    if kind.startswith('read '):
        return f'*Read on {kind.removeprefix("read ").strip()}:* `{rest.strip()}`'
    source = known_sources()[kind.strip()]
    return (
        f'*Values of {source["date"]}, [{kind.strip()}]({up}results/{kind.strip()}):* '
        f'`{source["command"]}`'
    )


def captioned(markdown: str, up: str) -> str:
    """A page with a caption below each table that has a mark, in place of the mark."""
    out, waiting = [], ''
    for line in [*markdown.splitlines(), '']:
        if found := MARK.match(line):
            waiting = caption(found.group(1), up)
            continue
        if waiting and out and out[-1].startswith('|') and not line.startswith('|'):
            out += ['', waiting]
            waiting = ''
        out.append(line)
    return '\n'.join(out)


def changed_since(day: str) -> int:
    """How many commits have changed the package since that day, 0 where git is not there."""
    command = ['git', 'rev-list', '--count', f'--since={day}T23:59', 'HEAD', '--', 'sonar_imm']
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return int(done.stdout) if done.returncode == 0 and done.stdout.strip() else 0


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
        later = changed_since(source['date'])
        print(f'{source["date"]}  {name}: {later} commits to sonar_imm since; {source["command"]}')
    found = all_doubts()
    for doubt in found:
        print(doubt, file=sys.stderr)
    return 1 if found else 0


if __name__ == '__main__':
    sys.exit(main())
