# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The road of a stranger's file: convert, info, track, export, with nothing but its name; that of
every row of the table of formats; and files for other programs from a scene of a moving ship."""

import json
from pathlib import Path
import re
import shutil

from helpers.commands import figures, run, unpacked
from helpers.estimates import same
from helpers.field_files import BAGS, FORMATS, line
from helpers.obstacle_runs import tracked_by_command
from helpers.source import ROOT
import numpy as np
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.export.points import read_points
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.survey.chart import OF_ONE_RUN

MADE = {each.name: each for each in FORMATS}


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Writes a file of the formats, of `count` spots, into the current folder; gives its name."""
    monkeypatch.chdir(tmp_path)

    def made(name, count=60, at=''):
        place = Path(at or name)
        place.parent.mkdir(exist_ok=True)
        MADE[name].make(tmp_path / place, line(count, MADE[name].step))
        return str(place)

    return made


@pytest.mark.parametrize('name', ['line.xtf', 'usbl.csv'])
def test_what_has_places_on_earth_lies_there_in_the_report(made, name):
    """An origin that the conversion found goes beside the bag, and from there into the run; else
    the first fix is the origin."""
    assert main(['convert', made(name), 'bag', *MADE[name].options]) == 0
    assert main(['track', 'bag', 'run']) == 0
    assert main(['evaluate', 'run', '--report', 'report.html']) == 0
    packed = re.findall('H4sI[A-Za-z0-9+/=]+', Path('report.html').read_text())
    plots = ''.join(map(unpacked, packed))
    assert '"text":"latitude"' in plots and '"text":"longitude"' in plots
    if name == 'line.xtf':
        assert '"name":"vehicle"' in plots
    else:
        assert '"text":"x [m]"' not in plots


def test_bags_are_named_after_files_and_folders_where_nobody_names_them(made, capsys):
    for options in ([], ['--ignore', 'id', '--time-offset', '1']):
        assert main(['convert', made('usbl.csv'), *options]) == 0
        shutil.move('usbl.bag', f'named{len(options)}')
    for name in ('a.csv', 'b.csv'):
        made('usbl.csv', at=f'dives/{name}')
    capsys.readouterr()
    assert main(['convert', 'dives', '--jobs', '2']) == 0
    assert 'files such as a.csv: convert fixes' in capsys.readouterr().err
    assert {path.name for path in Path('dives.bags').iterdir()} == {'a', 'b'}
    made('gps.log', at='dives/gps.log')
    assert main(['convert', 'dives', 'others']) == 2
    assert 'a.csv (fixes), gps.log (nmea)' in capsys.readouterr().err


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


# -- every row of the table of formats --


TABLE = ROOT / 'docs' / 'reference' / 'formats.md'
OUT = {'diver': 'csv', 'obstacle': 'geojson', 'bathymetry': 'xyz', 'fathometer': 'csv'}
QUICK = {'fathometer': 'particles=200', 'bathymetry': 'particles_per_model=50'}
NO_NAVIGATION = ('pings.npz', 'survey.bag', 'swath.bag', 'micron.bag')
"""What does not say where on Earth it was; of soundings not even where in metres."""
ARRAY = ['--params', str(BAGS / 'fathometer_pressure' / 'parameters.yaml')]


def test_each_row_of_the_table_has_a_file_here():
    lines = TABLE.read_text().partition('## In')[2].partition('###')[0].splitlines()
    rows = [row.split(' | ')[0].strip('| ') for row in lines if row.startswith('| ')]
    assert rows[1:] == list(dict.fromkeys(each.row for each in FORMATS))


@pytest.mark.parametrize('each', FORMATS, ids=lambda each: each.name)
def test_from_a_file_to_tracks_in_a_file(made, tmp_path, each, capsys):
    bag = made(each.name, {'bathymetry': 12, 'obstacle': 60}.get(each.system, 30))
    if each.kind != 'none':
        words = [word for word in (each.kind, bag, 'bag') if word]
        options = [option.format(tmp_path) for option in each.options]
        assert main(['convert', *words, *options]) == 0
        assert each.kind or 'is taken for' in capsys.readouterr().err
        bag = 'bag'
    # What only describes the ground is for a tracker beside other inputs.
    assert main(['info', bag]) == (0 if each.system else 1)
    printed = capsys.readouterr().out
    if not each.system:
        assert 'fits obstacle ground' in printed and 'no tracker can use it' in printed
        assert main(['track', bag, 'run', '--system', 'obstacle']) == 0
        printed = capsys.readouterr().out
        assert 'obstacle <- /ground as ground (' in printed and 'no track was made' in printed
        return
    suggested = printed.split('to track it: sonar-imm ')[1].splitlines()[0]
    assert f'--system {each.system}' in suggested
    words = suggested.replace('OUT_DIR', 'run').split()
    quick = ['--set', QUICK[each.system]] if each.system in QUICK else []
    assert main([*words, *(ARRAY if each.name.endswith('.wav') else quick)]) == 0
    printed = capsys.readouterr().out
    assert f'{each.system} <- ' in printed and 'no track was made' not in printed
    nowhere = each.name in NO_NAVIGATION
    kind = 'csv' if nowhere and each.system == 'obstacle' else OUT[each.system]
    refused = nowhere and each.system == 'bathymetry'
    assert main(['export', 'run', f'out.{kind}']) == (2 if refused else 0)
    if refused:
        assert 'the recording has no navigation' in capsys.readouterr().err
    else:
        assert Path(f'out.{kind}').stat().st_size > 100


