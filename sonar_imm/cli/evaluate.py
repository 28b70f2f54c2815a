"""``sonar-imm evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .common import BAG, example, json_option, print_json, say

TRUTH_GAP, CUTOFF = 60.0, 10.0


@click.command(epilog=example('sonar-imm evaluate out',
                              'sonar-imm evaluate out --truth gps.bag --report gps.html'))
@click.argument('out_dir', type=click.Path(path_type=Path))
@click.option('--truth', 'truth_bag', type=BAG,
              help='Bag with /truth/estimate; by default the tracked bag itself.')
@click.option('--truth-lag', type=float, default=0.0, show_default=True, metavar='SECONDS',
              help='Compare an estimate with truth this much later.')
@click.option('--truth-gap', type=click.FloatRange(min=0.0), default=TRUTH_GAP, show_default=True,
              metavar='SECONDS', help='Truth is not interpolated across longer gaps.')
@click.option('--cutoff', type=click.FloatRange(min=0.0, min_open=True), default=CUTOFF,
              show_default=True, metavar='METRES',
              help='With several targets, an estimate further away is on none.')
@click.option('--report', type=click.Path(path_type=Path, dir_okay=False),
              help='Where to write the report; by default OUT_DIR/report.html.')
@click.option('--no-report', is_flag=True, help='Only write metrics.json.')
@json_option
def command(out_dir: Path, truth_bag: Path | None, truth_lag: float, truth_gap: float,
            cutoff: float, report: Path | None, no_report: bool, as_json: bool) -> None:
    """Score the run that `sonar-imm track` left in OUT_DIR.

    Writes metrics.json and one self-contained HTML report. Without truth only what needs none is
    judged: the surprise of the measurements (NIS) and the models.
    """
    metrics, page = evaluate_run(
        out_dir, truth_bag=truth_bag, truth_lag=truth_lag, truth_gap=truth_gap, cutoff=cutoff,
        report=None if no_report else report or out_dir / 'report.html')
    print_json(metrics) if as_json else _print(metrics, page)


def evaluate_run(out_dir: Path, *, truth_bag: Path | None = None, truth_lag: float = 0.0,
                 truth_gap: float = TRUTH_GAP, cutoff: float = CUTOFF, report: Path | None = None
                 ) -> tuple[dict[str, Any], Path | None]:
    """Metrics of a run, written to its folder, and the report if one is wanted.

    Raises `BagError` when the folder or the truth cannot be read.
    """
    from ..evaluation.run_folder import METRICS, RunFolder
    from ..evaluation.scoring import score
    folder = RunFolder(out_dir)
    run = folder.read_run()
    series = folder.read_series()
    truth, fixes = read_references(run, truth_bag, truth_lag, truth_gap)
    metrics = score(series, truth, fixes=fixes, cutoff=cutoff)
    metrics['truth_lag_s'] = truth_lag
    folder.write_json(METRICS, metrics)
    if report is not None:
        from ..evaluation.report import ReportInput, write_report
        write_report(report, ReportInput(run=run, metrics=metrics, series=series, truth=truth,
                                         fixes=fixes))
    return metrics, report


def read_references(run: dict[str, Any], truth_bag: Path | None, truth_lag: float,
                    truth_gap: float) -> tuple[Any, Any]:
    """Truth and raw fixes to compare a run with, None where there are none.

    The recording itself may be gone; then there are no fixes, and truth only by `truth_bag`.
    Raises `BagError` when `truth_bag` holds no truth.
    """
    from ..evaluation.run_folder import read_fixes, read_truth, TRUTH_TOPIC
    from ..evaluation.scoring import fix_series
    from ..evaluation.truth import Truth
    from ..recordings.reader import BagError
    bag = Path(run['bag'])
    series = read_truth(truth_bag or bag) if truth_bag or bag.exists() else None
    if series is None and truth_bag is not None:
        raise BagError(f'{truth_bag} has no topic {TRUTH_TOPIC}')
    truth = None if series is None else Truth.from_series(series, max_gap=truth_gap)
    fixes = read_fixes(run) if bag.exists() else []
    return truth and truth.shifted(truth_lag), fix_series(fixes) if fixes else None


def _print(metrics: dict[str, Any], page: Path | None) -> None:
    from ..evaluation.report import summary_sentence
    say(summary_sentence(metrics))
    for name, value in _lines(metrics):
        say(f'  {name:<34} {value}')
    if page is not None:
        say(f'report: {page}')


def _lines(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """The numbers a person wants to see first."""
    lines = []
    for key, title, unit in (('position', 'position error', 'm'), ('raw_fix', 'raw fixes', 'm'),
                             ('velocity', 'velocity error', 'mps')):
        values = metrics.get(key, {})
        if values.get('n'):
            lines.append((f'{title}, RMSE / median / 95 %',
                          ' / '.join(f'{values[f"{name}_{unit}"]:.3f}'
                                     for name in ('rmse', 'median', 'p95'))
                          + (' m' if unit == 'm' else ' m/s')))
    for key, title in (('nees_position', 'NEES, position'), ('nees_state', 'NEES, whole state'),
                       ('nis', 'NIS')):
        values = metrics['consistency'].get(key, {})
        if values.get('n'):
            lines.append((title, f'{values["mean"]:.2f}, believable {values["low"]:.2f} to '
                                 f'{values["high"]:.2f}'))
    coverage = metrics['consistency'].get('coverage', {})
    if metrics.get('position', {}).get('n'):
        lines.append(('truth inside 50 / 90 / 95 % ellipse',
                      ' / '.join(f'{100 * share:.0f} %' for share in coverage.values())))
    if metrics.get('lag'):
        lines.append(('best lag of the estimates', f'{metrics["lag"]["best_s"]:.2f} s, then RMSE '
                      f'{metrics["lag"]["rmse_at_best_m"]:.3f} m'))
    for name, value in metrics.get('tracks', {}).items():
        lines.append((name.replace('_', ' '), f'{value:.3g}'))
    return lines
