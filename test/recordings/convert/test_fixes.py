# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import csv
import math

import numpy as np
import pymap3d
import pytest
import yaml

from msg_adapters.estimates import read_estimate
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm_tools.recordings.conversion import MOST_NAMED
from sonar_imm_tools.recordings.convert import (
    ConversionReport,
    convert_fixes,
    convert_truth,
    CsvOptions,
    KINDS,
)
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.truth import difference_velocity, number_names


@pytest.fixture
def convert(tmp_path):
    def run(text, kind='fixes', **options):
        source = tmp_path / 'in.csv'
        source.write_text(text)
        return KINDS[kind](source, tmp_path / 'out', **options)

    return run


def fixes_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver')]


def truth_of(path):
    with BagReader(path) as bag:
        return [read_estimate(item.message) for item in bag.messages(['/truth/estimate'])]


def test_bad_rows_are_named_by_line_and_the_rest_is_converted(convert):
    report = convert('stamp,x,y\n5,1,2\n6,abc,2\n7,1\n8,nan,1\n9,1e12,1\n-1,1,1\n4,3,4\n')
    assert isinstance(report, ConversionReport)
    assert (report.rows, report.bad_rows, report.messages) == (7, 5, {'/fix': 2})
    assert [problem.split(':')[0] for problem in report.problems] == [
        f'in.csv, line {line}' for line in (3, 4, 5, 6, 7)
    ]
    fixes = fixes_of(report.path)
    assert [fix.stamp_ns for fix in fixes] == [4 * 10**9, 5 * 10**9]  # sorted by stamp
    assert fixes[0].position.tolist() == [3.0, 4.0, 0.0] and fixes[0].frame_id == 'map'


def test_rows_that_say_whose_they_are_become_scans_with_identities(convert):
    rows = '5,1,2,cod\n5,3,4,ling\n6,1,3,cod\n6,9,9,cod\n7,3,5,ling\n7,8,8,\n8,1,4,cod\n'
    report = convert('stamp,x,y,name\n' + rows)
    assert report.messages == {'/fixes': 4} and report.notes['id'] == 'cod is 1, ling is 2'
    assert report.problems == ['in.csv, line 5: cod is there at this time']
    scans = fixes_of(report.path)
    assert [scan.target_id.tolist() for scan in scans] == [[1, 2], [1], [2, -1], [1]]
    assert scans[2].position[:, :2].tolist() == [[3.0, 5.0], [8.0, 8.0]]
    assert scans[0].covariance is None


@pytest.mark.parametrize(
    'header, words',
    [
        ('stamp,lat', 'no column for longitude'),
        ('stamp,Longitude', 'no column for latitude'),
        ('stamp,foo', 'nor for latitude and longitude; it has stamp, foo'),
        ('stamp,x', 'no column for y'),
    ],
)
def test_a_table_without_a_position_is_told_what_is_missing(convert, header, words):
    with pytest.raises(BagError, match=words):
        convert(header + '\n5,1\n')


def test_numbers_of_divers_stay_and_numbers_of_rows_name_nobody(convert, tmp_path):
    report = convert('stamp,x,y,id,std\n5,1,2,17,.5\n6,1,2,17,.5\n7,3,4,4,\n8,3,4,4,.5\n')
    scans = fixes_of(report.path)
    assert [scan.target_id.tolist() for scan in scans] == [[17], [17], [4], [4]]
    assert scans[0].covariance[:, :2, :2].tolist() == [[[0.25, 0.0], [0.0, 0.25]]]
    assert scans[2].covariance is None and 'id' not in report.notes
    (tmp_path / 'rows.csv').write_text('stamp,x,y,id\n5,1,2,1\n6,1,2,2\n7,3,4,3\n')
    rows = convert_fixes(tmp_path / 'rows.csv', tmp_path / 'other')
    assert rows.messages == {'/fix': 3} and 'names no diver' in rows.notes['id']


def test_many_bad_rows_are_counted_but_not_all_listed(convert):
    report = convert('stamp,x,y\n5,1,2\n' + 'bad,1,2\n' * 500)
    assert report.bad_rows == 500 and len(report.problems) == MOST_NAMED + 1


