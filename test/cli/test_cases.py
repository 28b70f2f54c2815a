# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Inputs that people have, and what is right: a row for each, with its commands and its value.

Rows that need a whole run stand here; those of one reader stand in its own test (`ELSEWHERE`).
"""

from collections.abc import Callable
import csv
from functools import partial
import math
from pathlib import Path
import re
import sys
from typing import NamedTuple

from helpers.field_files import MAKERS, measured, text_of
from helpers.sonar_files import write_segy
import numpy as np
import pytest

from msg_adapters.fixes import write_fix, write_geodetic, write_relative
from msg_adapters.navigation import write_heading, write_navigation
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Fix, Navigation, RelativeFix, VesselFix, VesselHeading
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter

TEST = Path(__file__).resolve().parents[1]
ELSEWHERE = [
    'recordings/test_csv_table.py the_fraction_of_a_second_beside',
    'recordings/convert/test_detections.py pings_within_a_second_are_not_joined',
    'recordings/convert/test_nmea.py targets_of_a_usbl_are_placed_from_the_vessel',
    'recordings/convert/test_nmea.py a_time_that_cannot_be_read_takes_no_other_stamp',
    'recordings/convert/test_nmea.py the_date_is_advised_only_where_it_helps',
    'recordings/test_columns.py degrees_in_every_spelling',
    'recordings/test_csv_table.py times_of_day_in_one_number_pass_minutes_and_hours',
    'recordings/test_columns.py columns_that_are_zero_throughout_give_way_to_filled_ones',
    'recordings/test_csv_table.py forms_of_dates_and_times',
    'msg_adapters/test_fixes.py latitude_0_longitude_0_is_no_fix',
    'cli/test_pipeline.py a_type_that_nobody_hears_names_what_would_do',
    'cli/test_names.py any_locale_will_do',
    'cli/test_names.py a_recording_keeps_no_files_and_changes_no_node',
    'trackers/test_state.py a_file_runs_no_program',
    'cli/test_names.py a_file_that_a_recording_names_lies_beside_it',
    'recordings/convert/test_segy_headers.py the_recording_delay_of_each_trace',
    'recordings/convert/test_segy_headers.py the_sample_interval_of_each_trace_or_of_the_file',
    'recordings/convert/test_segy_headers.py local_times_ask_for_their_zone',
    'recordings/convert/test_segy_headers.py traces_without_a_date_begin_when_the_user_says',
    'recordings/convert/test_segy_headers.py samples_of_every_format_in_either_order',
    'recordings/convert/test_segy_headers.py places_are_used_or_the_sentence_says_why_not',
    'recordings/convert/test_segy_headers.py a_file_without_a_whole_trace_is_one_sentence',
    'recordings/convert/test_archives.py places_and_attitude_of_each_ping_become_navigation',
    'cli/test_field_files.py xyz_las_and_tif_hold_the_same_floor',
    'cli/test_damaged_lines.py soundings_far_away_are_left_out_and_said',
    'cli/test_damaged_lines.py '
    'each_damaged_line_is_named_and_left_out_and_the_chart_is_that_of_the_others',
]
"""The file and the name of the test that proves a row which one reader decides."""
BEGIN = 1_756_382_400
"""2025-08-28 12:00:00 UTC."""
PLACE = Origin(43.31, 5.36, 0.0)
RECEIVERS = {
    'VR2-551': (0, 0), 'VR2-552': (300, 10), 'VR2-553': (290, 250), 'VR2-554': (-10, 260)
}  # fmt: skip
EAST = np.array([0.0, 0.0, 0.0, 1.0])


def swim(t):
    """The way of a diver (..., 2) at seconds after the begin."""
    t = np.asarray(t, float)
    return np.stack([20 * np.sin(t / 45) + 0.1 * t, 18 * np.cos(t / 40)], axis=-1)


def circle(t):
    """The way of a fish between the receivers."""
    t = np.asarray(t, float)
    return np.stack([140 + 70 * np.cos(t / 80), 130 + 60 * np.sin(t / 80)], axis=-1)


def heard(period=(20, 40), seconds=600, seed=1):
    """(t, receiver) of a tag, right to .1 ms, in the order of their times."""
    rng, t, found = np.random.default_rng(seed), 3.0, []
    while t < seconds:
        for name, place in RECEIVERS.items():
            way = math.dist(circle(t), place) / 1500
            found.append((BEGIN + t + way + rng.normal(scale=1e-4), name))
        t += rng.uniform(*period)
    return sorted(found)


def detections(folder, head, line, **how):
    """detections.csv of `line(t, receiver)`, and receivers.csv."""
    places = [f'{name},{x},{y},-3' for name, (x, y) in RECEIVERS.items()]
    (folder / 'receivers.csv').write_text('\n'.join(['receiver,x,y,z', *places]) + '\n')
    lines = [line(t, name) for t, name in heard(**how)]
    (folder / 'detections.csv').write_text('\n'.join([head, *lines]) + '\n')


def fixes(folder, rows, head='time,x,y,std'):
    """fixes.csv of rows (seconds after the begin, x, y, ...)."""
    lines = [','.join([f'{text_of(BEGIN + t)}Z', *(f'{v:.4f}' for v in row)]) for t, *row in rows]
    (folder / 'fixes.csv').write_text('\n'.join([head, *lines]) + '\n')


def dive(folder, count=120, scale=1.0, std=0.8, offset=None, seed=2, step=1.0):
    """fixes.csv of one diver. offset(k): what the fix k is off by, m; scale: of the stated std."""
    rng, rows = np.random.default_rng(seed), []
    for k in range(count):
        x, y = swim(k * step) + std * rng.normal(size=2) + (np.array(offset(k)) if offset else 0)
        rows.append((k * step, x, y, scale * std))
    fixes(folder, rows)


def ns(t):
    return round((BEGIN + t) * 1e6) * 1000


def two_sensors(path, apart=5.0, count=200, seed=3):
    """A bag of fixes of two sensors in turn, of which one is `apart` off."""
    rng = np.random.default_rng(seed)
    stated = {'covariance': 0.25 * np.eye(2), 'frame_id': 'map'}
    with BagWriter(path) as bag:
        for k in range(count):
            x, y = swim(k) + 0.5 * rng.normal(size=2) + [0.0, apart * (k % 2)]
            fix = Fix(stamp_ns=ns(k), position=(x, y, 0.0), **stated)
            bag.write('/fix', write_fix(fix, ros_message), ns(k))


def seen_from(t):
    """The way of what a vessel hears, that goes east at 1 m/s."""
    return np.array([12 + 0.8 * t, 6 + 7 * math.sin(t / 18)])


def by_vessel(path, nav, count=80, seed=4):
    """A bag of relative fixes of a vessel with the bow east; nav(bag, k) writes its pose."""
    rng, stated = np.random.default_rng(seed), {'covariance': 0.09 * np.eye(3), 'frame_id': 'usbl'}
    with BagWriter(path) as bag:
        for k in range(count):
            nav(bag, k)
            if k:
                t = k - 0.5
                offset = (*(seen_from(t) - [t, 0] + 0.3 * rng.normal(size=2)), -4.0)
                fix = RelativeFix(stamp_ns=ns(t), offset=offset, **stated)
                bag.write('/relative', write_relative(fix, ros_message), ns(t))


def odometry(variances):
    """nav of `by_vessel`: exact poses that state these variances of roll, pitch and yaw, rad^2."""

    def nav(bag, k):
        place = {'position': [float(k), 0.0, 0.0], 'orientation': EAST, 'frame_id': 'odom'}
        message = write_navigation(Navigation(stamp_ns=ns(k), **place), ros_message)
        message.pose.covariance[:] = np.diag([0.25, 0.25, 0.25, *variances]).ravel()
        bag.write('/nav', message, ns(k))

    return nav


def satellite(every):
    """nav of `by_vessel`: places on Earth, each `every`-th at 0, 0 with a fix, and the heading."""

    def nav(bag, k):
        place = map(float, PLACE.geodetic(np.array([float(k), 0.0, 0.0])))
        latitude, longitude, _ = (0.0, 0.0, 0.0) if k % every == every // 2 else place
        fix = VesselFix(stamp_ns=ns(k), latitude=latitude, longitude=longitude, frame_id='gps')
        bag.write('/nav_fix', write_geodetic(fix, ros_message), ns(k))
        heading = VesselHeading(stamp_ns=ns(k), orientation=EAST, frame_id='vessel')
        bag.write('/heading', write_heading(heading, ros_message), ns(k))

    return nav


OBSTACLE = np.array([22.0, 4.0])
"""In the frame of the odometry, m."""


def swim_past(bag, seconds, turning=0.0):
    """/odom at 10 Hz of a vehicle at .5 m/s that looks to and fro by `turning`, rad; gives where
    it sees the obstacle at t: range and bearing."""

    def pose(t):
        return 0.5 * t, turning * math.sin(t / 8)

    for k in range(10 * seconds):
        x, yaw = pose(k / 10)
        odometry = Navigation(
            stamp_ns=ns(k / 10), position=(x, 0.0, -5.0), frame_id='odom',
            orientation=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            velocity=(0.5 * math.cos(yaw), -0.5 * math.sin(yaw), 0.0),
            turn_rate=(0.0, 0.0, turning / 8 * math.cos(k / 80)), child_frame_id='base_link',
        )  # fmt: skip
        bag.write('/odom', write_navigation(odometry, ros_message), ns(k / 10))

    def seen(t):
        x, yaw = pose(t)
        dx, dy = OBSTACLE - [x, 0.0]
        return math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)

    return seen


def slow_scan(path, sweep, turning, beams=360, seed=18):
    """A bag of a sonar that turns once in `sweep` s: a LaserScan stamped at its first beam."""
    rng, step = np.random.default_rng(seed), 2 * math.pi / beams
    with BagWriter(path) as bag:
        seen, t = swim_past(bag, 90, turning), 0.2
        while t + sweep < 89:
            ranges = np.full(beams, np.inf, np.float32)
            for k in range(beams):
                distance, bearing = seen(t + k / beams * sweep)
                if abs(bearing + math.pi - k * step) < step / 2:
                    ranges[k] = distance + 0.1 * rng.normal()
            scan = ros_message(
                'sensor_msgs/msg/LaserScan', header=header(t, 'sonar'), angle_min=-math.pi,
                angle_max=math.pi - step, angle_increment=step, time_increment=sweep / beams,
                scan_time=sweep, range_min=0.75, range_max=50.0, ranges=ranges,
                intensities=np.where(np.isinf(ranges), 0, 200).astype(np.float32),
            )  # fmt: skip
            bag.write('/scan', scan, ns(t + sweep))
            t += sweep


def pictures(path, sector_deg, seconds=20, rows=160, far=40.0, seed=19):
    """A bag of pictures at 2 Hz of a sonar's fan as on a screen, whose lower corners are dark."""
    rng, half = np.random.default_rng(seed), math.radians(sector_deg / 2)
    width = int(2 * rows * math.sin(half))
    v, u = np.mgrid[:rows, :width]
    ahead, port = (rows - v) / rows * far, (width / 2 - u) / rows * far
    dark = (np.hypot(ahead, port) > far) | (abs(np.arctan2(port, ahead)) > half)
    with BagWriter(path) as bag:
        seen = swim_past(bag, seconds)
        for k in range(2 * seconds):
            distance, bearing = seen(k / 2)
            x, y = distance * math.cos(bearing), distance * math.sin(bearing)
            near = np.exp(-((np.hypot(ahead - x, port - y) / 0.4) ** 2))
            pixels = rng.rayleigh(12, dark.shape) + 230 * near
            image = ros_message(
                'sensor_msgs/msg/Image', header=header(k / 2, 'sonar'), height=rows, width=width,
                encoding='mono8', is_bigendian=0, step=width,
                data=np.clip(np.where(dark, 0, pixels), 0, 255).astype(np.uint8).ravel(),
            )  # fmt: skip
            bag.write('/sonar/image', image, ns(k / 2))


