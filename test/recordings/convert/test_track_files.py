# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions in GPX, KML and GeoJSON become what the same positions in a CSV become."""

import json
import struct

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pymap3d
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from sonar_imm_tools.recordings.convert import convert_fixes, convert_truth
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.tables import CsvOptions

ROWS = [
    ('anna', '2024-05-31T10:00:00Z', 54.1, 10.1, -3.0),
    ('anna', '2024-05-31T10:00:05.250Z', 54.1001, 10.1, -3.5),
    ('bert', '2024-05-31T12:00:01+02:00', 54.2, 10.2, -4.0),
    ('bert', '2024-05-31T10:00:06Z', 54.2, 10.2001, -4.0),
]


def csv_text():
    lines = [f'{time},{lat},{lon},{up},{name}' for name, time, lat, lon, up in ROWS]
    return 'time,lat,lon,height,id\n' + '\n'.join(lines)


def gpx_text():
    points = [
        f'<trkpt lat="{lat}" lon="{lon}"><ele>{up}</ele><time>{time}</time></trkpt>'
        for _, time, lat, lon, up in ROWS
    ]
    return (
        '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
        f'<trk><name>anna</name><trkseg>{points[0]}</trkseg><trkseg>{points[1]}</trkseg></trk>'
        f'<trk><name>bert</name><trkseg>{points[2]}{points[3]}</trkseg></trk></gpx>'
    )


def waypoints_text():
    points = [
        f'<wpt lat="{lat}" lon="{lon}"><ele>{up}</ele><time>{time}</time><name>{name}</name></wpt>'
        for name, time, lat, lon, up in ROWS
    ]
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/0">{"".join(points)}</gpx>'


def kml_text():
    tracks = []
    for wanted in ('anna', 'bert'):
        own = [row for row in ROWS if row[0] == wanted]
        whens = ''.join(f'<when>{row[1]}</when>' for row in own)
        coords = ''.join(f'<gx:coord>{row[3]} {row[2]} {row[4]}</gx:coord>' for row in own)
        track = f'<gx:Track>{whens}{coords}</gx:Track>'
        tracks.append(f'<Placemark><name>{wanted}</name>{track}</Placemark>')
    return (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document><name>dive</name>'
        f'{"".join(tracks)}</Document></kml>'
    )


def points_text():
    features = [
        {
            'type': 'Feature',
            'geometry': {'type': 'Point', 'coordinates': [lon, lat, up]},
            'properties': {'time': time, 'id': name, 'note': None},
        }
        for name, time, lat, lon, up in ROWS
    ]
    return json.dumps({'type': 'FeatureCollection', 'features': features})


def lines_text():
    features = []
    for wanted in ('anna', 'bert'):
        own = [row for row in ROWS if row[0] == wanted]
        places = {'type': 'LineString', 'coordinates': [[r[3], r[2], r[4]] for r in own]}
        known = {'coordTimes': [row[1] for row in own], 'id': wanted}
        features.append({'type': 'Feature', 'geometry': places, 'properties': known})
    return json.dumps({'features': features, 'type': 'FeatureCollection'})


def fixes_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver')]


TEXTS = {
    'a.gpx': gpx_text,
    'b.gpx': waypoints_text,
    'c.kml': kml_text,
    'd.geojson': points_text,
    'e.json': lines_text,
}


@pytest.mark.parametrize('name', TEXTS)
def test_a_file_gives_the_fixes_of_a_csv(tmp_path, name):
    found = []
    for file, text in ((name, TEXTS[name]()), ('same.csv', csv_text())):
        (tmp_path / file).write_text(text)
        report = convert_fixes(tmp_path / file, tmp_path / f'{file}.bag', origin=(54.1, 10.1))
        assert report.bad_rows == 0 and report.notes['id'] == 'anna is 1, bert is 2'
        found.append(fixes_of(report.path))
    for first, other in zip(*found, strict=True):
        assert first.stamp_ns == other.stamp_ns
        assert first.position.tolist() == other.position.tolist()
        assert list(first.target_id) == list(other.target_id)


def test_truth_and_ignored_columns(tmp_path):
    (tmp_path / 'a.gpx').write_text(gpx_text())
    assert convert_truth(tmp_path / 'a.gpx', tmp_path / 'truth').messages == {'/truth/estimate': 4}
    options = CsvOptions(ignore=['id'])
    report = convert_fixes(tmp_path / 'a.gpx', tmp_path / 'out', options=options)
    assert report.messages == {'/fix': 4} and 'id' in report.notes['ignored columns of a.gpx']


@pytest.mark.parametrize(
    'text, wanted',
    [
        ('<gpx><trk><trkseg><trkpt lat="1" lon="2">', 'damaged GPX'),
        ('<gpx></gpx>', 'without a position'),
        ('{"type": "FeatureCollection", "features": [', 'damaged JSON'),
        ('{"type": "FeatureCollection", "features": [7, {"geometry": 3}]}', 'without a position'),
        ('<gpx><wpt lat="54" lon="10"></wpt></gpx>', 'nothing that could be converted'),
        (
            '<gpx><wpt lat="154" lon="10"><time>2024-05-31T10:00:00Z</time></wpt></gpx>',
            'look exchanged',
        ),
        (
            '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
            '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><gpx><wpt lat="1" lon="1">'
            '<name>&c;</name></wpt></gpx>',
            'GPX',
        ),
    ],
)
def test_damage_is_one_sentence(tmp_path, text, wanted):
    (tmp_path / 'a.gpx').write_text(text)
    with pytest.raises(BagError, match=wanted):
        convert_fixes(tmp_path / 'a.gpx', tmp_path / 'out')


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(list(TEXTS)), st.integers(0, 700), st.binary(max_size=3), st.integers(0, 9))
def test_hostile_bytes_are_no_tracebacks(tmp_path_factory, name, place, written, cut):
    folder = tmp_path_factory.mktemp('track')
    content = TEXTS[name]().encode()
    content = content[:place] + written + content[place + cut :]
    (folder / name).write_bytes(content)
    try:
        report = convert_fixes(folder / name, folder / 'out')
    except BagError as error:
        assert '\n' not in str(error)
    else:
        assert all(np.isfinite(fix.position).all() for fix in fixes_of(report.path))


