# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import csv
import json
import math

from helpers.field_files import measured, truth_of
import numpy as np
import pymap3d
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
import yaml

from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm_tools.recordings.conversion import MOST_NAMED
from sonar_imm_tools.recordings.convert import convert_fixes, convert_truth, CsvOptions
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.truth import difference_velocity, number_names


def test_bad_rows_are_named_by_line_and_the_rest_is_converted(convert):
    report = convert('stamp,x,y\n5,1,2\n6,abc,2\n7,1\n8,nan,1\n9,1e12,1\n-1,1,1\n4,3,4\n')
    assert (report.rows, report.bad_rows, report.messages) == (7, 5, {'/fix': 2})
    bad = [f'in.csv, line {line}' for line in (3, 4, 5, 6, 7)]
    assert [problem.split(':')[0] for problem in report.problems] == bad
    fixes = measured(report.path)
    assert [fix.stamp_ns for fix in fixes] == [4 * 10**9, 5 * 10**9]  # sorted by stamp
    assert fixes[0].position.tolist() == [3.0, 4.0, 0.0] and fixes[0].frame_id == 'map'
    # Many are not all listed.
    report = convert('stamp,x,y\n5,1,2\n' + 'bad,1,2\n' * 500, out='many')
    assert report.bad_rows == 500 and len(report.problems) == MOST_NAMED + 1


def test_rows_that_say_whose_they_are_become_scans_with_identities(convert):
    rows = '5,1,2,cod\n5,3,4,ling\n6,1,3,cod\n6,9,9,cod\n7,3,5,ling\n7,8,8,\n8,1,4,cod\n'
    report = convert('stamp,x,y,name\n' + rows)
    assert report.messages == {'/fixes': 4} and report.notes['id'] == 'cod is 1, ling is 2'
    assert report.problems == ['in.csv, line 5: cod is there at this time']
    scans = measured(report.path)
    assert [scan.target_id.tolist() for scan in scans] == [[1, 2], [1], [2, -1], [1]]
    assert scans[2].position[:, :2].tolist() == [[3.0, 5.0], [8.0, 8.0]]
    assert scans[0].covariance is None


def test_a_table_without_a_position_is_told_what_is_missing(convert, tmp_path):
    for text, words in (
        ('stamp,lat\n5,1', 'no column for longitude'), ('stamp,x\n5,1', 'no column for y'),
        ('stamp,foo\n5,1', 'nor for latitude and longitude; it has stamp, foo'),
        ('stamp,x,y\nbad,1,2', 'line 2'), ('stamp,x,y', 'nothing that could be converted'),
    ):  # fmt: skip
        with pytest.raises(BagError, match=words):
            convert(text + '\n')
        assert not (tmp_path / 'out').exists()


def test_numbers_of_divers_stay_and_numbers_of_rows_name_nobody(convert):
    report = convert('stamp,x,y,id,std\n5,1,2,17,.5\n6,1,2,17,.5\n7,3,4,4,\n8,3,4,4,.5\n')
    scans = measured(report.path)
    assert [scan.target_id.tolist() for scan in scans] == [[17], [17], [4], [4]]
    assert scans[0].covariance[:, :2, :2].tolist() == [[[0.25, 0.0], [0.0, 0.25]]]
    assert scans[2].covariance is None and 'id' not in report.notes
    rows = convert('stamp,x,y,id\n5,1,2,1\n6,1,2,2\n7,3,4,3\n', out='other')
    assert rows.messages == {'/fix': 3} and 'names no diver' in rows.notes['id']


def test_uncertainty_in_every_form(convert):
    whole, flat = 'var_x,cov_xy,var_y', [[4, 0], [0, 9]]
    for k, (header, cells, covariance) in enumerate((
        (whole, '4,1,9', [[4, 1], [1, 9]]), ('var_x,var_y', '4,9', flat),
        ('std_x,std_y', '2,3', flat), ('accuracy', '3', [[9, 0], [0, 9]]),
        ('sigma_east,sigma_north', '2,3', flat), ('std', '', None), ('std', '-1', None),
        ('std', '0', None), ('foo', '3', None), (whole, '-1,0,4', None), (whole, '4,,9', None),
    )):  # fmt: skip
        (fix,) = measured(convert(f'stamp,x,y,{header}\n5,1,2,{cells}\n', out=f'{k}').path)
        assert (None if fix.covariance is None else fix.covariance[:2, :2].tolist()) == covariance


NAN = math.nan


