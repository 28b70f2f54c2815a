# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the whole diver tracker, with gating and track logic.

    export SONAR_IMM_DATA=../shared/data
    python -m benchmarks.diver_accuracy --out docs/results/diver_accuracy.json

`scenes` are those of the simulator; other programs on them are in `diver_paper`. RMSE is over all
stamps from the first fix on.

`identity`: whose track is whose, by two ways to pair fixes and divers on the same scans; nothing
is configured. `buddies`: two divers swim legs the same way, 2 m apart, at .75 m/s for 120 s. A
sonar sees them without names: a scan per second, .5 m on each axis, P_D .9, two false fixes in a
square of 120 m. The transponder of the first is heard from the 20th second on, every four seconds,
good to 2 m. `crossing`: two pairs that cross within a metre, a scan per second, .7 m on each axis,
P_D .7, ten false fixes in a square of 160 m. `harbour`: eight boats on legs of 10 to 30 s at
3 m/s, 2 m on each axis, a scan each 2 s, P_D .9, 20 false fixes in a square of 400 m. Counted are
confirmed tracks: GOSPA (10 m, 2; of boats 20 m), `with switches` half of the cutoff for each
identity switch; switches and false tracks for each hour.

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

from benchmarks.recordings import autoferry
from benchmarks.study import DATA, final_estimates, first_track, Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of, Truth
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


def whole_tracker(runs: int) -> dict[str, dict[str, float]]:
    """Gating, track logic and all: RMSE of the confirmed track, scans without one, identities."""
    table = {}
    for name in ('table1', 'irregular', 'multistatic', 'multistatic_fixes'):
        squared, absent, names, total = [], 0, [], 0
        for seed in range(runs):
            scene = simulate(scenario(name), seed)
            measurements = [item.measurement for item in scene.measurements]
            tracker = DiverTracker(DiverConfig(max_tracks=1))
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


# -- identities ------------------------------------------------------------------------------

SCENES = ('buddies', 'crossing', 'harbour')
CUTOFF = 10.0
HALF, FALSE, SCAN_STD, NAMED_STD, P_DETECTION = 60.0, 2.0, 0.5, 2.0, 0.9
NAMED_FROM, EVERY = 20, 4


def true_paths(scene: Scene) -> Truth:
    tables = [table for true in scene.truth for table in true.tables('map')]
    rows = [
        Estimate.from_columns(table.columns, stamp_ns=table.stamp_ns, frame_id='map')
        for table in tables
    ]
    return Truth.from_series(series_of(rows))


def buddies(seed: int) -> tuple[TrueTrack, TrueTrack]:
    """The paths of two divers who swim the same way 2 m apart."""
    values: dict[str, Any] = {
        'duration': 120.0,
        'speed': 0.75,
        'start': [-20.0, 0.0],
        'turn_deg': 60.0,
    }
    first = truths(simulate(scenario('table1', values), seed), TrueTrack)[0]
    aside = first.position + [0.0, 2.0, *([0.0] * (first.position.shape[1] - 2))]
    return first, TrueTrack(2, first.stamp_ns, aside, first.velocity)


def measured(truth: tuple[TrueTrack, ...], seed: int) -> list[Fix | Fixes]:
    """Scans without names, and fixes of the first diver with its name, in order."""
    rng = np.random.default_rng([seed, 7])
    measurements: list[Fix | Fixes] = []
    for k, stamp in enumerate(truth[0].stamp_ns.tolist()):
        there = np.array([path.position[k, :2] for path in truth])
        there = there[rng.uniform(size=len(there)) < P_DETECTION]
        seen = there + rng.normal(scale=SCAN_STD, size=there.shape)
        false = rng.uniform(-HALF, HALF, (rng.poisson(FALSE), 2))
        both = np.concatenate([seen, false])
        measurements.append(
            Fixes(
                stamp_ns=stamp,
                position=np.column_stack([both, np.zeros(len(both))]),
                covariance=np.tile(np.eye(2) * SCAN_STD**2, (len(both), 1, 1)),
                frame_id='map',
            )
        )
        if k < NAMED_FROM or (k - NAMED_FROM) % EVERY:
            continue
        place = truth[0].position[k, :2] + rng.normal(scale=NAMED_STD, size=2)
        measurements.append(
            Fix(
                stamp_ns=stamp + 300_000_000,
                position=[*place, 0.0],
                covariance=np.eye(2) * NAMED_STD**2,
                target_id=truth[0].track_id,
                frame_id='map',
            )
        )
    return measurements


