# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pages and their pictures: whole, safe, the same each time; and files for Rerun."""

from html.parser import HTMLParser
from importlib import import_module
import json
from pathlib import Path
import re
import sys
from types import ModuleType, SimpleNamespace

from attrs import evolve
from helpers.dive_scenes import single_run
from helpers.report_pages import figures as figures_of
from helpers.report_pages import unpacked
import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm_tools.evaluation import report
from sonar_imm_tools.evaluation.diver import figures, METRICS, seen, summary_sentence
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of, Truth
from sonar_imm_tools.evaluation.judging import Judgement
from sonar_imm_tools.evaluation.numbers import Card, Check
from sonar_imm_tools.evaluation.plotting import (
    HEIGHT,
    in_degrees,
    MARGIN,
    nis_figure,
    scale_length,
    thin,
    thumbnail,
    THUMBNAIL_POINTS,
    WIDTH,
)

RUN = {
    'system': 'diver', 'bag': '/data/my <dive>.bag', 'topics': {'/fix': 'fix'},
    'parameters': {'model_set': 'heading_speed', 'speed_mean': 0.75}, 'counts': {'used': 60},
    'versions': {'sonar_imm': '0.1.0'},
    'refused': {'nan': {'count': 3, 'example': '/fix: not <b>finite</b>'}},
}  # fmt: skip


def judged(series, truth=None, **changes):
    run, metrics = {**RUN, **changes}, score(series, truth)
    return Judgement(
        run=run, metrics=metrics, words=summary_sentence, shown=METRICS, seen=seen,
        sections=lambda: figures.sections(metrics, series, truth), accuracy=lambda limit: None,
    )  # fmt: skip


def part(truth=True, count=60, checks=(), **changes):
    estimates, true_rows, _ = single_run(count=count)
    known = Truth.from_series(series_of(true_rows)) if truth else None
    return judged(series_of(estimates), known, **changes).part(checks)


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
    text = report.report_html(part())
    page = Page(text)
    assert page.loads == []
    assert page.headings[:5] == [
        'my <dive>.bag', 'Map', 'Error, and the predicted error', 'Which motion model held',
        'Normalised innovations (NIS)',
    ]  # fmt: skip
    assert unpacked(page.plotlyjs).startswith('/**\n* plotly.js')
    assert 'Refused input' in page.headings
    assert 'not &lt;b&gt;finite' in text and 'not <b>finite' not in text
    assert text == report.report_html(part()) and len(text) < 3e6
    assert len(page.figures) == 4
    names = [trace.get('name') for trace in page.figures[0]['data']]
    assert 'truth' in names and any(str(name).startswith('track ') for name in names)
    assert page.figures[0]['layout']['height'] == 640


def test_warnings_of_the_tracker_are_shown_and_truth_only_where_there_is_one():
    text = report.report_html(part(truth=False, warnings=['fix covariances <small>']))
    headings = Page(text).headings
    assert 'Stated uncertainty' in headings and 'Error, and the predicted error' not in headings
    assert '<li>fix covariances &lt;small&gt;</li>' in text and 'Dotted' not in text
    assert 'Dotted: truth' in report.report_html(
        part()
    ) and '<h2>Warnings' not in report.report_html(part())


def test_several_runs_have_a_front_page_and_a_page_each(tmp_path):
    failed = [Check('bytes', 'other', 'equal', False), Check('end', '0', '0', True)]
    parts = [part(), part(bag='/data/other.bag', checks=failed), part(bag='/data/other.bag')]
    report.write_report(tmp_path / 'all.html', parts)
    pages = sorted(path.name for path in (tmp_path / 'all_runs').iterdir())
    assert pages == ['1_my_dive_bag.html', '2_other_bag.html', '3_other_bag.html', report.PLOTLYJS]
    text = (tmp_path / 'all.html').read_text()
    front = Page(text)
    # The picture is of the run with most checks.
    assert front.loads == [f'all_runs/{pages[row]}' for row in (1, 0, 1, 2)]
    assert 'my &lt;dive&gt;.bag' in text and len(text) < 50_000
    assert 'FAILED: bytes' in front.cells and text.count('class="bad"') == 1
    run = (tmp_path / 'all_runs' / pages[1]).read_text()
    assert Page(run).loads == ['../all.html'] and not Page(run).plotlyjs
    assert 'other.bag' in Page(run).headings and len(run) < 3e6
    shared = (tmp_path / 'all_runs' / report.PLOTLYJS).read_text()
    assert unpacked(shared.split("'")[1]).startswith('/**\n* plotly.js')
    assert len(run) + len(shared) < 3e6  # what a browser loads for a page


