"""``sonar-imm demo``: what ``make demo`` runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..trackers import SYSTEMS
from .check import print_outcome, run_checks
from .common import example, say

if TYPE_CHECKING:
    from ..evaluation.report import ReportInput
    from .checking import Outcome


@click.command(epilog=example('sonar-imm demo --out demo'))
@click.option('--out', type=click.Path(path_type=Path, file_okay=False), default=Path('demo'),
              show_default=True, help='Folder for the runs and the report.')
def command(out: Path) -> None:
    """Play the shipped recordings to the real nodes, track them offline too, write one report."""
    outcomes = run_checks(tuple(SYSTEMS), out)
    for outcome in outcomes:
        print_outcome(outcome)
    from ..evaluation.report import write_report
    report = out / 'report.html'
    write_report(report, *(_material(outcome) for outcome in outcomes))
    say(f'report: {report.resolve()}')
    if not all(outcome.good for outcome in outcomes):
        raise click.exceptions.Exit(1)


def _material(outcome: Outcome) -> ReportInput:
    from ..evaluation.report import ReportInput
    from ..evaluation.run_folder import RunFolder
    from ..evaluation.scoring import score
    from .evaluate import CUTOFF, read_references, TRUTH_GAP
    folder = RunFolder(outcome.folder / 'offline')
    run, series = folder.read_run(), folder.read_series()
    truth, fixes = read_references(run, None, 0.0, TRUTH_GAP)
    return ReportInput(run=run, metrics=score(series, truth, fixes=fixes, cutoff=CUTOFF),
                       series=series, truth=truth, fixes=fixes,
                       checks=tuple(outcome.as_dict()['checks']))
