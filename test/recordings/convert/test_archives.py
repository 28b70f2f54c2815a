# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Numpy archives of snapshots and traces, traces as CSV, and the sound of an array."""

import math
import shutil
import time
import zipfile

from helpers.field_files import measured, truth_of
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import rotation_of_quaternion
from sonar_imm.measurements import Navigation
from sonar_imm_tools.cli.track import Plan
from sonar_imm_tools.recordings.convert import convert_hydrophones, convert_snapshots, KINDS, sniff
from sonar_imm_tools.recordings.sources import BagError

SECOND = 10**9


@pytest.fixture
def archived(tmp_path):
    """Save the arrays that are not None, and convert them."""

    def run(kind, options=None, **arrays):
        known = {name: each for name, each in arrays.items() if each is not None}
        np.savez(tmp_path / 'in.npz', **known)
        return KINDS[kind](tmp_path / 'in.npz', tmp_path / 'bag', **(options or {}))

    return run


@pytest.fixture
def convert(archived):
    """The report, the snapshots and the truth."""

    def run(options=None, **arrays):
        report = archived('snapshots', options, **arrays)
        return report, measured(report.path, 'bathymetry'), truth_of(report.path)

    return run


def samples(*shape):
    rng = np.random.default_rng(0)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)


RANGE, RANGES = 17.0 + 0.25 * np.arange(10), np.linspace(10.0, 20.0, 30)


def test_pings_with_stamps_and_own_variances(convert):
    iq, noise = samples(3, 10, 4), np.array([1.0, 2.0, 3.0])[:, None] * np.ones(10)
    report, received, truth = convert(
        iq=iq, range=RANGE, stamp=[5.0, 6.5, 7.0], noise_variance=noise, snr=np.arange(1.0, 11.0),
        sound_speed=1500.0, frequency=450e3, spacing_wavelengths=0.5,
    )  # fmt: skip
    assert report.rows == 3 and report.messages == {'/snapshot': 3} and not truth
    assert [item.stamp_ns for item in received] == [5 * SECOND, 65 * 10**8, 7 * SECOND]
    for k, entry in enumerate(received):
        assert (entry.iq == iq[k]).all() and (entry.noise_variance == k + 1.0).all()
        assert np.allclose(entry.signal_variance, (k + 1.0) * np.arange(1.0, 11.0))
        assert (entry.range == RANGE).all()
        assert entry.spacing_wavelengths == pytest.approx(0.5, rel=1e-6)
        assert entry.element_spacing == pytest.approx(1500.0 / 900e3, rel=1e-6)


def test_without_stamps_pings_follow_the_rate(convert):
    how = {'ping_rate': 4.0}
    report, received, _ = convert(how, Y=samples(3, 10, 4), time=RANGE / 750.0)
    assert report.notes['stamps'] == 'the archive states none: 4 pings a second (--ping-rate)'
    assert np.diff([item.stamp_ns for item in received]).tolist() == [250_000_000] * 2
    assert np.allclose(received[0].range, RANGE)


SECONDS = 1_748_944_800 + np.array([0.0, 0.5, 1.25])


@pytest.mark.parametrize(
    'name, times',
    [('Timestamps', SECONDS), ('stamp', 1e3 * SECONDS), ('time', SECONDS),
     ('stamp', (1e9 * SECONDS).astype(np.int64)), ('ping_time', (1e6 * SECONDS).astype('M8[us]'))],
)  # fmt: skip
def test_times_of_pings_in_other_units_and_by_other_names(convert, name, times):
    report, received, _ = convert(iq=samples(3, 10, 4), range=RANGE, **{name: times})
    stamps = np.array([item.stamp_ns for item in received])
    assert np.abs(stamps - (1e9 * SECONDS).astype(np.int64)).max() < 1000
    assert not {'stamps', 'ignored arrays of in.npz'} & set(report.notes)
    assert np.allclose(received[0].range, RANGE)


