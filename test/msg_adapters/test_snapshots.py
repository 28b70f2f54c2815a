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

from msg_adapters.snapshots import CONSTANTS, read_snapshot, VARIANCES, write_snapshot
from msg_adapters.table import encode_table
from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm_tools.recordings.messages import ros_message

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
    assert (
        snapshot.sound_speed == 1500.0
        and snapshot.frequency is None
        and snapshot.noise_variance is None
    )


def test_an_organised_cloud_says_the_same():
    first, other = read_snapshot(message()), read_snapshot(organised())
    assert (first.iq == other.iq).all() and (first.range == other.range).all()
    assert reason(read_snapshot, organised(range=np.zeros(BINS * STAVES))) == 'bad_range'


def test_times_become_ranges():
    time = (17.0 + 0.05 * np.arange(BINS)) / 750.0
    snapshot = read_snapshot(message(range=None, time=time))
    assert np.allclose(snapshot.range, 750.0 * time) and (snapshot.two_way_time == time).all()
    unknown = read_snapshot(message(range=None, time=time, sound_speed=None))
    assert np.allclose(unknown.ranges(1480.0), 740.0 * time)


def test_constants_hold_for_the_whole_ping():
    changing = np.float32([1500.0] * (BINS - 1) + [1501.0])
    assert reason(read_snapshot, message(sound_speed=changing)) == 'not_constant'
    partly = np.float32([np.nan] * (BINS - 1) + [1501.0])
    assert read_snapshot(message(sound_speed=partly)).sound_speed == 1501.0
    for nothing in (0.0, np.nan):
        snapshot = read_snapshot(message(sound_speed=np.full(BINS, nothing)))
        assert snapshot.sound_speed is None


@pytest.mark.parametrize(
    'code, changes',
    [
        ('missing_column', {'iq': None}),
        ('missing_column', {'range': None}),
        ('bad_field', {'iq': np.ones((BINS, 5), np.float32)}),
        ('bad_field', {'iq': np.ones(BINS)}),
        ('bad_staves', {'staves': 1}),
        ('bad_staves', {'staves': 65}),
        ('too_short', {'bins': 1}),
        ('too_short', {'bins': 0}),
        ('bad_stamp', {'stamp_ns': 0}),
        ('nan', {'iq': np.full((BINS, 6), np.nan, np.float32)}),
        ('silent', {'iq': np.zeros((BINS, 6), np.float32)}),
        ('bad_field', {'range': np.ones((BINS, 2))}),
        ('out_of_range', {'element_spacing': np.full(BINS, -1.0)}),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(code, changes):
    assert reason(read_snapshot, message(**changes)) == code


def test_a_cloud_without_staves_is_refused():
    cloud = organised()
    cloud.width = 0
    assert reason(read_snapshot, cloud) == 'no_staves'


def test_a_million_bins_are_refused():
    many = encode_table(
        {'range': np.arange(1e6, dtype=np.float32), 'iq': np.ones((10**6, 4), np.float32)},
        stamp_ns=10**18,
        frame_id='sonar',
        make=ros_message,
    )
    assert reason(read_snapshot, many) == 'too_large'


@pytest.mark.parametrize('times', [False, True])
def test_writing_and_reading_gives_the_same_snapshot(times):
    rng = np.random.default_rng(1)
    noise = np.float32([1.0, 2.0, np.nan, 4.0])
    time = np.arange(1.0, 5.0) * 1e-3 / 3.0
    snapshot = Snapshot(
        stamp_ns=10**18 + 1,
        frame_id='sonar',
        range=np.float32([17.0, 17.1, 17.2, 17.3]),
        iq=(rng.normal(size=(4, 8)) + 1j * rng.normal(size=(4, 8))).astype(np.complex64),
        two_way_time=time if times else None,
        noise_variance=noise,
        sound_speed=1500.0,
        signal_variance=noise,
        frequency=455e3,
        element_spacing=2.0**-9,
        sample_rate=15e3,
    )
    again = read_snapshot(write_snapshot(snapshot, ros_message))
    assert again.stamp_ns == snapshot.stamp_ns and (again.iq == snapshot.iq).all()
    assert np.allclose(again.range, 750.0 * time if times else snapshot.range, rtol=1e-15)
    for name in (*VARIANCES, *CONSTANTS):
        assert np.array_equal(getattr(again, name), getattr(snapshot, name), equal_nan=True), name


NASTY = np.array([0.1, 1.0, 17.0, 0.0, -1.0, 1e-30, 1e30, 1e38, 1500.0, np.nan, np.inf, -np.inf])
ALL = ('range', 'time', 'iq', *CONSTANTS, *VARIANCES)


@given(
    bins=st.integers(0, 4),
    staves=st.integers(0, 3),
    nasty=st.sets(st.sampled_from(ALL)),
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
        assert rejection.reason and rejection.sentence
        return
    assert (
        snapshot.usable.any()
        and np.isfinite(snapshot.iq[snapshot.usable]).all()
        and snapshot.bin_width > 0.0
    )
    for name in VARIANCES:
        known = getattr(snapshot, name)
        assert known is None or (known[~np.isnan(known)] > 0.0).all()
    assert snapshot.sound_speed is None or 1300.0 <= snapshot.sound_speed <= 1700.0
