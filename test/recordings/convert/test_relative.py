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
from sonar_imm_tools.recordings.convert import CsvOptions
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

EXACT = {'vessel_heading_std_deg': 0.0, 'vessel_attitude_std_deg': 0.0}
STATED = 'std_range,std_bearing'
POLAR = f'stamp,range,bearing_deg,{STATED}'
SHIP = 'stamp,vessel_x,vessel_y,heading,forward,starboard,std,id'
GPS = 'stamp,vessel_lat,vessel_lon,heading,forward,starboard'


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


def test_range_and_bearing_become_positions(convert):
    for header, bearing, bearings, x_y in (
        ('bearing_deg', 90, 'north', (100.0, 0.0)), ('Bearing [deg]', 0, 'north', (0.0, 100.0)),
        ('brg_deg', 225, 'north', (-70.7, -70.7)), ('bearing_rad', 0.5, 'east', (87.8, 47.9)),
        ('bearing', 300, 'north', (-86.6, 50.0)),
    ):  # fmt: skip
        text = f'stamp,range,{header},depth\n5,100,{bearing},7\n'
        (fix,) = measured(convert(text, 'fixes', header, bearings=bearings))
        assert fix.position == pytest.approx([*x_y, -7.0], abs=0.05) and fix.covariance is None


def test_their_covariance_lies_across_the_line_of_sight(convert):
    there = unbiased_polar_to_cartesian(200.0, np.radians(30.0), 0.25, np.radians(2.0) ** 2)
    told = {'range_std': 0.5, 'bearing_std_deg': 2.0}
    for k, (columns, cells, options) in enumerate((
        (STATED, '0.5,2', {}), ('sigma_range,std_bearing_rad', f'0.5,{np.radians(2.0)}', {}),
        ('foo', '', told), (STATED, ',', told),
    )):  # fmt: skip
        text = f'stamp,range,bearing_deg,{columns}\n5,200,60,{cells}\n'
        (fix,) = measured(convert(text, 'fixes', f'{k}', **options))
        assert fix.position[:2] == pytest.approx(there[0], abs=1e-6)
        assert fix.covariance[:2, :2] == pytest.approx(there[1], rel=1e-6)


# -- relative to a vessel ------------------------------------------------------------------------


AWAY, ASIDE = np.hypot(30, 10), np.degrees(np.arctan2(10, 30))
SEEN = [
    ('heading,forward,starboard', '90,30,10', {}),
    ('heading,range,bearing_deg', f'90,{AWAY},{ASIDE}', {}),
    ('range,bearing_rad', f'{AWAY},{-np.radians(ASIDE)}', {'bearings': 'east'}),
    ('heading,range,bearing_deg', f'77,{AWAY},{90 + ASIDE}', {'bearings': 'north'}),
]


def test_a_vessel_that_heads_east_sees_what_is_ahead_and_to_starboard(convert):
    """30 m ahead of (1000, 500) and 10 m to starboard is (1030, 490)."""
    for n, (columns, cells, options) in enumerate(SEEN):
        lines = [f'{k},1000,500,4,0.01,{cells}' for k in (5, 6, 7)]
        text = '\n'.join([f'time,vessel_x,ship_north,depth,std,{columns}', *lines])
        report = convert(text, 'relative', f'{n}', **options)
        assert report.messages == {'/nav': 3, '/relative': 3}
        assert [type(item) for item in measured(report)] == [VesselPose, RelativeFix] * 3
        last = tracked(report)
        assert last.frame_id == 'map' and last.stamp_ns == 7 * 10**9
        assert last.state[0, :2] == pytest.approx([1030.0, 490.0], abs=0.01)


def test_metres_of_a_truth_count_from_a_place_that_is_named(convert, tmp_path):
    (tmp_path / 'truth.csv').write_text('stamp,x,y\n5,1,2\n')
    report = convert(f'{GPS}\n5,59,10,90,10,2\n', 'relative', truth=tmp_path / 'truth.csv')
    assert 'latitude 59, longitude 10' in report.notes['truth']
    assert report.notes['origin'].startswith('latitude 59.0, longitude 10.0')


def test_a_vessel_by_latitude_and_longitude_is_placed_exactly(convert):
    # Of one fix in a second, a new target is not probable yet: the second place has two.
    lines = ['5,60,10,45,500,0,.01', '6,60,10.18,45,500,0,.01', '7,60,10.18,45,500,0,.01']
    how = CsvOptions(columns={'vessel_latitude': 'lat', 'vessel_longitude': 'lon'})
    text = '\n'.join(['time,lat,lon,hdg,fwd,stbd,std', *lines])
    report = convert(text, 'relative', options=how)
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
    report = convert('\n'.join([SHIP, *rows]), 'relative')
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


