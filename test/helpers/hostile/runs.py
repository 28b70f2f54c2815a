# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A tracker under a stream of good messages with bad ones between them, or with extreme parameters
that are allowed."""

from __future__ import annotations

from collections import Counter
from functools import cache, partial
from time import process_time
from typing import NamedTuple
import warnings

from attrs import define, field
from hypothesis import strategies as st
import numpy as np

from msg_adapters.inputs import inputs_of, made_inputs
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.measurements import DetectedImages

from .mutations import mutated, MUTATIONS
from .properties import check_estimate, check_refusal
from .streams import IMAGES, stream, templates, VARIANTS

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
        number, template = divmod(number, len(templates(system)))
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
        st.integers(0, len(VARIANTS[system]) - 1), st.lists(bad, min_size=BATCH, max_size=BATCH)
    )


@cache
def _tracker(system, variant):
    """A warm tracker, what reads for it, and the measurements of its stream."""
    entry = SYSTEMS[system]
    config = entry.config_type().from_mapping(VARIANTS[system][variant])
    tracker = entry.build(config)
    tracker.warm()
    settings = config.as_dict()
    readers = {
        (item.name, type_name): item.reader(type_name, 'enu', settings, item.name)
        for item in inputs_of(system)
        for type_name in item.readers
    }
    images = DetectedImages(system, IMAGES, settings) if made_inputs(system) else None
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
    name, type_name, message = templates(system)[bad.template]
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
    found = extreme_config(system, seed)
    if found is None:
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
