# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Logs of sentences: whose positions they hold, and when they were true."""

from datetime import datetime, timedelta, timezone
import math

from helpers.field_files import checked, measured, minutes, position
from helpers.sonar_files import PLACE
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pymap3d
import pytest

from sonar_imm.acoustics.geometry import rotation_of_quaternion
from sonar_imm_tools.recordings.convert import convert_nmea
from sonar_imm_tools.recordings.sources import BagError

pyais = pytest.importorskip('pyais')
pytest.importorskip('pynmea2')

BEGIN = datetime(2024, 5, 31, 23, 59, 50, tzinfo=timezone.utc)


def heading(value):
    return checked(f'GPHDT,{value},T')


def ais(mmsi, place, second, kind=1, **more):
    content = {'type': kind, 'mmsi': mmsi, 'lat': place[0], 'lon': place[1], 'second': second}
    return pyais.encode_dict(content | more, talker_id='AI', sentence_type='VDM')[0]


def converted(tmp_path, lines, out='out', **options):
    (tmp_path / 'log.nmea').write_text('\r\n'.join(lines) + '\r\n')
    return convert_nmea(tmp_path / 'log.nmea', tmp_path / out, **options)


def of(report, topic='/fixes', name='fixes'):
    return measured(report.path, topics={topic: name})


def ns(moment):
    return round(moment.timestamp()) * 10**9


def metres(latitude, longitude):
    return pymap3d.geodetic2enu(latitude, longitude, 0.0, *PLACE, 0.0)[:2]


def test_vessel_and_targets_over_midnight(tmp_path):
    lines = []
    for k in range(20):
        moment = BEGIN + timedelta(seconds=k)
        lines += [position('RMC', moment), position('GGA', moment), heading(30.0)]
        if k % 5 == 0:
            lines.append(ais(211_000_000 + k % 2, (54.01, 10.01), (moment.second - 3) % 60))
    report = converted(tmp_path, lines, origin=(*PLACE,))
    assert report.messages == {'/nav_fix': 20, '/heading': 20, '/fixes': 4}
    own = of(report, '/nav_fix', 'nav_fix')
    assert [item.stamp_ns for item in own] == [ns(BEGIN) + k * 10**9 for k in range(20)]
    assert own[0].height == pytest.approx(42.0)  # above the ellipsoid
    bow = rotation_of_quaternion(of(report, '/heading', 'heading')[0].orientation)[:, 0]
    assert math.degrees(math.atan2(bow[1], bow[0])) == pytest.approx(60.0)
    scans = of(report)
    # The report says the second; the clock of the log is 3 s later.
    assert [scan.stamp_ns for scan in scans] == [ns(BEGIN) + (5 * k - 3) * 10**9 for k in range(4)]
    # AIS counts in 1e-4 minutes.
    assert scans[0].position[0, :2] == pytest.approx(metres(54.01, 10.01), abs=0.2)
    assert scans[0].covariance[0, 0, 0] == 15.0**2


def test_without_targets_the_receiver_is_the_target(tmp_path):
    lines = [position('RMC', BEGIN + timedelta(seconds=k)) for k in range(5)]
    report = converted(tmp_path, lines)
    assert report.messages == {'/fix': 5} and 'are the fixes' in report.notes['own']
    with pytest.raises(BagError, match='nothing that could be converted'):
        convert_nmea(tmp_path / 'log.nmea', tmp_path / 'none', own='vessel')


def test_tracked_targets_are_placed_from_the_vessel_or_where_they_say(tmp_path):
    reach, angle = 926.0, math.radians(120.0)
    wanted = [reach * math.sin(angle), reach * math.cos(angle)]
    for reference, bearing in (('T', 120.0), ('R', 90.0)):
        tracked = ttm(bearing, reference, 'buoy', '235950.00')
        lines = [position('RMC', BEGIN), heading(30.0), tracked]
        scan = of(converted(tmp_path, lines, reference, origin=PLACE))[0]
        assert scan.position[0, :2] == pytest.approx(wanted, abs=0.1)
    where = f'{minutes(54.02, 2)},N,{minutes(10.03, 3)},E'
    line = checked(f'RATLL,01,{where},anna,235952.00,T,')
    scan = of(converted(tmp_path, [position('RMC', BEGIN), line], origin=PLACE))[0]
    assert scan.position[0, :2] == pytest.approx(metres(54.02, 10.03), abs=0.1)
    assert scan.stamp_ns == ns(BEGIN + timedelta(seconds=2))


