# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the headers of SEG-Y and SU files say, of files written byte by byte."""

from datetime import datetime, timezone
import struct

import numpy as np
import pytest

from msg_adapters.array_records import read_trace
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.convert import convert_segy
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.segy_lines import read_segy
from sonar_imm_tools.recordings.sniffing import sniff
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.times import gps_minus_utc

pytest.importorskip('segyio')
WORDS = {
    'elevation_scalar': (69, 'h'), 'scalar': (71, 'h'), 'x': (73, 'i'), 'y': (77, 'i'),
    'group_x': (81, 'i'), 'group_y': (85, 'i'), 'units': (89, 'h'), 'delay': (109, 'h'),
    'count': (115, 'H'), 'interval': (117, 'H'), 'year': (157, 'h'), 'day': (159, 'h'),
    'hour': (161, 'h'), 'minute': (163, 'h'), 'second': (165, 'h'), 'time_base': (167, 'h'),
    'cdp_x': (181, 'i'), 'cdp_y': (185, 'i'), 'time_scalar': (215, 'h'),
}  # fmt: skip
FILE_WORDS = {'interval': (17, 'H'), 'count': (21, 'H'), 'format': (25, 'h'), 'feet': (55, 'h')}
VALUES = np.array([[0.0, 1.0, 100.0, -3.0], [7.0, -118.0, 64.0, 2.0], [5.0, 6.0, 7.0, 8.0]])
FORMATS = {1: 'ibm', 2: 'i', 3: 'h', 5: 'f', 6: 'd', 8: 'b', 10: 'I', 11: 'H', 16: 'B'}
USUAL = {'year': 2021, 'day': 60, 'hour': 10, 'interval': 100, 'units': 2, 'scalar': -100}
TEN = round(datetime(2021, 3, 1, 10, tzinfo=timezone.utc).timestamp())


def ibm(value):
    """A number of hexadecimal exponent as 32 bits."""
    if value == 0.0:
        return 0
    exponent, size = 64, abs(value)
    while size >= 1.0:
        size, exponent = size / 16.0, exponent + 1
    return (value < 0.0) << 31 | exponent << 24 | round(size * 2**24)


def put(header, table, order, values):
    for name, value in values.items():
        place, kind = table[name]
        struct.pack_into(order + kind, header, place - 1, value)


def write(path, order='>', code=5, su=False, extra=b'', revised=False, of_file=None, **words):
    """Traces `VALUES` with header words, one value for all or one for each, beside `USUAL`."""
    text, binary = ('C 1 CHIRP'.ljust(80) * 40).encode('cp037'), bytearray(400)
    of_file = {'interval': 100, 'count': VALUES.shape[1], 'format': code, **(of_file or {})}
    put(binary, FILE_WORDS, order, of_file)
    if revised:
        struct.pack_into(order + 'I', binary, 96, 0x01020304)
        binary[300:302] = b'\x02\x01'
    parts = [] if su else [text, bytes(binary), extra]
    for k, row in enumerate(VALUES):
        header = bytearray(240)
        own = {
            name: value[k] if isinstance(value, (list, tuple)) else value
            for name, value in {'count': VALUES.shape[1], **USUAL, **words}.items()
        }
        put(header, WORDS, order, own)
        kind = FORMATS[code]
        if kind == 'ibm':
            samples = struct.pack(f'{order}4I', *map(ibm, row))
        else:
            row = np.abs(row) if kind.isupper() else row
            samples = struct.pack(f'{order}4{kind}', *(row if kind in 'fd' else map(int, row)))
        parts += [bytes(header), samples]
    path.write_bytes(b''.join(parts))
    return path


@pytest.mark.parametrize('order', ['>', '<'])
@pytest.mark.parametrize('code', FORMATS)
def test_samples_of_every_format_in_either_order(tmp_path, code, order):
    line = read_segy(write(tmp_path / 'line.sgy', order, code))
    expected = np.abs(VALUES) if FORMATS[code].isupper() else VALUES
    assert line.amplitude == pytest.approx(expected) and not line.problems
    assert line.stamps[0] == TEN * 10**9 and line.interval == pytest.approx(np.full(3, 1e-4))
    assert sniff(tmp_path / 'line.sgy').kind == 'segy'