def header(t, frame_id):
    seconds, nanoseconds = divmod(ns(t), 10**9)
    stamp = ros_message('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return ros_message('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


TELEMETRY = 'convert detections detections.csv b --receivers receivers.csv --time-zone UTC'
FISH = 'track b run --set target=fish --set target_z=-3.0'
FIXES = 'convert fixes fixes.csv b'
PLACES = ('place_cov_x_x', 'place_cov_x_y', 'place_cov_x_y', 'place_cov_y_y')
"""Columns of the covariance of an obstacle."""
ONE = 'track b run --set target=rov --set max_tracks=1'


class Run(NamedTuple):
    """Codes and words of the commands, and the confirmed and coasting rows of the run: seconds
    after the begin, places (n, 2), covariances (n, 2, 2) and numbers."""

    codes: list[int]
    words: str
    t: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    track: np.ndarray

    def errors(self, way):
        return self.place - np.array([way(t) for t in self.t])

    def rmse(self, way):
        assert len(self.t) > 10
        return math.sqrt(np.mean(np.sum(self.errors(way) ** 2, axis=1)))

    def inside(self, way):
        """The share of the truth inside the stated ellipse of 95 %."""
        error = self.errors(way)
        whitened = np.linalg.solve(self.covariance, error[..., None])[..., 0]
        return np.mean(np.sum(whitened * error, axis=1) < 5.991)


class Case(NamedTuple):
    name: str
    make: Callable[[Path], object]
    commands: tuple[str, ...]
    right: Callable[[Run], bool]


def export(head, line, **how):
    return lambda folder: detections(folder, head, line, **how)


VUE, TEXT = 'Date and Time (UTC),Receiver,Transmitter', text_of


def swapped(folder):
    """A diver is missed in three scans, in which another one appears 900 m away."""
    rng, rows = np.random.default_rng(5), []
    for k in range(45):
        for y in [0.0] if k < 30 else [900.0] if k < 33 else [0.0, 900.0]:
            rows.append((k + 1, 0.4 * k + 0.7 * rng.normal(), y + 0.7 * rng.normal(), 0.7))
    fixes(folder, rows)


def keeps_numbers_apart(run):
    sides = [set(run.track[run.place[:, 1] < 450.0]), set(run.track[run.place[:, 1] > 450.0])]
    return [len(side) for side in sides] == [1, 1] and not sides[0] & sides[1]


def reflections(folder):
    rng, late, left = np.random.default_rng(6), set(), 0
    for k in range(20, 240):
        left = left - 1 if left else 6 if rng.random() < 0.05 else 0
        late |= {k} if left else set()

    def offset(k):
        return [rng.uniform(15, 40), rng.uniform(-5, 5)] if k in late else [0.0, 0.0]

    dive(folder, 240, offset=offset, step=2.0)


def held(folder):
    rng, rows = np.random.default_rng(7), []
    for k in range(400):
        if k % 8 == 0:
            value = swim(k) + 1.5 * rng.normal(size=2)
        rows.append((k, *value, 1.5))
    fixes(folder, rows)


def unstated(folder):
    rng = np.random.default_rng(8)
    rows = [(t, *(swim(t) + 4.0 * rng.normal(size=2))) for t in range(0, 400, 2)]
    fixes(folder, rows, 'time,x,y')


def polled(folder):
    """Three fish in turn, each fix with a stamp of its own."""
    rng, rows = np.random.default_rng(9), []
    for n in range(360):
        t, phase = n / 3, 2.0 * (n % 3)
        x, y = 8 * math.cos(t / 12 + phase) + 6 * (n % 3), 8 * math.sin(t / 12 + phase)
        rows.append((t, x + 0.3 * rng.normal(), y + 0.3 * rng.normal(), 0.3))
    fixes(folder, rows)


def odd_waypoint(folder):
    point = '<trkpt lat="43.3" lon="{:.6f}"><time>2021-01-01T00:00:{:02d}</time></trkpt>'
    points = ''.join(point.format(5.3 + 1e-5 * k, k) for k in range(50))
    (folder / 'track.gpx').write_text(
        '<gpx xmlns="http://www.topografix.com/GPX/1/1"><wpt lat="43.3" lon="5.3"/>'
        f'<trk><trkseg>{points}</trkseg></trk></gpx>'
    )


def moving_vessel(folder):
    rows = ['Tid (UTC);Båt bredde;Båt lengde;Kurs;Navn;Avstand [m];Peiling [°];Dybde']
    for k in range(60):
        cells = f'43,31{k:04d};5,36;{80 + k % 9},5;Ola;{40 + 0.5 * k:.1f};{k};3,0'
        rows.append(f'{TEXT(BEGIN + k, 0)};{cells}'.replace('.', ','))
    (folder / 'usbl.csv').write_text('\n'.join(rows) + '\n', encoding='utf-8')


def commas(folder):
    rows = [f'"{k}","{2.5 + k / 10:.1f}","3,0"'.replace('.', ',') for k in range(30)]
    (folder / 'fixes.csv').write_text('\n'.join(['\ufeff"time","x","y"', *rows]) + '\n', 'utf-8')


def flagged(folder):
    """A German table in the letters of Windows, of which every tenth row is bad and 60 m off."""
    rng = np.random.default_rng(11)
    rows = ['Zeitstempel;Name;Breitengrad;Längengrad;Standardabweichung [m];Status']
    for k in range(200):
        bad, time = k % 10 == 5, TEXT(BEGIN + 2 * k, 0, '%d.%m.%Y %H:%M:%S')
        x, y = swim(2 * k) + rng.normal(size=2) + (60 if bad else 0)
        latitude, longitude, _ = PLACE.geodetic(np.array([x, y, 0.0]))
        cells = f'{latitude:.7f};{longitude:.7f};1.0'.replace('.', ',')
        rows.append(f'{time};Müller;{cells};{"Fehler" if bad else "OK"}')
    (folder / 'taucher.csv').write_text('\n'.join(rows) + '\n', 'cp1252')


def are_the_good_ones(run):
    """180 fixes of 1 m, all within 8 m of the way."""
    scans = measured('b', topics={'/fixes': 'fixes'})
    places = np.concatenate([scan.position[:, :2] for scan in scans])
    way = np.array([swim(1e-9 * scan.stamp_ns - BEGIN) for scan in scans])
    away = np.linalg.norm(places - places[0] - way + way[0], axis=1)
    variances = {float(scan.covariance[0, 0, 0]) for scan in scans}
    return len(scans) == 180 and away.max() < 8.0 and variances == {1.0} and '20' in run.words


def knows_the_obstacle(run):
    """Within 1 m at the end."""
    last = run.place[run.t == run.t[-1]]
    return np.linalg.norm(last - OBSTACLE, axis=1).min() < 1.0


def profile(folder):
    """60 traces of a flat floor at 12 m, 30 dB over a noisy water column, and two layers."""
    rng, t, k = np.random.default_rng(12), np.arange(600) * 60e-6, np.arange(60)
    echoes = {0.016: 1000.0, 0.021: 500.0, 0.029: 300.0}
    layers = sum(a * np.exp(-0.5 * ((t - at) / 2e-4) ** 2) for at, a in echoes.items())
    write_segy(
        folder / 'line.sgy', layers + rng.rayleigh(30.0, (60, 600)), 5, TRACE_SAMPLE_INTERVAL=60,
        YearDataRecorded=2021, DayOfYear=60, HourOfDay=10, SecondOfMinute=k // 4,
    )  # fmt: skip


def has_no_ghosts(run):
    """No horizon more than 1 m above the floor in 5 % of the traces; the floor itself in 90 %."""
    table = np.genfromtxt('run/estimate.csv', delimiter=',', names=True)
    stamps, depth, surely = table['stamp_ns'], table['depth'], table['existence'] > 0.5
    floor = surely & (abs(depth - 12.0) < 0.4) & (table['is_bottom'] > 0.9)
    above = surely & (depth < 11.0)
    traces, ghosts, hits = (len(set(each)) for each in (stamps, stamps[above], stamps[floor]))
    return traces > 50 and ghosts < 3 and hits > 54


def attitude(*variances):
    return lambda folder: by_vessel(folder / 'b', odometry(variances))


def times_too_small(run):
    found = re.search(r'too small by a factor (more than )?([\d.]+)', run.words)
    return found and (float(found[2]) >= 20 if found[1] else 50 <= float(found[2]) <= 200)


CASES = [
    Case('coarse_stamps', export(VUE, lambda t, r: f'{TEXT(t, 0)},{r},7'), (TELEMETRY,),
         lambda run: run.codes == [2] and 'resolution of 1 s' in run.words),
    *(Case(f'other_makers {name}', export(*MAKERS[name]), (TELEMETRY, FISH),
           lambda run: run.rmse(circle) < 0.5)
      for name in ('otn', 'glatos', 'lotek', 'thelma', 'fathom')),
    Case('burst_of_a_second tracked', export(VUE, lambda t, r: f'{TEXT(t, 6)},{r},7',
         period=(1, 1), seconds=100), (TELEMETRY, FISH),
         lambda run: len(run.t) > 85 and run.rmse(circle) < 0.5),
    Case('gpx_odd_waypoint', odd_waypoint, ('convert track.gpx b',
         'convert track.gpx c --time-zone UTC'), lambda run: run.codes == [2, 0]
         and '--time-zone' in run.words and '50 on /fix' in run.words),
    Case('german_vessel', moving_vessel, ('convert fixes usbl.csv b',),
         lambda run: run.codes == [2] and 'Kurs' in run.words and 'Båt bredde' in run.words),
    Case('quoted_decimal_comma', commas, (FIXES, 'track b run'),
         lambda run: 3.0 < run.place[-1, 0] < 6.0 and abs(run.place[-1, 1] - 3.0) < 0.1),
    Case('teleport', swapped, (FIXES, 'track b run'), keeps_numbers_apart),
    Case('outliers_in_a_row', partial(dive, offset=lambda k: [0, 25 * (k in (40, 41, 80, 81))]),
         (FIXES, ONE), lambda run: np.linalg.norm(run.errors(swim), axis=1).max() < 12.5
         and len(set(run.track)) == 1),
    Case('multipath', reflections, (FIXES, ONE), lambda run: run.rmse(swim) < 3.5),
    Case('held_values', held, (FIXES, ONE), lambda run: run.inside(swim) > 0.85),
    Case('wrong_covariances small', partial(dive, count=300, scale=0.1), (FIXES, ONE),
         times_too_small),
    Case('wrong_covariances large', partial(dive, count=300, scale=3.2), (FIXES, ONE),
         lambda run: 'too large' in run.words),
    Case('no_covariance', unstated, (FIXES, 'track b run --set target=rov'),
         lambda run: 'no message states' in run.words and 'fix_std' in run.words),
    Case('polled', polled, (FIXES, 'track b run --set target=fish'),
         lambda run: 'scan_period' in run.words and 'covariances' not in run.words),
    Case('two_sensors', lambda folder: two_sensors(folder / 'b'), (ONE,),
         lambda run: 'offset' in run.words and np.mean(run.track == run.track[-1]) > 0.9),
    *(Case(f'attitude_not_measured roll {variance:.3g}', attitude(variance, variance, 1e-4),
           ('track b run',), lambda run: run.rmse(seen_from) < 1.5)
      for variance in (99.0, 1e6)),
    *(Case(f'attitude_not_measured yaw {variance:.3g}', attitude(1e-4, 1e-4, variance),
           ('track b run',), lambda run: not len(run.t) and 'heading' in run.words)
      for variance in (math.pi**2 / 3, sys.float_info.max)),
    Case('zero_zero vessel', lambda folder: by_vessel(folder / 'b', satellite(9)),
         ('track b run',), lambda run: len(run.t) > 55 and len(set(run.track)) == 1
         and np.linalg.norm(run.errors(seen_from), axis=1).max() < 7.0
         and 'no_fix' in run.words),
    Case('german_headers', flagged, ('convert fixes taucher.csv b --time-zone UTC',),
         are_the_good_ones),
    *(Case(f'slow_scan {sweep} {turning}', lambda folder, sweep=sweep, turning=turning:
           slow_scan(folder / 'b', sweep, turning),
           ('track b run --system obstacle --topic detections=/scan --topic nav=/odom',),
           knows_the_obstacle) for sweep, turning in ((7.0, 0.0), (11.0, 0.6))),
    *(Case(f'picture_of_the_fan {sector}', lambda folder, sector=sector:
           pictures(folder / 'b', sector), ('track b run --system obstacle --topic nav=/odom '
           f'--topic image=/sonar/image --set image_far_range=40.0 --set image_fov_deg={sector}',),
           knows_the_obstacle) for sector in (70.0, 120.0)),
    Case('image_and_odometry', lambda folder: pictures(folder / 'b', 90.0),
         ('track b run --system obstacle --set image_far_range=40.0 --set image_fov_deg=90.0',),
         knows_the_obstacle),
    Case('ghost_line', profile, ('convert segy line.sgy b', 'track b run'), has_no_ghosts),
]  # fmt: skip


@pytest.mark.parametrize('case', CASES, ids=lambda case: case.name)
def test_a_case_is_right_or_asked(case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    case.make(tmp_path)
    codes = [main(command.split()) for command in case.commands]
    words, rows = ''.join(capsys.readouterr()), []
    if (table := tmp_path / 'run' / 'estimate.csv').exists():
        with table.open() as file:
            rows = [row for row in csv.DictReader(file) if row.get('track_state') in ('1', '2')]

    def values(*names):
        return np.array([[float(row[name]) for name in names] for row in rows])

    columns = ('cov_px_px', 'cov_px_py', 'cov_px_py', 'cov_py_py')
    columns = PLACES if rows and columns[0] not in rows[0] else columns
    t = np.array([int(row['stamp_ns']) * 1e-9 - BEGIN for row in rows])
    place, covariance = values('px', 'py').reshape(-1, 2), values(*columns).reshape(-1, 2, 2)
    run = Run(codes, words, t, place, covariance, values('track_id').ravel())
    assert case.right(run), run.words


def test_the_test_of_each_other_row_is_there():
    for path, name in map(str.split, ELSEWHERE):
        assert f'def test_{name}(' in (TEST / path).read_text()
