# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Files of sonars and folders of pictures as bags: what is taken, and what is said of bad ones."""

import importlib.util
import os
import pickle
import platform
import sys

from helpers.sonar_files import (
    BAND,
    ek60,
    ek80,
    FILTERS,
    kmall,
    kongsberg_all,
    place_of,
    PULSE,
    RATE,
    side_scan,
    SLOPE,
    xtf_head,
    xtf_ping,
    xtf_soundings,
)
import numpy as np
import pytest
from scipy import signal
import yaml

from msg_adapters.soundings import read_ground
from sonar_imm.measurements import Detections, Navigation, Snapshot
from sonar_imm_tools.recordings import foreign
from sonar_imm_tools.recordings.convert import (
    convert_ek80,
    convert_kongsberg,
    convert_pictures,
    convert_xtf,
    sonar_files,
)
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sniffing import sniff
from sonar_imm_tools.recordings.sources import BagError

SIDES = [('port', 'port', 'uint16'), ('stbd', 'starboard', 'uint16')]


def read(bag, system, kind):
    with BagReader(bag) as reader:
        found = [item.measurement for item in measurements_of(reader, system)]
    return [item for item in found if isinstance(item, kind)]


def echo(at, bins=500):
    """Noise, the same in every ping, with an echo in bin `at`; none for a negative one."""
    row = np.round(200.0 * np.sqrt(np.random.default_rng(3).exponential(size=bins)))
    if at >= 0:
        row[at] = 20_000.0
    return row.astype('u2')


def xtf(path, pings, channels=SIDES):
    path.write_bytes(b''.join([xtf_head(channels).to_bytes(), *pings]))
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

    @pytest.mark.parametrize('order, at', [('far', 199), ('near', 300)])
    def test_the_order_of_port_samples(self, tmp_path, order, at):
        path = xtf(tmp_path / 'a.xtf', [xtf_ping(0.0, [echo(300), echo(-1)])])
        convert_xtf(path, tmp_path / 'bag', side='port', port_samples=order)
        (ping,) = read(tmp_path / 'bag', 'obstacle', Detections)
        assert ping.range == pytest.approx([(at + 0.5) * 0.1], abs=0.06)

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
        assert 'gives up' in report.problems[0] and 'kept' in report.problems[0]

    def test_a_packet_without_a_length_ends_the_file(self, tmp_path):
        pings = some(3)
        pings[2] = pings[2][:10] + bytes(4) + pings[2][14:]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.messages['/detections'] == 2 and len(report.problems) == 1

    @pytest.mark.parametrize(
        'content, wanted',
        [
            (b'', 'ended|gives up|shorter'),
            (b'\x7b' + bytes(100), 'gives up'),
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

    def test_a_clock_that_is_off_once_and_one_that_was_set(self, tmp_path):
        seconds = [0.0, 0.2, 1e8, 0.4, 0.6, 7200.0, 7200.2, 7200.4]
        pings = [xtf_ping(second, [echo(-1), echo(300)]) for second in seconds]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.messages['/detections'] == 7 and report.reasons == {'clock off': 1}
        assert any('jumps by 7199.4 s and stays' in problem for problem in report.problems)

    def test_a_ping_without_a_time_is_counted(self, tmp_path):
        pings = [*some(2), xtf_ping(0.4, [echo(-1), echo(3)], Month=13)]
        report = convert_xtf(xtf(tmp_path / 'a.xtf', pings), tmp_path / 'bag')
        assert report.reasons == {'no time': 1} and report.messages['/detections'] == 2

    def test_an_index_beside_the_file_is_not_unpickled(self, tmp_path):
        class Trap:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / 'sprung'),)

        path = xtf(tmp_path / 'a.xtf', some(2))
        (tmp_path / 'a.pyxtf_idx').write_bytes(pickle.dumps(Trap()))
        assert convert_xtf(path, tmp_path / 'bag').messages['/detections'] == 2
        assert not (tmp_path / 'sprung').exists()

    def test_where_there_are_no_files_of_descriptors(self, tmp_path, monkeypatch):
        """As on Windows: the file is read by its name, unless an index lies beside it."""
        path, there = xtf(tmp_path / 'a.xtf', some(3)), os.path.exists
        monkeypatch.setattr(
            foreign.os.path,
            'exists',
            lambda each: not str(each).startswith('/dev') and there(each),
        )
        pings = list(foreign.READERS['xtf'](str(path)))
        assert [ping['kind'] for ping in pings] == ['ping'] * 3
        (tmp_path / 'a.pyxtf_idx').write_bytes(b'')
        with pytest.raises(ValueError, match='index of pyxtf beside it'):
            list(foreign.READERS['xtf'](str(path)))

    def test_a_reader_that_hangs_is_stopped(self, tmp_path, monkeypatch):
        monkeypatch.setattr(foreign, 'SILENCE', 3.0)
        os.mkfifo(tmp_path / 'a.xtf')
        with pytest.raises(BagError, match='stopped after 3 s'):
            convert_xtf(tmp_path / 'a.xtf', tmp_path / 'bag')

    def test_a_reader_that_wants_too_much_memory_is_stopped(self, tmp_path):
        """A packet that states 3 GB, in a file that has them."""
        pings = some(2)
        huge = bytearray(pings[0][:14])
        huge[2], huge[10:14] = 200, (3 << 30).to_bytes(4, 'little')
        path = xtf(tmp_path / 'a.xtf', [*pings, bytes(huge)])
        os.truncate(path, path.stat().st_size + (3 << 30))
        report = convert_xtf(path, tmp_path / 'bag')
        assert report.messages['/detections'] == 2
        assert 'needs more than 1024 MB' in report.problems[0]


