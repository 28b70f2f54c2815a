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

from attrs import asdict
from helpers.diver_runs import arrivals
from helpers.marine import sent
from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters import scans, table
from msg_adapters.arrivals import read_arrivals, REQUIRED, write_arrivals
from msg_adapters.scans import read_scan
from msg_adapters.table import decode_table, encode_table
from sonar_imm.measurements import Fixes, Rejection
from sonar_imm_tools.recordings.messages import ros_message

FORMATS = list(table.DATATYPES.values())


def cloud(fields, data, *, height=1, width=1, point_step, row_step=None, big=False):
    """A PointCloud2 of plain attributes; fields are (name, offset, datatype, count)."""
    names = ('name', 'offset', 'datatype', 'count')
    return SimpleNamespace(
        height=height, width=width, point_step=point_step, is_bigendian=big, data=data,
        row_step=width * point_step if row_step is None else row_step,
        fields=[SimpleNamespace(**dict(zip(names, field))) for field in fields],
    )  # fmt: skip


def encode(columns, stamp_ns=1_000_000_007, frame_id='map'):
    return encode_table(columns, stamp_ns=stamp_ns, frame_id=frame_id, make=ros_message)


class TestDecode:
    def test_every_datatype_in_both_byte_orders(self):
        for order in '<>':
            packed = np.zeros(3, [(code, order + code) for code in FORMATS])
            for code in FORMATS:
                packed[code] = [1, 2, 120]
            offsets = {code: offset for code, (_, offset) in packed.dtype.fields.items()}
            fields = [(code, offsets[code], n, 1) for n, code in table.DATATYPES.items()]
            shape = {'width': 3, 'point_step': packed.itemsize, 'big': order == '>'}
            for code, column in decode_table(cloud(fields, packed.tobytes(), **shape)).items():
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
        shape = {'height': 2, 'width': 3, 'point_step': step, 'row_step': row}
        columns = decode_table(cloud([('v', 1, 3, 2), ('f', 7, 7, 1)], bytes(data), **shape))
        assert columns['v'].tolist() == [[0, 7], [1, 7], [2, 7], [10, 7], [11, 7], [12, 7]]
        assert columns['f'].tolist() == [0, -1, -2, 1, 0, -1]

    @pytest.mark.filterwarnings('error')
    def test_every_kind_of_payload_and_the_columns_are_fresh(self):
        data = np.float64(2.5).tobytes()
        for kind in (data, array('B', data), np.frombuffer(data, np.uint8)):
            columns = decode_table(cloud([('a', 0, 8, 1)], kind, point_step=8))
            columns['a'][0] = 3.0
            assert columns['a'][0] == 3.0
        # Not every bit pattern of a wire can be converted without a flag of the processor.
        bits = np.array([0x7F800001, 0x3F800000], '<u4')
        columns = decode_table(cloud([('a', 0, 7, 1)], bits.tobytes(), width=2, point_step=4))
        assert np.isnan(table.scalar_column(columns, 'a')).tolist() == [True, False]

    def test_an_empty_cloud_has_typed_empty_columns(self):
        fields = [('a', 0, 8, 1), ('b', 0, 1, 3)]
        for height, width in ((1, 0), (0, 5), (0, 0)):
            columns = decode_table(cloud(fields, b'', height=height, width=width, point_step=8))
            assert columns['a'].shape == (0,) and columns['a'].dtype == np.float64
            assert columns['b'].shape == (0, 3)
        assert decode_table(cloud([], b'', width=0, point_step=0)) == {}

    def test_what_does_not_fit_is_refused_by_name(self):
        name, eight, most = [('a', 0, 8, 1)], bytes(8), 2**20
        wide = [(str(i), 0, 2, most) for i in range(1000)]
        for code, message in (
            ('short_data', cloud(name, bytes(15), width=2, point_step=8)),
            ('short_data', cloud([('a', 0, 2, 1)], bytes(15), height=2, point_step=1, row_step=8)),
            ('bad_layout', cloud(name, bytes(16), width=2, point_step=8, row_step=8)),
            ('bad_layout', cloud([], b'', width=2, point_step=0)),
            ('bad_layout', cloud([('a', 0, 2, 1)], [1, 2], point_step=1)),
            ('bad_field', cloud([('a', 1, 8, 1)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 3)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 2**32 - 1)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 0)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 0, 1)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 9, 1)], eight, point_step=8)),
            ('bad_field', cloud([('', 0, 7, 1)], eight, point_step=8)),
            ('bad_field', cloud([('a', 0, 7, 1), ('a', 4, 7, 1)], eight, point_step=8)),
            ('too_large', cloud([(str(i), 0, 1, 1) for i in range(1025)], b'\0', point_step=1)),
            ('too_large', cloud(wide, bytes(most), point_step=most)),
        ):
            assert reason(decode_table, message) == code


