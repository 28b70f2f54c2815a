# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pages and their pictures: whole, safe, the same each time; files for Rerun; and that every
system has what the commands need of it, and judges its own runs."""

from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
import re
import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

from attrs import evolve
from helpers import commands
from helpers.commands import unpacked
from helpers.dive_scenes import single_run, write_dive
import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.evaluation import judging, numbers, plotting, report
from sonar_imm_tools.evaluation.diver import figures, METRICS, seen, summary_sentence
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of, Truth
from sonar_imm_tools.evaluation.judging import judge, Judgement, JudgeOptions, Limit
from sonar_imm_tools.evaluation.numbers import (
    Card,
    cards,
    Check,
    chi2_summary,
    error_summary,
    lines,
    Metric,
)
from sonar_imm_tools.evaluation.plotting import HEIGHT, MARGIN, thumbnail, WIDTH
from sonar_imm_tools.offline.run_folder import read_measurements, read_truth, RunFolder
from sonar_imm_tools.recordings.reader import BagError

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
    """Headings, figures, cells and whatever the page would load from elsewhere."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.cells, self.plotlyjs, self.loads = [], [], '', []
        self.figures, self._open, self._inside_cell = commands.figures(text), None, False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.loads += [attributes[name] for name in ('src', 'href') if name in attributes]
        self._open = attributes.get('id') if tag == 'script' else tag
        self.cells += [''] * (tag == 'td')
        self._inside_cell |= tag == 'td'

    def handle_endtag(self, tag):
        self._inside_cell &= tag != 'td'

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
    assert 'Refused input' in page.headings and 'Warnings' not in page.headings
    assert 'not &lt;b&gt;finite' in text and 'not <b>finite' not in text
    assert text == report.report_html(part()) and len(text) < 3e6
    assert len(page.figures) == 4 and 'Dotted: truth' in text
    names = [trace.get('name') for trace in page.figures[0]['data']]
    assert 'truth' in names and any(str(name).startswith('track ') for name in names)
    assert page.figures[0]['layout']['height'] == 640


def test_a_page_shows_warnings_checks_and_truth_only_where_there_are_some():
    text = report.report_html(part(truth=False, warnings=['fix covariances <small>']))
    headings = Page(text).headings
    assert 'Stated uncertainty' in headings and 'Error, and the predicted error' not in headings
    assert '<li>fix covariances &lt;small&gt;</li>' in text and 'Dotted' not in text
    for check, heading in (
        (Check('bytes', 'equal', 'equal', True), 'Live node against offline tracker'),
        (Check('position RMSE against truth', '1 m', 'at most 2 m', True), 'Error and its limit'),
    ):
        assert Page(report.report_html(part(checks=[check]))).headings[1] == heading
    assert 'Map' in Page(report.report_html(judged(series_of([])).part())).headings


def test_one_run_is_a_file_and_several_have_a_front_page_and_a_page_each(tmp_path):
    report.write_report(tmp_path / 'a' / 'run.html', [part()])
    assert [path.name for path in (tmp_path / 'a').iterdir()] == ['run.html']
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
    assert 'other.bag' in Page(run).headings
    shared = (tmp_path / 'all_runs' / report.PLOTLYJS).read_text()
    assert unpacked(shared.split("'")[1]).startswith('/**\n* plotly.js')
    assert len(run) + len(shared) < 3e6  # what a browser loads for a page


def test_the_front_page_has_three_numbers_and_a_verdict_of_each_run():
    row = part()
    cells = Page(report.front_html([row], ['page.html'])).cells
    assert cells[:2] == ['my <dive>.bag', 'diver'] and cells[2].startswith('1 track of 1 diver, ')
    assert cells[3] in ('consistent', 'cautious', 'overconfident') and cells[3] == row.verdict
    titles = ('Position error, RMS', 'Truth inside the 95 % ellipse', 'Velocity error, RMS')
    for cell, title in zip(cells[4:], titles, strict=True):
        assert cell.replace('\u00a0', ' ').endswith(title)
    # Names of pages sort and suit every file system.
    bags = [part(bag=f'/data/{name}') for name in ('a b', '../x', 'p\u00e9 "q"')] * 4
    names = report.page_names(bags)
    assert names[:3] == ['01_a_b.html', '02_x.html', '03_p_q_.html'] and names == sorted(
        set(names)
    )


