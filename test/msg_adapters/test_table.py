# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from array import array
import math
import tracemalloc
from types import SimpleNamespace

from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters import table
from msg_adapters.table import decode_table, encode_table
from sonar_imm.measurements import Rejection
from sonar_imm_tools.recordings.messages import ros_message, typestore

FORMATS = list(table.DATATYPES.values())


def cloud(fields, data, *, height=1, width=1, point_step, row_step=None, big=False):
    """A PointCloud2 of plain attributes; fields are (name, offset, datatype, count)."""
    names = ('name', 'offset', 'datatype', 'count')
    return SimpleNamespace(
        height=height, width=width, point_step=point_step, is_bigendian=big, data=data,
        row_step=width * point_step if row_step is None else row_step,
        fields=[SimpleNamespace(**dict(zip(names, field))) for field in fields],
    )  # fmt: skip


def encode(columns):
    return encode_table(columns, stamp_ns=1_000_000_007, frame_id='map', make=ros_message)


@pytest.mark.filterwarnings('error')
def test_a_signalling_nan_is_a_nan():
    """Not every bit pattern of a wire can be converted without a flag of the processor."""
    bits = np.array([0x7F800001, 0x3F800000], '<u4')
    columns = decode_table(cloud([('a', 0, 7, 1)], bits.tobytes(), width=2, point_step=4))
    assert np.isnan(table.scalar_column(columns, 'a')).tolist() == [True, False]


class TestDecode:
    def test_every_datatype_in_both_byte_orders(self):
        for order in '<>':
            packed = np.zeros(3, [(code, order + code) for code in FORMATS])
            for code in FORMATS:
                packed[code] = [1, 2, 120]
            fields = [
                (code, packed.dtype.fields[code][1], number, 1)
                for number, code in table.DATATYPES.items()
            ]
            message = cloud(
                fields, packed.tobytes(), width=3, point_step=packed.itemsize, big=order == '>'
            )
            for code, column in decode_table(message).items():
                assert column.dtype == np.dtype(code) and column.dtype.isnative
                assert column.tolist() == [1, 2, 120]

    def test_padding_of_points_and_rows_and_a_vector_column(self):
        # two rows of three points of 12 bytes, 5 bytes of padding after each row
        step, row = 12, 3 * 12 + 5
        data = bytearray(b'\xff' * (2 * row))
        for r in range(2):
            for c in range(3):
                at = r * row + c * step
                data[at + 1 : at + 5] = np.array([10 * r + c, 7], '<i2').tobytes()
                data[at + 7 : at + 11] = np.array([r - c], '<f4').tobytes()
        message = cloud(
            [('v', 1, 3, 2), ('f', 7, 7, 1)], bytes(data), height=2, width=3, point_step=step,
            row_step=row,
        )  # fmt: skip
        columns = decode_table(message)
        assert columns['v'].tolist() == [[0, 7], [1, 7], [2, 7], [10, 7], [11, 7], [12, 7]]
        assert columns['f'].tolist() == [0, -1, -2, 1, 0, -1]

    def test_overlapping_fields_see_the_same_bytes(self):
        message = cloud([('word', 0, 6, 1), ('bytes', 0, 2, 4)], bytes([1, 2, 3, 4]), point_step=4)
        columns = decode_table(message)
        assert columns['word'].tolist() == [0x04030201]
        assert columns['bytes'].tolist() == [[1, 2, 3, 4]]

    @pytest.mark.parametrize(
        'kind', [bytes, lambda data: array('B', data), lambda data: np.frombuffer(data, np.uint8)]
    )
    def test_every_kind_of_payload_and_the_columns_are_fresh(self, kind):
        columns = decode_table(
            cloud([('a', 0, 8, 1)], kind(np.float64(2.5).tobytes()), point_step=8)
        )
        columns['a'][0] = 3.0
        assert columns['a'][0] == 3.0

    def test_an_empty_cloud_has_typed_empty_columns(self):
        for height, width, step in ((1, 0, 8), (0, 5, 8), (0, 0, 8)):
            columns = decode_table(
                cloud(
                    [('a', 0, 8, 1), ('b', 0, 1, 3)], b'', height=height, width=width,
                    point_step=step, row_step=width * step,
                )
            )  # fmt: skip
            assert columns['a'].shape == (0,) and columns['a'].dtype == np.float64
            assert columns['b'].shape == (0, 3)
        assert decode_table(cloud([], b'', width=0, point_step=0)) == {}

    @pytest.mark.parametrize(
        'code, message',
        [
            ('short_data', cloud([('a', 0, 8, 1)], bytes(15), width=2, point_step=8)),
            ('short_data', cloud([('a', 0, 2, 1)], bytes(15), height=2, point_step=1, row_step=8)),
            ('bad_layout', cloud([('a', 0, 8, 1)], bytes(16), width=2, point_step=8, row_step=8)),
            ('bad_layout', cloud([], b'', width=2, point_step=0)),
            ('bad_layout', cloud([('a', 0, 2, 1)], [1, 2], point_step=1)),
            ('bad_field', cloud([('a', 1, 8, 1)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 3)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 2**32 - 1)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 0)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 0, 1)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 9, 1)], bytes(8), point_step=8)),
            ('bad_field', cloud([('', 0, 7, 1)], bytes(8), point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 1), ('a', 4, 7, 1)], bytes(8), point_step=8)),
            ('too_large', cloud([(str(i), 0, 1, 1) for i in range(1025)], b'\0', point_step=1)),
            ('too_large',
             cloud([(str(i), 0, 2, 2**20) for i in range(1000)], bytes(2**20), point_step=2**20)),
        ],
    )  # fmt: skip
    def test_what_does_not_fit_is_refused_by_name(self, code, message):
        assert reason(decode_table, message) == code


