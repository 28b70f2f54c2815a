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

"""Monte Carlo sweeps: one scenario under many seeds, the scores of all runs summed up.

A run does what `simulate`, `track` and `evaluate` do one after the other, with their functions, in
a folder that is thrown away. So its numbers are theirs for the same seed. Runs know nothing of one
another: where they run, how many at a time and in which order they end changes no number.

A run that fails is an `Outcome` too, with a sentence instead of metrics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import csv
from importlib import import_module
import math
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from attrs import field, frozen
import numpy as np

from sonar_imm import __version__
from sonar_imm.files import whole
from sonar_imm.parameters import Config, ConfigError
from sonar_imm.trackers import SYSTEMS

from ..offline.jobs import as_they_end, cluster, ignore_interrupt, sentence_of
from ..offline.run_folder import RunFolder
from ..offline.tracking import InputOptions, OfflineRun, write_run
from ..recordings.reader import BagReader
from ..recordings.scenes import write_scene
from ..recordings.sources import BagError
from .judging import judge
from .numbers import flatten

CSV, JSON = 'sweep.csv', 'sweep.json'
PREFIX = 'sonar_imm_sweep_'
ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
"""What a worker process has as 1: the runs share the cores, not the algebra inside one run. The
kernels of numba are serial."""


@frozen(kw_only=True)
class Sweep:
    """What all runs have in common. Plain values, so that it travels to other machines.

    scene: parameters of the scenario; config: of the tracker, its own seed included, which is the
    same in all runs.
    """

    system: str
    scenario: str
    scene: Config
    config: Config
    options: InputOptions
    version: str = __version__


@frozen
class Outcome:
    """What became of one run: flat metrics by name, or the sentence that says why there are none.

    versions: of what computed it.
    """

    seed: int
    metrics: Mapping[str, float] = field(factory=dict)
    failure: str = ''
    versions: Mapping[str, str] = field(factory=dict)


def run_seed(sweep: Sweep, seed: int, within: str | None = None) -> Outcome:
    """Simulate, track and score one seed, in a temporary folder below `within`, by default the
    system's.

    Never raises: a bad run must not end the others.
    """
    with TemporaryDirectory(prefix=PREFIX, dir=within) as place:
        try:
            return _run(sweep, seed, Path(place))
        except Exception as error:
            # The place differs from run to run; the sentence has to be the same each time.
            return Outcome(seed, failure=sentence_of(error).replace(f'{place}{os.sep}', ''))


def _run(sweep: Sweep, seed: int, place: Path) -> Outcome:
    if sweep.version != __version__:
        raise ConfigError(f'the worker has sonar_imm {__version__}, the sweep {sweep.version}')
    scenes = import_module(SYSTEMS[sweep.system].scenes)
    bag, folder = place / 'scene', RunFolder(place / 'run')
    write_scene(scenes.simulate(sweep.scene, seed), bag, provenance={'seed': str(seed)})
    with BagReader(bag) as reader:
        offline = OfflineRun(reader, SYSTEMS[sweep.system], sweep.config, sweep.options)
        with folder.fresh() as unfinished:
            run = write_run(unfinished, offline)
    return Outcome(seed, finite_numbers(judge(folder).metrics), versions=run['versions'])


def finite_numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The finite numbers among nested metrics by dotted name; True is 1, so a mean is a share."""
    return {
        name: int(value) if isinstance(value, bool) else value
        for name, value in flatten(metrics).items()
        if isinstance(value, (bool, int, float)) and math.isfinite(value)
    }


# -- where the runs run --------------------------------------------------------------------------


def run_here(sweep: Sweep, seeds: Iterable[int]) -> Iterator[Outcome]:
    """One after the other in this process, without dask."""
    return (run_seed(sweep, seed) for seed in seeds)


def run_on_processes(sweep: Sweep, seeds: Sequence[int], workers: int) -> Iterator[Outcome]:
    """In so many processes of this machine, as they end. They listen on its loopback interface
    only, whatever dask is configured to, and there is no dashboard.

    Raises ModuleNotFoundError without dask.
    """
    from distributed import Client, LocalCluster

    # Before the processes start: an algebra library looks once, when it is loaded.
    os.environ.update(dict.fromkeys(ONE_THREAD, '1'))
    # One folder for all, so that nothing is left of processes that are interrupted.
    with (
        TemporaryDirectory(prefix=PREFIX) as within,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host='127.0.0.1',
            dashboard_address=None,
            worker_dashboard_address='127.0.0.1:0',
            # Without a dashboard its port would still be taken.
            scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
            local_directory=within,
            silence_logs='CRITICAL',
        ) as cluster,
        Client(cluster) as client,
    ):
        client.register_worker_callbacks(ignore_interrupt)
        yield from _distributed(client, sweep, seeds, within)


