# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Which seed makes a typical recording of a scene, and what `check` may allow on it.

    python -m benchmarks.typical_seed obstacle movers --runs 31
    python -m benchmarks.typical_seed obstacle movers --runs 31 --write bags/obstacle_movers

A recording that is shipped is one draw of many, and a lucky one would promise too much. So the
scene is simulated, tracked and scored under many seeds, and the seed is taken whose error is the
median. With several metrics (``--metric``, dotted names of
``metrics.json``; by default the one that `check` compares) it is the seed whose rank is nearest to
the middle in all of them; errors with a sign are ranked by their size. The limit of `check` is
what nine in ten of these runs stay below, rounded up to two digits.

``--write`` makes the recording of that seed with its limit (``check.yaml``) and a README.md that
says all this; with ``--keep SEED`` the recording that is there stays, whose seed it names.
``--seed`` begins the runs, ``--set`` changes the scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from importlib import import_module
import io
import json
import math
import os
from pathlib import Path
import shutil
import sys
from tempfile import TemporaryDirectory

from attrs import frozen
import numpy as np

from benchmarks.study import markdown
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import main as sonar_imm
from sonar_imm_tools.evaluation.judging import Limit
from sonar_imm_tools.evaluation.numbers import flatten
from sonar_imm_tools.offline.jobs import workers as sharing
from sonar_imm_tools.recordings.own_files import write_own_limit

SHARE = 0.9
"""Of the runs that are within the limit of `check`."""


@frozen
class Typical:
    """seed: whose errors are in the middle, or that is kept; rank: of its first error, 1 the
    smallest; limit: for `check`; spread: of each metric."""

    seed: int
    rank: int
    limit: float
    spread: dict[str, dict[str, float]]


Runs = Mapping[int, Mapping[str, float]]
"""By seed, what `evaluate` says; nothing of a run that failed."""


def typical(runs: Runs, metrics: Sequence[str], keep: int | None = None) -> Typical:
    """The typical one of runs, or the seed to `keep`; the first of the metrics has the limit.

    Raises ValueError when a metric is missing in more than half of the runs.
    """
    seeds = sorted(runs)
    error = np.array([[abs(runs[s].get(name, math.inf)) for name in metrics] for s in seeds])
    for name, column in zip(metrics, error.T):
        if 2 * np.isinf(column).sum() >= len(runs):
            known = sorted({name for run in runs.values() for name in run})
            raise ValueError(f'most runs have no {name}; there are: {", ".join(known)}')
    rank = np.argsort(np.argsort(error, axis=0, kind='stable'), axis=0)
    off = np.abs(rank - (len(runs) - 1) // 2)
    # The worst rank decides, then the sum of all, then the first metric.
    best = int(np.lexsort((off[:, 0], off.sum(axis=1), off.max(axis=1)))[0])
    if keep is not None:
        best = seeds.index(keep)
    spread = {}
    for name, column in zip(metrics, error.T):
        finite = column[np.isfinite(column)]
        columns = [column[best], *np.percentile(finite, [50, 5, 95])]
        spread[name] = dict(zip(('of the seed', 'median', '5 %', '95 %'), map(float, columns)))
    first = error[:, 0]
    limit = rounded_up(float(np.percentile(first[np.isfinite(first)], 100 * SHARE)))
    return Typical(seeds[best], int(rank[best, 0]) + 1, limit, spread)


def rounded_up(value: float, digits: int = 2) -> float:
    """The next number of so many digits that is not below `value`."""
    if value <= 0.0:
        return 0.0
    places = digits - 1 - math.floor(math.log10(value))
    return round(math.ceil(value * 10**places - 1e-9) / 10**places, max(places, 0))


def simulated(given: argparse.Namespace, seed: int) -> list[str]:
    """The command that makes the recording, without the name of the program and of the bag."""
    pairs = [text for pair in given.set for text in ('--set', pair)]
    return ['--scenario', given.scene, '--seed', str(seed), *pairs, *given.compress]


def readme(given: argparse.Namespace, found: Typical, limit: Limit, failed: int) -> str:
    """What README.md of the recording says."""
    name = Path(given.write).name
    command = [
        'sonar-imm',
        'simulate',
        given.system,
        f'bags/{name}',
        *simulated(given, found.seed),
    ]
    again = ['python', '-m', 'benchmarks.typical_seed', given.system, given.scene]
    again += ['--runs', str(given.runs), '--seed', str(given.seed)]
    again += [text for pair in given.set for text in ('--set', pair)]
    again += [text for metric in given.metric for text in ('--metric', metric)]
    again += [*given.compress, '--write', f'bags/{name}']
    again += [] if given.keep is None else ['--keep', str(given.keep)]
    first = next(iter(found.spread))
    what = limit.meaning if first == limit.metric else f'`{first}`'
    return '\n'.join(
        [
            f'# {name}',
            '',
            f'    {" ".join(command)}',
            '',
            f'Number {found.rank} of seeds {given.seed} to {given.seed + given.runs - 1} by '
            f'{what}, the smallest first.' + (f' {failed} runs failed.' if failed else ''),
            f'`sonar-imm check {given.system}` allows {found.limit:g} {limit.unit}; '
            f'{100 * SHARE:.0f} % of these runs stay below.',
            '',
            markdown(found.spread),
            '',
            f'    {" ".join(again)}',
            '',
        ]
    )


def scored(system: str, scene: Sequence[str]) -> dict[str, float]:
    """What `simulate`, `track` and `evaluate` make of a scene; nothing where one of them fails."""
    with TemporaryDirectory(prefix='sonar_imm_study_') as place, redirect_stdout(io.StringIO()):
        bag, run = f'{place}/scene', f'{place}/run'
        for words in (
            ('simulate', system, bag, *scene),
            ('track', bag, run),
            ('evaluate', run, '--no-report'),
        ):
            if sonar_imm([*words]):
                return {}
        metrics = flatten(json.loads(Path(run, 'metrics.json').read_text(encoding='utf-8')))
    return {
        name: float(value)
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }


def runs_of(given: argparse.Namespace) -> dict[int, dict[str, float]]:
    """All runs, shared by processes with a thread each."""
    seeds = range(given.seed, given.seed + given.runs)
    os.environ.update(dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), '1'))
    found: dict[int, dict[str, float]] = {}
    with sharing(min(given.workers or len(os.sched_getaffinity(0)), given.runs)) as run:
        calls = [(given.system, simulated(given, seed)) for seed in seeds]
        for k, metrics, failure in run(scored, calls):
            found[seeds[k]] = metrics or {}
            text = failure or ', '.join(
                f'{name} {found[seeds[k]].get(name, math.nan):.3f}' for name in given.metric
            )
            print(f'seed {seeds[k]}: {text}', file=sys.stderr, flush=True)
    return found


