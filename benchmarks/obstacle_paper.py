# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The estimates of the paper beside the tracker's: afterwards, by RMSD, and on the sea floor.

    python -m benchmarks.obstacle_paper --runs 200 --out docs/results/obstacle_paper.json
    python -m benchmarks.obstacle_paper --cases tether

**RMSD.** From the first echo and an assumed vertical offset d_st follows where the obstacle is,
hence, with the navigation, every later echo. The deferred estimate is the d_st whose echoes come
nearest to the measured ones,

    argmin over d_st of  RMSD = sqrt(mean((dd / step_d)^2 + (ddelta / step_delta)^2)),     eq. (8)

with the pixels of the sonar image as units. (1), which turns an echo and an offset into a point,
and (8) are lost in the copies of the paper that we know; both are reconstructed from what the text
says of them. The paper looks for offsets below the sonar; `both_sides` looks above it too. The
estimate hangs on the error of the first echo; `refit` frees range and azimuth of the first echo
and the scale of the navigation for each d_st, which brings it close to what the tracker does
online.

`methods`: errors when the range first falls to 50, 30 and 20 m, as in
`benchmarks.obstacle_accuracy`: of the paper's filter on the sea floor (`seafloor`), of `deferred`
over all echoes so far, for offsets from 0 to 12 m below as in the paper, and of `refit`, 12 m to
both sides. Half of the runs.

`section5`: what a single deferred estimate is worth. The paper reads 11 m off the echoes of its
detector and 8 m off those picked by eye, on the same pings, and holds noisy detections
responsible. Here the truth is 8 m, a large body seen from 95 to 45 m, or 0.5 m, a sphere seen to
10 m. Every encounter is read in several ways, its vehicle and its navigation being the same: by
eye, by a detector, by a noisy one with outliers, by a detector whose echo wanders over an extended
body by 1 m, and by eye and by the detector while the obstacle sways by 0.5 m. `11 or more` and
`within 1 m` are shares of all encounters. `10.5 if eye` is the share of the encounters with an
estimate of 10.5 m or more among those which the eye reads to within 1 m of 8, and `off eye` the
standard deviation of the difference from what the eye reads, m; of an obstacle that sways, it is
the eye that sees it sway.

`tether`: two moored spheres, the scene of ``bags/obstacle_tethers``, tracked as any recording is.
For the track with most echoes, all offsets at its first echo: what RMSD, RMSD on both sides, the
refitted one and the tracker say, each less the truth, and the length of the tether that follows
from the tracker's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from attrs import evolve
import numpy as np
from scipy.optimize import minimize_scalar

from benchmarks.obstacle_accuracy import (
    config_of,
    LEVER,
    offset_at,
    RANGES,
    summary,
    track,
)
from benchmarks.obstacle_sea import truth_tables
from benchmarks.study import final_estimates, Parts, study, truths
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import DepthSlices, HeightPrior, Mixture, Sonar
from sonar_imm.trackers.obstacle.pings import Mount
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.evaluation.obstacle.scoring import score, tether_length
from sonar_imm_tools.evaluation.obstacle.series import Series, series_of, truth_of
from sonar_imm_tools.recordings.own_files import unusual
from sonar_imm_tools.simulation.obstacle.simulator import (
    ObstacleScenario,
    scenario,
    simulate,
    TrueObstacle,
)

# -- the deferred estimate ------------------------------------------------------------------------

_STEPS = (1e-3, 1e-6, 1e-6)
"""Differences for the slopes: range m, azimuth rad, scale."""


class Deferred(NamedTuple):
    """offset (G,) of the curve and rmsd (G,), NaN where no such obstacle exists; best: the offset
    at its minimum, m below the sonar at the first ping; least: the RMSD there."""

    offset: FloatArray
    rmsd: FloatArray
    best: float
    least: float


def sonar_poses(
    navigation: Sequence[Navigation], stamps_ns: np.ndarray, config: ObstacleConfig
) -> tuple[Pose, np.ndarray]:
    """The sonar's poses in NED and FRD at each of the stamps (N,), and where they are known (N,):
    not outside the navigation or in its gaps."""
    samples = {sample.stamp_ns: sample for sample in navigation}
    stamps = tuple(sorted(samples))
    buffer = NavigationBuffer(stamps, tuple(samples[stamp] for stamp in stamps))
    mount = Mount(config)
    longest = round(config.max_navigation_gap * 1e9)
    known = np.array(
        [buffer.readiness(int(t), int(t), longest, 0) == 'ready' for t in stamps_ns], bool
    )
    position, R = np.full((len(known), 3), np.nan), np.full((len(known), 3, 3), np.nan)
    for k in np.flatnonzero(known):
        position[k], R[k] = mount.sonar(buffer.pose(int(stamps_ns[k])))
    return Pose(position, R), known


