# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Horizons for other programs: read back by other means than those that wrote them."""

import csv
import json
import shutil
import struct

from helpers.segy_files import write_segy
import numpy as np
import pytest

from msg_adapters.navigation import write_navigation
from sonar_imm.measurements import Navigation
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.convert import convert_segy
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.positions import read_positions
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter

segyio = pytest.importorskip('segyio')
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
    assert main(['track', str(folder / 'bag'), str(folder / 'run'), '--set', 'particles=500']) == 0
    return folder


def export(folder, name, *options):
    return main(['export', str(folder / 'run'), str(folder / name), *map(str, options)])


def estimates(folder):
    with (folder / 'run' / 'estimate.csv').open() as file:
        return [row for row in csv.DictReader(file) if row['depth'] != 'nan']


def test_the_table_has_every_pick_by_horizon(tracked):
    assert export(tracked, 'h.csv') == 0
    with (tracked / 'h.csv').open() as file:
        rows = list(csv.DictReader(file))
    known = estimates(tracked)
    assert len(rows) == len(known) >= 2 * T // STACK
    order = [(int(row['horizon']), int(row['trace'])) for row in rows]
    assert order == sorted(order) and {row['line'] for row in rows} == {'line.seg'}
    by_depth = sorted(float(row['depth_m']) for row in rows)
    assert by_depth == pytest.approx(sorted(float(row['depth']) for row in known), abs=6e-4)
    for row in rows:
        assert float(row['twt_ms']) == pytest.approx(
            2e3 * float(row['depth_m']) / 1500.0, abs=2e-3
        )
        assert row['x'] == '' and float(row['latitude']) == pytest.approx(17.13, abs=1e-5)
        # Forty milliseconds of arc to the east from record to record; the last one comes after
        # the last place, by which it stays, and all others three quarters of a step after theirs.
        step = np.radians(40.0 / 3.6e6) * 6_371_008.8 * np.cos(np.radians(17.13))
        way = step * min(int(row['trace']) - 1, T // STACK - 1.75)
        assert float(row['distance_m']) == pytest.approx(way, abs=0.02)
    assert rows[0]['time_utc'].startswith('2018-03-13T00:00:00.')


@pytest.mark.parametrize('speed', [True, '1500', None, 0.0, 1e5])
def test_a_speed_of_a_run_that_is_none_is_said(tracked, tmp_path, capsys, speed):
    shutil.copytree(tracked / 'run', tmp_path / 'run')
    run = json.loads((tmp_path / 'run' / 'run.json').read_text())
    run['parameters']['sound_speed'] = speed
    (tmp_path / 'run' / 'run.json').write_text(json.dumps(run))
    assert export(tmp_path, 'h.csv') == 2
    assert f'the sound_speed in the run.json of {tmp_path / "run"} is no speed' in (
        capsys.readouterr().err
    )


def test_map_coordinates(tracked):
    pytest.importorskip('rasterio')
    assert export(tracked, 'm.csv', '--epsg', 32615) == 0
    with (tracked / 'm.csv').open() as file:
        row = next(csv.DictReader(file))
    # Zone 15 by the series for the transverse Mercator projection, worked out by hand.
    a, e2, k0 = 6_378_137.0, 0.00669437999014, 0.9996
    lat, dlon = np.radians(17.13), np.radians(float(row['longitude']) + 93.0)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    A = dlon * np.cos(lat)
    east = 500_000.0 + k0 * n * (A + (1.0 - np.tan(lat) ** 2) * A**3 / 6.0)
    assert float(row['x']) == pytest.approx(east, abs=0.5)


def test_points_along_the_track(tracked):
    assert export(tracked, 'h.geojson') == 0
    content = json.loads((tracked / 'h.geojson').read_text())
    assert content['type'] == 'FeatureCollection'
    assert len(content['features']) == len(estimates(tracked))
    for item in content['features']:
        east, north, up = item['geometry']['coordinates']
        assert item['geometry']['type'] == 'Point' and -91.65 < east < -91.63
        assert up == -item['properties']['depth_m'] and north == pytest.approx(17.13, abs=1e-5)


def test_segy_read_by_segyio_and_by_hand(tracked):
    original = tracked / 'line.seg'
    assert export(tracked, 'p.sgy', '--segy', original) == 0
    known = estimates(tracked)
    with segyio.open(str(tracked / 'p.sgy'), ignore_geometry=True) as file:
        picks = file.trace.raw[:]
        cdp = file.attributes(segyio.TraceField.CDP)[:]
    assert list(cdp) == list(500 + np.arange(T)) and picks.shape == (T, N)
    stamps = sorted({row['stamp_ns'] for row in known})
    for record, stamp in enumerate(stamps):
        rows = [row for row in known if row['stamp_ns'] == stamp]
        wanted = {round(float(row['depth']) / SPACING): int(row['track_id']) for row in rows}
        for trace in picks[STACK * record : STACK * record + STACK]:
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


@pytest.mark.parametrize(
    'name, options, words',
    [
        ('tracks.gpx', [], 'is for tracks'),
        ('x.sgy', (), 'needs --segy'),
        ('x.txt', (), 'ends in none of'),
        ('line.seg', ('--segy', 'line.seg', '--overwrite'), 'stays as it is'),
        ('x.sgy', ('--segy', 'other.seg'), 'its times are others'),
        ('x.xyz', (), 'no soundings'),
    ],
)
def test_what_cannot_be_exported_is_one_sentence(tracked, capsys, name, options, words):
    other = tracked / 'other.seg'
    if not other.exists():
        write_line(other)
        with segyio.open(str(other), 'r+', ignore_geometry=True) as file:
            for k in range(T):
                file.header[k].update({segyio.TraceField.HourOfDay: 5})
    options = [tracked / option if str(option).endswith('.seg') else option for option in options]
    assert export(tracked, name, *options) == 2
    error = capsys.readouterr().err
    assert words in error and 'Traceback' not in error
    assert not (tracked / 'x.sgy').exists()


def test_without_places_there_is_a_table_but_no_map(tracked, tmp_path, capsys):
    scene = ('simulate', 'fathometer', str(tmp_path / 'bag'), '--scenario', 'diffuse')
    assert main([*scene, '--set', 'records=4']) == 0
    assert main(['track', str(tmp_path / 'bag'), str(tmp_path / 'run')]) == 0
    assert export(tmp_path, 'h.csv') == 0
    for name, options, words in (
        ('h.geojson', (), 'no positions'),
        ('m.csv', ('--epsg', 32615), 'no positions'),
        ('p.sgy', ('--segy', tracked / 'line.seg'), 'does not say how it was made'),
    ):
        assert export(tmp_path, name, *options) == 2
        assert words in capsys.readouterr().err


def test_places_by_navigation(tracked, tmp_path, capsys):
    """The same line with its places as metres from an origin in place of fixes."""
    transform = pytest.importorskip('rasterio.warp').transform
    with BagReader(tracked / 'bag') as bag, BagWriter(tmp_path / 'bag') as out:
        places = read_positions(bag)
        for item in bag.messages(['/trace']):
            out.write('/trace', item.message, item.log_ns)
        east, north = transform(
            'EPSG:4326', 'EPSG:32615', places.longitude.tolist(), places.latitude.tolist()
        )
        for k, stamp in enumerate(places.stamp_ns.tolist()):
            here = Navigation(
                stamp_ns=stamp,
                frame_id='map',
                child_frame_id='boat',
                position=np.array([east[k] - 850_000.0, north[k] - 1_890_000.0, 0.0]),
                orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            )
            out.write('/nav', write_navigation(here, ros_message), stamp)
    text = (tracked / 'bag' / 'parameters.yaml').read_text()
    (tmp_path / 'bag' / 'parameters.yaml').write_text(text)
    run = 'track', tmp_path / 'bag', tmp_path / 'run', '--system', 'fathometer'
    assert main([*map(str, run), '--set', 'particles=500']) == 0
    capsys.readouterr()
    assert export(tmp_path, 'n.geojson') == 2
    assert '--origin' in capsys.readouterr().err
    where = '--epsg', 32615, '--origin', '850000,1890000'
    assert export(tmp_path, 'n.geojson', *where) == 0
    for landmark in json.loads((tmp_path / 'n.geojson').read_text())['features']:
        longitude, latitude, _ = landmark['geometry']['coordinates']
        assert -91.65 < longitude < -91.63 and latitude == pytest.approx(17.13, abs=1e-5)
