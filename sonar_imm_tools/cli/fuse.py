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

import contextlib
from pathlib import Path
import time
from typing import Any

import click

from .common import example, json_option, print_json, say, timeout_option

NAME = 'sonar_imm_fuse'


@click.command(
    epilog=example(
        'sonar-imm fuse port starboard both',
        'sonar-imm evaluate both',
        'sonar-imm fuse --live /port/diver/estimate /starboard/diver/estimate',
    )
)
@click.argument('first', metavar='RUN_A', type=click.Path(path_type=Path))
@click.argument('second', metavar='RUN_B', type=click.Path(path_type=Path))
@click.argument('out', type=click.Path(path_type=Path), required=False)
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
@click.option('--live', is_flag=True, help='RUN_A and RUN_B are topics of running nodes.')
@click.option(
    '--wait',
    type=click.FloatRange(0.0, 60.0),
    default=1.0,
    show_default=True,
    help='With --live: seconds that an estimate waits for the other node to come as far.',
)
@timeout_option(60.0, when='With --live')
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@json_option
def command(
    first: Path,
    second: Path,
    out: Path | None,
    max_age: float,
    noise: float,
    live: bool,
    wait: float,
    timeout: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fuse the diver tracks of two runs into one run in the folder OUT, or of two nodes, live.

    RUN_A and RUN_B are folders of `track`: of two nodes that watched the same divers, in the same
    frame. Confirmed tracks that keep the same place are one diver, and their estimates are joined
    by covariance intersection, which is consistent however the errors of the two are correlated.
    Others stay as they are. The truth is that of RUN_A's recording.

    With --live RUN_A and RUN_B are topics (/diver/estimate), there is no OUT, and what comes is
    published as /sonar_imm_fuse/estimate. Ctrl-C ends it.
    """
    from ..offline.fusing import write_fused
    from ..offline.run_folder import RunFolder

    if live == (out is not None):
        raise click.UsageError('OUT is for two runs' if live else 'name OUT, or --live')
    if live:
        if first == second:
            raise click.UsageError('RUN_A and RUN_B are the same topic')
        _fuse_live((str(first), str(second)), (noise, max_age, wait), timeout)
        return
    assert out is not None
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


def _fuse_live(
    topics: tuple[str, str], settings: tuple[float, float, float], timeout: float
) -> None:
    """Publish what two nodes say as what one would."""
    from msg_adapters.estimates import write_estimate
    from sonar_imm.nodes.messages import make, message_class
    from sonar_imm.nodes.qos import output_qos

    from ..offline.fusing import LiveFusion
    from ..replay.link import Link
    from ..replay.listening import TableListener

    fusion = LiveFusion(*settings)
    sides = {f'/{topic.lstrip("/")}': side for side, topic in enumerate(topics)}
    known: set[tuple[int, int]] = set()
    with Link(NAME) as link, contextlib.suppress(KeyboardInterrupt):
        cloud = message_class('sensor_msgs/msg/PointCloud2')
        output: Any = link.node.create_publisher(cloud, f'/{NAME}/estimate', output_qos())
        reported = 0
        for table in TableListener(link, topics).tables(timeout):
            if table is not None:
                fusion.take(sides[table.topic], _estimate(table), time.monotonic())
            for estimate in fusion.ready(time.monotonic()):
                output.publish(write_estimate(estimate, make))
            for pair in sorted(fusion.pairs - known):
                say(f'track {pair[0]} of {topics[0]} and {pair[1]} of {topics[1]} are one diver')
            known = set(fusion.pairs)
            if fusion.late > 2 * reported:
                reported = fusion.late
                say(f'{reported} estimates came too late and are left out: try a longer --wait')


def _estimate(table: Any) -> Any:
    """The divers of a table that was heard."""
    from sonar_imm.estimates import Estimate

    from ..replay.link import LinkError

    columns = table.columns or {}
    if not {'px', 'py', 'vx', 'vy', 'track_id', 'track_state'} <= columns.keys():
        raise LinkError(f'{table.topic}: {table.problem or "no estimates of divers"}')
    return Estimate.from_columns(columns, stamp_ns=table.stamp_ns, frame_id=table.frame_id)