def test_the_reader_of_echo_sounders_is_here_wherever_it_has_a_wheel():
    """So that the tests below are left out nowhere else; `make venv` installs it."""
    libc, version = platform.libc_ver()
    new = tuple(map(int, version.split('.')[:2])) >= (2, 34) if libc == 'glibc' else False
    if sys.version_info < (3, 11) or platform.machine() != 'x86_64' or not new:
        pytest.skip('themachinethatgoesping has no wheel for this Python and system')
    assert importlib.util.find_spec('themachinethatgoesping'), (
        "pip install --no-deps themachinethatgoesping tqdm 'nanobind-backend>=1.0'"
    )


def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch):
    for name in ('pyxtf', 'themachinethatgoesping', 'ektools'):
        (tmp_path / f'{name}.py').write_text('raise ImportError("not here")')
    (tmp_path / 'a').write_bytes(b'\x7b' + bytes(2000))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(BagError, match=r'a needs pyxtf: .*sonar_imm\[xtf\]'):
        convert_xtf(tmp_path / 'a', tmp_path / 'bag')
    (tmp_path / 'b').write_bytes(bytes(4) + b'CON0' + bytes(600))
    with pytest.raises(BagError, match=r'b needs ektools: .*sonar_imm\[echosounders\]'):
        convert_ek80(tmp_path / 'b', tmp_path / 'bag')
    for convert in (convert_ek80, convert_kongsberg):
        with pytest.raises(BagError, match=r'sonar_imm\[echosounders\]'):
            convert(tmp_path / 'a', tmp_path / 'bag')


