# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Files of sonars and folders of pictures as bags: what is taken, and what is said of bad ones."""

import math
import os
import pickle
import sys

from helpers.field_files import measured
from helpers.sonar_files import place_of, side_scan, xtf_head, xtf_ping, xtf_soundings
import numpy as np
import pytest
import yaml

from msg_adapters.soundings import read_ground
from sonar_imm.measurements import Detections, Navigation, Rejection, Snapshot
from sonar_imm_tools.recordings.conversion import ConversionReport
from sonar_imm_tools.recordings.convert import convert_pictures, convert_xtf, sniff
from sonar_imm_tools.recordings.convert import xtf as xtf_files
from sonar_imm_tools.recordings.convert.xtf import pings_of
from sonar_imm_tools.recordings.convert_options import XtfOptions
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

SIDES = [('port', 'port', 'uint16'), ('stbd', 'starboard', 'uint16')]

TOWED = {'ShipYcoordinate': 54.0, 'ShipXcoordinate': 10.0, 'Layback': 25.0}
TOO_FAR = 'up to 25 m behind'


def read(bag, system, kind):
    return [item for item in measured(bag, system) if isinstance(item, kind)]


def echo(at, bins=500):
    """Noise, the same in every ping, with an echo in bin `at`; none for a negative one."""
    row = np.round(200.0 * np.sqrt(np.random.default_rng(3).exponential(size=bins)))
    if at >= 0:
        row[at] = 20_000.0
    return row.astype('u2')


def xtf(path, pings, channels=SIDES, **head):
    start = xtf_head(channels)
    for name, value in head.items():
        setattr(start, name, value)
    path.write_bytes(b''.join([start.to_bytes(), *pings]))
    return path


def some(count, **more):
    return [xtf_ping(0.2 * k, [echo(-1), echo(300)], **more) for k in range(count)]