SMALL = ('--set', 'pings=3', '--set', 'last_range=30', '--set', 'bin_width=0.1')


@pytest.fixture(scope='module')
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp('export')
    scene = ('simulate', 'bathymetry', folder / 'bag', '--scenario', 'moving_two_sides')
    assert run(*scene, *SMALL) == 0
    assert run('track', folder / 'bag', folder / 'run', '--set', 'particles_per_model=30') == 0
    return folder / 'run'


@pytest.mark.parametrize('tables', ['--parquet', '--no-table'])
def test_soundings_are_the_same_from_any_table(tables, tracked, tmp_path):
    pytest.importorskip('pyarrow')
    line, chart = tmp_path / 'runs' / 'line', tmp_path / 'chart'
    again = ('--set', 'particles_per_model=30', tables)
    assert run('track', tracked.parent / 'bag', line, *again) == 0
    assert not list(line.rglob('*.csv'))
    for folder, name in ((tracked, 'a.csv'), (line, 'b.csv')):
        assert run('export', folder, tmp_path / name) == 0
    assert (tmp_path / 'a.csv').read_bytes() == (tmp_path / 'b.csv').read_bytes()
    assert run('survey', line.parent, chart) == 0
    survey = json.loads((chart / 'survey.json').read_text())
    sounded = len(read_points(tracked / 'soundings.csv'))
    assert [each['soundings'] for each in survey['lines']] == [sounded]
    assert not survey['warnings']
    estimates = (RunFolder(folder).read_estimates() for folder in (line, tracked))
    assert all(same(*pair) for pair in zip(*estimates, strict=True))
    assert run('evaluate', line) == 0
    assert 'soundings in cells of' in (line / 'report.html').read_text()


