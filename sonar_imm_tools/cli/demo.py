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

from pathlib import Path

import click

from sonar_imm.trackers import SYSTEMS

from .check import print_checks, run_checks
from .common import example, say


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
    recordings = run_checks(tuple(SYSTEMS), out)
    for recording in recordings:
        print_checks(recording)
    from ..evaluation.report import write_report

    report = out / 'report.html'
    write_report(report, [recording.judgement.part(recording.checks) for recording in recordings])
    say(f'report: {report.resolve()}')
    if not all(recording.good for recording in recordings):
        raise click.exceptions.Exit(1)