def test_one_run_is_one_file(tmp_path):
    report.write_report(tmp_path / 'a' / 'run.html', [part()])
    assert [path.name for path in (tmp_path / 'a').iterdir()] == ['run.html']


def test_the_front_page_has_three_numbers_and_a_verdict_of_each_run():
    row = part()
    cells = Page(report.front_html([row], ['page.html'])).cells
    assert cells[0] == 'my <dive>.bag' and cells[1] == 'diver'
    assert cells[2].startswith('1 track of 1 diver, ')
    assert cells[3] in ('consistent', 'cautious', 'overconfident') and cells[3] == row.verdict
    titles = ('Position error, RMS', 'Truth inside the 95 % ellipse', 'Velocity error, RMS')
    assert len(cells) == 7
    for cell, title in zip(cells[4:], titles):
        assert cell.replace('\u00a0', ' ').endswith(title)


def test_names_of_pages_sort_and_suit_every_file_system():
    names = report.page_names(
        [part(bag=f'/data/{name}') for name in ('a b', '../x', 'p\u00e9 "q"')] * 4
    )
    assert names[:3] == ['01_a_b.html', '02_x.html', '03_p_q_.html']
    assert names == sorted(set(names))


def test_a_run_with_an_origin_is_drawn_in_degrees():
    estimates, true_rows, _ = single_run(count=60)
    series, truth = series_of(estimates), Truth.from_series(series_of(true_rows))
    origin = Origin(60.0, 10.0)
    metres = figures.map_figure(series, truth, None)
    degrees = in_degrees(figures.map_figure(series, truth, None), origin)
    for plain, drawn in zip(metres.data, degrees.data):
        back = [origin.local(*place)[:2] for place in zip(drawn.y[:5], drawn.x[:5])]
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
    assert 'Map' in Page(report.report_html(judged(series_of([])).part())).headings


def test_checks_against_the_live_node_come_first():
    checks = [Check('bytes', 'equal', 'equal', True)]
    page = Page(report.report_html(part(checks=checks)))
    assert page.headings[1] == 'Live node against offline tracker'
    checks = [Check('position RMSE against truth', '1 m', 'at most 2 m', True)]
    assert Page(report.report_html(part(checks=checks))).headings[1] == 'Error and its limit'


def test_a_part_of_another_system_makes_a_page():
    other = report.Part(
        run={**RUN, 'system': 'whale', 'bag': 'whale.bag'},
        metrics={'size': {'rmse_m': 2.0}},
        summary='A whale.',
        cards=[Card('30 m', 'Length')],
        sections=[report.Section('Whale', 'Seen from the side.')],
    )
    text = report.report_html(other)
    page = Page(text)
    assert page.headings.index('whale.bag') < page.headings.index('Whale')
    assert 'sonar_imm · whale tracker' in text and 'size.rmse_m' in text
    assert 'Length' in report.front_html([part(), other], ['1.html', '2.html'])
    # A topic of another name is told with what it was read as.
    run = {**RUN, 'topics': {'/boat/fix': 'fix', '/gps': 'fix'}}
    assert report.Part(run=run, metrics={}, summary='').input == '/boat/fix, /gps as fix'


def kinds(sizes):
    """The kinds of traces on a page with a figure of each size."""
    drawn = [go.Figure(go.Scattergl(x=list(range(n)), y=list(range(n)))) for n in sizes]
    sections = [report.Section('figure', 'text', figure) for figure in drawn]
    text = report.report_html(report.Part(run=RUN, metrics={}, summary='', sections=sections))
    return [figure['data'][0]['type'] for figure in figures_of(text)]


def test_only_the_largest_figures_use_the_graphics_card_and_small_ones_never():
    sizes = [report.LEAST_GL_POINTS + k for k in range(report.MOST_GL_FIGURES + 3)]
    assert kinds(sizes) == 3 * ['scatter'] + report.MOST_GL_FIGURES * ['scattergl']
    assert kinds([10, report.LEAST_GL_POINTS - 1]) == 2 * ['scatter']