def test_the_truth_of_a_test_vector(convert):
    h = np.linspace(0.0, 1.0, 10)
    known = {'r': RANGE, 'h': h, 'patch': h > 0.5, 'H': 15.0, 'tilt': 0.5, 'dlam': 0.5, 'sn2': 1.0}
    report, _, (truth,) = convert(Y=samples(10, 8), **known)
    assert report.messages == {'/snapshot': 1, '/truth/estimate': 1}
    assert report.notes['element_spacing_wavelengths'] == '0.5'
    extras = truth.extras
    assert (extras['height'] == h).all() and (extras['range'] == RANGE).all()
    assert extras['patch'].tolist() == [0] * 5 + [1] * 5 and extras['valid'].all()
    assert np.allclose(extras['angle'], np.arcsin((15.0 - h) / RANGE) - 0.5)
    assert np.allclose(truth.xyz[:, 2], h - 15.0)


PLACES = {'latitude': 59.43 + np.array([0.0, 1e-5, 2e-5]), 'longitude': np.full(3, 10.47)}
POSES = {**PLACES, 'heading': np.full(3, 30.0)}
EAST_NORTH = {'x': np.arange(3.0), 'y': np.full(3, 7.0), 'yaw': np.full(3, math.radians(60.0))}


@pytest.mark.parametrize(
    'poses', [POSES, {name.title(): value for name, value in POSES.items()}, EAST_NORTH]
)
def test_places_and_attitude_of_each_ping_become_navigation(convert, poses):
    more = {'z': -2.0, 'roll_deg': np.full(3, 5.0), 'pitch_rad': 0.1, 'altitude': 12.0}
    report, received, _ = convert(
        iq=samples(3, 30, 2), range=RANGES, stamp=np.arange(3.0) + 1e9, odd=np.ones(4), **poses,
        **more,
    )  # fmt: skip
    assert report.messages == {'/nav': 3, '/altitude': 3, '/snapshot': 3}
    assert report.notes['ignored arrays of in.npz'] == 'odd'
    poses_read = [item for item in received if isinstance(item, Navigation)]
    north, east = (0.0, 1.0) if 'x' in poses else (1e-5 * 111_414.0, 0.0)
    for k, pose in enumerate(poses_read):
        way = pose.position - poses_read[0].position
        assert way == pytest.approx([k * east, k * north, 0.0], abs=1e-3)
        assert pose.position[2] == -2.0
        # Bow 60 degrees from east, up by .1 rad; starboard 5 degrees down.
        bow, port = rotation_of_quaternion(pose.orientation)[:, :2].T
        assert math.atan2(bow[1], bow[0]) == pytest.approx(math.radians(60.0))
        assert bow[2] == pytest.approx(math.sin(0.1))
        assert port[2] == pytest.approx(math.sin(math.radians(5.0)) * math.cos(0.1))


def test_the_origin_of_degrees_counts_beside_other_parameters(convert, tmp_path):
    convert(iq=samples(3, 30, 4), range=RANGES, **POSES)
    params = tmp_path / 'my.yaml'
    params.write_text('/**: {ros__parameters: {sonar_height: 12.0}}')
    for chosen in (None, params):
        (job,) = Plan(params=chosen).jobs(tmp_path / 'bag', tmp_path / 'out')
        assert job.options.origin == Origin(59.43, 10.47)
    assert job.config.sonar_height == 12.0


def test_navigation_in_a_table_beside_the_snapshots(convert, tmp_path):
    rows = [f'{10**9 + k},{59.43 + 1e-5 * k},10.47,{30 + k},5,2' for k in range(4)]
    rows = ['time,lat,lon,hdg,roll,depth', *rows, '1000000005,bad,10.47,30,5,2']
    nav, pings = tmp_path / 'nav.csv', {'iq': samples(3, 30, 2), 'range': RANGES}
    nav.write_text('\n'.join(rows))
    report, received, _ = convert({'nav': nav}, **pings, stamp=np.arange(3.0) + 1e9)
    poses = [item for item in received if isinstance(item, Navigation)]
    assert report.messages == {'/nav': 4, '/snapshot': 3} and report.bad_rows == 1
    assert poses[2].position == pytest.approx([0.0, 2e-5 * 111_414.0, -2.0], abs=1e-3)
    nav.write_text('time,lat,lon\n1000000000,59.43,10.47\n')
    with pytest.raises(BagError, match='heading'):
        convert({'nav': nav}, **pings)


def test_channels_are_added_up_to_staves(convert):
    iq = samples(10, 4)
    _, (item,), _ = convert({'staves': [[0, 3], [1, 2]]}, quadrants=iq, range_m=RANGE)
    assert np.allclose(item.iq, np.stack([iq[:, 0] + iq[:, 3], iq[:, 1] + iq[:, 2]], axis=1))