class TestEk80:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip('themachinethatgoesping')

    @pytest.fixture
    def samples(self):
        rng = np.random.default_rng(1)
        return rng.normal(size=(3, 200, 4)) + 1j * rng.normal(size=(3, 200, 4))

    def test_halves_of_a_split_beam(self, tmp_path, samples):
        report = convert_ek80(ek80(tmp_path / 'a.raw', samples), tmp_path / 'bag')
        assert report.messages == {'/nav': 3, '/snapshot': 3}
        snapshots = read(tmp_path / 'bag', 'bathymetry', Snapshot)
        halves = np.stack([samples[..., [0, 3]].sum(-1), samples[..., [1, 2]].sum(-1)], -1)
        for snapshot, iq in zip(snapshots, halves):
            assert snapshot.iq == pytest.approx(iq[1:], rel=1e-5, abs=1e-5)
        first = snapshots[0]
        assert (first.sound_speed, first.frequency) == pytest.approx((1490.0, 70e3))
        assert first.range[99] == pytest.approx(100 * 0.5 * 1490.0 * 4e-5, rel=1e-5)
        assert snapshots[1].stamp_ns - first.stamp_ns == pytest.approx(2e8, abs=1e4)

    def test_all_four_sectors_on_demand(self, tmp_path, samples):
        path = ek80(tmp_path / 'a.raw', samples)
        convert_ek80(path, tmp_path / 'bag', staves=[[0], [1], [2], [3]])
        assert read(tmp_path / 'bag', 'bathymetry', Snapshot)[0].staves == 4

    def test_the_spacing_of_the_halves_follows_from_the_sensitivity(self, tmp_path, samples):
        """23 rad of phase per rad, so 23 / (2 pi) wavelengths; an option is worth more."""
        path = ek80(tmp_path / 'a.raw', samples)
        for options, wanted in (({}, 23 * 1490 / 70e3 / (2 * np.pi)), ({'element_spacing': 1}, 1)):
            convert_ek80(path, tmp_path / f'bag{len(options)}', **options)
            found = read(tmp_path / f'bag{len(options)}', 'bathymetry', Snapshot)[0]
            assert found.element_spacing == pytest.approx(wanted, rel=1e-6)

    def test_power_and_angles_are_two_halves(self, tmp_path):
        rng = np.random.default_rng(2)
        angles, power = rng.integers(-128, 128, (3, 200, 2)), rng.integers(-9000, -3000, (3, 200))
        path = ek80(tmp_path / 'a.raw', power, angles=angles)
        assert convert_ek80(path, tmp_path / 'bag').messages['/snapshot'] == 3
        for ping, snapshot in enumerate(read(tmp_path / 'bag', 'bathymetry', Snapshot)):
            starboard, port = snapshot.iq.T
            decibels = 10 * np.log10(np.abs(starboard) ** 2)
            assert decibels == pytest.approx(power[ping, 1:] * 10 * np.log10(2) / 256, abs=1e-3)
            assert np.abs(port) == pytest.approx(np.abs(starboard))
            wanted = np.exp(1j * np.pi / 128 * angles[ping, 1:, 0])  # athwartships comes first
            turn = starboard * port.conj() / np.abs(port) ** 2
            assert turn == pytest.approx(wanted, abs=1e-5)
        with pytest.raises(BagError, match='no sectors to choose'):
            convert_ek80(path, tmp_path / 'none', staves=[[0], [1]])

    def test_a_chirp_is_compressed(self, tmp_path):
        """An echo 40 samples deep, of a chirp that scipy made, has its range and its phase."""
        count, step = round(PULSE * RATE), int(np.prod([each for _, each in FILTERS]))
        sent = signal.chirp(np.arange(count) / RATE, BAND[0], PULSE, BAND[1])
        received = np.zeros(200 * step)
        received[40 * step : 40 * step + count] = sent * signal.windows.tukey(count, 2 * SLOPE)
        for coefficients, every in FILTERS:
            received = np.convolve(received, coefficients)[::every]
        turn = np.exp(0.4j)
        sectors = np.array([turn, turn.conj(), turn.conj(), turn])
        path = ek80(tmp_path / 'a.raw', (received[:, None] * sectors)[None], chirp=True)
        convert_ek80(path, tmp_path / 'bag')
        (snapshot,) = read(tmp_path / 'bag', 'bathymetry', Snapshot)
        size = np.abs(snapshot.iq[:, 0])
        loudest = int(size.argmax())
        assert snapshot.range[loudest] == pytest.approx(40 * step / RATE * 745.0, abs=1e-3)
        # 35 kHz wide: a quarter of the pulse further off there is next to nothing.
        far = np.abs(np.arange(len(size)) - loudest) > 10
        assert size[far].max() < 0.05 * size[loudest] and size[loudest] == pytest.approx(
            2, rel=0.05
        )
        angle = np.angle(snapshot.iq[loudest, 0] * snapshot.iq[loudest, 1].conj())
        assert angle == pytest.approx(0.8, abs=1e-3) and snapshot.frequency == 72.5e3

    def test_what_cannot_be_used_is_said(self, tmp_path, samples):
        with pytest.raises(BagError, match='whose filters the file does not hold'):
            convert_ek80(ek80(tmp_path / 'a.raw', samples, chirp=True, filters=[]), tmp_path / 'o')
        with pytest.raises(BagError, match='nothing that could be converted'):
            convert_ek80(ek80(tmp_path / 'b.raw', samples), tmp_path / 'bag', channel='ES38')

    def test_what_came_before_the_cut_is_kept(self, tmp_path, samples):
        path = ek80(tmp_path / 'a.raw', samples)
        path.write_bytes(path.read_bytes()[:-500])
        assert convert_ek80(path, tmp_path / 'bag').messages['/snapshot'] == 2