def test_the_uncertainty_of_z(convert):
    for k, (header, cells, of_z) in enumerate((
        ('std,depth,std_z', '3,7,0.5', [0, 0, 0.25]), ('z,std_z', '-7,0.5', [NAN, NAN, 0.25]),
        ('std,z,sigma_depth', '3,-7,0.5', [0, 0, 0.25]), ('std,z,std_z', '3,,0.5', [NAN] * 3),
        ('std,z,var_z', '3,-7,0.25', [0, 0, 0.25]), ('std,z,std_z', '3,-7,', [NAN] * 3),
        ('std,z,cov_x_z,cov_y_z,cov_z_z', '3,-7,0.5,-0.25,1', [0.5, -0.25, 1]),
        ('std,z,std_z', '3,-7,-0.5', [NAN] * 3), ('std,z,cov_x_z,var_z', '3,-7,9,1', [NAN] * 3),
    )):  # fmt: skip
        (fix,) = measured(convert(f'stamp,x,y,{header}\n5,1,2,{cells}\n', out=f'{k}').path)
        assert fix.covariance[2] == pytest.approx(of_z, nan_ok=True)
        rows = ''.join(f'{second},{second},2,A,{cells}\n' for second in (5, 6))
        scans = measured(convert(f'stamp,x,y,id,{header}\n{rows}', out=f'named{k}').path)
        assert scans[0].covariance[0, 2] == pytest.approx(of_z, nan_ok=True)


def test_an_impossible_covariance_is_a_bad_row(convert):
    bad = ['4,7,9', '1e300,0,1e308', '1e-300,0,1e-300', '1e-300,0,1']
    rows = [f'5,1,2,{cells}' for cells in [*bad, '4,0,9']]
    report = convert('\n'.join(['stamp,x,y,var_x,cov_xy,var_y', *rows]))
    assert report.bad_rows == 4 and report.messages == {'/fix': 1}
    assert all(f'line {k}' in problem for k, problem in enumerate(report.problems, start=2))


def test_columns_units_and_delimiters_of_other_people(convert):
    columns = {'stamp': 'when', 'x': 'rechts', 'y': 'hoch'}
    how = {'frame_id': 'pool', 'options': CsvOptions(columns=columns, time_unit='ms')}
    (fix,) = measured(convert('when;rechts;hoch;depth\n1500,5;1,5;2,5;7\n', **how).path)
    assert fix.stamp_ns == 1_500_500_000 and fix.position.tolist() == [1.5, 2.5, -7.0]
    assert fix.frame_id == 'pool'


@pytest.mark.parametrize('origin', [None, (50.0, 8.0), (50.0, 8.0, 100.0)])
def test_latitudes_become_metres_around_the_origin(convert, origin):
    with pytest.raises(BagError, match='an origin is'):
        convert('time,lat,lon\n5,50,8\n', origin=(91.0, 0.0))
    text = 'time,lat,lon,alt\n5,50.001,8.002,90\n6,50.003,8.004,95\n7,91,8,0\n'
    report = convert(text, origin=origin)
    first, second = measured(report.path)
    around = (*(origin or (50.001, 8.002)), 0.0)[:3]
    for fix, place in ((first, (50.001, 8.002, 90.0)), (second, (50.003, 8.004, 95.0))):
        ecef = np.array(pymap3d.geodetic2ecef(*place)) - pymap3d.geodetic2ecef(*around)
        assert np.linalg.norm(fix.position) == pytest.approx(np.linalg.norm(ecef), abs=1e-6)
    offset = second.position - first.position  # north 222 m and east 143 m at 50 degrees
    assert offset[:2] == pytest.approx([143.4, 222.5], abs=0.5)
    assert report.bad_rows == 1 and 'not a position on Earth' in report.problems[0]
    assert f'latitude {around[0]!r}' in report.notes['origin']
    with BagReader(report.path) as bag:
        assert bag.custom_data['origin'] == report.notes['origin']
    # The tracker is told it.
    (told,) = yaml.safe_load((report.path / 'parameters.yaml').read_text()).values()
    assert DiverConfig.from_mapping(told['ros__parameters']).origin == around