class TestXtf:
    pytestmark = [pytest.mark.filterwarnings('ignore')]

    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip('pyxtf')

    def test_echoes_of_a_side_navigation_and_altitude(self, tmp_path):
        report = convert_xtf(side_scan(tmp_path / 'a.xtf'), tmp_path / 'bag')
        assert report.messages == {'/detections': 60, '/nav': 60, '/altitude': 60}
        assert report.notes['samples'].startswith('magnitude only')
        pings = read(tmp_path / 'bag', 'obstacle', Detections)
        seen = np.array([len(ping) for ping in pings])
        assert seen.sum() >= 9 and not seen[:20].any() and not seen[40:].any()
        found = pings[30]
        assert found.range == pytest.approx([30.05], abs=0.06) and found.bearing[0] == 0.0
        nav = read(tmp_path / 'bag', 'obstacle', Navigation)[-1]
        # 60 pings at 0.2 s and 0.5 m/s, heading east, 5 m deep
        assert nav.position == pytest.approx([5.9, 0.0, -5.0], abs=0.05)
        assert nav.orientation == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-9)
        assert pings[0].stamp_ns == 1_717_149_600 * 10**9

    @pytest.mark.parametrize(
        'side, order, at, degrees',
        [
            ('port', 'far', 199, 90.0),
            ('port', 'near', 300, 90.0),
            ('starboard', 'far', 300, -90.0),
        ],
    )
    def test_the_order_of_samples_and_the_narrow_high_beam_abeam(
        self, tmp_path, side, order, at, degrees
    ):
        path = xtf(tmp_path / 'a.xtf', [xtf_ping(0.0, [echo(300), echo(300)])])
        convert_xtf(path, tmp_path / 'bag', side=side, port_samples=order)
        (ping,) = read(tmp_path / 'bag', 'obstacle', Detections)
        assert ping.range == pytest.approx([(at + 0.5) * 0.1], abs=0.06)
        given = yaml.safe_load((tmp_path / 'bag' / 'parameters.yaml').read_text())
        (given,) = (each['ros__parameters'] for each in given.values())
        assert given['sonar_mount_rpy_deg'] == [0.0, 0.0, degrees]
        assert (given['horizontal_fov_deg'], given['vertical_fov_deg']) == (3.0, 80.0)

    def test_degrees_that_a_file_calls_metres_are_asked(self, tmp_path):
        pings = side_scan(tmp_path / 'a.xtf').read_bytes()[1024:]
        path = xtf(tmp_path / 'a.xtf', [pings], NavUnits=0)
        with pytest.raises(BagError, match='--units degrees'):
            convert_xtf(path, tmp_path / 'bag')
        convert_xtf(path, tmp_path / 'bag', units='degrees')
        nav = read(tmp_path / 'bag', 'obstacle', Navigation)[-1]
        assert nav.position == pytest.approx([5.9, 0.0, -5.0], abs=0.05)
        convert_xtf(path, tmp_path / 'metres', units='metres')
        nav = read(tmp_path / 'metres', 'obstacle', Navigation)[-1]
        assert nav.position[:2] == pytest.approx([10.0, 54.0], abs=0.01)

    @pytest.mark.parametrize(
        'units, wanted',
        [(3, 'its places are degrees, and they are'), (7, 'does not say the unit')],
    )
    def test_metres_that_a_file_calls_otherwise_are_asked(self, tmp_path, units, wanted):
        pings = [xtf_ping(0.2 * k, [echo(-1), echo(300)], (5e6, 4e5 + k)) for k in range(9)]
        path = xtf(tmp_path / 'a.xtf', pings, NavUnits=units)
        with pytest.raises(BagError, match=f'{wanted}.*400000, 5000000.*--units metres'):
            convert_xtf(path, tmp_path / 'bag')
        convert_xtf(path, tmp_path / 'bag', units='metres')
        nav = read(tmp_path / 'bag', 'obstacle', Navigation)[-1]
        assert nav.position[:2] == pytest.approx([4e5 + 8.0, 5e6])

    def test_a_file_of_the_other_side_names_its_option(self, tmp_path):
        pings = [xtf_ping(0.2 * k, [echo(300)]) for k in range(3)]
        path = xtf(tmp_path / 'a.xtf', pings, SIDES[:1])
        with pytest.raises(BagError, match='channels of port alone: --side port'):
            convert_xtf(path, tmp_path / 'bag')
        assert convert_xtf(path, tmp_path / 'bag', side='port').messages['/detections'] == 3

    def test_metres_near_the_origin_are_no_question(self, tmp_path):
        pings = [xtf_ping(0.2 * k, [echo(-1), echo(300)], (5.0, 0.1 * k)) for k in range(9)]
        path = xtf(tmp_path / 'a.xtf', pings, NavUnits=0)
        assert not convert_xtf(path, tmp_path / 'bag').questions

    def test_the_frequency_of_several_channels_is_chosen(self, tmp_path):
        channels = [('low', 'starboard', 'uint16'), ('high', 'starboard', 'uint16')]
        head = xtf_head(channels)
        for info, frequency in zip(head.ChanInfo, (100.0, 500.0)):
            info.Frequency = frequency
        pings = [xtf_ping(0.2 * k, [echo(100), echo(300)]) for k in range(3)]
        (tmp_path / 'a.xtf').write_bytes(b''.join([head.to_bytes(), *pings]))
        for frequency, at in ((None, 100), (480e3, 300), (90e3, 100)):
            out = tmp_path / f'{frequency}'
            report = convert_xtf(tmp_path / 'a.xtf', out, frequency=frequency)
            assert '100000, 500000 Hz' in report.notes['frequencies']
            for ping in read(out, 'obstacle', Detections):
                assert ping.range == pytest.approx([(at + 0.5) * 0.1], abs=0.06)

    @pytest.mark.parametrize(
        ('more', 'row', 'words'),
        [
            ({}, echo(300), ''),
            ({'SensorHeading': 0.0}, echo(300), 'the heading is 0 in all 3 pings'),
            ({}, echo(-1), 'no echo was found in 3 pings of starboard'),
            ({}, np.maximum(echo(300), 65_535 * (np.arange(500) < 9)).astype('u2'), '1.8% of'),
            ({**TOWED, 'SensorYcoordinate': 0.0, 'SensorXcoordinate': 0.0}, echo(300), TOO_FAR),
            (TOWED, echo(300), TOO_FAR),
        ],
    )
    def test_what_looks_wrong_is_asked(self, tmp_path, more, row, words):
        pings = [xtf_ping(0.2 * k, [echo(-1), row], **more) for k in range(3)]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert words in ' '.join(report.questions) and bool(report.questions) == bool(words)

    def test_a_channel_of_phases_makes_snapshots(self, tmp_path):
        channels = [('amplitude', 'starboard', 'uint16'), ('phase 1', 'starboard', 'float32')]
        turn = np.linspace(-3.0, 3.0, 500).astype('f4')
        path = xtf(tmp_path / 'a.xtf', [xtf_ping(0.0, [echo(-1), turn])], channels)
        report = convert_xtf(path, tmp_path / 'bag', element_spacing=0.0017)
        assert report.notes['samples'] == 'amplitudes and phases'
        (snapshot,) = read(tmp_path / 'bag', 'bathymetry', Snapshot)
        loud = np.abs(snapshot.iq[:, 0]) > 0.0
        angle = np.angle(snapshot.iq[:, 1] * snapshot.iq[:, 0].conj())
        assert angle[loud] == pytest.approx(turn[loud], abs=1e-5)
        assert np.abs(snapshot.iq[:, 0]) == pytest.approx(echo(-1))
        assert snapshot.side == 'starboard' and snapshot.staves == 2
        assert snapshot.range[0] == pytest.approx(0.05) and snapshot.frequency == 450e3

    def test_a_channel_of_phases_for_each_stave(self, tmp_path):
        names = ['amplitude', 'phase 1', 'phase 2']
        channels = [(name, 'port', 'float32') for name in names]
        size = np.linspace(1.0, 2.0, 50).astype('f4')
        turns = [np.linspace(-1.0, 1.0, 50).astype('f4'), np.linspace(2.0, 0.5, 50).astype('f4')]
        path = xtf(tmp_path / 'a.xtf', [xtf_ping(0.0, [size, *turns])], channels)
        convert_xtf(path, tmp_path / 'bag')
        (snapshot,) = read(tmp_path / 'bag', 'bathymetry', Snapshot)
        wanted = size[::-1, None] * np.exp(1j * np.column_stack(turns)[::-1])
        assert snapshot.iq == pytest.approx(wanted, rel=1e-5)
        assert snapshot.side == 'port'

    def test_soundings_of_a_multibeam_are_ground_and_other_packets_are_named(self, tmp_path):
        raw = bytearray(xtf_soundings(0.1, [(0.0, 0.0, 9.0)]))
        raw[2] = 2  # bathymetry as the vendor has it
        beams = [(-10.0, 2.0, 20.0), (10.0, -2.0, 21.0), (0.0, 0.0, 0.0)]
        pings = [xtf_soundings(0.0, beams), raw, xtf_soundings(0.2, beams, place_of(3.0, 0.0))]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings, []), tmp_path / 'bag')
        assert report.messages == {'/ground': 2, '/nav': 2, '/altitude': 2}
        assert report.notes['packets not taken'] == '1 bathy'
        assert 'samples' not in report.notes and not report.problems
        with BagReader(tmp_path / 'bag') as bag:
            grounds = [read_ground(item.message) for item in bag.messages(['/ground'])]
        for x, ground in zip((0.0, 3.0), grounds):
            wanted = [[x - 10.0, 2.0, -20.0], [x + 10.0, -2.0, -21.0]]
            assert ground.position == pytest.approx(np.array(wanted), abs=0.02)

    def test_what_came_before_the_damage_is_kept(self, tmp_path):
        whole = xtf(tmp_path / 'a.xtf', some(5)).read_bytes()
        (tmp_path / 'cut.xtf').write_bytes(whole[:-900])
        report = convert_xtf(tmp_path / 'cut.xtf', tmp_path / 'bag')
        assert report.messages['/detections'] == 4
        assert report.problems == ['cut.xtf: a ping is cut off; what came before it is kept']

    @pytest.mark.parametrize(
        'content, wanted',
        [
            (b'', 'the head of the file is cut off'),
            (b'\x7b' + bytes(100), 'the head of the file is cut off'),
            (b'\x7a' + bytes(2000), 'version of the file is 122'),
            (b'\x7b' + bytes(1023), 'holds nothing that could be converted'),
        ],
    )
    def test_nothing_of_use_is_one_sentence(self, tmp_path, content, wanted):
        (tmp_path / 'a.xtf').write_bytes(content)
        with pytest.raises(BagError, match=wanted) as caught:
            convert_xtf(tmp_path / 'a.xtf', tmp_path / 'bag')
        assert '\n' not in str(caught.value) and not (tmp_path / 'bag').exists()

    def test_positions_at_zero_are_none_and_are_counted(self, tmp_path):
        pings = [*some(3, place=(0.0, 0.0)), xtf_ping(0.8, [echo(-1), echo(300)])]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.messages['/nav'] == 1 and report.messages['/detections'] == 4
        assert any('3 pings have no position' in problem for problem in report.problems)

    def test_a_clock_that_is_off_once_one_that_was_set_and_a_ping_without_time(self, tmp_path):
        seconds = [0.0, 0.2, 1e8, 0.4, 0.6, 7200.0, 7200.2, 7200.4]
        pings = [xtf_ping(second, [echo(-1), echo(300)]) for second in seconds]
        pings.append(xtf_ping(7200.6, [echo(-1), echo(3)], Month=13))
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.messages['/detections'] == 7
        assert report.reasons == {'clock off': 1, 'no time': 1}
        assert any('jumps by 7199.4 s and stays' in problem for problem in report.problems)

    def test_an_index_beside_the_file_is_not_unpickled(self, tmp_path):
        class Trap:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / 'sprung'),)

        path = xtf(tmp_path / 'a.xtf', some(2))
        (tmp_path / 'a.pyxtf_idx').write_bytes(pickle.dumps(Trap()))
        assert convert_xtf(path, tmp_path / 'bag').messages['/detections'] == 2
        assert not (tmp_path / 'sprung').exists()

    def test_it_reads_what_the_reader_of_the_library_reads(self, tmp_path):
        pyxtf = pytest.importorskip('pyxtf')
        path = side_scan(tmp_path / 'a.xtf')
        beams = [(-10.0, 2.0, 20.0), (10.0, -2.0, 21.0)]
        path.write_bytes(path.read_bytes() + xtf_soundings(12.0, beams))
        _, *packets = pyxtf.xtf_read_gen(str(path))
        pings = list(pings_of(path, ConversionReport(tmp_path)))
        assert len(packets) == len(pings) == 61
        for packet, ping in zip(packets, pings):
            assert ping['stamp_ns'] == packet.get_time().astype('datetime64[ns]').astype(int)
            assert ping['place'] == (packet.SensorXcoordinate, packet.SensorYcoordinate)
            names = ('SensorHeading', 'SensorPitch', 'SensorRoll', 'SensorDepth')
            stated = [getattr(packet, name) for name in names]
            assert [ping[name] for name in ('heading', 'pitch', 'roll', 'depth')] == stated
        for packet, ping in zip(packets[:-1], pings):
            for samples, channel in zip(packet.data, ping['channels'], strict=True):
                assert channel['samples'].dtype == samples.dtype
                assert np.array_equal(channel['samples'], samples)
        assert pings[-1]['soundings'].tolist() == np.array(beams).tolist()

    def test_a_file_in_pieces_and_noise_are_one_sentence_each(self, tmp_path):
        rng = np.random.default_rng(1)
        pings = [*some(2), xtf_soundings(0.4, [(0.0, 0.0, 20.0)])]
        whole = xtf(tmp_path / 'a.xtf', pings).read_bytes()
        ends = np.cumsum([1024, *map(len, pings)])
        used = ends - [0, 48, 48, 0]  # bytes that fill a ping of side scan up are no loss
        for size in range(1000, len(whole), 31):
            (tmp_path / 'a.xtf').write_bytes(whole[:size])
            report = ConversionReport(tmp_path)
            assert len(list(pings_of(tmp_path / 'a.xtf', report))) == np.sum(used[1:] <= size)
            between = not any(used[k] <= size <= ends[k] for k in range(4))
            assert len(report.problems) == between
        for _ in range(100):
            (tmp_path / 'a.xtf').write_bytes(whole[: rng.integers(1, 1300)] + rng.bytes(3000))
            report = ConversionReport(tmp_path)
            list(pings_of(tmp_path / 'a.xtf', report))
            assert len(report.problems) == 1 and '\n' not in report.problems[0]

    @pytest.mark.parametrize('kind', [0, 17, 6, 200])
    def test_a_packet_that_states_another_length(self, tmp_path, kind):
        """Of 3 GB, in a file that has them, nothing is read."""
        for length in (0, 1, 13, 100, 255, (64 << 20) + 1, 3 << 30, 2**32 - 1):
            odd = bytearray(some(1)[0])
            odd[2], odd[10:14] = kind, length.to_bytes(4, 'little')
            path = xtf(tmp_path / 'a.xtf', [*some(2), bytes(odd)])
            if length == 3 << 30:
                os.truncate(path, path.stat().st_size + length)
            report = ConversionReport(tmp_path)
            assert len(list(pings_of(path, report))) == 2, length
            assert len(report.problems) == 1 and 'kept' in report.problems[0]

    def test_packets_of_other_types_are_passed_over(self, tmp_path):
        """The library breaks down at a serial port's, and knows nothing of the last one."""
        other = bytes.fromhex('cefa') + bytes([6]) + bytes(7) + (64).to_bytes(4, 'little')
        strange = other.ljust(64, b'\1')[:2] + b'\xfa' + other.ljust(64, b'\1')[3:]
        pings = [other.ljust(64, b'\1'), *some(2), strange]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.messages['/detections'] == 2 and not report.problems
        assert report.notes['packets not taken'] == '1 raw_serial, 1 250'

    def test_a_ping_too_long_for_an_image_is_counted_and_a_pipe_is_not_waited_for(self, tmp_path):
        channels = [('stbd', 'starboard', 'uint8')]
        pings = [xtf_ping(0.2 * k, [np.zeros(n, 'u1')]) for k, n in enumerate([500, 4_000_001])]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings, channels), tmp_path / 'bag')
        assert report.messages['/detections'] == 1 and report.reasons == {'too large': 1}
        os.mkfifo(tmp_path / 'b.xtf')
        with pytest.raises(BagError, match='this is no file'):
            convert_xtf(tmp_path / 'b.xtf', tmp_path / 'none')

    def test_a_missing_library_is_named_with_its_extra(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, 'pyxtf', None)
        path = tmp_path / 'a.xtf'
        path.write_bytes(b'\x7b' + bytes(2000))
        with pytest.raises(BagError, match=r'a.xtf needs pyxtf: .*sonar_imm\[xtf\]'):
            convert_xtf(path, tmp_path / 'bag')


