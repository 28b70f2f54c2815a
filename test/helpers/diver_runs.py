# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Helpers of the diver tests: fixes, pings, runs, errors."""

from attrs import fields
import numpy as np

from sonar_imm.measurements import Arrivals, Fix, Fixes
from sonar_imm.trackers.diver.instruments import Instruments
from sonar_imm.trackers.diver.scan import ping_measurements

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


def numbers_of(ping, config, models, layout=None):
    layout = layout or Instruments().layout(config, models)
    return ping_measurements(ping, np.arange(len(ping)), config, models, layout)


def followed(tracker, measurements):
    """The newest estimate after each measurement."""
    return [tracker.process(measurement)[-1] for measurement in measurements]


def miss(estimate, place, row=0):
    """How far a row is from a place of two or three coordinates, m, and the NEES."""
    n = len(place)
    off = estimate.state[row, :n] - place
    return np.sqrt(off @ off), off @ np.linalg.solve(estimate.covariance[row, :n, :n], off)


def run(tracker, measurements):
    """The last word on every stamp."""
    final = {}
    for measurement in measurements:
        final.update((estimate.stamp_ns, estimate) for estimate in tracker.process(measurement))
    return [final[stamp] for stamp in sorted(final)]


def read_only(known):
    """Let nobody write into a `Known`, and count its arrays."""
    found = [*known.features.values(), *known.rows.key.values()]
    found += [part for block in known.rows.blocks for part in block]
    for part in (known.life, known.rows, known.borrowed):
        found += [getattr(part, field.name) for field in fields(type(part))]
    found = [array for array in found if isinstance(array, np.ndarray)]
    for array in found:
        array.flags.writeable = False
    return len(found)


def errors(estimates, track, first=0):
    """(k, 2): `miss` of the confirmed row of each estimate, from the stamp `first` of it on."""
    at = {int(stamp): k for k, stamp in enumerate(track.stamp_ns)}
    found = []
    for estimate in estimates:
        rows, k = np.flatnonzero(estimate.extras['track_state'] > 0), at[estimate.stamp_ns]
        if len(rows) and k >= first:
            found.append(miss(estimate, track.position[k, :2], rows[0]))
    return np.array(found)


def both_sides(estimate):
    """The two places that the rows of both sides are at."""
    image = np.array([estimate.extras[name][0] for name in ('mirror_x', 'mirror_y')])
    return image, 2.0 * estimate.state[0, :2] - image
