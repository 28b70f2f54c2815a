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

"""What was tried to break the package, in one file, and the tables of docs/reliability.md.

    python -m benchmarks.reliability FOLDER --run             every part that is not done, hours
    python -m benchmarks.reliability FOLDER --run soak flood  these parts only
    python -m benchmarks.reliability FOLDER    takes the parts in FOLDER in, writes file and page
    python -m benchmarks.reliability           writes the tables of the page anew
    python -m benchmarks.reliability --check   whether the page says what the file says

A part is a JSON file in FOLDER that a program writes row by row (`PROGRAMS`). What was broken off
goes on: rows that are there and good are not measured again, those that fell short are. To measure
all anew, take another folder. File and page are written after each part; a row that is not in
FOLDER stays as it was. Ends with 1 when something fell short.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import json
import os
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

from benchmarks.tables import write_json
from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / 'docs' / 'results' / 'reliability.json'
PAGE = ROOT / 'docs' / 'reliability.md'
CASES = os.environ.get('CASES', '100000')
"""Hostile messages for each system."""
_TEST = ('-m', 'pytest', '-m', 'system', '-p', 'no:cacheprovider')
_SOAK = ('-m', 'benchmarks.soak')
PROGRAMS: dict[str, tuple[str, ...]] = {
    'faults': (*_TEST, 'test/system/faults/test_faults.py'),
    'signals': (*_TEST, 'test/system/faults/test_signals.py'),
    'restart': (*_TEST, 'test/system/faults/test_restart.py'),
    'damage': (*_TEST, 'test/system/faults/test_damage.py'),
    'flood': (*_TEST, 'test/system/faults/test_flood.py'),
    'soak': (*_SOAK, '--out', '{}/soak.json'),
    'soak_live': (*_SOAK, '--live', '--hours', '1', '--out', '{}/soak_live.json'),
    'metamorphic': ('-m', 'pytest', '-n', '0', 'test/trackers/test_metamorphic.py'),
    'hostile': ('-m', 'helpers.hostile', '--cases', CASES, '--json', '{}/hostile.json'),
}
"""What makes each part, for Python; {} is the folder."""
PARTS = tuple(PROGRAMS)
WHOLE = ('hostile',)
"""Parts whose program writes its file at the end, not row by row."""
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


def restart(part: Sequence[Mapping[str, Any]]) -> Rows:
    """A row per system."""
    rows = [['node', 'killed', 'messages sent again', 'estimates', 'equal bit for bit']]
    rows[0].append('others without the file')
    names = ('system', 'tried', 'again', 'estimates', 'equal', 'changed_without')
    return rows + [[str(row[name]) for name in names] for row in part]


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
    'restart': restart,
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
    return said + [short for name in PARTS for short in _short(name, parts.get(name, ()))]


def _short(name: str, part: Part) -> list[str]:
    rows = part.items() if isinstance(part, Mapping) else (('', row) for row in part)
    return [sentence for system, row in rows for sentence in SHORT[name](row, system)]


def _short_fault(row: Mapping[str, Any], _: str) -> list[str]:
    late = row['recovered'] is None or row['recovered'] > row['limit']
    said = f'{row["fault"]}, {row["system"]}: recovered {row["recovered"]}'
    return [said] if late or row['traceback'] else []


def _short_signal(row: Mapping[str, Any], _: str) -> list[str]:
    said = f'{row["signal"]}, {row["system"]}: {row["why"]}'
    return [said] if row['clean'] < row['tried'] else []


def _short_restart(row: Mapping[str, Any], _: str) -> list[str]:
    said = f'restart, {row["system"]}: {row["equal"]} of {row["estimates"]} estimates are equal'
    return [said] if row['equal'] < row['estimates'] else []


def _short_damage(row: Mapping[str, Any], _: str) -> list[str]:
    said = f'{row["what"]}: {row["silent"]} silent, {row["failed"]} failed'
    return [said] if row['silent'] or row['failed'] else []


def _short_flood(row: Mapping[str, Any], _: str) -> list[str]:
    uncounted = row['sent'] - row['used'] - row['dropped'] - row['lost']
    patience = max(1.0, 6.0 / row['capacity'])
    late = row['latency_max'] > row['max_wait'] + patience or row['recovered'] > patience
    said = f'flood, {row["system"]}: recovered after {row["recovered"]:.2f} s, {uncounted} lost'
    return [said] if uncounted or late else []


def _short_soak(row: Mapping[str, float], system: str) -> list[str]:
    said = []
    if row['slope_low'] > FLAT:
        said.append(f'a day at sea, {system}: memory grows {row["slope_mb_per_h"]:.2f} MB/h')
    if row['p99_last_ms'] > SLOWER * row['p99_first_ms'] or row['uncounted']:
        said.append(f'a day at sea, {system}: slower at the end, or messages not counted')
    return said


def _short_hostile(row: Mapping[str, Any], system: str) -> list[str]:
    failed = row['messages']['failures'] or row['parameters']['failures']
    return [f'hostile, {system}: something got through'] if failed else []


def _short_metamorphic(row: Mapping[str, Any], _: str) -> list[str]:
    said = f'{row["system"]}, {row["how"]}, {row["moved"]}: the states differ by {row["states"]:g}'
    return [said] if row['states'] > row['tolerance'] else []


SHORT: dict[str, Callable[[Any, str], list[str]]] = {
    'faults': _short_fault,
    'signals': _short_signal,
    'restart': _short_restart,
    'damage': _short_damage,
    'flood': _short_flood,
    'soak': _short_soak,
    'soak_live': _short_soak,
    'metamorphic': _short_metamorphic,
    'hostile': _short_hostile,
}
"""What is wrong with a row of each part, in sentences."""


def forget_the_bad(name: str, file: Path) -> None:
    """Take those rows out of the file of a part that fell short, so that they are tried again."""
    if not file.is_file():
        return
    part = json.loads(file.read_text(encoding='utf-8'))
    good: Part
    if isinstance(part, Mapping):
        good = {system: row for system, row in part.items() if not SHORT[name](row, system)}
    else:
        good = [row for row in part if not SHORT[name](row, '')]
    if good != part:
        file.write_text(json.dumps(good, indent=1) + '\n', encoding='utf-8')


def run(name: str, folder: Path) -> None:
    """Let the program of a part measure what is not there yet; says when it fails."""
    file = folder / f'{name}.json'
    forget_the_bad(name, file)
    if name in WHOLE and file.is_file() and json.loads(file.read_text()).keys() == SYSTEMS.keys():
        return
    print(f'{name} ...', flush=True)
    told = dict(os.environ, SONAR_IMM_FIGURES=str(folder))
    told['PYTHONPATH'] = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    words = [word.replace('{}', str(folder)) for word in PROGRAMS[name]]
    code = subprocess.run([sys.executable, *words], cwd=ROOT, env=told).returncode
    if code:
        print(f'{name}: ended with exit code {code}', flush=True)


def _merged(old: Part, new: Part) -> Part:
    """The rows of `old`, those that `new` has replaced by it, and what is new after them."""
    if isinstance(new, Mapping):
        both = {**(old or {}), **new}
        return {system: both[system] for system in SYSTEMS if system in both}
    rows = {_key(row): row for row in [*(old or []), *new]}
    return list(rows.values())


def _key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a row is about."""
    return tuple(row.get(name) for name in ('system', 'fault', 'signal', 'what', 'how', 'moved'))