def write(given: argparse.Namespace, found: Typical, text: str) -> None:
    """Make the recording, its limit and README.md, in place of those there are."""
    folder = Path(given.write)
    if given.keep is None:
        if folder.exists():
            shutil.rmtree(folder)
        status = sonar_imm(['simulate', given.system, str(folder), *simulated(given, found.seed)])
        if status:
            sys.exit(status)
    write_own_limit(folder, found.limit, simulated(given, found.seed))
    (folder / 'README.md').write_text(text, encoding='utf-8')


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('system', choices=list(SYSTEMS))
    parser.add_argument('scene', help='one of `sonar-imm simulate SYSTEM --list`')
    parser.add_argument('--runs', type=int, default=31)
    parser.add_argument('--seed', type=int, default=1, help='of the first run')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE')
    parser.add_argument('--metric', action='append', default=[], help='the first has the limit')
    parser.add_argument('--workers', type=int, help='processes; by default one per core')
    parser.add_argument('--write', type=Path, metavar='BAG', help='make the recording here')
    parser.add_argument(
        '--keep',
        type=int,
        metavar='SEED',
        help='the recording of --write stays; it is of this seed',
    )
    parser.add_argument(
        '--compress', action='store_const', const=['--compress'], default=[], help='the recording'
    )
    given = parser.parse_args()
    limit = import_module(SYSTEMS[given.system].judge).LIMIT
    given.metric = given.metric or [limit.metric]
    runs = runs_of(given)
    failed = sum(not metrics for metrics in runs.values())
    try:
        found = typical(runs, given.metric, given.keep)
    except ValueError as error:
        sys.exit(str(error))
    print(markdown(found.spread))
    print(f'seed {found.seed}, limit for check {found.limit:g} {limit.unit}, {failed} failed')
    if given.write:
        write(given, found, readme(given, found, limit, failed))


if __name__ == '__main__':
    main()