def deferred(
    z: FloatArray,
    poses: Pose,
    config: ObstacleConfig,
    *,
    offsets: FloatArray | None = None,
    both_sides: bool = False,
    refit: bool = False,
) -> Deferred:
    """The deferred estimate from one obstacle's echoes.

    z (N, 2): range and azimuth (to starboard), N >= 2; poses: of the sonar, (N,); offsets (G,):
    where to draw the curve, by default every 0.25 m over what a beam can hold, below the sonar or
    on both sides. The minimum is found to a micrometre between them.
    """
    if len(z) < 2:
        raise ValueError('a deferred estimate needs two echoes at least')
    if offsets is None:
        reach = 0.25 * np.ceil(4.0 * z[0, 0] * np.sin(np.radians(0.8 * config.vertical_fov_deg)))
        offsets = np.arange(-reach if both_sides else 0.0, reach + 0.125, 0.25)
    curve = _rmsd(offsets, z, poses, config, refit)
    if not np.isfinite(curve).any():
        return Deferred(offsets, curve, np.nan, np.nan)

    def at(offset: float) -> float:
        value = _rmsd(np.array([offset]), z, poses, config, refit)[0]
        return float(value) if np.isfinite(value) else np.inf

    lowest = int(np.nanargmin(curve))
    between = offsets[max(lowest - 1, 0)], offsets[min(lowest + 1, len(offsets) - 1)]
    found = minimize_scalar(at, bounds=between, method='bounded', options={'xatol': 1e-9})
    return Deferred(offsets, curve, float(found.x), float(found.fun))


def _rmsd(
    offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig, refit: bool
) -> FloatArray:
    """(G,)"""
    first = np.zeros((len(offsets), 3)) + [*z[0], 0.0]
    if refit:
        first = _refit(first, offsets, z, poses, config)
    residual = _residuals(first, offsets, z, poses, config)
    return np.asarray(np.sqrt(np.mean(residual[:, : 2 * len(z)] ** 2, axis=1) * 2.0))


def _residuals(
    first: FloatArray, offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig
) -> FloatArray:
    """(G, 2N + 1) in pixels, of obstacles whose first echo and navigation scale are `first` (G,
    3); the last column is the scale in its standard deviations."""
    start = Pose(poses.position[0], poses.R[0])
    m = geometry.reconstruct(first[:, 0], first[:, 1], offsets, start.R, config.azimuth_model)
    travelled = poses.position - start.position
    scale = np.ones((len(first), 1, 3))
    scale[:, 0, :2] += first[:, 2:]
    seen = geometry.to_body(
        Pose(start.position + travelled * scale, poses.R), geometry.to_world(start, m)[:, None]
    )
    d, delta = geometry.project(seen, config.azimuth_model)
    parts = (d - z[:, 0]) / STEP[0], wrap_angle(delta - z[:, 1]) / STEP[1]
    prior = first[:, 2:] / max(config.scale_std, 1e-9)
    return np.concatenate([*parts, prior], axis=1)


def _refit(
    first: FloatArray, offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig
) -> FloatArray:
    """Gauss-Newton for range and azimuth of the first echo and the scale, offset by offset."""
    for _ in range(6):
        residual = _residuals(first, offsets, z, poses, config)
        slope = np.stack(
            [
                (_residuals(first + step * e, offsets, z, poses, config) - residual) / step
                for step, e in zip(_STEPS, np.eye(3))
            ],
            axis=-1,
        )
        good = np.isfinite(residual).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
        A, r = slope[good], residual[good]
        normal = np.einsum('gni,gnj->gij', A, A)
        right = np.einsum('gni,gn->gi', A, r)
        first = first.copy()
        first[good] -= np.linalg.solve(normal, right[..., None])[..., 0]
        first[~good] = np.nan
    return first


# -- methods: errors on the way ------------------------------------------------------------------


