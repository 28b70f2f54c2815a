# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What was tried to break the package, in one run, one file and the tables of docs/reliability.md.

    python -m benchmarks.reliability FOLDER --run             every part that is not done
    python -m benchmarks.reliability FOLDER --run soak flood  these parts only
    python -m benchmarks.reliability FOLDER    file and page of the parts in FOLDER
    python -m benchmarks.reliability           writes the tables of the page anew
    python -m benchmarks.reliability --check   whether the page says what the file says

A part is a JSON file in FOLDER that a program writes row by row (`PROGRAMS`). What was broken off
goes on: rows that are there and good are not measured again, those that fell short are. To measure
all anew, take another folder. File and page are of one folder and are written when all of its
parts are there; how long each part took, and of which commit it is, lies beside them. Ends with 1
when something fell short.

``SONAR_IMM_SHARE`` is how much is tried: 1 takes 40 minutes on a quiet machine of two cores, 4 is
four times as many signals, kills, hours at sea and damaged files. Less than 1 only shows that all
programs run, each fault on one node: file and page are written into FOLDER then.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from datetime import date
import json
from operator import itemgetter
import os
from pathlib import Path
import re
import subprocess
import sys
import textwrap
import time
from typing import Any

from benchmarks.study import known, write_json
from sonar_imm import __version__
from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / 'docs' / 'results' / 'reliability.json'
PAGE = ROOT / 'docs' / 'reliability.md'
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
_BLOCK = re.compile(r'(<!-- reliability: (\w+) -->\n).*?(<!-- /reliability -->)', re.DOTALL)

Part = Any
"""Rows as a list, or by system (of 'bounds': by kind of message)."""
Row = Mapping[str, Any]


def _plain(name: str, form: str = '') -> Callable[[Row], str]:
    return lambda row: format(row[name], form)


def _failures(row: Row) -> int:
    return len(row['messages']['failures']) + len(row['parameters']['failures'])


SOAK: dict[str, Callable[[Row], str]] = {
    'system': _plain('system'),
    'hours': _plain('hours', 'g'),
    'memory, MB': _plain('memory_mb', '.0f'),
    'slope, MB/h': _plain('slope_mb_per_h', '.3f'),
    'grown in the second half, MB': _plain('grown_mb', '.2f'),
    'p99 first tenth, ms': _plain('p99_first_ms', '.2f'),
    'p99 last tenth, ms': _plain('p99_last_ms', '.2f'),
}
MESSAGES = {
    'fixes': '`fixes`: 10,000 of one scan, at random, `association: gnn`',
    'fixes_softly': 'the same by default',
    'arrivals_wild_tag': '`arrivals`: a tag, 1000 receivers, times that fit nothing',
    'arrivals_many_divers': '`arrivals`: echoes of 50 divers at 20 receivers',
    'detections': '`detections`: 10,000 echoes all over the beam',
    'snapshot': '`snapshot`: 20,000 bins of 8 staves',
    'pressure': '`pressure`: 200,000 samples of 32 hydrophones',
    'csdm': '`csdm`: 2000 frequencies of 32 hydrophones',
    'trace': '`trace`: 50,000 depths',
}
"""What the messages of `benchmarks.bounds` are."""
COLUMNS: dict[str, dict[str, Callable[[Row], str]]] = {
    'bounds': {
        'message': lambda row: MESSAGES[row['system']],
        'MB': _plain('size_mb', '.2f'),
        'CPU s': _plain('cpu_s', '.2f'),
        'memory MB': _plain('memory_mb', '.0f'),
    },
    'flood': {
        'node': _plain('system'),
        'can, 1/s': _plain('capacity', '.0f'),
        'sent, 1/s': _plain('rate', '.0f'),
        'used': _plain('used'),
        'dropped': _plain('dropped'),
        'lost': _plain('lost'),
        'latency p50, s': _plain('latency_p50', '.2f'),
        'most, s': _plain('latency_max', '.2f'),
        'recovery, s': _plain('recovered', '.2f'),
    },
    'soak': SOAK,
    'soak_live': SOAK,
}
"""The columns of each table with a row for each row of the part; that of the faults has one for
each fault and a column for each system (`table_of`)."""


def _signals(rows: Sequence[Row]) -> str:
    names = ', '.join(dict.fromkeys(row['signal'] for row in rows))
    clean, tried = (sum(row[name] for row in rows) for name in ('clean', 'tried'))
    return f'{clean} of {tried} nodes ended so: {names}.'


def _restart(rows: Sequence[Row]) -> str:
    killed, estimates, equal, changed = (
        sum(row[name] for row in rows)
        for name in ('tried', 'estimates', 'equal', 'changed_without')
    )
    return (
        f'{killed} nodes killed: {equal} of {estimates} estimates are equal bit for bit; without '
        f'the file {changed} differ.'
    )


def _damage(rows: Sequence[Row]) -> str:
    each = ', '.join(f'{row["what"]} {row["tried"]} times' for row in rows)
    tried, said, silent, failed = (
        sum(int(row[name]) for row in rows) for name in ('tried', 'said', 'silent', 'failed')
    )
    return (
        f'{each}: {said} of {tried} reported, {silent} silent and not harmless, {failed} crashes '
        'or partial outputs.'
    )


