# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Write the pages with measured numbers from their templates and the files of results.

Whole pages: ``docs/templates/NAME.md.j2`` makes ``docs/results/NAME.md``. Single
tables in pages written by hand: ``docs/templates/tables/NAME.md.j2`` replaces the table with the
same head.
Templates take numbers by path, names joined by `>`: the first is the file below docs/results, the
others lead to the number, as in ``diver_accuracy>paths>legs, 1 m, 1>raw``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
import math
from pathlib import Path
import re
from typing import Any

import jinja2

from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
TEMPLATES = ROOT / 'docs' / 'templates'
RESULTS = ROOT / 'docs' / 'results'

TABLES = {
    'README': 'README.md',
    'fathometer': 'docs/fathometer.md',
}
"""By template of `docs/templates/tables`: the page whose table it writes."""

PAGES = {'reliability.md.j2': 'docs/reliability.md'}
"""By template: the page, where that is no page of results."""

NUMBER = re.compile(r'\{([^{}|]+)(?:\|([^{}]*))?\}')
"""A number in a cell: `{name}` or `{name|format}`."""


class Numbers:
    """The files of results in a folder, and which of them have been read.

    :param folder: where the files are, each with its `made`: command, date and commit.
    """

    def __init__(self, folder: Path = RESULTS) -> None:
        self.folder = folder
        self.files: dict[str, Any] = {}
        self.captioned: set[str] = set()

    def at(self, path: str) -> Any:
        """Return what is at a path. Raises LookupError with the names that are there."""
        file, *names = path.split('>')
        if file not in self.files:
            text = (self.folder / f'{file}.json').read_text(encoding='utf-8')
            self.files[file] = json.loads(text)
        found = self.files[file]
        for name in names:
            try:
                found = found[int(name) if isinstance(found, list) else name]
            except (LookupError, TypeError, ValueError) as error:
                there = ', '.join(map(repr, found)) if isinstance(found, Mapping) else repr(found)
                raise LookupError(f'{path}: no {name!r} among {there}') from error
        return found

    def n(self, path: str, spec: str | None = None) -> str:
        """Return a number as text, a float with two decimals if not otherwise; `-` for none."""
        value = self.at(path)
        if value is None or isinstance(value, float) and math.isnan(value):
            return '-'
        usual = '.2f' if isinstance(value, float) else ''
        return format(value, usual if spec is None else spec).replace('%', ' %')

    def made(self, file: str) -> str:
        """Return a link to a file with the day and the commits of its numbers."""
        made = self.at(f'{file}>made')
        added = re.findall(r' at commit (\w+)', made['command'])
        commits = ', '.join(dict.fromkeys([made['commit'], *added]))
        return f'[{file}.json]({file}.json), {made["date"]}, {commits}'

    def table(
        self,
        path: str,
        columns: Mapping[str, str],
        rows: Mapping[str, str] | Sequence[str] | None = None,
        first: str = '',
        caption: bool = True,
    ) -> str:
        """Return a table with its caption.

        :param path: of a number, with `{row}` and `{col}` in it.
        :param columns: by heading, a name for `{col}` with its format, `RMSE|.1f`, or several
            with text around them, `{RMSE|.1f} ({NEES})`. Without a format: two decimals. `@` in a
            name stands for the row; of `inside / cover` the first that is there.
        :param rows: by label, a name for `{row}`; a list of names that are labels, too; None for
            all names at the path before `{row}`.
        :param first: heading of the labels.
        :raises LookupError: for a row, or a column, without any number. What only some rows have
            is `-` in the others.
        """
        if rows is None:
            before, _, after = path.partition('{row}')
            assert before.endswith('>') and after.startswith('>'), path
            rows = list(self.at(before[:-1]))
        if not isinstance(rows, Mapping):
            rows = {name: name for name in rows}
        lines = [f'| {first} | ' + ' | '.join(columns) + ' |', '|---' * (len(columns) + 1) + '|']
        files: dict[str, None] = {}
        missing: dict[str, LookupError] = {}
        there: set[str] = set()

        def number(row: str, names: str, spec: str | None) -> str:
            for name in names.split(' / '):
                whole = path.replace('{col}', name.replace('@', row)).replace('{row}', row)
                files[whole.partition('>')[0]] = None
                try:
                    text = self.n(whole, spec)
                except LookupError as error:
                    missing[names] = error
                else:
                    there.add(names)
                    return text
            return '-'

        for label, row in rows.items():
            cells = []
            for column in columns.values():
                parts = NUMBER.split(column if '{' in column else f'{{{column}}}')
                numbers = [number(row, *found) for found in zip(parts[1::3], parts[2::3])]
                cell = ''.join(a + b for a, b in zip(parts[::3], [*numbers, '']))
                cells.append('-' if set(cell) <= set('-, ;()') else cell)
            if set(cells) == {'-'}:
                raise LookupError(f'{path}: {row!r} has no number')
            lines.append(f'| {label} | ' + ' | '.join(cells) + ' |')
        for names in missing.keys() - there:
            raise missing[names]
        text = '\n'.join(lines)
        if not caption:
            return text
        self.captioned |= set(files)
        return f'{text}\n\n<small>{"; ".join(map(self.made, files))}</small>'

    def sources(self) -> str:
        """Return one line with the files that were read and stand below no table; "" for none."""
        others = '; '.join(map(self.made, sorted(self.files.keys() - self.captioned)))
        return others and f'<small>Numbers in the text: {others}</small>'


def rendered(template: Path, folder: Path = RESULTS) -> str:
    """Return the text of a template. Raises jinja2.UndefinedError for a name that is not known."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    numbers = Numbers(folder)
    functions = {name: getattr(numbers, name) for name in ('at', 'n', 'table', 'made', 'sources')}
    functions['systems'] = list(SYSTEMS)
    text = environment.from_string(template.read_text(encoding='utf-8')).render(functions)
    return text.rstrip() + '\n'


def with_table(page: str, table: str) -> str:
    """Return a page with its table of the same head replaced. Raises ValueError without one."""
    head, _, _ = table.partition('\n')
    lines = page.splitlines()
    if lines.count(head) != 1:
        raise ValueError(
            f'the page has {lines.count(head)} tables with the head {head!r}, not one'
        )
    start = end = lines.index(head)
    while end < len(lines) and lines[end].startswith('|'):
        end += 1
    return '\n'.join([*lines[:start], *table.rstrip().splitlines(), *lines[end:]]) + '\n'


def pages() -> dict[str, str]:
    """Return every page with measured numbers: its text by its path below the project root."""
    found = {
        PAGES.get(path.name, f'docs/results/{path.name}').removesuffix('.j2'): rendered(path)
        for path in sorted(TEMPLATES.glob('*.md.j2'))
    }
    for name, page in TABLES.items():
        text = (ROOT / page).read_text(encoding='utf-8')
        found[page] = with_table(text, rendered(TEMPLATES / 'tables' / f'{name}.md.j2'))
    return found
