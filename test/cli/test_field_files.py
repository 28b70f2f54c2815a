# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The road of a stranger's file: convert, info, track, export, with nothing but its name; and that
of every row of the table of formats."""

from pathlib import Path
import re

from helpers.dive_scenes import legs
from helpers.field_files import BAGS, FORMATS, line, shipped_sound
from helpers.report_pages import unpacked
from helpers.source import ROOT
import numpy as np
import pytest

from msg_adapters.fixes import write_geodetic
from sonar_imm.measurements import GeodeticFix
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

pyais = pytest.importorskip('pyais')
soundfile = pytest.importorskip('soundfile')

BEGIN = 1_717_149_600
PLACE = 54.0, 10.0
DEGREE = 111_320.0


def degrees_of(place):
    east = place[:, 0] / (DEGREE * np.cos(np.radians(PLACE[0])))
    return PLACE[0] + place[:, 1] / DEGREE, PLACE[1] + east


def dive(count=80, seed=1):
    times = np.arange(count)
    noise = np.random.default_rng(seed).normal(0.0, 1.2, (count, 2))
    return BEGIN + times, legs(times * 1.0)[:, :2] + noise


MADE = {each.name: each for each in FORMATS}


def test_sound_comes_back_sample_by_sample(tmp_path):
    """That of a shipped array, from a WAV; below it is tracked."""
    blocks = shipped_sound(3)
    pressure = np.concatenate([block.pressure for block in blocks])
    rate, scale = blocks[0].sample_rate, blocks[0].scale
    steps = np.round(pressure / scale).astype(np.int16)
    name = tmp_path / 'a_20240531_100000.wav'
    soundfile.write(name, steps, int(rate), subtype='PCM_16')
    options = ['--full-scale', repr(scale * 2**15), '--block', repr(len(blocks[0]) / rate)]
    assert main(['convert', str(name), str(tmp_path / 'bag'), *options]) == 0
    with BagReader(tmp_path / 'bag') as bag:
        found = [item.measurement.pressure for item in measurements_of(bag, 'fathometer')]
        # Each record of the recording has a scale of its own, within 2e-4.
        assert np.concatenate(found) == pytest.approx(pressure, rel=3e-4, abs=1e-3 * scale)


def drawn(report):
    """What the plots of a report are made of."""
    return ''.join(map(unpacked, re.findall('H4sI[A-Za-z0-9+/=]+', report.read_text())))


def test_obstacles_of_a_file_with_positions_lie_on_earth_in_the_report(tmp_path):
    """The origin that the conversion found goes beside the bag, and from there into the run."""
    each = MADE['line.xtf']
    each.make(tmp_path / each.name, line(60, each.step))
    bag, run, report = tmp_path / 'bag', tmp_path / 'run', tmp_path / 'report.html'
    assert main(['convert', str(tmp_path / each.name), str(bag), *each.options]) == 0
    assert main(['track', str(bag), str(run)]) == 0
    assert main(['evaluate', str(run), '--report', str(report)]) == 0
    plots = drawn(report)
    assert '"text":"latitude"' in plots and '"name":"vehicle"' in plots


@pytest.mark.parametrize('name', ['usbl.csv', 'line.xtf'])
def test_from_a_file_to_a_picture_in_two_commands(tmp_path, name, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr('webbrowser.open', opened.append)
    monkeypatch.setenv('DISPLAY', ':0')
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    monkeypatch.setattr('tempfile.tempdir', None)
    each = MADE[name]
    each.make(tmp_path / name, line(60, each.step))
    bag = tmp_path / 'line.bag'
    assert main(['convert', str(tmp_path / name), str(bag)]) == 0
    assert main(['view', str(bag)]) == 0
    report = Path(capsys.readouterr().out.rpartition('report: ')[2].strip())
    assert opened == [report.as_uri()] and report.is_relative_to(tmp_path)
    assert 'plotly' in report.read_text().lower()


def test_soundings_of_a_multibeam_are_a_reference_and_no_tracker_takes_them_alone(
    tmp_path, capsys
):
    MADE['swath.xtf'].make(tmp_path / 'swath.xtf', line(5, 0.2))
    bag, run = tmp_path / 'bag', tmp_path / 'run'
    assert main(['convert', str(tmp_path / 'swath.xtf'), str(bag)]) == 0
    assert 'to track it' not in capsys.readouterr().out
    assert main(['info', str(bag)]) == 1
    printed = capsys.readouterr().out
    assert 'fits obstacle ground' in printed and 'no tracker can use it' in printed
    assert main(['track', str(bag), str(run), '--system', 'obstacle']) == 0
    assert 'obstacle <- /ground as ground (5 messages)' in (output := capsys.readouterr().out)
    assert 'no track was made' in output


@pytest.mark.parametrize('options', [[], ['--ignore', 'id', '--time-offset', '1']])
def test_the_bag_is_named_after_the_file_where_nobody_names_it(tmp_path, monkeypatch, options):
    MADE['usbl.csv'].make(tmp_path / 'usbl.csv', line())
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'usbl.csv', *options]) == 0
    assert (tmp_path / 'usbl.bag').is_dir()


def test_a_folder_of_files_of_one_kind_becomes_a_folder_of_bags(tmp_path, monkeypatch, capsys):
    for name in ('a.csv', 'b.csv'):
        (tmp_path / 'dives').mkdir(exist_ok=True)
        MADE['usbl.csv'].make(tmp_path / 'dives' / name, line())
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'dives', '--jobs', '2']) == 0
    assert 'files such as a.csv: convert fixes' in capsys.readouterr().err
    assert {path.name for path in (tmp_path / 'dives.bags').iterdir()} == {'a', 'b'}
    MADE['gps.log'].make(tmp_path / 'dives' / 'gps.log', line())
    assert main(['convert', 'dives', 'others']) == 2
    assert 'a.csv (fixes), gps.log (nmea)' in capsys.readouterr().err


GERMAN = 'Zeitstempel;Breite;Länge;Tiefe (m)\n' + ''.join(
    f'31.05.2024 10:00:{k:02d};54,00{k:02d};10,00{k:02d};12,5\n' for k in range(30)
)


@pytest.mark.parametrize('encoding', ['utf-8', 'latin-1'])
def test_a_german_table(tmp_path, monkeypatch, encoding, capsys):
    """Headers, commas, dates and letters as a German spreadsheet writes them."""
    (tmp_path / 'usbl.csv').write_text(GERMAN, encoding=encoding)
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'usbl.csv', '--time-zone', 'Europe/Berlin']) == 0
    assert 'longitude = Länge' in capsys.readouterr().out
    with BagReader('usbl.bag') as bag:
        fixes = [item.measurement for item in measurements_of(bag, 'diver')]
    assert fixes[0].stamp_ns == (BEGIN - 7200) * 10**9
    assert fixes[0].position == pytest.approx([0.0, 0.0, -12.5], abs=1e-6)
    assert fixes[-1].position[1] == pytest.approx(29e-4 * 111_300, rel=1e-2)


def test_what_is_kept_and_looks_wrong_is_asked(tmp_path, monkeypatch, capsys):
    rows = ''.join(f'{k},{600 * k},{100 * (k % 7)},12\n' for k in range(1, 40))  # millimetres
    (tmp_path / 'usbl.csv').write_text('time,x,y,Depth (m)\n' + rows)
    monkeypatch.chdir(tmp_path)
    assert main(['convert', 'usbl.csv', '--column', 'z=Depth (m)']) == 0
    printed = capsys.readouterr().out
    assert 'move at 601 m/s; is their unit, or that of the time, right?' in printed
    assert "is --column 'depth=Depth (m)' meant?" in printed
    two = ''.join(f'{k},{500 * (k % 2)},{0.8 * k}\n' for k in range(1, 40))  # divers in turn
    (tmp_path / 'two.csv').write_text('time,x,y\n' + two)
    assert main(['convert', 'two.csv']) == 0
    assert 'question' not in capsys.readouterr().out


@pytest.mark.parametrize(
    'arguments, wanted',
    [
        (['nothing.csv', 'out'], 'nothing.csv does not exist'),
        (['fixess', 'out'], "did you mean 'fixes'"),
        (['dive.bag', 'out'], 'is a recording already'),
    ],
)
def test_what_cannot_be_converted_is_one_sentence(
    tmp_path, capsys, monkeypatch, arguments, wanted
):
    monkeypatch.chdir(tmp_path)
    MADE['usbl.csv'].make(tmp_path / 'usbl.csv', line())
    assert main(['convert', 'usbl.csv', 'dive.bag']) == 0
    capsys.readouterr()
    assert main(['convert', *arguments]) != 0
    printed = capsys.readouterr().err
    assert wanted.lower() in printed.lower() and 'Traceback' not in printed


def test_the_map_of_fixes_on_earth_is_in_degrees(tmp_path):
    """Also where nobody stated the origin, which the first fix is then."""
    times, place = dive()
    with BagWriter(tmp_path / 'bag') as bag:
        for t, latitude, longitude in zip(times.tolist(), *degrees_of(place)):
            fix = GeodeticFix(
                stamp_ns=t * 10**9, latitude=latitude, longitude=longitude, height=0.0,
                frame_id='gps', covariance=np.eye(3),
            )  # fmt: skip
            bag.write('/fix', write_geodetic(fix, ros_message), t * 10**9)
    assert main(['track', str(tmp_path / 'bag'), str(tmp_path / 'run')]) == 0
    report = tmp_path / 'report.html'
    assert main(['evaluate', str(tmp_path / 'run'), '--report', str(report)]) == 0
    plots = drawn(report)
    assert '"text":"latitude"' in plots and '"text":"longitude"' in plots
    assert '"text":"x [m]"' not in plots


# -- every row of the table of formats --


TABLE = ROOT / 'docs' / 'reference' / 'formats.md'
OUT = {'diver': 'csv', 'obstacle': 'geojson', 'bathymetry': 'xyz', 'fathometer': 'csv'}
QUICK = {
    'fathometer': ['--set', 'particles=200'],
    'bathymetry': ['--set', 'particles_per_model=50'],
}
NO_NAVIGATION = ('pings.npz', 'survey.bag', 'swath.bag', 'micron.bag')
"""What does not say where on Earth it was; of soundings not even where in metres."""
ARRAY = ['--params', str(BAGS / 'fathometer_pressure' / 'parameters.yaml')]


def test_each_row_of_the_table_has_a_file_here():
    lines = TABLE.read_text().partition('## In')[2].partition('###')[0].splitlines()
    rows = [row.split(' | ')[0].strip('| ') for row in lines if row.startswith('| ')]
    assert rows[1:] == list(dict.fromkeys(each.row for each in FORMATS))


@pytest.mark.parametrize('each', FORMATS, ids=lambda each: each.name)
def test_from_a_file_to_tracks_in_a_file(tmp_path, each, capsys):
    source, run = tmp_path / each.name, tmp_path / 'run'
    count = {'bathymetry': 12, 'obstacle': 60}.get(each.system, 30)
    each.make(source, line(count, each.step))
    bag = source
    if each.kind != 'none':
        bag = tmp_path / 'bag'
        words = [each.kind, str(source)] if each.kind else [str(source)]
        options = [option.format(tmp_path) for option in each.options]
        assert main(['convert', *words, str(bag), *options]) == 0
        assert each.kind or 'is taken for' in capsys.readouterr().err
    # What only describes the ground is for a tracker beside other inputs.
    assert main(['info', str(bag)]) == (0 if each.system else 1)
    printed = capsys.readouterr().out
    if not each.system:
        assert 'fits obstacle ground' in printed
        return
    suggested = printed.split('to track it: sonar-imm ')[1].splitlines()[0]
    assert f'--system {each.system}' in suggested
    words = suggested.replace('OUT_DIR', str(run)).split()
    words += ARRAY if each.name.endswith('.wav') else QUICK.get(each.system, [])
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert f'{each.system} <- ' in printed and 'no track was made' not in printed
    nowhere = each.name in NO_NAVIGATION
    out = tmp_path / f'out.{"csv" if nowhere and each.system == "obstacle" else OUT[each.system]}'
    if nowhere and each.system == 'bathymetry':
        assert main(['export', str(run), str(out)]) == 2
        assert 'the recording has no navigation' in capsys.readouterr().err
        return
    assert main(['export', str(run), str(out)]) == 0
    assert out.stat().st_size > 100