def test_a_run_with_an_origin_is_drawn_in_degrees():
    estimates, true_rows, _ = single_run(count=60)
    series, truth = series_of(estimates), Truth.from_series(series_of(true_rows))
    origin = Origin(60.0, 10.0)
    metres = figures.map_figure(series, truth, None)
    degrees = plotting.in_degrees(figures.map_figure(series, truth, None), origin)
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
    assert [plotting.scale_length(x) for x in (0.7, 1.0, 4.9, 72.0)] == [0.5, 1.0, 2.0, 50.0]


def test_a_part_of_another_system_makes_a_page():
    run = {**RUN, 'system': 'whale', 'bag': 'whale.bag'}
    sections = [report.Section('Whale', 'Seen from the side.')]
    told = {'summary': 'A whale.', 'cards': [Card('30 m', 'Length')], 'sections': sections}
    other = report.Part(run=run, metrics={'size': {'rmse_m': 2.0}}, **told)
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
    return [figure['data'][0]['type'] for figure in commands.figures(text)]


def test_only_the_largest_figures_use_the_graphics_card_and_small_ones_never():
    sizes = [report.LEAST_GL_POINTS + k for k in range(report.MOST_GL_FIGURES + 3)]
    assert kinds(sizes) == 3 * ['scatter'] + report.MOST_GL_FIGURES * ['scattergl']
    assert kinds([10, report.LEAST_GL_POINTS - 1]) == 2 * ['scatter']


def test_thinning_keeps_what_it_says_and_hits_are_divided_by_their_degrees_of_freedom():
    for count in (0, 10, 11, 99):
        assert min(count, 5) <= len(np.arange(count)[plotting.thin(count, 10)]) <= 10
    time, nis = np.arange(4.0), np.array([2.0, 9.0, 4.0, 1.0])
    for dof, y, bands in (([2] * 4, nis, 1), ([2, 3, 2, 1], [1.0, 3.0, 2.0, 1.0], 0)):
        figure = plotting.nis_figure(time, nis, np.array(dof))
        np.testing.assert_allclose(figure.data[0].y, y)
        assert len(figure.layout.shapes) == bands
    band, _ = plotting.nis_figure(np.arange(40.0), np.ones(40), np.full(40, 2)).layout.shapes
    assert [band.y0, band.y1] == pytest.approx(chi2.ppf([0.025, 0.975], 2 * 5) / 5)


# -- the pictures of the front page ---------------------------------------------------------------


def line(x, y, **layout):
    trace = go.Scatter(x=x, y=y, mode='lines', line={'color': '#123456'})
    return go.Figure(trace).update_layout(**layout)


def test_a_line_goes_from_corner_to_corner():
    """In the view of the figure; depth grows downwards, axes may be equal."""
    for layout, first, last in (
        ({}, (MARGIN, HEIGHT - MARGIN), (WIDTH - MARGIN, MARGIN)),
        ({'yaxis_autorange': 'reversed'}, (MARGIN, MARGIN), (WIDTH - MARGIN, HEIGHT - MARGIN)),
        ({'xaxis_range': [0, 4]}, (MARGIN, HEIGHT - MARGIN), (WIDTH / 2, MARGIN)),
        # 2 m by 4 m at one scale: the height decides, the width stays in the middle.
        ({'yaxis_scaleanchor': 'x'}, (95.5, HEIGHT - MARGIN), (164.5, MARGIN)),
    ):
        path = re.search(r' d="([^"]*)"', thumbnail(line([0.0, 2.0], [1.0, 5.0], **layout)))[1]
        points = re.findall(r'[ML](-?[\d.]+) (-?[\d.]+)', path)
        assert [tuple(map(float, points[k])) for k in (0, -1)] == [first, last]


def test_gaps_break_a_line_long_lines_are_thinned_points_and_areas_are_drawn():
    svg = thumbnail(line([0.0, 1.0, np.nan, 3.0], [0.0, 1.0, np.nan, 0.0]))
    assert svg.count('M') == 2 and svg.count('L') == 1
    many = np.arange(10.0 * plotting.THUMBNAIL_POINTS)
    assert thumbnail(line(many, many)).count('L') == plotting.THUMBNAIL_POINTS - 1
    figure = go.Figure(go.Scatter(x=[1, 2], y=[1, 2], mode='markers', marker={'color': 'red'}))
    figure.add_scatter(x=[0, 1, 1], y=[0, 0, 1], fill='toself', fillcolor='rgba(1,2,3,0.1)')
    svg = thumbnail(figure)
    assert svg.count('h0') == 2 and 'fill="rgba(1,2,3,0.1)" stroke="none"' in svg
    assert '<path' not in thumbnail(go.Figure(go.Heatmap(z=[[1, 2]])))


