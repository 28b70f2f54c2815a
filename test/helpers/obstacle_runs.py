# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Helpers of the obstacle tests: recorded approaches as measurements, runs, errors."""

import functools
import json
from pathlib import Path

import numpy as np

from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle.filters import build_filter, Sonar
from sonar_imm.trackers.obstacle.mixtures import innovations
from sonar_imm.trackers.obstacle.pings import Echoes, Mount
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
FAITHFUL = {
    **FIXED, **AS_STATED, 'components': 41, 'max_offset': 12.0, 'scale_std': 0.0,
    'navigation_noise': (0.0, 0.0, 0.0), 'clutter_density': 1e-9, 'gate_probability': 0.9999999,
    'max_tracks': 1, 'confirm_hits': 1,
}  # fmt: skip
"""A tracker that does what the exact posterior of the vectors does."""


@functools.cache
def meta(name):
    return json.loads((VECTORS / 'approach_meta.json').read_text())[f'{name}.csv']


@functools.cache
def rows(name):
    return np.genfromtxt(VECTORS / f'{name}.csv', delimiter=',', names=True)


def navigation(row, stamp_ns):
    return Navigation(
        stamp_ns=stamp_ns, position=[row['odom_x'], row['odom_y'], row['odom_z']],
        orientation=[row['qx'], row['qy'], row['qz'], row['qw']], frame_id='odom',
    )  # fmt: skip


def approach(name):
    """The measurements of a vector file, ROS axes."""
    out = []
    for row in rows(name):
        stamp = SECOND + round(row['t'] * SECOND)
        seen = np.isfinite(row['meas_range'])
        out.append(Altitude(stamp_ns=stamp, altitude=row['altitude']))
        out.append(navigation(row, stamp))
        out.append(
            Detections(
                stamp_ns=stamp,
                range=[row['meas_range']] if seen else [],
                bearing=[-row['meas_delta']] if seen else [],
            )
        )
    return out


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


def track_approach(name, **values):
    """The estimates of a vector file, ping by ping."""
    config = ObstacleConfig(sonar_lever=lever(name), **values)
    return list(run(ObstacleTracker(config), approach(name)).values())


def track_scene(name, seed, overrides=None, **values):
    """A simulated scene and the estimates of it."""
    return tracked(name, seed, overrides, **values)[:2]


def tracked(name, seed, overrides=None, **values):
    """A simulated scene, the estimates of it by stamp, and the tracker, with parameters `values`
    beside those that the scene has."""
    scene_config = scenario(name, overrides)
    scene = simulate(scene_config, seed)
    config = ObstacleConfig(
        **{
            'sonar_lever': scene_config.sonar_lever,
            'sonar_mount_rpy_deg': scene_config.sonar_mount_rpy_deg,
            'azimuth_model': scene_config.azimuth_model,
            'ping_timing': scene_config.ping_timing,
            **values,
        }
    )
    tracker = ObstacleTracker(config)
    return scene, run(tracker, [item.measurement for item in scene.measurements]), tracker


def followed(estimate, truth, ping, near=5.0):
    """The row of the confirmed track that follows `truth` at number `ping`, None when there is
    none."""
    r, b = estimate.state[:, 0], estimate.state[:, 1]
    true_r, true_b = truth.range[ping], truth.bearing[ping]
    distance = np.hypot(
        r * np.cos(b) - true_r * np.cos(true_b), r * np.sin(b) - true_r * np.sin(true_b)
    )
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
            return (
                estimate.state[row, 2] - true,
                estimate.covariance[row, 2, 2],
                low <= true <= high,
                estimate.probabilities[row, 0],
            )
    return None


def mean_nis(final):
    """Mean normalised innovation squared over all hits; 2 when all is right."""
    values = np.concatenate([estimate.extras['nis'] for estimate in final.values()])
    return float(np.nanmean(values))


def follow(measurements, config):
    """A vector file's obstacle without gate or track logic: NIS (n,) of each echo, and the last
    view."""
    mount = Mount(config)
    filter_, mixture, before, nis = build_filter(config), None, None, []
    for i in range(0, len(measurements), 3):
        altitude, pose, ping = measurements[i : i + 3]
        sonar = Sonar(
            mount.sonar(NavigationBuffer().added(pose).pose(pose.stamp_ns)), altitude.altitude
        )
        echoes = Echoes.of(ping, config)
        z, R = echoes.z, echoes.R
        if mixture is None:
            mixture = filter_.begin(z, R, sonar)
        else:
            mixture, _ = filter_.advance(mixture, before, sonar, 0.5)
            if len(z):
                h, C = filter_.expected(mixture, sonar)
                nis.append(innovations(mixture.mu, z[:, None] - h, C + R[:, None])[2][0])
                mixture = filter_.update(mixture, h, z, R, sonar)[0]
        before = sonar
    return np.array(nis), filter_.view(mixture, sonar)


def crossing(pings=80, detected=1.0, clutter=0.0, late=10**6):
    """The estimates ping by ping, and the true velocities (3, 2), east and north. Every echo comes
    with the probability `detected`, among `clutter` false ones a ping on average; the third
    obstacle echoes from ping `late` on and does not move."""
    rng = np.random.default_rng(3)
    velocity = np.array([[0.0, 0.5], [0.0, -0.5], [0.0, 0.0]])
    start = np.array([[70.0, -10.0], [72.0, 10.0], [84.0, 12.0]])
    measurements = []
    for k in range(pings):
        t, stamp = 0.5 * k, SECOND + k * SECOND // 2
        measurements.append(
            Navigation(stamp_ns=stamp, position=[t, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0])
        )
        off = start + t * velocity - [t, 0.0]
        z = np.column_stack([np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])])
        z[:2] += rng.normal(size=(2, 2)) * [0.1, 0.003]
        echoes = [z[0], z[1]]
        if detected < 1.0 or k >= late:
            z[2] += rng.normal(size=2) * [0.1, 0.003]
            echoes = [item for item in z[: 3 if k >= late else 2] if rng.uniform() < detected]
            echoes += [
                rng.uniform([5.0, -0.39], [99.0, 0.39]) for _ in range(rng.poisson(clutter))
            ]
        seen = np.reshape(echoes, (-1, 2))
        measurements.append(Detections(stamp_ns=stamp, range=seen[:, 0], bearing=seen[:, 1]))
    return list(run(ObstacleTracker(ObstacleConfig()), measurements).values()), velocity


def tracked_by_command(folder, scenario='tethers', seed=1, **settings):
    """Simulate and track into `folder`; gives the folder of the run."""
    changed = [part for name, value in settings.items() for part in ('--set', f'{name}={value}')]
    scene = ['simulate', 'obstacle', str(folder / 'scene'), '--scenario', scenario]
    assert main([*scene, '--seed', str(seed), *changed]) == 0
    assert main(['track', str(folder / 'scene'), str(folder / 'run')]) == 0
    return folder / 'run'
