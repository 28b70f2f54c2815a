# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Helpers of the obstacle tests: recorded approaches and encounters as measurements, runs."""

import functools
import json
from pathlib import Path

import numpy as np

from helpers.vector_files import load_vectors
from sonar_imm.acoustics.geometry import Pose, rotation
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.filters import Sonar
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.cli import main
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

SECOND = 10**9
VECTORS = Path(__file__).parents[1] / 'vectors' / 'obstacle'
EXACT = {'drift_std': 0.0, 'yaw_error_std_deg': 0.0, 'navigation_delay_std': 0.0}
"""Navigation without errors that last."""
FIXED = {'behaviours': ('fixed',), **EXACT}
AS_STATED = {'variance_scale_min': 1.0, 'variance_scale_max': 1.0}
"""Variances as detections state them: what is wrong shows in the innovations."""
NO_NOISE = {'scale_std': 0.0, 'navigation_noise': (0.0, 0.0, 0.0)}
FAITHFUL = {
    **FIXED, **AS_STATED, **NO_NOISE, 'components': 41, 'max_offset': 12.0,
    'clutter_density': 1e-9, 'gate_probability': 0.9999999, 'max_tracks': 1, 'confirm_hits': 1,
}  # fmt: skip
"""A tracker that does what the exact posterior of the vectors does."""
KINDS = ('fixed', 'swaying', 'moving', 'seabed')
ENCOUNTERS = (
    ('swaying_approach', 0), ('moving_target', 0), ('starts_moving', 0), ('seabed_and_fixed', 0),
    ('seabed_and_fixed', 1),
)  # fmt: skip
"""Encounters at sea with the answers of an independent filter."""


def level(north=0.0, altitude=np.nan, turned=(0.0, 0.0, 0.0)):
    """A sonar 20 m deep, bow to the north unless it is turned."""
    return Sonar(Pose(np.array([north, 0.0, 20.0]), rotation(*turned)), altitude)


def still(stamp_ns, x=0.0, orientation=(0.0, 0.0, 0.0, 1.0)):
    """Navigation of a level vehicle 20 m deep, bow to the east."""
    return Navigation(stamp_ns=stamp_ns, position=[x, 0.0, -20.0], orientation=orientation)


def echoes(stamp_ns, z=(), **more):
    """A ping of echoes z (n, 2)."""
    z = np.reshape(np.asarray(z, float), (-1, 2))
    return Detections(stamp_ns=stamp_ns, range=z[:, 0], bearing=z[:, 1], **more)


@functools.cache
def meta(name):
    return json.loads((VECTORS / 'approach_meta.json').read_text())[f'{name}.csv']


@functools.cache
def rows(name):
    return np.genfromtxt(VECTORS / f'{name}.csv', delimiter=',', names=True)


def approach(name):
    """The measurements of a vector file, ROS axes."""
    out = []
    for row in rows(name):
        stamp = SECOND + round(row['t'] * SECOND)
        position, turn = (
            [row[key] for key in keys.split()] for keys in ('odom_x odom_y odom_z', 'qx qy qz qw')
        )
        out += [
            Altitude(stamp_ns=stamp, altitude=row['altitude']),
            Navigation(stamp_ns=stamp, position=position, orientation=turn, frame_id='odom'),
            echoes(stamp, seen_of(row['meas_range'], -row['meas_delta'])),
        ]
    return out


def seen_of(distance, bearing):
    return [(distance, bearing)] if np.isfinite(distance) else []


def lever(name):
    """Of a vector file, vehicle FLU."""
    x, y, z = meta(name)['cfg']['lever']
    return (x, -y, -z)


def run(tracker, measurements):
    """The last word on every ping, by stamp."""
    final = {}
    for measurement in measurements:
        final.update((estimate.stamp_ns, estimate) for estimate in tracker.process(measurement))
    return dict(sorted(final.items()))


def track(measurements, **values):
    """The estimates ping by ping."""
    return list(run(ObstacleTracker(ObstacleConfig(**values)), measurements).values())


def track_approach(name, **values):
    return track(approach(name), sonar_lever=lever(name), **values)