def test_nothing_good_is_an_error_and_leaves_no_bag(convert, tmp_path):
    with pytest.raises(BagError, match='line 2'):
        convert('stamp,x,y\nbad,1,2\n')
    with pytest.raises(BagError, match='nothing that could be converted'):
        convert('stamp,x,y\n')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    'header, cells, covariance',
    [
        ('var_x,cov_xy,var_y', '4,1,9', [[4, 1], [1, 9]]),
        ('var_x,var_y', '4,9', [[4, 0], [0, 9]]),
        ('std_x,std_y', '2,3', [[4, 0], [0, 9]]),
        ('accuracy', '3', [[9, 0], [0, 9]]),
        ('sigma_east,sigma_north', '2,3', [[4, 0], [0, 9]]),
        ('std', '', None),
        ('std', '-1', None),
        ('std', '0', None),
        ('var_x,cov_xy,var_y', '-1,0,4', None),
        ('var_x,cov_xy,var_y', '4,,9', None),
        ('foo', '3', None),
    ],
)
def test_uncertainty_in_every_form(convert, header, cells, covariance):
    (fix,) = fixes_of(convert(f'stamp,x,y,{header}\n5,1,2,{cells}\n').path)
    assert (None if fix.covariance is None else fix.covariance[:2, :2].tolist()) == covariance


@pytest.mark.parametrize(
    'header, cells, of_z',
    [
        ('std,depth,std_z', '3,7,0.5', [0, 0, 0.25]),
        ('std,z,sigma_depth', '3,-7,0.5', [0, 0, 0.25]),
        ('std,z,var_z', '3,-7,0.25', [0, 0, 0.25]),
        ('std,z,cov_x_z,cov_y_z,cov_z_z', '3,-7,0.5,-0.25,1', [0.5, -0.25, 1]),
        ('z,std_z', '-7,0.5', [math.nan, math.nan, 0.25]),
        ('std,z,std_z', '3,,0.5', None),
        ('std,z,std_z', '3,-7,', None),
        ('std,z,std_z', '3,-7,-0.5', None),
        ('std,z,cov_x_z,var_z', '3,-7,9,1', None),
    ],
)
def test_the_uncertainty_of_z(convert, tmp_path, header, cells, of_z):
    (fix,) = fixes_of(convert(f'stamp,x,y,{header}\n5,1,2,{cells}\n').path)
    expected = [math.nan] * 3 if of_z is None else of_z
    assert fix.covariance[2] == pytest.approx(expected, nan_ok=True)
    rows = ''.join(f'{second},{second},2,A,{cells}\n' for second in (5, 6))
    (tmp_path / 'named.csv').write_text(f'stamp,x,y,id,{header}\n{rows}')
    scans = fixes_of(convert_fixes(tmp_path / 'named.csv', tmp_path / 'named').path)
    assert scans[0].covariance[0, 2] == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize('cells', ['4,7,9', '1e300,0,1e308', '1e-300,0,1e-300', '1e-300,0,1'])
def test_an_impossible_covariance_is_a_bad_row(convert, cells):
    report = convert(f'stamp,x,y,var_x,cov_xy,var_y\n5,1,2,{cells}\n6,1,2,4,0,9\n')
    assert report.bad_rows == 1 and 'line 2' in report.problems[0]


def test_depth_points_down_and_z_up(convert):
    (fix,) = fixes_of(convert('stamp,x,y,depth\n5,1,2,7\n').path)
    assert fix.position[2] == -7.0


def test_columns_units_and_delimiters_of_other_people(convert):
    report = convert(
        'when;rechts;hoch\n1500,5;1,5;2,5\n',
        frame_id='pool',
        options=CsvOptions(columns={'stamp': 'when', 'x': 'rechts', 'y': 'hoch'}, time_unit='ms'),
    )
    (fix,) = fixes_of(report.path)
    assert fix.stamp_ns == 1_500_500_000 and fix.position[:2].tolist() == [1.5, 2.5]
    assert fix.frame_id == 'pool'


@pytest.mark.parametrize('origin', [None, (50.0, 8.0), (50.0, 8.0, 100.0)])
def test_latitudes_become_metres_around_the_origin(convert, origin):
    report = convert(
        'time,lat,lon,alt\n5,50.001,8.002,90\n6,50.003,8.004,95\n7,91,8,0\n', origin=origin
    )
    first, second = fixes_of(report.path)
    around = origin or (50.001, 8.002)
    around = (*around, 0.0)[:3]
    for fix, place in ((first, (50.001, 8.002, 90.0)), (second, (50.003, 8.004, 95.0))):
        ecef = np.array(pymap3d.geodetic2ecef(*place)) - pymap3d.geodetic2ecef(*around)
        assert np.linalg.norm(fix.position) == pytest.approx(np.linalg.norm(ecef), abs=1e-6)
    offset = second.position - first.position  # north 222 m and east 143 m at 50 degrees
    assert offset[:2] == pytest.approx([143.4, 222.5], abs=0.5)
    assert report.bad_rows == 1 and 'not a position on Earth' in report.problems[0]
    assert f'latitude {around[0]!r}' in report.notes['origin']
    with BagReader(report.path) as bag:
        assert bag.custom_data['origin'] == report.notes['origin']