def test_times_before_a_sentence(tmp_path):
    report = ais(211_000_001, (54.01, 10.01), 60)
    words = '1717199990.0 ', '2024-05-31T23:59:50Z,', '\\s:a,c:1717199990*5A\\', '1717199990000;'
    for k, before in enumerate(words):
        assert of(converted(tmp_path, [before + report], f'{k}'))[0].stamp_ns == ns(BEGIN)


def test_what_cannot_be_used_is_counted_and_named(tmp_path):
    good, there = position('RMC', BEGIN), (54.01, 10.01)
    lines = [
        ais(211_000_001, there, 10),  # no time yet
        good,
        good.replace('54', '55', 1),  # wrong checksum
        'no sentence',
        position('GGA', BEGIN, (91.0, 10.0)),
        ais(211_000_001, (91.0, 181.0), 10),  # says that it has no position
        ais(211_000_001, there, 50),
    ]
    report = converted(tmp_path, [*lines, checked('GPXYZ,1'), checked('PFOO,1,2')])
    assert report.bad_rows == 5 and report.messages == {'/fixes': 1, '/nav_fix': 1}
    assert report.reasons['no time'] == 1
    named = [problem.split(',')[1].split(':')[0] for problem in report.problems]
    assert named == [f' line {k}' for k in (1, 3, 4, 5, 6)]
    # Those that are not known are counted by their names.
    assert '1 GPXYZ' in report.notes['not used'] and '(' not in report.notes['not used']


CHANGES = st.tuples(st.integers(0, 3), st.integers(0, 70), st.characters(max_codepoint=255))


@settings(max_examples=50)
@given(st.lists(CHANGES, max_size=8))
def test_damaged_sentences_are_no_tracebacks(tmp_path_factory, changes):
    lines = [position('RMC', BEGIN), ais(211_000_001, (54.0, 10.0), 5), heading(3.0), 'x']
    for line, place, letter in changes:
        lines[line] = lines[line][:place] + letter + lines[line][place + 1 :]
        body = lines[line].partition('*')[0].encode('ascii', 'replace').decode()
        lines[line] = body[:1] + checked(body[1:])[1:]  # the content is wrong, not the sum
    folder = tmp_path_factory.mktemp('log')
    (folder / 'log.nmea').write_text('\n'.join(lines), encoding='utf-8')
    try:
        assert np.isfinite(convert_nmea(folder / 'log.nmea', folder / 'out').rows)
    except BagError as error:
        assert '\n' not in str(error)


def usrth(distance, bearing, elevation=0.0):
    return checked(f'USRTH,0,0,0,{distance},0,{bearing},{elevation},0,0,0,90.0,16')


def psimssb(moment, ahead, starboard, status='A', system='C', turned='H', name='B01'):
    place = f'{starboard},{ahead},12.0,0.1'
    return checked(f'PSIMSSB,{moment:%H%M%S}.00,{name},{status},,{system},{turned},M,{place},N,,')


def test_targets_of_a_usbl_are_placed_from_the_vessel(tmp_path):
    for k, (sentence, place) in enumerate((
        (usrth(100.0, 90.0), [100.0, 0.0, 0.0]),
        (usrth(100.0, 180.0, -30.0), [0.0, -86.6, -50.0]),
        (psimssb(BEGIN, 25.0, 20.0), [25.0, -20.0, -12.0]),
    )):  # fmt: skip
        lines = [position('RMC', BEGIN), heading(90.0), sentence]
        report = converted(tmp_path, lines, f'{k}', origin=(*PLACE,))
        assert (report.messages['/nav_fix'], report.messages['/heading'], report.rows) == (1, 1, 3)
        (found,) = of(report) if 'B01' in sentence else of(report, '/fix', 'fix')
        assert np.ravel(found.position) == pytest.approx(place, abs=0.05)