class Seafloor(DepthSlices):
    """The paper's filter: one Gaussian as deep as the sea floor below the vehicle, whatever was
    measured."""

    def __init__(self, config: ObstacleConfig):
        super().__init__(evolve(config, components=1, scale_std=0.0))

    def begin(
        self, z: FloatArray, R: FloatArray, sonar: Sonar, height: HeightPrior | None = None
    ) -> Mixture:
        return self._clamped(super().begin(z, R, sonar, height), sonar)

    def predict_unchanged(
        self, mixture: Mixture, before: Sonar, after: Sonar, dt: float
    ) -> tuple[Mixture, int]:
        return super().predict_unchanged(self._clamped(mixture, before), before, after, dt)

    def _clamped(self, mixture: Mixture, sonar: Sonar) -> Mixture:
        x, P = mixture.x.copy(), mixture.P.copy()
        x[..., 2] = sonar.pose.position[2] + sonar.altitude
        P[..., 2, :] = P[..., :, 2] = 0.0
        P[..., 2, 2] = self.config.altitude_std**2
        return Mixture(x, P, mixture.mu)


class SeafloorTracker(ObstacleTracker):
    """The obstacle tracker with `Seafloor` as its filter; needs an altitude with each ping."""

    def _apply_config(self, config: ObstacleConfig) -> None:
        super()._apply_config(config)
        self.filter = Seafloor(config)


TRIED = {False: np.arange(0.0, 12.1, 0.5), True: np.arange(-12.0, 12.1, 0.5)}
"""Offsets tried by `deferred` and, refitting, by `refit`."""


def received(scene: Scene) -> tuple[list[Detections], list[Navigation]]:
    """The pings with echoes and the navigation of a scene."""
    items = [item.measurement for item in scene.measurements]
    pings = [item for item in items if isinstance(item, Detections) and len(item)]
    return pings, [item for item in items if isinstance(item, Navigation)]


def first_echoes(pings: Sequence[Detections]) -> FloatArray:
    """Range and azimuth (to starboard) (N, 2) of the first echo of each ping."""
    return np.array([[ping.range[0], -ping.bearing[0]] for ping in pings])


def deferred_at(
    scene: Scene, config: ObstacleConfig, at: float, refit: bool
) -> list[float] | None:
    """What `offset_at` gives, of the deferred estimate from the echoes until the range falls to
    `at`, known for certain to be the obstacle's."""
    truth = truths(scene, TrueObstacle)[0]
    pings, navigation = received(scene)
    last = np.flatnonzero(truth.range <= at)[0]
    pings = [ping for ping in pings if ping.stamp_ns <= truth.stamp_ns[last]]
    stamps = np.array([ping.stamp_ns for ping in pings] + [int(truth.stamp_ns[last])])
    poses, _ = sonar_poses(navigation, stamps, config)
    z, seen = first_echoes(pings), Pose(poses.position[:-1], poses.R[:-1])
    best = deferred(z, seen, config, offsets=TRIED[refit], refit=refit).best
    now = best + poses.position[0, 2] - poses.position[-1, 2]
    return [now - truth.vertical_offset[last], np.nan, np.nan]


def method_errors(runs: int) -> dict[str, dict[str, float]]:
    """Every method on approaches: RMSE, bias, NEES, coverage of the 90 % band at each range."""
    setting = scenario('approach', LEVER)
    config = config_of(setting)
    rows: dict[str, list[list[list[float] | None]]] = {'seafloor': [], 'deferred': [], 'refit': []}
    for seed in range(runs):
        scene = simulate(setting, seed)
        truth = truths(scene, TrueObstacle)[0]
        final = track(scene, config, SeafloorTracker)
        rows['seafloor'].append([offset_at(truth, final, at) for at in RANGES])
        for method, refit in (('deferred', False), ('refit', True)):
            rows[method].append([deferred_at(scene, config, at, refit) for at in RANGES])
    return {f'approach, {method}': summary(found) for method, found in rows.items()}


# -- section5: what a single estimate is worth ----------------------------------------------------

