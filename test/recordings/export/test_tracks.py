# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracks in the formats of plotters, GIS and tables, read back by other programs."""

import csv
import json
import math
import struct
from xml.etree import ElementTree

from helpers.dive_bags import write_dive
import numpy as np
import pymap3d
import pytest

from sonar_imm.estimates import PLACES
from sonar_imm.soundings import COLUMNS
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.export.points import Points, read_points, write_las, write_xyz
from sonar_imm_tools.recordings.export.tracks import tracks_of
from sonar_imm_tools.recordings.sources import BagError

ORIGIN = 54.5, 10.25
COUNT = 60


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('tracks')
    write_dive(folder / 'bag', count=COUNT)
    origin = f'--set=origin=[{ORIGIN[0]}, {ORIGIN[1]}, 0.0]'
    assert main(['track', str(folder / 'bag'), str(folder / 'run'), origin]) == 0
    return folder / 'run'


@pytest.fixture(scope='module')
def estimates(run):
    return RunFolder(run).read_estimates()


def exported(run, path, *more):
    assert main(['export', str(run), str(path), *more]) == 0
    return path


def test_rows_are_those_of_confirmed_tracks(run, estimates, tmp_path):
    with exported(run, tmp_path / 'a.csv').open() as file:
        rows = list(csv.DictReader(file))
    tables = [(e.stamp_ns, e.columns()) for e in estimates]
    kept = [(stamp, columns) for stamp, columns in tables if columns['track_state'][0] > 0]
    assert 0 < len(rows) == len(kept) < COUNT  # the first ones are tentative
    for row, (stamp, columns) in zip(rows, kept):
        assert int(row['stamp_ns']) == stamp
        P = np.array(
            [
                [columns['cov_px_px'][0], columns['cov_px_py'][0]],
                [columns['cov_px_py'][0], columns['cov_py_py'][0]],
            ]
        )
        major, minor = float(row['std_major']), float(row['std_minor'])
        assert major >= minor
        assert [minor**2, major**2] == pytest.approx(np.linalg.eigvalsh(P), rel=2e-3, abs=2e-3)
        azimuth = math.radians(float(row['major_azimuth_deg']))
        along = np.array([math.sin(azimuth), math.cos(azimuth)])
        assert along @ P @ along == pytest.approx(major**2, rel=2e-3, abs=2e-3)
        assert float(row['speed']) == pytest.approx(
            math.hypot(columns['vx'][0], columns['vy'][0]), abs=6e-4
        )
        families = {name: columns[name][0] for name in columns if name.startswith('family_')}
        assert row['model'] == max(families, key=families.get).removeprefix('family_')
        place = pymap3d.enu2geodetic(columns['px'][0], columns['py'][0], 0.0, *ORIGIN, 0.0)
        assert [float(row['latitude']), float(row['longitude'])] == pytest.approx(
            place[:2], abs=3e-8
        )


def places_of(path):
    """Latitude and longitude (n, 2) and times of a file."""
    if path.suffix == '.geojson':
        points = [
            feature
            for feature in json.loads(path.read_text())['features']
            if feature['geometry']['type'] == 'Point'
        ]
        places = [feature['geometry']['coordinates'][1::-1] for feature in points]
        return places, [feature['properties']['time_utc'] for feature in points]
    root = ElementTree.parse(path).getroot()
    found = {tag: [] for tag in ('trkpt', 'time', 'when', 'coord')}
    for element in root.iter():
        found.get(element.tag.rpartition('}')[2], []).append(element)
    if path.suffix == '.gpx':
        places = [[float(e.get('lat')), float(e.get('lon'))] for e in found['trkpt']]
        return places, [e.text for e in found['time']]
    places = [[float(part) for part in e.text.split()[1::-1]] for e in found['coord']]
    return places, [e.text for e in found['when']]


@pytest.mark.parametrize('kind', ['gpx', 'kml', 'geojson', 'parquet'])
def test_other_formats_hold_the_same_rows(run, tmp_path, kind):
    with exported(run, tmp_path / 'a.csv').open() as file:
        rows = list(csv.DictReader(file))
    path = exported(run, tmp_path / f'a.{kind}')
    wanted = [[float(row['latitude']), float(row['longitude'])] for row in rows]
    if kind == 'parquet':
        pyarrow = pytest.importorskip('pyarrow.parquet')
        table = pyarrow.read_table(path).to_pydict()
        places = [list(pair) for pair in zip(table['latitude'], table['longitude'])]
        times = table['time_utc']
        assert set(table) == set(rows[0])
    else:
        places, times = places_of(path)
    assert np.array(places) == pytest.approx(np.array(wanted), abs=2e-8)
    assert times == [row['time_utc'] for row in rows]


@pytest.mark.parametrize('kind', ['gpx', 'kml', 'geojson'])
def test_exported_tracks_come_in_again(run, tmp_path, kind, capsys):
    """What `export` writes, `convert` reads, each point once."""
    path = exported(run, tmp_path / f'a.{kind}')
    count = len(places_of(path)[0])
    assert main(['convert', 'truth', str(path), str(tmp_path / 'truth')]) == 0
    capsys.readouterr()
    assert main(['convert', str(path), str(tmp_path / 'again')]) == 0
    assert f'{count} on /fix' in capsys.readouterr().out


def test_gis_programs_see_the_lines_of_kml(run, tmp_path):
    pyogrio = pytest.importorskip('pyogrio')
    path = exported(run, tmp_path / 'a.kml')
    _, _, geometry, _ = pyogrio.raw.read(path)
    kinds = [int.from_bytes(each[1:5], 'little' if each[0] else 'big') for each in geometry]
    assert 2 in [kind & 0xFF for kind in kinds]  # a line string in WKB


