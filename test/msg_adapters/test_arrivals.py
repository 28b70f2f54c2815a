# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters.arrivals import COLUMNS, read_arrivals, REQUIRED, write_arrivals
from msg_adapters.table import encode_table
from sonar_imm.measurements import Arrivals, Rejection
from sonar_imm_tools.recordings.messages import ros_message


def columns(rows=3, **changes):
    base = {name: np.arange(rows, dtype=np.float64) + 1.0 for name in REQUIRED}
    base.update(
        tx_id=np.zeros(rows, np.uint16),
        rx_id=np.arange(rows, dtype=np.uint16),
        toa=np.linspace(0.1, 0.2, rows),
    )
    base.update(changes)
    return {name: column for name, column in base.items() if column is not None}


def message(stamp_ns=10**18, frame_id='map', **changes):
    return encode_table(columns(**changes), stamp_ns=stamp_ns, frame_id=frame_id, make=ros_message)


def test_missing_optional_columns_are_nan():
    arrivals = read_arrivals(message())
    assert len(arrivals) == 3 and not arrivals.passive
    assert np.isnan(arrivals.var_toa).all() and np.isnan(arrivals.bearing).all()
    assert np.isnan(arrivals.var_bearing).all()
    assert arrivals.toa.tolist() == np.linspace(0.1, 0.2, 3).tolist()


def test_a_missing_required_column_is_named():
    with pytest.raises(Rejection, match='rx_y') as caught:
        read_arrivals(message(rx_y=None))
    assert caught.value.reason == 'missing_column'


def test_bad_rows_are_dropped_one_by_one():
    arrivals = read_arrivals(
        message(
            rows=7,
            toa=np.array([0.1, np.nan, 0.3, 0.4, 1e9, -0.1, 0.7]),
            rx_y=np.array([0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0]),
            tx_x=np.array([0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 0.0]),
        )
    )
    assert arrivals.rx_id.tolist() == [0, 6]


def test_without_any_transmitter_the_target_emits():
    nowhere = np.full(3, np.nan)
    arrivals = read_arrivals(
        message(tx_x=nowhere, tx_y=nowhere, tx_z=nowhere, toa=np.array([0.0, -0.01, 0.2]))
    )
    assert arrivals.passive and len(arrivals) == 3
    # Nothing is known of the instant but that it is near the stamp.
    arrivals = read_arrivals(
        message(tx_x=nowhere, tx_y=nowhere, tx_z=nowhere, toa=np.array([0.0, -1e4, 0.2]))
    )
    assert arrivals.rx_id.tolist() == [0, 2]


def test_variances_that_are_none_become_unknown():
    variances = np.float32([1e-6, 0.0, -1.0, np.nan, np.inf])
    arrivals = read_arrivals(message(rows=5, var_toa=variances))
    assert arrivals.var_toa[0] == np.float32(1e-6) and np.isnan(arrivals.var_toa[1:]).all()


def test_each_kind_of_variance_has_its_own_least_value():
    arrivals = read_arrivals(
        message(
            var_toa=np.float32([1e-14, 1e-19, 1e-14]), bearing=np.zeros(3),
            var_bearing=np.float32([1e-11, 1e-14, 1e-11]), depth=np.zeros(3),
            var_depth=np.float32([1e-7, 1e-11, 1e-7]),
        )
    )  # fmt: skip
    for variance in (arrivals.var_toa, arrivals.var_bearing, arrivals.var_depth):
        assert np.isnan(variance).tolist() == [False, True, False]


def test_elevation_and_depth_come_and_go_and_degrees_are_refused():
    values = {
        'elevation': np.array([-0.2, np.nan, 0.1]),
        'var_elevation': np.float32([1e-4, np.nan, 2e-4]),
        'depth': np.array([11.0, 11.0, np.inf]),
        'var_depth': np.float32([0.04, 0.04, 0.0]),
    }
    arrivals = read_arrivals(message(**values))
    again = read_arrivals(write_arrivals(arrivals, ros_message))
    for item in (arrivals, again):
        np.testing.assert_array_equal(item.elevation, values['elevation'])
        np.testing.assert_array_equal(item.depth, [11.0, 11.0, np.nan])
        np.testing.assert_array_equal(item.var_depth, np.float32([0.04, 0.04, np.nan]))
        np.testing.assert_array_equal(item.var_elevation, values['var_elevation'])
    assert np.isnan(read_arrivals(message()).depth).all()
    for degrees in (45.0, -45.0):
        odd = message(elevation=np.array([0.1, degrees, 0.1]))
        assert reason(read_arrivals, odd) == 'out_of_range'