def test_the_attitude_that_a_usbl_reports(tmp_path):
    """Bow up and starboard down, with the fraction of its second."""
    sensor = f'PSIMSNS,{BEGIN:%H%M%S}.250,M01,1,1,3.0,2.0,0.4,120.0,,1,0.0,,M01'
    lines = [position('RMC', BEGIN), checked(sensor), psimssb(BEGIN, 10.0, 0.0)]
    (found,) = of(converted(tmp_path, lines, origin=(*PLACE,)), '/heading', 'heading')
    assert found.stamp_ns % 10**9 == 250_000_000
    bow, port = rotation_of_quaternion(found.orientation)[:, :2].T
    assert np.degrees(np.arctan2(bow[0], bow[1])) == pytest.approx(120.0)
    assert np.degrees(np.arcsin(bow[2])) == pytest.approx(2.0)
    assert port[2] == pytest.approx(np.sin(np.radians(3.0)) * np.cos(np.radians(2.0)))


def test_a_vessel_with_a_usbl_is_never_the_target(tmp_path):
    for sentence, words in (
        (checked('PSIMSNS,095958.00,M01,1,1,3.0,2.0,0.4,,,1,0.0,,M01'), 'no heading'),
        (psimssb(BEGIN, 1.0, 1.0, status='V'), 'flagged as invalid'),
        (psimssb(BEGIN, 1.0, 1.0, system='P'), 'coordinates P, H'),
        (psimssb(BEGIN, 1.0, 1.0, turned='N'), 'coordinates C, N'),
        (usrth(100.0, 90.0)[:-2] + '00', 'another checksum'),
    ):
        with pytest.raises(BagError, match=words):
            converted(tmp_path, [position('RMC', BEGIN), heading(90.0), sentence])
    # Nor where the USBL is not read.
    for body in ('PSIMLBP,100000.00,B01,54.0,10.0', 'PTSAG,#1,100000.00,1,2'):
        how = {'lines': [position('GGA', BEGIN), checked(body)], 'date': '2024-05-31'}
        with pytest.raises(BagError, match='is of a USBL and not read; --own fixes'):
            converted(tmp_path, **how)
        assert converted(tmp_path, out=body[:5], own='fixes', **how).messages == {'/fix': 1}


def test_a_time_that_cannot_be_read_takes_no_other_stamp(tmp_path):
    good = position('GGA', BEGIN)
    name, _, *rest = good[1:].rpartition('*')[0].split(',')
    for clock in ('95958.00', '0959 8.00', '09598.00', '9:59:58', '0959'):
        bad = checked(','.join([name, clock, *rest]))
        report = converted(tmp_path, [good, bad, good], clock, date='2024-05-31')
        assert (report.bad_rows, report.rows) == (1, 3)
        assert report.reasons == {'unreadable time': 1}
        with pytest.raises(BagError, match='cannot be read as HHMMSS') as caught:
            converted(tmp_path, [bad] * 3, date='2024-05-31')
        assert '--date' not in caught.value.sentence


def test_the_date_is_advised_only_where_it_helps(tmp_path):
    times = [position('GGA', BEGIN)]
    with pytest.raises(BagError, match='--date'):
        converted(tmp_path, times)
    (fix,) = of(converted(tmp_path, times, date='2024-05-31'), '/fix', 'fix')
    assert fix.stamp_ns == ns(BEGIN)
    with pytest.raises(BagError, match='60 of 60 rows.*no time') as caught:
        converted(tmp_path, [ais(211_000_000, PLACE, 60)] * 60)
    assert '--date' not in caught.value.sentence


def by_talkers(apart, first='GP'):
    """A log of two talkers, of which GN says more, `apart` m to the north."""
    lines, there = [], (PLACE[0] + apart / 111e3, PLACE[1])
    for moment in (BEGIN + timedelta(seconds=k) for k in range(20)):
        more = [position(kind, moment, there, 'GN') for kind in ('RMC', 'GGA')]
        one = [position('GGA', moment)]
        lines += one + more if first == 'GP' else more + one
    return lines


