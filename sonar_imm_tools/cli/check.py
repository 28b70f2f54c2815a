# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm check``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
import functools
from pathlib import Path
import tempfile
from typing import Any, TYPE_CHECKING

import click

from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import print_json, say, warn

if TYPE_CHECKING:
    from .checking import CheckedRecording, PlayedRecording


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm check diver', 'sonar-imm check diver --bag dive.bag --limit 3'))
@opt.systems
@click.option('--bag', type=opt.PATH, help='Play this recording instead of the shipped ones.')
@opt.params(help='Parameter file for the node and the offline run.')
@click.option('--limit', type=opt.NOT_NEGATIVE, metavar='ERROR',
    help='Largest error allowed, of the kind and in the unit that the check prints, e.g. position '
    'RMSE in metres for the diver. By default that of the recording (check.yaml in its folder), '
    'or else of the system.')
@click.option('--out', type=opt.FOLDER,
    help='Keep both runs in this folder.')
@opt.json
def command(
    systems: tuple[str, ...], bag: Path | None, params: Path | None, limit: float | None,
    out: Path | None, as_json: bool,
) -> None:
    """Start the real nodes, play recordings to them in lock-step and check their estimates.

    The estimates have to equal those of `track`, byte for byte, and to lie near the truth. Without
    SYSTEMS all are checked. Exit code 1 when a check fails.
    """
    if bag is not None and len(systems or SYSTEMS) > 1:
        raise click.UsageError('--bag needs exactly one system')
    with tempfile.TemporaryDirectory(prefix='sonar_imm_check_') as scratch:
        asked: dict[str, Any] = {'bag': bag, 'params': params, 'limit': limit, 'quiet': as_json}
        recordings = run_checks(systems or tuple(SYSTEMS), out or Path(scratch), **asked)
    if as_json:
        print_json([recording.as_dict() for recording in recordings])
    else:
        for recording in recordings:
            print_checks(recording)
    if not all(recording.good for recording in recordings):
        raise click.exceptions.Exit(1)
# fmt: on


def run_checks(
    systems: tuple[str, ...],
    folder: Path,
    *,
    bag: Path | None = None,
    params: Path | None = None,
    limit: float | None = None,
    quiet: bool = False,
    jobs: int = 1,
    live_all: bool = True,
) -> list[CheckedRecording]:
    """Check `bag`, or all shipped recordings, for each system; runs are kept below `folder`.

    jobs: processes that share the recordings, the smallest of each system first; they print
    nothing but which recording is done. live_all: play all to the node, not only the smallest of
    each system. The list is in the order of systems and recordings.
    """
    from .checking import instruments_in, play_recording, shipped_bags

    todo = [
        (path, system, name, topics)
        for system in systems
        for path in ([bag] if bag else shipped_bags(system, folder))
        for name, topics in instruments_in(path, system).items()
    ]
    order, first = _small_ones_first([item[:2] for item in todo])
    plays = [
        functools.partial(
            play_recording,
            path,
            system,
            folder / path.stem / name,
            params=params,
            limit=limit,
            topics=topics,
            quiet=quiet or jobs > 1,
            live=live_all or number in order[:first],
        )
        for number, (path, system, name, topics) in enumerate(todo)
    ]
    if jobs == 1:
        return [play().judged() for play in plays]
    return _shared_out(plays, order, jobs)


def _small_ones_first(todo: list[tuple[Path, str]]) -> tuple[list[int], int]:
    """In which order to check recordings, and how many of them come first: the smallest of each
    system do, then the others, of which the largest come first."""
    size = [sum(file.stat().st_size for file in path.rglob('*')) for path, _ in todo]
    first = {
        system: min((i for i, item in enumerate(todo) if item[1] == system), key=size.__getitem__)
        for _, system in todo
    }
    others = [i for i in range(len(todo)) if i not in first.values()]
    return [*first.values(), *sorted(others, key=lambda i: -size[i])], len(first)


def _shared_out(
    plays: Sequence[Callable[[], PlayedRecording]], order: Sequence[int], jobs: int
) -> list[CheckedRecording]:
    """Play in so many processes that take the recordings in this order, judge here meanwhile."""
    from ..offline.jobs import processes

    done: dict[int, CheckedRecording] = {}
    with processes(jobs) as pool:
        running = {pool.submit(plays[i]): i for i in order}
        for future in as_completed(running):
            recording = done[running[future]] = future.result().judged()
            state = 'ok' if recording.good else 'FAILED'
            warn(f'{len(done)} of {len(plays)}: {recording.bag.name} {state}')
    return [done[i] for i in sorted(done)]


def print_checks(recording: CheckedRecording) -> None:
    """Print the checks of one recording."""
    say(f'{recording.system}: {recording.bag.name}')
    for check in recording.checks:
        state = 'ok  ' if check.good else 'FAIL'
        say(f'  {state}  {check.name}: {check.result} (wanted: {check.wanted})')
    if latency := recording.latency_ms:
        delays = f'p50 {latency["p50"]:.1f} ms, p99 {latency["p99"]:.1f} ms'
        say(f'        latency of an estimate: {delays}')
