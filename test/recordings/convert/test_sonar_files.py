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
from sonar_imm.measurements import Detections, Navigation, Snapshot
from sonar_imm_tools.recordings.conversion import ConversionReport
from sonar_imm_tools.recordings.convert import convert_pictures, convert_xtf, sniff
from sonar_imm_tools.recordings.convert.xtf import _sides, pings_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

SIDES = [('port', 'port', 'uint16'), ('stbd', 'starboard', 'uint16')]

TOWED = {'ShipYcoordinate': 54.0, 'ShipXcoordinate': 10.0, 'Layback': 25.0}


def read(bag, kind, system='obstacle'):
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


@pytest.fixture
def library():
    return pytest.importorskip('pyxtf')


@pytest.mark.filterwarnings('ignore')
@pytest.mark.usefixtures('library')
class TestXtf:
    @pytest.fixture
    def convert(self, tmp_path):
        """Write pings and convert them; the folder is `out`."""

        def run(pings, channels=SIDES, out='bag', head=None, **options):
            path = xtf(tmp_path / 'a.xtf', pings, channels, **(head or {}))
            return convert_xtf(path, tmp_path / out, **options)

        return run

    def test_echoes_of_a_side_navigation_and_altitude(self, tmp_path):
        report = convert_xtf(side_scan(tmp_path / 'a.xtf'), tmp_path / 'bag')
        assert report.messages == {'/detections': 60, '/nav': 60, '/altitude': 60}
        assert report.notes['samples'].startswith('magnitude only')
        pings = read(tmp_path / 'bag', Detections)
        seen = np.array([len(ping) for ping in pings])
        assert seen.sum() >= 9 and not seen[:20].any() and not seen[40:].any()
        assert pings[30].range == pytest.approx([30.05], abs=0.06) and pings[30].bearing[0] == 0.0
        nav = read(tmp_path / 'bag', Navigation)[-1]
        # 60 pings at 0.2 s and 0.5 m/s, heading east, 5 m deep
        assert nav.position == pytest.approx([5.9, 0.0, -5.0], abs=0.05)
        assert nav.orientation == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-9)
        assert pings[0].stamp_ns == 1_717_149_600 * 10**9

    def test_the_order_of_samples_and_the_narrow_high_beam_abeam(self, convert):
        for k, (side, order, at, degrees) in enumerate((
            ('port', 'far', 199, 90.0), ('port', 'near', 300, 90.0),
            ('starboard', 'far', 300, -90.0),
        )):  # fmt: skip
            pings, how = [xtf_ping(0.0, [echo(300)] * 2)], {'side': side, 'port_samples': order}
            bag = convert(pings, out=f'{k}', **how).path
            (ping,) = read(bag, Detections)
            assert ping.range == pytest.approx([(at + 0.5) * 0.1], abs=0.06)
            given = yaml.safe_load((bag / 'parameters.yaml').read_text())
            (given,) = (each['ros__parameters'] for each in given.values())
            assert given['sonar_mount_rpy_deg'] == [0.0, 0.0, degrees]
            assert (given['horizontal_fov_deg'], given['vertical_fov_deg']) == (3.0, 80.0)

    def test_places_in_units_that_the_file_calls_otherwise_are_asked(self, convert, tmp_path):
        degrees = [side_scan(tmp_path / 'a.xtf').read_bytes()[1024:]]
        metres = [xtf_ping(0.2 * k, [echo(-1), echo(300)], (5e6, 4e5 + k)) for k in range(9)]
        far = '.*400000, 5000000.*--units metres'
        for stated, pings, words, units, place in (
            (0, degrees, '--units degrees', 'degrees', [5.9, 0.0]),
            (0, degrees, '--units degrees', 'metres', [10.0, 54.0]),
            (3, metres, f'its places are degrees, and they are{far}', 'metres', [4e5 + 8.0, 5e6]),
            (7, metres, f'does not say the unit{far}', 'metres', [4e5 + 8.0, 5e6]),
        ):
            with pytest.raises(BagError, match=words):
                convert(pings, head={'NavUnits': stated})
            out = f'{stated}_{units}'
            convert(pings, out=out, head={'NavUnits': stated}, units=units)
            nav = read(tmp_path / out, Navigation)[-1]
            assert nav.position[:2] == pytest.approx(place, abs=0.05)
        # Metres near the origin are no question.
        near = [xtf_ping(0.2 * k, [echo(-1), echo(300)], (5.0, 0.1 * k)) for k in range(9)]
        assert not convert(near, head={'NavUnits': 0}).questions

    def test_a_file_of_the_other_side_names_its_option(self, convert):
        pings = [xtf_ping(0.2 * k, [echo(300)]) for k in range(3)]
        with pytest.raises(BagError, match='channels of port alone: --side port'):
            convert(pings, SIDES[:1])
        assert convert(pings, SIDES[:1], side='port').messages['/detections'] == 3

    def test_the_frequency_of_several_channels_is_chosen(self, tmp_path):
        """Also where samples at full scale are counted."""
        channels = [('low', 'starboard', 'uint16'), ('high', 'starboard', 'uint16')]
        head = xtf_head(channels)
        for info, frequency in zip(head.ChanInfo, (100.0, 500.0)):
            info.Frequency = frequency
        loud = np.maximum(echo(100), 65_535 * (np.arange(500) % 50 == 0)).astype('u2')
        pings = [xtf_ping(0.2 * k, [loud, echo(300)]) for k in range(3)]
        (tmp_path / 'a.xtf').write_bytes(b''.join([head.to_bytes(), *pings]))
        for frequency, at in ((None, 100), (480e3, 300), (90e3, 100)):
            out = tmp_path / f'{frequency}'
            report = convert_xtf(tmp_path / 'a.xtf', out, frequency=frequency)
            assert '100000, 500000 Hz' in report.notes['frequencies']
            assert '--frequency HZ' in report.notes['frequencies']
            for ping in read(out, Detections):
                assert np.abs(ping.range - (at + 0.5) * 0.1).min() < 0.06
            assert ('full scale' in ' '.join(report.questions)) == (at == 100)

    def test_more_than_a_hundredth_at_full_scale_is_said(self, convert):
        for k, (clipped, top, said) in enumerate([
            (5, 65_535, False), (6, 65_535, True), (6, 4095, True), (45, 4000, False),
            (9, 15, False),
        ]):  # fmt: skip
            row = np.where(np.arange(500) < clipped, top, 1).astype('u2')
            report = convert([xtf_ping(0.0, [echo(-1), row])], out=f'{k}')
            assert any('full scale' in question for question in report.questions) == said

    def test_ranges_count_from_the_delay_and_no_sonar_reaches_farther(self, convert):
        for delay, near in ((0.01, 7.5), (9.0, 6750.0), (10.0, 0.0), (-1.0, 0.0)):
            report = convert([xtf_ping(0.0, [echo(-1), echo(300)], delay=delay)], out=f'{delay}')
            (ping,) = read(report.path, Detections)
            assert ping.range == pytest.approx([near + 30.05], abs=0.06)
        for far in (0.0, -1.0, math.nan, math.inf, 10_000.1):
            with pytest.raises(BagError, match='slant range'):
                convert([xtf_ping(0.0, [echo(-1), echo(300)], slant_range=far)])

    def test_the_range_of_whole_numbers_is_one_turn(self, convert):
        for k, (dtype, sample, how, turn) in enumerate([
            ('uint16', 16384, {}, 0.5 * math.pi), ('uint16', 49152, {}, -0.5 * math.pi),
            ('uint8', 64, {}, 0.5 * math.pi), ('float32', 0.25, {}, 0.25),
            ('uint16', 8, {'radians_per_count': 0.125}, 1.0),
        ]):  # fmt: skip
            channels = [('amplitude', 'starboard', 'uint16'), ('phase 1', 'starboard', dtype)]
            rows = [np.full(50, 4, 'u2'), np.full(50, sample, dtype)]
            report = convert([xtf_ping(0.0, rows)], channels, f'{k}', **how)
            (snapshot,) = read(report.path, Snapshot, 'bathymetry')
            wanted = np.array([4.0, 4.0 * np.exp(1j * turn)])
            assert snapshot.iq[7] == pytest.approx(wanted, abs=1e-5)
            assert snapshot.sample_rate == pytest.approx(0.5 * 1500.0 / 1.0)

    def test_what_looks_wrong_is_asked(self, convert):
        loud = np.maximum(echo(300), 65_535 * (np.arange(500) < 9)).astype('u2')
        nowhere = {'SensorYcoordinate': 0.0, 'SensorXcoordinate': 0.0}
        for k, (more, row, words) in enumerate((
            ({}, echo(300), ''),
            ({'SensorHeading': 0.0}, echo(300), 'the heading is 0 in all 3 pings'),
            ({}, echo(-1), 'no echo was found in 3 pings of starboard'),
            ({}, loud, '1.8% of'),
            ({**TOWED, **nowhere}, echo(300), 'up to 25 m behind'),
            (TOWED, echo(300), 'up to 25 m behind'),
        )):  # fmt: skip
            report = convert(
                [xtf_ping(0.2 * k, [echo(-1), row], **more) for k in range(3)], out=f'{k}'
            )
            assert words in ' '.join(report.questions) and bool(report.questions) == bool(words)

    def test_a_channel_of_phases_makes_snapshots(self, convert):
        channels = [('amplitude', 'starboard', 'uint16'), ('phase 1', 'starboard', 'float32')]
        turn = np.linspace(-3.0, 3.0, 500).astype('f4')
        report = convert([xtf_ping(0.0, [echo(-1), turn])], channels, element_spacing=0.0017)
        assert report.notes['samples'] == 'amplitudes and phases'
        (snapshot,) = read(report.path, Snapshot, 'bathymetry')
        loud = np.abs(snapshot.iq[:, 0]) > 0.0
        angle = np.angle(snapshot.iq[:, 1] * snapshot.iq[:, 0].conj())
        assert angle[loud] == pytest.approx(turn[loud], abs=1e-5)
        assert np.abs(snapshot.iq[:, 0]) == pytest.approx(echo(-1))
        assert snapshot.side == 'starboard' and snapshot.staves == 2
        assert snapshot.range[0] == pytest.approx(0.05) and snapshot.frequency == 450e3
        # One for each stave.
        channels = [(name, 'port', 'float32') for name in ('amplitude', 'phase 1', 'phase 2')]
        size = np.linspace(1.0, 2.0, 50).astype('f4')
        turns = [np.linspace(-1.0, 1.0, 50).astype('f4'), np.linspace(2.0, 0.5, 50).astype('f4')]
        bag = convert([xtf_ping(0.0, [size, *turns])], channels, out='staves').path
        (snapshot,) = read(bag, Snapshot, 'bathymetry')
        wanted = size[::-1, None] * np.exp(1j * np.column_stack(turns)[::-1])
        assert snapshot.iq == pytest.approx(wanted, rel=1e-5) and snapshot.side == 'port'

    def test_soundings_of_a_multibeam_are_ground_and_other_packets_are_named(self, convert):
        raw = bytearray(xtf_soundings(0.1, [(0.0, 0.0, 9.0)]))
        raw[2] = 2  # bathymetry as the vendor has it
        beams = [(-10.0, 2.0, 20.0), (10.0, -2.0, 21.0), (0.0, 0.0, 0.0)]
        pings = [xtf_soundings(0.0, beams), raw, xtf_soundings(0.2, beams, place_of(3.0, 0.0))]
        report = convert(pings, [])
        assert report.messages == {'/ground': 2, '/nav': 2, '/altitude': 2}
        assert report.notes['packets not taken'] == '1 bathy'
        assert 'samples' not in report.notes and not report.problems
        with BagReader(report.path) as bag:
            grounds = [read_ground(item.message) for item in bag.messages(['/ground'])]
        for x, ground in zip((0.0, 3.0), grounds):
            wanted = [[x - 10.0, 2.0, -20.0], [x + 10.0, -2.0, -21.0]]
            assert ground.position == pytest.approx(np.array(wanted), abs=0.02)

    def test_nothing_of_use_is_one_sentence(self, tmp_path, monkeypatch):
        for content, wanted in (
            (b'', 'the head of the file is cut off'),
            (b'\x7b' + bytes(100), 'the head of the file is cut off'),
            (b'\x7a' + bytes(2000), 'version of the file is 122'),
            (b'\x7b' + bytes(1023), 'holds nothing that could be converted'),
            (b'\x7b' + bytes(2000), r'a.xtf needs pyxtf: .*sonar_imm\[xtf\]'),
        ):
            if 'needs' in wanted:
                monkeypatch.setitem(sys.modules, 'pyxtf', None)
            (tmp_path / 'a.xtf').write_bytes(content)
            with pytest.raises(BagError, match=wanted) as caught:
                convert_xtf(tmp_path / 'a.xtf', tmp_path / 'bag')
            assert '\n' not in str(caught.value) and not (tmp_path / 'bag').exists()

    def test_positions_at_zero_are_none_and_are_counted(self, convert):
        report = convert([*some(3, place=(0.0, 0.0)), xtf_ping(0.8, [echo(-1), echo(300)])])
        assert report.messages['/nav'] == 1 and report.messages['/detections'] == 4
        assert any('3 pings have no position' in problem for problem in report.problems)

    def test_a_clock_that_is_off_once_one_that_was_set_and_a_ping_without_time(self, convert):
        seconds = [0.0, 0.2, 1e8, 0.4, 0.6, 7200.0, 7200.2, 7200.4]
        pings = [xtf_ping(second, [echo(-1), echo(300)]) for second in seconds]
        report = convert([*pings, xtf_ping(7200.6, [echo(-1), echo(3)], Month=13)])
        assert report.messages['/detections'] == 7
        assert report.reasons == {'clock off': 1, 'no time': 1}
        assert any('jumps by 7199.4 s and stays' in problem for problem in report.problems)

    def test_an_index_beside_the_file_is_not_unpickled(self, convert, tmp_path):
        class Trap:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / 'sprung'),)

        (tmp_path / 'a.pyxtf_idx').write_bytes(pickle.dumps(Trap()))
        assert convert(some(2)).messages['/detections'] == 2
        assert not (tmp_path / 'sprung').exists()

    def test_it_reads_what_the_reader_of_the_library_reads(self, library, tmp_path):
        path = side_scan(tmp_path / 'a.xtf')
        beams = [(-10.0, 2.0, 20.0), (10.0, -2.0, 21.0)]
        path.write_bytes(path.read_bytes() + xtf_soundings(12.0, beams))
        _, *packets = library.xtf_read_gen(str(path))
        pings = list(pings_of(path, ConversionReport(tmp_path)))
        assert len(packets) == len(pings) == 61
        for packet, ping in zip(packets, pings):
            assert ping['stamp_ns'] == packet.get_time().astype('datetime64[ns]').astype(int)
            assert ping['place'] == (packet.SensorXcoordinate, packet.SensorYcoordinate)
            for name in ('heading', 'pitch', 'roll', 'depth'):
                assert ping[name] == getattr(packet, f'Sensor{name.title()}')
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
            if used[1] - 900 < size < used[1]:
                said = 'a.xtf: a ping is cut off; what came before it is kept'
                assert report.problems == [said]
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

    def test_packets_of_other_types_are_passed_over(self, convert):
        """The library breaks down at a serial port's, and knows nothing of the last one."""
        other = bytes.fromhex('cefa') + bytes([6]) + bytes(7) + (64).to_bytes(4, 'little')
        other = other.ljust(64, b'\1')
        report = convert([other, *some(2), other[:2] + b'\xfa' + other[3:]])
        assert report.messages['/detections'] == 2 and not report.problems
        assert report.notes['packets not taken'] == '1 raw_serial, 1 250'

    def test_a_ping_too_long_for_an_image_is_counted_and_a_pipe_is_not_waited_for(
        self, convert, tmp_path
    ):
        pings = [xtf_ping(0.2 * k, [np.zeros(n, 'u1')]) for k, n in enumerate([500, 4_000_001])]
        report = convert(pings, [('stbd', 'starboard', 'uint8')])
        assert report.messages['/detections'] == 1 and report.reasons == {'too large': 1}
        os.mkfifo(tmp_path / 'b.xtf')
        with pytest.raises(BagError, match='this is no file'):
            convert_xtf(tmp_path / 'b.xtf', tmp_path / 'none')


def test_a_channel_of_no_side_is_passed_over():
    rows = [{'side': side, 'samples': np.arange(3)} for side in ('port', 'starboard', '')]
    assert set(_sides({'channels': rows}, 'near')) == {'port', 'starboard'}


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
    pings = read(tmp_path / 'bag', Detections)
    assert [ping.range[0] for ping in pings] == pytest.approx(0.4 * (60.5 - np.arange(6)), abs=0.2)
    assert pings[0].bearing[0] == pytest.approx(np.radians(30.0), abs=0.02)
    nav = read(tmp_path / 'bag', Navigation)[5]
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