def test_a_bad_origin_is_explained(convert):
    with pytest.raises(BagError, match='an origin is'):
        convert('time,lat,lon\n5,50,8\n', origin=(91.0, 0.0))


def test_the_same_input_gives_the_same_bag(convert, tmp_path):
    text = 'stamp,x,y\n5,1,2\n6,2,3\n'
    first = {file.name: file.read_bytes() for file in convert(text).path.iterdir()}
    (tmp_path / 'out').rename(tmp_path / 'before')
    second = {file.name: file.read_bytes() for file in convert(text).path.iterdir()}
    assert first == second
    with pytest.raises(BagError, match='exists already'):
        convert(text)


def test_truth_of_several_named_targets(convert):
    report = convert(
        'time,name,x,y\n5,ann,0,0\n6,ann,1,2\n8,ann,5,4\n8,bob,7,7\n8,ann,9,9\n', kind='truth'
    )
    truth = truth_of(report.path)
    assert [estimate.extras['track_id'][0] for estimate in truth] == [1, 1, 1, 2]
    # central differences with uneven steps, by hand: one-sided at the ends, weighted inside
    assert truth[0].extras['vx'][0] == pytest.approx(1.0)
    inside = (1.0 * 2.0 + 2.0 * 1.0) / 3.0
    assert truth[1].extras['vx'][0] == pytest.approx(inside)
    assert truth[2].extras['vy'][0] == pytest.approx(1.0)
    assert np.isnan(truth[3].extras['vx'][0])
    assert report.notes['truth_velocity'] == 'central differences'


def test_a_stated_velocity_is_kept(convert):
    report = convert('time,x,y,vx,vy\n5,0,0,0.1,0.2\n6,9,9,,0.4\n', kind='truth')
    first, second = truth_of(report.path)
    assert first.extras['vx'][0] == 0.1 and np.isnan(second.extras['vx'][0])
    assert report.notes['truth_velocity'] == 'stated' and 'origin' not in report.notes


def test_truth_in_degrees_notes_its_origin(convert):
    report = convert('time,latitude,longitude\n5,54.0,10.0\n6,54.0,10.1\n', kind='truth')
    assert report.notes['origin'] == 'latitude 54.0, longitude 10.0, height 0.0'


def test_difference_velocity_is_exact_for_constant_speed():
    stamps = np.array([0, 10**9, 4 * 10**9, 5 * 10**9]) + 10**18
    seconds = (stamps - stamps[0]) * 1e-9
    velocity = difference_velocity(stamps, np.column_stack([2.0 * seconds, -seconds]))
    assert np.allclose(velocity, [2.0, -1.0])
    assert np.isnan(difference_velocity(stamps[:1], [[1.0, 2.0]])).all()


def test_names_become_numbers():
    assert number_names(['7', '3', '7']) == {'7': 7, '3': 3}
    assert number_names(['b', 'a', 'b']) == {'b': 1, 'a': 2}
    assert number_names(['1', '70000']) == {'1': 1, '70000': 2}
    assert number_names([]) == {}


def test_the_real_fixes_and_truth(real_data, tmp_path):
    folder = real_data / 'yaps_ssu1'
    report = convert_fixes(folder / 'fixes.csv', tmp_path / 'bag', truth=folder / 'gps_truth.csv')
    assert report.messages == {'/fix': 119, '/truth/estimate': 450} and not report.bad_rows
    with (folder / 'fixes.csv').open() as file:
        rows = list(csv.DictReader(file))
    fixes = fixes_of(report.path)
    for row, fix in zip(rows, fixes):
        assert fix.stamp_ns == int(row['stamp_s'].replace('.', '')) * 1000
        assert fix.position[:2].tolist() == [float(row['east_m']), float(row['north_m'])]
        assert fix.covariance[0, 1] == float(row['cov_east_north_m2'])
        assert fix.covariance[1, 1] == float(row['var_north_m2'])
    truth = truth_of(report.path)
    stamp = np.array([estimate.stamp_ns for estimate in truth])
    place = np.array([[estimate.extras['px'][0], estimate.extras['py'][0]] for estimate in truth])
    inside = [fix for fix in fixes if stamp[0] <= fix.stamp_ns <= stamp[-1]]
    error = [
        np.hypot(
            *(
                fix.position[:2]
                - [np.interp(fix.stamp_ns, stamp, place[:, axis]) for axis in (0, 1)]
            )
        )
        for fix in inside
    ]
    assert len(inside) == 116
    assert np.sqrt(np.mean(np.square(error))) == pytest.approx(3.69, abs=0.01)


