"""``sonar-imm demo``: what ``make demo`` runs."""

from __future__ import annotations

from pathlib import Path

import click

from ..trackers import SYSTEMS
from .check import print_outcome, run_checks
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
    outcomes = run_checks(tuple(SYSTEMS), out)
    for outcome in outcomes:
        print_outcome(outcome)
    from ..evaluation.report import write_report

    report = out / 'report.html'
    write_report(report, [outcome.judgement.part(outcome.checks) for outcome in outcomes])
    say(f'report: {report.resolve()}')
    if not all(outcome.good for outcome in outcomes):
        raise click.exceptions.Exit(1)