ONE, MANY = {'iq': samples(10, 4), 'range': RANGE}, {'iq': samples(3, 30, 2), 'range': RANGES}
WORDS = [
    ({}, {**ONE, 'iq': None}, 'no array iq or'),
    ({}, {**ONE, 'range': None}, 'no array range or .* or time'),
    ({}, {**ONE, 'iq': samples(1, 4, 10), 'x': 0, 'y': 0, 'yaw': 0}, 'for 4 bins'),
    ({}, {**ONE, 'iq': np.ones((10, 4))}, 'complex'),
    ({}, {**ONE, 'iq': samples(10)}, 'shape'),
    ({}, {**ONE, 'range': RANGE[:9]}, 'nothing that could be converted'),
    ({}, {**ONE, 'stamp': [1.0, 2.0]}, 'stamps'),
    ({}, {**ONE, 'stamp': [np.inf]}, 'stamps'),
    ({}, {**ONE, 'stamp': [1e300]}, 'before 2038'),
    ({}, {**ONE, 'stamp': np.array(['M8', 's'])}, 'no numbers'),
    ({}, {**ONE, 'c': np.array('x')}, "'c' holds no numbers"),
    ({}, {**ONE, 'range': RANGE.astype('m8[s]')}, "'range' holds no numbers"),
    ({}, {**ONE, 'sound_speed': np.ones(3)}, 'one finite number'),
    ({'staves': [[0, 4], [1]]}, ONE, 'channels 0 to 3'),
    ({'names': {'iq': 'data'}}, ONE, "no array 'data'"),
    ({}, {**ONE, 'range': RANGE[:9], 'x': 1.0, 'y': 2.0, 'heading': 90.0}, 'nothing that could'),
    ({'names': {'data': 'iq'}}, ONE, 'unknown array'),
    ({}, {**ONE, 'iq': np.array([{}])}, 'more than plain arrays'),
    # navigation that can be read in two ways
    ({}, {**MANY, **EAST_NORTH, 'yaw': np.full(3, 60.0)}, 'heading=yaw'),
    ({}, {**MANY, 'x': np.zeros(3), 'y': np.zeros(3)}, '--name heading=ARRAY'),
    ({}, {**MANY, **POSES, 'roll': np.full(3, 0.1)}, '--name roll_rad=roll'),
    ({}, {**MANY, **POSES, 'heading': np.zeros(4)}, 'heading has the shape'),
    ({}, {**MANY, **POSES, 'heading': np.full(3, 1.2)}, '--name heading_deg=heading'),
]
DEPTH = 120.0 + 0.25 * np.arange(40)
TRACES = {'depth': DEPTH, 'amplitude': np.ones((3, 40))}
WORDS_OF_TRACES = [
    ({'amplitude': None}, "no array 'amplitude'"),
    ({'depth': DEPTH[:5]}, r'\(traces, n\) are needed'),
    ({'stamp': [1.0]}, '3 traces need as many'),
    ({'sigma': np.ones(7)}, 'sigma has the shape'),
    ({'amplitude': np.zeros((3, 40))}, 'silent'),
    ({'stamp': [1e300] * 3}, '3 traces need as many'),
    ({'stamp': [3e9] * 3}, 'before 2038'),
    ({'stamp': ['a'] * 3}, "'stamp' holds no numbers"),
    ({'sigma': 'x'}, "'sigma' holds no numbers"),
]


def test_what_cannot_be_converted_is_said_in_a_sentence(archived):
    of_traces = [('traces', {}, {**TRACES, **arrays}, word) for arrays, word in WORDS_OF_TRACES]
    for kind, options, arrays, word in [*(('snapshots', *each) for each in WORDS), *of_traces]:
        with pytest.raises(BagError, match=word):
            archived(kind, options, **arrays)


