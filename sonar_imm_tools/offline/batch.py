# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Many trackers over many recordings: who does what, what is done already, what came of it.

A job is one tracker over the topics of one instrument in one recording; it writes one run folder.
Jobs know nothing of one another: where they run and in which order they end changes no byte. The
folder around them has ``summary.json``, or one for each shard, by which the runs are found again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import json
import os
from pathlib import Path
from typing import Any

from attrs import evolve, frozen

from sonar_imm import __version__
from sonar_imm.files import remove_leftovers
from sonar_imm.parameters import Config, ConfigError
from sonar_imm.trackers import SYSTEMS

from ..recordings.reader import BagError, BagReader
from . import run_folder as results
from .jobs import as_they_end, cluster, processes, sentence_of
from .run_folder import RunFolder, SUMMARY
from .tracking import InputOptions, OfflineRun, write_run

TRACKED, KEPT, FAILED = 'tracked', 'kept', 'failed'
"""States of a run: made now, made before by the same command, not made."""


@frozen(kw_only=True)
class Job:
    """One run to be made. Plain values, so that it travels to other processes and machines.

    instrument: its name, '' where a recording has only one. overwrite: replace another run.
    resume: keep a run that is the same; take what an interrupted program left for nothing.
    """

    bag: Path
    folder: Path
    instrument: str = ''
    system: str
    config: Config
    options: InputOptions
    overwrite: bool = False
    resume: bool = False
    strict: bool = False
    tables: str = results.AS_CSV
    version: str = __version__

    def outcome(self, **came: Any) -> Outcome:
        """What became of it."""
        return Outcome(bag=self.bag, folder=self.folder, instrument=self.instrument, **came)


@frozen(kw_only=True)
class Outcome:
    """What became of a job: its state, the content of run.json, or why there is none."""

    bag: Path
    folder: Path
    instrument: str = ''
    state: str = FAILED
    run: Mapping[str, Any] | None = None
    failure: str = ''


Advance = Callable[[int], None]


def track(job: Job, advance: Callable[[int], Advance] | None = None) -> Outcome:
    """Do a job. advance: gives what hears of messages, once it is known how many there are.

    Raises `BagError` and `ConfigError`.
    """
    if job.version != __version__:
        raise ConfigError(f'the worker has sonar_imm {__version__}, the command {job.version}')
    folder = RunFolder(job.folder)
    with BagReader(job.bag, strict=job.strict) as reader:
        offline = OfflineRun(reader, SYSTEMS[job.system], job.config, job.options)
        overwrite = job.overwrite
        if job.resume and not overwrite:
            if (run := _same_run(folder, offline)) is not None and _complete(job, run):
                remove_leftovers(job.folder)
                return job.outcome(state=KEPT, run=run)
            overwrite = True  # it is not finished, or the same without these tables
        with folder.fresh(overwrite=overwrite, inputs=[job.bag]) as unfinished:
            advanced = advance(offline.total) if advance else lambda count: None
            run = write_run(unfinished, offline, advanced, tables=job.tables)
        return job.outcome(state=TRACKED, run=run)


def _same_run(folder: RunFolder, offline: OfflineRun) -> dict[str, Any] | None:
    """The run in `folder` when it is what `offline` would make; None when there is none.

    Raises `BagError` when there is another.
    """
    if not (folder.path / results.RUN).is_file():
        return None
    run = folder.read_run()
    # As JSON has it: tuples are lists.
    wanted = json.loads(json.dumps(results.finite(results.run_record(**offline.recipe()))))
    other = [name for name in wanted if run.get(name) != wanted[name]]
    if not other:
        return run
    named = []
    for name in other:
        old, new = run.get(name), wanted[name]
        if isinstance(old, dict) and isinstance(new, dict):
            keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
            name += f' ({", ".join(keys[:3])}{", ..." if len(keys) > 3 else ""})'
        named.append(name)
    raise BagError(
        f'{folder.path} holds another run, which differs in {", ".join(named)}; choose another '
        'folder or say --overwrite'
    )


def _complete(job: Job, run: Mapping[str, Any]) -> bool:
    """Whether the tables are there that are wanted."""
    if job.tables == results.NO_TABLE:
        return RunFolder(job.folder).bins() is None
    names = [results.CSV, *([results.SOUNDINGS] if 'soundings' in run else [])]
    if job.tables == results.AS_PARQUET:
        names = [results.PARQUET[name] for name in names]
    return all((job.folder / name).is_file() for name in names)


