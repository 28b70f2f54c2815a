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

"""``sonar-imm fuse``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import example, json_option, print_json, say


@click.command(
    epilog=example(
        'sonar-imm fuse port starboard both',
        'sonar-imm evaluate both',
    )
)
@click.argument('first', metavar='RUN_A', type=click.Path(path_type=Path))
@click.argument('second', metavar='RUN_B', type=click.Path(path_type=Path))
@click.argument('out', type=click.Path(path_type=Path))
@click.option(
    '--max-age',
    type=click.FloatRange(0.0, 600.0),
    default=5.0,
    show_default=True,
    help='Seconds for which an estimate of one run is carried on to a stamp of the other.',
)
@click.option(
    '--noise',
    type=click.FloatRange(0.0, 100.0),
    default=0.6,
    show_default=True,
    help='How fast velocities change while an estimate is carried on, m/s^1.5.',
)
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@json_option
def command(
    first: Path,
    second: Path,
    out: Path,
    max_age: float,
    noise: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fuse the diver tracks of two runs into one run in the folder OUT.

    RUN_A and RUN_B are folders of `track`: of two nodes that watched the same divers, in the same
    frame. Confirmed tracks that keep the same place are one diver, and their estimates are joined
    by covariance intersection, which is consistent however the errors of the two are correlated.
    Others stay as they are. The truth is that of RUN_A's recording.
    """
    from ..offline.fusing import write_fused
    from ..offline.run_folder import RunFolder

    if first.resolve() == second.resolve():
        raise click.UsageError('RUN_A and RUN_B are the same folder')
    if out.resolve() in (first.resolve(), second.resolve()):
        raise click.UsageError('OUT is one of the runs')
    with RunFolder(out).fresh(overwrite=overwrite) as folder:
        run = write_fused(
            (RunFolder(first), RunFolder(second)), folder, max_age=max_age, noise=noise
        )
    made = run['fused']
    if as_json:
        print_json({'out': str(out), 'estimates': run['estimates'], **made})
        return
    share = made['fused_rows'] / max(1, made['rows'])
    say(
        f'{out}: {run["estimates"]} estimates; {len(made["pairs"])} pairs of tracks, '
        f'{share:.0%} of the rows fused'
    )
