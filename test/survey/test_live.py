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

"""A chart that grows ping by ping: the same as one made at once, and only what changed is made."""

import numpy as np
import pytest

from msg_adapters.soundings import read_ground, write_ground
from sonar_imm.measurements import Ground
from sonar_imm.trackers.obstacle.ground import GroundMap
from sonar_imm_tools.recordings.export.points import Points
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.survey import budget, scenario, simulate
from sonar_imm_tools.survey.grid import grid_of_looks, Soundings
from sonar_imm_tools.survey.line import joined_lines, line_of
from sonar_imm_tools.survey.live import COLUMNS, LiveChart

BUDGET = budget()


@pytest.fixture(scope='module')
def scene():
    small = {'lines': 2, 'cross_lines': 1, 'length': 60.0, 'spacing': 30.0, 'ghost': False}
    return simulate(scenario('survey', small), 1)


def pings(points):
    for stamp in np.unique(points.stamp_ns).tolist():
        rows = points.stamp_ns == stamp
        yield stamp, {name: values[rows] for name, values in points.columns.items()}


def fed(chart, lines, every=7):
    """Feed whole lines in portions; the tiles that were made, by portion."""
    made, waiting = [], 0
    for points in lines:
        for stamp, columns in pings(points):
            chart.add(stamp, columns)
            waiting += 1
            if waiting == every:
                made.append(set(chart.remade()))
                waiting = 0
    made.append(set(chart.remade()))
    return made


def test_it_is_the_chart_of_all_lines(scene):
    chart = LiveChart(1.0, BUDGET)
    fed(chart, scene.points)
    assert chart.lines == 3
    lines = [line_of(points, BUDGET) for points in scene.points]
    number = np.concatenate([np.full(len(line), k) for k, line in enumerate(lines)])
    xy = np.concatenate([line.xy for line in lines])
    low = (np.floor(xy.min(axis=0)) - 2).astype(int)
    size = (np.ceil(xy.max(axis=0)) + 2).astype(int) - low
    box = (int(low[0]), int(low[1]), int(size[0]), int(size[1]))
    whole = grid_of_looks(Soundings(joined_lines(lines), number), 1.0, box, BUDGET)
    table = chart.table()
    assert list(table) == list(COLUMNS)
    keys = [
        {(x, y): k for k, (x, y) in enumerate(zip(a, b))}
        for a, b in (((table['px'], table['py'])), (whole.ix + 0.5, whole.iy + 0.5))
    ]
    both = [key for key in keys[0] if key in keys[1]]
    assert len(both) == len(keys[0]) > 0.99 * len(keys[1])  # tiles without soundings are left out
    here, there = ([mine[key] for key in both] for mine in keys)
    assert len(both) > 5000
    apart = np.abs(table['z'][here] - whole.z[there])
    # Directions at the ends of a portion are those of fewer pings.
    assert np.quantile(apart, 0.999) < 1e-3
    assert np.median(np.abs(table['uncertainty'][here] / whole.sd[there] - 1.0)) < 1e-3
    assert (table['lines'][here] == whole.lines[there]).mean() > 0.999


def test_only_tiles_that_changed_are_made(scene):
    chart = LiveChart(0.25, BUDGET)
    portions = fed(chart, scene.points[:1], every=5)
    everything = set().union(*portions)
    assert len(everything) > 20 and max(len(portion) for portion in portions) < len(everything)
    assert not set(chart.remade())
    x0, y0, cells = chart.picture()
    assert cells.min() == -1 and cells.max() == 100 and (cells == 0).any()
    table = chart.table()
    shoalest = np.argmax(table['z'])
    row = int(np.floor(table['py'][shoalest] / 0.25)) - y0
    column = int(np.floor(table['px'][shoalest] / 0.25)) - x0
    assert cells[row, column] == 100


@pytest.mark.parametrize('turned, silent, lines', [(False, 5, 1), (True, 5, 2), (False, 40, 2)])
def test_a_turn_or_a_silence_begins_another_line(scene, turned, silent, lines):
    first = scene.points[0]
    columns = dict(first.columns)
    if turned:  # back on the same track: port is on the other side
        columns['x'], columns['y'] = -columns['x'], -columns['y']
    later = int(first.stamp_ns.max() - first.stamp_ns.min()) + silent * 10**9
    chart = LiveChart(2.0, BUDGET)
    fed(chart, [first, Points(first.stamp_ns + later, columns)])
    assert chart.lines == lines


def test_what_changed_is_the_ground_of_the_obstacle_node(scene):
    """All that was published by and by is the newest chart, exact, with its variances."""
    chart = LiveChart(1.0, BUDGET)
    newest = {}
    for points in scene.points:
        for stamp, columns in pings(points):
            chart.add(stamp, columns)
        position, variance = chart.floor(sorted(set(chart.remade())))
        stamp = int(points.stamp_ns.max())
        ground = Ground(stamp_ns=stamp, position=position, variance=variance)
        read = read_ground(write_ground(ground, ros_message))
        assert np.array_equal(read.position, ground.position)
        newest |= {
            (x, y): (z, v) for (x, y, z), v in zip(read.position.tolist(), read.variance.tolist())
        }
    table = chart.table()
    assert set(newest) == set(zip(table['px'].tolist(), table['py'].tolist()))
    z, variance = np.array([newest[place] for place in zip(table['px'], table['py'])]).T
    assert z == pytest.approx(table['z'], abs=1e-5)
    assert variance == pytest.approx(np.square(table['uncertainty']), rel=1e-4)
    floor = GroundMap().added(ground)
    off = [floor.floor(x, y, 1.0)[0] - z for x, y, z in ground.position[::50].tolist()]
    assert np.median(np.abs(off)) < 0.1
    assert len(chart.floor([])[0]) == 0


def test_nothing_is_an_empty_chart():
    chart = LiveChart(1.0, BUDGET)
    chart.add(1, {name: np.zeros(0) for name in ('x', 'y', 'z')})
    assert not list(chart.remade()) and chart.picture()[2].size == 0
    assert all(len(column) == 0 for column in chart.table().values())
