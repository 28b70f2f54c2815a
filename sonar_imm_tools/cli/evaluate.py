# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm evaluate``."""

from __future__ import annotations

from pathlib import Path

import click

from ..evaluation.judging import judge, Judgement, JudgeOptions, TRUTH_GAP
from . import options as opt
from .common import print_json, say


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm evaluate out',
        'sonar-imm evaluate out --truth gps.bag --report gps.html',
        'sonar-imm evaluate line1 line9 --crossing'))
@click.argument('out_dir', type=opt.PATH)
@click.argument('other', metavar='[OTHER]', required=False, type=opt.PATH)
@click.option('--truth', 'truth_bag', type=opt.PATH,
    help='Bag with /truth/estimate; by default the tracked bag itself.')
@click.option('--truth-lag', type=float, default=0.0, show_default=True, metavar='SECONDS',
    help='Compare an estimate with truth this much later.')
@click.option('--truth-gap', type=opt.NOT_NEGATIVE, default=TRUTH_GAP, show_default=True,
    metavar='SECONDS', help='Truth is not interpolated across longer gaps.')
@click.option('--cutoff', type=opt.POSITIVE, metavar='METRES',
    help='An estimate further away from all targets is on none of them; the default depends on '
    'the system: for divers six times the median distance of the raw fixes (of the tracks where '
    'there are none) from the truth, and at least 10.')
@click.option('--report', type=opt.FILE,
    help='Where to write the report; by default OUT_DIR/report.html.')
@click.option('--crossing', is_flag=True,
    help='Compare the horizons of two fathometer runs, OUT_DIR and OTHER, where they cross.')
@click.option('--position-std', type=opt.NOT_NEGATIVE, default=3.0, show_default=True,
    metavar='METRES',
    help='crossing: error of a position, which counts by the slope of a horizon.')
@click.option('--no-report', is_flag=True, help='Only write metrics.json.')
@opt.json
def command(
    out_dir: Path, other: Path | None, truth_bag: Path | None, truth_lag: float, truth_gap: float,
    cutoff: float | None, report: Path | None, crossing: bool, position_std: float,
    no_report: bool, as_json: bool,
) -> None:
    """Score the run, or all runs, that `sonar-imm track` left in OUT_DIR.

    Writes metrics.json beside each run and an HTML report, which is one file for one run; for
    several it is a page with a row for each, and their pages lie in a folder beside it, named
    after it: report_runs. Without truth only what needs none is scored: the normalised innovations
    (NIS) and the model probabilities. With --crossing the depths of two lines are compared where
    they cross; only the figure of that is written, where --report names a file.
    """
    from ..offline.batch import run_folders
    from ..offline.run_folder import REPORT, RunFolder

    if crossing != (other is not None):
        raise click.UsageError('--crossing compares two runs: OUT_DIR and OTHER')
    if other is not None:
        _compare_crossing(out_dir, other, position_std, report, as_json)
        return
    folders = run_folders(out_dir)
    for folder in folders:
        if report is not None:
            RunFolder(folder).keep_from(report, but=REPORT)
    options = JudgeOptions(truth_bag=truth_bag, lag=truth_lag, gap=truth_gap, cutoff=cutoff)
    names = {folder: folder.relative_to(out_dir).as_posix() for folder in folders}
    judgements = {folder: evaluate_run(folder, options) for folder in folders}
    page = None if no_report else report or out_dir / 'report.html'
    if page is not None:
        from ..evaluation.report import write_report

        write_report(page, [judgement.part([]) for judgement in judgements.values()])
    if as_json:
        metrics = {names[folder]: run.metrics for folder, run in judgements.items()}
        print_json(metrics.get('.', metrics))
        return
    for folder, judgement in judgements.items():
        say(f'{"" if folder == out_dir else f"{names[folder]}: "}{judgement.summary}')
        for title, value in judgement.lines:
            say(f'  {title:<34} {value}')
    if page is not None:
        say(f'report: {page}')
# fmt: on


def _compare_crossing(
    a: Path, b: Path, position_std: float, report: Path | None, as_json: bool
) -> None:
    import plotly.graph_objects as go

    from ..evaluation.fathometer.crossing import crossing_lines, crossing_metrics, mistie_figure
    from ..evaluation.plotting import plain_content
    from ..offline.run_folder import RunFolder

    for folder in (a, b):
        if report is not None:
            RunFolder(folder).keep_from(report)
    metrics = crossing_metrics(RunFolder(a), RunFolder(b), position_std)
    if report is not None:
        from ..evaluation.report import write_page

        figure = go.Figure(plain_content(mistie_figure(metrics)))
        head = '<head><meta name="generator" content="sonar_imm">'
        text = figure.to_html(include_plotlyjs=True).replace('<head>', head, 1)
        write_page(report, f'<!DOCTYPE html>\n{text}')
    if as_json:
        print_json(metrics)
        return
    for line in crossing_lines(metrics):
        say(line)


def evaluate_run(out_dir: Path, options: JudgeOptions | None = None) -> Judgement:
    """Judge a run and write the metrics to its folder.

    Raises `BagError` when the folder or the truth cannot be read.
    """
    from ..offline.run_folder import METRICS, RunFolder

    folder = RunFolder(out_dir)
    judgement = judge(folder, options)
    folder.write_json(METRICS, judgement.metrics)
    return judgement