def test_thinning_keeps_at_most_what_it_says():
    for count in (0, 10, 11, 99):
        assert min(count, 5) <= len(np.arange(count)[thin(count, 10)]) <= 10


def test_hits_with_different_degrees_of_freedom_are_divided_by_them():
    time, nis = np.arange(4.0), np.array([2.0, 9.0, 4.0, 1.0])
    same, mixed = (nis_figure(time, nis, np.array(dof)) for dof in ([2] * 4, [2, 3, 2, 1]))
    np.testing.assert_allclose(same.data[0].y, nis)
    np.testing.assert_allclose(mixed.data[0].y, [1.0, 3.0, 2.0, 1.0])
    assert len(same.layout.shapes) == 1 and len(mixed.layout.shapes) == 0


def test_the_mean_of_hits_has_its_own_band_of_95_percent():
    band, _ = nis_figure(np.arange(40.0), np.ones(40), np.full(40, 2)).layout.shapes
    assert [band.y0, band.y1] == pytest.approx(chi2.ppf([0.025, 0.975], 2 * 5) / 5)


# -- the pictures of the front page ---------------------------------------------------------------


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


def pictured(system, verdict='consistent', **run):
    run = {'system': system, 'bag': f'{system}.bag', 'topics': {}, **run}
    sections = [report.Section('Map', '', line([0, 1], [0, 1]), picture=True)]
    return report.Part(run=run, metrics={}, summary='', verdict=verdict, sections=sections)


def test_the_front_page_has_a_picture_of_each_system_and_coloured_verdicts():
    kinds = ('diver',), ('diver', 'overconfident'), ('obstacle', 'cautious')
    parts = [pictured(*kind) for kind in kinds]
    page = report.front_html(parts, ['a.html', 'b.html', 'c.html'])
    assert page.count('<svg') == 2 and page.count('<a class="card" href="a.html">') == 1
    for verdict, count in (('consistent', 2), ('overconfident', 1), ('cautious', 2)):
        assert page.count(f'class="badge {verdict}"') == count


def test_the_clock_time_of_second_zero():
    stamps = 1_777_888_801_500_000_000, 12_000_000_000, 2**62
    starts = [pictured('diver', first_stamp_ns=stamp).start for stamp in stamps]
    assert starts == ['2026-05-04 10:00:01 UTC', '', '']


# -- what is drawn in a Rerun file, as far as it needs no Rerun -----------------------------------

NAME = 'sonar_imm_tools.evaluation.rerun_file'


@pytest.fixture
def drawn(monkeypatch):
    """The module, in which Rerun is only called to write."""
    try:
        import rerun  # noqa: F401
    except ImportError:
        empty = ModuleType('rerun')
        empty.blueprint = None
        monkeypatch.setitem(sys.modules, 'rerun', empty)
    yield import_module(NAME)
    if getattr(sys.modules.get('rerun'), 'blueprint', 0) is None:
        del sys.modules[NAME]


def estimate(state_names, covariance, **extras):
    n, d = covariance.shape[:2]
    return Estimate(
        stamp_ns=1, frame_id='map', xyz=np.zeros((n, 3), np.float32), state_names=state_names,
        state=np.zeros((n, d)), covariance=covariance, model_names=(),
        probabilities=np.empty((n, 0)), extras=extras,
    )  # fmt: skip


def test_ellipsoids_are_those_of_the_covariances_of_places(drawn):
    rng = np.random.default_rng(1)
    A = rng.normal(size=(4, 3, 3))
    full = A @ A.swapaxes(1, 2)
    flat = drawn._place_covariances(estimate(('px', 'py'), full[:, :2, :2]))
    assert (flat[:, :2, :2] == full[:, :2, :2]).all() and not flat[:, 2].any()
    upper = {f'place_cov_{a}_{b}': full[:, 'xyz'.index(a), 'xyz'.index(b)] for a, b in (
        ('x', 'x'), ('x', 'y'), ('x', 'z'), ('y', 'y'), ('y', 'z'), ('z', 'z')
    )}  # fmt: skip
    places = drawn._place_covariances(estimate(('range',), full[:, :1, :1], **upper))
    assert places == pytest.approx(full)
    assert drawn._place_covariances(estimate(('range',), full[:, :1, :1])) is None
    half, turns = drawn._ellipsoids(full)
    R = Rotation.from_quat(turns).as_matrix()
    assert np.einsum('nij,nj,nkj->nik', R, (half / 2.0) ** 2, R) == pytest.approx(full)
    assert drawn._ellipsoids(np.zeros((1, 3, 3)))[0] == pytest.approx(0.005)


