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
import sys

from helpers.field_files import measured
from helpers.sonar_files import write_segy
import numpy as np
import pytest
import yaml

from sonar_imm.trackers.fathometer.response import envelope_parameters
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.convert import convert_segy, sniff
from sonar_imm_tools.recordings.convert.fathometer import doubted_spacing, measured_instrument
from sonar_imm_tools.recordings.positions import read_positions
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.segy_lines import read_segy
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


def write(path, order='>', code=5, su=False, revised=False, of_file=None, **words):
    """Traces `VALUES` with header words, one value for all or one for each, beside `USUAL`."""
    text, binary = ('C 1 CHIRP'.ljust(80) * 40).encode('cp037'), bytearray(400)
    of_file = {'interval': 100, 'count': VALUES.shape[1], 'format': code, **(of_file or {})}
    put(binary, FILE_WORDS, order, of_file)
    if revised:
        struct.pack_into(order + 'I', binary, 96, 0x01020304)
        struct.pack_into(order + 'd', binary, 72, 62.5)
        binary[300:302] = b'\x02\x01'
    parts, kind = [] if su else [text, bytes(binary)], FORMATS[code]
    for k, row in enumerate(VALUES):
        header = bytearray(240)
        given = {'count': VALUES.shape[1], **USUAL, **words}
        own = {n: value[k] if isinstance(value, list) else value for n, value in given.items()}
        put(header, WORDS, order, own)
        row = np.abs(row) if kind.isupper() else row
        packed = map({'ibm': ibm, 'f': float, 'd': float}.get(kind, int), row)
        parts += [bytes(header), struct.pack(f'{order}4{kind.replace("ibm", "I")}', *packed)]
    path.write_bytes(b''.join(parts))
    return path


@pytest.fixture
def line_of(tmp_path):
    """Write a file and read it."""

    def read(order='>', code=5, name='line.sgy', how=None, **words):
        return read_segy(write(tmp_path / name, order, code, **words), **(how or {}))

    return read


@pytest.mark.parametrize('order', ['>', '<'])
def test_samples_of_every_format_in_either_order(line_of, tmp_path, order):
    for code, kind in FORMATS.items():
        line = line_of(order, code)
        expected = np.abs(VALUES) if kind.isupper() else VALUES
        assert line.amplitude == pytest.approx(expected) and not line.problems
        assert line.stamps[0] == TEN * 10**9 and line.interval == pytest.approx(np.full(3, 1e-4))
        assert sniff(tmp_path / 'line.sgy').kind == 'segy'
    line = line_of(order, revised=True)  # the byte order constant of revision 2
    assert line.interval == pytest.approx(np.full(3, 62.5e-6))
    assert line.amplitude == pytest.approx(VALUES)
    # SU files have no file header.
    line = line_of(order, name='line.su', su=True, delay=20)
    assert line.amplitude == pytest.approx(VALUES) and line.delay == pytest.approx(0.02)
    assert convert_segy(tmp_path / 'line.su', tmp_path / 'bag').messages['/trace'] == 3
    # What is cut off keeps its whole traces.
    path = write(tmp_path / 'line.sgy', order)
    path.write_bytes(path.read_bytes()[:-5])
    line = read_segy(path)
    assert line.amplitude == pytest.approx(VALUES[:2]) and 'cut off in trace 3' in line.problems[0]


@pytest.mark.parametrize('order, code', [('>', 1), ('<', 2), ('>', 3), ('<', 5)])
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


def test_the_recording_delay_of_each_trace(line_of):
    for words, delay in (
        ({'delay': [40, 40, 60]}, [0.04, 0.04, 0.06]),
        ({'delay': 500, 'time_scalar': -10}, [0.05] * 3),
        ({'delay': 50, 'time_scalar': 10}, [0.5] * 3),
        ({'delay': 50, 'time_scalar': 7}, [0.05] * 3),
        ({'delay': -2}, [-0.002] * 3),
    ):
        line = line_of(**words)
        assert line.delay == pytest.approx(delay)
        assert bool(line.problems) == (words.get('time_scalar') == 7)


