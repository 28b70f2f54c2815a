# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the whole diver tracker, with gating and track logic.

    python -m benchmarks.diver_accuracy --runs 60 --out docs/results/diver_accuracy.json
    export SONAR_IMM_DATA=../shared/data
    python -m benchmarks.diver_accuracy --parts paths --add --out FILE

`scenes` are those of the simulator; other programs on them are in `diver_paper`. RMSE is over all
stamps from the first fix on.

`paths`: 33 paths against every single family of motion, told the truth: boats, scooters, swimmers
in legs, circles and zigzags, divers who stand, loiter or drift; three paths were recorded (an
AUV's dead reckoning, two boats), their fixes are simulated. Some fixes state a sixth of their
variance. The best in hindsight is the least RMSE of the raw fixes, two heading sets and five
constant velocities, each alone, told the true covariance and without a gate. `ratio` is the RMSE
of `model_set: families`, told what the fixes state, over that. NEES is of the position, 2 is due;
fixes before the tenth do not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.recordings import autoferry, DATA
from benchmarks.study import final_estimates, first_track, Parts, rms, study, truths
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

SINGLES: dict[str, dict[str, Any]] = {
    'heading .005': {'model_set': 'heading_speed'},
    'heading .07': {'model_set': 'heading_speed', 'speed_noise': 0.07},
    **{
        f'CV {noise:g}': {'model_set': 'bench_cv', 'acceleration_noise': (noise,)}
        for noise in (0.03, 0.1, 0.25, 0.6, 1.5)
    },
}
ALONE: dict[str, Any] = {
    'association': 'gnn',
    'max_tracks': 1,
    'confirm_hits': 1,
    'delete_misses': 10000,
    'max_coast': 600.0,
}
FIRST = 10
"""Fixes at the beginning that are not scored."""

INSIDE = -2.0 * np.log(0.05)
"""Squared distance within which 95 % of two normal coordinates lie."""


class Path(NamedTuple):
    """Fixes z (k, 2) at t (k,) of a diver at truth (k, 2), with covariances R (k, 2, 2), stated
    too small by a factor."""

    t: np.ndarray
    truth: np.ndarray
    z: np.ndarray
    R: np.ndarray
    too_small: float = 1.0


def integrated(speed: np.ndarray, heading: np.ndarray, step: float = 0.1) -> np.ndarray:
    """Positions (k, 2) of a diver with a speed (k,) and heading (k,) at each step."""
    velocity = np.column_stack([speed * np.cos(heading), speed * np.sin(heading)])
    return np.cumsum(velocity * step, axis=0)


def legs(
    rng: np.random.Generator, seconds: float, speed: float, dwell: float, turn: float
) -> tuple[np.ndarray, np.ndarray]:
    """Speed and heading each .1 s: legs of about `dwell` seconds, turns of about `turn` degrees
    at 30 degrees a second."""
    k = int(seconds * 10)
    due = np.empty(k)
    heading, left = rng.uniform(-np.pi, np.pi), 0
    for row in range(k):
        if left <= 0:
            heading += np.deg2rad(turn) * rng.normal()
            left = int(10 * rng.exponential(dwell)) + 10
        due[row], left = heading, left - 1
    made = due.copy()
    for row in range(1, k):
        made[row] = made[row - 1] + np.clip(due[row] - made[row - 1], -0.0524, 0.0524)
    return np.full(k, speed), made


def smooth_turns(
    rng: np.random.Generator, seconds: float, rate: float, dwell: float
) -> np.ndarray:
    """Heading (k,) each .1 s of a vessel whose rate of turn, of `rate` degrees a second, is drawn
    anew now and then."""
    k = int(seconds * 10)
    rates, left, now = np.empty(k), 0, 0.0
    for row in range(k):
        if left <= 0:
            now = np.deg2rad(rate) * rng.choice([-1.0, 0.0, 1.0])
            left = int(10 * rng.exponential(dwell)) + 20
        rates[row], left = now, left - 1
    return rng.uniform(-np.pi, np.pi) + np.cumsum(rates) * 0.1


def course(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Positions (k, 2) each .1 s."""
    seconds = 300.0
    k = int(10 * seconds)
    t = 0.1 * np.arange(k)
    if kind == 'boat':
        return integrated(np.full(k, 3.0), smooth_turns(rng, seconds, 8.0, 15.0))
    if kind == 'scooter':
        return integrated(np.full(k, 2.0), smooth_turns(rng, seconds, 10.0, 10.0))
    if kind == 'changes':
        speed, heading = legs(rng, seconds, 0.6, 20.0, 70.0)
        heading[:1000] = smooth_turns(rng, 100.0, 10.0, 10.0)
        speed[:1000], speed[1000:1600] = 2.0, 0.0
        return integrated(speed, heading)
    if kind == 'circle':
        return integrated(np.full(k, 0.6), 0.6 / 15.0 * t)
    if kind == 'wander':
        return integrated(np.full(k, 0.7), np.cumsum(0.05 * rng.normal(size=k)))
    if kind == 'zigzag':
        aside = np.where(t // 15.0 % 2 == 0.0, 0.6, -0.6)
        return integrated(np.full(k, 0.8), rng.uniform(-3.0, 3.0) + aside)
    if kind == 'pace':
        slow = np.exp(-0.1 / 60.0)
        speed = np.empty(k)
        speed[0] = 0.7
        for row in range(1, k):
            push = 0.25 * np.sqrt(1.0 - slow**2) * rng.normal()
            speed[row] = 0.7 + slow * (speed[row - 1] - 0.7) + push
        return integrated(np.abs(speed), legs(rng, seconds, 1.0, 20.0, 60.0)[1])
    if kind == 'straight':
        return integrated(np.full(k, 0.75), np.full(k, rng.uniform(-np.pi, np.pi)))
    speeds = {'still': 0.0, 'loiter': 0.15, 'drift': 0.08, 'legs': 0.75}
    return integrated(*legs(rng, seconds, speeds[kind], 20.0, 5.0 if kind == 'drift' else 70.0))


KINDS: dict[str, tuple[str, float, float, float]] = {
    'boat turning, .3 m, 2 s': ('boat', 0.3, 2.0, 1.0),
    'scooter 2 m/s, .2 m': ('scooter', 0.2, 1.0, 1.0),
    'scooter 2 m/s, .2 m, R / 6': ('scooter', 0.2, 1.0, 6.0),
    'scooter, still, legs, .3 m': ('changes', 0.3, 1.0, 1.0),
    'legs, 1 m': ('legs', 1.0, 1.0, 1.0),
    'legs, 1 m, R / 6': ('legs', 1.0, 1.0, 6.0),
    'still, 1 m': ('still', 1.0, 1.0, 1.0),
    'still, 1 m, R / 6': ('still', 1.0, 1.0, 6.0),
    'loiter .15 m/s, 1.5 m': ('loiter', 1.5, 1.0, 1.0),
    'straight, polar': ('straight', 0.0, 1.0, 1.0),
    'gaps 10 s, 1 m': ('legs', 1.0, 10.0, 1.0),
    'circle, .5 m': ('circle', 0.5, 1.0, 1.0),
    'wandering heading, .5 m': ('wander', 0.5, 1.0, 1.0),
    'zigzag, .5 m': ('zigzag', 0.5, 1.0, 1.0),
    'pace kept a minute, .5 m': ('pace', 0.5, 1.0, 1.0),
}
"""Course, standard deviation of a fix on each axis (0: polar), seconds between fixes, by how many
times the stated variance is too small."""


def made(kind: str, seed: int) -> Path:
    """One path of a kind."""
    name, std, every, too_small = KINDS[kind]
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    rows = np.arange(0, 3000 if std else 1000, round(10 * every))
    truth = course(name, rng)[rows]
    if std:
        R = np.tile(np.eye(2) * std**2, (len(rows), 1, 1))
    else:
        truth = truth + [-40.0, 40.0]
        angle, distance = np.arctan2(truth[:, 1], truth[:, 0]), np.hypot(*truth.T)
        along = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        wide = (np.deg2rad(2.0) * distance)[:, None, None] ** 2
        R = 0.01 * along[:, :, None] * along[:, None] + wide * across[:, :, None] * across[:, None]
    noise = np.einsum('kab,kb->ka', np.linalg.cholesky(R), rng.normal(size=truth.shape))
    return Path(0.1 * rows, truth, truth + noise, R, too_small)


def recorded(seed: int = 0) -> dict[str, Path]:
    """Paths that were sailed, with simulated fixes: an AUV's dead reckoning and two boats."""
    found: dict[str, Path] = {}
    if not DATA.is_dir():
        return found
    rng = np.random.default_rng([seed, 99])
    dvl = np.genfromtxt(DATA / 'stpere_nav/dvl.csv', delimiter=',', names=True)
    turned = np.genfromtxt(DATA / 'stpere_nav/attitude.csv', delimiter=',', names=True)
    courses = {'AUV, recorded, .3 m': (*_reckoned(dvl, turned), 0.3)}
    _, truth = autoferry('radar')
    for number in (1, 2):
        own = truth[truth[:, 1] == number]
        courses[f'boat {number}, recorded, 1 m'] = own[:, 0], own[:, 2:], 1.0
    for name, (t, place, std) in courses.items():
        grid = np.arange(t[0], min(t[-1], t[0] + 400.0), 1.0)
        there = np.column_stack([np.interp(grid, t, column) for column in place.T])
        R = np.tile(np.eye(2) * std**2, (len(grid), 1, 1))
        z = there + std * rng.normal(size=there.shape)
        found[name] = Path(grid - grid[0], there, z, R)
    return found


def _reckoned(dvl: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and dead-reckoned place of the AUV, from its own velocity and yaw."""
    good = dvl['bottom_velocity_valid'] == 1
    t = dvl['stamp_s'][good]
    yaw = np.interp(t, turned['stamp_s'], np.unwrap(np.deg2rad(turned['yaw_deg'])))
    forward, right = (0.01 * dvl[f'bottom_velocity_{axis}_cm_s'][good] for axis in 'xy')
    # North east from a yaw clockwise of north; the velocity is smoothed over some 5 s.
    smooth = np.ones(7) / 7.0
    north = np.convolve(forward * np.cos(yaw) - right * np.sin(yaw), smooth, 'same')
    east = np.convolve(forward * np.sin(yaw) + right * np.cos(yaw), smooth, 'same')
    step = np.diff(t, prepend=t[0])
    return t, np.column_stack([np.cumsum(east * step), np.cumsum(north * step)])


def paths(seeds: int) -> dict[str, Path]:
    """All paths by name."""
    found = {f'{kind}, {seed + 1}': made(kind, seed) for kind in KINDS for seed in range(seeds)}
    return {**found, **recorded()}


def fixes_of(path: Path, factor: float) -> list[Fix]:
    """The fixes with their covariances times `factor`."""
    return [
        Fix(
            stamp_ns=round((100.0 + t) * 1e9),
            position=np.array([*z, 0.0]),
            covariance=R * factor,
            frame_id='map',
        )
        for t, z, R in zip(path.t, path.z, path.R)
    ]


def followed(
    path: Path, config: DiverConfig, factor: float = 1.0
) -> tuple[np.ndarray, np.ndarray, DiverTracker]:
    """Errors (k, 2) of the first track after each fix, NaN without one, their NEES (k,), and the
    tracker."""
    tracker = DiverTracker(config)
    final = final_estimates(tracker, fixes_of(path, factor))
    error, squared = np.full((len(path.t), 2), np.nan), np.full(len(path.t), np.nan)
    for row, stamp in enumerate(sorted(final)):
        if (found := first_track(final[stamp], path.truth[row])) is not None:
            error[row], squared[row] = found
    return error, squared, tracker


def scores(path: Path) -> dict[str, Any]:
    """RMSE of all programs on a path."""
    rmse = {'raw': rms(np.hypot(*(path.z - path.truth)[FIRST:].T))}
    for name, values in SINGLES.items():
        config = DiverConfig(**ALONE, gate_probability=0.9999999, **values)
        rmse[name] = rms(np.hypot(*followed(path, config)[0][FIRST:].T))
    best = min(rmse, key=lambda name: rmse[name])
    error, squared, tracker = followed(
        path, DiverConfig(model_set='families', max_tracks=1), 1.0 / path.too_small
    )
    ours = rms(np.hypot(*error[FIRST:].T))
    return {
        'raw': rmse['raw'],
        'cv_25': rmse['CV 0.25'],
        'heading_speed': rmse['heading .005'],
        'best': rmse[best],
        'best_is': best,
        'families': ours,
        'ratio': ours / rmse[best],
        'nees': float(np.mean(squared[FIRST:])),
        'tracks': int(tracker._stream.state.life.next_id - 1),
    }


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of the paths."""
    ratio, due = ([row[name] for row in rows] for name in ('ratio', 'nees'))
    return {
        'paths': len(rows),
        'mean_ratio': float(np.mean(ratio)),
        'worst_ratio': max(ratio),
        'least_nees': min(due),
        'most_nees': max(due),
    }


# -- scenes of the simulator ----------------------------------------------------------------------


def whole_tracker(runs: int, **values: Any) -> dict[str, dict[str, float]]:
    """Gating, track logic and all, defaults but for `values`: RMSE of the confirmed track, scans
    without one, identities."""
    table = {}
    for name in ('table1', 'irregular', 'multistatic', 'multistatic_fixes'):
        squared, absent, names, total = [], 0, [], 0
        for seed in range(runs):
            scene = simulate(scenario(name), seed)
            measurements = [item.measurement for item in scene.measurements]
            tracker = DiverTracker(DiverConfig(max_tracks=1, **values))
            final = final_estimates(tracker, measurements)
            path = truths(scene, TrueTrack)[0]
            at = {int(stamp): k for k, stamp in enumerate(path.stamp_ns)}
            ids = set()
            for stamp, estimate in final.items():
                found = first_track(estimate, path.position[at[stamp], :2])
                total += 1
                absent += found is None
                if found is not None:
                    confirmed = estimate.extras['track_state'] > 0
                    ids.add(int(estimate.extras['track_id'][confirmed][0]))
                    squared.append(found[0] @ found[0])
            names.append(len(ids))
        table[name] = {
            'RMSE': float(np.sqrt(np.mean(squared))),
            'unconfirmed scans': absent / total,
            'identities': float(np.mean(names)),
        }
    return table


def main(runs: int = 60, seeds: int = 2, parts: Sequence[str] = ('scenes',)) -> Parts:
    """runs: of each scene; seeds: of each path."""
    if 'scenes' in parts:
        yield {'runs': runs}
        yield {'the whole tracker': whole_tracker(runs, model_set='heading_speed')}
        yield {'the whole tracker, by default': whole_tracker(runs)}
    if 'paths' in parts:
        rows = []
        for name, path in paths(seeds).items():
            rows.append(scores(path))
            yield {'paths': {name: rows[-1]}}
        yield {'summary': summary(rows)}


if __name__ == '__main__':
    study(main, parts={'choices': ('scenes', 'paths')})
