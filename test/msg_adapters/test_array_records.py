# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of arrays and traces: read back as written, and hostile ones named."""

from attrs import evolve
from helpers.hostile.properties import check_refusal
from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters.array_records import (
    read_array_depth,
    read_csdm,
    read_pressure,
    read_trace,
    write_array_depth,
    write_csdm,
    write_pressure,
    write_response,
    write_trace,
)
from msg_adapters.snapshots import CONSTANTS, read_snapshot, VARIANCES, write_snapshot
from msg_adapters.table import decode_table, encode_table
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Rejection, Snapshot, Trace
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 10**18
F, N = 5, 4


def spectra():
    rng = np.random.default_rng(0)
    p = rng.normal(size=(F, N, 7)) + 1j * rng.normal(size=(F, N, 7))
    return CrossSpectra(
        stamp_ns=STAMP, frame_id='array', frequency=100.0 + 2.0 * np.arange(F), snapshots=7,
        csdm=(p @ p.conj().swapaxes(1, 2) / 7).astype(np.complex64), reference_depth=73.5,
    )  # fmt: skip


def table(**columns):
    return encode_table(
        {name: column for name, column in columns.items() if column is not None},
        stamp_ns=STAMP,
        frame_id='array',
        make=ros_message,
    )


def csdm_table(matrices, **changes):
    flat = np.asarray(matrices, np.complex64)
    flat = flat.reshape(len(flat), flat.shape[1] ** 2).view(np.float32)
    columns = {'frequency': np.float32(100.0 + 2.0 * np.arange(len(matrices))), 'csdm': flat}
    return table(**{**columns, **changes})


def trace_table(rows=60, **changes):
    depth = np.float32(120.0 + 0.1 * np.arange(rows))
    columns = {'depth': depth, 'amplitude': np.sin(depth).astype(np.float32)}
    return table(**{**columns, **changes})


def pressure_table(rows=50, **changes):
    p = np.random.default_rng(1).normal(size=(rows, N)).astype(np.float32)
    return table(**{'p': p, 'sample_rate': np.full(rows, 12e3, np.float32), **changes})


def test_cross_spectra_come_back_as_they_went():
    item = spectra()
    message = write_csdm(item, ros_message)
    back = read_csdm(message)
    assert (back.csdm == item.csdm).all() and back.csdm.dtype == np.complex64
    assert (back.frequency == item.frequency).all() and back.snapshots == 7
    assert back.reference_depth == 73.5 and back.frame_id == 'array' and back.stamp_ns == STAMP
    row = decode_table(message)['csdm'][2]
    assert row[2 * (1 * N + 3)] == item.csdm[2, 1, 3].real  # row-major, real part first
    assert row[2 * (1 * N + 3) + 1] == item.csdm[2, 1, 3].imag


def test_what_is_not_said_is_not_known_but_by_the_depth_of_the_deepest_element():
    back = read_csdm(csdm_table(spectra().csdm))
    assert back.snapshots == 0 and back.reference_depth is None
    depths = np.tile(np.float32([80.0, 79.8, 79.6, 79.4]), (F, 1))
    assert read_csdm(csdm_table(spectra().csdm, element_depth=depths)).reference_depth == 80.0


def test_dead_hydrophones_are_masked_and_singular_matrices_are_read_for_loading_mends_them():
    R = spectra().csdm.copy()
    R[:, 2], R[:, :, 2] = 0.0, 0.0
    assert list(read_csdm(csdm_table(R)).alive) == [True, True, False, True]
    R[:, 2], R[:, :, 2] = np.nan, np.nan
    assert list(read_csdm(csdm_table(R)).alive) == [True, True, False, True]
    p = np.exp(1j * np.arange(N))
    assert len(read_csdm(csdm_table(np.tile(np.outer(p, p.conj()), (F, 1, 1))))) == F


