# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pages: whole, safe, the same each time."""

from html.parser import HTMLParser
import json

from helpers.dive_scenes import single_run
from helpers.report_pages import figures as figures_of
from helpers.report_pages import unpacked
import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.stats import chi2

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm_tools.evaluation.diver import figures, METRICS, seen, summary_sentence
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of, Truth
from sonar_imm_tools.evaluation.judging import Judgement
from sonar_imm_tools.evaluation.numbers import Card, Check
from sonar_imm_tools.evaluation.plotting import in_degrees, nis_figure, scale_length, thin
from sonar_imm_tools.evaluation.report import (
    front_html,
    LEAST_GL_POINTS,
    MOST_GL_FIGURES,
    page_names,
    Part,
    PLOTLYJS,
    report_html,
    Section,
    write_report,
)

RUN = {
    'system': 'diver',
    'bag': '/data/my <dive>.bag',
    'topics': {'/fix': 'fix'},
    'parameters': {'model_set': 'heading_speed', 'speed_mean': 0.75},
    'counts': {'used': 60},
    'versions': {'sonar_imm': '0.1.0'},
    'refused': {'nan': {'count': 3, 'example': '/fix: not <b>finite</b>'}},
}


def judged(series, truth=None, **changes):
    run, metrics = {**RUN, **changes}, score(series, truth)
    return Judgement(
        run=run,
        metrics=metrics,
        words=summary_sentence,
        shown=METRICS,
        seen=seen,
        sections=lambda: figures.sections(metrics, series, truth),
        accuracy=lambda limit: None,
    )


def part(truth=True, count=60, checks=(), **changes):
    estimates, true_rows, _ = single_run(count=count)
    known = Truth.from_series(series_of(true_rows)) if truth else None
    return judged(series_of(estimates), known, **changes).part(checks)


def html(part):
    return report_html(part)