def run_job(job: Job) -> Outcome:
    """Do a job; never raises, since a bad recording must not end the others."""
    try:
        return track(job)
    except Exception as error:
        return job.outcome(failure=sentence_of(error))


def run_jobs(
    jobs: Sequence[Job],
    *,
    count: int = 1,
    address: str | None = None,
    note: Callable[[str], None] = lambda sentence: None,
) -> Iterator[Outcome]:
    """Do `jobs` as they end: in this process, in `count` processes, or on the workers of the dask
    scheduler at `address`, which need the same paths; `note` hears of troubles that may pass.

    Raises OSError when a process dies, `ConfigError` when no scheduler answers.
    """
    if address is not None:
        with cluster(address, note) as client:
            for number, outcome, failure in as_they_end(client, run_job, [(job,) for job in jobs]):
                yield _seen(outcome) if outcome else jobs[number].outcome(failure=failure)
    elif min(count, len(jobs)) <= 1:
        yield from map(run_job, jobs)
    else:
        with processes(min(count, len(jobs))) as pool:
            yield from pool.map(run_job, jobs)


def _seen(outcome: Outcome) -> Outcome:
    """A worker on another machine may have written where this one does not see it."""
    if outcome.state == FAILED or (outcome.folder / results.RUN).is_file():
        return outcome
    sentence = (
        f'a worker wrote {outcome.folder}, which is not to be seen here: the folder has to lie '
        'where all machines reach it'
    )
    return evolve(outcome, state=FAILED, run=None, failure=sentence)


def summary_of(out: Path, outcomes: Iterable[Outcome], name: str = SUMMARY) -> dict[str, Any]:
    """The content of summary.json, or of a shard's: of each run where it is and what came of it.
    Earlier runs in it that are in `out` still stay in it."""
    fresh = [_entry(out, outcome) for outcome in outcomes]
    new = {entry['folder'] for entry in fresh}
    earlier = _entries(out / name) if (out / name).is_file() else []
    kept = [entry for entry in earlier if entry['folder'] not in new]
    kept = [entry for entry in kept if (out / entry['folder'] / results.RUN).is_file()]
    return {'runs': kept + fresh}


def _entry(out: Path, outcome: Outcome) -> dict[str, Any]:
    run = outcome.run or {}
    return {
        'folder': outcome.folder.resolve().relative_to(out.resolve()).as_posix(),
        'bag': str(outcome.bag.resolve()),
        'instrument': outcome.instrument,
        'state': outcome.state,
        'failure': outcome.failure,
        'system': run.get('system', ''),
        'messages': run.get('messages', 0),
        'refused': sum(entry['count'] for entry in run.get('refused', {}).values()),
        'estimates': run.get('estimates', 0),
        'rows': run.get('rows', 0),
        'wall_s': run.get('timings', {}).get('wall_s'),
        'warnings': list(run.get('warnings', [])),
        'problems': list(run.get('problems', [])),
    }


def run_folders(out: Path) -> list[Path]:
    """The folders of the finished runs at `out`: itself, or those of its summaries.

    Raises `BagError` when there is no run.
    """
    lists = results.summaries(out)
    if (out / results.RUN).is_file() or not lists:
        return [out]
    named = dict.fromkeys(out / entry['folder'] for path in lists for entry in _entries(path))
    found = [folder for folder in named if (folder / results.RUN).is_file()]
    if not found:
        raise BagError(f'{out} holds no finished run: all that {lists[0].name} names failed')
    return found


def check_summary(out: Path, name: str = SUMMARY) -> None:
    """Raise `BagError` where a file that is no summary has its name in the folder `out`."""
    if os.path.lexists(out / name):
        _entries(out / name)


def _entries(path: Path) -> list[dict[str, Any]]:
    content = results.read_json(path)
    try:
        entries = content['runs']
        if not all(isinstance(entry['folder'], str) for entry in entries):
            raise ValueError('a folder is no text')
        for entry in entries:
            below = Path(entry['folder'])
            if below.is_absolute() or '..' in below.parts:
                raise ValueError(f'{below} is not below its folder')
        return list(entries)
    except (ValueError, TypeError, KeyError) as error:
        raise BagError(f'{path} cannot be understood: {sentence_of(error)}') from None