class TestEncode:
    def test_x_y_z_come_first_and_nothing_is_padded(self):
        given = {'id': np.array([1], np.uint8), 'z': np.float32([3]), 'iq': np.float32([[1, 2]])}
        message = encode({**given, 'x': np.float32([1]), 'y': np.float32([2])})
        assert [field.name for field in message.fields] == ['x', 'y', 'z', 'id', 'iq']
        assert [field.offset for field in message.fields] == [0, 4, 8, 12, 13]
        assert message.point_step == 21 and message.row_step == 21 and len(message.data) == 21
        assert message.header.stamp.sec == 1 and message.header.stamp.nanosec == 7

    def test_what_no_cloud_can_hold_is_a_programming_error(self):
        wrong = [np.zeros(2, np.int64), np.array(['x']), np.zeros((2, 2, 2)), np.zeros((2, 0))]
        for columns in (*({'a': each} for each in wrong), {'a': np.zeros(2), 'b': np.zeros(3)}):
            with pytest.raises(ValueError, match='column'):
                encode(columns)

    @given(st.data())
    @settings(max_examples=100)
    def test_round_trip_through_cdr_is_bit_exact(self, data):
        rows, columns = data.draw(st.integers(0, 5)), {}
        words = st.text(min_size=1, max_size=5, alphabet='xyzabc_0')
        for name in data.draw(st.lists(words, unique=True, max_size=6)):
            dtype = np.dtype(data.draw(st.sampled_from(FORMATS)))
            count = data.draw(st.integers(1, 3))
            size = rows * count * dtype.itemsize
            raw = data.draw(st.binary(min_size=size, max_size=size))
            shape = (rows,) if count == 1 else (rows, count)
            columns[name] = np.frombuffer(raw, dtype).reshape(shape)
        decoded = decode_table(sent(encode(columns)))
        assert set(decoded) == set(columns)
        for name, column in columns.items():
            assert decoded[name].dtype == column.dtype and decoded[name].shape == column.shape
            assert decoded[name].tobytes() == column.tobytes()


SIZES = (0, 1, 1, 1, 2, 3, 4, 4, 5, 7, 8, 8, 12, 16, 24, 2**31 - 1, 2**32 - 1)


@given(
    st.binary(min_size=20, max_size=20), st.integers(0, 4), st.binary(max_size=200),
    st.booleans(), st.booleans(),
)  # fmt: skip
@settings(max_examples=200, suppress_health_check=list(HealthCheck))
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
            dtype = np.dtype('<>'[message.is_bigendian] + table.DATATYPES[field.datatype])
            at = (message.height - 1) * message.row_step + field.offset
            at += (message.width - 1) * message.point_step + (field.count - 1) * dtype.itemsize
            raw = message.data[at : at + dtype.itemsize]
            assert len(raw) == dtype.itemsize
            last = np.frombuffer(raw, dtype)[0]
            got = column.reshape(rows, math.prod(column.shape[1:]))[-1, -1]
            assert got == last or (np.isnan(got) and np.isnan(last))


def test_only_named_columns_are_decoded_and_a_bad_field_is_named_all_the_same():
    b, c = np.ones((3, 2), np.float32), np.arange(3, dtype=np.int32)
    columns = decode_table(encode({'a': np.arange(3.0), 'b': b, 'c': c}), ('c', 'a', 'not_there'))
    assert list(columns) == ['a', 'c'] and columns['a'].tolist() == [0.0, 1.0, 2.0]
    fields = [('a', 0, 8, 1), ('depth', 8, 8, 1)]
    with pytest.raises(Rejection, match="'depth'.*beyond the point_step"):
        decode_table(cloud(fields, bytes(8), point_step=8), ('a',))