class Page(HTMLParser):
    """Headings, ids, figures, cells and whatever the page would load from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.ids, self.loads, self._open = [], [], [], None
        self.figures, self.cells, self.plotlyjs, self._inside_cell = [], [], '', False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.ids += [attributes['id']] if 'id' in attributes else []
        self.loads += [attributes[name] for name in ('src', 'href') if name in attributes]
        if 'data-figure' in attributes:
            self.figures.append(json.loads(unpacked(attributes['data-figure'])))
        self._open = attributes.get('id') if tag == 'script' else tag
        if tag == 'td':
            self.cells.append('')
            self._inside_cell = True

    def handle_endtag(self, tag):
        if tag == 'td':
            self._inside_cell = False

    def handle_data(self, data):
        if self._open in ('h1', 'h2'):
            self.headings.append(data)
            self._open = None
        elif self._open == 'plotlyjs':
            self.plotlyjs = data
        elif self._inside_cell:
            self.cells[-1] += data.rstrip('\n')


def test_the_page_is_whole_small_loads_nothing_and_is_the_same_each_time():
    text = html(part())
    page = Page(text)
    assert page.loads == []
    assert page.headings[:5] == [
        'my <dive>.bag',
        'Map',
        'Error, and the predicted error',
        'Which motion model held',
        'Normalised innovations (NIS)',
    ]
    assert unpacked(page.plotlyjs).startswith('/**\n* plotly.js')
    assert 'Refused input' in page.headings
    assert 'not &lt;b&gt;finite' in text and 'not <b>finite' not in text
    assert text == html(part()) and len(text) < 3e6
    assert len(page.figures) == 4
    names = [trace.get('name') for trace in page.figures[0]['data']]
    assert 'truth' in names and any(str(name).startswith('track ') for name in names)
    assert page.figures[0]['layout']['height'] == 640


def test_without_truth_the_stated_uncertainty_is_shown():
    page = Page(html(part(truth=False)))
    assert 'Stated uncertainty' in page.headings
    assert 'Error, and the predicted error' not in page.headings


def test_warnings_of_the_tracker_are_shown_and_truth_only_where_there_is_one():
    text = html(part(truth=False, warnings=['fix covariances <small>']))
    assert '<li>fix covariances &lt;small&gt;</li>' in text and 'Dotted' not in text
    assert 'Dotted: truth' in html(part()) and '<h2>Warnings' not in html(part())


def test_several_runs_have_a_front_page_and_a_page_each(tmp_path):
    failed = [Check('bytes', 'other', 'equal', False), Check('end', '0', '0', True)]
    parts = [part(), part(bag='/data/other.bag', checks=failed), part(bag='/data/other.bag')]
    write_report(tmp_path / 'all.html', parts)
    pages = sorted(path.name for path in (tmp_path / 'all_runs').iterdir())
    assert pages == ['1_my_dive_bag.html', '2_other_bag.html', '3_other_bag.html', PLOTLYJS]
    text = (tmp_path / 'all.html').read_text()
    front = Page(text)
    # The picture is of the run with most checks.
    assert front.loads == [f'all_runs/{pages[row]}' for row in (1, 0, 1, 2)]
    assert 'my &lt;dive&gt;.bag' in text and len(text) < 50_000
    assert 'FAILED: bytes' in front.cells and text.count('class="bad"') == 1
    run = (tmp_path / 'all_runs' / pages[1]).read_text()
    assert Page(run).loads == ['../all.html'] and not Page(run).plotlyjs
    assert 'other.bag' in Page(run).headings and len(run) < 3e6
    shared = (tmp_path / 'all_runs' / PLOTLYJS).read_text()
    assert unpacked(shared.split("'")[1]).startswith('/**\n* plotly.js')
    assert len(run) + len(shared) < 3e6  # what a browser loads for a page


def test_one_run_is_one_file(tmp_path):
    write_report(tmp_path / 'a' / 'run.html', [part()])
    assert [path.name for path in (tmp_path / 'a').iterdir()] == ['run.html']


def test_the_front_page_has_three_numbers_and_a_verdict_of_each_run():
    row = part()
    cells = Page(front_html([row], ['page.html'])).cells
    assert cells[0] == 'my <dive>.bag' and cells[1] == 'diver'
    assert cells[2].startswith('1 track of 1 diver, ')
    assert cells[3] in ('consistent', 'cautious', 'overconfident') and cells[3] == row.verdict
    titles = ('Position error, RMS', 'Truth inside the 95 % ellipse', 'Velocity error, RMS')
    assert len(cells) == 7
    for cell, title in zip(cells[4:], titles):
        assert cell.replace('\u00a0', ' ').endswith(title)


def test_names_of_pages_sort_and_suit_every_file_system():
    names = page_names([part(bag=f'/data/{name}') for name in ('a b', '../x', 'p\u00e9 "q"')] * 4)
    assert names[:3] == ['01_a_b.html', '02_x.html', '03_p_q_.html']
    assert names == sorted(set(names))


def test_a_run_with_an_origin_is_drawn_in_degrees():
    estimates, true_rows, _ = single_run(count=60)
    series, truth = series_of(estimates), Truth.from_series(series_of(true_rows))
    origin = Origin(60.0, 10.0)
    metres = figures.map_figure(series, truth, None)
    degrees = in_degrees(figures.map_figure(series, truth, None), origin)
    for plain, drawn in zip(metres.data, degrees.data):
        back = [
            origin.local(latitude, longitude)[:2]
            for latitude, longitude in zip(drawn.y[:5], drawn.x[:5])
        ]
        expected = np.column_stack([plain.x[:5], plain.y[:5]])
        np.testing.assert_allclose(back, expected, atol=1e-2)  # the Earth is round
    assert degrees.layout.yaxis.scaleratio == pytest.approx(2.0)
    bar = degrees.data[-1]
    ends = [origin.local(y, x)[0] for x, y in zip(bar.x, bar.y)]
    assert bar.name == f'{ends[1] - ends[0]:.0f} m'
    for place, axis in ((bar.x, degrees.layout.xaxis), (bar.y, degrees.layout.yaxis)):
        low, high = axis.range
        assert 0.01 < (place[0] - low) / (high - low) < 0.1  # in the lower left corner
    assert [scale_length(x) for x in (0.7, 1.0, 4.9, 72.0)] == [0.5, 1.0, 2.0, 50.0]


def test_a_run_without_tracks_still_makes_a_page():
    series = series_of([])
    page = Page(html(judged(series).part()))
    assert 'Map' in page.headings


def test_checks_against_the_live_node_come_first():
    checks = [Check('bytes', 'equal', 'equal', True)]
    page = Page(html(part(checks=checks)))
    assert page.headings[1] == 'Live node against offline tracker'
    checks = [Check('position RMSE against truth', '1 m', 'at most 2 m', True)]
    assert Page(html(part(checks=checks))).headings[1] == 'Error and its limit'


def test_a_part_of_another_system_makes_a_page():
    other = Part(
        run={**RUN, 'system': 'whale', 'bag': 'whale.bag'},
        metrics={'size': {'rmse_m': 2.0}},
        summary='A whale.',
        cards=[Card('30 m', 'Length')],
        sections=[Section('Whale', 'Seen from the side.')],
    )
    text = html(other)
    page = Page(text)
    assert page.headings.index('whale.bag') < page.headings.index('Whale')
    assert 'sonar_imm · whale tracker' in text and 'size.rmse_m' in text
    assert 'Length' in front_html([part(), other], ['1.html', '2.html'])


def test_a_topic_of_another_name_is_told_with_what_it_was_read_as():
    run = {**RUN, 'topics': {'/boat/fix': 'fix', '/gps': 'fix'}}
    assert Part(run=run, metrics={}, summary='').input == '/boat/fix, /gps as fix'


def kinds(sizes):
    """The kinds of traces on a page with a figure of each size."""
    drawn = [go.Figure(go.Scattergl(x=list(range(n)), y=list(range(n)))) for n in sizes]
    run = {'system': 'diver', 'bag': 'run', 'topics': {}}
    sections = [Section('figure', 'text', figure) for figure in drawn]
    html = report_html(Part(run=run, metrics={}, summary='', sections=sections))
    return [figure['data'][0]['type'] for figure in figures_of(html)]


def test_only_the_largest_figures_use_the_graphics_card_and_small_ones_never():
    sizes = [LEAST_GL_POINTS + k for k in range(MOST_GL_FIGURES + 3)]
    assert kinds(sizes) == 3 * ['scatter'] + MOST_GL_FIGURES * ['scattergl']
    assert kinds([10, LEAST_GL_POINTS - 1]) == 2 * ['scatter']


@pytest.mark.parametrize('count, most', [(0, 10), (10, 10), (11, 10), (99, 10)])
def test_thinning_keeps_at_most_what_it_says(count, most):
    left = len(np.arange(count)[thin(count, most)])
    assert left <= most and left >= min(count, most // 2)


def test_hits_with_different_degrees_of_freedom_are_divided_by_them():
    time, nis = np.arange(4.0), np.array([2.0, 9.0, 4.0, 1.0])
    same, mixed = (nis_figure(time, nis, np.array(dof)) for dof in ([2] * 4, [2, 3, 2, 1]))
    np.testing.assert_allclose(same.data[0].y, nis)
    np.testing.assert_allclose(mixed.data[0].y, [1.0, 3.0, 2.0, 1.0])
    assert len(same.layout.shapes) == 1 and len(mixed.layout.shapes) == 0


def test_the_mean_of_hits_has_its_own_band_of_95_percent():
    band, _ = nis_figure(np.arange(40.0), np.ones(40), np.full(40, 2)).layout.shapes
    assert [band.y0, band.y1] == pytest.approx(chi2.ppf([0.025, 0.975], 2 * 5) / 5)
