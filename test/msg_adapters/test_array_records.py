# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of arrays, traces and snapshots: read back as written, and hostile ones named."""

from attrs import asdict, evolve
from helpers.refusals import reason
import numpy as np
import pytest

from msg_adapters import array_records as records
from msg_adapters.array_records import read_csdm, read_pressure, read_trace
from msg_adapters.snapshots import CONSTANTS, read_snapshot, VARIANCES, write_snapshot
from msg_adapters.table import decode_table, encode_table
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Rejection, Snapshot, Trace
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 10**18
F, N = 5, 4
BINS, STAVES = 6, 3


def spectra():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(F, N, 7)) + 1j * rng.normal(size=(F, N, 7))
    return CrossSpectra(
        stamp_ns=STAMP, frame_id='array', frequency=100.0 + 2.0 * np.arange(F), snapshots=7,
        csdm=(p @ p.conj().swapaxes(1, 2) / 7).astype(np.complex64), reference_depth=73.5,
    )  # fmt: skip


def table(stamp_ns=STAMP, **columns):
    columns = {name: column for name, column in columns.items() if column is not None}
    return encode_table(columns, stamp_ns=stamp_ns, frame_id='array', make=ros_message)


def csdm_table(matrices, **changes):
    flat = np.asarray(matrices, np.complex64)
    flat = flat.reshape(len(flat), flat.shape[1] ** 2).view(np.float32)
    columns = {'frequency': np.float32(100.0 + 2.0 * np.arange(len(matrices))), 'csdm': flat}
    return table(**{**columns, **changes})


def trace_table(rows=60, **changes):
    depth = np.float32(120.0 + 0.1 * np.arange(rows))
    return table(**{'depth': depth, 'amplitude': np.sin(depth).astype(np.float32), **changes})


def pressure_table(rows=50, **changes):
    p = np.random.default_rng(1).normal(size=(rows, N)).astype(np.float32)
    return table(**{'p': p, 'sample_rate': np.full(rows, 12e3, np.float32), **changes})


def columns(bins=BINS, staves=STAVES, **changes):
    iq = np.random.default_rng(0).normal(size=(bins, 2 * staves)).astype(np.float32)
    known = {'range': np.float32(17.0 + 0.05 * np.arange(bins)), 'iq': iq}
    return {**known, 'sound_speed': np.full(bins, 1500.0, np.float32), **changes}


def message(stamp_ns=STAMP, **changes):
    return table(stamp_ns, **columns(**changes))


def organised(width=STAVES, **changes):
    """The same samples as a cloud of one row a range bin and one column a stave."""
    own = columns()
    parts = {'re': own['iq'][:, 0::2].ravel(), 'im': own['iq'][:, 1::2].ravel()}
    cloud = table(**{**parts, 'range': np.repeat(own['range'], STAVES), **changes})
    cloud.height, cloud.width, cloud.row_step = BINS, width, STAVES * cloud.point_step
    return cloud


def test_cross_spectra_come_back_as_they_went():
    item = spectra()
    message = records.write_csdm(item, ros_message)
    np.testing.assert_equal(asdict(read_csdm(message)), asdict(item))
    row = decode_table(message)['csdm'][2]
    assert row[2 * (1 * N + 3)] == item.csdm[2, 1, 3].real  # row-major, real part first
    assert row[2 * (1 * N + 3) + 1] == item.csdm[2, 1, 3].imag
    # What is not said is not known, but by the depth of the deepest element.
    back = read_csdm(csdm_table(item.csdm))
    assert back.snapshots == 0 and back.reference_depth is None
    depths = np.tile(np.float32([80.0, 79.8, 79.6, 79.4]), (F, 1))
    assert read_csdm(csdm_table(item.csdm, element_depth=depths)).reference_depth == 80.0


def test_dead_hydrophones_are_masked_and_singular_matrices_are_read_for_loading_mends_them():
    R = spectra().csdm.copy()
    for dead in (0.0, np.nan):
        R[:, 2] = R[:, :, 2] = dead
        assert list(read_csdm(csdm_table(R)).alive) == [True, True, False, True]
    p = np.exp(1j * np.arange(N))
    assert len(read_csdm(csdm_table(np.tile(np.outer(p, p.conj()), (F, 1, 1))))) == F
    # Nor does a dead one spoil a block of pressure.
    p = np.random.default_rng(3).normal(size=(50, N)).astype(np.float32)
    p[:, 1], p[7, 3] = 0.25, np.inf
    with pytest.raises(Rejection, match='2 hydrophones live'):
        read_pressure(pressure_table(p=p))
    p[7, 3] = 0.0
    assert list(read_pressure(pressure_table(p=p)).alive) == [True, False, True, True]