def test_bins_are_in_the_table_or_in_the_bag(tracked, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    place, again = tmp_path / 'bag', ('--set', 'particles_per_model=30', '--shard', '1/1')
    plain = json.loads((tracked / 'run.json').read_text())['written_bytes']
    for tables in ('--parquet', '--no-table', '--no-table', '--parquet'):
        assert run('track', tracked.parent / 'bag', tmp_path, *again, tables) == 0
        with BagReader(place / 'estimate') as bag:
            topics = {topic.name.rpartition('/')[2]: topic.count for topic in bag.topics}
        assert topics == {'soundings': 6} | ({'estimate': 6} if tables == '--no-table' else {})
        size = json.loads((place / 'run.json').read_text())['written_bytes']
        assert size < 0.35 * plain
    kept = re.findall(r'(\d) tracked, (\d) kept', capsys.readouterr().out)
    assert kept == [('1', '0'), ('1', '0'), ('0', '1'), ('1', '0')]
    table = place / 'estimate.parquet'
    parquet.write_table(parquet.read_table(table).drop_columns('z'), table)
    with pytest.raises(BagError, match='is no table of estimates: an estimate table'):
        RunFolder(place).read_estimates()
    table.write_bytes(table.read_bytes()[:-9])
    with pytest.raises(BagError, match='estimate.parquet cannot be read: '):
        RunFolder(place).read_estimates()


def test_xyz_las_and_tif_hold_the_same_floor(tracked, tmp_path):
    laspy, rasterio = pytest.importorskip('laspy'), pytest.importorskip('rasterio')
    place = ('--epsg', '32632', '--origin', '500000,6000000,1.5')
    for name in ('a.xyz', 'a.laz', 'a.tif', 'a.csv'):
        assert run('export', tracked, tmp_path / name, *place) == 0
    points = read_points(tracked / 'soundings.csv')
    content = json.loads((tracked / 'run.json').read_text())
    assert len(points) == content['soundings'] > 400  # of both sides
    assert content['parameters']['navigation'] == 'required' and content['estimates'] == 6
    assert set(points['side']) == {0.0, 1.0} and points['z'].mean() == pytest.approx(-20, abs=0.2)
    assert all(np.isfinite(column).all() for column in points.columns.values())
    text = np.loadtxt(tmp_path / 'a.xyz')
    las = laspy.read(tmp_path / 'a.laz')
    table = read_points(tmp_path / 'a.csv')
    assert table['y'] == pytest.approx(points['y'] + 6_000_000.0, abs=1e-6)
    assert table.columns.keys() == points.columns.keys()
    assert text[:, 0] == pytest.approx(points['x'] + 500_000.0, abs=1e-3)
    assert np.asarray(las.y) == pytest.approx(points['y'] + 6_000_000.0, abs=1e-3)
    assert np.asarray(las.z) == pytest.approx(text[:, 2], abs=1.1e-3)
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    # Since 2017 GPS is 18 s ahead; the epoch is 1980-01-06, less 10^9 s.
    utc = np.asarray(las.gps_time) + 1e9 - 18.0 + 315_964_800.0
    assert utc == pytest.approx(1e-9 * points.stamp_ns, abs=1e-3)
    for returns in (las.return_number, las.number_of_returns):
        assert (np.asarray(returns) == 1).all()
    with rasterio.open(tmp_path / 'a.tif') as file:
        depth, uncertainty, _, count = file.read([1, 2, 3, 4])
        assert file.crs.to_epsg() == 32632 and np.nansum(count) >= 0.9 * len(points)
        assert file.descriptions == OF_ONE_RUN
    # What a ping has in common does not average out: heave alone is 5 cm by default.
    assert np.nanmin(uncertainty) > 0.05
    assert np.nanmean(depth) == pytest.approx(18.5, abs=0.2)


def test_mistakes_are_one_sentence(tracked, tmp_path, capsys):
    pytest.importorskip('rasterio')
    for words, said in (
        ('a.pdf', '.xyz, .las, .laz, .tif'), ('a.tif --epsg 1', 'EPSG number 1'),
        ('a.tif --cell 0.00001', 'too large'), ('a.xyz --origin 5', 'X,Y'),
        ('a.tif --cell 0', 'cell'),
    ):  # fmt: skip
        name, *options = words.split()
        assert run('export', tracked, tmp_path / name, *options) == 2
        error = capsys.readouterr().err
        assert said in error and error.count('\n') == 1 and not (tmp_path / name).exists()


def test_runs_without_soundings_and_files_in_the_way_are_named(tracked, tmp_path, capsys):
    small = ('--set', 'pings=1', '--set', 'last_range=25')
    assert run('simulate', 'bathymetry', tmp_path / 'bag', *small) == 0
    assert run('track', tmp_path / 'bag', tmp_path / 'run') == 0
    assert run('export', tmp_path / 'run', tmp_path / 'a.xyz') == 2
    assert 'holds no soundings' in capsys.readouterr().err
    (tmp_path / 'a.xyz').write_text('mine')
    assert run('export', tracked, tmp_path / 'a.xyz') == 2
    assert 'there already' in capsys.readouterr().err
    assert run('export', tracked, tmp_path / 'a.xyz', '--overwrite') == 0
    assert run('evaluate', tracked) == 0
    drawn = figures((tracked / 'report.html').read_text())
    names = [trace.get('name') for figure in drawn for trace in figure['data']]
    assert 'track of the ship' in names


def test_obstacles_of_a_run_as_geojson(tmp_path, capsys):
    pytest.importorskip('rasterio')
    made = tracked_by_command(tmp_path, 'approach', last_range=50)
    (landmark,) = json.loads((made / 'run.json').read_text())['landmarks']
    place = ('--epsg', '32632', '--origin', '500000,6000000,-5')
    assert run('export', made, tmp_path / 'a.geojson', '--map', *place) == 0
    (found,) = json.loads((tmp_path / 'a.geojson').read_text())['features']
    longitude, latitude, height = found['geometry']['coordinates']
    # 500 km east is the central meridian; a degree of latitude is about 111.3 km here.
    assert longitude == pytest.approx(9.0 + landmark['x'] / 65_500.0, abs=1e-4)
    assert latitude == pytest.approx(54.1481 + landmark['y'] / 111_300.0, abs=2e-4)
    assert height == pytest.approx(landmark['z'] - 5.0, abs=1e-3)
    properties = found['properties']
    assert properties['track_id'] == landmark['track_id'] and properties['existence'] > 0.99
    assert properties['z_low_m'] < height < properties['z_high_m']
    assert properties['x_std_m'] == pytest.approx(landmark['cov_x_x'] ** 0.5, abs=1e-3)
    assert run('export', made, tmp_path / 'b.geojson', '--map') == 2
    assert '--epsg' in capsys.readouterr().err