@pytest.fixture
def folder(tmp_path):
    """Pictures of 100 ranges by 41 beams, an echo ahead that comes nearer."""
    image = pytest.importorskip('PIL.Image')
    inside, rows = tmp_path / 'frames', ['file,time_utc,x,y,heading,depth']
    inside.mkdir()
    rng = np.random.default_rng(2)
    for k in range(6):
        pixels = np.round(3.0 * np.sqrt(rng.exponential(size=(100, 41))))
        pixels[60 - k, 5] = 200.0
        image.fromarray(pixels.astype('u1')).save(inside / f'{k}.png')
        rows.append(f'{k}.png,{1_717_149_600 + k},{0.4 * k},0,90,3')
    (inside / 'stamps.csv').write_text('\n'.join(rows))
    return inside


def test_a_folder_of_pictures(tmp_path, folder):
    assert sniff(folder).kind == 'pictures'
    report = convert_pictures(folder, tmp_path / 'bag', far_range=40.0, fov=82.0)
    assert report.messages == {'/detections': 6, '/nav': 6}
    pings = read(tmp_path / 'bag', 'obstacle', Detections)
    assert [ping.range[0] for ping in pings] == pytest.approx(0.4 * (60.5 - np.arange(6)), abs=0.2)
    assert pings[0].bearing[0] == pytest.approx(np.radians(30.0), abs=0.02)
    nav = read(tmp_path / 'bag', 'obstacle', Navigation)[5]
    assert nav.position == pytest.approx([2.0, 0.0, -3.0])