def test_truth_of_several_named_targets(convert):
    report = convert(
        'time,name,x,y\n5,ann,0,0\n6,ann,1,2\n8,ann,5,4\n8,bob,7,7\n8,ann,9,9\n', kind='truth'
    )
    truth = [estimate.extras for estimate in truth_of(report.path)]
    assert [extras['track_id'][0] for extras in truth] == [1, 1, 1, 2]
    # central differences with uneven steps, by hand: one-sided at the ends, weighted inside
    inside = (1.0 * 2.0 + 2.0 * 1.0) / 3.0
    assert [extras['vx'][0] for extras in truth[:2]] == pytest.approx([1.0, inside])
    assert truth[2]['vy'][0] == pytest.approx(1.0) and np.isnan(truth[3]['vx'][0])
    assert report.notes['truth_velocity'] == 'central differences'
    # A stated one is kept.
    report = convert('time,latitude,longitude\n5,54.0,10.0\n6,54.0,10.1\n', 'truth', 'degrees')
    assert report.notes['origin'] == 'latitude 54.0, longitude 10.0, height 0.0'
    report = convert('time,x,y,vx,vy\n5,0,0,0.1,0.2\n6,9,9,,0.4\n', 'truth', 'stated')
    first, second = truth_of(report.path)
    assert first.extras['vx'][0] == 0.1 and np.isnan(second.extras['vx'][0])
    assert report.notes['truth_velocity'] == 'stated' and 'origin' not in report.notes


def test_velocity_is_exact_for_constant_speed_and_names_become_numbers():
    seconds = np.array([0, 1, 4, 5])
    stamps = seconds * 10**9 + 10**18
    velocity = difference_velocity(stamps, np.column_stack([2.0 * seconds, -seconds]))
    assert np.allclose(velocity, [2.0, -1.0])
    assert np.isnan(difference_velocity(stamps[:1], [[1.0, 2.0]])).all()
    assert number_names(['7', '3', '7']) == {'7': 7, '3': 3} and number_names([]) == {}
    assert number_names(['b', 'a', 'b']) == {'b': 1, 'a': 2}
    assert number_names(['1', '70000']) == {'1': 1, '70000': 2}


def test_the_real_fixes_and_truth(real_data, tmp_path):
    folder = real_data / 'yaps_ssu1'
    report = convert_fixes(folder / 'fixes.csv', tmp_path / 'bag', truth=folder / 'gps_truth.csv')
    assert report.messages == {'/fix': 119, '/truth/estimate': 450} and not report.bad_rows
    with (folder / 'fixes.csv').open() as file:
        rows = list(csv.DictReader(file))
    fixes = measured(report.path)
    for row, fix in zip(rows, fixes):
        assert fix.stamp_ns == int(row['stamp_s'].replace('.', '')) * 1000
        assert fix.position[:2].tolist() == [float(row['east_m']), float(row['north_m'])]
        stated = [float(row['cov_east_north_m2']), float(row['var_north_m2'])]
        assert fix.covariance[1, :2].tolist() == stated
    truth = truth_of(report.path)
    stamp = np.array([estimate.stamp_ns for estimate in truth])
    inside = [fix for fix in fixes if stamp[0] <= fix.stamp_ns <= stamp[-1]]
    at = [fix.stamp_ns for fix in inside]
    true = [np.interp(at, stamp, [each.extras[n][0] for each in truth]) for n in ('px', 'py')]
    error = np.array([fix.position[:2] for fix in inside]) - np.transpose(true)
    assert len(inside) == 116
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(3.69, abs=0.01)
    alone = truth_of(convert_truth(folder / 'gps_truth.csv', tmp_path / 'alone').path)
    speed = [np.hypot(each.extras['vx'][0], each.extras['vy'][0]) for each in alone]
    assert np.median(speed) == pytest.approx(0.48, abs=0.05)


def test_flagged_rows_are_left_out_and_repeated_ones_are_counted(convert):
    lines = ['time,x,y,diver,position_valid']
    for k in range(1, 21):
        place = k - k % 2  # every position is polled twice
        lines.append(f'{k},{place},0,amy,{"false" if k > 16 else "1"}')
        lines.append(f'{k},0,{place},bob,1')
    report = convert('\n'.join([*lines, '21,2,2,amy,perhaps']) + '\n')
    assert report.reasons['flagged invalid'] == 4 and report.bad_rows == 5
    assert "position_valid is 'perhaps', neither true nor false" in report.problems[-1]
    assert report.messages == {'/fixes': 20}
    assert report.notes['repeated'].startswith('16 rows hold a position that came before')


def test_metres_have_no_parameters_and_the_same_input_gives_the_same_bag(convert, tmp_path):
    def content(folder):
        bag = convert('stamp,x,y\n5,1,2\n6,2,3\n', out=f'{folder}/bag').path
        return {file.name: file.read_bytes() for file in bag.iterdir()}

    first = content('one')
    assert first == content('two') and 'parameters.yaml' not in first
    with pytest.raises(BagError, match='exists already'):
        content('one')