def test_what_a_message_may_cost_before_it_is_believed():
    """Too many rows are refused before the data are looked at; fields nobody asks for are free."""
    message = cloud([('a', 0, 8, 1)], None, width=11, point_step=8)
    with pytest.raises(Rejection, match='11 rows; at most 10') as caught:
        decode_table(message, most_rows=10)
    assert caught.value.reason == 'too_large'
    fields = [(f'f{i}', i % 7, 2, 1000) for i in range(1000)] + [('a', 0, 7, 1)]
    message = cloud(fields, bytes(1010 * 9_000), width=9_000, point_step=1010)
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
def test_a_table_says_whether_all_of_it_is_finite(rows):
    good = {'a': np.ones(rows), 'n': np.full(rows, 7, np.uint32)}
    assert encode(good).is_dense and encode({**good, 'v': np.ones((rows, 2))}).is_dense
    for bad in (np.nan, np.inf, -np.inf):
        spoilt = np.ones(rows)
        spoilt[-1] = bad
        assert not encode({**good, 'b': spoilt}).is_dense
        assert not encode({**good, 'v': np.column_stack([np.ones(rows), spoilt])}).is_dense


# -- tables of fixes


STAMP = 1_700_000_000_123_456_789
FLAT_COVARIANCE = [[4.0, 0.5], [0.5, 9.0]]
WHOLE = [[4.0, 0.5, 0.25], [0.5, 9.0, 0.5], [0.25, 0.5, 1.0]]


def scan(**columns):
    """Two fixes at (1, 2) and (3, 4); `columns` replace."""
    flat = {'cov_x_x': [1.0, 4.0], 'cov_x_y': [0.5, 0.0], 'cov_y_y': [1.0, 9.0]}
    full = {'x': [1.0, 3.0], 'y': [2.0, 4.0], **{n: np.float32(v) for n, v in flat.items()}}
    full = {n: np.asarray(v) for n, v in {**full, **columns}.items() if v is not None}
    return encode(full, STAMP)


def doubted(message):
    return scans.doubt_scan(message, read_scan(message))


def test_a_table_is_read_and_turned():
    got = read_scan(scan(z=[5.0, math.nan], id=np.array([7, -1], np.int32)))
    assert got.stamp_ns == STAMP and got.frame_id == 'map' and len(got) == 2
    assert got.position.tolist() == [[1.0, 2.0, 5.0], [3.0, 4.0, 0.0]]
    flat = got.covariance[:, :2, :2]
    assert flat.tolist() == [[[1.0, 0.5], [0.5, 1.0]], [[4.0, 0.0], [0.0, 9.0]]]
    assert np.isnan(got.covariance[:, 2]).all()
    assert got.target_id.tolist() == [7, -1]
    assert read_scan(scan()).target_id is None
    message = scan(z=[5.0, 6.0])
    got = read_scan(message, world_frame='ned')
    assert got.position.tolist() == [[2.0, 1.0, -5.0], [4.0, 3.0, -6.0]]
    assert got.covariance[1, :2, :2].tolist() == [[9.0, 0.0], [0.0, 4.0]]


SPOILT = [
    ('x', math.nan), ('x', 1e9), ('y', math.inf), ('cov_x_y', 2.0), ('cov_x_x', math.inf),
    ('cov_x_x', 1e-300),
]  # fmt: skip


def test_rows_that_cannot_be_used_are_left_out_and_doubted():
    for column, value in SPOILT:
        message = scan(**{column: [value, decode_table(scan())[column][1]]})
        assert read_scan(message).position.tolist() == [[3.0, 4.0, 0.0]]
        assert doubted(message) == 'unusable_rows' and doubted(scan()) is None
    # Unknown covariances are NaN in their rows.
    got = read_scan(scan(cov_x_x=[-1.0, 4.0]))
    assert np.isnan(got.covariance[0]).all()
    assert got.covariance[1, :2, :2].tolist() == [[4, 0], [0, 9]]
    zero = dict.fromkeys(('cov_x_x', 'cov_x_y', 'cov_y_y'), [0.0, 0.0])
    assert read_scan(scan(**zero)).covariance is None


