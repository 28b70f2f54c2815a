# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Helpers of the diver tests: fixes, runs, errors."""

from attrs import fields
import numpy as np

from sonar_imm.measurements import Arrivals, Fix, Fixes

SECOND = 10**9


def fix(second, x, y, covariance=None, frame_id='map'):
    return Fix(
        stamp_ns=round(second * SECOND),
        position=[x, y, 0.0],
        covariance=np.eye(2) if covariance is None else covariance,
        frame_id=frame_id,
    )


def scan_of(second, places, std=0.5, **more):
    """Fixes at places (n, 2), each good to `std` m."""
    n = len(places)
    return Fixes(
        stamp_ns=round(second * SECOND),
        position=np.column_stack([np.reshape(places, (n, 2)), np.zeros(n)]),
        covariance=np.tile(std**2 * np.eye(2), (n, 1, 1)),
        **{'frame_id': 'map', **more},
    )


def scan(second, *places, **more):
    """Fixes at the places, each good to half a metre."""
    return scan_of(second, places, **more)


def arrivals(stamp_ns, rx, toa, **more):
    """Times toa (n,) heard at receivers rx (n, 3), of one tag unless `tx` (3,) or (n, 3) says
    where the transmitter is; good to a tenth of a millisecond, and without bearings."""
    n = len(rx)
    known = {'tx_id': np.zeros(n), 'rx_id': np.arange(n), 'tx': np.nan, 'var_toa': 1e-8}
    known |= {'bearing': np.nan, 'var_bearing': np.nan, 'frame_id': 'map', **more}
    known['tx'] = np.broadcast_to(known['tx'], (n, 3))
    for name in ('var_toa', 'bearing', 'var_bearing'):
        known[name] = np.broadcast_to(known[name], n)
    return Arrivals(stamp_ns=stamp_ns, rx=rx, toa=toa, **known)


def run(tracker, measurements):
    """The last word on every stamp."""
    final = {}
    for measurement in measurements:
        final.update((estimate.stamp_ns, estimate) for estimate in tracker.process(measurement))
    return [final[stamp] for stamp in sorted(final)]


def arrays(known):
    """Every array of a `Known`, by name."""
    yield from known.features.items()
    for name, part in (('life', known.life), ('rows', known.rows), ('borrowed', known.borrowed)):
        for field in fields(type(part)):
            value = getattr(part, field.name)
            if isinstance(value, np.ndarray):
                yield f'{name}.{field.name}', value
    yield from known.rows.key.items()
    for number, block in enumerate(known.rows.blocks):
        yield from ((f'{name}_{number}', part) for name, part in zip('xP', block))


def read_only(known):
    """Let nobody write into a `Known`, and count its arrays."""
    found = [array for _, array in arrays(known)]
    for array in found:
        array.flags.writeable = False
    return len(found)


def errors(estimates, track):
    """Position error (k, 2) and covariance (k, 2, 2) of the confirmed row of each stamp."""
    at = {int(stamp): k for k, stamp in enumerate(track.stamp_ns)}
    found = []
    for estimate in estimates:
        rows = np.flatnonzero(estimate.extras['track_state'] > 0)
        if len(rows):
            truth = track.position[at[estimate.stamp_ns], :2]
            found.append(
                (estimate.state[rows[0], :2] - truth, estimate.covariance[rows[0], :2, :2])
            )
    return [np.array(column) for column in zip(*found)]