def run_on_cluster(
    sweep: Sweep,
    seeds: Sequence[int],
    address: str,
    note: Callable[[str], None] = lambda sentence: None,
) -> Iterator[Outcome]:
    """On the workers of the dask scheduler at `address`, as they end; `note` hears of troubles
    that may pass.

    Raises `ConfigError` when no scheduler answers there, ModuleNotFoundError without dask.
    """
    with cluster(address, note) as client:
        yield from _distributed(client, sweep, seeds)


def _distributed(
    client: Any, sweep: Sweep, seeds: Sequence[int], within: str | None = None
) -> Iterator[Outcome]:
    calls = [(sweep, seed, within) for seed in seeds]
    for number, outcome, failure in as_they_end(client, run_seed, calls):
        yield outcome or Outcome(seeds[number], failure=failure)


# -- what comes out ------------------------------------------------------------------------------


def summarise(outcomes: Iterable[Outcome]) -> dict[str, dict[str, float]]:
    """Of each metric, over the runs that gave it: how many did (`runs`), mean, std (of one run),
    stderr (of the mean), p05 and p95. With one run std and stderr are NaN."""
    values: dict[str, list[float]] = {}
    for outcome in sorted(outcomes, key=lambda outcome: outcome.seed):
        for name, value in outcome.metrics.items():
            values.setdefault(name, []).append(value)
    return {name: _spread(np.array(numbers, np.float64)) for name, numbers in values.items()}


def _spread(values: np.ndarray) -> dict[str, float]:
    count = len(values)
    std = float(np.std(values, ddof=1)) if count > 1 else math.nan
    low, high = np.percentile(values, [5.0, 95.0])
    return {
        'runs': count,
        'mean': float(np.mean(values)),
        'std': std,
        'stderr': std / math.sqrt(count),
        'p05': float(low),
        'p95': float(high),
    }


def record(sweep: Sweep, outcomes: Iterable[Outcome]) -> dict[str, Any]:
    """The content of sweep.json: what was run, with which versions, and what came out."""
    ordered = sorted(outcomes, key=lambda outcome: outcome.seed)
    versions: dict[str, set[str]] = {}
    for outcome in ordered:
        for name, version in outcome.versions.items():
            versions.setdefault(name, set()).add(version)
    return {
        'system': sweep.system,
        'scenario': sweep.scenario,
        'scene': sweep.scene.as_dict(),
        'parameters': sweep.config.as_dict(),
        'seeds': [outcome.seed for outcome in ordered],
        'failures': {str(run.seed): run.failure for run in ordered if run.failure},
        'versions': {name: ' and '.join(sorted(found)) for name, found in versions.items()},
        'summary': summarise(ordered),
    }


def prepare(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder for a sweep.

    Raises `BagError` when it holds one that may not be replaced.
    """
    if out.exists() and not out.is_dir():
        raise BagError(f'{out} is a file; a folder is needed')
    old = [path for path in (out / CSV, out / JSON) if path.exists()]
    if old and not overwrite:
        raise BagError(
            f'{out} holds a sweep already ({old[0].name}); choose another folder or '
            'say --overwrite'
        )
    for path in old:
        path.unlink()
    out.mkdir(parents=True, exist_ok=True)


def write(out: Path, content: Mapping[str, Any], outcomes: Iterable[Outcome]) -> None:
    """Write sweep.json and sweep.csv: one row per run by seed, empty cells for missing metrics."""
    names = list(content['summary'])
    with whole(out / CSV) as path, path.open('w', encoding='utf-8', newline='') as file:
        table = csv.writer(file, lineterminator='\n')
        table.writerow(['seed', 'failure', *names])
        for run in sorted(outcomes, key=lambda outcome: outcome.seed):
            table.writerow([run.seed, run.failure, *(run.metrics.get(name) for name in names)])
    RunFolder(out).write_json(JSON, content)