def take_in(folder: Path, parts: dict[str, Part]) -> None:
    """Write file and page with the parts of `folder`."""
    for name in PARTS:
        if (file := folder / f'{name}.json').is_file():
            parts[name] = _merged(parts.get(name), json.loads(file.read_text(encoding='utf-8')))
    write_json(RESULT, parts)
    page = PAGE.read_text(encoding='utf-8')
    PAGE.write_text(page_of(page, parts), encoding='utf-8')


def page_of(text: str, parts: Mapping[str, Part]) -> str:
    """The page with the tables of `parts` between its marks."""

    def table(found: re.Match[str]) -> str:
        name = found.group(2)
        if name not in parts:
            return f'{found.group(1)}Not measured yet.\n{found.group(3)}'
        head, *body = TABLES[name](parts[name])
        lines = [head, ['---'] * len(head), *body]
        told = '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)
        source = f'<!-- numbers: {RESULT.name}; made by benchmarks.reliability -->'
        return f'{found.group(1)}{source}\n{told}\n{found.group(3)}'

    return _BLOCK.sub(table, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path, nargs='?')
    parser.add_argument('--check', action='store_true')
    parser.add_argument('--run', nargs='*', choices=PARTS, metavar='PART')
    told = parser.parse_args()
    parts = json.loads(RESULT.read_text(encoding='utf-8')) if RESULT.is_file() else {}
    page = PAGE.read_text(encoding='utf-8')
    if told.check:
        sys.exit(page != page_of(page, parts))
    if told.folder is None:
        PAGE.write_text(page_of(page, parts), encoding='utf-8')
        return
    folder = told.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in () if told.run is None else told.run or PARTS:
        run(name, folder)
        take_in(folder, parts)
    take_in(folder, parts)
    problems = short_of(parts)
    print('\n'.join(problems) or 'all promises kept')
    sys.exit(bool(problems))


if __name__ == '__main__':
    main()