@pytest.mark.parametrize('order', ['>', '<'])
@pytest.mark.parametrize('code', [1, 2, 3, 5])
def test_segyio_and_obspy_read_the_same_values(tmp_path, code, order):
    """In the formats that obspy has; those are all of revision 1 but one."""
    segy = pytest.importorskip('obspy.io.segy.segy')
    path = write(tmp_path / 'line.sgy', order, code, interval=50, day=60, x=900_123, delay=20)
    line, other = read_segy(path), segy._read_segy(str(path)).traces
    assert [each.data.tolist() for each in other] == line.amplitude.tolist()
    for k, each in enumerate(trace.header for trace in other):
        assert line.interval[k] == each.sample_interval_in_ms_for_this_trace * 1e-6
        assert line.delay[k] == each.delay_recording_time * 1e-3
        assert line.longitude[k] == pytest.approx(each.source_coordinate_x / 360_000)
        begin = datetime(each.year_data_recorded, 1, 1, each.hour_of_day, tzinfo=timezone.utc)
        days = (each.day_of_year - 1) * 86_400
        assert line.stamps[0] == (round(begin.timestamp()) + days) * 10**9


@pytest.mark.parametrize('order', ['>', '<'])
def test_the_byte_order_constant_of_revision_2(tmp_path, order):
    exact = bytearray(write(tmp_path / 'line.sgy', order, revised=True).read_bytes())
    struct.pack_into(order + 'd', exact, 3272, 62.5)
    (tmp_path / 'line.sgy').write_bytes(exact)
    line = read_segy(tmp_path / 'line.sgy')
    assert line.interval == pytest.approx(np.full(3, 62.5e-6))
    assert line.amplitude == pytest.approx(VALUES)


@pytest.mark.parametrize('order', ['>', '<'])
def test_su_files_have_no_file_header(tmp_path, order):
    line = read_segy(write(tmp_path / 'line.su', order, su=True, delay=20))
    assert line.amplitude == pytest.approx(VALUES) and line.delay == pytest.approx(0.02)
    assert convert_segy(tmp_path / 'line.su', tmp_path / 'bag').messages['/trace'] == 3


@pytest.mark.parametrize(
    ('words', 'delay'),
    [
        ({'delay': [40, 40, 60]}, [0.04, 0.04, 0.06]),
        ({'delay': 500, 'time_scalar': -10}, [0.05] * 3),
        ({'delay': 50, 'time_scalar': 10}, [0.5] * 3),
        ({'delay': 50, 'time_scalar': 7}, [0.05] * 3),
        ({'delay': -2}, [-0.002] * 3),
    ],
)
def test_the_recording_delay_of_each_trace(tmp_path, words, delay):
    line = read_segy(write(tmp_path / 'line.sgy', **words))
    assert line.delay == pytest.approx(delay)
    assert bool(line.problems) == (words.get('time_scalar') == 7)


def test_the_sample_interval_of_each_trace_or_of_the_file(tmp_path):
    line = read_segy(write(tmp_path / 'a.sgy', interval=[100, 0, 50], of_file={'interval': 80}))
    assert line.interval == pytest.approx([1e-4, 8e-5, 5e-5])
    assert not line.questions
    line = read_segy(write(tmp_path / 'c.sgy', interval=[100, 100, 50], of_file={'interval': 80}))
    (question,) = line.questions
    assert '100 us in the trace headers and 80 us' in question and '0.8 times' in question
    line = read_segy(write(tmp_path / 'b.sgy', interval=40_000))
    assert line.interval == pytest.approx(0.04)  # unsigned


def test_the_number_of_samples_of_the_traces_where_the_file_states_none(tmp_path):
    path = write(tmp_path / 'line.sgy', of_file={'count': 0})
    assert read_segy(path).amplitude == pytest.approx(VALUES)