@pytest.mark.parametrize('first', ['GP', 'GN'])
def test_two_receivers_in_one_log_are_asked_for(tmp_path, first):
    lines, where = by_talkers(31.0, first), {'date': '2024-05-31', 'origin': PLACE}
    with pytest.raises(BagError, match=r'31.1 m apart.*--talker GP'):
        converted(tmp_path, lines, **where)
    with pytest.raises(BagError, match='GL; there are'):
        converted(tmp_path, lines, talker='GL')
    for name, north in (('GP', 0.0), ('GN', 31.0)):
        report = converted(tmp_path, lines, name, talker=name, **where)
        places = [fix.position[1] for fix in of(report, '/fix', 'fix')]
        assert places == pytest.approx([north] * 20, abs=0.3)
        assert f'of {name} are used' in report.notes['talkers']


def test_one_receiver_with_two_talkers_gives_each_position_once(tmp_path):
    report = converted(tmp_path, by_talkers(0.2), date='2024-05-31')
    assert report.messages['/fix'] == 20 and 'GN (40), GP (20)' in report.notes['talkers']
    assert not report.questions
    # Two receivers of one talker are a question.
    lines = [
        position('GGA', BEGIN + timedelta(seconds=k), (PLACE[0] + north, PLACE[1]))
        for k in range(20)
        for north in (0.0, 4e-4)
    ]
    report = converted(tmp_path, [position('RMC', BEGIN), *lines], 'two', origin=PLACE)
    assert 'two receivers in one log' in report.questions[0]
    fixes = of(report, '/fix', 'fix')
    assert len(fixes) == 20 and max(abs(fix.position[1]) for fix in fixes) < 0.3


def test_headings_that_say_that_there_is_none_are_left_out(tmp_path):
    first, second = (position('RMC', BEGIN + timedelta(seconds=k)) for k in (0, 1))
    for k, body in enumerate(
        ['GPHDT,,T', 'GPHDT,-1.0,T', 'GPHDT,999.9,T', 'GPTHS,10.0,V', 'GPTHS,,V']
    ):
        lines = [first, checked('GPTHS,90.0,A'), second, checked(body), ais(211, PLACE, 51)]
        report = converted(tmp_path, lines, f'{k}')
        assert report.messages['/heading'] == 1 and report.bad_rows == 1


def test_times_before_sentences_of_another_zone_are_asked_about(tmp_path):
    moments = [BEGIN + timedelta(seconds=k) for k in range(5)]
    for hours in (0, 2, -9):
        ahead = timedelta(hours=hours)
        lines = [f'{t + ahead:%Y-%m-%d %H:%M:%S} {position("RMC", t)}' for t in moments]
        if hours:
            with pytest.raises(BagError, match=rf'are [+]?{hours} h from .* --time-zone'):
                converted(tmp_path, lines)
        zone = f'{hours:+03d}:00' if hours else ''
        report = converted(tmp_path, lines, f'{hours}', time_zone=zone)
        assert [fix.stamp_ns for fix in of(report, '/fix', 'fix')] == list(map(ns, moments))
        assert not report.questions
    # Of AIS alone nobody says the time of day.
    lines = [f'2024-05-31 10:00:{k:02d} {ais(7, PLACE, 60)}' for k in range(5)]
    assert '--time-zone' in converted(tmp_path, lines).questions[0]


def ttm(bearing, reference, name, clock):
    return checked(f'RATTM,07,0.5,{bearing},{reference},3.0,0.0,T,,,N,{name},T,,{clock},A')


def test_a_radar_without_heading_and_reports_of_the_own_ship_alone_are_named(tmp_path):
    lines = [position('RMC', BEGIN), ttm(45.0, 'R', 'A', '')]
    with pytest.raises(BagError, match='no heading came before it'):
        converted(tmp_path, lines)
    assert converted(tmp_path, lines, own='fixes').messages == {'/fix': 1}
    own = {'type': 1, 'mmsi': 7, 'lat': 54.0, 'lon': 10.0, 'second': 60}
    line = pyais.encode_dict(own, sentence_type='VDO')[0]
    with pytest.raises(BagError, match='1 AIS reports of the own ship'):
        converted(tmp_path, [f'1700000000 {line}'], 'own')