ONES, FLAT = np.ones((50, N)), {'frequency': np.float32(np.arange(F))}
MANY = {'range': np.arange(1e6, dtype=np.float32), 'iq': np.ones((10**6, 4), np.float32)}
HOSTILE = {
    (read_csdm, csdm_table): {
        'bad_hydrophones': [{'matrices': spectra().csdm[:, :2, :2]}],
        'too_short': [{'matrices': spectra().csdm[:1]}, {'matrices': spectra().csdm[:0]}],
        'bad_field': [{'matrices': spectra().csdm, 'element_depth': np.float32(ONES[:F, :3])}],
    },
    (read_csdm, table): {
        'bad_field': [{**FLAT, 'csdm': np.zeros((F, 30), np.float32)},
                      {**FLAT, 'csdm': np.zeros((F, 32), np.int32)}],
        'missing_column csdm': [FLAT],
    },
    (read_pressure, pressure_table): {
        'missing_column scale': [{'p': np.zeros((50, N), np.int16)}],
        'missing_column sample_rate': [{'sample_rate': None}],
        'bad_scale': [{'p': np.int16(ONES), 'scale': np.zeros(50, np.float32)},
                      {'rows': 0, 'p': np.int16(ONES[:0]), 'scale': np.float32(ONES[:0, 0])}],
        'out_of_range': [{'sample_rate': np.zeros(50, np.float32)}],
        'not_constant': [{'sample_rate': np.linspace(1e4, 2e4, 50, dtype=np.float32)}],
        'too_short': [{'rows': 1}, {'rows': 0}],
    },
    (read_trace, trace_table): {
        'missing_column amplitude': [{'amplitude': None}],
        'bad_field': [{'amplitude': np.zeros((60, 2), np.float32)}],
        'too_short': [{'rows': 1}, {'rows': 0}],
    },
    (read_snapshot, message): {
        'missing_column': [{'iq': None}, {'range': None}],
        'bad_field': [{'iq': np.ones((BINS, 5), np.float32)}, {'iq': np.ones(BINS)},
                      {'range': np.ones((BINS, 2))}],
        'too_short': [{'bins': 1}, {'bins': 0}],
        'out_of_range': [{'element_spacing': np.full(BINS, -1.0)}],
        'not_constant': [{'sound_speed': np.float32([1500.0] * (BINS - 1) + [1501.0])}],
    },
    (read_snapshot, table): {'too_large': [MANY]},
    (read_snapshot, organised): {
        'bad_range': [{'range': np.zeros(BINS * STAVES)}], 'no_staves': [{'width': 0}],
    },
}  # fmt: skip


@pytest.mark.parametrize('read, make', HOSTILE)
def test_hostile_tables_are_named(read, make):
    for words, rows in HOSTILE[read, make].items():
        code, _, column = words.partition(' ')
        for changes in rows:
            assert reason(read, make(**changes)) == code, words
            with pytest.raises(Rejection, match=column or None):
                read(make(**changes))


def block_of(pressure, **scale):
    return Pressure(stamp_ns=STAMP, frame_id='array', pressure=pressure, sample_rate=12e3, **scale)


def test_pressure_comes_back_as_floats_or_as_scaled_whole_numbers():
    block = block_of(np.random.default_rng(2).normal(size=(40, N)))
    back = read_pressure(records.write_pressure(block, ros_message))
    assert (back.pressure == block.pressure).all() and back.sample_rate == 12e3
    for scale, whole in ((1e-3, np.int16), (0.1, np.int8)):
        message = records.write_pressure(evolve(block, scale=scale), ros_message)
        assert decode_table(message)['p'].dtype == whole
        again = read_pressure(message)
        assert np.abs(again.pressure - block.pressure).max() < 0.51 * scale
        assert records.write_pressure(again, ros_message).data.tobytes() == message.data.tobytes()


def test_pressure_at_the_limit_of_its_whole_numbers_is_clipped_and_keeps_its_sign():
    samples = np.outer((-1.0) ** np.arange(40), [1.0, -2.0, 3.0, -4.0])
    for peak, kept, whole in (
        (127, 127, np.int8), (128, 128, np.int16), (32_767, 32_767, np.int16),
        (32_768, 32_767, np.int16), (-40_000, -32_768, np.int16),
    ):  # fmt: skip
        samples[7, 1] = peak
        message = records.write_pressure(block_of(samples, scale=1), ros_message)
        assert decode_table(message)['p'].dtype == whole
        assert read_pressure(message).pressure[7].tolist() == [-1.0, kept, -3.0, 4.0]