def test_the_sample_interval_of_each_trace_or_of_the_file(line_of):
    line = line_of(interval=[100, 0, 50], of_file={'interval': 80})
    assert line.interval == pytest.approx([1e-4, 8e-5, 5e-5])
    assert not line.questions
    (question,) = line_of(interval=[100, 100, 50], of_file={'interval': 80}).questions
    assert '100 us in the trace headers and 80 us' in question and '0.8 times' in question
    line = line_of(interval=40_000, of_file={'count': 0})
    assert line.interval == pytest.approx(0.04)  # unsigned
    assert line.amplitude == pytest.approx(VALUES)  # their number by the traces


def test_windows_that_shift_become_traces_of_other_depths(tmp_path):
    path = write(tmp_path / 'line.sgy', delay=[40, 40, 60], interval=[100, 100, 50])
    report = convert_segy(path, tmp_path / 'bag', depth_offset=1.0)
    assert '31 to 46 m' in report.notes['depth_of_sample_0']
    depth = [trace.depth for trace in measured(tmp_path / 'bag', 'fathometer')]
    assert [each[0] for each in depth] == pytest.approx([31.0, 31.0, 46.0])
    assert [each[1] - each[0] for each in depth] == pytest.approx([0.075, 0.075, 0.0375], abs=1e-5)


def test_places_are_used_or_the_sentence_says_why_not(line_of):
    for words, place in (
        ({'x': 900_000, 'y': 18_360_000}, (2.5, 51.0)),
        ({'group_x': 900_000, 'group_y': 18_360_000}, (2.5, 51.0)),
        ({'cdp_x': 900_000, 'cdp_y': 18_360_000}, (2.5, 51.0)),
        ({'x': -2500, 'y': 51_000, 'units': 3, 'scalar': -1000}, (-2.5, 51.0)),
        ({'x': -23_000, 'y': 510_000, 'units': 4, 'scalar': 1}, (-2.5, 51.0)),
        ({'x': 590_000, 'y': 5_650_000, 'units': 1, 'scalar': 0}, None),
        ({'x': 590_000, 'y': 5_650_000, 'units': 0, 'scalar': 7}, None),
        ({'x': 9_000_000_00, 'y': 51, 'units': 3, 'scalar': 0}, None),
    ):
        line = line_of(**words)
        if place is None:
            assert np.isnan(line.longitude).all() and np.isnan(line.latitude).all()
            assert '3 places are not used' in line.problems[0]
        else:
            assert line.longitude == pytest.approx(place[0]) and not line.problems
            assert line.latitude == pytest.approx(place[1])


def test_places_in_metres_or_feet_with_a_coordinate_system(line_of):
    warp = pytest.importorskip('rasterio.warp')
    (east,), (north,) = warp.transform('EPSG:32631', 'EPSG:4326', [590_000], [5_650_000])
    for feet, foot in ((1, 1.0), (2, 0.3048)):
        words = {'x': round(590_000 / foot), 'y': round(5_650_000 / foot), 'units': 1, 'scalar': 1}
        line = line_of(of_file={'feet': feet}, how={'crs': 32631}, **words)
        assert line.longitude == pytest.approx(east, abs=1e-5) and not line.problems
        assert line.latitude == pytest.approx(north, abs=1e-5)


def test_local_times_ask_for_their_zone(line_of):
    for base in (1, 3):
        with pytest.raises(BagError, match='--time-zone'):
            line_of(time_base=base)
    # In March Berlin has one hour more than UTC, in July two.
    for base, day, zone, ahead in (
        (1, 60, '+05:30', 19_800), (3, 60, 'Europe/Berlin', 3600), (1, 190, 'Europe/Berlin', 7200)
    ):  # fmt: skip
        line = line_of(time_base=base, day=day, how={'time_zone': zone})
        assert line.stamps[0] == (TEN + (day - 60) * 86_400 - ahead) * 10**9


def test_times_that_are_utc_or_of_gps(line_of):
    for base in (0, 2, 4, 5):
        assert line_of(time_base=base).stamps[0] == (TEN - 18 * (base == 5)) * 10**9
        zone = line_of(time_base=base, how={'time_zone': '+01:00'}).stamps[0]
        assert zone == (TEN - {0: 3600, 5: 18}.get(base, 0)) * 10**9
    dates = (1980, 1, 6), (1999, 1, 1), (2012, 6, 30, 23, 59, 59), (2012, 7, 1), (2025, 1, 1)
    moments = [datetime(*date, tzinfo=timezone.utc).timestamp() for date in dates]
    assert list(gps_minus_utc(np.array(moments))) == [0, 13, 15, 16, 18]
    for year, whole in ((21, 2021), (98, 1998)):  # of two digits
        assert line_of(year=year).stamps == line_of(year=whole).stamps