EXACT = {
    **LEVER,
    'range_std': 0.0,
    'bearing_std_deg': 0.0,
    'range_step': 0.0,
    'bearing_step_deg': 0.0,
    'altitude': 25.0,
    'first_range': 95.0,
    'vertical_fov_deg': 30.0,
}
"""A body of this size is seen beyond the edge of a beam of 15 degrees."""
BODIES: dict[str, dict[str, float]] = {
    'large': {'vertical_offset': 8.0, 'last_range': 45.0},
    'sphere': {'vertical_offset': 0.5, 'last_range': 10.0},
}
STEP = np.array([0.17, np.radians(0.18)])
OUTLIER = np.array([8.0, np.radians(6.0)])
STILL: dict[str, Any] = {}
WANDERS = {'obstacle_motion': 'swaying', 'obstacle_sway': 1.0, 'obstacle_sway_time': 2.0}
SWAYS = {'obstacle_motion': 'swaying'}
READINGS: dict[str, tuple[float, float, float, dict[str, Any]]] = {
    'by eye': (0.1, 0.1, 0.0, STILL),
    'detector': (0.15, 0.25, 0.0, STILL),
    'noisy detector': (0.4, 0.6, 0.1, STILL),
    'wandering echo': (0.15, 0.25, 0.0, WANDERS),
    'by eye, swaying': (0.1, 0.1, 0.0, SWAYS),
    'detector, swaying': (0.15, 0.25, 0.0, SWAYS),
}
"""Errors of range m and bearing deg, share of outliers, and what the obstacle does."""
OFFSETS = np.arange(0.0, 20.1, 0.25)


def encounter(body: str, does: dict[str, Any], seed: int) -> tuple[ObstacleScenario, Scene]:
    setting = scenario('approach', {**EXACT, **BODIES[body], **does})
    return setting, simulate(setting, seed)


def echoes(setting: ObstacleScenario, scene: Scene) -> tuple[FloatArray, Pose]:
    """Exact range and azimuth (N, 2) of a scene's pings, and the poses the navigation states."""
    pings, navigation = received(scene)
    stamps = np.array([ping.stamp_ns for ping in pings])
    poses, known = sonar_poses(navigation, stamps, config_of(setting))
    return first_echoes(pings)[known], Pose(poses.position[known], poses.R[known])


def read(z: FloatArray, reading: str, seed: int) -> FloatArray:
    """The echoes (N, 2) as they are read: with noise, outliers and the pixels of the image."""
    range_std, bearing_std, outliers, _ = READINGS[reading]
    rng = np.random.default_rng([seed, list(READINGS).index(reading)])
    seen = z + rng.normal(size=z.shape) * [range_std, np.radians(bearing_std)]
    astray = rng.uniform(size=len(z)) < outliers
    astray[0] = False  # a reader begins with an echo of the body
    seen += astray[:, None] * rng.uniform(-1.0, 1.0, z.shape) * OUTLIER
    return np.asarray(np.round(seen / STEP) * STEP)


def estimates(body: str, runs: int) -> dict[str, list[float]]:
    """The deferred estimate of every encounter, by the way it is read."""
    table: dict[str, list[float]] = {name: [] for name in READINGS}
    for seed in range(runs):
        for name, (*_, does) in READINGS.items():
            setting, scene = encounter(body, does, seed)
            z, poses = echoes(setting, scene)
            found = deferred(read(z, name, seed), poses, config_of(setting), offsets=OFFSETS)
            table[name].append(round(found.best, 3))
    return table


def distribution(table: dict[str, list[float]], truth: float) -> dict[str, dict[str, float]]:
    """Median and 90 % interval of each reading; for the large body the shares told above."""
    result = {}
    for name, values in table.items():
        best = np.array(values)
        seen = np.array(table['by eye, swaying' if 'swaying' in name else 'by eye'])
        eye = np.abs(seen - truth) <= 1.0
        low, middle, high = np.percentile(best, [5.0, 50.0, 95.0])
        result[name] = {
            'median': float(middle),
            '5 %': float(low),
            '95 %': float(high),
            '11 or more': float(np.mean(best >= 11.0)),
            'within 1 m': float(np.mean(np.abs(best - truth) <= 1.0)),
            '10.5 if eye': float(np.mean(best[eye] >= 10.5)) if eye.any() else float('nan'),
            'off eye': float(np.std(best - seen)),
        }
    return result


# -- tether: of a whole recording ----------------------------------------------------------------

TETHERS = {'last_range': -17.0}
"""What the recording differs in from its scene."""
CUTOFF, GAP = 5.0, 60.0
"""Metres from which a track is on no obstacle, and seconds over which truth is interpolated."""