def test_pictures_that_cannot_be_used_are_counted(tmp_path, folder):
    image = pytest.importorskip('PIL.Image')
    (folder / '1.png').write_bytes(b'no picture')
    (folder / '2.png').unlink()
    text = (folder / 'stamps.csv').read_text()
    (folder / 'stamps.csv').write_text(text.replace('3.png', '../../etc/passwd'))
    (folder / '4.png').write_bytes(b'%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n')
    image.new('L', (4_000_001, 1)).save(folder / '5.png')
    report = convert_pictures(folder, tmp_path / 'bag', far_range=40.0, fov=82.0)
    assert report.messages['/detections'] == 1 and report.reasons == {'no picture': 5}
    problems = ' '.join(report.problems)
    assert 'outside of the folder' in problems and 'too many pixels' in problems
    assert "'4.png' cannot be read: cannot identify image file" in problems
    with pytest.raises(BagError, match='--far-range and --fov'):
        convert_pictures(folder, tmp_path / 'none')
    (folder / 'other.csv').write_text('file\n')
    with pytest.raises(BagError, match='2 CSV files; name the one'):
        convert_pictures(folder, tmp_path / 'none')


# -- numbers of side scan: ranges, phases and what is said of a file, by hand


PING = {'stamp_ns': 1, 'sound_speed': 1500.0, 'nav': None}