def track_scene(name, seed, overrides=None, **values):
    """A simulated scene and the estimates of it."""
    return tracked(name, seed, overrides, **values)[:2]


def tracked(name, seed, overrides=None, **values):
    """A simulated scene, the estimates of it by stamp, and the tracker, with parameters `values`
    beside those that the scene has."""
    config = scenario(name, overrides)
    scene = simulate(config, seed)
    shared = ('sonar_lever', 'sonar_mount_rpy_deg', 'azimuth_model', 'ping_timing')
    values = {**{key: getattr(config, key) for key in shared}, **values}
    tracker = ObstacleTracker(ObstacleConfig(**values))
    return scene, run(tracker, [item.measurement for item in scene.measurements]), tracker


def followed(estimate, truth, ping, near=5.0):
    """The row of the confirmed track that follows `truth` at number `ping`, None when there is
    none."""
    r, b = estimate.state[:, 0], estimate.state[:, 1]
    distance = np.abs(r * np.exp(1j * b) - truth.range[ping] * np.exp(1j * truth.bearing[ping]))
    good = (estimate.extras['track_state'] > 0) & (distance < near)
    return int(np.argmin(np.where(good, distance, np.inf))) if good.any() else None


def offset_at(scene, final, at_range):
    """Error of the vertical offset of the first obstacle, its variance, its band's success and
    P(above) when the range first falls to `at_range`; None when it is not tracked."""
    truth = scene.truth[0]
    for ping in np.flatnonzero(truth.range <= at_range)[:6]:
        estimate = final.get(int(truth.stamp_ns[ping]))
        row = None if estimate is None else followed(estimate, truth, ping)
        if row is not None:
            true = truth.vertical_offset[ping]
            low, high = (estimate.extras[f'vertical_offset_{end}'][row] for end in ('lo', 'hi'))
            error, variance = estimate.state[row, 2] - true, estimate.covariance[row, 2, 2]
            return error, variance, low <= true <= high, estimate.probabilities[row, 0]
    return None


@functools.cache
def met(name, number=0, altitude=True, **values):
    """The arrays of a recorded encounter by key, and the estimates of it ping by ping."""
    head, found = f'{number:02d}/', load_vectors(f'obstacle_sea/{name}')
    data = {key[len(head) :]: value for key, value in found.items() if key.startswith(head)}
    return data, track_encounter(data, altitude, **values)


def track_encounter(data, altitude=True, **values):
    given = []
    for k, t in enumerate(data['t']):
        stamp = SECOND + round(float(t) * SECOND)
        if altitude:
            given.append(Altitude(stamp_ns=stamp, altitude=float(data['altitude'][k])))
        pose, turn, velocity, rate = (data[f'odom_{key}'][k].astype(float) for key in 'pqvw')
        moving = {'velocity': velocity, 'turn_rate': rate, 'frame_id': 'odom'}
        given.append(Navigation(stamp_ns=stamp, position=pose, orientation=turn, **moving))
        given.append(echoes(stamp, seen_of(data['meas_range'][k], data['meas_bearing'][k])))
    lever = tuple(float(value) for value in data['sonar_lever_flu'])
    return track(given, sonar_lever=lever, **{**AS_STATED, **values})


def oldest(estimate):
    """The columns of the only, or the longest, track."""
    row = int(np.argmin(estimate.extras['track_id']))
    return {name: values[row] for name, values in estimate.columns().items()}


def column(estimates, name, pings):
    """(n,) of the oldest track."""
    return np.array([oldest(estimates[k])[name] for k in pings])


def tracked_by_command(folder, scenario='tethers', seed=1, **settings):
    """Simulate and track into `folder`; gives the folder of the run."""
    changed = [part for name, value in settings.items() for part in ('--set', f'{name}={value}')]
    scene = ['simulate', 'obstacle', str(folder / 'scene'), '--scenario', scenario]
    assert main([*scene, '--seed', str(seed), *changed]) == 0
    assert main(['track', str(folder / 'scene'), str(folder / 'run')]) == 0
    return folder / 'run'
