# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Runs with known errors: estimates are the truth plus noise drawn from the stated covariance."""

import numpy as np

from msg_adapters.fixes import write_fix
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

START_NS = 1_700_000_000_000_000_000
SECOND = 10**9
HEADINGS = tuple(f'heading_{index * 360 // 16:03d}' for index in range(16)) + ('hover',)
FIX_SIGMA = 1.2
SIGMA = np.array([0.6, 0.3, 0.2, 0.1])


def legs(times):
    """(n, 4) a walk at 0.8 m/s: east, then north, then north-west."""
    course = np.radians(np.select([times < 40, times < 70], [0.0, 90.0], 135.0))
    velocity = 0.8 * np.column_stack([np.cos(course), np.sin(course)])
    steps = np.diff(times, append=times[-1])[:, None] * velocity
    position = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]])
    return np.hstack([position, velocity])


def covariance():
    """(4, 4) with correlations, so that a swapped axis shows."""
    correlation = np.eye(4)
    correlation[0, 1] = correlation[1, 0] = 0.5
    correlation[0, 2] = correlation[2, 0] = 0.3
    return SIGMA[:, None] * correlation * SIGMA


def estimate_at(stamp_ns, states, ids, *, stated=None, tentative=False, nis=None):
    """One estimate with a row for each of `states` (rows, 4)."""
    rows = len(states)
    states = np.reshape(states, (rows, 4))
    probabilities = np.full((rows, len(HEADINGS)), 0.2 / (len(HEADINGS) - 1))
    course = np.degrees(np.arctan2(states[:, 3], states[:, 2])) % 360.0
    probabilities[np.arange(rows), np.rint(course / 22.5).astype(int) % 16] = 0.8
    return Estimate(
        stamp_ns=stamp_ns, frame_id='map', xyz=np.column_stack([states[:, :2], np.zeros(rows)]),
        state_names=('px', 'py', 'vx', 'vy'), state=states,
        covariance=np.tile(covariance() if stated is None else stated, (rows, 1, 1)),
        model_names=HEADINGS, probabilities=probabilities,
        extras={
            'track_id': np.array(ids, np.uint32),
            'track_state': np.full(rows, 0 if tentative else 1, np.uint8),
            'nis': np.full(rows, np.nan) if nis is None else np.asarray(nis, float),
            'nis_dof': np.full(rows, 0 if nis is None else 2, np.uint16),
        },
    )  # fmt: skip


def truth_estimate(stamp_ns, states, ids):
    """One stamp of a truth table as it reads back from a bag: states among the extras."""
    states = np.reshape(states, (len(ids), 4))
    return Estimate(
        stamp_ns=stamp_ns, frame_id='map', state_names=(), state=np.empty((len(ids), 0)),
        xyz=np.column_stack([states[:, :2], np.zeros(len(ids))]).astype(np.float32),
        covariance=np.empty((len(ids), 0, 0)), probabilities=np.empty((len(ids), 0)),
        extras={
            **dict(zip(('px', 'py', 'vx', 'vy'), states.T)),
            'track_id': np.array(ids, np.uint32),
        },
    )  # fmt: skip


def stamps(times):
    """Seconds of a scene as stamps."""
    return [START_NS + round(float(time) * SECOND) for time in times]


def single_run(count=400, seed=1, spread=1.0):
    """(estimates, truth, times): one diver; errors are `spread` times as large as stated."""
    rng = np.random.default_rng(seed)
    times = np.arange(count) * 0.25
    truth = legs(times)
    error = spread * rng.multivariate_normal(np.zeros(4), covariance(), size=count)
    nis = rng.chisquare(2, count)
    estimates = [
        estimate_at(stamp, state[None], [7], nis=[value])
        for stamp, state, value in zip(stamps(times), truth + error, nis)
    ]
    true = [truth_estimate(stamp, state[None], [0]) for stamp, state in zip(stamps(times), truth)]
    return estimates, true, times


def write_dive(path, *, count=120, seed=4, truth=True, topic='/fix', spoilt=(), shuffle=False):
    """One diver, a fix a second, truth at half seconds; `spoilt` fixes have a NaN position."""
    rng = np.random.default_rng(seed)
    times = np.arange(count) * 1.0
    place = legs(times)[:, :2] + rng.normal(0.0, FIX_SIGMA, (count, 2))
    order = np.arange(count)
    if shuffle:
        for pair in range(10, count - 1, 7):
            order[[pair, pair + 1]] = order[[pair + 1, pair]]
    with BagWriter(path) as bag:
        if truth:
            dense = np.arange(2 * count) * 0.5
            state = legs(dense)
            true = TrueTrack(0, stamps(dense), state[:, :2], state[:, 2:])
            for stamp, name, message in records_of(true, 'map'):
                bag.write(name, message, stamp)
        stamp_ns = stamps(times)
        for arrival, index in enumerate(order):
            given = {'position': [*place[index], 0.0], 'covariance': np.eye(2) * FIX_SIGMA**2}
            fix = Fix(stamp_ns=stamp_ns[index], frame_id='map', **given)
            message = write_fix(fix, ros_message)
            if index in spoilt:
                message.pose.pose.position.x = float('nan')
            bag.write(topic, message, stamp_ns[arrival])
    return path
