# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of positions relative to a vessel, with its pose, and of range and bearing."""

from attrs import evolve
import numpy as np
import pymap3d
import pytest
import yaml

from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.measurements import Fixes, RelativeFix, VesselFix, VesselHeading, VesselPose
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.tracker import DiverTracker
from sonar_imm_tools.recordings.convert import CsvOptions, KINDS
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

EXACT = {'vessel_heading_std_deg': 0.0, 'vessel_attitude_std_deg': 0.0}
STATED = 'std_range,std_bearing'


@pytest.fixture
def convert(tmp_path):
    def run(text, kind='relative', **options):
        source = tmp_path / 'in.csv'
        source.write_text(text)
        return KINDS[kind](source, tmp_path / 'out', **options)

    return run


def known(report):
    """What the tracker is told beside the bag."""
    file = report.path / 'parameters.yaml'
    return yaml.safe_load(file.read_text())['diver']['ros__parameters'] if file.exists() else {}


def measured(report):
    with BagReader(report.path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver', settings=known(report))]


def tracked(report):
    """The last estimate of the tracker, with what the recording says of its instruments."""
    tracker = DiverTracker(evolve(DiverConfig.from_mapping(known(report)), **EXACT))
    made = [item for measurement in measured(report) for item in tracker.process(measurement)]
    assert not tracker.counts['vessel_pose_gap']
    return made[-1]


# -- range and bearing from the origin -----------------------------------------------------------


@pytest.mark.parametrize(
    'header, bearing, bearings, x_y',
    [
        ('bearing_deg', 90, 'north', (100.0, 0.0)),
        ('Bearing [deg]', 0, 'north', (0.0, 100.0)),
        ('brg_deg', 225, 'north', (-70.7, -70.7)),
        ('bearing_rad', 0.5, 'east', (87.8, 47.9)),
        ('bearing', 300, 'north', (-86.6, 50.0)),
    ],
)
def test_range_and_bearing_become_positions(convert, header, bearing, bearings, x_y):
    text = f'stamp,range,{header},depth\n5,100,{bearing},7\n'
    (fix,) = measured(convert(text, 'fixes', bearings=bearings))
    assert fix.position == pytest.approx([*x_y, -7.0], abs=0.05) and fix.covariance is None


@pytest.mark.parametrize(
    'columns, cells, options',
    [
        (STATED, '0.5,2', {}),
        ('sigma_range,std_bearing_rad', f'0.5,{np.radians(2.0)}', {}),
        ('foo', '', {'range_std': 0.5, 'bearing_std_deg': 2.0}),
        (STATED, ',', {'range_std': 0.5, 'bearing_std_deg': 2.0}),
    ],
)
def test_their_covariance_lies_across_the_line_of_sight(convert, columns, cells, options):
    text = f'stamp,range,bearing_deg,{columns}\n5,200,60,{cells}\n'
    (fix,) = measured(convert(text, 'fixes', **options))
    there = unbiased_polar_to_cartesian(200.0, np.radians(30.0), 0.25, np.radians(2.0) ** 2)
    assert fix.position[:2] == pytest.approx(there[0], abs=1e-6)
    assert fix.covariance[:2, :2] == pytest.approx(there[1], rel=1e-6)


@pytest.mark.parametrize('kind, more', [('fixes', ''), ('relative', ',vessel_x,vessel_y,heading')])
def test_a_bearing_without_a_unit_is_not_guessed(convert, kind, more):
    cells = ',0,0,0' if more else ''
    with pytest.raises(BagError, match='bearing may be degrees or radians'):
        convert(f'stamp,range,bearing{more}\n5,10,1.5{cells}\n6,10,-2{cells}\n', kind)


# -- relative to a vessel ------------------------------------------------------------------------


@pytest.mark.parametrize(
    'columns, cells, options',
    [
        ('heading,forward,starboard', '90,30,10', {}),
        ('heading,range,bearing_deg', f'90,{np.hypot(30, 10)},{np.degrees(np.arctan2(10, 30))}',
         {}),
        ('range,bearing_rad', f'{np.hypot(30, 10)},{-np.arctan2(10, 30)}', {'bearings': 'east'}),
        ('heading,range,bearing_deg',
         f'77,{np.hypot(30, 10)},{90 + np.degrees(np.arctan2(10, 30))}', {'bearings': 'north'}),
    ],
)  # fmt: skip
def test_a_vessel_that_heads_east_sees_what_is_ahead_and_to_starboard(
    convert, columns, cells, options
):
    """30 m ahead of (1000, 500) and 10 m to starboard is (1030, 490)."""
    lines = [f'{k},1000,500,4,0.01,{cells}' for k in (5, 6, 7)]
    text = f'time,vessel_x,ship_north,depth,std,{columns}\n' + '\n'.join(lines) + '\n'
    report = convert(text, options=CsvOptions(), **options)
    assert report.messages == {'/nav': 3, '/relative': 3}
    kinds = [type(item) for item in measured(report)]
    assert kinds == [VesselPose, RelativeFix] * 3
    last = tracked(report)
    assert last.frame_id == 'map' and last.stamp_ns == 7 * 10**9
    assert last.state[0, :2] == pytest.approx([1030.0, 490.0], abs=0.01)


def test_metres_of_a_truth_count_from_a_place_that_is_named(convert, tmp_path):
    (tmp_path / 'truth.csv').write_text('stamp,x,y\n5,1,2\n')
    text = 'stamp,vessel_latitude,vessel_longitude,heading,forward,starboard\n5,59,10,90,10,2\n'
    report = convert(text, truth=tmp_path / 'truth.csv')
    assert 'latitude 59, longitude 10' in report.notes['truth']
    assert report.notes['origin'].startswith('latitude 59.0, longitude 10.0')


def test_a_vessel_by_latitude_and_longitude_is_placed_exactly(convert):
    # Of one fix in a second, a new target is not probable yet: the second place has two.
    lines = ['5,60,10,45,500,0,.01', '6,60,10.18,45,500,0,.01', '7,60,10.18,45,500,0,.01']
    report = convert(
        'time,lat,lon,hdg,fwd,stbd,std\n' + '\n'.join(lines),
        options=CsvOptions(columns={'vessel_latitude': 'lat', 'vessel_longitude': 'lon'}),
    )
    kinds = [type(item) for item in measured(report)]
    assert kinds == [VesselFix, VesselHeading, RelativeFix] * 3
    assert known(report)['origin'][0] == 60.0
    there = pymap3d.enu2geodetic(*(500.0 * np.sqrt([0.5, 0.5, 0.0])), 60.0, 10.18, 0.0)
    expected = pymap3d.geodetic2enu(*there, 60.0, 10.0, 0.0)[:2]
    last = tracked(report)
    assert last.state[np.argmax(last.state[:, 0]), :2] == pytest.approx(expected, abs=0.02)


def test_names_are_tags_and_share_a_pose(convert):
    both = ((20, 'amy'), (50, 'b 2'))
    rows = [f'{k},0,0,0,{x},0,.1,{name}' for k in (5, 6, 7) for x, name in both]
    head = 'time,vessel_x,vessel_y,heading,forward,starboard,std,diver'
    report = convert('\n'.join([head, *rows]))
    assert report.messages == {'/nav': 3, '/relative': 6}
    assert known(report)['tags'] == ['amy', 'b_2']
    last = tracked(report)
    order = np.argsort(last.extras['target_id'])
    assert last.extras['target_id'][order].tolist() == [1, 2]
    assert last.state[order, 1] == pytest.approx([20.0, 50.0], abs=0.1)


# -- scans in which nobody was seen --------------------------------------------------------------


def test_a_row_with_a_time_and_no_position_is_an_empty_scan(convert):
    report = convert('stamp,x,y,std\n5,1,2,.5\n6,,,\n7,3,4,.5\n7,8,9,\n8,nan,NaN,\n', 'fixes')
    assert report.messages == {'/fixes': 4} and not report.bad_rows
    assert report.notes['empty scans'].startswith('2 rows have a time and no position, the first ')
    assert 'in line 3' in report.notes['empty scans']
    scans = measured(report)
    assert all(isinstance(scan, Fixes) for scan in scans)
    assert [len(scan) for scan in scans] == [1, 0, 2, 0]
    assert [scan.target_id for scan in scans] == [None] * 4
    block = scans[2].covariance[1, :2, :2]
    assert np.isnan(block).all() or block.max() > 0.0


def test_empty_scans_end_a_track_and_missing_rows_do_not(convert, tmp_path):
    seen = [f'{k},{k},0,.1' for k in range(1, 11)]
    silent = [f'{k},,,' for k in range(11, 31)]
    ended = tracked(convert('\n'.join(['stamp,x,y,std', *seen, *silent]), 'fixes'))
    assert ended.stamp_ns == 30 * 10**9 and not len(ended)
    (tmp_path / 'out').rename(tmp_path / 'before')
    going = tracked(convert('\n'.join(['stamp,x,y,std', *seen]), 'fixes'))
    assert len(going) == 1


@pytest.mark.parametrize('header', ['stamp,lat,lon', 'stamp,range,bearing_deg'])
def test_every_form_of_position_can_be_empty(convert, header):
    report = convert(f'{header}\n5,,\n6,50,8\n', 'fixes')
    assert [len(scan) for scan in measured(report)] == [0, 1]


def test_a_vessel_that_sees_nobody_says_so(convert):
    report = convert('stamp,vessel_x,vessel_y,heading,forward,starboard\n5,0,0,0,9,0\n6,1,0,0,,\n')
    assert report.messages == {'/fixes': 1, '/nav': 2, '/relative': 1}
    assert tracked(report).stamp_ns == 6 * 10**9


def test_nothing_but_empty_scans_is_an_error(convert):
    with pytest.raises(BagError, match='line 2: x and y are empty'):
        convert('stamp,x,y\n5,,\n6,,\n', 'fixes')
    with pytest.raises(BagError, match='nothing that could be converted'):
        convert('stamp,vessel_x,vessel_y,heading,forward,starboard\n5,0,0,0,,\n')


# -- what cannot be used -------------------------------------------------------------------------

POLAR = 'stamp,range,bearing_deg,std_range,std_bearing'
SHIP = 'stamp,vessel_x,vessel_y,heading,forward,starboard,std,id'
GPS = 'stamp,vessel_lat,vessel_lon,heading,forward,starboard'


@pytest.mark.parametrize(
    'kind, header, good, bad, words',
    [
        ('fixes', 'stamp,x,y', '5,1,2', '6,1,', 'y is empty'),
        ('fixes', 'stamp,x,y,id', '5,1,2,amy', '6,,,amy', 'amy has no position'),
        ('fixes', 'stamp,x,y', '5,1,2', 'soon,,', 'stamp is '),
        ('fixes', POLAR, '5,50,90,1,1', '6,-50,90,1,1', 'a negative distance'),
        ('fixes', POLAR, '5,50,90,1,1', '6,50,90000,1,1', 'more than two turns'),
        ('fixes', POLAR, '5,50,90,1,1', '6,50,,1,1', 'bearing_deg is empty'),
        ('fixes', POLAR, '5,50,90,1,1', '6,50,east,1,1', 'not a number'),
        ('fixes', POLAR, '5,50,90,1,1', '6,inf,90,1,1', 'is infinite'),
        ('fixes', POLAR, '5,50,90,1,1', '6,1e30,90,1,1', ''),
        ('fixes', POLAR, '5,50,90,1,1', '6,50,90,1,100', 'good to 100 degrees only'),
        ('fixes', POLAR, '5,50,90,1,1', '6,50,90,1e30,1', ''),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,,0,0,9,0,.1,', 'vessel_x is empty'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,0,0,,9,0,.1,', 'heading is empty'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,0,0,4000,9,0,.1,', 'heading is 4000 degrees'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,1e12,0,0,9,0,.1,', 'is not on Earth'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,0,0,0,9e9,0,.1,', 'km away'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,0,0,0,,,.1,amy', 'amy has no position'),
        ('relative', SHIP, '5,0,0,0,9,0,.1,', '6,0,0,0,9,0,1e30,', 'the covariance'),
        ('relative', GPS, '5,60,10,0,9,0', '6,95,10,0,9,0', 'is not a position on Earth'),
    ],
)
def test_hostile_rows_cost_a_sentence_each(convert, kind, header, good, bad, words):
    report = convert(f'{header}\n{good}\n{bad}\n', kind)
    assert report.rows == 2 and report.bad_rows == 1
    (problem,) = report.problems
    assert problem.startswith('in.csv, line 3: ') and words in problem and '\n' not in problem


@pytest.mark.parametrize(
    'kind, header, options, words',
    [
        ('fixes', 'stamp,range,bearing_deg,std_range', {}, 'no column for std_bearing'),
        ('fixes', 'stamp,range,bearing_deg', {'bearings': 'bow'}, 'sonar-imm convert relative'),
        ('fixes', 'stamp,range', {}, 'no column for x and y'),
        ('relative', 'stamp,vessel_x,vessel_y,heading', {}, 'no column for range and bearing'),
        ('relative', 'stamp,vessel_x,vessel_y,forward,starboard', {}, 'no column for heading'),
        ('relative', 'stamp,vessel_x,vessel_y,heading,forward,abeam', {}, 'no column for starb'),
        ('relative', 'stamp,heading,forward,starboard', {}, 'no column for vessel_x and vessel_y'),
        ('relative', GPS, {}, 'heading may be degrees or radians'),
        ('relative', GPS.replace('heading', 'heading_deg'), {'origin': (91.0, 0.0)}, 'an origin'),
    ],
)
def test_a_table_that_says_too_little_is_told_what_is_missing(
    convert, kind, header, options, words
):
    with pytest.raises(BagError, match=words):
        convert(f'{header}\n5,1,1,1,1,1\n', kind, **options)