class TestEk60:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip('ektools')

    @pytest.fixture
    def samples(self):
        rng = np.random.default_rng(2)
        return rng.integers(-9000, -3000, (3, 200)), rng.integers(-128, 128, (3, 200, 2))

    def test_power_and_angles_are_two_halves(self, tmp_path, samples):
        power, angles = samples
        report = convert_ek80(ek60(tmp_path / 'a.raw', *samples), tmp_path / 'bag')
        assert report.messages == {'/nav': 3, '/snapshot': 3} and not report.problems
        assert report.notes['channel'] == 'GPT 38 kHz ES38B'
        found = read(tmp_path / 'bag', 'bathymetry', Snapshot)
        for ping, snapshot in enumerate(found):
            starboard, port = snapshot.iq.T
            decibels = 10 * np.log10(np.abs(starboard) ** 2)
            assert decibels == pytest.approx(power[ping, 1:] * 10 * np.log10(2) / 256, abs=1e-3)
            turn = starboard * port.conj() / np.abs(port) ** 2
            wanted = np.exp(1j * np.pi / 128 * angles[ping, 1:, 0])  # athwartships comes first
            assert turn == pytest.approx(wanted, abs=1e-5)
        first = found[0]
        assert first.stamp_ns == pytest.approx((1_717_149_600.1) * 1e9, abs=1e4)
        assert (first.sound_speed, first.frequency) == pytest.approx((1490.0, 38e3))
        assert first.element_spacing == pytest.approx(21.9 * 1490 / 38e3 / (2 * np.pi), rel=1e-6)
        assert first.range[99] == pytest.approx(100 * 0.5 * 1490.0 * 2.56e-4, rel=1e-5)

    def test_a_ping_lies_between_two_positions(self, tmp_path, samples):
        """Pings 0.1 s after a position each, at 2 m/s to the east; none follows the last."""
        convert_ek80(ek60(tmp_path / 'a.raw', *samples), tmp_path / 'bag')
        with BagReader(tmp_path / 'bag') as bag:
            east = [each.message.pose.pose.position.x for each in bag.messages(['/nav'])]
        assert np.diff(east) == pytest.approx([0.4, 0.2], abs=0.02)

    def test_power_alone_is_refused(self, tmp_path, samples):
        with pytest.raises(BagError, match='power alone, which says no direction'):
            convert_ek80(ek60(tmp_path / 'a.raw', samples[0], None), tmp_path / 'bag')

    def test_what_came_before_the_cut_is_kept(self, tmp_path, samples):
        path = ek60(tmp_path / 'a.raw', *samples)
        path.write_bytes(path.read_bytes()[:-500])
        report = convert_ek80(path, tmp_path / 'bag')
        assert report.messages['/snapshot'] == 2 and 'a datagram is cut off' in report.problems[0]