def test_empty_scans_end_a_track_and_missing_rows_do_not(convert):
    seen = ['stamp,x,y,std', *(f'{k},{k},0,.1' for k in range(1, 11))]
    silent = [f'{k},,,' for k in range(11, 31)]
    ended = tracked(convert('\n'.join([*seen, *silent]), 'fixes', 'ended'))
    assert ended.stamp_ns == 30 * 10**9 and not len(ended)
    assert len(tracked(convert('\n'.join(seen), 'fixes'))) == 1


def test_every_form_of_position_can_be_empty(convert):
    for header in ('stamp,lat,lon', 'stamp,range,bearing_deg'):
        report = convert(f'{header}\n5,,\n6,50,8\n', 'fixes', header)
        assert [len(scan) for scan in measured(report)] == [0, 1]
    # Also of a vessel that sees nobody.
    report = convert(f'{SHIP}\n5,0,0,0,9,0,,\n6,1,0,0,,,,\n', 'relative')
    assert report.messages == {'/fixes': 1, '/nav': 2, '/relative': 1}
    assert tracked(report).stamp_ns == 6 * 10**9


# -- what cannot be used -------------------------------------------------------------------------


ROWS = {
    ('fixes', 'stamp,x,y', '5,1,2'): [('6,1,', 'y is empty'), ('soon,,', 'stamp is ')],
    ('fixes', 'stamp,x,y,id', '5,1,2,amy'): [('6,,,amy', 'amy has no position')],
    ('fixes', POLAR, '5,50,90,1,1'): [
        ('6,-50,90,1,1', 'a negative distance'), ('6,50,90000,1,1', 'more than two turns'),
        ('6,50,,1,1', 'bearing_deg is empty'), ('6,50,east,1,1', 'not a number'),
        ('6,inf,90,1,1', 'is infinite'), ('6,1e30,90,1,1', ''),
        ('6,50,90,1,100', 'good to 100 degrees only'), ('6,50,90,1e30,1', ''),
    ],
    ('relative', SHIP, '5,0,0,0,9,0,.1,'): [
        ('6,,0,0,9,0,.1,', 'vessel_x is empty'), ('6,0,0,,9,0,.1,', 'heading is empty'),
        ('6,0,0,4000,9,0,.1,', 'heading is 4000 degrees'),
        ('6,1e12,0,0,9,0,.1,', 'is not on Earth'), ('6,0,0,0,9e9,0,.1,', 'km away'),
        ('6,0,0,0,,,.1,amy', 'amy has no position'), ('6,0,0,0,9,0,1e30,', 'the covariance'),
    ],
    ('relative', GPS, '5,60,10,0,9,0'): [('6,95,10,0,9,0', 'is not a position on Earth')],
}  # fmt: skip


@pytest.mark.parametrize('kind, header, good', ROWS)
def test_hostile_rows_cost_a_sentence_each(convert, kind, header, good):
    bad, words = zip(*ROWS[kind, header, good])
    report = convert('\n'.join([header, good, *bad]) + '\n', kind)
    assert report.rows == 1 + len(bad) and report.bad_rows == len(bad)
    for k, (problem, wanted) in enumerate(zip(report.problems, words, strict=True)):
        assert problem.startswith(f'in.csv, line {3 + k}: ') and wanted in problem
        assert '\n' not in problem


def test_a_table_that_says_too_little_is_told_what_is_missing(convert):
    ship, row = 'stamp,vessel_x,vessel_y', '5,1,1,1,1,1'
    on_earth = GPS.replace('heading', 'heading_deg')
    for kind, text, options, words in (
        ('fixes', f'stamp,range,bearing_deg,std_range\n{row}', {}, 'no column for std_bearing'),
        ('fixes', f'stamp,range,bearing_deg\n{row}', {'bearings': 'bow'}, 'imm convert relative'),
        ('relative', f'{ship},heading\n{row}', {}, 'no column for range and bearing'),
        ('relative', f'{ship},forward,starboard\n{row}', {}, 'no column for heading'),
        ('relative', f'{ship},heading,forward,abeam\n{row}', {}, 'no column for starb'),
        ('relative', f'stamp,heading,forward,starboard\n{row}', {}, 'for vessel_x and vessel_y'),
        ('relative', f'{GPS}\n{row}', {}, 'heading may be degrees or radians'),
        ('relative', f'{on_earth}\n{row}', {'origin': (91.0, 0.0)}, 'an origin'),
        # A bearing without a unit is not guessed.
        ('fixes', 'stamp,range,bearing\n5,10,1.5\n6,10,-2', {}, 'may be degrees or radians'),
        ('relative', f'{ship},heading,range,bearing\n5,0,0,0,10,1.5\n6,0,0,0,10,-2', {},
         'bearing may be degrees or radians'),
        # Nothing but empty scans is an error.
        ('fixes', 'stamp,x,y\n5,,\n6,,', {}, 'line 2: x and y are empty'),
        ('relative', f'{SHIP}\n5,0,0,0,,,,', {}, 'nothing that could be converted'),
    ):  # fmt: skip
        with pytest.raises(BagError, match=words):
            convert(f'{text}\n', kind, **options)
