# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is done to good messages, and a tracker under a stream of good ones with bad ones between
them, or with extreme parameters that are allowed.

Each mutation takes a message, which it may change, and a generator of random numbers; most leave a
message that gets past the first checks.
"""

from __future__ import annotations

from collections import Counter
from functools import cache, partial
from time import process_time
from typing import NamedTuple
import warnings

from attrs import define, field
from hypothesis import strategies as st
import numpy as np

from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import inputs_of, made_inputs
from msg_adapters.table import DATATYPES
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.measurements import DetectedImages

from . import streams
from .streams import make, SECOND, stream

ODD = np.array([
    np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1.0, 5e-324, 1e-45, 1e-30, 1e-12, 1e-6, 0.5, 3.0,
    np.pi, 90.0, 360.0, 1e5, 1e12, 1e30, 3e38, 1.7e308, -1e5, -1e30, 2.0**24, 2.0**53,
])  # fmt: skip
TEXTS = [
    '', ' ', 'map', 'other', 'map_ned', '/map', '<script>alert(1)</script>', 'ü' * 200, 'a/b',
    'a\nb', '\x1b[2J', 'z' * 5000,
]  # fmt: skip
_CODES = {name: code for code, name in DATATYPES.items()}
TABLE = 'sensor_msgs/msg/PointCloud2'


def odd_field(message, rng):
    """An odd value in any field, however deep."""
    places = list(streams.leaves(message))
    owner, name, node = places[rng.integers(len(places))]
    odd = _odd_many if streams.is_many(node) else _odd_one
    setattr(owner, name, odd(getattr(owner, name), node, rng))


def odd_table(message, rng):
    """Odd numbers, rows or columns in a table; an odd field in what is none."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    columns = _columns(message)
    for _ in range(1 + rng.integers(2)):
        _COLUMNS[rng.integers(len(_COLUMNS))](columns, rng)
    _encode(message, columns, rng)


def odd_layout(message, rng):
    """The same table, laid out in another way: byte order, padding, height, order of fields."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    _encode(message, _columns(message), rng, strange=True)


def claim(message, rng):
    """A table that claims what it does not hold."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    big = int(rng.choice([0, 1, 2, 3, 7, 255, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1]))
    if rng.random() < 0.4 and message.fields:
        field = message.fields[rng.integers(len(message.fields))]
        name = str(rng.choice(['offset', 'count', 'datatype']))
        setattr(field, name, big % 256 if name == 'datatype' else big)
    elif rng.random() < 0.3:
        message.data = message.data[: int(rng.integers(len(message.data) + 1))]
    else:
        setattr(message, str(rng.choice(['height', 'width', 'point_step', 'row_step'])), big)


def odd_stamp(message, rng):
    """A stamp that goes back, forward, or nowhere."""
    stamp = getattr(getattr(message, 'header', None), 'stamp', None)
    if stamp is None:
        return odd_field(message, rng)
    kind = rng.integers(6)
    if kind == 0:
        stamp.sec = int(rng.choice([0, 1, -1, -(2**31), 2**31 - 1]))
    elif kind == 1:
        stamp.nanosec = int(rng.choice([0, 1, 10**9 - 1, 10**9, 2**32 - 1]))
    else:
        most = [9.0, 10.5, 12.0, 17.0][kind - 2]
        shift = int(rng.choice([-1, 1]) * 10.0 ** rng.uniform(0.0, most))
        total = min(max(stamp.sec * SECOND + stamp.nanosec + shift, 0), (2**31 - 1) * SECOND)
        stamp.sec, stamp.nanosec = divmod(total, SECOND)


def again(message, rng):
    """Nothing: the message is sent again, or on another input."""


MUTATIONS = (odd_field, odd_table, odd_table, odd_layout, claim, odd_stamp, again)


def mutated(message, mutation, rng):
    """A copy of a message, changed once or twice."""
    message = streams.clone(message)
    mutation(message, rng)
    if rng.random() < 0.3:
        MUTATIONS[rng.integers(len(MUTATIONS))](message, rng)
    return message


def _odd_one(value, node, rng):
    number = streams.number_type(node)
    if number is None:
        return str(rng.choice(TEXTS))
    if node[1][0] == 'bool':
        return bool(rng.integers(2))
    if number.kind == 'f':
        return float(_odd_floats(np.asarray(value, number), rng))
    low, high = np.iinfo(number).min, np.iinfo(number).max
    return int(rng.choice([low, high, 0, 1, 2, 3, rng.integers(low, high)]))


