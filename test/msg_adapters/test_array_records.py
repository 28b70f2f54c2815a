# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of arrays and traces: read back as written, and hostile ones named."""

from attrs import evolve
from helpers.refusals import reason
from hypothesis import given, settings
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
from msg_adapters.table import decode_table, encode_table
from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Rejection, Trace
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 10**18
F, N = 5, 4
EMPTY = np.empty((0, N), np.int16)


def spectra(**changes):
    rng = np.random.default_rng(0)
    p = rng.normal(size=(F, N, 7)) + 1j * rng.normal(size=(F, N, 7))
    values = {
        'stamp_ns': STAMP,
        'frame_id': 'array',
        'frequency': 100.0 + 2.0 * np.arange(F),
        'csdm': (p @ p.conj().swapaxes(1, 2) / 7).astype(np.complex64),
        'snapshots': 7,
        'reference_depth': 73.5,
    }
    return CrossSpectra(**{**values, **changes})


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


def test_what_is_not_said_is_not_known():
    back = read_csdm(csdm_table(spectra().csdm))
    assert back.snapshots == 0 and back.reference_depth is None


def test_the_depth_of_the_elements_tells_that_of_the_deepest():
    depths = np.tile(np.float32([80.0, 79.8, 79.6, 79.4]), (F, 1))
    assert read_csdm(csdm_table(spectra().csdm, element_depth=depths)).reference_depth == 80.0
    assert (
        reason(read_csdm, csdm_table(spectra().csdm, element_depth=depths[:, :3])) == 'bad_field'
    )


@pytest.mark.parametrize(
    'spoil, expected',
    [
        (lambda R: R + np.triu(np.ones((N, N)), 1), 'not_hermitian'),
        (lambda R: R * np.nan, 'nan'),
        (lambda R: R * 0.0, 'silent'),
        (lambda R: R + 5.0 * (np.ones((N, N)) - np.eye(N)), 'not_positive'),
        (lambda R: R[:, :2, :2], 'bad_hydrophones'),
        (lambda R: R[:1], 'too_short'),
        (lambda R: R[:0], 'too_short'),
    ],
)
def test_hostile_matrices_are_named(spoil, expected):
    assert reason(read_csdm, csdm_table(spoil(spectra().csdm))) == expected


def test_a_dead_hydrophone_and_a_hydrophone_of_nan_are_masked():
    R = spectra().csdm.copy()
    R[:, 2], R[:, :, 2] = 0.0, 0.0
    assert list(read_csdm(csdm_table(R)).alive) == [True, True, False, True]
    R[:, 2], R[:, :, 2] = np.nan, np.nan
    assert list(read_csdm(csdm_table(R)).alive) == [True, True, False, True]


def test_singular_matrices_are_read_for_loading_mends_them():
    p = np.exp(1j * np.arange(N))
    assert len(read_csdm(csdm_table(np.tile(np.outer(p, p.conj()), (F, 1, 1))))) == F


def test_a_count_that_is_no_matrix_is_named():
    flat = np.zeros((F, 30), np.float32)
    message = table(frequency=np.float32(np.arange(F)), csdm=flat)
    assert reason(read_csdm, message) == 'bad_field'
    whole = table(frequency=np.float32(np.arange(F)), csdm=np.zeros((F, 32), np.int32))
    assert reason(read_csdm, whole) == 'bad_field'


@pytest.mark.parametrize(
    'read, message, name',
    [
        (read_csdm, table(frequency=np.float32([1, 2])), 'csdm'),
        (read_pressure, table(p=np.zeros((5, 4), np.float32)), 'sample_rate'),
        (read_trace, table(depth=np.float32([1, 2])), 'amplitude'),
    ],
)
def test_missing_columns_are_named(read, message, name):
    with pytest.raises(Rejection, match=name):
        read(message)


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
    [
        (127, 127, np.int8),
        (128, 128, np.int16),
        (32_767, 32_767, np.int16),
        (32_768, 32_767, np.int16),
        (-40_000, -32_768, np.int16),
    ],
)
def test_pressure_at_the_limit_of_its_whole_numbers_is_clipped_and_keeps_its_sign(
    peak, kept, whole
):
    samples = np.outer((-1.0) ** np.arange(40), [1.0, -2.0, 3.0, -4.0])
    samples[7, 1] = peak
    block = Pressure(stamp_ns=STAMP, frame_id='array', pressure=samples, sample_rate=12e3, scale=1)
    message = write_pressure(block, ros_message)
    assert decode_table(message)['p'].dtype == whole
    assert read_pressure(message).pressure[7].tolist() == [-1.0, kept, -3.0, 4.0]


@pytest.mark.parametrize(
    'changes, expected',
    [
        ({'p': np.zeros((50, N), np.int16)}, 'missing_column'),
        ({'p': np.ones((50, N), np.int16), 'scale': np.zeros(50, np.float32)}, 'bad_scale'),
        ({'p': np.zeros((50, N), np.float32)}, 'silent'),
        ({'p': np.full((50, N), np.nan, np.float32)}, 'nan'),
        ({'p': np.ones((50, 2), np.float32)}, 'bad_hydrophones'),
        ({'sample_rate': np.zeros(50, np.float32)}, 'out_of_range'),
        ({'sample_rate': np.linspace(1e4, 2e4, 50, dtype=np.float32)}, 'not_constant'),
        ({'rows': 1}, 'too_short'),
        ({'rows': 0}, 'too_short'),
        ({'rows': 0, 'p': EMPTY, 'scale': np.float32(EMPTY[:, 0])}, 'bad_scale'),
    ],
)
def test_hostile_pressure_is_named(changes, expected):
    assert reason(read_pressure, pressure_table(**changes)) == expected


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


@pytest.mark.parametrize(
    'changes, expected',
    [
        ({'amplitude': np.full(60, np.nan, np.float32)}, 'nan'),
        ({'amplitude': np.zeros(60, np.float32)}, 'silent'),
        ({'amplitude': np.zeros((60, 2), np.float32)}, 'bad_field'),
        ({'depth': np.float32(np.arange(60)[::-1])}, 'bad_depth'),
        ({'depth': np.full(60, np.inf, np.float32)}, 'nan'),
        ({'depth': np.float32(1e4 * np.arange(60))}, 'out_of_range'),
        ({'rows': 1}, 'too_short'),
        ({'rows': 0}, 'too_short'),
    ],
)
def test_hostile_traces_are_named(changes, expected):
    assert reason(read_trace, trace_table(**changes)) == expected


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