def test_bearings_are_wrapped_and_degrees_are_refused():
    arrivals = read_arrivals(message(bearing=np.array([0.5, 1.5 * np.pi, np.nan])))
    assert arrivals.bearing[0] == 0.5 and arrivals.bearing[1] == pytest.approx(-0.5 * np.pi)
    assert np.isnan(arrivals.bearing[2])
    for degrees in (45.0, -45.0):
        odd = message(bearing=np.array([0.1, degrees, 0.1]))
        assert reason(read_arrivals, odd) == 'out_of_range'


@pytest.mark.parametrize(
    'code, changes',
    [
        ('empty', {'rows': 0}),
        ('nan', {'toa': np.full(3, np.nan)}),
        ('nan', {'tx_x': np.array([1.0, np.nan, 2.0]), 'rx_x': np.array([np.nan, 0.0, np.nan])}),
        ('out_of_range', {'rx_id': np.array([0.0, 0.5, 2.0])}),
        ('out_of_range', {'tx_id': np.array([0, -1, 2], np.int32)}),
        ('out_of_range', {'tx_id': np.array([0, 65536, 2], np.int32)}),
        ('bad_field', {'toa': np.zeros((3, 2))}),
        ('bad_stamp', {'stamp_ns': 0}),
        ('frame_ned', {'frame_id': 'map_ned'}),
        ('too_large', {'rows': 10_001}),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(code, changes):
    assert reason(read_arrivals, message(**changes)) == code


@pytest.mark.parametrize('bearing', [np.full(2, np.nan), np.array([0.3, np.nan])])
def test_writing_and_reading_gives_the_same_arrivals(bearing):
    nowhere = np.full((2, 3), np.nan)
    arrivals = Arrivals(
        stamp_ns=10**18 + 1, tx_id=[0, 0], rx_id=[3, 65535], tx=nowhere,
        rx=[[1 / 3, 2.0, -1.0], [4.0, 5.0, 6.0]], toa=[0.0, 0.1],
        var_toa=np.float32([1e-6, np.nan]), bearing=bearing,
        var_bearing=np.float32(bearing * 0.1), frame_id='map',
    )  # fmt: skip
    again = read_arrivals(write_arrivals(arrivals, ros_message))
    assert again.stamp_ns == arrivals.stamp_ns and again.frame_id == 'map'
    for name in ('tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing'):
        assert np.array_equal(getattr(again, name), getattr(arrivals, name), equal_nan=True), name


NASTY = np.array(
    [
        0.1, 0.2, 0.5, 1.0, 3.0, 0.0, -1.0, 1e-30, 1e9, 1e30, -1e30, 45.0, 7e4, np.nan, np.inf,
        -np.inf,
    ]
)  # fmt: skip
ALL = COLUMNS


@given(
    rows=st.integers(0, 3),
    nasty=st.sets(st.sampled_from(ALL), max_size=4),
    gone=st.sampled_from((None,) * 5 + REQUIRED),
    values=st.binary(min_size=36, max_size=36),
    stamp_ns=st.integers(-(10**18), 2 * 10**18),
    cut=st.sampled_from((0, 0, 0, 1, 40)),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_arrivals_are_refused_or_finite(rows, nasty, gone, values, stamp_ns, cut):
    table = columns(rows=rows)
    drawn = NASTY[np.frombuffer(values, np.uint8) % len(NASTY)].astype(np.float32)
    for i, name in enumerate(sorted(nasty)):
        table[name] = drawn[3 * i : 3 * i + rows]
    table.pop(gone, None)
    cloud = encode_table(table, stamp_ns=stamp_ns, frame_id='map', make=ros_message)
    cloud.data = cloud.data[: len(cloud.data) - cut]
    try:
        arrivals = read_arrivals(cloud)
    except Rejection as rejection:
        assert rejection.reason and rejection.sentence
        return
    assert len(arrivals) and arrivals.stamp_ns > 0
    assert np.isfinite(arrivals.toa).all() and np.isfinite(arrivals.rx).all()
    assert arrivals.passive or np.isfinite(arrivals.tx).all()
    for name in ('var_toa', 'var_bearing'):
        known = getattr(arrivals, name)[~np.isnan(getattr(arrivals, name))]
        assert np.isfinite(known).all() and (known > 0.0).all()
    bearing = arrivals.bearing[~np.isnan(arrivals.bearing)]
    assert (np.abs(bearing) <= np.pi).all()