def channel(samples=(1, 2, 3), **changes):
    values = {'slant_range': 75.0, 'delay': 0.0, 'name': '', 'side': 'port', 'frequency': 4.55e5}
    return {**values, 'samples': np.array(samples), **changes}


@pytest.mark.parametrize(
    'delay, near', [(0.0, 0.0), (0.01, 7.5), (9.99, 7492.5), (10.0, 0.0), (-1.0, 0.0)]
)
def test_a_sample_lies_in_the_middle_of_its_bin_and_the_delay_is_there_and_back(delay, near):
    ranges = xtf_files._ranges(channel(delay=delay), 1500.0)
    assert ranges == pytest.approx(near + np.array([12.5, 37.5, 62.5]))


@pytest.mark.parametrize('far', [0.0, -1.0, math.nan, math.inf, 10_000.1])
def test_a_slant_range_that_no_sonar_has_is_refused(far):
    assert xtf_files._ranges(channel(slant_range=10_000.0), 1500.0)[-1] == pytest.approx(8333.333)
    with pytest.raises(Rejection, match='slant range'):
        xtf_files._ranges(channel(slant_range=far), 1500.0)


@pytest.mark.parametrize(
    'samples, radians_per_count, turn',
    [
        (np.array([16384], np.int16), None, 0.5 * math.pi),
        (np.array([-16384], np.int16), None, -0.5 * math.pi),
        (np.array([64], np.uint8), None, 0.5 * math.pi),
        (np.array([0.25], np.float32), None, 0.25),
        (np.array([8], np.int16), 0.125, 1.0),
    ],
)
def test_the_range_of_whole_numbers_is_one_turn(samples, radians_per_count, turn):
    assert xtf_files._turns(samples, radians_per_count) == pytest.approx([turn])