def _odd_floats(values, rng):
    """Values like those given, or none at all like them."""
    with np.errstate(all='ignore'):
        kind = rng.integers(4)
        if kind == 0:
            new = values * 10.0 ** rng.uniform(-40.0, 40.0)
        elif kind == 1:
            new = values + rng.normal(size=values.shape) * 10.0 ** rng.uniform(-9.0, 3.0)
        else:
            new = rng.choice(ODD, values.shape)
        return np.asarray(new).astype(values.dtype)


def _odd_numbers(values, rng):
    """An array with odd numbers in some or all places."""
    where = rng.random(values.shape) < rng.choice([0.1, 0.5, 1.0])
    if values.dtype.kind == 'f':
        return np.where(where, _odd_floats(values, rng), values)
    limits = np.iinfo(values.dtype)
    new = rng.choice([limits.min, limits.max, 0, 1, 2, 3], values.shape)
    return np.where(where, new, values).astype(values.dtype)


def _odd_many(value, node, rng):
    if isinstance(value, list):
        if not streams.is_sequence(node):
            return value
        if not value or rng.random() < 0.2:
            return []
        picked = rng.integers(len(value), size=int(rng.integers(1, 2 * len(value) + 1)))
        return [streams.clone(value[i]) for i in picked]
    if streams.is_sequence(node) and rng.random() < 0.3:
        length = int(rng.choice([0, 1, max(len(value) - 1, 0), len(value) + 1, 1000]))
        return np.resize(value, length) if len(value) else np.ones(length, value.dtype)
    return _odd_numbers(value, rng)


# -- tables ---------------------------------------------------------------------------------------


def _columns(message):
    """The columns of a good table; nothing of one that is damaged already."""
    columns = {}
    rows = message.height * message.width
    for each in message.fields:
        code = DATATYPES.get(each.datatype)
        if code is None or each.count < 1 or each.count > 5000:
            continue
        dtype = np.dtype((np.dtype(code).newbyteorder('<'), (each.count,)))
        end = each.offset + dtype.itemsize
        if rows * message.point_step > len(message.data) or end > message.point_step:
            continue
        raw = np.asarray(message.data[: rows * message.point_step], 'u1')
        raw = raw.reshape(rows, message.point_step)[:, each.offset : end]
        columns[each.name] = np.ascontiguousarray(raw).view(f'<{code}').reshape(rows, each.count)
    return columns


def _one(columns, rng):
    names = list(columns)
    return names[rng.integers(len(names))] if names else None


def _odd_values(columns, rng):
    if (name := _one(columns, rng)) is not None:
        columns[name] = _odd_numbers(columns[name], rng)


def _odd_rows(columns, rng):
    rows = len(next(iter(columns.values()), ()))
    count = int(rng.choice([0, 1, 2, max(rows - 1, 0), rows, rows + 1, 3 * rows, 400]))
    if rng.random() < 0.5 and count <= rows:
        which = np.sort(rng.permutation(rows)[:count])
    else:
        which = rng.integers(max(rows, 1), size=count if rows else 0)
    for name in columns:
        columns[name] = columns[name][which]


def _fewer_columns(columns, rng):
    if (name := _one(columns, rng)) is not None:
        column = columns.pop(name)
        if rng.random() < 0.5:
            columns[str(rng.choice(TEXTS)) or 'x'] = column


def _other_count(columns, rng):
    if (name := _one(columns, rng)) is not None:
        count = int(rng.choice([1, 2, 3, 5, 8, 32, 200]))
        columns[name] = np.resize(columns[name], (len(columns[name]), count))


def _other_type(columns, rng):
    if (name := _one(columns, rng)) is not None:
        with np.errstate(all='ignore'):
            kind = str(rng.choice(list(DATATYPES.values())))
            columns[name] = columns[name].astype(f'<{kind}')


_COLUMNS = (
    _odd_values, _odd_values, _odd_values, _odd_rows, _fewer_columns, _other_count, _other_type,
)  # fmt: skip


