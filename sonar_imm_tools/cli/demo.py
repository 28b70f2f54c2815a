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

"""``sonar-imm demo``: what ``make demo`` runs."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sonar_imm.trackers import SYSTEMS

from .check import print_checks, run_checks
from .common import example, say

if TYPE_CHECKING:
    from .checking import CheckedRecording

OWN_CHECKS = 3
"""Checks of a recording before its accuracy: answers, equal bytes, a clean end."""


@click.command(epilog=example('sonar-imm demo --out demo'))
@click.option(
    '--out',
    type=click.Path(path_type=Path, file_okay=False),
    default=Path('demo'),
    show_default=True,
    help='Folder for the runs and the report.',
)
def command(out: Path) -> None:
    """Play the shipped recordings to the real nodes, track them offline too, write one report."""
    say(
        'The live nodes and the offline trackers on the shipped recordings, the smallest of each '
        'system first.'
    )
    recordings = run_checks(tuple(SYSTEMS), out, jobs=min(os.cpu_count() or 1, len(SYSTEMS)))
    for recording in recordings:
        if not recording.good:
            print_checks(recording)
    for system in SYSTEMS:
        say(_summary(system, [item for item in recordings if item.system == system]))
    from ..evaluation.report import write_report

    report = out / 'report.html'
    write_report(report, [recording.judgement.part(recording.checks) for recording in recordings])
    say(f'report: {report.resolve()}')
    if not all(recording.good for recording in recordings):
        raise click.exceptions.Exit(1)


def _summary(system: str, recordings: Sequence[CheckedRecording]) -> str:
    """One line: how many recordings passed, and the accuracy of each that has a truth."""
    checks = sum(len(recording.checks) for recording in recordings)
    passed = sum(check.good for recording in recordings for check in recording.checks)
    scores: dict[str, list[str]] = {}
    for recording in recordings:
        for check in recording.checks[OWN_CHECKS:]:
            scores.setdefault(check.name, []).append(check.result)
    accuracy = '; '.join(f'{name} {", ".join(results)}' for name, results in scores.items())
    return f'{system}: {passed} of {checks} checks ok on {len(recordings)} recordings; {accuracy}'