def test_a_phase_is_that_of_stave_one_against_stave_zero():
    channels = [channel([4, 4]), channel(np.array([0, 16384], np.int16), name='Phase')]
    made = xtf_files._interferometer(PING, 'port', channels, XtfOptions())
    assert made.iq == pytest.approx(np.array([[4.0, 4.0], [4.0, 4.0j]]), abs=1e-6)
    assert made.sample_rate == pytest.approx(0.5 * 1500.0 / 37.5) and made.side == 'port'
    assert xtf_files._interferometer(PING, 'port', channels[:1], XtfOptions()) is None


@pytest.mark.parametrize('order, first', [('far', 3.0), ('near', 1.0)])
def test_port_may_be_told_from_far_to_near(order, first):
    ping = {'channels': [channel(), channel(side='starboard'), channel(side='', samples=[9])]}
    found = xtf_files._sides(ping, order)
    assert found['port'][0]['samples'][0] == first
    assert found['starboard'][0]['samples'][0] == 1.0 and set(found) == {'port', 'starboard'}


@pytest.mark.parametrize(
    'clipped, top, full',
    [(0, 32767, 0), (1, 32767, 1), (2, 32767, 2), (2, 4095, 2), (9, 4000, 0), (50, 15, 0)],
)
def test_more_than_a_hundredth_at_full_scale_is_said(clipped, top, full, tmp_path):
    samples = np.ones(100, np.int16)
    samples[:clipped] = top
    how, report, channels = XtfOptions(), ConversionReport(tmp_path), [channel(samples)]
    seen = xtf_files._Seen(how)
    seen.image(channels, 1)
    seen.tell(tmp_path / 'a.xtf', report)
    assert seen.clipped == full and seen.samples == 100
    assert any('full scale' in question for question in report.questions) == (full > 1)


def test_samples_at_full_scale_are_those_of_the_frequency_that_is_used(tmp_path):
    loud, calm = np.full(100, 32767, np.int16), np.ones(100, np.int16)
    channels = [channel(loud, frequency=4e5), channel(calm, frequency=9e5)]
    for frequency, clipped in ((None, 100), (4.1e5, 100), (8e5, 0)):
        seen = xtf_files._Seen(XtfOptions(frequency=frequency))
        magnitudes = xtf_files._magnitudes(channels, seen.how)
        image = xtf_files._image(PING, magnitudes[0], seen.how)
        seen.image(magnitudes, 1)
        assert seen.clipped == clipped and (image.amplitude.max() == 32767) == (clipped > 0)
        report = ConversionReport(tmp_path)
        seen.tell(tmp_path / 'a.xtf', report)
        assert '--frequency HZ' in report.notes['frequencies']