def _encode(message, columns, rng, strange=False):
    """Write columns into a PointCloud2, with padding and byte order as it comes."""
    strange = strange or rng.random() < 0.2
    order = '>' if strange and rng.random() < 0.5 else '<'
    names = list(columns)
    if strange:
        rng.shuffle(names)
    fields, parts, offset = [], [], 0
    rows = len(next(iter(columns.values()), ()))
    for name in names:
        gap = int(rng.integers(5)) if strange else 0
        column = columns[name].astype(columns[name].dtype.newbyteorder(order))
        raw = np.ascontiguousarray(column).view('u1').reshape(rows, -1) if rows else None
        parts += [np.zeros((rows, gap), 'u1'), raw]
        told = {'datatype': _CODES[column.dtype.str[1:]], 'count': column.shape[1]}
        fields.append(make('sensor_msgs/msg/PointField', name=name, offset=offset + gap, **told))
        offset += gap + column.dtype.itemsize * column.shape[1]
    height = int(rng.choice([h for h in range(1, 5) if rows % h == 0])) if strange else 1
    table = np.concatenate(parts, axis=1) if rows and parts else np.zeros((rows, 0), 'u1')
    width, pad = rows // height, int(rng.integers(9)) if strange else 0
    lines = table.reshape(height, width * table.shape[1]) if height else table
    lines = np.concatenate([lines, np.zeros((len(lines), pad), 'u1')], axis=1)
    message.fields, message.is_bigendian = fields, order == '>'
    message.height, message.width, message.point_step = height, width, offset
    message.row_step, message.data = lines.shape[1], np.ascontiguousarray(lines).ravel()


# -- what must hold of every refusal and of every estimate --------------------------------------

ROUNDING = 1e-9


def check_refusal(rejection):
    """A reason to count, and a sentence to show."""
    assert rejection.reason and ' ' not in rejection.reason, rejection.reason
    assert rejection.sentence and '\n' not in rejection.sentence
    assert len(rejection.sentence) < 2000


def check_estimate(estimate):
    """`check_numbers`, and that a message can hold it."""
    check_numbers(estimate)
    write_estimate(estimate, make)


def check_numbers(estimate):
    """Numbers that are finite where they must be, covariances, probabilities."""
    valid = np.asarray(estimate.extras.get('valid', np.ones(len(estimate))), bool)
    if estimate.state_names == ('depth', 'amplitude') and len(estimate) == 1:
        valid = estimate.extras['existence'] > 0.0  # a row that says that there is no reflector
    state, covariance = estimate.state[valid], estimate.covariance[valid]
    for name, values in (('state', state), ('covariance', covariance)):
        assert np.isfinite(values).all(), f'{name} {values}'
    check_covariances(covariance)
    probabilities = estimate.probabilities
    if probabilities.size:
        assert ((probabilities >= 0.0) & (probabilities <= 1.0)).all(), probabilities
        wrong = np.abs(probabilities.sum(axis=1) - 1.0).max()
        assert wrong < ROUNDING, f'probabilities sum to one but for {wrong}'
    for name, column in estimate.extras.items():
        assert len(column) == len(estimate), name
        if name in ('existence', 'label_probability', 'label_confidence'):
            assert not ((column < 0.0) | (column > 1.0)).any(), f'{name} {column}'


def check_covariances(covariance):
    """(n, d, d): symmetric, and no eigenvalue of the correlations below zero but for rounding."""
    if not covariance.size:
        return
    assert (covariance == np.swapaxes(covariance, -1, -2)).all(), 'not symmetric'
    own = np.diagonal(covariance, axis1=-2, axis2=-1)
    assert (own >= 0.0).all(), f'a variance below zero: {own}'
    std = np.sqrt(np.where(own > 0.0, own, 1.0))
    least = np.linalg.eigvalsh(covariance / std[:, :, None] / std[:, None, :]).min()
    assert least > -ROUNDING, f'an eigenvalue of a correlation is {least}'


# -- runs ---------------------------------------------------------------------------------------

BATCH = 50
"""Bad messages in one run of a tracker."""

REFUSALS = {'too_late', 'duplicate', 'other_frame', 'unknown_type', 'other_spacing', 'full'}
"""What trackers count of a measurement that changes nothing; ``doubted`` is counted of earlier
ones when one is believed."""

REFUSED = 'refused'
"""Stands for the number of a good message where the tracker refused a bad one."""