def _hostile(rows: Sequence[Row]) -> str:
    sent, read = (sum(row['messages'][name] for row in rows) for name in ('cases', 'read'))
    draws, slowest = (
        sum(row['parameters']['draws'] for row in rows),
        max(row['messages']['ms_p999'] for row in rows),
    )
    crashes = sum(map(_failures, rows))
    return (
        f'{sent} messages, of which {read} could be read, and {draws} extreme parameters: '
        f'{crashes} crashes; the slowest of 1000 messages took {slowest:g} ms.'
    )


def _metamorphic(rows: Sequence[Row]) -> str:
    shares = [row['states'] / (row['tolerance'] or 1.0) for row in rows]
    row, share = max(zip(rows, shares), key=itemgetter(1))
    return (
        f'{len(rows)} pairs of a way to track and a moved scene: states differ by at most '
        f'{share:.1g} of what is tolerated ({row["system"]}, {row["how"]}, {row["moved"]}).'
    )


SENTENCES: dict[str, Callable[[Sequence[Row]], str]] = {
    'signals': _signals,
    'restart': _restart,
    'damage': _damage,
    'hostile': _hostile,
    'metamorphic': _metamorphic,
}
"""Parts that are a sentence on the page."""


def rows_of(part: Part) -> list[Row]:
    """The rows of a part, each with its system."""
    if isinstance(part, Mapping):
        return [{'system': system, **row} for system, row in part.items()]
    return list(part)


def table_of(name: str, part: Part) -> list[list[str]]:
    """Return the cells of the table of a part, the head first."""
    rows = rows_of(part)
    if name == 'faults':
        cells = {(row['system'], row['fault']): _recovery(row) for row in rows}
        alike: dict[tuple[str, ...], list[str]] = {}
        for fault in dict.fromkeys(row['fault'] for row in rows):
            of_fault = tuple(cells.get((system, fault), '') for system in SYSTEMS)
            alike.setdefault(of_fault, []).append(fault)
        return [['fault', *SYSTEMS], *(['; '.join(names), *each] for each, names in alike.items())]
    columns = COLUMNS[name]
    return [[*columns], *([text(row) for text in columns.values()] for row in rows)]


def _recovery(row: Row) -> str:
    """Messages until estimates are as if nothing had been, and what was lost."""
    recovered = 'never' if row['recovered'] is None else str(row['recovered'])
    losses = ', '.join(
        f'{n} {name.rpartition(": ")[2]}' for name, n in sorted(row['losses'].items())
    )
    return f'{recovered}; {losses}' if losses else recovered


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


def _about(run: Mapping[str, Row]) -> str:
    """Return the run in a sentence."""
    seconds = sum(of['seconds'] for of in run.values())
    (last, *_) = sorted((of['date'] for of in run.values()), reverse=True)
    processors = max(of['processors'] for of in run.values())
    commits = sorted({commit for of in run.values() for commit in of['commits']})
    shares = sorted({of['share'] for of in run.values()})
    return (
        f'One run of {last}, {seconds / 60.0:.0f} minutes on {processors} '
        f'processors, of {" and ".join(f"`{commit}`" for commit in commits)}, `SHARE` '
        f'{" and ".join(f"{share:g}" for share in shares)}.'
    )


def page_of(text: str, parts: Mapping[str, Part]) -> str:
    """The page with the tables of `parts` between its marks."""

    def table(found: re.Match[str]) -> str:
        name = found.group(2)
        if name not in parts and name == 'run':
            return f'{found.group(1)}Measured part by part, of several versions.\n{found.group(3)}'
        if name not in parts:
            return f'{found.group(1)}Not measured yet.\n{found.group(3)}'
        if name == 'run':
            return f'{found.group(1)}{_about(parts[name])}\n{found.group(3)}'
        if name in SENTENCES:
            sentence = textwrap.fill(SENTENCES[name](rows_of(parts[name])), 140)
            return f'{found.group(1)}{sentence}\n{found.group(3)}'
        head, *body = table_of(name, parts[name])
        lines = [head, ['---'] * len(head), *body]
        text = '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)
        return f'{found.group(1)}{text}\n{found.group(3)}'

    return _BLOCK.sub(table, text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path, nargs='?')
    parser.add_argument('--check', action='store_true')
    parser.add_argument('--run', nargs='*', choices=PARTS, metavar='PART')
    given = parser.parse_args()
    parts = known(RESULT)
    page = PAGE.read_text(encoding='utf-8')
    if given.check:
        sys.exit(page != page_of(page, parts))
    if given.folder is None:
        PAGE.write_text(page_of(page, parts), encoding='utf-8')
        return
    folder = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in () if given.run is None else given.run or PARTS:
        run(name, folder)
    parts = parts_of(folder)
    if set(PARTS) <= parts.keys():
        whole = all(of['share'] >= 1.0 for of in parts.get('run', {}).values())
        result = RESULT if whole else folder / RESULT.name
        write_json(result, parts, command='make reliability')
        written = PAGE if whole else folder / PAGE.name
        written.write_text(page_of(page, parts), encoding='utf-8')
    problems = short_of(parts)
    print('\n'.join(problems) or 'all promises kept')
    sys.exit(bool(problems))


if __name__ == '__main__':
    main()