def test_what_cannot_be_used_is_refused_with_its_reason():
    none = {name: [] for name in ('x', 'y', 'cov_x_x', 'cov_x_y', 'cov_y_y')}
    assert len(read_scan(scan(**none))) == 0  # an empty scan is one
    for code, columns in (
        ('missing_column', dict.fromkeys(none)), ('missing_column', {'cov_x_y': None}),
        ('nan', {'x': [math.nan, math.nan]}), ('bad_field', {'x': np.ones((2, 2))}),
        ('out_of_range', {'id': [0.5, 1.0]}), ('out_of_range', {'id': [3e9, 1.0]}),
    ):  # fmt: skip
        assert reason(read_scan, scan(**columns)) == code


@pytest.mark.parametrize(
    'n, named, deep', [(0, True, True), (1, True, False), (5, False, True), (5, True, True)]
)
def test_writing_and_reading_gives_the_same_scan(n, named, deep):
    covariance = np.tile(WHOLE if deep else FLAT_COVARIANCE, (n, 1, 1))
    known = {'covariance': covariance, 'target_id': np.arange(n) if named else None}
    position = np.random.default_rng(n).normal(size=(n, 3)) * 1e5
    fixes = Fixes(stamp_ns=STAMP, position=position, frame_id='map', **known)
    message = scans.write_scan(fixes, ros_message)
    assert ('cov_z_z' in [each.name for each in message.fields]) == (deep and n > 0)
    again = read_scan(message)
    if n:
        np.testing.assert_equal(asdict(again), asdict(fixes))
    assert len(again) == n and (again.target_id is None) == (not named or n == 0)


def test_poses_are_fixes_without_covariance():
    fixes = Fixes(stamp_ns=STAMP, position=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], frame_id='map')
    message = scans.write_poses(fixes, ros_message)
    got = scans.read_poses(message)
    assert (got.position == fixes.position).all() and got.covariance is None
    message.poses[0].position.x = math.nan
    left = scans.read_poses(message)
    assert len(left) == 1 and scans.doubt_scan(message, left) == 'unusable_rows'
    none = Fixes(stamp_ns=1, position=np.empty((0, 3)))
    assert len(scans.read_poses(scans.write_poses(none, ros_message))) == 0


def test_heights_are_read_where_they_are_stated():
    z = {'z': [5.0, math.nan], 'cov_z_z': [0.25, 0.25]}
    got = read_scan(scan(**z)).covariance
    assert got[0].tolist() == [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.25]]
    assert np.isnan(got[1, 2]).all()
    turned = read_scan(scan(**z, cov_x_z=[0.1, 0.0], cov_y_z=[0.2, 0.0]), world_frame='ned')
    assert turned.covariance[0, 2] == pytest.approx([-0.2, -0.1, 0.25])
    only = read_scan(scan(**z, cov_x_x=[-1.0, 4.0])).covariance[0]
    assert np.isnan(only[:2]).all() and only[2, 2] == 0.25
    assert np.isnan(read_scan(scan(cov_z_z=[1.0, 1.0])).covariance[:, 2]).all()


# -- arrivals


def columns(rows=3, **changes):
    base = {name: np.arange(rows, dtype=np.float64) + 1.0 for name in REQUIRED}
    base |= {'tx_id': np.zeros(rows, np.uint16), 'rx_id': np.arange(rows, dtype=np.uint16)}
    base |= {'toa': np.linspace(0.1, 0.2, rows), **changes}
    return {name: column for name, column in base.items() if column is not None}


def message(stamp_ns=10**18, frame_id='map', **changes):
    return encode(columns(**changes), stamp_ns, frame_id)


def test_missing_optional_columns_are_nan_and_bearings_are_wrapped():
    heard = read_arrivals(message())
    assert len(heard) == 3 and not heard.passive
    assert np.isnan(heard.var_toa).all() and np.isnan(heard.bearing).all()
    assert np.isnan(heard.var_bearing).all()
    assert heard.toa.tolist() == np.linspace(0.1, 0.2, 3).tolist()
    heard = read_arrivals(message(bearing=np.array([0.5, 1.5 * np.pi, np.nan])))
    assert heard.bearing[0] == 0.5 and heard.bearing[1] == pytest.approx(-0.5 * np.pi)
    assert np.isnan(heard.bearing[2])