ONES, FLAT = np.ones((50, N)), {'frequency': np.float32(np.arange(F))}
HOSTILE = {
    (read_csdm, csdm_table): {
        'not_hermitian': [{'matrices': spectra().csdm + np.triu(np.ones((N, N)), 1)}],
        'nan': [{'matrices': spectra().csdm * np.nan}],
        'silent': [{'matrices': spectra().csdm * 0.0}],
        'not_positive': [{'matrices': spectra().csdm + 5.0 * (np.ones((N, N)) - np.eye(N))}],
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
        'silent': [{'p': np.float32(0.0 * ONES)}],
        'nan': [{'p': np.float32(np.nan * ONES)}],
        'bad_hydrophones': [{'p': np.float32(ONES[:, :2])}],
        'out_of_range': [{'sample_rate': np.zeros(50, np.float32)}],
        'not_constant': [{'sample_rate': np.linspace(1e4, 2e4, 50, dtype=np.float32)}],
        'too_short': [{'rows': 1}, {'rows': 0}],
    },
    (read_trace, trace_table): {
        'missing_column amplitude': [{'amplitude': None}],
        'nan': [{'amplitude': np.full(60, np.nan, np.float32)},
                {'depth': np.full(60, np.inf, np.float32)}],
        'silent': [{'amplitude': np.zeros(60, np.float32)}],
        'bad_field': [{'amplitude': np.zeros((60, 2), np.float32)}],
        'bad_depth': [{'depth': np.float32(np.arange(60)[::-1])}],
        'out_of_range': [{'depth': np.float32(1e4 * np.arange(60))}],
        'too_short': [{'rows': 1}, {'rows': 0}],
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


def test_pressure_comes_back_as_floats_or_as_scaled_whole_numbers():
    rng = np.random.default_rng(2)
    block = Pressure(
        stamp_ns=STAMP, frame_id='array', pressure=rng.normal(size=(40, N)), sample_rate=12e3
    )
    back = read_pressure(write_pressure(block, ros_message))
    assert (back.pressure == block.pressure).all() and back.sample_rate == 12e3
    for scale, whole in ((1e-3, np.int16), (0.1, np.int8)):
        message = write_pressure(evolve(block, scale=scale), ros_message)
        assert decode_table(message)['p'].dtype == whole
        again = read_pressure(message)
        assert np.abs(again.pressure - block.pressure).max() < 0.51 * scale
        assert write_pressure(again, ros_message).data.tobytes() == message.data.tobytes()


@pytest.mark.parametrize(
    'peak, kept, whole',
    [(127, 127, np.int8), (128, 128, np.int16), (32_767, 32_767, np.int16),
     (32_768, 32_767, np.int16), (-40_000, -32_768, np.int16)],
)  # fmt: skip
def test_pressure_at_the_limit_of_its_whole_numbers_is_clipped_and_keeps_its_sign(
    peak, kept, whole
):
    samples = np.outer((-1.0) ** np.arange(40), [1.0, -2.0, 3.0, -4.0])
    samples[7, 1] = peak
    block = Pressure(stamp_ns=STAMP, frame_id='array', pressure=samples, sample_rate=12e3, scale=1)
    message = write_pressure(block, ros_message)
    assert decode_table(message)['p'].dtype == whole
    assert read_pressure(message).pressure[7].tolist() == [-1.0, kept, -3.0, 4.0]


def test_a_dead_hydrophone_does_not_spoil_the_block():
    p = np.random.default_rng(3).normal(size=(50, N)).astype(np.float32)
    p[:, 1] = 0.25
    p[7, 3] = np.inf
    with pytest.raises(Rejection, match='2 hydrophones live'):
        read_pressure(pressure_table(p=p))
    p[7, 3] = 0.0
    assert list(read_pressure(pressure_table(p=p)).alive) == [True, False, True, True]


def test_traces_come_back_with_their_noise():
    depth = 120.0 + 0.25 * np.arange(80)
    trace = Trace(
        stamp_ns=STAMP, depth=depth, amplitude=np.cos(depth), sigma=np.full(80, 0.5),
        frame_id='array', reference_depth=0.0,
    )  # fmt: skip
    back = read_trace(write_trace(trace, ros_message))
    assert np.allclose(back.amplitude, trace.amplitude, atol=1e-7)
    assert (back.depth == depth).all() and (back.sigma == 0.5).all()
    assert back.reference_depth == 0.0  # at the surface, not unknown
    assert read_trace(trace_table()).sigma is None


def test_a_response_is_a_trace_that_can_be_drawn():
    message = write_response(
        Trace(stamp_ns=STAMP, depth=np.arange(1.0, 9.0), amplitude=np.ones(8), sigma=np.ones(8)),
        ros_message,
    )
    columns = decode_table(message)
    assert list(columns) == ['x', 'y', 'z', 'depth', 'amplitude', 'sigma']
    assert (columns['z'] == -columns['depth']).all()
    assert len(read_trace(message)) == 8


def test_the_depth_of_the_array_is_down_whatever_the_frame():
    message = write_array_depth(
        ArrayDepth(stamp_ns=STAMP, depth=73.5, frame_id='map'), ros_message
    )
    assert message.point.z == -73.5
    assert read_array_depth(message).depth == 73.5
    message.header.frame_id = 'map_ned'
    assert read_array_depth(message).depth == -73.5
    message.header.frame_id = 'map'
    pose = ros_message('geometry_msgs/msg/PoseWithCovarianceStamped', header=message.header)
    pose.pose.pose.position.z = 40.0
    assert read_array_depth(pose, world_frame='ned').depth == 40.0
    message.point.z = float('nan')
    assert reason(read_array_depth, message) == 'nan'


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.sampled_from([read_csdm, read_pressure, read_trace]))
def test_bytes_of_any_kind_are_read_or_refused(data, read):
    good = {
        read_csdm: csdm_table(spectra().csdm),
        read_pressure: pressure_table(),
        read_trace: trace_table(),
    }[read]
    content = np.array(good.data)
    content[: len(data)] = np.frombuffer(data, np.uint8)[: len(content)]
    good.data = content
    try:
        read(good)
    except Rejection as rejection:
        assert rejection.sentence


# -- snapshots of pings


BINS, STAVES = 6, 3


def columns(bins=BINS, staves=STAVES, **changes):
    rng = np.random.default_rng(0)
    base = {
        'range': np.float32(17.0 + 0.05 * np.arange(bins)),
        'iq': rng.normal(size=(bins, 2 * staves)).astype(np.float32),
        'sound_speed': np.full(bins, 1500.0, np.float32),
    }
    base.update(changes)
    return {name: column for name, column in base.items() if column is not None}


def message(stamp_ns=10**18, **changes):
    return encode_table(columns(**changes), stamp_ns=stamp_ns, frame_id='sonar', make=ros_message)


def organised(**changes):
    """The same samples as a cloud of one row a range bin and one column a stave."""
    table = columns()
    cloud = {
        're': table['iq'][:, 0::2].ravel(),
        'im': table['iq'][:, 1::2].ravel(),
        'range': np.repeat(table['range'], STAVES),
        **changes,
    }
    cloud = encode_table(cloud, stamp_ns=10**18, frame_id='sonar', make=ros_message)
    cloud.height, cloud.width = BINS, STAVES
    cloud.row_step = STAVES * cloud.point_step
    return cloud


def test_samples_are_interleaved_real_and_imaginary():
    snapshot = read_snapshot(message())
    iq = columns()['iq']
    assert snapshot.iq.dtype == np.complex64 and snapshot.staves == STAVES
    assert (snapshot.iq == iq[:, 0::2] + 1j * iq[:, 1::2]).all()
    assert (snapshot.range == columns()['range']).all() and snapshot.frame_id == 'sonar'
    assert snapshot.sound_speed == 1500.0
    assert snapshot.frequency is None and snapshot.noise_variance is None


def test_an_organised_cloud_says_the_same_and_times_become_ranges():
    first, other = read_snapshot(message()), read_snapshot(organised())
    assert (first.iq == other.iq).all() and (first.range == other.range).all()
    assert reason(read_snapshot, organised(range=np.zeros(BINS * STAVES))) == 'bad_range'
    time = (17.0 + 0.05 * np.arange(BINS)) / 750.0
    snapshot = read_snapshot(message(range=None, time=time))
    assert np.allclose(snapshot.range, 750.0 * time) and (snapshot.two_way_time == time).all()
    unknown = read_snapshot(message(range=None, time=time, sound_speed=None))
    assert np.allclose(unknown.ranges(1480.0), 740.0 * time)
    cloud = organised()
    cloud.width = 0
    assert reason(read_snapshot, cloud) == 'no_staves'
    many = {'range': np.arange(1e6, dtype=np.float32), 'iq': np.ones((10**6, 4), np.float32)}
    cloud = encode_table(many, stamp_ns=10**18, frame_id='sonar', make=ros_message)
    assert reason(read_snapshot, cloud) == 'too_large'


def test_constants_hold_for_the_whole_ping():
    changing = np.float32([1500.0] * (BINS - 1) + [1501.0])
    assert reason(read_snapshot, message(sound_speed=changing)) == 'not_constant'
    partly = np.float32([np.nan] * (BINS - 1) + [1501.0])
    assert read_snapshot(message(sound_speed=partly)).sound_speed == 1501.0
    for nothing in (0.0, np.nan):
        snapshot = read_snapshot(message(sound_speed=np.full(BINS, nothing)))
        assert snapshot.sound_speed is None


@pytest.mark.parametrize(
    'code, rows',
    [
        ('missing_column', [{'iq': None}, {'range': None}]),
        ('bad_field', [{'iq': np.ones((BINS, 5), np.float32)}, {'iq': np.ones(BINS)}]),
        ('bad_field', [{'range': np.ones((BINS, 2))}]),
        ('bad_staves', [{'staves': 1}, {'staves': 65}]),
        ('too_short', [{'bins': 1}, {'bins': 0}]),
        ('bad_stamp', [{'stamp_ns': 0}]),
        ('nan', [{'iq': np.full((BINS, 6), np.nan, np.float32)}]),
        ('silent', [{'iq': np.zeros((BINS, 6), np.float32)}]),
        ('out_of_range', [{'element_spacing': np.full(BINS, -1.0)}]),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(code, rows):
    assert [reason(read_snapshot, message(**changes)) for changes in rows] == [code] * len(rows)


@pytest.mark.parametrize('times', [False, True])
def test_writing_and_reading_gives_the_same_snapshot(times):
    rng = np.random.default_rng(1)
    noise = np.float32([1.0, 2.0, np.nan, 4.0])
    time = np.arange(1.0, 5.0) * 1e-3 / 3.0
    snapshot = Snapshot(
        stamp_ns=10**18 + 1, frame_id='sonar', range=np.float32([17.0, 17.1, 17.2, 17.3]),
        iq=(rng.normal(size=(4, 8)) + 1j * rng.normal(size=(4, 8))).astype(np.complex64),
        two_way_time=time if times else None, noise_variance=noise, sound_speed=1500.0,
        signal_variance=noise, frequency=455e3, element_spacing=2.0**-9, sample_rate=15e3,
    )  # fmt: skip
    again = read_snapshot(write_snapshot(snapshot, ros_message))
    assert again.stamp_ns == snapshot.stamp_ns and (again.iq == snapshot.iq).all()
    assert np.allclose(again.range, 750.0 * time if times else snapshot.range, rtol=1e-15)
    for name in (*VARIANCES, *CONSTANTS):
        assert np.array_equal(getattr(again, name), getattr(snapshot, name), equal_nan=True), name


NASTY = np.array([0.1, 1.0, 17.0, 0.0, -1.0, 1e-30, 1e30, 1e38, 1500.0, np.nan, np.inf, -np.inf])
COLUMNS_OF_PINGS = ('range', 'time', 'iq', *CONSTANTS, *VARIANCES)


@given(
    bins=st.integers(0, 4),
    staves=st.integers(0, 3),
    nasty=st.sets(st.sampled_from(COLUMNS_OF_PINGS)),
    gone=st.sampled_from(('range', 'iq', 'time', 'frequency')),
    cut=st.sampled_from((0, 0, 3)),
    values=st.binary(min_size=24, max_size=24),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_snapshots_are_refused_or_usable(bins, staves, nasty, gone, cut, values):
    table = columns(bins=bins, staves=max(staves, 1))
    drawn = NASTY[np.frombuffer(values, np.uint8) % len(NASTY)].astype(np.float32)
    for name in sorted(nasty):
        wide = 2 * max(staves, 1) if name == 'iq' else 1
        table[name] = np.resize(drawn, (bins, wide)) if wide > 1 else np.resize(drawn, bins)
        drawn = np.roll(drawn, 5)
    table.pop(gone, None)
    cloud = encode_table(table, stamp_ns=10**18, frame_id='sonar', make=ros_message)
    cloud.data = cloud.data[: len(cloud.data) - cut]
    try:
        snapshot = read_snapshot(cloud)
    except Rejection as rejection:
        check_refusal(rejection)
        return
    assert snapshot.usable.any() and snapshot.bin_width > 0.0
    assert np.isfinite(snapshot.iq[snapshot.usable]).all()
    for name in VARIANCES:
        known = getattr(snapshot, name)
        assert known is None or (known[~np.isnan(known)] > 0.0).all()
    assert snapshot.sound_speed is None or 1300.0 <= snapshot.sound_speed <= 1700.0