def test_the_real_truth_alone(real_data, tmp_path):
    report = convert_truth(real_data / 'yaps_ssu1' / 'gps_truth.csv', tmp_path / 'bag')
    speed = [
        np.hypot(estimate.extras['vx'][0], estimate.extras['vy'][0])
        for estimate in truth_of(report.path)
    ]
    assert np.median(speed) == pytest.approx(0.48, abs=0.05)


def test_flagged_rows_are_left_out_and_repeated_ones_are_counted(tmp_path):
    source = tmp_path / 'log.csv'
    lines = ['time,x,y,diver,position_valid']
    for k in range(1, 21):
        place = k - k % 2  # every position is polled twice
        lines.append(f'{k},{place},0,amy,{"false" if k > 16 else "1"}')
        lines.append(f'{k},0,{place},bob,1')
    source.write_text('\n'.join(lines) + '\n')
    report = convert_fixes(source, tmp_path / 'bag')
    assert report.reasons == {'flagged invalid': 4} and report.bad_rows == 4
    assert report.messages == {'/fixes': 20}
    assert report.notes['repeated'].startswith('16 rows hold a position that came before')


def test_a_flag_that_is_neither_is_said(tmp_path):
    source = tmp_path / 'log.csv'
    source.write_text('time,x,y,valid\n1,1,1,\n2,2,2,perhaps\n')
    report = convert_fixes(source, tmp_path / 'bag')
    assert report.messages == {'/fix': 1}
    assert "valid is 'perhaps', neither true nor false" in report.problems[0]


def test_the_origin_of_latitudes_is_told_the_tracker(convert):
    report = convert('time,lat,lon\n1,59.5,10.25\n2,59.50001,10.25\n')
    content = yaml.safe_load((report.path / 'parameters.yaml').read_text())
    assert content['diver']['ros__parameters'] == {'origin': [59.5, 10.25, 0.0]}
    DiverConfig.from_mapping(content['diver']['ros__parameters'])


def test_metres_have_no_parameters(convert):
    assert not (convert('time,x,y\n1,2,3\n').path / 'parameters.yaml').exists()


@pytest.mark.parametrize(
    'truth, words, helps',
    [
        ('time,x,y\n2024-05-31 10:00:00,1,2\n', '--truth-time-zone UTC', {'time_zone': 'UTC'}),
        ('time,a,b\n5,1,2\n', '--truth-column x=HEADER', {'columns': {'x': 'a', 'y': 'b'}}),
        ('time,Lat,Lon\n5,115.1,-33.5\n', "--truth-column 'latitude=Lon'",
         {'columns': {'latitude': 'Lon', 'longitude': 'Lat'}}),
    ],
)  # fmt: skip
def test_advice_about_the_truth_names_the_options_of_the_truth(
    convert, tmp_path, truth, words, helps
):
    path = tmp_path / 'truth.csv'
    path.write_text(truth)
    try:
        said = ' '.join(convert('time,x,y\n5,1,2\n', truth=path).problems)
    except BagError as error:
        said = error.sentence
    assert words in said
    report = KINDS['fixes'](
        tmp_path / 'in.csv', tmp_path / 'helped', truth=path, truth_options=CsvOptions(**helps)
    )
    assert report.messages['/truth/estimate'] == 1 and report.problems == []


@pytest.mark.parametrize(
    'stamp, words',
    [('10:{0:02d}:00', 'whole minutes. If'), ('10:00:{0:02d}', 'whole seconds. If')],
)
def test_rows_that_share_a_stamp_are_said(tmp_path, stamp, words):
    rows = [f'2024-05-31T{stamp.format(k // 10)}Z,{k},{0.5 * k}' for k in range(60)]
    (tmp_path / 'fixes.csv').write_text('\n'.join(['time,x,y', *rows]) + '\n')
    report = convert_fixes(tmp_path / 'fixes.csv', tmp_path / 'bag')
    said = report.notes['shared stamps']
    assert 'up to 10 rows have one stamp' in said and words in said
    one_each = [f'2024-05-31T10:{k:02d}:00Z,{k},1' for k in range(60)]
    (tmp_path / 'fixes.csv').write_text('\n'.join(['time,x,y', *one_each]) + '\n')
    assert 'shared stamps' not in convert_fixes(tmp_path / 'fixes.csv', tmp_path / 'b2').notes