def pictured(system, verdict='consistent', **run):
    run = {'system': system, 'bag': f'{system}.bag', 'topics': {}, **run}
    sections = [report.Section('Map', '', line([0, 1], [0, 1]), picture=True)]
    return report.Part(run=run, metrics={}, summary='', verdict=verdict, sections=sections)


def test_the_front_page_has_a_picture_of_each_system_coloured_verdicts_and_the_clock_time():
    kinds = ('diver',), ('diver', 'overconfident'), ('obstacle', 'cautious')
    parts = [pictured(*kind) for kind in kinds]
    page = report.front_html(parts, ['a.html', 'b.html', 'c.html'])
    assert page.count('<svg') == 2 and page.count('<a class="card" href="a.html">') == 1
    for verdict, count in (('consistent', 2), ('overconfident', 1), ('cautious', 2)):
        assert page.count(f'class="badge {verdict}"') == count
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
        stamp_ns=1, frame_id='map', xyz=np.zeros((n, 3), np.float32), extras=extras,
        state_names=state_names, state=np.zeros((n, d)), covariance=covariance,
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


def noted(*arguments, **values):
    """In place of what Rerun draws."""
    return SimpleNamespace(arguments=arguments, **values)


@pytest.fixture
def written(drawn, monkeypatch):
    """What is written of a run of `estimates` with `truth`: how many, the first picture, and what
    is logged (path, time, what)."""

    def write(estimates, truth):
        known, stream = {'read_run': lambda: {'system': 'diver'}}, MagicMock()
        known['read_estimates'] = lambda: estimates
        stream.__enter__.return_value = stream
        monkeypatch.setattr(drawn, 'RunFolder', lambda run: SimpleNamespace(**known))
        monkeypatch.setattr(drawn, 'read_truth', lambda facts: truth)
        monkeypatch.setattr(drawn, 'rerun', MagicMock(**kinds))
        drawn.rerun.RecordingStream.return_value = stream
        count, logged, now = drawn.write_rerun(Path('run'), Path('.') / 'run.rrd'), [], None
        for name, arguments, values in stream.method_calls:
            if name == 'set_time':
                now = values['timestamp'].astype(int)
            elif name == 'log':
                logged.append((arguments[0], now, arguments[1]))
        return count, stream.save.call_args.kwargs['default_blueprint'], logged

    views = 'Spatial3DView', 'TimeSeriesView', 'Blueprint', 'Horizontal', 'Vertical'
    kinds = dict.fromkeys(('Points3D', 'Ellipsoids3D', 'Scalars'), noted)
    monkeypatch.setattr(drawn, 'blueprint', SimpleNamespace(**dict.fromkeys(views, noted)))
    return write


def scan(stamp_ns, ids, states):
    n = len(ids)
    tracks = {'track_id': np.array(ids, np.uint32), 'track_state': np.array(states, np.uint8)}
    made = estimate(('px', 'py'), np.tile(np.diag([4.0, 9.0]), (n, 1, 1)), **tracks)
    return evolve(
        made, stamp_ns=stamp_ns, state=np.tile([10.0, np.nan], (n, 1)),
        model_names=('still', 'east'), probabilities=np.tile([0.25, 0.75], (n, 1)),
    )  # fmt: skip


def test_tracks_that_were_ever_confirmed_have_curves_of_what_is_known(written):
    """Track 7 is confirmed at its second scan, 8 for longer, and 9 never."""
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8], [1, 2]), scan(7, [8, 9], [1, 0])]
    count, _, logged = written(run, [estimate((), np.empty((2, 0, 0)))])
    assert count == 3
    curves = [entry for entry in logged if '/track_' in entry[0]]
    assert {(path.split('/')[1], stamp) for path, stamp, _ in curves} == {
        ('track_7', 5), ('track_7', 6), ('track_8', 5), ('track_8', 6), ('track_8', 7)
    }  # fmt: skip
    first = {path: what.arguments for path, stamp, what in curves if stamp == 5}
    assert {path: value for path, (value,) in first.items() if 'track_7' in path} == {
        'diver/track_7/state/px': 10.0, 'diver/track_7/std/px': 2.0, 'diver/track_7/std/py': 3.0,
        'diver/track_7/probability/still': 0.25, 'diver/track_7/probability/east': 0.75,
    }  # fmt: skip
    places = [(t, len(what.arguments[0])) for path, t, what in logged if path == 'diver/points']
    assert places == [(5, 3), (6, 2), (7, 2)]
    truth = [(stamp, what.colors) for path, stamp, what in logged if path == 'truth']
    assert truth == [(1, (255, 255, 255))]  # white