def test_bad_rows_are_dropped_one_by_one_and_without_any_transmitter_the_target_emits():
    toa, spoilt = np.array([0.1, np.nan, 0.3, 0.4, 1e9, -0.1, 0.7]), np.zeros((2, 7))
    spoilt[0, 2], spoilt[1, 3] = np.inf, np.nan
    heard = read_arrivals(message(rows=7, toa=toa, rx_y=spoilt[0], tx_x=spoilt[1]))
    assert heard.rx_id.tolist() == [0, 6]
    nobody = dict.fromkeys(('tx_x', 'tx_y', 'tx_z'), np.full(3, np.nan))
    # Nothing is known of the instant but that it is near the stamp.
    for early, left in ((-0.01, [0, 1, 2]), (-1e4, [0, 2])):
        heard = read_arrivals(message(**nobody, toa=np.array([0.0, early, 0.2])))
        assert heard.passive and heard.rx_id.tolist() == left


def test_variances_that_are_none_or_too_small_become_unknown():
    variances = np.float32([1e-6, 0.0, -1.0, np.nan, np.inf])
    heard = read_arrivals(message(rows=5, var_toa=variances))
    assert heard.var_toa[0] == np.float32(1e-6) and np.isnan(heard.var_toa[1:]).all()
    limits = ('toa', 1e-14, 1e-19), ('bearing', 1e-11, 1e-14), ('depth', 1e-7, 1e-11)
    for name, good, small in limits:
        variance = np.float32([good, small, good])
        heard = read_arrivals(message(**{name: np.full(3, 0.1), f'var_{name}': variance}))
        found = getattr(heard, f'var_{name}')
        assert np.isnan(found).tolist() == [False, True, False]


def test_elevation_and_depth_come_and_go():
    known = {
        'elevation': [-0.2, np.nan, 0.1], 'var_elevation': np.float32([1e-4, np.nan, 2e-4]),
        'depth': [11.0, 11.0, np.nan], 'var_depth': np.float32([0.04, 0.04, np.nan]),
    }  # fmt: skip
    values = {'depth': np.array([11.0, 11.0, np.inf]), 'var_depth': np.float32([0.04, 0.04, 0.0])}
    given = {name: np.asarray(column) for name, column in (known | values).items()}
    heard = read_arrivals(message(**given))
    np.testing.assert_equal({name: getattr(heard, name) for name in known}, known)
    again = read_arrivals(write_arrivals(heard, ros_message))
    np.testing.assert_equal(asdict(again), asdict(heard))
    assert np.isnan(read_arrivals(message()).depth).all()


def test_arrivals_that_cannot_be_used_are_refused_with_their_reason():
    nowhere = {'tx_x': np.array([1.0, np.nan, 2.0]), 'rx_x': np.array([np.nan, 0.0, np.nan])}
    angles = [(name, degrees) for name in ('bearing', 'elevation') for degrees in (45.0, -45.0)]
    for code, changes in (
        ('empty', {'rows': 0}), ('missing_column', {'rx_y': None}),
        ('nan', {'toa': np.full(3, np.nan)}), ('nan', nowhere),
        ('out_of_range', {'rx_id': np.array([0.0, 0.5, 2.0])}),
        ('out_of_range', {'tx_id': np.array([0, -1, 2], np.int32)}),
        ('out_of_range', {'tx_id': np.array([0, 65536, 2], np.int32)}),
        *(('out_of_range', {name: np.array([0.1, value, 0.1])}) for name, value in angles),
        ('bad_field', {'toa': np.zeros((3, 2))}), ('bad_stamp', {'stamp_ns': 0}),
        ('frame_ned', {'frame_id': 'map_ned'}), ('too_large', {'rows': 10_001}),
    ):  # fmt: skip
        assert reason(read_arrivals, message(**changes)) == code


def test_writing_and_reading_gives_the_same_arrivals():
    for bearing in ([np.nan, np.nan], [0.3, np.nan]):
        spread = {'bearing': bearing, 'var_bearing': np.float32(0.1 * np.array(bearing))}
        heard = arrivals(
            10**18 + 1, [[1 / 3, 2.0, -1.0], [4.0, 5.0, 6.0]], [0.0, 0.1], rx_id=[3, 65535],
            var_toa=np.float32([1e-6, np.nan]), **spread,
        )  # fmt: skip
        again = read_arrivals(write_arrivals(heard, ros_message))
        np.testing.assert_equal(asdict(again), asdict(heard))