def test_archives_that_unpack_to_far_more_or_hold_others_and_other_files_cost_a_sentence(tmp_path):
    head = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (%d,)}"
    npy = head % 10**15 + b' ' * 64
    np.savez(tmp_path / 'inner.npz', iq=samples(10, 4))
    inner = (tmp_path / 'inner.npz').read_bytes()
    for part, content, method, words in (
        ('iq.npy', bytes(140_000_000), zipfile.ZIP_BZIP2, 'unpacks to more than'),
        ('iq.npy', npy[:128], zipfile.ZIP_STORED, 'damaged'),
        ('iq.zip', inner, zipfile.ZIP_STORED, 'more than plain arrays'),
        ('iq.npy', inner, zipfile.ZIP_STORED, 'more than plain arrays'),
    ):
        with zipfile.ZipFile(tmp_path / 'a.npz', 'w', method) as archive:
            archive.writestr(part, content)
        with pytest.raises(BagError, match=words):
            convert_snapshots(tmp_path / 'a.npz', tmp_path / 'bag')
    np.save(tmp_path / 'single.npy', np.ones(3))
    np.savez_compressed(tmp_path / 'cut.npz', iq=samples(500, 4), range=np.arange(500.0))
    data = bytearray((tmp_path / 'cut.npz').read_bytes())
    data[200 : 200 + len(data) // 2] = bytes(len(data) // 2)
    (tmp_path / 'cut.npz').write_bytes(data)
    refused = {'nothing.npz': 'cannot be read', 'single.npy': 'not a numpy archive'}
    for name, words in {**refused, 'cut.npz': 'damaged'}.items():
        with pytest.raises(BagError, match=words):
            convert_snapshots(tmp_path / name, tmp_path / 'bag')


def heard(report):
    return measured(report.path, 'fathometer')


def test_an_archive_with_truth(archived):
    strength = np.array([[1.0, 0.3], [0.9, 0.5], [0.39, np.nan]])
    report = archived(
        'traces', depth=DEPTH, amplitude=np.sin(DEPTH) * np.ones((3, 1)), sigma=[1.0, 2.0, 3.0],
        stamp=[5.0, 6.5, 7.0], reference_depth=[70.0, np.nan, 71.0], reflector_amplitude=strength,
        reflector_depth=np.array([[121.0, 125.0], [121.1, 125.1], [121.2, 125.2]]),
    )  # fmt: skip
    assert report.messages == {'/trace': 3, '/truth/estimate': 3}
    traces = heard(report)
    assert [trace.stamp_ns for trace in traces] == [5 * SECOND, 65 * SECOND // 10, 7 * SECOND]
    assert [trace.reference_depth for trace in traces] == [70.0, None, 71.0]
    assert (traces[1].sigma == 2.0).all() and np.allclose(traces[1].amplitude, np.sin(DEPTH))
    truth = [item.columns() for item in truth_of(report.path)]
    # The second is there with 0.6 and more of its greatest, the first no longer with 0.39.
    assert [list(item['track_id']) for item in truth] == [[1, 2], [1, 2], []]
    assert list(truth[1]['depth']) == [121.1, 125.1]


def test_bad_pings_and_traces_are_left_out_by_name(archived):
    spoilt = TRACES['amplitude'].copy()
    spoilt[1] = np.nan
    report = archived('traces', {'rate': 2.0}, depth=DEPTH, amplitude=spoilt)
    assert report.bad_rows == 1 and 'trace 1: ' in report.problems[0]
    stamps = [item.stamp_ns for item in heard(report)]
    assert stamps[1] - stamps[0] == SECOND
    shutil.rmtree(report.path)
    iq = samples(3, 10, 4)
    iq[1] = np.nan
    report = archived('snapshots', iq=iq, range=RANGE)
    assert len(measured(report.path, 'bathymetry')) == 2
    assert report.bad_rows == 1 and 'ping 1' in report.problems[0]


def test_a_table_has_a_row_a_sample(tmp_path):
    lines = ['time,depth,amplitude,sigma']
    lines += [f'{stamp},{z:.2f},{k},0.5' for stamp in (3, 4) for k, z in enumerate(DEPTH)]
    lines[50] = '4,far,1,1'
    (tmp_path / 'in.csv').write_text('\n'.join(lines))
    report = KINDS['traces'](tmp_path / 'in.csv', tmp_path / 'bag')
    assert report.rows == 80 and report.bad_rows == 1 and 'line 51' in report.problems[0]
    first, second = heard(report)
    assert len(first) == 40 and len(second) == 39 and (first.sigma == 0.5).all()


# -- the sound of an array becomes blocks of pressure that are its samples


RATE, BEGIN, BEGIN_NS = 4000, '2024-05-31T10:00:00Z', 1_717_149_600 * SECOND


def write_sound(path, channels=4, **how):
    soundfile = pytest.importorskip('soundfile')
    samples = 0.2 * np.random.default_rng(3).standard_normal((10_000, channels))
    soundfile.write(path, samples, RATE, **how)
    return soundfile.read(path, dtype='float64', always_2d=True)[0]


def joined(report):
    return np.concatenate([block.pressure for block in heard(report)])


@pytest.mark.parametrize('kind', ['wav PCM_16', 'wav FLOAT', 'wav PCM_24', 'flac PCM_16'])
def test_blocks_are_the_samples(tmp_path, kind):
    ending, subtype = kind.split()
    path, chosen = tmp_path / f'a.{ending}', [3, 2, 0]
    samples = write_sound(path, subtype=subtype)
    how = {'channels': chosen, 'full_scale': 8.0, 'depth': 100.0, 'block': 0.7}
    report = convert_hydrophones(path, tmp_path / 'out', start=BEGIN, **how)
    blocks = heard(report)
    stamps = [BEGIN_NS + 700_000_000 * k for k in range(len(blocks))]
    assert [block.stamp_ns for block in blocks] == stamps
    assert joined(report) == pytest.approx(8.0 * samples[:, chosen], abs=1e-6)
    assert {(block.reference_depth, block.sample_rate) for block in blocks} == {(100.0, RATE)}


def test_the_name_of_the_file_says_when_it_begins_or_that_does_not_matter(tmp_path):
    for name in ('x_20240531_100000', '5146.240531100000', 'a-20240531T100000Z'):
        path = tmp_path / f'{name}.wav'
        write_sound(path)
        report = convert_hydrophones(path, tmp_path / name)
        assert heard(report)[0].stamp_ns == BEGIN_NS
        assert report.notes['start'].startswith(f'{BEGIN} by the name')
        report = convert_hydrophones(path, tmp_path / f'{name}_zone', time_zone='+02:00')
        assert heard(report)[0].stamp_ns == BEGIN_NS - 7200 * SECOND
    write_sound(tmp_path / 'a.wav')
    for start, before in (('0', SECOND), ('now', time.time_ns())):
        report = convert_hydrophones(tmp_path / 'a.wav', tmp_path / start, start=start)
        assert 0 <= heard(report)[0].stamp_ns - before < 60 * SECOND


def test_wave_files_of_the_other_byte_order_and_those_that_were_cut(tmp_path):
    for endian, least, most in (('BIG', 10_000, 10_000), ('LITTLE', 4001, 5000)):
        path = tmp_path / f'{endian}.wav'
        samples = write_sound(path, endian=endian)
        content = path.read_bytes()
        assert content[:4] == {'BIG': b'RIFX', 'LITTLE': b'RIFF'}[endian]
        path.write_bytes(content if endian == 'BIG' else content[: len(content) // 2])
        assert sniff(path).kind == 'hydrophones'
        found = joined(convert_hydrophones(path, tmp_path / endian, start='0'))
        assert least <= len(found) <= most
        assert found == pytest.approx(samples[: len(found)], abs=1e-6)


def test_what_cannot_be_used_is_one_sentence(tmp_path):
    write_sound(tmp_path / 'a.wav')
    (tmp_path / 'b.wav').write_bytes(b'RIFF____WAVE' + bytes(50))
    write_sound(tmp_path / 'c.wav', channels=1)
    for name, options, wanted in (
        ('a.wav', {'start': None}, 'does not say when it begins'),
        ('a.wav', {'start': 'noon'}, 'is no time'), ('a.wav', {'channels': [0, 9]}, 'not 9'),
        ('a.wav', {'block': 600.0, 'channels': [0]}, 'at least two'), ('c.wav', {}, 'one channel'),
        ('b.wav', {}, 'cannot be read as sound'), ('none.wav', {}, 'cannot be read'),
    ):  # fmt: skip
        how = {name: value for name, value in ({'start': BEGIN} | options).items() if value}
        with pytest.raises(BagError, match=wanted):
            convert_hydrophones(tmp_path / name, tmp_path / 'out', **how)
        assert not (tmp_path / 'out').exists()