def test_windows_that_shift_become_traces_of_other_depths(tmp_path):
    path = write(tmp_path / 'line.sgy', delay=[40, 40, 60], interval=[100, 100, 50])
    report = convert_segy(path, tmp_path / 'bag', depth_offset=1.0)
    assert '31 to 46 m' in report.notes['depth_of_sample_0']
    with BagReader(tmp_path / 'bag') as bag:
        depth = [read_trace(item.message).depth for item in bag.messages(['/trace'])]
    assert [each[0] for each in depth] == pytest.approx([31.0, 31.0, 46.0])
    assert [each[1] - each[0] for each in depth] == pytest.approx([0.075, 0.075, 0.0375], abs=1e-5)


@pytest.mark.parametrize(
    ('words', 'place'),
    [
        ({'x': 900_000, 'y': 18_360_000}, (2.5, 51.0)),
        ({'group_x': 900_000, 'group_y': 18_360_000}, (2.5, 51.0)),
        ({'cdp_x': 900_000, 'cdp_y': 18_360_000}, (2.5, 51.0)),
        ({'x': -2500, 'y': 51_000, 'units': 3, 'scalar': -1000}, (-2.5, 51.0)),
        ({'x': -23_000, 'y': 510_000, 'units': 4, 'scalar': 1}, (-2.5, 51.0)),
        ({'x': 590_000, 'y': 5_650_000, 'units': 1, 'scalar': 0}, None),
        ({'x': 590_000, 'y': 5_650_000, 'units': 0, 'scalar': 7}, None),
        ({'x': 9_000_000_00, 'y': 51, 'units': 3, 'scalar': 0}, None),
    ],
)
def test_places_are_used_or_the_sentence_says_why_not(tmp_path, words, place):
    line = read_segy(write(tmp_path / 'line.sgy', **words))
    if place is None:
        assert np.isnan(line.longitude).all() and np.isnan(line.latitude).all()
        assert '3 places are not used' in line.problems[0]
    else:
        assert line.longitude == pytest.approx(place[0]) and not line.problems
        assert line.latitude == pytest.approx(place[1])


@pytest.mark.parametrize('feet', [1, 2])
def test_places_in_metres_or_feet_with_a_coordinate_system(tmp_path, feet):
    warp = pytest.importorskip('rasterio.warp')
    foot = 0.3048 if feet == 2 else 1.0
    words = {'x': round(590_000 / foot), 'y': round(5_650_000 / foot), 'units': 1, 'scalar': 1}
    path = write(tmp_path / 'line.sgy', of_file={'feet': feet}, **words)
    line = read_segy(path, crs=32631)
    (east,), (north,) = warp.transform('EPSG:32631', 'EPSG:4326', [590_000], [5_650_000])
    assert line.longitude == pytest.approx(east, abs=1e-5) and not line.problems
    assert line.latitude == pytest.approx(north, abs=1e-5)


@pytest.mark.parametrize('base', [1, 3])
def test_local_times_ask_for_their_zone(tmp_path, base):
    path = write(tmp_path / 'line.sgy', time_base=base)
    with pytest.raises(BagError, match='--time-zone'):
        read_segy(path)
    assert read_segy(path, time_zone='+05:30').stamps[0] == (TEN - 19_800) * 10**9
    # In March Berlin has one hour more than UTC, in July two.
    assert read_segy(path, time_zone='Europe/Berlin').stamps[0] == (TEN - 3600) * 10**9
    july = write(tmp_path / 'july.sgy', time_base=base, day=190)
    summer = read_segy(july, time_zone='Europe/Berlin').stamps[0]
    assert summer == (TEN + 130 * 86_400 - 7200) * 10**9


@pytest.mark.parametrize('base', [0, 2, 4, 5])
def test_times_that_are_utc_or_of_gps(tmp_path, base):
    path = write(tmp_path / 'line.sgy', time_base=base)
    assert read_segy(path).stamps[0] == (TEN - 18 * (base == 5)) * 10**9
    zone = read_segy(path, time_zone='+01:00').stamps[0]
    assert zone == (TEN - {0: 3600, 5: 18}.get(base, 0)) * 10**9