class TestKongsberg:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip('themachinethatgoesping')

    def test_soundings_of_an_all_file_lie_beside_the_ship(self, tmp_path):
        """It heads east: starboard is south."""
        report = convert_kongsberg(kongsberg_all(tmp_path / 'a.all'), tmp_path / 'bag')
        assert report.messages == {'/ground': 5, '/nav': 5} and not report.problems
        with BagReader(tmp_path / 'bag') as bag:
            grounds = [read_ground(item.message) for item in bag.messages(['/ground'])]
        for k, ground in enumerate(grounds):
            wanted = [[0.4 * k + 0.5, -y, -20.0] for y in (-10.0, 0.0, 10.0)]
            assert ground.position == pytest.approx(np.array(wanted), abs=0.02)
            assert ground.stamp_ns == pytest.approx((1_717_149_600 + 0.2 * k) * 1e9, abs=1e4)
        own = yaml.safe_load((tmp_path / 'bag' / 'parameters.yaml').read_text())
        profile = own['bathymetry']['ros__parameters']['sound_speed_profile']
        assert profile == pytest.approx([0.0, 1480.0, 30.0, 1490.0])

    def test_soundings_and_navigation(self, tmp_path):
        report = convert_kongsberg(kmall(tmp_path / 'a.kmall'), tmp_path / 'bag')
        assert report.messages == {'/ground': 5, '/nav': 5} and not report.problems
        with BagReader(tmp_path / 'bag') as bag:
            grounds = [read_ground(item.message) for item in bag.messages(['/ground'])]
        for k, ground in enumerate(grounds):  # without a compass the bow is north
            wanted = [[0.4 * k + y, 0.5, -20.0] for y in (-10.0, 0.0, 10.0)]
            assert ground.position == pytest.approx(np.array(wanted), abs=0.02)
            assert ground.stamp_ns == pytest.approx((1_717_149_600 + 0.2 * k) * 1e9, abs=1e4)

    def test_a_cut_file_is_refused(self, tmp_path):
        """The library loses every ping of it: what it makes up must not become a sea floor."""
        path = kmall(tmp_path / 'a.kmall')
        path.write_bytes(path.read_bytes()[:-300])
        with pytest.raises(BagError, match='none of its soundings is valid'):
            convert_kongsberg(path, tmp_path / 'bag')
        assert not (tmp_path / 'bag').exists()


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
    (folder / '1.png').write_bytes(b'no picture')
    (folder / '2.png').unlink()
    text = (folder / 'stamps.csv').read_text()
    (folder / 'stamps.csv').write_text(text.replace('3.png', '../../etc/passwd'))
    report = convert_pictures(folder, tmp_path / 'bag', far_range=40.0, fov=82.0)
    assert report.messages['/detections'] == 3 and report.reasons == {'no picture': 3}
    assert 'outside of the folder' in ' '.join(report.problems)
    with pytest.raises(BagError, match='--far-range and --fov'):
        convert_pictures(folder, tmp_path / 'none')
    (folder / 'other.csv').write_text('file\n')
    with pytest.raises(BagError, match='2 CSV files; name the one'):
        convert_pictures(folder, tmp_path / 'none')


def test_soundings_of_a_multibeam_lie_beside_the_ship(tmp_path, monkeypatch):
    """Heading east: forward is east, starboard south. The reader itself is not in this test."""
    (tmp_path / 'a.kmall').write_bytes(b'\0\0\0\x10#IIP')
    ping = {
        'kind': 'ping',
        'units': 'degrees',
        'heading': 90.0,
        'pitch': 0.0,
        'roll': 0.0,
        'depth': 1.0,
        'altitude': float('nan'),
        'soundings': np.array([[2.0, 10.0, 20.0], [np.nan, 0.0, 0.0]]),
    }
    lost = {'soundings': None, 'place': (10.0, 54.0)}
    cast = {'kind': 'profile', 'values': [0.0, 1480.0, 30.0, 1490.0]}
    records = [
        cast,
        {**cast, 'values': [0.0, 1480.0, 0.0, 1490.0]},
        {**ping, 'stamp_ns': 1_717_149_600 * 10**9, 'place': (10.0, 54.0)},
        {**ping, 'stamp_ns': 1_717_149_601 * 10**9, 'place': (0.0, 0.0)},
        {**ping, 'stamp_ns': 1_717_149_602 * 10**9, **lost},
    ]
    monkeypatch.setattr(sonar_files, 'read_apart', lambda reader, path: iter(records))
    report = convert_kongsberg(tmp_path / 'a.kmall', tmp_path / 'bag')
    assert report.messages == {'/nav': 1, '/ground': 1} and report.bad_rows == 2
    own = yaml.safe_load((tmp_path / 'bag' / 'parameters.yaml').read_text())
    assert own['bathymetry']['ros__parameters'] == {'sound_speed_profile': cast['values']}
    assert any('needs increasing depths' in problem for problem in report.problems)
    with BagReader(tmp_path / 'bag') as bag:
        (found,) = [read_ground(item.message) for item in bag.messages(['/ground'])]
    assert found.position == pytest.approx(np.array([[2.0, -10.0, -21.0]]), abs=1e-6)
