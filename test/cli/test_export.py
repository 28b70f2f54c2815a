# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm export``: from a scene of a moving ship to files that other programs read."""

import json
import re

from helpers.commands import run
from helpers.report_pages import figures
import numpy as np
import pytest

from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.export.points import read_points
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.survey.chart import OF_ONE_RUN

SMALL = ('--set', 'pings=3', '--set', 'last_range=30', '--set', 'bin_width=0.1')


@pytest.fixture(scope='module')
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp('export')
    scene = ('simulate', 'bathymetry', folder / 'bag', '--scenario', 'moving_two_sides')
    assert run(*scene, *SMALL) == 0
    assert run('track', folder / 'bag', folder / 'run', '--set', 'particles_per_model=30') == 0
    return folder / 'run'


def test_a_run_holds_the_soundings_of_both_sides(tracked):
    points = read_points(tracked / 'soundings.csv')
    content = json.loads((tracked / 'run.json').read_text())
    assert len(points) == content['soundings'] > 400
    assert content['parameters']['navigation'] == 'required' and content['estimates'] == 6
    assert set(points['side']) == {0.0, 1.0} and points['z'].mean() == pytest.approx(-20, abs=0.2)
    assert all(np.isfinite(column).all() for column in points.columns.values())


@pytest.mark.parametrize('tables', ['--parquet', '--no-table'])
def test_soundings_are_the_same_from_any_table(tables, tracked, tmp_path):
    pytest.importorskip('pyarrow')
    again = ('--set', 'particles_per_model=30', tables)
    assert run('track', tracked.parent / 'bag', tmp_path / 'runs' / 'line', *again) == 0
    assert not list((tmp_path / 'runs').rglob('*.csv'))
    for folder, name in ((tracked, 'a.csv'), (tmp_path / 'runs' / 'line', 'b.csv')):
        assert run('export', folder, tmp_path / name) == 0
    assert (tmp_path / 'a.csv').read_bytes() == (tmp_path / 'b.csv').read_bytes()
    assert run('survey', tmp_path / 'runs', tmp_path / 'chart') == 0
    (line,) = json.loads((tmp_path / 'chart' / 'survey.json').read_text())['lines']
    assert line['soundings'] == len(read_points(tracked / 'soundings.csv'))
    assert not json.loads((tmp_path / 'chart' / 'survey.json').read_text())['warnings']
    ours, theirs = (RunFolder(f).read_estimates() for f in (tmp_path / 'runs' / 'line', tracked))
    for our, their in zip(ours, theirs, strict=True):
        assert (our.stamp_ns, our.frame_id) == (their.stamp_ns, their.frame_id)
        assert [*our.columns()] == [*their.columns()]
        for mine, other in zip(our.columns().values(), their.columns().values()):
            np.testing.assert_array_equal(mine, other, strict=True)
    assert run('evaluate', tmp_path / 'runs' / 'line') == 0
    assert 'soundings in cells of' in (tmp_path / 'runs' / 'line' / 'report.html').read_text()


def test_bins_are_in_the_table_or_in_the_bag(tracked, tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    place, again = tmp_path / 'bag', ('--set', 'particles_per_model=30', '--shard', '1/1')
    sizes = {}
    for tables in ('--parquet', '--no-table', '--no-table', '--parquet'):
        assert run('track', tracked.parent / 'bag', tmp_path, *again, tables) == 0
        with BagReader(place / 'estimate') as bag:
            topics = {topic.name.rpartition('/')[2]: topic.count for topic in bag.topics}
        sizes[tables] = json.loads((place / 'run.json').read_text())['written_bytes']
        assert topics == {'soundings': 6} | ({'estimate': 6} if tables == '--no-table' else {})
    assert re.findall(r'(\d) tracked, (\d) kept', capsys.readouterr().out) == [
        ('1', '0'), ('1', '0'), ('0', '1'), ('1', '0')
    ]  # fmt: skip
    plain = json.loads((tracked / 'run.json').read_text())['written_bytes']
    assert all(size < 0.35 * plain for size in sizes.values())
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
    assert (np.asarray(las.return_number) == 1).all()
    assert (np.asarray(las.number_of_returns) == 1).all()
    with rasterio.open(tmp_path / 'a.tif') as file:
        depth, uncertainty, _, count = file.read([1, 2, 3, 4])
        assert file.crs.to_epsg() == 32632 and np.nansum(count) >= 0.9 * len(points)
        assert file.descriptions == OF_ONE_RUN
    # What a ping has in common does not average out: heave alone is 5 cm by default.
    assert np.nanmin(uncertainty) > 0.05
    assert np.nanmean(depth) == pytest.approx(18.5, abs=0.2)


@pytest.mark.parametrize(
    'arguments, word',
    [
        (('a.pdf',), '.xyz, .las, .laz, .tif'),
        (('a.tif', '--epsg', '1'), 'EPSG number 1'),
        (('a.tif', '--cell', '0.00001'), 'too large'),
        (('a.xyz', '--origin', '5'), 'X,Y'),
        (('a.tif', '--cell', '0'), 'cell'),
    ],
)
def test_mistakes_are_one_sentence(tracked, tmp_path, capsys, arguments, word):
    pytest.importorskip('rasterio')
    name, *options = arguments
    assert run('export', tracked, tmp_path / name, *options) == 2
    error = capsys.readouterr().err
    assert word in error and error.count('\n') == 1
    assert not (tmp_path / name).exists()


def test_runs_without_soundings_and_files_in_the_way_are_named(tracked, tmp_path, capsys):
    scene = ('simulate', 'bathymetry', tmp_path / 'bag', '--set', 'pings=1')
    assert run(*scene, '--set', 'last_range=25') == 0
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
    scene = ('simulate', 'obstacle', tmp_path / 'bag', '--set', 'last_range=50')
    assert run(*scene) == 0
    assert run('track', tmp_path / 'bag', tmp_path / 'run') == 0
    (landmark,) = json.loads((tmp_path / 'run' / 'run.json').read_text())['landmarks']
    place = ('--epsg', '32632', '--origin', '500000,6000000,-5')
    assert run('export', tmp_path / 'run', tmp_path / 'a.geojson', '--map', *place) == 0
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
    assert run('export', tmp_path / 'run', tmp_path / 'b.geojson', '--map') == 2
    assert '--epsg' in capsys.readouterr().err