def test_the_first_picture_has_the_curves_of_the_track_that_lasted_longest(written):
    run = [scan(5, [7, 8, 9], [0, 1, 0]), scan(6, [7, 8, 9], [1, 2, 0]), scan(7, [8, 9], [1, 0])]
    (split,) = written([*run, scan(8, [9], [0])], None)[1].arguments
    scene, curves = split.arguments
    assert scene.origin == '/'
    assert [view.origin.rpartition('/')[0] for view in curves.arguments] == ['/diver/track_8'] * 3
    alone = written([scan(5, [9], [0])], None)[1]
    assert [view.origin for view in alone.arguments] == ['/']


def folder_of(tmp_path, estimates=(), **run):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir(parents=True)
    folder.write_estimates(estimates, 'diver')
    record = {'system': 'diver', 'bag': str(tmp_path / 'dive'), 'topics': {'/fix': 'fix'}}
    folder.write_json('run.json', {**record, 'counts': {}, 'parameters': {}, **run})
    return folder


def test_every_system_has_a_judge_with_a_limit_that_is_met_or_missed():
    for system in SYSTEMS.values():
        module = import_module(system.judge)
        assert callable(module.scored) and isinstance(module.LIMIT, Limit)
    limit = Limit(0.5, 'm', 'height RMSE', 'height.all.rmse_m')
    check = limit.check(0.5, remark=' (flat floor 1.20 m)')
    assert (check.name, check.wanted) == ('height RMSE against truth', 'at most 0.5 m')
    assert check.good and check.result == '0.50 m (flat floor 1.20 m)'
    assert not limit.check(0.4, at_most=0.3).good


def test_without_truth_there_is_no_accuracy_but_a_page(tmp_path):
    judgement = judge(folder_of(tmp_path, single_run(count=30)[0]))
    assert judgement.accuracy(None) is None
    assert 'no truth' in judgement.summary and judgement.metrics['truth_lag_s'] == 0.0
    assert judgement.part([]).title == 'dive'


def test_truth_of_another_bag_is_scored(tmp_path):
    truth = write_dive(tmp_path / 'truth')
    options = JudgeOptions(truth_bag=truth, lag=0.5, gap=5.0, cutoff=3.0)
    judgement = judge(folder_of(tmp_path, single_run(count=100)[0]), options)
    assert judgement.metrics['cutoff_m'] == 3.0 and judgement.metrics['truth_lag_s'] == 0.5
    check = judgement.accuracy(None)
    assert check.wanted == 'at most 1.25 m' and check.name == 'position RMSE against truth'
    assert not judgement.accuracy(1e-3).good
    assert judgement.lines[0][0] == 'position error, RMSE / median / 95 %'


@pytest.mark.parametrize('system', ['diver', 'obstacle'])
def test_truth_and_estimates_of_something_else_are_one_sentence(system, tmp_path, monkeypatch):
    place = {name: np.zeros(1, np.float32) for name in 'xyz'}
    nothing = [Estimate.from_columns(place, stamp_ns=1, frame_id='map')]
    monkeypatch.setattr(judging, 'read_truth', lambda *_: nothing)
    with pytest.raises(BagError, match=re.escape(f'{tmp_path / "dive"}: ')):
        judge(folder_of(tmp_path, system=system))
    with pytest.raises(BagError, match="no column 'px'|not those of obstacles"):
        judge(folder_of(tmp_path / 'other', nothing, system=system))