@pytest.mark.parametrize('name, layer', [('a.gpx', 'track_points'), ('a.geojson', None)])
def test_gdal_reads_the_places_that_were_written(run, tmp_path, name, layer):
    pyogrio = pytest.importorskip('pyogrio')
    path = exported(run, tmp_path / name)
    _, _, geometry, _ = pyogrio.raw.read(path, layer=layer)
    points = [each for each in geometry if each[1] & 0xFF == 1]
    there = np.array([struct.unpack('<2d', each[5:21]) for each in points])
    table = exported(run, tmp_path / 'a.csv')
    with table.open() as file:
        rows = [(float(row['longitude']), float(row['latitude'])) for row in csv.DictReader(file)]
    assert there == pytest.approx(np.array(rows), abs=1e-8)


def test_a_place_on_earth_can_be_told(run, tmp_path):
    plain = tmp_path / 'plain'
    write_dive(tmp_path / 'bag', count=COUNT)
    assert main(['track', str(tmp_path / 'bag'), str(plain)]) == 0
    assert main(['export', str(plain), str(tmp_path / 'a.gpx')]) == 2
    assert not (tmp_path / 'a.gpx').exists()
    path = exported(plain, tmp_path / 'b.gpx', '--epsg', '32632', '--origin', '500000,6000000')
    places, _ = places_of(path)
    # The middle meridian of zone 32, and the northing of some 54.1 degrees.
    assert np.abs(np.array(places) - [54.147, 9.0]).max() < 0.01


def test_what_has_no_tracks_is_one_sentence(estimates):
    with pytest.raises(BagError, match='no confirmed tracks'):
        tracks_of(estimates[:1], None)


def points(n=300, seed=2):
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(0.1, 1.0, n) for name in COLUMNS}
    columns['x'], columns['y'] = rng.uniform(-5.0, 20.0, n), rng.uniform(3.0, 13.0, n)
    columns['z'] = -20.0 + 0.1 * columns['x']
    columns['vertical_uncertainty'] = rng.uniform(0.01, 0.04, n)
    columns['label'] = rng.integers(0, 2, n).astype(float)
    columns['side'] = rng.integers(0, 2, n).astype(float)
    columns['intensity'] = rng.uniform(-30.0, 20.0, n)
    stamps = 1_700_000_000_000_000_000 + 1_000_000_000 * rng.integers(0, 10, n)
    return Points(stamps, columns)


def test_xyz_is_read_by_numpy(tmp_path):
    item = points()
    write_xyz(tmp_path / 'a.xyz', item)
    table = np.loadtxt(tmp_path / 'a.xyz')
    for k, name in enumerate('xyz'):
        assert table[:, k] == pytest.approx(item[name], abs=5.1e-4)
    assert table[:, 3] == pytest.approx(np.sqrt(item['vertical_uncertainty']), abs=5.1e-4)


@pytest.mark.parametrize('name', ['a.las', 'a.laz'])
def test_las_is_read_by_laspy(tmp_path, name):
    laspy = pytest.importorskip('laspy')
    item = points().moved((500_000.0, 6_000_000.0, 0.0))
    write_las(tmp_path / name, item, 32632)
    las = laspy.read(tmp_path / name)
    for axis in 'xyz':
        assert np.asarray(las[axis]) == pytest.approx(item[axis], abs=5.1e-4)
    for extra in ('vertical_uncertainty', 'horizontal_uncertainty', 'beam_angle', 'range'):
        assert np.asarray(las[extra]) == pytest.approx(item[extra].astype(np.float32))
    assert np.asarray(las.user_data) == pytest.approx(item['label'])
    assert np.asarray(las.point_source_id) == pytest.approx(item['side'])
    decibels = np.asarray(las.intensity) / 100.0 + item['intensity'].min()
    assert decibels == pytest.approx(item['intensity'], abs=0.0051)
    assert set(las.classification) == {40}
    wkt = [vlr for vlr in las.header.vlrs if 'Wkt' in type(vlr).__name__]
    assert 'UTM zone 32N' in wkt[0].string and las.header.global_encoding.wkt
    if name.endswith('laz'):
        write_las(tmp_path / 'b.las', item, 32632)
        assert (tmp_path / name).stat().st_size < (tmp_path / 'b.las').stat().st_size


@pytest.mark.parametrize(
    'text, word',
    [
        ('stamp_ns,x,y\n', 'no column z and'),
        (','.join(['stamp_ns', *COLUMNS]) + '\n1,2\n', 'not numbers'),
        (','.join(['stamp_ns', *COLUMNS]) + '\n' + ','.join(['a'] * 12) + '\n', 'not numbers'),
    ],
)
def test_broken_tables_are_refused(tmp_path, text, word):
    path = tmp_path / 'soundings.csv'
    path.write_text(text)
    with pytest.raises(BagError, match=word):
        read_points(path)
    with pytest.raises(BagError, match='cannot be read'):
        read_points(tmp_path / 'none.csv')


@pytest.mark.parametrize('exact', [True, False])
def test_places_of_a_table_are_the_exact_ones_where_it_has_them(tmp_path, exact):
    names = [name for name in COLUMNS if exact or name not in PLACES]
    row = dict.fromkeys(names, '1') | {'x': '500000.0', 'px': '500000.001'}
    lines = [','.join(['stamp_ns', *names]), ','.join(['7', *(row[name] for name in names)])]
    (tmp_path / 'soundings.csv').write_text('\n'.join(lines) + '\n')
    read = read_points(tmp_path / 'soundings.csv')
    assert read['x'].tolist() == [500000.001 if exact else 500000.0]
    assert not set(PLACES) & set(read.columns)