def test_traces_come_back_with_their_noise():
    depth = 120.0 + 0.25 * np.arange(80)
    trace = Trace(
        stamp_ns=STAMP, depth=depth, amplitude=np.cos(depth), sigma=np.full(80, 0.5),
        frame_id='array', reference_depth=0.0,
    )  # fmt: skip
    back = read_trace(records.write_trace(trace, ros_message))
    assert np.allclose(back.amplitude, trace.amplitude, atol=1e-7)
    assert (back.depth == depth).all() and (back.sigma == 0.5).all()
    assert back.reference_depth == 0.0  # at the surface, not unknown
    assert read_trace(trace_table()).sigma is None
    # A response is a trace that can be drawn.
    message = records.write_response(trace, ros_message)
    drawn = decode_table(message)
    assert list(drawn) == ['x', 'y', 'z', 'depth', 'amplitude', 'sigma']
    assert (drawn['z'] == -drawn['depth']).all() and len(read_trace(message)) == 80


def test_the_depth_of_the_array_is_down_whatever_the_frame():
    item = ArrayDepth(stamp_ns=STAMP, depth=73.5, frame_id='map')
    message = records.write_array_depth(item, ros_message)
    assert message.point.z == -73.5 and records.read_array_depth(message).depth == 73.5
    message.header.frame_id = 'map_ned'
    assert records.read_array_depth(message).depth == -73.5
    message.header.frame_id = 'map'
    pose = ros_message('geometry_msgs/msg/PoseWithCovarianceStamped', header=message.header)
    pose.pose.pose.position.z = 40.0
    assert records.read_array_depth(pose, world_frame='ned').depth == 40.0
    message.point.z = float('nan')
    assert reason(records.read_array_depth, message) == 'nan'


def test_samples_are_interleaved_real_and_imaginary_or_those_of_an_organised_cloud():
    snapshot, own = read_snapshot(message()), columns()
    assert snapshot.iq.dtype == np.complex64 and snapshot.staves == STAVES
    assert (snapshot.iq == own['iq'][:, 0::2] + 1j * own['iq'][:, 1::2]).all()
    assert (snapshot.range == own['range']).all() and snapshot.frame_id == 'array'
    assert snapshot.sound_speed == 1500.0
    assert snapshot.frequency is None and snapshot.noise_variance is None
    other = read_snapshot(organised())
    assert (snapshot.iq == other.iq).all() and (snapshot.range == other.range).all()
    # Times become ranges.
    time = (17.0 + 0.05 * np.arange(BINS)) / 750.0
    snapshot = read_snapshot(message(range=None, time=time))
    assert np.allclose(snapshot.range, 750.0 * time) and (snapshot.two_way_time == time).all()
    unknown = read_snapshot(message(range=None, time=time, sound_speed=None))
    assert np.allclose(unknown.ranges(1480.0), 740.0 * time)
    # A constant holds for the whole ping.
    partly = np.float32([np.nan] * (BINS - 1) + [1501.0])
    for stated, known in ((partly, 1501.0), (np.zeros(BINS), None), (np.full(BINS, np.nan), None)):
        assert read_snapshot(message(sound_speed=stated)).sound_speed == known


@pytest.mark.parametrize('times', [False, True])
def test_writing_and_reading_gives_the_same_snapshot(times):
    rng = np.random.default_rng(1)
    noise = np.float32([1.0, 2.0, np.nan, 4.0])
    time = np.arange(1.0, 5.0) * 1e-3 / 3.0
    snapshot = Snapshot(
        stamp_ns=STAMP + 1, frame_id='sonar', range=np.float32([17.0, 17.1, 17.2, 17.3]),
        iq=(rng.normal(size=(4, 8)) + 1j * rng.normal(size=(4, 8))).astype(np.complex64),
        two_way_time=time if times else None, noise_variance=noise, sound_speed=1500.0,
        signal_variance=noise, frequency=455e3, element_spacing=2.0**-9, sample_rate=15e3,
    )  # fmt: skip
    again = read_snapshot(write_snapshot(snapshot, ros_message))
    assert again.stamp_ns == snapshot.stamp_ns and (again.iq == snapshot.iq).all()
    assert np.allclose(again.range, 750.0 * time if times else snapshot.range, rtol=1e-15)
    for name in (*VARIANCES, *CONSTANTS):
        assert np.array_equal(getattr(again, name), getattr(snapshot, name), equal_nan=True), name
