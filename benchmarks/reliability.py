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

"""What `make reliability` found out, in one file, and the tables of docs/reliability.md.

    python -m benchmarks.reliability FOLDER    takes the parts in FOLDER in, writes file and page
    python -m benchmarks.reliability           writes the tables of the page anew
    python -m benchmarks.reliability --check   whether the page says what the file says

A part is a JSON file that a long form wrote: faults, signals, damage and flood by
`test/system/faults`, soak and soak_live by `benchmarks.soak`, hostile by `make fuzz`, metamorphic
by `test/trackers/test_metamorphic.py`. A part that is not in FOLDER stays as it was. Ends with 1
when something fell short.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import json
from pathlib import Path
import re
import sys
from typing import Any

from benchmarks.tables import write_json
from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / 'docs' / 'results' / 'reliability.json'
PAGE = ROOT / 'docs' / 'reliability.md'
PARTS = (
    'faults',
    'signals',
    'damage',
    'flood',
    'soak',
    'soak_live',
    'hostile',
    'metamorphic',
)
FLAT = 1.0
"""MB per hour: memory that grows faster is no longer called flat."""
SLOWER = 2.0
"""Times by which the 99th percentile of the last tenth may be above that of the first."""
_BLOCK = re.compile(r'(<!-- reliability: (\w+) -->\n).*?(<!-- /reliability -->)', re.DOTALL)

Part = Any
Rows = list[list[str]]


def faults(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per fault: messages until estimates are as if nothing had been, and what was lost."""
    rows = [['fault', *SYSTEMS]]
    for name in dict.fromkeys(row['fault'] for row in part):
        cells = {row['system']: row for row in part if row['fault'] == name}
        rows.append([name, *(_recovery(cells.get(system)) for system in SYSTEMS)])
    return rows


