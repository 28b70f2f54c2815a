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

"""The page of a report: what the browser is asked to draw."""

from helpers.report_pages import figures
import plotly.graph_objects as go

from sonar_imm_tools.evaluation.report import (
    LEAST_GL_POINTS,
    MOST_GL_FIGURES,
    Part,
    report_html,
    Section,
)


def kinds(sizes):
    """The kinds of traces on a page with a figure of each size."""
    drawn = [go.Figure(go.Scattergl(x=list(range(n)), y=list(range(n)))) for n in sizes]
    run = {'system': 'diver', 'bag': 'run', 'topics': {}}
    sections = [Section('figure', 'text', figure) for figure in drawn]
    html = report_html(Part(run=run, metrics={}, summary='', sections=sections))
    return [figure['data'][0]['type'] for figure in figures(html)]


def test_only_the_largest_figures_use_the_graphics_card():
    sizes = [LEAST_GL_POINTS + k for k in range(MOST_GL_FIGURES + 3)]
    assert kinds(sizes) == 3 * ['scatter'] + MOST_GL_FIGURES * ['scattergl']


def test_small_figures_never_do():
    assert kinds([10, 100, LEAST_GL_POINTS - 1]) == 3 * ['scatter']
