# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm view``."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
import sys
import tempfile

import click

from . import options as opt
from .common import say


# fmt: off
@click.command(cls=opt.Renewed,
    epilog=opt.example('sonar-imm view out', 'sonar-imm view dive.bag',
        'sonar-imm view out --rerun out.rrd'))
@click.argument('source', metavar='RESULTS|BAG', type=opt.PATH)
@click.option('--browser', is_flag=True, hidden=True, expose_value=False)  # the only way now
@click.option('--rerun', 'rerun_file', metavar='FILE.rrd',
    type=opt.FILE,
    help='Write the estimates of RESULTS for the Rerun viewer instead.')
def command(source: Path, rerun_file: Path | None) -> None:
    """Open the HTML report of RESULTS, a folder of `sonar-imm track`, in the browser.

    A report that is missing is written first. A BAG is tracked and scored first, into a temporary
    folder. Without a browser the command only says where the report is.
    """
    if rerun_file is not None:
        from ..evaluation.rerun_file import write_rerun
        from ..offline.run_folder import RunFolder

        RunFolder(source).keep_from(rerun_file)
        count = write_rerun(source, rerun_file)
        say(f'{count} estimates written to {rerun_file}; show them with: rerun {rerun_file}')
        return
    import webbrowser

    report = _report_of(source).resolve()
    say(f'report: {report}')
    # Without a screen a browser of the terminal would start, which cannot draw the report.
    screens = ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER')
    if not sys.platform.startswith('linux') or any(os.environ.get(name) for name in screens):
        with contextlib.suppress(webbrowser.Error):
            webbrowser.open(report.as_uri())
# fmt: on


def _report_of(source: Path) -> Path:
    """The report of a results folder or of a bag; written when it is missing."""
    from ..offline.batch import run_folders
    from ..offline.run_folder import REPORT, RUN, summaries
    from .evaluate import evaluate_run
    from .track import Plan, track_one

    if (source / RUN).is_file() or summaries(source):
        results, folders = source, run_folders(source)
    else:
        results = Path(tempfile.mkdtemp(prefix='sonar_imm_')) / 'run'
        jobs = Plan().jobs(source, results)
        say(f'tracking {source} into {results}')
        for job in jobs:
            track_one(job)
        folders = [job.folder for job in jobs]
    report = results / REPORT
    if not report.is_file():
        from ..evaluation.report import write_report

        write_report(report, [evaluate_run(folder).part([]) for folder in folders])
    return report