class Bad(NamedTuple):
    """One hostile message: which template, what is done to it, and the seed of how."""

    template: int
    mutation: int
    seed: int

    @classmethod
    def of(cls, system, number):
        """One for each number; a smaller number is no simpler a case, but the same every time."""
        number, template = divmod(number, len(streams.templates(system)))
        return cls(template, *reversed(divmod(number, len(MUTATIONS))))


@define
class Tally:
    """What happened to hostile messages."""

    cases: int = 0
    read: int = 0
    estimates: int = 0
    refused: Counter = field(factory=Counter)
    counted: Counter = field(factory=Counter)
    seconds: list = field(factory=list)


def batches(system):
    """A strategy: which variant of the tracker, and the bad messages."""
    bad = st.integers(0, 2**40 - 1).map(lambda number: Bad.of(system, number))
    return st.tuples(
        st.integers(0, len(streams.VARIANTS[system]) - 1),
        st.lists(bad, min_size=BATCH, max_size=BATCH),
    )


@cache
def _tracker(system, variant):
    """A warm tracker, what reads for it, and the measurements of its stream."""
    entry = SYSTEMS[system]
    config = entry.config_type().from_mapping(streams.VARIANTS[system][variant])
    tracker = entry.build(config)
    tracker.warm()
    settings = config.as_dict()
    readers = {
        (item.name, type_name): item.reader(type_name, 'enu', settings, item.name)
        for item in inputs_of(system)
        for type_name in item.readers
    }
    images = DetectedImages(system, streams.IMAGES, settings) if made_inputs(system) else None
    for each in made_inputs(system):
        for type_name in each.readers:
            readers[each.name, type_name] = images.reader(each, type_name)
    good = [readers[name, kind](message) for name, kind, message in stream(system, variant)]
    return tracker, readers, good