@pytest.mark.parametrize(('year', 'whole'), [(21, 2021), (98, 1998)])
def test_years_of_two_digits(tmp_path, year, whole):
    line = read_segy(write(tmp_path / 'line.sgy', year=year))
    assert line.stamps == read_segy(write(tmp_path / 'line.sgy', year=whole)).stamps


def test_seconds_between_gps_and_utc():
    moments = [
        datetime(*date, tzinfo=timezone.utc).timestamp()
        for date in (
            (1980, 1, 6),
            (1999, 1, 1),
            (2012, 6, 30, 23, 59, 59),
            (2012, 7, 1),
            (2025, 1, 1),
        )
    ]
    assert list(gps_minus_utc(np.array(moments))) == [0, 13, 15, 16, 18]


def test_traces_without_a_date_begin_when_the_user_says(tmp_path):
    nothing = {'year': 0, 'day': 0, 'hour': 0}
    path = write(tmp_path / 'line.sgy', **nothing)
    with pytest.raises(BagError, match='--start'):
        read_segy(path)
    with pytest.raises(BagError, match='yesterday'):
        read_segy(path, start='yesterday')
    line = read_segy(path, start='2021-03-01T10:00:00Z', rate=4.0)
    assert line.stamps == [TEN * 10**9 + k * 250_000_000 for k in range(3)]
    assert '--rate' in line.questions[0]
    last = read_segy(write(path, year=2020, day=366)).stamps[0]
    assert last == round(datetime(2020, 12, 31, 10, tzinfo=timezone.utc).timestamp()) * 10**9
    write(path, year=[2020, 2021, 2021], day=366)
    with pytest.raises(BagError, match='trace 2 is of day 366 of 2021, which is no date.*--start'):
        read_segy(path)
    line = read_segy(path, start='2021-03-01T10:00:00Z')
    assert line.stamps[0] == TEN * 10**9 and 'day 366' in line.questions[0]
    # A time of day without a date goes on over midnight.
    path = write(tmp_path / 'night.sgy', year=0, day=0, hour=[23, 23, 0], minute=[58, 59, 0])
    line = read_segy(path, start='2021-03-01T10:00:00Z')
    assert line.stamps == [(TEN + 60 * k) * 10**9 for k in range(3)]


@pytest.mark.parametrize('size', [0, 100, 3599, 3600, 3700])
def test_a_file_without_a_whole_trace_is_one_sentence(tmp_path, size):
    path = write(tmp_path / 'line.sgy')
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(BagError, match=r'cannot be read'):
        read_segy(path)


@pytest.mark.parametrize('order', ['>', '<'])
def test_a_file_that_is_cut_off_keeps_its_whole_traces(tmp_path, order):
    path = write(tmp_path / 'line.sgy', order)
    path.write_bytes(path.read_bytes()[:-5])
    line = read_segy(path)
    assert line.amplitude == pytest.approx(VALUES[:2]) and 'cut off in trace 3' in line.problems[0]


def test_the_speed_of_sound_may_be_a_file_with_its_profile(tmp_path, capsys):
    """A vertical path through 20 m of 1480 m/s and 20 m of 1520 m/s."""
    path, profile = write(tmp_path / 'line.sgy', delay=40), tmp_path / 'cast.csv'
    profile.write_text('depth,sound_speed\n0,1480\n20,1480\n20.001,1520\n40.001,1520\n')
    asked = ['convert', 'segy', str(path), str(tmp_path / 'bag'), '--sound-speed']
    assert main([*asked, str(profile)]) == 0
    with BagReader(tmp_path / 'bag') as bag:
        message = next(bag.messages(['/trace'])).message
    mean = 40.0 / (20.0 / 1480.0 + 20.0 / 1520.0)
    assert read_trace(message).depth[0] == pytest.approx(0.5 * mean * 0.040, abs=2e-3)
    for wrong, words in (('absent.svp', 'not a valid'), ('12', 'range'), (str(path), 'profile')):
        assert main([*asked[:3], str(tmp_path / 'no'), asked[4], wrong]) == 2
        assert words in capsys.readouterr().err
