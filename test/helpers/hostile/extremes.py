# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Trackers with extreme but allowed parameters, over short streams of good messages."""

from __future__ import annotations

from functools import cache

import numpy as np

from msg_adapters.inputs import inputs_of
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS

from .properties import check_estimate
from .streams import stream

SHARE = 0.2
"""Of the parameters that are changed in a draw."""

COSTLY = {
    'particles': 200, 'particles_per_model': 20, 'components': 21, 'threads': 1, 'directions': 24,
    'order_max': 6, 'grid_extent': 50.0, 'smoothing_lag': 3, 'phones': 0, 'max_tracks': 10,
}  # fmt: skip
"""The most that is tried of what only costs time: how much is a matter of what a user pays."""

CHEAP = {
    'bathymetry': {'particles_per_model': 8},
    'diver': {},
    'fathometer': {'particles': 40, 'order_max': 3, 'phones': 0, 'record_seconds': 0.2},
    'obstacle': {'max_tracks': 4},
}
"""What a draw starts from."""


def drawn(system, seed):
    """An allowed configuration, and the parameters that differ; None when those drawn do not go
    together."""
    rng = np.random.default_rng(seed)
    values = dict(CHEAP[system])
    config_type = SYSTEMS[system].config_type()
    for spec in config_type.specs():
        if rng.random() < SHARE and spec.name not in ('pulse_file', 'phones', 'threads'):
            values[spec.name] = _value(spec, rng)
    while True:
        try:
            return config_type.from_mapping(values), values
        except ConfigError as error:
            # What the sentences name goes back to its default; without a name, one of all does.
            named = [name for name in values if any(name in one for one in error.problems)]
            if not values:
                return None
            del values[named[0] if named else sorted(values)[int(rng.integers(len(values)))]]


def _value(spec, rng):
    if spec.kind == 'bool':
        return bool(rng.integers(2))
    if spec.choices and spec.kind == 'str':
        return str(rng.choice(spec.choices))
    if spec.choices:
        return [str(one) for one in rng.permutation(spec.choices)[: 1 + rng.integers(4)]]
    if spec.kind in ('str', 'str[]'):
        return spec.default
    low = -1e6 if spec.low is None else spec.low
    high = COSTLY.get(spec.name, 1e6 if spec.high is None else spec.high)
    if spec.kind.endswith('[]'):
        count = len(spec.default)
        return [_number(spec, low, high, rng) for _ in range(count)]
    return _number(spec, low, high, rng)


def _number(spec, low, high, rng):
    kind = rng.integers(4)
    if kind < 2:
        value = (low, high)[kind]
    elif kind == 2 and high > max(low, 0.0):
        least = max(low, high * 1e-9)
        value = min(max(least * (high / least) ** rng.random(), low), high)
    else:
        value = rng.uniform(low, high)
    return round(value) if spec.kind.startswith('int') else float(value)


@cache
def _messages(system, variant):
    return stream(system, variant)


def run(system, seed):
    """Run one draw over a short stream; gives the number of estimates, None for no draw."""
    found = drawn(system, seed)
    if found is None:
        return None
    config, values = found
    tracker = SYSTEMS[system].build(config)
    entries = {entry.name: entry for entry in inputs_of(system)}
    settings, count = config.as_dict(), 0
    for name, type_name, message in _messages(system, seed % 3 if system == 'fathometer' else 0):
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