def test_the_commonest_problem_is_named_and_its_advice_helps(tmp_path):
    """A waypoint without a time does not hide a track whose times state no zone."""
    point = '<trkpt lat="59.4" lon="10.{:03d}"><time>2021-01-01T00:00:{:02d}</time></trkpt>'
    track = ''.join(point.format(k, k) for k in range(50))
    path = tmp_path / 'a.gpx'
    path.write_text(f'<gpx><wpt lat="59.4" lon="10.4"/><trk>{track}</trk></gpx>')
    with pytest.raises(BagError, match='50 of 51 rows, .*--time-zone'):
        convert_fixes(path, tmp_path / 'out')
    report = convert_fixes(path, tmp_path / 'out', options=CsvOptions(time_zone='UTC'))
    assert report.messages == {'/fix': 50}


def in_metres(name, count=30):
    """GeoJSON of points in a map projection, and their latitudes and longitudes."""
    east, north = 500_000.0 + 10.0 * np.arange(count), 5_983_000.0 + 7.0 * np.arange(count)
    features = [
        {
            'type': 'Feature',
            'properties': {'time': f'2024-05-31T10:00:{k:02d}Z'},
            'geometry': {'type': 'Point', 'coordinates': [east[k], north[k]]},
        }
        for k in range(count)
    ]
    crs = {'type': 'name', 'properties': {'name': name}}
    # Near the central meridian: the arc of the ellipsoid along it, and the circle across it.
    axis, squared, scale = 6378137.0, 0.00669438, 0.9996

    def radius(phi, power):
        return axis / (1.0 - squared * np.sin(phi) ** 2) ** power

    def arc(phi):
        return scale * quad(lambda part: (1.0 - squared) * radius(part, 1.5), 0.0, phi)[0]

    phi = np.array([brentq(lambda part, at=at: arc(part) - at, 0.9, 1.0) for at in north])
    latitude = np.degrees(phi)
    longitude = 9.0 + np.degrees((east - 500_000.0) / (scale * radius(phi, 0.5) * np.cos(phi)))
    return {'type': 'FeatureCollection', 'crs': crs, 'features': features}, latitude, longitude


@pytest.mark.parametrize('cut', [False, True])
@pytest.mark.parametrize('name', ['urn:ogc:def:crs:EPSG::25832', 'EPSG:32632'])
def test_geojson_in_a_map_projection(tmp_path, name, cut):
    whole, latitude, longitude = in_metres(name)
    text = json.dumps(whole)
    (tmp_path / 'dive.geojson').write_text(text[:-20] if cut else text)
    origin = float(latitude[0]), float(longitude[0])
    report = convert_fixes(tmp_path / 'dive.geojson', tmp_path / 'bag', origin=origin)
    with BagReader(report.path) as bag:
        fixes = [item.measurement for item in measurements_of(bag, 'diver', {'/fix': 'fix'})]
    expected = pymap3d.geodetic2enu(latitude, longitude, 0.0, *origin, 0.0)
    places = np.array([fix.position[:2] for fix in fixes])
    assert len(places) == 30 - cut
    assert places == pytest.approx(np.transpose(expected)[: 30 - cut, :2], abs=0.01)


def test_geojson_in_a_system_that_is_not_known_is_one_sentence(tmp_path):
    whole, _, _ = in_metres('our own grid')
    (tmp_path / 'dive.geojson').write_text(json.dumps(whole))
    with pytest.raises(BagError, match="'our own grid', which is not known"):
        convert_fixes(tmp_path / 'dive.geojson', tmp_path / 'bag')


@pytest.mark.parametrize('name, layer', [('a.gpx', 'track_points'), ('d.geojson', None)])
def test_gdal_reads_the_same_places(tmp_path, name, layer):
    pyogrio = pytest.importorskip('pyogrio')
    path = tmp_path / name
    path.write_text(TEXTS[name]())
    _, _, geometry, _ = pyogrio.raw.read(path, layer=layer)
    there = np.array([struct.unpack('<2d', each[5:21]) for each in geometry])
    report = convert_truth(path, tmp_path / 'truth', origin=(54.0, 10.0))
    assert report.rows == len(there) == 4
    report = convert_fixes(path, tmp_path / 'bag', origin=(54.0, 10.0))
    places = np.concatenate([scan.position[:, :2] for scan in fixes_of(report.path)])
    wanted = np.transpose(pymap3d.geodetic2enu(*there.T[::-1], 0.0, 54.0, 10.0, 0.0))[:, :2]
    # As high as they are, they lie a little nearer.
    assert sorted(places.tolist()) == pytest.approx(np.array(sorted(wanted.tolist())), abs=0.05)