def test_advice_about_the_truth_names_the_options_of_the_truth(convert, tmp_path):
    path, text = tmp_path / 'truth.csv', 'time,x,y\n5,1,2\n'
    for k, (truth, words, helps) in enumerate((
        ('x,y\n2024-05-31 10:00:00,1,2', '--truth-time-zone UTC', {'time_zone': 'UTC'}),
        ('a,b\n5,1,2', '--truth-column x=HEADER', {'columns': {'x': 'a', 'y': 'b'}}),
        ('Lat,Lon\n5,115.1,-33.5', "--truth-column 'latitude=Lon'",
         {'columns': {'latitude': 'Lon', 'longitude': 'Lat'}}),
    )):  # fmt: skip
        path.write_text(f'time,{truth}\n')
        try:
            said = ' '.join(convert(text, out=f'{k}', truth=path).problems)
        except BagError as error:
            said = error.sentence
        assert words in said
        report = convert(text, out=f'helped{k}', truth=path, truth_options=CsvOptions(**helps))
        assert report.messages['/truth/estimate'] == 1 and report.problems == []


def test_rows_that_share_a_stamp_are_said(convert):
    for stamp, words in (('10:{0:02d}:00', 'minutes'), ('10:00:{0:02d}', 'seconds')):
        rows = [f'2024-05-31T{stamp.format(k // 10)}Z,{k},{0.5 * k}' for k in range(60)]
        said = convert('\n'.join(['time,x,y', *rows]), out=words).notes['shared stamps']
        assert 'up to 10 rows have one stamp' in said and f'whole {words}. If' in said
    rows = [f'2024-05-31T10:{k:02d}:00Z,{k},1' for k in range(60)]
    assert 'shared stamps' not in convert('\n'.join(['time,x,y', *rows])).notes


# -- positions in GPX, KML and GeoJSON become what the same positions in a CSV become


ROWS = [
    ('anna', '2024-05-31T10:00:00Z', 54.1, 10.1, -3.0),
    ('anna', '2024-05-31T10:00:05.250Z', 54.1001, 10.1, -3.5),
    ('bert', '2024-05-31T12:00:01+02:00', 54.2, 10.2, -4.0),
    ('bert', '2024-05-31T10:00:06Z', 54.2, 10.2001, -4.0),
]


def csv_text():
    lines = [f'{time},{lat},{lon},{up},{name}' for name, time, lat, lon, up in ROWS]
    return 'time,lat,lon,height,id\n' + '\n'.join(lines)


def of_each(write):
    """Of the name and the rows of each diver."""
    return [write(name, [r for r in ROWS if r[0] == name]) for name in ('anna', 'bert')]


def gpx_points(tag, more=''):
    point = '<{0} lat="{3}" lon="{4}"><ele>{5}</ele><time>{2}</time>' + more + '</{0}>'
    return [point.format(tag, *row) for row in ROWS]


def gpx_text():
    points = gpx_points('trkpt')
    return (
        '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
        f'<trk><name>anna</name><trkseg>{points[0]}</trkseg><trkseg>{points[1]}</trkseg></trk>'
        f'<trk><name>bert</name><trkseg>{points[2]}{points[3]}</trkseg></trk></gpx>'
    )


def waypoints_text():
    points = ''.join(gpx_points('wpt', '<name>{1}</name>'))
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/0">{points}</gpx>'


def kml_text():
    def track(name, own):
        whens = ''.join(f'<when>{row[1]}</when>' for row in own)
        coords = ''.join(f'<gx:coord>{row[3]} {row[2]} {row[4]}</gx:coord>' for row in own)
        track = f'<gx:Track>{whens}{coords}</gx:Track>'
        return f'<Placemark><name>{name}</name>{track}</Placemark>'

    return (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2" '
        'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document><name>dive</name>'
        f'{"".join(of_each(track))}</Document></kml>'
    )


def feature(kind, coordinates, **properties):
    shape = {'type': kind, 'coordinates': coordinates}
    return {'type': 'Feature', 'geometry': shape, 'properties': properties}


def geojson_text(*features):
    return json.dumps({'features': features, 'type': 'FeatureCollection'})


def of_line(name, own):
    times = [row[1] for row in own]
    return feature('LineString', [[r[3], r[2], r[4]] for r in own], coordTimes=times, id=name)


def of_point(name, time, lat, lon, up):
    return feature('Point', [lon, lat, up], time=time, id=name, note=None)


TEXTS = {
    'a.gpx': gpx_text(), 'b.gpx': waypoints_text(), 'c.kml': kml_text(),
    'd.geojson': geojson_text(*(of_point(*row) for row in ROWS)),
    'e.json': geojson_text(*of_each(of_line)),
}  # fmt: skip