def test_what_went_into_a_run_is_read_again_and_a_truth_bag_without_truth_is_told(tmp_path):
    run = {'system': 'diver', 'topics': {'/fix': 'fix'}, 'bag': str(tmp_path / 'dive')}
    assert read_truth(run) is None and list(read_measurements(run)) == []
    write_dive(tmp_path / 'dive', count=10, spoilt=(3,))
    assert len(read_truth(run)) == 20
    measured = list(read_measurements(run))
    assert len(measured) == 9 and all(isinstance(item, Fix) for item in measured)
    blind = write_dive(tmp_path / 'blind', truth=False, count=5)
    assert read_truth({'bag': str(blind)}) is None
    with pytest.raises(BagError, match='has no topic /truth/estimate'):
        read_truth({'bag': str(blind)}, blind)


# -- numbers that every system is judged by -------------------------------------------------------


def test_coverage_and_errors_far_too_large_are_put_in_words():
    for coverage, words in (
        (0.6, 'overconfident'),
        (0.95, 'is consistent'),
        (1.0, 'more cautious'),
    ):
        assert words in numbers.coverage_sentence(coverage)
    for coverage, nees, said in (
        (0.96, 1.9, 'consistent'), (0.96, 2.1, 'overconfident'), (1.0, 2.1, 'overconfident')
    ):  # fmt: skip
        assert numbers.coverage_verdict(coverage, nees=nees) == said
    sentence = numbers.coverage_sentence(0.96, 31_500.0)
    assert 'overconfident' in sentence and 'mean NEES 3.15e+04 times' in sentence
    assert 'NEES' not in numbers.coverage_sentence(0.5, 31_500.0)
    far = chi2_summary(np.array([1.0, 1.0, 126_000.0]), 2)
    shown = [Metric(covers=('share', 0.95), nees='nees')]
    assert numbers.verdict(shown, {'share': 0.96, 'nees': far}) == 'overconfident'
    assert numbers.verdict(shown, {'share': 0.96}) == 'consistent'


def test_a_metric_is_shown_with_its_unit_where_its_first_number_is_known():
    shown = [numbers.error('angle', 'angle error', 'rad'), numbers.chi2('nees', 'NEES')]
    angle = error_summary(np.radians([3.0, 4.0]), unit='rad')
    found = lines(shown, {'angle': angle, 'nees': chi2_summary(np.empty(0), 2)})
    assert found == (('angle error, RMSE / median / 95 %', '0.062 / 0.061 / 0.069 rad'),)
    assert lines(shown, {'angle': error_summary(np.empty(0), unit='rad')}) == ()
    each = numbers.each('height', ['mean_error', 'rmse'])
    found = lines(each, {'height': {'mean_error': 0.25, 'rmse': 2}})
    assert found == (('mean error', '0.25'), ('rmse', '2'))
    shown = [
        Metric(label='kept / lost', line='{a.kept:.0%} / {a.lost:.0%}'),
        Metric(card='Kept', value='{a.kept:.1%}', remark='of {n}', when=lambda m: m['n'] > 1),
    ]
    found = lines(shown, {'a': {'kept': 0.5, 'lost': float('nan')}})
    assert found == (('kept / lost', '50 % / -'),)
    assert lines(shown, {'a': {'lost': 0.5}}) == lines(shown, {}) == ()
    (card,) = cards(shown, {'n': 2, 'a': {'kept': 0.25}})
    assert (card.title, card.value, card.remark) == ('Kept', '25.0 %', 'of 2')
    assert cards(shown, {'n': 1, 'a': {'kept': 0.25}}) == ()


def test_nees_leaves_out_what_says_nothing_and_mixed_degrees_share_bounds_around_one():
    none = chi2_summary(np.empty(0), 2)
    assert (none['n'], none['dof'], none['believable']) == (0, 2, None)
    error = np.array([[3.0, 4.0], [1.0, 1.0], [np.nan, 0.0]])
    covariance = np.array([np.diag([1.0, 4.0]), np.diag([1.0, 0.0]), np.eye(2)])
    assert numbers.usable_nees(error, covariance).tolist() == [13.0]
    summary = numbers.nis_summary(np.array([2.0, 4.0]), np.array([2.0, 3.0]))
    assert summary['mean'] == pytest.approx(6.0 / 5.0) and summary['low'] < 1.0 < summary['high']
    one = numbers.nis_summary(np.array([2.0]), np.array([2.0]))
    far = numbers.bounds_remark(numbers.nis_summary(np.full(9, 20.0), np.full(9, 2.0)))
    assert numbers.bounds_remark(summary).startswith('per degree of freedom: 1 expected')
    assert numbers.bounds_remark(one).endswith('believable')
    assert far.startswith('2 expected; outside of ') and 'believable' not in far
