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

"""The deferred estimate of the paper beside the online one: RMSD against the vertical offset.

The echoes of a track are those nearest to where the track was at its hits. With them, and the
navigation of the recording, `rmsd` computes the curves of the paper's
Figure 3.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.config import ObstacleConfig

from .rmsd import Deferred, deferred, sonar_poses
from .series import Series, TruePath

MOST_ECHOES = 300
LEAST_ECHOES = 5


@frozen(eq=False, kw_only=True)
class DeferredEstimates:
    """The deferred curves of one track, and what to compare them with: `plain`, RMSD below the
    sonar as the paper has it; `both`, RMSD on both sides; `refit`, both sides with first echo and
    scale refitted.

    All offsets hold at the first echo of the track, m below the sonar, NaN when unknown. `truth`;
    `online` with `online_std` and `band`: what the tracker says at its last echo; `altitude`: of
    the sonar above the sea floor, with `altitude_std`. What is left of it below the obstacle is
    the length of its tether, if it is moored.
    """

    track_id: int
    echoes: int
    plain: Deferred
    both: Deferred
    refit: Deferred
    online: float
    online_std: float
    band: tuple[float, float]
    altitude: float
    altitude_std: float
    truth: float = float('nan')

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for `metrics.json`."""
        result = {
            'track_id': self.track_id,
            'echoes': self.echoes,
            'rmsd_m': self.plain.best,
            'rmsd_both_sides_m': self.both.best,
            'refit_m': self.refit.best,
            'online_m': self.online,
            'altitude_m': self.altitude,
            'tether_m': self.altitude - self.online,
            'tether_std_m': float(np.hypot(self.online_std, self.altitude_std)),
        }
        if np.isfinite(self.truth):
            result |= {
                'truth_m': self.truth,
                'rmsd_error_m': self.plain.best - self.truth,
                'rmsd_both_sides_error_m': self.both.best - self.truth,
                'refit_error_m': self.refit.best - self.truth,
                'online_error_m': self.online - self.truth,
            }
        return result


def deferred_estimates(
    series: Series,
    measurements: Iterable[Any],
    config: ObstacleConfig,
    truth: dict[int, TruePath],
    gap: float,
) -> DeferredEstimates | None:
    """The deferred estimates of the track with most hits; None when it has too few echoes.

    truth: obstacle by track id, for the tracks that were matched with one.
    """
    track_id = series.longest_track()
    if track_id is None:
        return None
    track = series.pick((series.track_id == track_id) & np.isfinite(series.nis))
    received = list(measurements)
    pings = {p.stamp_ns: p for p in received if isinstance(p, Detections) and len(p)}
    track = track.pick(np.array([stamp in pings for stamp in track.stamp_ns.tolist()], bool))
    navigation = [pose for pose in received if isinstance(pose, Navigation)]
    poses, known = sonar_poses(navigation, track.stamp_ns, config)
    rows = np.flatnonzero(known)
    rows = rows[:: max(1, -(-len(rows) // MOST_ECHOES))]
    if len(rows) < LEAST_ECHOES:
        return None
    z = np.array(
        [_echo(pings[int(track.stamp_ns[row])], track.state[row], config) for row in rows]
    )
    at = type(poses)(poses.position[rows], poses.R[rows])
    sunk = float(at.position[-1, 2] - at.position[0, 2])
    first, last = track.stamp_ns[rows[:1]], rows[-1]
    path = truth.get(track_id)
    heights = [height for height in received if isinstance(height, Altitude)]
    altitude = float('nan')
    if heights:
        altitude = min(heights, key=lambda height: abs(height.stamp_ns - int(first[0]))).altitude
    return DeferredEstimates(
        track_id=track_id,
        echoes=len(rows),
        plain=deferred(z, at, config),
        both=deferred(z, at, config, both_sides=True),
        refit=deferred(z, at, config, both_sides=True, refit=True),
        online=float(track.state[last, 2]) + sunk,
        online_std=float(np.sqrt(track.covariance[last, 2, 2])),
        band=(float(track.low[last]) + sunk, float(track.high[last]) + sunk),
        altitude=altitude + config.sonar_lever[2],
        altitude_std=config.altitude_std,
        truth=float(path.at(first, gap)[0, 2]) if path else float('nan'),
    )


def _echo(ping: Detections, state: FloatArray, config: ObstacleConfig) -> FloatArray:
    """Range and azimuth (to starboard) of the detection nearest to a track's state (3,)."""
    away = np.hypot(
        (ping.range - state[0]) / config.range_std,
        (ping.bearing - state[1]) / np.radians(config.bearing_std_deg),
    )
    nearest = int(np.nanargmin(away))
    return np.array([ping.range[nearest], -ping.bearing[nearest]])