def run(system, batch, tally=None):
    """Send the bad messages between good ones; every property is checked on the way, and a warning
    of numpy is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        _run(system, batch, Tally() if tally is None else tally)


def _run(system, batch, tally):
    variant, bads = batch
    tracker, readers, good = _tracker(system, variant)
    tracker.reset()
    intake = Intake(tracker)
    kept, estimates = [], {}
    for i, measurement in enumerate(good):
        kept.append((i, measurement))
        estimates[i] = _processed(intake, measurement, tally)
        for j in range(len(bads) * i // len(good), len(bads) * (i + 1) // len(good)):
            hostile = _read(system, bads[j], readers, measurement.stamp_ns, tally)
            if hostile is None:
                continue
            before = Counter(tracker.counts)
            found = _processed(intake, hostile, tally)
            delta = Counter(tracker.counts) - before
            if found is None:
                continue
            if found or not delta or set(delta) - REFUSALS:
                kept.append((None, hostile))
            else:
                kept.append((REFUSED, hostile))
                tally.counted.update(delta)
    if bads and bads[0].seed % 2:
        _check_nothing_lost(tracker, kept, estimates)


def _read(system, bad, readers, stamp_ns, tally):
    """The measurement that a bad message gives, None when it is refused."""
    rng = np.random.default_rng(bad.seed)
    name, type_name, message = streams.templates(system)[bad.template]
    message = _at(message, stamp_ns + int(rng.integers(10**8)))
    message = mutated(message, MUTATIONS[bad.mutation], rng)
    if rng.random() < 0.05:  # on another input of the same type
        name = rng.choice([reader for reader, kind in readers if kind == type_name])
    tally.cases += 1
    start = process_time()
    try:
        measurement = readers[name, type_name](message)
    except Rejection as rejection:
        check_refusal(rejection)
        tally.refused[rejection.reason] += 1
        measurement = None
    tally.seconds.append(process_time() - start)
    tally.read += measurement is not None
    return measurement


def _processed(intake, measurement, tally):
    """The estimates that a measurement gives, None when the intake refuses it."""
    start = process_time()
    try:
        found = _estimates(intake, measurement)
    except Rejection as rejection:
        check_refusal(rejection)
        tally.refused[rejection.reason] += 1
        return None
    tally.seconds.append(process_time() - start)
    for estimate in found:
        check_estimate(estimate)
    tally.estimates += len(found)
    return found


def _estimates(intake, measurement):
    admitted = intake.admit(measurement)
    return [] if admitted is None else intake.tracker.process(admitted)


def _check_nothing_lost(tracker, kept, estimates):
    """Without what was refused, every good message gives the same estimates, until either run
    takes the clock for restarted: a stamp that is refused is evidence of it, for or against.
    What the tracker refused still passes the intake, which remembers that these numbers came."""
    restarted = tracker.counts['restarts'] > 0
    tracker.reset()
    intake = Intake(tracker)
    for i, measurement in kept:
        try:
            found = (intake.admit if i is REFUSED else partial(_estimates, intake))(measurement)
        except Rejection:
            found = None
        if restarted or tracker.counts['restarts']:
            return
        if i in (None, REFUSED) or found is estimates[i] is None:
            continue
        assert found is not None and estimates[i] is not None
        for first, other in zip(found, estimates[i], strict=True):
            assert first.stamp_ns == other.stamp_ns
            for name in ('state', 'covariance', 'probabilities'):
                np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


def _at(message, stamp_ns):
    """The message, its stamp moved; what is below is shared, since a mutation copies it."""
    if not hasattr(message, 'header'):
        return message  # transforms, each with a stamp of its own
    stamp = message.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 10**9)
    return message


# -- extreme parameters ---------------------------------------------------------------------------

SHARE = 0.2
"""Of the parameters that are changed in a draw."""

COSTLY = {
    'particles': 200, 'particles_per_model': 20, 'threads': 1, 'directions': 24,
    'order_max': 6, 'smoothing_lag': 3, 'phones': 0, 'max_tracks': 10,
}  # fmt: skip
"""The most that is tried of what only costs time: how much is a matter of what a user pays."""

CHEAP = {
    'bathymetry': {'particles_per_model': 8},
    'diver': {},
    'fathometer': {'particles': 40, 'order_max': 3, 'phones': 0, 'record_seconds': 0.2},
    'obstacle': {'max_tracks': 4},
}
"""What a draw starts from."""


def extreme_config(system, seed):
    """An allowed configuration, and the parameters that differ; None when those drawn do not go
    together."""
    rng = np.random.default_rng(seed)
    values = dict(CHEAP[system])
    config_type = SYSTEMS[system].config_type()
    for spec in config_type.specs():
        if rng.random() < SHARE and spec.name not in ('pulse_file', 'phones', 'threads'):
            values[spec.name] = _extreme_value(spec, rng)
    while True:
        try:
            return config_type.from_mapping(values), values
        except ConfigError as error:
            # What the sentences name goes back to its default; without a name, one of all does.
            named = [name for name in values if any(name in problem for problem in error.problems)]
            if not values:
                return None
            del values[named[0] if named else sorted(values)[int(rng.integers(len(values)))]]


def _extreme_value(spec, rng):
    if spec.kind == 'bool':
        return bool(rng.integers(2))
    if spec.choices and spec.kind == 'str':
        return str(rng.choice(spec.choices))
    if spec.choices:
        return [str(choice) for choice in rng.permutation(spec.choices)[: 1 + rng.integers(4)]]
    if spec.kind in ('str', 'str[]'):
        return spec.default
    low = -1e6 if spec.low is None else spec.low
    high = COSTLY.get(spec.name, 1e6 if spec.high is None else spec.high)
    if spec.kind.endswith('[]'):
        count = len(spec.default)
        return [_extreme_number(spec, low, high, rng) for _ in range(count)]
    return _extreme_number(spec, low, high, rng)


def _extreme_number(spec, low, high, rng):
    kind = rng.integers(4)
    if kind < 2:
        value = (low, high)[kind]
    elif kind == 2 and high > max(low, 0.0):
        least = max(low, high * 1e-9)
        value = min(max(least * (high / least) ** rng.random(), low), high)
    else:
        value = rng.uniform(low, high)
    return round(value) if spec.kind.startswith('int') else float(value)


def run_extreme(system, seed):
    """Run one draw over a short stream; gives the number of estimates, None for no draw."""
    if (found := extreme_config(system, seed)) is None:
        return None
    config, values = found
    tracker = SYSTEMS[system].build(config)
    entries = {entry.name: entry for entry in inputs_of(system)}
    settings, count = config.as_dict(), 0
    variant = seed % 3 if system == 'fathometer' else 0
    for name, type_name, message in stream(system, variant):
        try:
            measurement = entries[name].reader(type_name, 'enu', settings, name)(message)
        except Rejection:
            continue
        for estimate in tracker.process(measurement):
            count += 1
            try:
                check_estimate(estimate)
            except AssertionError as error:
                raise AssertionError(f'{system} with {values}: {error}') from None
    return count