@pytest.mark.parametrize('name', TEXTS)
def test_a_file_gives_the_fixes_of_a_csv(tmp_path, name):
    found = []
    for file, text in ((name, TEXTS[name]), ('same.csv', csv_text())):
        (tmp_path / file).write_text(text)
        report = convert_fixes(tmp_path / file, tmp_path / f'{file}.bag', origin=(54.1, 10.1))
        assert report.bad_rows == 0 and report.notes['id'] == 'anna is 1, bert is 2'
        found.append(measured(report.path))
    for first, other in zip(*found, strict=True):
        assert first.stamp_ns == other.stamp_ns
        assert first.position.tolist() == other.position.tolist()
        assert list(first.target_id) == list(other.target_id)
    how = CsvOptions(ignore=['id'])
    report = convert_fixes(tmp_path / name, tmp_path / 'out', options=how)
    assert report.messages == {'/fix': 4} and 'id' in report.notes[f'ignored columns of {name}']


def test_damage_is_one_sentence(tmp_path):
    entities = f'<!ENTITY b "{10 * "&a;"}"><!ENTITY c "{10 * "&b;"}">'
    point = '<wpt lat="1" lon="1"><name>&c;</name></wpt>'
    shapes = '{"geometry": 3}, {"geometry": {"type": "Polygon"}}'
    for text, wanted in (
        ('<gpx><trk><trkseg><trkpt lat="1" lon="2">', 'damaged GPX'),
        ('<gpx></gpx>', 'without a position'),
        ('{"type": "FeatureCollection", "features": [', 'damaged JSON'),
        (f'{{"type": "FeatureCollection", "features": [7, {shapes}]}}', 'without a position'),
        ('<gpx><wpt lat="54" lon="10"></wpt></gpx>', 'nothing that could be converted'),
        ('<gpx><wpt lat="154" lon="10"><time>2024-05-31T10:00:00Z</time></wpt></gpx>', 'exchange'),
        (f'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">{entities}]><gpx>{point}</gpx>', 'GPX'),
    ):
        (tmp_path / 'a.gpx').write_text(text)
        with pytest.raises(BagError, match=wanted):
            convert_fixes(tmp_path / 'a.gpx', tmp_path / 'out')


def in_metres(name, count=30):
    """GeoJSON of points in a map projection, and their latitudes and longitudes."""
    east, north = 500_000.0 + 10.0 * np.arange(count), 5_983_000.0 + 7.0 * np.arange(count)
    times = [f'2024-05-31T10:00:{k:02d}Z' for k in range(count)]
    features = [feature('Point', [*at], time=time) for *at, time in zip(east, north, times)]
    crs = {'type': 'name', 'properties': {'name': name}}
    # Near the central meridian: the arc of the ellipsoid along it, and the circle across it.
    axis, squared, scale = 6378137.0, 0.00669438, 0.9996

    def radius(phi, power):
        return axis / (1.0 - squared * np.sin(phi) ** 2) ** power

    def arc(phi):
        return scale * quad(lambda part: (1.0 - squared) * radius(part, 1.5), 0.0, phi)[0]

    phi = np.array([brentq(lambda part, at=at: arc(part) - at, 0.9, 1.0) for at in north])
    longitude = 9.0 + np.degrees((east - 500_000.0) / (scale * radius(phi, 0.5) * np.cos(phi)))
    whole = {'type': 'FeatureCollection', 'crs': crs, 'features': features}
    return whole, np.degrees(phi), longitude


def test_geojson_in_a_map_projection(tmp_path):
    for name, cut in (('urn:ogc:def:crs:EPSG::25832', False), ('EPSG:32632', True)):
        whole, latitude, longitude = in_metres(name)
        text, path = json.dumps(whole), tmp_path / f'{cut}.geojson'
        path.write_text(text[:-20] if cut else text)
        origin = float(latitude[0]), float(longitude[0])
        fixes = measured(convert_fixes(path, tmp_path / f'{cut}', origin=origin).path)
        expected = pymap3d.geodetic2enu(latitude, longitude, 0.0, *origin, 0.0)
        places = np.array([fix.position[:2] for fix in fixes])
        assert len(places) == 30 - cut
        assert places == pytest.approx(np.transpose(expected)[: 30 - cut, :2], abs=0.01)
    path.write_text(json.dumps(in_metres('our own grid')[0]))
    with pytest.raises(BagError, match="'our own grid', which is not known"):
        convert_fixes(path, tmp_path / 'bag')