class Stream:
    """A recording that keeps what is logged: (path, time, what)."""

    def __init__(self, name):
        self.name, self.logged = name, []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def save(self, file, default_blueprint):
        self.file, self.picture = file, default_blueprint

    def set_time(self, timeline, timestamp):
        self.now = timestamp.astype(int)

    def log(self, path, what):
        self.logged.append((path, self.now, what))


def noted(*arguments, **values):
    """In place of what Rerun draws."""
    return SimpleNamespace(arguments=arguments, **values)


@pytest.fixture
def written(drawn, monkeypatch):
    """The module, and what it writes of a run of `estimates` with `truth`."""
    stream = Stream('none yet')

    def write(estimates, truth):
        known = {'read_run': lambda: {'system': 'diver'}, 'read_estimates': lambda: estimates}
        folder = SimpleNamespace(**known)
        monkeypatch.setattr(drawn, 'RunFolder', lambda run: folder)
        monkeypatch.setattr(drawn, 'read_truth', lambda facts: truth)
        count = drawn.write_rerun(Path('run'), Path('.') / 'run.rrd')
        return count, stream

    views = 'Spatial3DView', 'TimeSeriesView', 'Blueprint', 'Horizontal', 'Vertical'
    kinds = 'Points3D', 'Ellipsoids3D', 'Scalars'
    monkeypatch.setattr(drawn, 'blueprint', SimpleNamespace(**dict.fromkeys(views, noted)))
    fake = SimpleNamespace(RecordingStream=lambda name: stream, **dict.fromkeys(kinds, noted))
    monkeypatch.setattr(drawn, 'rerun', fake)
    return write


def scan(stamp_ns, ids, states):
    n = len(ids)
    return evolve(
        estimate(
            ('px', 'py'), np.tile(np.diag([4.0, 9.0]), (n, 1, 1)),
            track_id=np.array(ids, np.uint32), track_state=np.array(states, np.uint8),
        ),
        stamp_ns=stamp_ns,
        state=np.tile([10.0, np.nan], (n, 1)),
        model_names=('still', 'east'),
        probabilities=np.tile([0.25, 0.75], (n, 1)),
    )  # fmt: skip


def test_tracks_that_were_ever_confirmed_have_curves_of_what_is_known(written):
    """Track 7 is confirmed at its second scan, 8 for longer, and 9 never."""
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8], [1, 2]), scan(7, [8, 9], [1, 0])]
    count, stream = written(run, [estimate((), np.empty((2, 0, 0)))])
    assert count == 3
    curves = [entry for entry in stream.logged if '/track_' in entry[0]]
    assert {(path.split('/')[1], stamp) for path, stamp, _ in curves} == {
        ('track_7', 5), ('track_7', 6), ('track_8', 5), ('track_8', 6), ('track_8', 7)
    }  # fmt: skip
    first = {path: what.arguments for path, stamp, what in curves if stamp == 5}
    assert {path: value for path, (value,) in first.items() if 'track_7' in path} == {
        'diver/track_7/state/px': 10.0, 'diver/track_7/std/px': 2.0, 'diver/track_7/std/py': 3.0,
        'diver/track_7/probability/still': 0.25, 'diver/track_7/probability/east': 0.75,
    }  # fmt: skip
    places = [(stamp, len(what.arguments[0])) for path, stamp, what in stream.logged
              if path == 'diver/points']  # fmt: skip
    assert places == [(5, 3), (6, 2), (7, 2)]
    truth = [(stamp, what.colors) for path, stamp, what in stream.logged if path == 'truth']
    assert truth == [(1, (255, 255, 255))]  # white


def test_the_first_picture_has_the_curves_of_the_track_that_lasted_longest(written):
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8, 9], [1, 2, 0]), scan(7, [8, 9], [1, 0])]
    _, stream = written([*run, scan(8, [9], [0])], None)
    (split,) = stream.picture.arguments
    scene, curves = split.arguments
    assert scene.origin == '/'
    assert [view.origin.rpartition('/')[0] for view in curves.arguments] == ['/diver/track_8'] * 3
    _, alone = written([scan(5, [9], [0])], None)
    assert [view.origin for view in alone.picture.arguments] == ['/']
