# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names that others chose, in what is written: a script in HTML, a formula in CSV, an escape
sequence on a terminal or in XML, text that is turned round."""

import csv
import io
import json
import re
import webbrowser
from xml.etree import ElementTree

from helpers.commands import figures
import numpy as np
import plotly.graph_objects as go
from plotly.utils import PlotlyJSONEncoder
import pytest
from rich.console import Console

from msg_adapters.fixes import write_fix
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Rejection
from sonar_imm.texts import in_one_line, visible
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import warn
from sonar_imm_tools.evaluation.plotting import plain_content
from sonar_imm_tools.recordings.export import CsvWriter, in_cell
from sonar_imm_tools.recordings.export.horizons import Picks, write_horizons
from sonar_imm_tools.recordings.export.tracks import tracks_of, write_tracks
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

SCRIPT = '</script><script>alert(1)</script>'
FORMULAS = ['=HYPERLINK("http://x","y")', "+cmd|' /C calc'!A0", '-2+3', '@SUM(1)', '\t=1', '\r=1']
STEERING = '\x1b[2J\x1b]0;title\x07'
TURNED = '\u202egpj.exe'
FILE_NAME = f'=1+1 <script>alert(1){STEERING}{TURNED}[bold]'
"""A file may be called so."""


def is_harmless(text):
    """Whether no character of `text` steers a terminal or turns text round."""
    return not re.search('[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]', text)


def estimate(model):
    """Two confirmed tracks; one model has this name."""
    return Estimate(
        stamp_ns=1, frame_id='map', xyz=np.zeros((2, 3), np.float32),
        state_names=('px', 'py', 'vx', 'vy'), state=np.ones((2, 4)),
        covariance=np.tile(np.eye(4), (2, 1, 1)), model_names=(model,),
        probabilities=np.ones((2, 1)),
        extras={'track_id': np.arange(2, dtype='u4'), 'track_state': np.ones(2, 'u1')},
    )  # fmt: skip


def test_what_would_steer_a_terminal_is_shown():
    assert visible('a\x1b[2Jb\x07\x9b\u202ec\r') == 'a\\x1b[2Jb\\x07\\x9b\\u202ec\\r'
    assert visible('Zoë, 5 m²\n\tend') == 'Zoë, 5 m²\n\tend'


def test_a_sentence_is_one_line_and_has_an_end():
    assert in_one_line('a\nb\r\nc\td') == 'a b c d'
    assert len(in_one_line('x' * 10**6)) < 1100
    rejection = Rejection('frame', "the frame 'a\n\x1b[31mb'")
    assert rejection.sentence == str(rejection) == "the frame 'a \\x1b[31mb'"


def test_what_may_be_a_formula_gets_an_apostrophe_names_and_numbers_stay():
    for text in (*FORMULAS, ' =1', '\n=1', '\uff1d1', '-', '-1\t'):
        assert in_cell(text).startswith("'") and is_harmless(in_cell(text)), text
    for text in ('', 'line 1', 'a=b', '-1.50', '+3', '1e-5', '-inf', 'nan'):
        assert in_cell(text) == text


def test_rows_are_as_csv_writes_them():
    ours, plain = io.StringIO(), io.StringIO()
    for row in [['a', 'b,c', 'd"e'], [1, -2.5, float('nan')], ['-0.10', '', 1e300]]:
        CsvWriter(ours).write(row)
        csv.writer(plain, lineterminator='\n').writerow(row)
    assert ours.getvalue() == plain.getvalue()


def test_tables_of_horizons_and_tracks_hold_no_formula(tmp_path):
    one, whole, name = np.ones(1), np.ones(1, np.int64), FORMULAS[0]
    copied = dict.fromkeys(('existence', 'is_bottom', 'multiple_probability'), one)
    picks = Picks(whole, whole, whole, one, one, one, copied, -one, -one, one)
    write_horizons(tmp_path / 'h.csv', picks, name, None)
    write_tracks(tmp_path / 't.csv', tracks_of([estimate(name)], None), 'csv', name)
    for file, column, start in (
        ('h.csv', 'line', "'"), ('h.csv', 'longitude', '-1.0000000'), ('t.csv', 'model', "'"),
    ):  # fmt: skip
        with (tmp_path / file).open(newline='') as opened:
            (row, *_) = csv.DictReader(opened)
        assert row[column].startswith(start)


@pytest.mark.parametrize('kind', ['gpx', 'kml', 'geojson'])
def test_tracks_for_maps_can_be_read_whatever_they_are_called(tmp_path, kind):
    given = estimate(f'{SCRIPT}{STEERING}')
    tracks = tracks_of([given], lambda places: (places[:, 0], places[:, 1]))
    write_tracks(tmp_path / 'file', tracks, kind, FILE_NAME)
    text = (tmp_path / 'file').read_text()
    assert is_harmless(text)
    if kind != 'geojson':
        words = [element.text or '' for element in ElementTree.fromstring(text).iter()]
        assert any('<script>alert(1)' in word for word in words)


def test_figures_have_no_links_nor_pictures_but_line_breaks():
    figure = go.Figure()
    figure.add_scatter(
        x=[1], y=[2], name=f'<a href="http://x">{TURNED}</a>', text=['<b>5</b><br>']
    )
    figure.add_scatter(x=['<img src=x>'], y=np.array(['<i onclick=x>', 'b']))
    figure.update_layout(title={'text': SCRIPT})
    text = go.Figure(plain_content(figure)).to_json()
    parts = go.Figure(plain_content(figure)).to_dict()
    assert parts['data'][0]['name'] == '&lt;a href="http://x">\\u202egpj.exe&lt;/a>'
    assert list(parts['data'][0]['text']) == ['<b>5</b><br>']
    assert parts['layout']['title']['text'].startswith('&lt;/script>&lt;script>')
    assert not re.search('<(?:a|img|i onclick|/?script)', text)
    assert is_harmless(text)
    # One of numbers stays as it is.
    figure = go.Figure(layout={'title': 'depth [m]'})
    figure.add_scattergl(
        x=np.arange(3.0), y=[1, 2, 3], name='a & b', hovertemplate='%{x}<extra></extra>'
    )
    before = json.dumps(figure.to_dict(), cls=PlotlyJSONEncoder)
    assert json.dumps(plain_content(figure), cls=PlotlyJSONEncoder) == before


def test_tables_of_nodes_are_drawn_as_they_are():
    """rich would read brackets for a style."""
    pytest.importorskip('rclpy')
    from sonar_imm_tools.cli.echo import _picture
    from sonar_imm_tools.replay.listening import ReceivedTable

    columns = dict.fromkeys((f'[red]{STEERING}', f'prob_a[bold]{TURNED}'), np.ones(1))
    columns['prob_b'] = np.zeros(1)
    shown = ReceivedTable(topic='/a', frame_id=f'[blink]{STEERING}', columns=columns, stamp_ns=1)
    broken = ReceivedTable(topic='/b', problem=f'[bold]no{STEERING}')
    console = Console(file=io.StringIO(), width=200, color_system=None)
    console.print(_picture({'/a': shown, '/b': broken}, 5))
    text = console.file.getvalue()
    assert is_harmless(text)
    assert all(word in text for word in ('[red]', '[blink]', 'a[bold]', '/b: [bold]no'))


def test_names_in_a_bag_do_not_steer_the_terminal_nor_the_report(tmp_path, capsys, monkeypatch):
    """A topic, a frame, a parameter, a refused message, the bag and the results folder."""
    name = f'{SCRIPT}{STEERING}{TURNED}'
    bag, run = tmp_path / FILE_NAME, tmp_path / f'{FILE_NAME} run'
    with BagWriter(bag) as writer:
        for k in range(8):
            stamp = (1_700_000_000 + k) * 10**9
            fix = Fix(stamp_ns=stamp, position=[k, 0.0, 0.0], frame_id=name, covariance=np.eye(2))
            message = write_fix(fix, ros_message)
            message.header.frame_id += '_ned' * (k == 5)  # refused, with a sentence
            writer.write(f'/{name}/fix', message, stamp)
    opened = []
    monkeypatch.setattr(webbrowser, 'open', opened.append)
    monkeypatch.setenv('DISPLAY', ':0')
    assert main(['info', str(bag)]) == 0
    assert main(['track', str(bag), str(run), '--set', f'frame_id={name}']) == 0
    assert main(['export', str(run), str(tmp_path / 'tracks.csv')]) == 0
    assert main(['view', str(run)]) == 0
    assert main(['track', str(bag), str(run)]) == 2  # there is one
    output = capsys.readouterr()
    assert '\\x1b[2J' in output.out and '\\u202e' in output.err
    assert is_harmless(output.out) and is_harmless(output.err)
    assert opened == [(run / 'report.html').as_uri()]
    page = (run / 'report.html').read_text()
    assert page.count('&lt;script&gt;alert(1)') > 3 and '<script>alert(1)' not in page
    assert is_harmless(page)
    assert figures(page) and '<script' not in str(figures(page))
    for file in (run / 'estimate.csv', tmp_path / 'tracks.csv'):
        assert is_harmless(file.read_text())


def test_names_in_a_table_do_not_steer_the_terminal(tmp_path, capsys):
    """Targets of a CSV file, and its columns; and what is said on standard error."""
    warn(f'{STEERING}{TURNED} is not read')
    rows = [
        f'{k},{k},0,"{name}"' for k in range(4) for name in (f'=1{STEERING}', f'{SCRIPT}{TURNED}')
    ]
    (tmp_path / 'a.csv').write_text('\n'.join([f'time,x,y,id,"{FILE_NAME}"', *rows]) + '\n')
    status = main(['convert', str(tmp_path / 'a.csv'), str(tmp_path / 'bag')])
    output = capsys.readouterr()
    assert status in (0, 2)
    assert is_harmless(output.out) and is_harmless(output.err)


def test_lines_of_a_survey_may_have_any_name(tmp_path, capsys):
    """In its table of crossings, its page, and what is said of a line that cannot be read."""
    pytest.importorskip('rasterio')
    pytest.importorskip('pyarrow')
    small = ('lines=2', 'cross_lines=1', 'spacing=25', 'length=80', 'ping_interval=0.7')
    runs = tmp_path / 'runs'
    settings = [word for setting in small for word in ('--set', setting)]
    assert main(['simulate', 'survey', str(runs), '--soundings', *settings]) == 0
    for k, path in enumerate(sorted(path for path in runs.iterdir() if path.name != 'truth.npz')):
        path.rename(path.with_name(f'{FILE_NAME}{k}{path.suffix}'))
    damaged = runs / f'{FILE_NAME}9'
    damaged.mkdir()
    (damaged / 'soundings.csv').write_text('stamp_ns,x\n1,2\n')
    status = main(['survey', str(runs), str(tmp_path / 'out'), '--adjust'])
    output = capsys.readouterr()
    assert status in (0, 1), output.err
    assert is_harmless(output.out) and is_harmless(output.err)
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert '<script>alert(1)' not in page and '&lt;script&gt;alert(1)' in page
    plotly = page.partition('<script>')[2].partition('</script></head>')[0]  # it is not ours
    assert is_harmless(page.replace(plotly, ''))
    with (tmp_path / 'out' / 'crossings.csv').open(newline='') as file:
        crossings = list(csv.DictReader(file))
    assert crossings and all(row['line_a'].startswith("'=") for row in crossings)