def most_echoes(
    series: Series, measurements: Sequence[Any], config: ObstacleConfig
) -> tuple[Series, FloatArray, Pose] | None:
    """The hits of the track with most of them, the detection nearest to each (N, 2), range and
    azimuth to starboard, and the poses of the sonar then; None without a track."""
    track_id = series.longest_track()
    if track_id is None:
        return None
    hits = series.pick((series.track_id == track_id) & np.isfinite(series.nis))
    pings = {item.stamp_ns: item for item in measurements if isinstance(item, Detections)}
    navigation = [item for item in measurements if isinstance(item, Navigation)]
    poses, known = sonar_poses(navigation, hits.stamp_ns, config)
    hits = hits.pick(known)
    z = []
    for stamp_ns, state in zip(hits.stamp_ns.tolist(), hits.state):
        ping = pings[stamp_ns]
        away = np.hypot(
            (ping.range - state[0]) / config.range_std,
            (ping.bearing - state[1]) / np.radians(config.bearing_std_deg),
        )
        nearest = int(np.nanargmin(away))
        z.append([ping.range[nearest], -ping.bearing[nearest]])
    return hits, np.array(z), Pose(poses.position[known], poses.R[known])


def moored(setting: ObstacleScenario, seed: int) -> dict[str, float]:
    """The errors of all estimates of a run, m below the sonar at the first echo, the truth, and
    the length of the tether; empty when no track was on an obstacle."""
    scene = simulate(setting, seed)
    config = evolve(ObstacleConfig(), **unusual(setting.instruments(), ObstacleConfig))
    measurements = [item.measurement for item in scene.measurements]
    series = series_of(final_estimates(ObstacleTracker(config), measurements).values())
    paths = truth_of(
        [table for each in truths(scene, TrueObstacle) for table in truth_tables(each)]
    )
    _, matched = score(series, paths, cutoff=CUTOFF, gap=GAP)
    found = most_echoes(series, measurements, config)
    if found is None or matched is None:
        return {}
    hits, z, poses = found
    own = series.track_id[matched.row] == hits.track_id[0]
    if not own.any():
        return {}
    path = paths[matched.target[np.argmax(own)]]
    true = float(path.at(hits.stamp_ns[:1], GAP)[0, 2])
    sunk = poses.position[-1, 2] - poses.position[0, 2]
    said = {
        'RMSD': deferred(z, poses, config).best,
        'RMSD, both sides': deferred(z, poses, config, both_sides=True).best,
        'refitted': deferred(z, poses, config, both_sides=True, refit=True).best,
        'online': float(hits.state[-1, 2] + sunk),
    }
    errors = {name: value - true for name, value in said.items()}
    return {**errors, 'truth': true, **tether_length(series, measurements, config)}


def spread(rows: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Of the size of each error: median, percentiles and the worst."""
    table = {}
    for name in ('RMSD', 'RMSD, both sides', 'refitted', 'online'):
        size = np.abs([row[name] for row in rows])
        low, middle, upper, share, high = np.percentile(size, [5, 50, 75, 90, 95])
        table[name] = {
            'median': float(middle),
            '5 %': float(low),
            '75 %': float(upper),
            '90 %': float(share),
            '95 %': float(high),
            'worst': float(size.max()),
            'runs': len(rows),
        }
    return table


CASES = ('methods', 'section5', 'tether')


def main(runs: int = 200, seeds: int = 31, cases: Sequence[str] = CASES) -> Parts:
    yield {'runs': runs}
    if 'methods' in cases:
        yield {'approach': method_errors(max(1, runs // 2))}
    if 'section5' in cases:
        for body, changes in BODIES.items():
            found = estimates(body, runs)
            table = distribution(found, changes['vertical_offset'])
            yield {body: {'distribution': table, 'estimates': found}}
    if 'tether' in cases:
        setting = scenario('tethers', TETHERS)
        rows = {f'seed {seed}': moored(setting, seed) for seed in range(1, seeds + 1)}
        rows = {name: row for name, row in rows.items() if row}
        yield {'tether': {'errors': rows, 'size of the errors': spread(list(rows.values()))}}


if __name__ == '__main__':
    study(
        main,
        digits=2,
        runs={'help': 'encounters of section5; methods has half of them'},
        seeds={'help': 'runs of tether'},
        cases={'choices': CASES},
    )
