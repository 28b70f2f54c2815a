# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pictures of the front page: what a figure holds, at its place."""

import re

import numpy as np
import plotly.graph_objects as go
import pytest

from sonar_imm_tools.evaluation.plotting import HEIGHT, MARGIN, thumbnail, THUMBNAIL_POINTS, WIDTH
from sonar_imm_tools.evaluation.report import front_html, Part, Section


def line(x, y, **layout):
    figure = go.Figure(go.Scatter(x=x, y=y, mode='lines', line={'color': '#123456'}))
    figure.update_layout(**layout)
    return figure


def corners(svg):
    """The first and the last point of the first path."""
    points = re.findall(r'[ML](-?[\d.]+) (-?[\d.]+)', re.search(r' d="([^"]*)"', svg)[1])
    return [tuple(map(float, points[k])) for k in (0, -1)]


@pytest.mark.parametrize(
    'layout, first, last',
    [
        ({}, (MARGIN, HEIGHT - MARGIN), (WIDTH - MARGIN, MARGIN)),
        ({'yaxis_autorange': 'reversed'}, (MARGIN, MARGIN), (WIDTH - MARGIN, HEIGHT - MARGIN)),
        ({'xaxis_range': [0, 4]}, (MARGIN, HEIGHT - MARGIN), (WIDTH / 2, MARGIN)),
        # 2 m by 4 m at one scale: the height decides, the width stays in the middle.
        ({'yaxis_scaleanchor': 'x'}, (95.5, HEIGHT - MARGIN), (164.5, MARGIN)),
    ],
    ids=['fills the picture', 'depth grows downwards', 'view of the figure', 'equal axes'],
)
def test_a_line_goes_from_corner_to_corner(layout, first, last):
    assert corners(thumbnail(line([0.0, 2.0], [1.0, 5.0], **layout))) == [first, last]


def test_gaps_break_a_line_and_long_lines_are_thinned():
    svg = thumbnail(line([0.0, 1.0, np.nan, 3.0], [0.0, 1.0, np.nan, 0.0]))
    assert svg.count('M') == 2 and svg.count('L') == 1
    many = np.arange(10.0 * THUMBNAIL_POINTS)
    assert thumbnail(line(many, many)).count('L') == THUMBNAIL_POINTS - 1


def test_points_areas_and_figures_without_lines():
    figure = go.Figure(go.Scatter(x=[1, 2], y=[1, 2], mode='markers', marker={'color': 'red'}))
    figure.add_scatter(x=[0, 1, 1], y=[0, 0, 1], fill='toself', fillcolor='rgba(1,2,3,0.1)')
    svg = thumbnail(figure)
    assert svg.count('h0') == 2 and 'fill="rgba(1,2,3,0.1)" stroke="none"' in svg
    assert '<path' not in thumbnail(go.Figure(go.Heatmap(z=[[1, 2]])))


def part(system, verdict='consistent', checks=(), **run):
    picture = line([0, 1], [0, 1])
    return Part(
        run={'system': system, 'bag': f'{system}.bag', 'topics': {}, **run},
        metrics={},
        summary='',
        verdict=verdict,
        checks=checks,
        sections=[Section('Map', '', picture, picture=True)],
    )


def test_the_front_page_has_a_picture_of_each_system_and_coloured_verdicts():
    parts = [part('diver'), part('diver', 'overconfident'), part('obstacle', 'cautious')]
    page = front_html(parts, ['a.html', 'b.html', 'c.html'])
    assert page.count('<svg') == 2 and page.count('<a class="card" href="a.html">') == 1
    for verdict, count in (('consistent', 2), ('overconfident', 1), ('cautious', 2)):
        assert page.count(f'class="badge {verdict}"') == count


@pytest.mark.parametrize(
    'stamp, start',
    [
        (1_777_888_801_500_000_000, '2026-05-04 10:00:01 UTC'),
        (12_000_000_000, ''),
        (2**62, ''),
    ],
)
def test_the_clock_time_of_second_zero(stamp, start):
    assert part('diver', first_stamp_ns=stamp).start == start
