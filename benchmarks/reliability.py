# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What was tried to break the package, in one run and one file.

    python -m benchmarks.reliability FOLDER --run             every part that is not done
    python -m benchmarks.reliability FOLDER --run soak flood  these parts only
    python -m benchmarks.reliability FOLDER                   the file of the parts in FOLDER

A part is a JSON file in FOLDER that a program writes row by row (`PROGRAMS`). What was broken off
goes on: rows that are there and good are not measured again, those that fell short are. To measure
all anew, take another folder. The file is of one folder and is written when all of its parts are
there; how long each part took, and of which commit it is, lies beside them. Ends with 1 when
something fell short.

``SONAR_IMM_SHARE`` is how much is tried: 1 takes 40 minutes on a quiet machine of two cores, 4 is
four times as many signals, kills, hours at sea and damaged files. Less than 1 only shows that all
programs run, each fault on one node: the file is written into FOLDER then.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from datetime import date
import json
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

from benchmarks.study import known, ROOT, write_json
from sonar_imm import __version__
from sonar_imm.trackers import SYSTEMS

RESULT = ROOT / 'docs' / 'results' / 'reliability.json'
CASES = os.environ.get('CASES', '100000')
"""Hostile messages for each system."""
SHARE = float(os.environ.get('SONAR_IMM_SHARE', '1.0'))
HOURS, LIVE_HOURS = 8.0 * SHARE, 1.0 * SHARE
_TEST = ('-m', 'pytest', '-m', 'system', '-p', 'no:cacheprovider')
_SOAK = ('-m', 'benchmarks.soak')
PROGRAMS: dict[str, tuple[str, ...]] = {
    'bounds': ('-m', 'benchmarks.bounds', '--out', '{}/bounds.json'),
    'faults': (*_TEST, 'test/system/faults/test_faults.py'),
    'signals': (*_TEST, 'test/system/faults/test_signals.py'),
    'restart': (*_TEST, 'test/system/faults/test_restart.py'),
    'damage': (*_TEST, 'test/system/faults/test_damage.py'),
    'flood': (*_TEST, 'test/system/faults/test_flood.py'),
    'soak': (*_SOAK, '--hours', str(HOURS), '--out', '{}/soak.json'),
    'soak_live': (*_SOAK, '--live', '--hours', str(LIVE_HOURS), '--out', '{}/soak_live.json'),
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
LONGEST = 30.0
"""CPU seconds that one message may take."""
Part = Any
"""Rows as a list, or by system (of 'bounds': by kind of message)."""
Row = Mapping[str, Any]


def _failures(row: Row) -> int:
    return len(row['messages']['failures']) + len(row['parameters']['failures'])


def rows_of(part: Part) -> list[Row]:
    """The rows of a part, each with its system."""
    if isinstance(part, Mapping):
        return [{'system': system, **row} for system, row in part.items()]
    return list(part)


def short_of(parts: Mapping[str, Part]) -> list[str]:
    """What fell short of the promises, in sentences."""
    missing = [f'{name}: not measured' for name in PARTS if name not in parts]
    found = [shortfall(name, row) for name in PARTS for row in rows_of(parts.get(name, ()))]
    commits = {commit for of in parts.get('run', {}).values() for commit in of['commits']}
    several = [f'parts are of {len(commits)} versions: take another folder'] * (len(commits) > 1)
    return missing + [sentence for sentence in found if sentence] + several


def shortfall(name: str, row: Row) -> str:
    """What is wrong with a row of a part, in a sentence; '' for nothing."""
    system = row.get('system')
    if name == 'bounds':
        sentence = f'{system}: {row["cpu_s"]:.1f} s of a message that was read or refused'
        return sentence if row['refused'] or row['cpu_s'] > LONGEST else ''
    if name == 'faults':
        late = row['recovered'] is None or row['recovered'] > row['limit']
        sentence = f'{row["fault"]}, {system}: recovered {row["recovered"]}'
        return sentence if late or row['traceback'] else ''
    if name == 'signals':
        sentence = f'{row["signal"]}, {system}: {row["why"]}'
        return sentence if row['clean'] < row['tried'] else ''
    if name == 'restart':
        sentence = f'restart, {system}: {row["equal"]} of {row["estimates"]} estimates are equal'
        return sentence if row['equal'] < row['estimates'] else ''
    if name == 'damage':
        sentence = f'{row["what"]}: {row["silent"]} silent, {row["failed"]} failed'
        return sentence if row['silent'] or row['failed'] else ''
    if name == 'flood':
        lost = row['sent'] - row['used'] - row['dropped'] - row['lost']
        patience = max(1.0, 6.0 / row['capacity'])
        late = row['latency_max'] > row['max_wait'] + patience or row['recovered'] > patience
        sentence = f'flood, {system}: recovered after {row["recovered"]:.2f} s, {lost} lost'
        return sentence if lost or late else ''
    if name == 'hostile':
        return f'hostile, {system}: something got through' if _failures(row) else ''
    if name == 'metamorphic':
        sentence = (
            f'{system}, {row["how"]}, {row["moved"]}: the states differ by {row["states"]:g}'
        )
        return sentence if row['states'] > row['tolerance'] else ''
    grows = row['slope_low'] > FLAT
    slower = row['p99_last_ms'] > SLOWER * row['p99_first_ms'] or row['uncounted']
    problems = [f'memory grows {row["slope_mb_per_h"]:.2f} MB/h'] * grows
    problems += ['slower at the end, or messages not counted'] * bool(slower)
    return f'a day at sea, {system}: {", ".join(problems)}' if problems else ''


def forget_the_bad(name: str, file: Path) -> None:
    """Take those rows out of the file of a part that fell short, so that they are tried again."""
    if not file.is_file():
        return
    part = _part(file)
    good: Part
    if isinstance(part, Mapping):
        good = {system: row for system, row in part.items() if not shortfall(name, row)}
    else:
        good = [row for row in part if not shortfall(name, row)]
    if good != part:
        file.write_text(json.dumps(good, indent=1) + '\n', encoding='utf-8')


def run(name: str, folder: Path) -> None:
    """Let the program of a part measure what is not there yet; says when it fails."""
    file = folder / f'{name}.json'
    forget_the_bad(name, file)
    if name in WHOLE and known(file).keys() == SYSTEMS.keys():
        return
    print(f'{name} ...', flush=True)
    environment = dict(os.environ, SONAR_IMM_FIGURES=str(folder))
    environment['PYTHONPATH'] = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    words = [word.replace('{}', str(folder)) for word in PROGRAMS[name]]
    start = time.monotonic()
    code = subprocess.run([sys.executable, *words], cwd=ROOT, env=environment).returncode
    note(name, folder, time.monotonic() - start)
    if code:
        print(f'{name}: ended with exit code {code}', flush=True)


def note(name: str, folder: Path, seconds: float) -> None:
    """Add to the file of the folder how long a part took, when, and of which commit it is."""
    runs = known(folder / 'run.json')
    before = runs.get(name, {'seconds': 0.0, 'commits': []})
    words = ['git', '-C', str(ROOT), 'describe', '--always', '--dirty']
    done = subprocess.run(words, capture_output=True, text=True)
    runs[name] = {
        'seconds': before['seconds'] + round(seconds, 3),
        'date': f'{date.today():%Y-%m-%d}',
        'share': SHARE,
        'processors': os.cpu_count(),
        'commits': sorted({*before['commits'], done.stdout.strip() or __version__}),
    }
    write_json(folder / 'run.json', runs)


def parts_of(folder: Path) -> dict[str, Part]:
    """What is in a folder, and under ``run`` how it came there."""
    files = {name: folder / f'{name}.json' for name in ('run', *PARTS)}
    return {name: _part(file) for name, file in files.items() if file.is_file()}


def _part(file: Path) -> Any:
    """What is in the file of a part; lists are of tests, the rest of studies."""
    part = json.loads(file.read_text(encoding='utf-8'))
    if isinstance(part, dict):
        part.pop('made', None)
    return part


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--run', nargs='*', choices=PARTS, metavar='PART')
    given = parser.parse_args()
    folder = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in () if given.run is None else given.run or PARTS:
        run(name, folder)
    parts = parts_of(folder)
    if set(PARTS) <= parts.keys():
        whole = all(of['share'] >= 1.0 for of in parts.get('run', {}).values())
        result = RESULT if whole else folder / RESULT.name
        write_json(result, parts, command='make reliability')
    problems = short_of(parts)
    print('\n'.join(problems) or 'all promises kept')
    sys.exit(bool(problems))


if __name__ == '__main__':
    main()