def test_traces_without_a_date_begin_when_the_user_says(line_of):
    begin, nothing = '2021-03-01T10:00:00Z', {'year': 0, 'day': 0}
    for start, words in (('', '--start'), ('yesterday', 'yesterday')):
        with pytest.raises(BagError, match=words):
            line_of(**nothing, hour=0, how={'start': start})
    line = line_of(**nothing, hour=0, how={'start': begin, 'rate': 4.0})
    assert line.stamps == [TEN * 10**9 + k * 250_000_000 for k in range(3)]
    assert '--rate' in line.questions[0]
    last = datetime(2020, 12, 31, 10, tzinfo=timezone.utc).timestamp()
    assert line_of(year=2020, day=366).stamps[0] == round(last) * 10**9
    never = {'year': [2020, 2021, 2021], 'day': 366}
    with pytest.raises(BagError, match='trace 2 is of day 366 of 2021, which is no date.*--start'):
        line_of(**never)
    line = line_of(**never, how={'start': begin})
    assert line.stamps[0] == TEN * 10**9 and 'day 366' in line.questions[0]
    # A time of day without a date goes on over midnight.
    line = line_of(**nothing, hour=[23, 23, 0], minute=[58, 59, 0], how={'start': begin})
    assert line.stamps == [(TEN + 60 * k) * 10**9 for k in range(3)]


def test_a_file_without_a_whole_trace_is_one_sentence(tmp_path):
    path = write(tmp_path / 'line.sgy')
    whole = path.read_bytes()
    cuts = [whole[:size] for size in (0, 100, 3599, 3600, 3700)]
    for content in (*cuts, b'no traces here', None):
        path.unlink() if content is None else path.write_bytes(content)
        with pytest.raises(BagError, match=r'cannot be read'):
            read_segy(path)


def test_the_speed_of_sound_may_be_a_file_with_its_profile(tmp_path, capsys):
    """A vertical path through 20 m of 1480 m/s and 20 m of 1520 m/s."""
    path, profile = write(tmp_path / 'line.sgy', delay=40), tmp_path / 'cast.csv'
    profile.write_text('depth,sound_speed\n0,1480\n20,1480\n20.001,1520\n40.001,1520\n')
    asked = ['convert', 'segy', str(path), str(tmp_path / 'bag'), '--sound-speed']
    assert main([*asked, str(profile)]) == 0
    first = measured(tmp_path / 'bag', 'fathometer')[0]
    mean = 40.0 / (20.0 / 1480.0 + 20.0 / 1520.0)
    assert first.depth[0] == pytest.approx(0.5 * mean * 0.040, abs=2e-3)
    for wrong, words in (('absent.svp', 'not a valid'), ('12', 'range'), (str(path), 'profile')):
        assert main([*asked[:3], str(tmp_path / 'no'), asked[4], wrong]) == 2
        assert words in capsys.readouterr().err


# -- what traces tell of their instrument: pulse, noise, spacing and place


T, N = 40, 90
ARRIVAL = 30 + np.arange(T) // 8
LAG = np.arange(N) - ARRIVAL[:, None]
ECHO = 1000.0 * np.exp(-0.5 * np.square(LAG / 1.5)) + np.where(LAG > 6, 200.0, 0.0)


def profile(path, amplitude, *, depth_m=0.0, arcsec=True):
    second = np.arange(len(amplitude)) // 4
    return write_segy(
        path, amplitude, TRACE_SAMPLE_INTERVAL=66, YearDataRecorded=2018, DayOfYear=72,
        HourOfDay=10, SecondOfMinute=second, ElevationScalar=-10,
        SourceWaterDepth=round(10.0 * depth_m), SourceGroupScalar=-1000,
        CoordinateUnits=2 if arcsec else 1, SourceX=round(-91.64 * 3.6e6) + 40 * second,
        SourceY=round(17.13 * 3.6e6),
    )  # fmt: skip


def parameters_of(bag):
    text = (bag / 'parameters.yaml').read_text()
    return yaml.safe_load(text)['fathometer']['ros__parameters']


