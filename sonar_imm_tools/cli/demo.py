# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm demo``: what ``make demo`` runs."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonar_imm.trackers import SYSTEMS

from ..evaluation.numbers import counted
from . import options as opt
from .check import print_checks, run_checks
from .common import say

if TYPE_CHECKING:
    from .checking import CheckedRecording


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm demo --out demo', 'sonar-imm demo --system diver --all'))
@click.option('--out', type=opt.FOLDER, default=Path('demo'),
    show_default=True, help='Folder for the runs and the report.')
@click.option('--system', 'systems', multiple=True, type=click.Choice(list(SYSTEMS)),
    help='Show this system alone; may be repeated. All by default.')
@click.option('--all', 'live_all', is_flag=True,
    help='Play every recording to the node. By default only the smallest of each system, which '
    'comes first; the others are tracked offline.')
def command(out: Path, systems: tuple[str, ...], live_all: bool) -> None:
    """Play shipped recordings to the real nodes, track all of them offline, write one report.

    A line for each system says what it saw and how well, the last one where the report is. Exit
    code 1 when a node did not do what the offline tracker did, or an error is above its limit.
    """
    chosen = tuple(dict.fromkeys(systems)) or tuple(SYSTEMS)
    recordings = run_checks(chosen, out, jobs=min(os.cpu_count() or 1, 8), live_all=live_all)
    from ..evaluation.report import write_report

    report = out / 'report.html'
    write_report(report, [recording.judgement.part(recording.checks) for recording in recordings])
    for recording in recordings:
        if not recording.good:
            print_checks(recording)
    for system in chosen:
        say(_line(system, [item for item in recordings if item.system == system]))
    say(f'report: {report.resolve()}')
    if not all(recording.good for recording in recordings):
        raise click.exceptions.Exit(1)
# fmt: on


def _line(system: str, recordings: Sequence[CheckedRecording]) -> str:
    """What was seen in a recording that the node played, how well, and what the checks say."""
    live = [item for item in recordings if item.latency_ms]
    if failed := [item.bag.name for item in recordings if not item.good]:
        state = f'FAILED: {", ".join(failed)}'
    else:
        state = (
            f'node and offline equal on {counted(len(live), "recording")}, '
            f'errors within limits on {len(recordings)}'
        )
    return f'{system} ({live[0].bag.name}): {live[0].judgement.headline}; {state}'