class TestEncode:
    def test_x_y_z_come_first_and_nothing_is_padded(self):
        message = encode(
            {
                'id': np.array([1], np.uint8), 'z': np.float32([3]), 'iq': np.float32([[1, 2]]),
                'x': np.float32([1]), 'y': np.float32([2]),
            }
        )  # fmt: skip
        assert [field.name for field in message.fields] == ['x', 'y', 'z', 'id', 'iq']
        assert [field.offset for field in message.fields] == [0, 4, 8, 12, 13]
        assert message.point_step == 21 and message.row_step == 21 and len(message.data) == 21
        assert message.header.stamp.sec == 1 and message.header.stamp.nanosec == 7

    @pytest.mark.parametrize(
        'columns',
        [
            {'a': np.zeros(2, np.int64)},
            {'a': np.array(['x'])},
            {'a': np.zeros(2), 'b': np.zeros(3)},
            {'a': np.zeros((2, 2, 2))},
            {'a': np.zeros((2, 0))},
        ],
    )
    def test_what_no_cloud_can_hold_is_a_programming_error(self, columns):
        with pytest.raises(ValueError, match='column'):
            encode(columns)

    @given(st.data())
    @settings(max_examples=100, deadline=None)
    def test_round_trip_through_cdr_is_bit_exact(self, data):
        rows = data.draw(st.integers(0, 5))
        names = data.draw(
            st.lists(st.text(min_size=1, max_size=5, alphabet='xyzabc_0'), unique=True, max_size=6)
        )
        columns = {}
        for name in names:
            dtype = np.dtype(data.draw(st.sampled_from(FORMATS)))
            count = data.draw(st.integers(1, 3))
            size = rows * count * dtype.itemsize
            raw = data.draw(st.binary(min_size=size, max_size=size))
            shape = (rows,) if count == 1 else (rows, count)
            columns[name] = np.frombuffer(raw, dtype).reshape(shape)
        message = encode(columns)
        kind = 'sensor_msgs/msg/PointCloud2'
        again = typestore().deserialize_cdr(typestore().serialize_cdr(message, kind), kind)
        decoded = decode_table(again)
        assert set(decoded) == set(columns)
        for name, column in columns.items():
            assert decoded[name].dtype == column.dtype and decoded[name].shape == column.shape
            assert decoded[name].tobytes() == column.tobytes()


SIZES = (0, 1, 1, 1, 2, 3, 4, 4, 5, 7, 8, 8, 12, 16, 24, 2**31 - 1, 2**32 - 1)