def test_the_pulse_and_the_noise_are_measured_and_an_impossible_spacing_is_said():
    pulse, noise = measured_instrument(ECHO, 0.4)
    # A Gaussian of 1.5 samples: half of its width at half height, linear between samples.
    assert pulse == pytest.approx(0.4 * 1.5, rel=0.1)
    assert noise[:28] == pytest.approx(np.full(28, 1.0))
    coarse = 100.0 * np.round(ECHO / 100.0)
    assert measured_instrument(coarse, 0.4)[1][:28] == pytest.approx(np.full(28, 50.0))
    assert measured_instrument(ECHO[:, 40:], 0.4) is None
    stated = np.full(T, 12.8)
    assert doubted_spacing(ECHO, 0.4, 0.0, stated) is None
    message = doubted_spacing(ECHO, 0.05, 0.0, stated)
    assert '0.4 m a sample would fit' in message and '12.8 m of water' in message
    # Samples that were left out before count as way.
    assert doubted_spacing(ECHO[:, 10:], 0.4, 4.0, stated) is None
    assert doubted_spacing(ECHO, 0.05, 0.0, np.zeros(T)) is None
    assert 'end at 0.09 m' in doubted_spacing(ECHO, 0.001, 0.0, np.zeros(T))


def test_an_envelope_brings_its_parameters_and_places(tmp_path):
    path = profile(tmp_path / 'line.seg', ECHO, depth_m=12.8)
    report = convert_segy(path, tmp_path / 'bag', stack=2)
    assert 'would fit' in report.notes['sample_interval']
    report = convert_segy(path, tmp_path / 'good', stack=2, sample_spacing=0.4)
    assert 'sample_interval' not in report.notes
    assert report.messages == {'/position': 10, '/trace': 20}
    own = parameters_of(tmp_path / 'good')
    assert own['pulse'] == 'gaussian' and own['pulse_width'] == pytest.approx(0.6, rel=0.05)
    assert own['min_separation'] == pytest.approx(3 * own['pulse_width'])
    with BagReader(tmp_path / 'good') as bag:
        places = read_positions(bag)
    assert places.latitude == pytest.approx(np.full(10, 17.13), abs=1e-6)
    east, north = places.at(places.stamp_ns[:2] + np.array([500_000_000, -60 * 10**9]))
    assert east[0] == pytest.approx(places.longitude[:2].mean(), abs=1e-9)
    assert np.isnan(east[1]) and np.isnan(north[1])


def test_what_is_no_envelope_is_left_alone(tmp_path):
    path = profile(tmp_path / 'line.seg', ECHO - 100.0, arcsec=False)
    report = convert_segy(path, tmp_path / 'bag', sample_spacing=0.4)
    assert report.messages == {'/trace': 40} and 'pulse' not in report.notes
    assert not (tmp_path / 'bag' / 'parameters.yaml').exists()
    path = profile(tmp_path / 'deaf.seg', ECHO[:, 40:])
    report = convert_segy(path, tmp_path / 'deaf', sample_spacing=0.4)
    assert 'no floor stands free' in report.notes['pulse']


def envelopes(*, gas=0.0, steep=0.0, growth=0.0, seed=1):
    """Envelopes (400, 200), .1 m apart, of a pulse of .3 m on a floor that rises by `steep` m from
    trace to trace, and falls; `gas`: share of arrivals that are up to six times as broad; noise of
    .02 that grows by exp(growth)."""
    rng, rows, z = np.random.default_rng(seed), np.arange(400), 0.1 * np.arange(200)
    floor = 6.0 + 2.0 * np.sin(rows / 40.0) + steep * np.abs(rows % 20 - 10)
    width = 0.3 * (1.0 + (rng.random(400) < gas) * rng.uniform(1.0, 5.0, 400))
    away = z - floor[:, None]

    def complex_noise(rms):
        return rms * np.sqrt(0.5) * (rng.standard_normal((2, 400, 200)).T @ [1.0, 1j]).T

    phase = np.exp(2j * np.pi * rng.random(400))[:, None]
    field = np.exp(-0.5 * np.square(away / width[:, None])) * phase
    field = field + complex_noise(0.15) * np.where(away > 0.0, np.exp(-away / 3.0), 0.0)
    return np.abs(field + complex_noise(0.02) * np.exp(growth * z / z[-1]))


