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
import shutil
import struct
from xml.etree import ElementTree

from helpers.commands import run as command
from helpers.dive_scenes import write_dive
from helpers.sonar_files import write_segy
import numpy as np
import pymap3d
import pytest

from msg_adapters.navigation import write_navigation
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import PLACES
from sonar_imm.measurements import Navigation
from sonar_imm.soundings import COLUMNS
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.convert import convert_segy
from sonar_imm_tools.recordings.export import points as clouds
from sonar_imm_tools.recordings.export.points import origin_of, Points, read_points
from sonar_imm_tools.recordings.export.tracks import tracks_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.positions import read_positions
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.writer import BagWriter

ORIGIN = 54.5, 10.25
COUNT = 60
COVARIANCE = ('px_px', 'px_py', 'px_py', 'py_py')


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('tracks')
    write_dive(folder / 'bag', count=COUNT)
    origin = f'--set=origin=[{ORIGIN[0]}, {ORIGIN[1]}, 0.0]'
    assert command('track', folder / 'bag', folder / 'run', origin) == 0
    return folder / 'run'


@pytest.fixture(scope='module')
def estimates(run):
    return RunFolder(run).read_estimates()


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def exported(run, path, *more):
    assert command('export', run, path, *more) == 0
    return path


def test_rows_are_those_of_confirmed_tracks(run, estimates, tmp_path):
    rows = rows_of(exported(run, tmp_path / 'a.csv'))
    tables = [(e.stamp_ns, e.columns()) for e in estimates]
    kept = [(stamp, columns) for stamp, columns in tables if columns['track_state'][0] > 0]
    assert 0 < len(rows) == len(kept) < COUNT  # the first ones are tentative
    for row, (stamp, columns) in zip(rows, kept):
        columns = {name: column[0] for name, column in columns.items()}
        assert int(row['stamp_ns']) == stamp
        P = np.array([columns[f'cov_{name}'] for name in COVARIANCE]).reshape(2, 2)
        major, minor = float(row['std_major']), float(row['std_minor'])
        assert major >= minor
        assert [minor**2, major**2] == pytest.approx(np.linalg.eigvalsh(P), rel=2e-3, abs=2e-3)
        azimuth = math.radians(float(row['major_azimuth_deg']))
        along = np.array([math.sin(azimuth), math.cos(azimuth)])
        assert along @ P @ along == pytest.approx(major**2, rel=2e-3, abs=2e-3)
        speed = math.hypot(columns['vx'], columns['vy'])
        assert float(row['speed']) == pytest.approx(speed, abs=6e-4)
        families = {name: columns[name] for name in columns if name.startswith('family_')}
        assert row['model'] == max(families, key=families.get).removeprefix('family_')
        place = pymap3d.enu2geodetic(columns['px'], columns['py'], 0.0, *ORIGIN, 0.0)
        found = [float(row['latitude']), float(row['longitude'])]
        assert found == pytest.approx(place[:2], abs=3e-8)


def places_of(path):
    """Latitude and longitude (n, 2) and times of a file."""
    if path.suffix == '.geojson':
        features = json.loads(path.read_text())['features']
        points = [each for each in features if each['geometry']['type'] == 'Point']
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
def test_other_formats_hold_the_same_rows_and_come_in_again(run, tmp_path, kind, capsys):
    rows = rows_of(exported(run, tmp_path / 'a.csv'))
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
    if kind != 'parquet':  # what `export` writes, `convert` reads, each point once
        assert command('convert', 'truth', path, tmp_path / 'truth') == 0
        capsys.readouterr()
        assert command('convert', path, tmp_path / 'again') == 0
        assert f'{len(places)} on /fix' in capsys.readouterr().out


def test_gis_programs_see_the_lines_of_kml(run, tmp_path):
    pyogrio = pytest.importorskip('pyogrio')
    _, _, geometry, _ = pyogrio.raw.read(exported(run, tmp_path / 'a.kml'))
    kinds = [int.from_bytes(each[1:5], 'little' if each[0] else 'big') for each in geometry]
    assert 2 in [kind & 0xFF for kind in kinds]  # a line string in WKB


