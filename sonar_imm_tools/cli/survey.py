# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm survey``."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from pathlib import Path

import click

from ..evaluation.numbers import counted
from . import options as opt
from .common import print_json, progress, say, warn


def _resolution(_ctx: click.Context, _param: click.Parameter, value: str) -> float:
    if value == 'auto':
        return 0.0
    try:
        cell = float(value)
    except ValueError:
        cell = 0.0
    if not 0.0 < cell < 1e5:
        raise click.BadParameter(f"'{value}' is neither auto nor a number of metres")
    return cell


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm survey runs chart --adjust --crs 32632 --origin 500000,6000000',
        'sonar-imm survey runs chart --adjust --jobs 8 --resume',
        'sonar-imm survey runs chart --resolution 0.5 --scheduler tcp://10.0.0.5:8786'))
@click.argument('runs', type=opt.PATH)
@click.argument('out', type=opt.PATH)
@click.option('--resolution', default='auto', show_default=True, callback=_resolution,
    metavar='auto|M', help='Side of the cells in metres; auto: a twentieth of the depth, by tile.')
@click.option('--adjust', 'adjusted', is_flag=True, help='Adjust the lines where they cross.')
@click.option('--fix', 'fixed', metavar='LINE', multiple=True, help='A line whose tide is known.')
@opt.crs
@opt.origin
@opt.jobs(help='Processes.')
@click.option('--scheduler', metavar='ADDRESS',
    help='Do the jobs on the cluster of this dask scheduler instead; its workers need the same '
    'sonar_imm, and reach RUNS and OUT by the same paths.')
@click.option('--resume', is_flag=True, help='Keep in OUT what is the same as before.')
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@opt.json
def command(
    runs: Path, out: Path, resolution: float, adjusted: bool, fixed: tuple[str, ...],
    epsg: int | None, origin: tuple[float, float, float], jobs: int, scheduler: str | None,
    resume: bool, overwrite: bool, as_json: bool,
) -> None:
    """Make one chart of all lines below RUNS, in the folder OUT.

    A line is a folder with soundings.parquet or soundings.csv, as `track` writes it. OUT gets
    survey.tif, tiles, provenance.parquet, coverage.geojson, adjustment.json, crossings.csv,
    report.html and survey.json; what is needed to resume lies in OUT/.work. The files do not
    depend on the number of processes. A line that cannot be read is named, the rest is made.
    """
    if scheduler is not None and jobs > 1:
        raise click.UsageError('--jobs and --scheduler exclude each other')
    if resume and overwrite:
        raise click.UsageError('--resume and --overwrite exclude each other')
    from ..offline.jobs import workers
    from ..offline.run_folder import require_parquet
    from ..recordings.export.points import wkt_of
    from ..survey.jobs import Options
    from ..survey.making import epsg_of, frame_of, make, Progress, sources_of
    from ..survey.products import folder_of, write

    require_parquet()
    sources = sources_of(runs)
    number = epsg_of(sources, epsg or 0)
    if number:
        wkt_of(number)
    options = Options(
        resolution=resolution,
        adjusted=adjusted,
        fixed=fixed,
        epsg=number,
        origin=origin,
        frame=frame_of(sources),
    )
    with folder_of(out, options, runs, resume=resume, overwrite=overwrite) as place:
        with contextlib.ExitStack() as stack, workers(jobs, scheduler, warn) as run:

            def begin(what: str, total: int) -> Callable[[int], None]:
                stack.close()
                return stack.enter_context(progress(what, total, quiet=as_json))

            hooks = Progress(begin=begin, say=lambda text: say(text, quiet=as_json), warn=warn)
            survey = make(sources, place, options, run, hooks)
        content = write(survey, place)
    failed = [line for line in content['lines'] if line['failure']]
    if as_json:
        print_json(content)
    else:
        lines = len(content['lines']) - len(failed)
        left = f', {counted(len(failed), "line")} left out' if failed else ''
        say(f'{out}: {counted(lines, "line")} in {counted(len(content["tiles"]), "tile")}{left}')
# fmt: on