def test_scatter_and_slopes_do_not_widen_the_pulse():
    """Gas makes most arrivals up to six times as broad: so is their median."""
    for gas, steep, most in ((0.0, 0.0, 1.25), (0.8, 0.0, 4.5), (0.0, 0.3, 1.25), (0.5, 0.3, 4.5)):
        pulse, _ = measured_instrument(envelopes(gas=gas, steep=steep), 0.1)
        assert 0.75 * 0.3 < pulse < most * 0.3


def test_the_same_pulse_from_few_and_many_traces():
    """Not from what is loudest, which is the transmit pulse, whose end is much steeper or not."""
    plain = np.concatenate([envelopes(seed=seed) for seed in range(3, 8)])
    # The first samples of each trace, louder than any floor.
    rung = plain + 3.0 * np.exp(-np.maximum(np.arange(200) - 25, 0.0) / 2.0)
    for many in (plain, rung):
        pulses = [measured_instrument(each, 0.1)[0] for each in (many[:60], many[:400], many)]
        assert pulses == pytest.approx([0.3] * 3, rel=0.2)
        assert max(pulses) < 1.12 * min(pulses)


def test_noise_that_grows_with_the_depth_is_measured_and_stated(tmp_path):
    grown = envelopes(growth=3.0)
    _, found = measured_instrument(grown, 0.1)
    # Just below the floor what scatters there cannot be told from it.
    ratio = found / (0.02 * np.exp(3.0 * np.linspace(0.0, 1.0, 200)))
    assert ratio.min() > 0.7 and np.delete(ratio, np.arange(40, 110)).max() < 1.45
    path = profile(tmp_path / 'in.sgy', grown)
    report = convert_segy(path, tmp_path / 'out', sample_spacing=0.1)
    assert 'growing with the depth' in report.notes['pulse']
    assert parameters_of(tmp_path / 'out')['noise_sigma'] == 0.0
    trace = measured(tmp_path / 'out', 'fathometer')[0]
    assert trace.sigma[-1] > 10.0 * trace.sigma[0]


def test_as_many_reflectors_as_the_window_holds():
    """A pulse too broad for six reflectors in the window: fewer, and no run refused for that."""
    broad = envelope_parameters(2.6, 0.1, 27.8)
    assert broad['order_max'] == 3 and broad['order_max'] * broad['min_separation'] <= 27.8
    assert envelope_parameters(0.5, 0.1, 27.8) == envelope_parameters(0.5, 0.1)
    assert envelope_parameters(50.0, 0.1, 27.8)['order_max'] == 1


LATE = np.arange(7)


def test_segy_traces_have_their_depth_and_time_and_are_cut_and_stacked(tmp_path):
    """Of seven traces every 100 us, four a second, of a recorder that starts late."""
    line = write_segy(
        tmp_path / 'line.seg', 100 * LATE[:, None] + np.arange(30), 3, YearDataRecorded=2018,
        DayOfYear=72, HourOfDay=23, MinuteOfHour=11, SecondOfMinute=24 + LATE // 4,
        TRACE_SAMPLE_INTERVAL=100, DelayRecordingTime=20,
    )  # fmt: skip
    report = convert_segy(line, tmp_path / 'bag', depth_offset=2.0)
    traces = measured(tmp_path / 'bag', 'fathometer')
    assert report.messages == {'/trace': 7}
    assert np.allclose(traces[0].depth, 2.0 + 15.0 + 0.075 * np.arange(30), atol=1e-5)
    assert list(traces[3].amplitude) == list(300.0 + np.arange(30))
    start = 1520982684 * 10**9  # 2018-03-13 23:11:24 UTC
    assert [trace.stamp_ns - start for trace in traces[:5]] == [k * 10**9 // 4 for k in range(5)]
    how = {'sample_spacing': 0.376, 'first_sample': 12, 'samples': 8, 'stack': 3}
    convert_segy(line, tmp_path / 'cut', **how)
    traces = measured(tmp_path / 'cut', 'fathometer')
    assert len(traces) == 2 and len(traces[0]) == 8
    assert np.allclose(traces[0].depth[0], 15.0 + 12 * 0.376)
    assert list(traces[1].amplitude) == list(400.0 + np.arange(12, 20))


def test_without_segyio_the_command_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'segyio', None)
    path = tmp_path / 'line.seg'
    path.touch()
    assert main(['convert', 'segy', str(path), str(tmp_path / 'bag')]) == 2
    assert "pip install 'sonar_imm[segy]'" in capsys.readouterr().err
