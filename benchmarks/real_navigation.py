# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle tracker on the real motion of a vehicle, with simulated detections: semi-synthetic.

There is no public recording of forward-looking sonar detections with navigation. This takes 20
minutes of an AUV's attitude (10 Hz) and Doppler log (1.5 Hz) in a marina, dead-reckons the path,
takes that path as the truth, and lets a simulated sonar look at simulated obstacles from it. So
the motion, its roll, its irregular times and its slowness are real, and so is the altitude, the
mean of the ranges of the log's beams; echoes and their noise are not, and navigation errors other
than noise are absent. The vehicle kept its depth, which was not recorded; 2 m are supposed.

The vehicle shows little of a height, so that the answer hangs on what is believed beforehand. The
obstacles of the first row lie anywhere between surface and sea floor, as the tracker believes, and
it hears the altitude. In the second they lie within 1.2 m of the sonar's depth, and the tracker is
told neither that nor the altitude: it believes in anything down to the edge of the beam. Errors
are compared with that of the first answer of each track, of always answering 0 and of always
answering the mean of all true offsets, which nobody knows beforehand.
"""

from __future__ import annotations

from pathlib import Path

from attrs import frozen
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.study import DATA, rms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

FOLDER = DATA / 'stpere_nav'
SECOND = 10**9
DEPTH = 2.0
WINDOW = 80.0
"""Seconds of one encounter."""
PING_STEP = 0.5
STD = (0.15, np.radians(0.25))


@frozen(eq=False)
class Path3D:
    """The vehicle at any time: t (n,) s, position (n, 3) NED, rotations NED from FRD, altitude
    (n,) m."""

    t: np.ndarray
    position: np.ndarray
    attitude: Rotation
    altitude: np.ndarray

    def at(self, t: np.ndarray) -> Pose:
        place = np.column_stack([np.interp(t, self.t, axis) for axis in self.position.T])
        return Pose(place, Slerp(self.t, self.attitude)(t).as_matrix())


def dead_reckoned(folder: Path = FOLDER) -> Path3D:
    """The path from attitude and bottom velocity (smoothed over 6 s)."""
    attitude = np.genfromtxt(folder / 'attitude.csv', delimiter=',', names=True)
    log = np.genfromtxt(folder / 'dvl.csv', delimiter=',', names=True)
    log = log[log['bottom_velocity_valid'] == 1]
    t = attitude['stamp_s']
    keep = np.append(True, np.diff(t) > 0.0) & (t >= log['stamp_s'][0]) & (t <= log['stamp_s'][-1])
    t = t[keep]
    turns = Rotation.from_euler(
        'ZYX',
        np.column_stack([attitude[f'{name}_deg'][keep] for name in ('yaw', 'pitch', 'roll')]),
        degrees=True,
    )
    speed = [uniform_filter1d(log[f'bottom_velocity_{axis}_cm_s'] / 100.0, 9) for axis in 'xy']
    body = np.column_stack(
        [*(np.interp(t, log['stamp_s'], axis) for axis in speed), np.zeros(len(t))]
    )
    over_ground = turns.apply(body)
    over_ground[:, 2] = 0.0
    steps = 0.5 * (over_ground[1:] + over_ground[:-1]) * np.diff(t)[:, None]
    place = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]) + [0.0, 0.0, DEPTH]
    beams = np.column_stack([log[f'range_bottom_{beam}_m'] for beam in (1, 2, 3)])
    altitude = np.interp(t, log['stamp_s'], np.median(beams, axis=1))
    return Path3D(t - t[0] + 1.0, place, turns, altitude)


def encounter(
    path: Path3D, start: float, offset: float, seed: int, altimeter: bool
) -> tuple[list[Navigation | Detections | Altitude], np.ndarray]:
    """Measurements of one obstacle `offset` m below the sonar, and its true place, NED."""
    rng = np.random.default_rng(seed)
    here = path.at(np.array([start]))
    first = Pose(here.position[0], here.R[0])
    distance, azimuth = rng.uniform(15.0, 30.0), np.radians(rng.uniform(-8.0, 8.0))
    place = geometry.to_world(first, geometry.reconstruct(distance, azimuth, offset, first.R))
    received: list[tuple[float, Navigation | Detections | Altitude]] = []
    times = path.t[(path.t >= start - 0.5) & (path.t <= start + WINDOW + 0.5)]
    poses = path.at(times)
    turns = Rotation.from_matrix(geometry.flip_rotation(poses.R)).as_quat()
    for t, position, q in zip(times, geometry.flip_world(poses.position), turns):
        received.append(
            (
                t,
                Navigation(
                    stamp_ns=round(t * SECOND), position=position, orientation=q, frame_id='odom'
                ),
            )
        )
    if altimeter:
        heights = np.interp(times[::5], path.t, path.altitude)
        received += [
            (t, Altitude(stamp_ns=round(t * SECOND), altitude=float(height)))
            for t, height in zip(times[::5], heights)
        ]
    pings = np.arange(start, start + WINDOW, PING_STEP)
    m = geometry.to_body(path.at(pings), place)
    d, delta = geometry.project(m)
    seen = (np.abs(m[:, 2]) <= d * np.sin(np.radians(7.5))) & (np.abs(delta) < np.radians(22.5))
    seen &= rng.uniform(size=len(pings)) < 0.9
    noise = rng.normal(size=(len(pings), 2)) * STD
    for k, t in enumerate(pings):
        rows = [k] if seen[k] else []
        received.append(
            (
                t,
                Detections(
                    stamp_ns=round(t * SECOND),
                    range=(d + noise[:, 0])[rows],
                    bearing=-(delta + noise[:, 1])[rows],
                    frame_id='sonar',
                ),
            )
        )
    received.sort(key=lambda item: item[0])
    return [measurement for _, measurement in received], place


def judged(path: Path3D, start: float, seed: int, altimeter: bool) -> dict[str, float] | None:
    """Error of the offset at the last ping and of the first answer, the true offset, NEES, whether
    the band holds the truth, and its width, m; None when the track was lost."""
    rng = np.random.default_rng(seed + 1000)
    reach = (-1.2, 1.2)
    if altimeter:
        reach = (-DEPTH, float(np.interp(start, path.t, path.altitude)))
    offset = float(rng.uniform(*reach))
    measurements, place = encounter(path, start, offset, seed, altimeter)
    tracker = ObstacleTracker(
        ObstacleConfig(range_std=0.15, bearing_std_deg=0.25, behaviours=('fixed',))
    )
    known = [
        estimate
        for measurement in measurements
        for estimate in tracker.process(measurement)
        if (estimate.extras['track_state'] > 0).any()
    ]
    if not known:
        return None
    true, answer, variance = [], [], 0.0
    for estimate in (known[0], known[-1]):
        row = int(np.argmax(estimate.extras['track_state'] > 0))
        at = path.at(np.array([estimate.stamp_ns / SECOND])).position[0, 2]
        true.append(float(place[2] - at))
        answer.append(float(estimate.state[row, 2]))
        variance = float(estimate.covariance[row, 2, 2])
        low, high = (float(estimate.extras[f'vertical_offset_{end}'][row]) for end in ('lo', 'hi'))
    error = answer[1] - true[1]
    return {
        'error': error,
        'first': answer[0] - true[0],
        'true': true[1],
        'nees': error**2 / variance,
        'held': float(low <= true[1] <= high),
        'width': high - low,
    }


def summary(path: Path3D, runs: int = 40, altimeter: bool = True) -> dict[str, float]:
    """RMSE, NEES, coverage and mean band width over encounters all along the recording."""
    starts = np.linspace(path.t[0] + 1.0, path.t[-1] - WINDOW - 2.0, runs)
    encounters = [judged(path, float(s), seed, altimeter) for seed, s in enumerate(starts)]
    found = [scores for scores in encounters if scores is not None]
    columns = {name: np.array([scores[name] for scores in found]) for name in found[0]}
    return {
        'encounters': runs,
        'tracked': len(found),
        'rmse_m': rms(columns['error']),
        'first_answer_rmse_m': rms(columns['first']),
        'answering_zero_rmse_m': rms(columns['true']),
        'spread_of_truth_m': float(columns['true'].std()),
        'nees': float(np.mean(columns['nees'])),
        'band_coverage': float(np.mean(columns['held'])),
        'band_width_m': float(np.mean(columns['width'])),
    }


def rows(runs: int = 100) -> dict[str, dict[str, float]]:
    """Numbers where the altitude is known, and where it is not."""
    path = dead_reckoned()
    return {
        'between surface and sea floor': summary(path, runs),
        'within 1.2 m, altitude untold': summary(path, runs, altimeter=False),
    }