def test_a_place_on_earth_can_be_told(estimates, tmp_path):
    write_dive(tmp_path / 'bag', count=COUNT)
    assert command('track', tmp_path / 'bag', tmp_path / 'plain') == 0
    assert command('export', tmp_path / 'plain', tmp_path / 'a.gpx') == 2
    assert not (tmp_path / 'a.gpx').exists()
    place = '--epsg', 32632, '--origin', '500000,6000000'
    places, _ = places_of(exported(tmp_path / 'plain', tmp_path / 'b.gpx', *place))
    # The middle meridian of zone 32, and the northing of some 54.1 degrees.
    assert np.abs(np.array(places) - [54.147, 9.0]).max() < 0.01
    with pytest.raises(BagError, match='no confirmed tracks'):
        tracks_of(estimates[:1], None)


def points(n=300, seed=2):
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(0.1, 1.0, n) for name in COLUMNS}
    columns['x'], columns['y'] = rng.uniform(-5.0, 20.0, n), rng.uniform(3.0, 13.0, n)
    columns['z'] = -20.0 + 0.1 * columns['x']
    columns['vertical_uncertainty'] = rng.uniform(0.01, 0.04, n)
    for name in ('label', 'side'):
        columns[name] = rng.integers(0, 2, n).astype(float)
    columns['intensity'] = rng.uniform(-30.0, 20.0, n)
    stamps = 1_700_000_000_000_000_000 + 1_000_000_000 * rng.integers(0, 10, n)
    return Points(stamps, columns)


def test_xyz_is_read_by_numpy_and_las_by_laspy(tmp_path):
    item = points()
    clouds.write_xyz(tmp_path / 'a.xyz', item)
    wanted = [*(item[name] for name in 'xyz'), np.sqrt(item['vertical_uncertainty'])]
    table = np.loadtxt(tmp_path / 'a.xyz')
    assert table[:, :4] == pytest.approx(np.transpose(wanted), abs=5.1e-4)
    laspy = pytest.importorskip('laspy')
    item = item.moved((500_000.0, 6_000_000.0, 0.0))
    for name in ('a.las', 'a.laz'):
        clouds.write_las(tmp_path / name, item, 32632)
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
    assert (tmp_path / 'a.laz').stat().st_size < (tmp_path / 'a.las').stat().st_size