def _recovery(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ''
    recovered = 'never' if row['recovered'] is None else str(row['recovered'])
    losses = ', '.join(
        f'{n} {name.rpartition(": ")[2]}' for name, n in sorted(row['losses'].items())
    )
    return f'{recovered}; {losses}' if losses else recovered


def signals(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per system: clean ends of those tried."""
    names = list(dict.fromkeys(row['signal'] for row in part))
    rows = [['node', *names]]
    for system in SYSTEMS:
        told = {row['signal']: row for row in part if row['system'] == system}
        cells = [f'{told[n]["clean"]} of {told[n]["tried"]}' if n in told else '' for n in names]
        rows.append([system, *cells])
    return rows


def damage(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per kind: tried, said, neither said nor harmless."""
    rows = [['what', 'tried', 'said', 'silent and not harmless', 'crashes, partial output']]
    return rows + [
        [row['what'], *(str(row[name]) for name in ('tried', 'said', 'silent', 'failed'))]
        for row in part
    ]


def flood(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per system."""
    head = ['node', 'can, 1/s', 'sent, 1/s', 'messages', 'used', 'dropped', 'lost']
    rows = [[*head, 'latency p50, s', 'most, s', 'recovery, s']]
    for row in part:
        counted = [str(row[name]) for name in ('sent', 'used', 'dropped', 'lost')]
        times = [f'{row[name]:.2f}' for name in ('latency_p50', 'latency_max', 'recovered')]
        speed = [f'{row["capacity"]:.0f}', f'{row["rate"]:.0f}']
        rows.append([row['system'], *speed, *counted, *times])
    return rows


def soak(part: Mapping[str, Mapping[str, float]]) -> Rows:
    """A row per system."""
    head = ['system', 'hours', 'messages', 'memory, MB', 'slope, MB/h', 'its 95 % interval']
    rows = [[*head, 'p99 first tenth, ms', 'p99 last tenth, ms', 'not counted']]
    for system, told in part.items():
        rows.append(
            [
                system,
                f'{told["hours"]:g}',
                f'{told["messages"]:.0f}',
                f'{told["memory_mb"]:.0f}',
                f'{told["slope_mb_per_h"]:.3f}',
                f'{told["slope_low"]:.3f} to {told["slope_high"]:.3f}',
                f'{told["p99_first_ms"]:.2f}',
                f'{told["p99_last_ms"]:.2f}',
                f'{told["uncounted"]:.0f}',
            ]
        )
    return rows


def hostile(part: Mapping[str, Mapping[str, Any]]) -> Rows:
    """A row per system."""
    head = ['system', 'messages', 'read', 'extreme parameters', 'crashes']
    rows = [[*head, 'slowest of 1000, ms', 'memory grown, MB']]
    for system, told in part.items():
        messages, parameters = told['messages'], told['parameters']
        rows.append(
            [
                system,
                str(messages['cases']),
                str(messages['read']),
                str(parameters['draws']),
                str(len(messages['failures']) + len(parameters['failures'])),
                f'{messages["ms_p999"]:g}',
                f'{messages["memory_grown_mb"]:g}',
            ]
        )
    return rows


def metamorphic(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per system, variant and transformation: the tolerance, and the worst differences."""
    kinds = ('places', 'states', 'covariances', 'probabilities')
    rows = [['system', 'with', 'scene', 'tolerance', *kinds]]
    for row in sorted(part, key=lambda one: (one['system'], one['how'])):
        worst = ['' if (gap := row.get(kind)) is None else f'{gap:.1g}' for kind in kinds]
        rows.append([row['system'], row['how'], row['moved'], f'{row["tolerance"]:g}', *worst])
    return rows


TABLES: dict[str, Callable[[Part], Rows]] = {
    'faults': faults,
    'signals': signals,
    'damage': damage,
    'flood': flood,
    'soak': soak,
    'soak_live': soak,
    'hostile': hostile,
    'metamorphic': metamorphic,
}


def short_of(parts: Mapping[str, Part]) -> list[str]:
    """What fell short of the promises, in sentences."""
    said = [f'{name}: not measured' for name in PARTS if name not in parts]
    for row in parts.get('faults', ()):
        late = row['recovered'] is None or row['recovered'] > row['limit']
        if late or row['traceback']:
            said.append(f'{row["fault"]}, {row["system"]}: recovered {row["recovered"]}')
    for row in parts.get('signals', ()):
        if row['clean'] < row['tried']:
            said.append(f'{row["signal"]}, {row["system"]}: {row["why"]}')
    for row in parts.get('damage', ()):
        if row['silent'] or row['failed']:
            said.append(f'{row["what"]}: {row["silent"]} silent, {row["failed"]} failed')
    for name in ('soak', 'soak_live'):
        for system, told in parts.get(name, {}).items():
            if told['slope_low'] > FLAT:
                said.append(f'{name}, {system}: memory grows {told["slope_mb_per_h"]:.2f} MB/h')
            if told['p99_last_ms'] > SLOWER * told['p99_first_ms'] or told['uncounted']:
                said.append(f'{name}, {system}: slower at the end, or messages not counted')
    for system, told in parts.get('hostile', {}).items():
        if told['messages']['failures'] or told['parameters']['failures']:
            said.append(f'hostile, {system}: something got through')
    return said


def page_of(text: str, parts: Mapping[str, Part]) -> str:
    """The page with the tables of `parts` between its marks."""

    def table(found: re.Match[str]) -> str:
        name = found.group(2)
        if name not in parts:
            return f'{found.group(1)}Not measured yet.\n{found.group(3)}'
        head, *body = TABLES[name](parts[name])
        lines = [head, ['---'] * len(head), *body]
        told = '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)
        source = f'<!-- numbers: {RESULT.name} -->'
        return f'{found.group(1)}{source}\n{told}\n{found.group(3)}'

    return _BLOCK.sub(table, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path, nargs='?')
    parser.add_argument('--check', action='store_true')
    told = parser.parse_args()
    parts = json.loads(RESULT.read_text(encoding='utf-8')) if RESULT.is_file() else {}
    page = PAGE.read_text(encoding='utf-8')
    if told.check:
        sys.exit(page != page_of(page, parts))
    if told.folder:
        for name in PARTS:
            if (file := told.folder / f'{name}.json').is_file():
                parts[name] = json.loads(file.read_text(encoding='utf-8'))
        write_json(RESULT, parts)
    PAGE.write_text(page_of(page, parts), encoding='utf-8')
    if told.folder:
        problems = short_of(parts)
        print('\n'.join(problems) or 'all promises kept')
        sys.exit(bool(problems))


if __name__ == '__main__':
    main()