def identity_scene(name: str, seed: int) -> tuple[list[Any], Scene, float]:
    """The measurements, the truth, and the cutoff of GOSPA in m."""
    if name == 'buddies':
        truth = buddies(seed)
        return list(measured(truth, seed)), Scene((), truth), CUTOFF
    if name == 'crossing':
        scene = simulate(
            scenario('crossing', {'detection_probability': 0.7, 'clutter': 10.0}), seed
        )
        return [item.measurement for item in scene.measurements], scene, CUTOFF
    values = {
        'motion': 'legs',
        'sensor': 'scans',
        'start': [0.0, 0.0],
        'detection_probability': 0.9,
        'divers': 8,
        'speed': 3.0,
        'turn_deg': 180.0,
        'leg_min': 10.0,
        'leg_max': 30.0,
        'duration': 300.0,
        'step': 2.0,
        'spacing': 30.0,
        'fix_std': 2.0,
        'clutter': 20.0,
        'clutter_range': 200.0,
    }
    scene = simulate(scenario('table1', values), seed)
    return [item.measurement for item in scene.measurements], scene, 20.0


def identities(name: str, runs: int, **settings: Any) -> dict[str, float]:
    """The scores of a way to pair, over all runs of a scene."""
    scored: list[dict[str, Any]] = []
    for seed in range(runs):
        items, scene, cutoff = identity_scene(name, seed)
        tracker = DiverTracker(DiverConfig(**settings))
        series = series_of([tracker.process(item)[-1] for item in items])
        scored.append(score(series, true_paths(scene), cutoff=cutoff))
    tracks = [each['tracks'] for each in scored]
    hours = sum(each['span_s'] for each in scored) / 3600.0
    return {
        'switches/h': sum(each['identity_switches'] for each in tracks) / hours,
        'GOSPA, rms': rms([each['gospa']['rms_m'] for each in scored]),
        'with switches': float(np.mean([each['gospa']['with_switches_m'] for each in scored])),
        'completeness': float(np.mean([each['completeness'] for each in tracks])),
        'RMSE': rms([each['position']['rmse_m'] for each in scored]),
        'NEES': float(np.mean([each['consistency']['nees_position']['mean'] for each in scored])),
        'false tracks/h': sum(each['false_tracks'] for each in tracks) / hours,
    }


PARTS = ('scenes', 'paths', 'identity')


def main(runs: int = 60, seeds: int = 2, scans: int = 10, parts: Sequence[str] = PARTS) -> Parts:
    """runs: of each scene; seeds: of each path; scans: runs of scenes of several targets."""
    if 'scenes' in parts:
        yield {'runs': runs}
        yield {'the whole tracker, by default': whole_tracker(runs)}
    if 'paths' in parts:
        rows = []
        for name, path in paths(seeds).items():
            rows.append(scores(path))
            yield {'paths': {name: rows[-1]}}
        yield {'summary': summary(rows)}
    for name in SCENES if 'identity' in parts else ():
        for association in ('gnn', 'jipda'):
            count = min(scans, 3) if name == 'harbour' else scans
            row = identities(name, count, association=association)
            yield {'identity': {f'{name}, {association}': {'runs': count, **row}}}


if __name__ == '__main__':
    study(main, parts={'choices': PARTS})