def test_places_of_a_table_are_the_exact_ones_and_broken_ones_are_refused(tmp_path):
    path, head = tmp_path / 'soundings.csv', ','.join(['stamp_ns', *COLUMNS])
    for exact, x in ((True, 500000.001), (False, 500000.0)):
        names = [name for name in COLUMNS if exact or name not in PLACES]
        row = dict.fromkeys(names, '1') | {'x': '500000.0', 'px': '500000.001'}
        cells = ','.join(['7', *(row[name] for name in names)])
        path.write_text(','.join(['stamp_ns', *names]) + f'\n{cells}\n')
        read = read_points(path)
        assert read['x'].tolist() == [x] and not set(PLACES) & set(read.columns)
    for text, words in (
        ('stamp_ns,x,y\n', 'no column z and'), (f'{head}\n1,2\n', 'not numbers'),
        (f'{head}\n{",".join("a" * 12)}\n', 'not numbers'),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(BagError, match=words):
            read_points(path)
    with pytest.raises(BagError, match='cannot be read'):
        read_points(tmp_path / 'none.csv')


# -- soundings in coordinate systems and in the frame of other lines


NOWHERE = (0.0, 0.0, 0.0)


def test_places_are_the_same_from_either_origin():
    rng = np.random.default_rng(1)
    degrees = 54.3 + rng.uniform(-1, 1, 40) / 60, 10.1 + rng.uniform(-1, 1, 40) / 60
    here, there = Origin(54.3, 10.1), Origin(54.29, 10.12)
    (x, y), wanted = here.local(*degrees)[:2], there.local(*degrees)[:2]
    seen = Points(np.arange(40), {'x': x, 'y': y, 'z': np.full(40, -20.0)})
    moved = seen.placed(here, None, NOWHERE, there)
    assert np.allclose([moved['x'], moved['y']], wanted, atol=2e-3)
    assert (moved['z'] == -20.0).all()
    # One that is none is one sentence.
    assert origin_of(None, 'a') is None and origin_of({}, 'a') is None
    assert origin_of({'origin': {'latitude': 1, 'longitude': '2'}}, 'a') == Origin(1.0, 2.0)
    for wrong in ([1, 2], {'latitude': 'x'}, 'x', {'up': 1}):
        with pytest.raises(BagError, match='cannot be understood'):
            origin_of({'origin': wrong}, 'a')


def test_the_central_meridian_of_utm_is_500_km_east_and_scaled():
    pytest.importorskip('rasterio')
    ahead = {'x': np.zeros(2), 'y': np.array([0.0, 1000.0]), 'z': np.zeros(2)}
    points = Points(np.arange(2), ahead)
    there = points.placed(Origin(54.3, 9.0), 25832, NOWHERE)
    assert there['x'] == pytest.approx(500_000.0, abs=1e-3)
    assert np.diff(there['y']) == pytest.approx(999.6, abs=0.01)
    # A stated place of the origin counts before its latitude.
    points = Points(np.arange(1), {name: np.array([1.0]) for name in 'xyz'})
    moved = points.placed(Origin(54.3, 9.0), 25832, (500.0, 600.0, 7.0))
    assert [moved[name][0] for name in 'xyz'] == [501.0, 601.0, 8.0]
    assert points.placed(None, 25832, NOWHERE)['x'][0] == 1.0


# -- horizons: read back by other means than those that wrote them


T, N, STACK = 48, 90, 4
SPACING, FIRST = 0.4, 8
LAYERS = 30.0 + 4.0 * np.sin(np.arange(T) / 12.0), 48.0 + np.zeros(T)
"""Samples of two layers in each trace."""


def write_line(path):
    rng, sample, rows = np.random.default_rng(3), np.arange(N), np.arange(T)
    traces = 40.0 * np.abs(rng.standard_normal((T, N)))
    for layer in LAYERS:
        traces += 3000.0 * np.exp(-0.5 * np.square((sample - layer[:, None]) / 1.5))
    return write_segy(
        path, np.round(traces), 3, TRACE_SAMPLE_INTERVAL=533, YearDataRecorded=2018, DayOfYear=72,
        SecondOfMinute=rows // STACK, SourceGroupScalar=-1000, CoordinateUnits=2,
        SourceX=round(-91.64 * 3.6e6) + 40 * (rows // STACK), SourceY=round(17.13 * 3.6e6),
        CDP=500 + rows,
    )  # fmt: skip


@pytest.fixture(scope='module')
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp('horizons')
    line = write_line(folder / 'line.seg')
    convert_segy(line, folder / 'bag', sample_spacing=SPACING, first_sample=FIRST, stack=STACK)
    assert command('track', folder / 'bag', folder / 'run', '--set', 'particles=500') == 0
    return folder


def export(folder, name, *options):
    return command('export', folder / 'run', folder / name, *options)


def picks(folder):
    return [row for row in rows_of(folder / 'run' / 'estimate.csv') if row['depth'] != 'nan']


def test_the_table_has_every_pick_by_horizon(tracked):
    assert export(tracked, 'h.csv') == export(tracked, 'h.geojson') == 0
    rows, known = rows_of(tracked / 'h.csv'), picks(tracked)
    assert len(rows) == len(known) >= 2 * T // STACK
    order = [(int(row['horizon']), int(row['trace'])) for row in rows]
    assert order == sorted(order) and {row['line'] for row in rows} == {'line.seg'}
    by_depth = sorted(float(row['depth_m']) for row in rows)
    assert by_depth == pytest.approx(sorted(float(row['depth']) for row in known), abs=6e-4)
    for row in rows:
        twt = 2e3 * float(row['depth_m']) / 1500.0
        assert float(row['twt_ms']) == pytest.approx(twt, abs=2e-3)
        assert row['x'] == '' and float(row['latitude']) == pytest.approx(17.13, abs=1e-5)
        # Forty milliseconds of arc to the east from record to record; the last one comes after
        # the last place, by which it stays, and all others three quarters of a step after theirs.
        step = np.radians(40.0 / 3.6e6) * 6_371_008.8 * np.cos(np.radians(17.13))
        way = step * min(int(row['trace']) - 1, T // STACK - 1.75)
        assert float(row['distance_m']) == pytest.approx(way, abs=0.02)
    assert rows[0]['time_utc'].startswith('2018-03-13T00:00:00.')
    # The same as points along the track.
    content = json.loads((tracked / 'h.geojson').read_text())
    assert content['type'] == 'FeatureCollection' and len(content['features']) == len(known)
    for item in content['features']:
        east, north, up = item['geometry']['coordinates']
        assert item['geometry']['type'] == 'Point' and -91.65 < east < -91.63
        assert up == -item['properties']['depth_m'] and north == pytest.approx(17.13, abs=1e-5)


def test_a_speed_of_a_run_that_is_none_is_said(tracked, tmp_path, capsys):
    shutil.copytree(tracked / 'run', tmp_path / 'run')
    record = json.loads((tmp_path / 'run' / 'run.json').read_text())
    said = f'the sound_speed in the run.json of {tmp_path / "run"} is no speed'
    for speed in (True, '1500', None, 0.0, 1e5):
        record['parameters']['sound_speed'] = speed
        (tmp_path / 'run' / 'run.json').write_text(json.dumps(record))
        assert export(tmp_path, 'h.csv') == 2
        assert said in capsys.readouterr().err


def test_map_coordinates(tracked):
    pytest.importorskip('rasterio')
    assert export(tracked, 'm.csv', '--epsg', 32615) == 0
    row = rows_of(tracked / 'm.csv')[0]
    # Zone 15 by the series for the transverse Mercator projection, worked out by hand.
    a, e2, k0 = 6_378_137.0, 0.00669437999014, 0.9996
    lat, dlon = np.radians(17.13), np.radians(float(row['longitude']) + 93.0)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    A = dlon * np.cos(lat)
    east = 500_000.0 + k0 * n * (A + (1.0 - np.tan(lat) ** 2) * A**3 / 6.0)
    assert float(row['x']) == pytest.approx(east, abs=0.5)


def test_segy_read_by_segyio_and_by_hand(tracked):
    segyio = pytest.importorskip('segyio')
    original = tracked / 'line.seg'
    assert export(tracked, 'p.sgy', '--segy', original) == 0
    known = picks(tracked)
    with segyio.open(str(tracked / 'p.sgy'), ignore_geometry=True) as file:
        found = file.trace.raw[:]
        cdp = file.attributes(segyio.TraceField.CDP)[:]
    assert list(cdp) == list(500 + np.arange(T)) and found.shape == (T, N)
    stamps = sorted({row['stamp_ns'] for row in known})
    for record, stamp in enumerate(stamps):
        rows = [row for row in known if row['stamp_ns'] == stamp]
        wanted = {round(float(row['depth']) / SPACING): int(row['track_id']) for row in rows}
        for trace in found[STACK * record : STACK * record + STACK]:
            assert {int(z): int(trace[z]) for z in np.flatnonzero(trace)} == wanted
    # By hand: 3200 and 400 bytes of header, 240 before each trace of two bytes a sample.
    raw, before = (tracked / 'p.sgy').read_bytes(), original.read_bytes()
    size = 240 + 2 * N
    assert len(raw) == len(before) == 3600 + T * size and raw[:3600] == before[:3600]
    for k in range(T):
        start = 3600 + k * size
        assert raw[start : start + 232] == before[start : start + 232]
        thousandths, number = struct.unpack('>ii', raw[start + 232 : start + 240])
        assert thousandths / 1000.0 == pytest.approx(LAYERS[0][k - k % STACK + 1], abs=2.5)
        samples = struct.unpack(f'>{N}h', raw[start + 240 : start + size])
        assert samples[round(thousandths / 1000.0)] == number > 0
    # The file that was converted is as it was.
    assert convert_segy(original, tracked / 'again', sample_spacing=SPACING).rows == T


def test_what_cannot_be_exported_is_one_sentence(tracked, capsys):
    other, segyio = tracked / 'other.seg', pytest.importorskip('segyio')
    write_line(other)
    with segyio.open(str(other), 'r+', ignore_geometry=True) as file:
        for k in range(T):
            file.header[k].update({segyio.TraceField.HourOfDay: 5})
    for name, options, words in (
        ('tracks.gpx', (), 'is for tracks'), ('x.sgy', (), 'needs --segy'),
        ('x.txt', (), 'ends in none of'), ('x.sgy', ('--segy', other), 'its times are others'),
        ('line.seg', ('--segy', tracked / 'line.seg', '--overwrite'), 'stays as it is'),
        ('x.xyz', (), 'no soundings'),
    ):  # fmt: skip
        assert export(tracked, name, *options) == 2
        error = capsys.readouterr().err
        assert words in error and 'Traceback' not in error
        assert not (tracked / 'x.sgy').exists()


def test_without_places_there_is_a_table_but_no_map(tracked, tmp_path, capsys):
    scene = ('simulate', 'fathometer', tmp_path / 'bag', '--scenario', 'diffuse')
    assert command(*scene, '--set', 'records=4') == 0
    assert command('track', tmp_path / 'bag', tmp_path / 'run') == export(tmp_path, 'h.csv') == 0
    of_line = ('p.sgy', ('--segy', tracked / 'line.seg'), 'does not say how it was made')
    of_map = ('m.csv', ('--epsg', 32615), 'no positions')
    for name, options, words in (('h.geojson', (), 'no positions'), of_map, of_line):
        assert export(tmp_path, name, *options) == 2
        assert words in capsys.readouterr().err


def test_places_by_navigation(tracked, tmp_path, capsys):
    """The same line with its places as metres from an origin in place of fixes."""
    transform = pytest.importorskip('rasterio.warp').transform
    with BagReader(tracked / 'bag') as bag, BagWriter(tmp_path / 'bag') as out:
        places = read_positions(bag)
        for item in bag.messages(['/trace']):
            out.write('/trace', item.message, item.log_ns)
        degrees = places.longitude.tolist(), places.latitude.tolist()
        east, north = map(np.array, transform('EPSG:4326', 'EPSG:32615', *degrees))
        ways = np.column_stack([east - 850_000.0, north - 1_890_000.0, 0.0 * east])
        facts = {'frame_id': 'map', 'child_frame_id': 'boat', 'orientation': (0.0, 0.0, 0.0, 1.0)}
        for stamp, position in zip(places.stamp_ns.tolist(), ways):
            here = Navigation(stamp_ns=stamp, position=position, **facts)
            out.write('/nav', write_navigation(here, ros_message), stamp)
    shutil.copy(tracked / 'bag' / 'parameters.yaml', tmp_path / 'bag')
    run = 'track', tmp_path / 'bag', tmp_path / 'run', '--system', 'fathometer'
    assert command(*run, '--set', 'particles=500') == 0
    capsys.readouterr()
    assert export(tmp_path, 'n.geojson') == 2
    assert '--origin' in capsys.readouterr().err
    where = '--epsg', 32615, '--origin', '850000,1890000'
    assert export(tmp_path, 'n.geojson', *where) == 0
    for landmark in json.loads((tmp_path / 'n.geojson').read_text())['features']:
        longitude, latitude, _ = landmark['geometry']['coordinates']
        assert -91.65 < longitude < -91.63 and latitude == pytest.approx(17.13, abs=1e-5)
