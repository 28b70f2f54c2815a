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

"""``sonar-imm chart``."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

import click

from sonar_imm.trackers import SYSTEMS

from .common import example, load_config, params_option, say, timeout_option

if TYPE_CHECKING:
    from ..survey.live import LiveChart

NAME = 'sonar_imm_chart'
MAKING = 0.5
"""Most seconds between two looks at what has been received, but for one tile."""


@click.command(
    epilog=example(
        'sonar-imm chart',
        'sonar-imm chart /port/bathymetry/soundings /starboard/bathymetry/soundings --cell 0.5',
    )
)
@click.argument('topics', metavar='[TOPIC]...', nargs=-1)
@click.option(
    '--cell',
    type=click.FloatRange(min=0.01),
    default=1.0,
    show_default=True,
    metavar='M',
    help='Side of the cells in metres.',
)
@click.option(
    '--period',
    type=click.FloatRange(min=0.1),
    default=2.0,
    show_default=True,
    metavar='SECONDS',
    help='Time between two messages of the chart.',
)
@params_option('Parameter file of the bathymetry node, for its error budget and sound speed.')
@timeout_option(60.0)
def command(
    topics: tuple[str, ...], cell: float, period: float, params: Path | None, timeout: float
) -> None:
    """Make a chart of the soundings of running nodes, while lines are run.

    Without TOPIC every topic that ends in /soundings is heard. Published, latched, in the frame of
    the navigation: /sonar_imm_chart/grid (nav_msgs/OccupancyGrid for RViz: 100 the shoalest, 0 the
    deepest, -1 unknown) and /sonar_imm_chart/nodes (PointCloud2: depths with uncertainty, count,
    lines and what competes). What changed goes to /sonar_imm_chart/ground, for the input `ground`
    of obstacle_node. Nothing is adjusted; `survey` does that afterwards. Ctrl-C ends it.
    """

    from ..replay.link import Link, LinkError
    from ..replay.listening import TableListener
    from ..survey.live import LiveChart

    config, _ = load_config(SYSTEMS['bathymetry'], params, {})
    settings: Any = config
    chart = LiveChart(cell, settings.budget(), settings.sound_speed)
    with Link(NAME) as link, contextlib.suppress(KeyboardInterrupt):
        outputs = Outputs(link)
        listener = TableListener(link, topics, 'soundings')
        frame, newest, due = '', 0, time.monotonic() + period
        changed: set[tuple[int, int]] = set()
        for table in listener.tables(timeout):
            if table is not None:
                if 'vertical_uncertainty' not in (table.columns or {}):
                    raise LinkError(f'{table.topic}: {table.problem or "no table of soundings"}')
                if table.frame_id != (frame or table.frame_id):
                    raise LinkError(
                        f"{table.topic} is in the frame '{table.frame_id}', others are in "
                        f"'{frame}': a chart has one"
                    )
                frame, newest = table.frame_id, max(newest, table.stamp_ns)
                chart.add(table.stamp_ns, table.columns or {})
            begun = time.monotonic()
            if begun < due:
                continue
            for tile in chart.remade():
                changed.add(tile)
                if time.monotonic() - begun > MAKING:
                    break
            else:
                if changed:
                    outputs.publish(chart, sorted(changed), newest, frame)
                due, changed = time.monotonic() + period, set()


class Outputs:
    """The topics of the chart."""

    def __init__(self, link: Any):
        from sonar_imm.nodes.messages import message_class
        from sonar_imm.nodes.qos import latched_qos, output_qos

        self._grid = link.node.create_publisher(
            message_class('nav_msgs/msg/OccupancyGrid'), f'/{NAME}/grid', latched_qos()
        )
        cloud = message_class('sensor_msgs/msg/PointCloud2')
        self._nodes = link.node.create_publisher(cloud, f'/{NAME}/nodes', latched_qos())
        self._ground = link.node.create_publisher(cloud, f'/{NAME}/ground', output_qos())
        self._lines = 0

    def publish(
        self, chart: LiveChart, changed: Sequence[tuple[int, int]], stamp_ns: int, frame_id: str
    ) -> None:
        """Publish all that is known, and of the tiles that changed the floor."""
        from msg_adapters.headers import make_header
        from msg_adapters.soundings import write_ground
        from msg_adapters.table import encode_table
        from sonar_imm.measurements import Ground
        from sonar_imm.nodes.messages import make

        table = chart.table()
        x0, y0, cells = chart.picture()
        rows, columns = cells.shape
        origin = make(
            'geometry_msgs/msg/Pose',
            position=make('geometry_msgs/msg/Point', x=x0 * chart.cell, y=y0 * chart.cell),
        )
        header = make_header(stamp_ns, frame_id, make)
        info = make(
            'nav_msgs/msg/MapMetaData',
            map_load_time=header.stamp,
            resolution=chart.cell,
            width=columns,
            height=rows,
            origin=origin,
        )
        self._grid.publish(
            make('nav_msgs/msg/OccupancyGrid', header=header, info=info, data=cells.ravel())
        )
        self._nodes.publish(encode_table(table, stamp_ns=stamp_ns, frame_id=frame_id, make=make))
        position, variance = chart.floor(changed)
        ground = Ground(stamp_ns=stamp_ns, position=position, variance=variance, frame_id=frame_id)
        self._ground.publish(write_ground(ground, make))
        if chart.lines != self._lines:
            self._lines = chart.lines
            say(f'line {chart.lines}: {len(table["x"])} nodes')