@given(
    sizes=st.binary(min_size=20, max_size=20),
    count=st.integers(0, 4),
    data=st.binary(max_size=200),
    packed=st.booleans(),
    big=st.booleans(),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_layouts_are_refused_or_read_within_their_bytes(sizes, count, data, packed, big):
    height, width, point_step, row_step, *rest = (SIZES[size % len(SIZES)] for size in sizes)
    fields = [
        ('xyab'[rest[4 * i] % 4], rest[4 * i + 1], sizes[4 * i + 6] % 10, rest[4 * i + 3])
        for i in range(count)
    ]
    shape = {'height': height, 'width': width, 'point_step': point_step}
    message = cloud(fields, data, **shape, row_step=None if packed else row_step, big=big)
    try:
        columns = decode_table(message)
    except Rejection as rejection:
        assert rejection.reason in ('bad_layout', 'bad_field', 'short_data', 'too_large')
        return
    rows = message.height * message.width
    assert [field.name for field in message.fields] == list(columns)
    for field in message.fields:
        column = columns[field.name]
        assert len(column) == rows
        if rows:  # an independent, slow reading of the last element
            dtype = np.dtype(table.DATATYPES[field.datatype]).newbyteorder(
                '>' if message.is_bigendian else '<'
            )
            at = (message.height - 1) * message.row_step + field.offset
            at += (message.width - 1) * message.point_step + (field.count - 1) * dtype.itemsize
            raw = message.data[at : at + dtype.itemsize]
            assert len(raw) == dtype.itemsize
            last = np.frombuffer(raw, dtype)[0]
            got = column.reshape(rows, math.prod(column.shape[1:]))[-1, -1]
            assert got == last or (np.isnan(got) and np.isnan(last))


class TestBounds:
    """What a message may cost before it is believed."""

    def test_only_named_columns_are_decoded(self):
        b, c = np.ones((3, 2), np.float32), np.arange(3, dtype=np.int32)
        message = encode({'a': np.arange(3.0), 'b': b, 'c': c})
        columns = decode_table(message, ('c', 'a', 'not_there'))
        assert list(columns) == ['a', 'c'] and columns['a'].tolist() == [0.0, 1.0, 2.0]

    def test_a_bad_field_is_named_even_where_it_is_not_wanted(self):
        fields = [('a', 0, 8, 1), ('depth', 8, 8, 1)]
        with pytest.raises(Rejection, match="'depth'.*beyond the point_step"):
            decode_table(cloud(fields, bytes(8), point_step=8), ('a',))

    def test_too_many_rows_are_refused_before_the_data_are_looked_at(self):
        message = cloud([('a', 0, 8, 1)], None, width=11, point_step=8)
        with pytest.raises(Rejection, match='11 rows; at most 10') as caught:
            decode_table(message, most_rows=10)
        assert caught.value.reason == 'too_large'

    def test_overlapping_fields_nobody_asked_for_cost_nothing(self):
        rows = 9_000
        fields = [(f'f{i}', i % 7, 2, 1000) for i in range(1000)] + [('a', 0, 7, 1)]
        message = cloud(fields, bytes(1010 * rows), width=rows, point_step=1010)
        tracemalloc.start()
        decode_table(message, ('a',))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
        tracemalloc.stop()


def test_equal_names_with_other_kinds_of_columns_are_other_tables():
    """Layouts are remembered: what is remembered must depend on all of it."""
    kinds = (np.float64, np.float32, np.int16, np.bool_)
    for values in (np.arange(3), np.ones((3, 2))):
        for kind in (*kinds, np.dtype('>f8')):
            message = encode({'b': np.ones(3), 'a': values.astype(kind), 'x': np.zeros(3)})
            columns = decode_table(message)
            assert list(columns) == ['x', 'b', 'a']
            np.testing.assert_array_equal(columns['a'], values.astype(kind))


@pytest.mark.parametrize('rows', [1, 4, 5, 300])
@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
def test_a_table_says_whether_all_of_it_is_finite(rows, bad):
    good = {'a': np.ones(rows), 'n': np.full(rows, 7, np.uint32)}
    spoilt = np.ones(rows)
    spoilt[-1] = bad
    pair = np.column_stack([np.ones(rows), spoilt])
    for more, dense in (({}, True), ({'v': np.ones((rows, 2))}, True), ({'b': spoilt}, False),
                        ({'v': pair}, False)):  # fmt: skip
        assert encode({**good, **more}).is_dense == dense
