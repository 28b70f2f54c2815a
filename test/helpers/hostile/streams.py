# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Good messages: a short stream for each system, and one message of every input and type.

Messages are trees of plain values, by the definitions of their types: adapters read by attribute
access only, so that a tree serves as a message. Every leaf keeps to its type: what no wire could
bring is not tried.
"""

from __future__ import annotations

from functools import cache
import math
from types import SimpleNamespace

import numpy as np
from rosbags.interfaces import Nodetype

from msg_adapters.inputs import inputs_of, made_inputs
from sonar_imm import measurements as m

from .. import marine

NUMBERS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1',
    'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4',
    'int64': 'i8', 'uint64': 'u8', 'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
"""The numpy type of each number on the wire."""


def fields_of(type_name):
    """The fields of a message type: (name, node)."""
    return marine.typestore().fielddefs[type_name][1]


def make(type_name, **values):
    """A message with some fields, the others zero; the factory that writers take."""
    fields = {name: _zero(node) for name, node in fields_of(type_name)}
    return SimpleNamespace(**{**fields, **values}, __msgtype__=type_name)


def clone(value):
    """A copy that shares nothing that can change."""
    if isinstance(value, SimpleNamespace):
        return SimpleNamespace(**{name: clone(member) for name, member in vars(value).items()})
    if isinstance(value, list):
        return [clone(item) for item in value]
    return value.copy() if isinstance(value, np.ndarray) else value


def leaves(message):
    """Every place that holds something: (owner, name, node), lists and arrays as one."""
    for name, node in fields_of(message.__msgtype__):
        kind, detail = node
        if kind == Nodetype.NAME:
            yield from leaves(getattr(message, name))
            continue
        yield message, name, node
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and detail[0][0] == Nodetype.NAME:
            for item in getattr(message, name)[:3]:
                yield from leaves(item)


def number_type(node):
    """The numpy type of a leaf or of its elements; None for text and for messages."""
    kind, detail = node
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return number_type(detail[0])
    return np.dtype(NUMBERS[detail[0]]) if kind == Nodetype.BASE and detail[0] in NUMBERS else None


def is_many(node):
    return node[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)


def is_sequence(node):
    return node[0] == Nodetype.SEQUENCE


def _zero(node):
    kind, detail = node
    if kind == Nodetype.NAME:
        return make(detail)
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        inner, count = detail
        length = count if kind == Nodetype.ARRAY else 0
        number = number_type(inner)
        if number is not None:
            return np.zeros(length, number)
        return [_zero(inner) for _ in range(length)]
    if detail[0] in NUMBERS:
        return False if detail[0] == 'bool' else np.zeros((), NUMBERS[detail[0]]).item()
    return ''


T0 = 1_700_000_000 * 10**9
SECOND = 10**9
STEPS = 12

VARIANTS = {
    'bathymetry': (
        {'model_set': 'height_two_rw', 'particles_per_model': 8, 'smoothing': 'none'},
        {'model_set': 'height_rw_ncs', 'particles_per_model': 8, 'smoothing': 'modes'},
        {'navigation': 'ignored', 'ping_coupling': 0.3},
    ),
    'diver': (
        {'max_tracks': 4},
        {'origin': [3.0, 3.0, 0.0], 'fix_bias_std': 0.5, 'tags': ['a'], 'max_tracks': 4},
        {'dimensions': 3, 'association': 'jipda', 'max_tracks': 4},
        {'association': 'jipda', 'model_set': 'heading_speed', 'tags': ['a'], 'max_tracks': 4},
    ),
    'fathometer': (
        {'particles': 40, 'order_max': 3, 'phones': 0, 'record_seconds': 0.2},
        {'particles': 40, 'order_max': 2, 'phones': 0, 'smoothing_lag': 1, 'heave': 'memory',
         'record_distance': 5.0},
        {'particles': 40, 'order_max': 2, 'phones': 4, 'polarity': 'both'},
    ),
    'obstacle': (
        {'max_tracks': 6, 'history': 1.0},
        {'ping_timing': 'two_way', 'max_tracks': 4, 'history': 1.0},
        {'behaviours': ['fixed'], 'max_tracks': 4},
    ),
}  # fmt: skip
"""Parameters of the trackers under test; small, since speed is not what is tried."""

COVARIANCE = np.eye(2)
FRAMES = {
    ('obstacle', 'detections'): 'sonar', ('obstacle', 'image'): 'sonar',
    ('obstacle', 'altitude'): 'altimeter', ('bathymetry', 'altitude'): 'altimeter',
    ('fathometer', 'array_depth'): '', ('fathometer', 'position'): '',
}  # fmt: skip
"""The frame of messages; 'map' where it is not said."""


def _diver(k):
    stamp = T0 + k * SECOND
    at = np.array([0.7 * k, 5.0 + 0.1 * (k % 3), 0.0])
    if k % 4 == 3:
        rx = np.array([[0.0, 0, 0], [70, 10, 0], [-60, 45, 0], [10, 85, 0]])
        leg = np.linalg.norm(rx - at, axis=1)
        none = np.full(4, np.nan)
        yield 'arrivals', m.Arrivals(
            stamp_ns=stamp, frame_id='map', tx_id=np.zeros(4), rx_id=np.arange(4),
            tx=np.tile(rx[0], (4, 1)), rx=rx, toa=(leg + leg[0]) / 1500.0,
            var_toa=np.full(4, 1e-8), bearing=none, var_bearing=none,
        )  # fmt: skip
    elif k % 4 == 1:
        both = np.array([at, at + [20.0, 9.0, 0.0]])
        scan = {'position': both, 'covariance': np.tile(COVARIANCE, (2, 1, 1))}
        yield 'fixes', m.Fixes(stamp_ns=stamp, frame_id='map', **scan)
    else:
        yield 'fix', m.Fix(stamp_ns=stamp, frame_id='map', position=at, covariance=COVARIANCE)


def _pose(k, step_ns):
    yaw = 0.05 * math.sin(k)
    return m.Navigation(
        stamp_ns=T0 + k * step_ns, position=[0.5 * k, 0.0, -5.0], velocity=[1.0, 0.0, 0.0],
        orientation=[0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)],
        frame_id='map', child_frame_id='base',
    )  # fmt: skip


def _obstacle(k):
    step = SECOND // 2
    yield 'nav', _pose(k, step)
    if k % 4 == 0:
        yield 'altitude', m.Altitude(stamp_ns=T0 + k * step, altitude=12.0, frame_id='altimeter')
    if k % 4 == 2:
        floor = np.array([[30.0, 0.0, -17.0], [31.0, 1.0, -17.1]]) + [0.5 * k, 0.0, 0.0]
        ground = {'frame_id': 'map', 'position': floor, 'variance': [0.01, 0.01]}
        yield 'ground', m.Ground(stamp_ns=T0 + k * step, **ground)
    ranges = np.array([40.0, 25.0]) - 0.5 * k
    yield 'detections', m.Detections(
        stamp_ns=T0 + k * step, frame_id='sonar', range=ranges, bearing=[0.05, -0.1],
        var_range=[0.04, 0.04], var_bearing=[1e-4, 1e-4], intensity=[10.0, 20.0],
        elevation=[0.05, np.nan], var_elevation=[3e-4, np.nan],
    )  # fmt: skip


@cache
def _noise(*shape):
    rng = np.random.default_rng(7)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def _csdm(stamp):
    y = _noise(16, 4, 6)
    csdm = np.einsum('fms,fns->fmn', y, y.conj()) / 6.0
    return m.CrossSpectra(
        stamp_ns=stamp, frequency=500.0 + 50.0 * np.arange(16), csdm=csdm, snapshots=6,
        frame_id='array', reference_depth=30.0,
    )  # fmt: skip


def _pressure(k, stamp):
    samples = _noise(STEPS * 600, 4).real[600 * k : 600 * (k + 1)].astype(np.float32)
    return m.Pressure(
        stamp_ns=stamp, pressure=samples, sample_rate=6000.0, frame_id='array', scale=0.0,
        reference_depth=30.0,
    )  # fmt: skip


def _trace(stamp):
    depth = 20.0 + 0.1 * np.arange(60)
    amplitude = np.exp(-np.square((depth - 22.0) / 0.3)) + 0.02 * np.sin(31.0 * depth)
    return m.Trace(
        stamp_ns=stamp, depth=depth, amplitude=amplitude, sigma=np.full(60, 0.1), frame_id='array'
    )


def _fathometer(k, variant):
    stamp = T0 + k * (SECOND // 10 if variant == 0 else SECOND)
    if k % 5 == 0:
        yield 'array_depth', m.ArrayDepth(stamp_ns=stamp, depth=30.0)
        yield 'position', m.GeodeticFix(stamp_ns=stamp, latitude=3.0, longitude=3.0 + 1e-4 * k)
    if variant == 0:
        yield 'pressure', _pressure(k, stamp)
    elif variant == 1:
        yield 'trace', _trace(stamp)
    else:
        yield 'csdm', _csdm(stamp)


def _bathymetry(k):
    stamp = T0 + k * SECOND // 5
    ranges = 18.0 + 0.4 * np.arange(16)
    iq = (_noise(STEPS * 16, 1) * np.exp(1j * np.arange(4)) * 5.0)[16 * k : 16 * (k + 1)]
    yield 'nav', _pose(k, SECOND // 5)
    if k % 4 == 0:
        yield 'altitude', m.Altitude(stamp_ns=stamp, altitude=15.0, frame_id='altimeter')
    yield 'snapshot', m.Snapshot(
        stamp_ns=stamp, range=ranges, iq=iq.astype(np.complex64), frame_id='sonar',
        noise_variance=np.ones(16), sound_speed=1500.0,
    )  # fmt: skip


@cache
def stream(system, variant):
    """(input, type, message) of a short stream that the variant of a tracker follows."""
    entries = {entry.name: entry for entry in inputs_of(system)}
    steps = {'diver': _diver, 'obstacle': _obstacle, 'bathymetry': _bathymetry}
    found = []
    for k in range(STEPS):
        made = _fathometer(k, variant) if system == 'fathometer' else steps[system](k)
        for name, measurement in made:
            message = entries[name].write(measurement, make)
            if hasattr(message, 'data'):
                message.data = np.frombuffer(message.data, np.uint8)
            found.append((name, message.__msgtype__, message))
    return tuple(found)


@cache
def templates(system):
    """(input, type, message): a good message of every type of every input of a system."""
    found = {}
    for variant in range(len(VARIANTS[system])):
        for name, type_name, message in stream(system, variant):
            found.setdefault((name, type_name), clone(message))
    for entry in (*inputs_of(system), *made_inputs(system)):
        for type_name in entry.readers:
            if (entry.name, type_name) in found:
                continue
            message = plausible(type_name)
            if type_name.endswith('PointCloud2'):  # any table
                message = clone(next(m for (_, kind), m in found.items() if kind == type_name))
            if hasattr(message, 'header'):
                message.header.frame_id = FRAMES.get((system, entry.name), 'map')
            found[entry.name, type_name] = message
    return tuple((name, type_name, item) for (name, type_name), item in found.items())


SPECIAL = {
    'sensor_msgs/msg/LaserScan': {
        'angle_min': -0.2, 'angle_increment': 0.1, 'range_min': 0.5, 'range_max': 80.0,
        'angle_max': 0.1,
    },
    'sensor_msgs/msg/Image': {
        'height': 4, 'width': 4, 'step': 4, 'encoding': 'mono8', 'data': np.arange(16, dtype='u1'),
    },
    'oculus_interfaces/msg/Ping': {
        'n_ranges': 4, 'n_beams': 4, 'step': 4, 'sample_size': 1, 'range_resolution': 0.5,
        'bearings': np.array([-200, -100, 100, 200], 'i2'), 'ping_data': np.arange(16, dtype='u1'),
        'speed_of_sound_used': 1500.0, 'has_gains': False,
    },
    'ping360_sonar_msgs/msg/SonarEcho': {
        'number_of_samples': 4, 'range': 20, 'speed_of_sound': 1500,
        'intensities': np.arange(4, dtype='u1'),
    },
    'seatrac_interfaces/msg/ModemRec': {'position_flt_error': False, 'msg_id': 0x10},
    'sensors/msg/SonoptixECHO': {'array_data': make(
        'std_msgs/msg/Float32MultiArray', data=np.arange(16, dtype='f4'), layout=make(
            'std_msgs/msg/MultiArrayLayout', dim=[
                make('std_msgs/msg/MultiArrayDimension', label=name, size=4, stride=4)
                for name in ('ranges', 'beams')]))},
}  # fmt: skip
"""Fields that a type needs beside plausible numbers."""

IMAGES = {'image_near_range': 1.0, 'image_far_range': 20.0, 'image_fov_deg': 60.0}
"""What images that say nothing of themselves are told of."""

_FIELDS = {
    'w': 0.9273618495495704, 'x': 0.3, 'y': 0.2, 'z': 0.1, 'sec': T0 // SECOND, 'nanosec': 0,
    'sound_speed': 1500.0, 'sample_rate': 1000.0, 'beam_count': 4, 'samples_per_beam': 4,
    'dtype': 0, 'flags': [], 'child_frame_id': 'other',
}  # fmt: skip


def plausible(type_name):
    """A message in which no number is odd."""
    message = make(type_name)
    _fill(message)
    vars(message).update(SPECIAL.get(type_name, {}))
    return message


def _fill(message):
    for owner, name, node in leaves(message):
        number = number_type(node)
        if name in _FIELDS:
            value = _FIELDS[name]
        elif is_many(node) and number is not None:
            count = len(getattr(owner, name))
            side = round(math.sqrt(count))
            square = np.eye(side).ravel() if side and side * side == count else None
            value = (np.arange(4) + 3.0 if square is None else square).astype(number)
            if node[1][0] == (Nodetype.BASE, ('uint8', 0)):
                value = np.arange(16, dtype='u1')
        elif is_many(node):
            value = [plausible(node[1][0][1]) for _ in range(4)]
        elif number is None:
            value = 'map'
        elif number.kind == 'f':
            value = 3.0
        else:
            value = 1
        setattr(owner, name, value)
