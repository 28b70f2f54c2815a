# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker, told nothing, against the Kalman filter that one writes in an afternoon.

    python -m benchmarks.diver_plain --out docs/results/diver_plain.json

Ships, boats, AUVs, ROVs, fish and divers, none drawn from a law of the tracker, with covariances
that are true, too small, too large, with heavy tails, with errors that last, with outliers. The
Kalman filter has a constant velocity, no gate, and acceleration noise of .1, .25 or .6 m/s^2
in a second (`cv_1`, `cv_25`, `cv_6`); it is told what the tracker is told. `ratio` is the RMSE of
the tracker over that of the best of the three, which only hindsight knows. NEES: 2 is due.
"""

from __future__ import annotations

from collections.abc import Callable

from attrs import evolve, frozen
import numpy as np

from benchmarks.diver_families import FIRST, followed, integrated, legs, Path, smooth_turns
from benchmarks.real_boats import predicted, updated
from benchmarks.study import mean_of, Parts, rms, study
from sonar_imm.trackers.diver.tracker import DiverConfig

STEP = 0.1
NOISES = {'cv_1': 0.1, 'cv_25': 0.25, 'cv_6': 0.6}
Course = Callable[[np.random.Generator, int], np.ndarray]


def turning(speed: float, rate: float, dwell: float) -> Course:
    """At a speed, m/s, with turns of `rate` degrees a second for some `dwell` seconds."""
    return lambda rng, k: integrated(np.full(k, speed), smooth_turns(rng, k * STEP, rate, dwell))


def swimming(rng: np.random.Generator, k: int) -> np.ndarray:
    return integrated(*legs(rng, k * STEP, 0.75, 20.0, 70.0))


def wandering(speed: float, seconds: float) -> Course:
    """With a velocity that is forgotten within so many seconds."""

    def course(rng: np.random.Generator, k: int) -> np.ndarray:
        kept, velocity = np.exp(-STEP / seconds), np.zeros((k, 2))
        for row in range(1, k):
            push = speed * np.sqrt(1.0 - kept**2) * rng.normal(size=2)
            velocity[row] = kept * velocity[row - 1] + push
        return np.cumsum(STEP * velocity, axis=0)

    return course


def lawnmower(rng: np.random.Generator, k: int) -> np.ndarray:
    """Lines of a minute at 1.5 m/s, and turns of 8 s to alternate sides."""
    line, within = np.divmod(np.arange(k) * STEP, 68.0)
    side = np.where(line % 2 == 0, 1.0, -1.0)
    turn = np.pi * np.clip(within - 60.0, 0.0, None) / 8.0
    heading = rng.uniform(-3.0, 3.0) + np.where(side > 0, turn, np.pi - turn)
    return integrated(np.full(k, 1.5), heading)


def stopping(rng: np.random.Generator, k: int) -> np.ndarray:
    """Half a minute at 4 m/s, half a minute still."""
    speed = np.where(np.arange(k) * STEP // 30.0 % 2 == 0, 4.0, 0.0)
    return integrated(speed, smooth_turns(rng, k * STEP, 3.0, 20.0))


def still(rng: np.random.Generator, k: int) -> np.ndarray:
    return np.zeros((k, 2))


def straight(rng: np.random.Generator, k: int) -> np.ndarray:
    return integrated(np.full(k, 3.0), np.full(k, rng.uniform(-3.0, 3.0)))


def normal(rng: np.random.Generator, k: int) -> np.ndarray:
    return rng.normal(size=(k, 2))


def heavy(rng: np.random.Generator, k: int) -> np.ndarray:
    return rng.standard_t(3, size=(k, 2)) / np.sqrt(3.0)


def lasting(rng: np.random.Generator, k: int) -> np.ndarray:
    """Errors of which nine tenths are those of the fix before."""
    error = normal(rng, k)
    for row in range(1, k):
        error[row] = 0.9 * error[row - 1] + np.sqrt(1.0 - 0.81) * error[row]
    return error


def wild(rng: np.random.Generator, k: int) -> np.ndarray:
    """One in a hundred misses by 500 standard deviations on each axis."""
    error = normal(rng, k)
    bad = rng.random(k) < 0.01
    bad[:5] = False
    error[bad] *= 500.0
    return error


@frozen
class Scene:
    """A course, the standard deviation of fixes on each axis, m, seconds between them, by what
    their covariances are multiplied when they are stated, how many fixes, their errors in
    standard deviations, and seconds of each two minutes without any."""

    course: Course
    std: float = 1.0
    every: float = 1.0
    stated: float = 1.0
    fixes: int = 600
    error: Callable[[np.random.Generator, int], np.ndarray] = normal
    silent: float = 0.0


SLOW = Scene(turning(1.0, 1.0, 60.0), std=2.5, every=30.0, fixes=120)
SCENES = {
    'ship, 5 m/s': Scene(turning(5.0, 2.0, 30.0), std=5.0),
    'ship, 10 m/s, 20 s': Scene(turning(10.0, 0.5, 200.0), std=30.0, every=20.0, fixes=300),
    'AUV in lines, 2 s': Scene(lawnmower, every=2.0, fixes=300),
    'AUV in lines, R / 6': Scene(lawnmower, every=2.0, fixes=300, stated=1 / 6),
    'AUV in lines, 6 R': Scene(lawnmower, every=2.0, fixes=300, stated=6.0),
    'ROV, .3 m/s': Scene(wandering(0.3, 5.0), std=0.3),
    'ROV, 1 m/s': Scene(wandering(1.0, 10.0), std=0.3),
    'fish, .2 m/s': Scene(wandering(0.2, 2.0), std=0.05),
    'diver, heavy tails': Scene(swimming, error=heavy),
    'diver, errors that last': Scene(swimming, error=lasting),
    'diver, R / 25': Scene(swimming, stated=1 / 25),
    'diver, 6 R': Scene(swimming, stated=6.0),
    'diver, 12 R': Scene(swimming, stated=12.0),
    'diver, outliers': Scene(swimming, error=wild),
    'diver, silent 40 of 120 s': Scene(swimming, silent=40.0),
    'boat, 30 s': SLOW,
    'boat, 30 s, 6 R': evolve(SLOW, stated=6.0),
    'boat, 30 s, R / 6': evolve(SLOW, stated=1 / 6),
    'boat, stops and goes': Scene(stopping),
    'straight, 3 m/s': Scene(straight, std=10.0),
    'still, 10 s': Scene(still, std=10.0, every=10.0, fixes=300),
}


def made(scene: Scene, rng: np.random.Generator) -> Path:
    """Its fixes; what they state is theirs divided by `too_small`."""
    step = round(scene.every / STEP)
    t = scene.every * np.arange(scene.fixes)
    truth = scene.course(rng, scene.fixes * step)[::step]
    z = truth + scene.std * scene.error(rng, scene.fixes)
    R = np.tile(np.eye(2) * scene.std**2, (scene.fixes, 1, 1))
    heard = t % 120.0 >= scene.silent
    return Path(t[heard], truth[heard], z[heard], R[heard], 1.0 / scene.stated)


def plain(path: Path, noise: float) -> np.ndarray:
    """Errors (k, 2) of a Kalman filter with a constant velocity and without a gate."""
    x, P = np.zeros(4), np.diag([0.0, 0.0, 4.0, 4.0])
    x[:2], P[:2, :2] = path.z[0], path.R[0] / path.too_small
    error = np.empty_like(path.z)
    for k, dt in enumerate(np.diff(path.t, prepend=path.t[0])):
        if k:
            x, P = updated(*predicted(x, P, dt, noise), path.z[k], path.R[k] / path.too_small)
        error[k] = x[:2] - path.truth[k]
    return error


def scores(path: Path) -> dict[str, float]:
    off = {name: plain(path, noise) for name, noise in NOISES.items()}
    others = {'raw': path.z - path.truth, **off}
    found = {name: rms(np.hypot(*each[FIRST:].T)) for name, each in others.items()}
    error, squared, _ = followed(path, DiverConfig(), 1.0 / path.too_small)
    good = np.isfinite(squared)
    good[:FIRST] = False
    found['default'] = rms(np.hypot(*error[good].T))
    best = min(rms(np.hypot(*each[good].T)) for each in off.values())
    return {
        **found,
        'ratio': found['default'] / best,
        'nees': float(squared[good].mean()),
        'seen': float(good[FIRST:].mean()),
    }


def main(runs: int = 2, scenes: tuple[str, ...] = tuple(SCENES)) -> Parts:
    yield {'runs': runs}
    ratio = []
    for name in scenes:
        number = list(SCENES).index(name)
        found = [
            scores(made(SCENES[name], np.random.default_rng([seed, number])))
            for seed in range(runs)
        ]
        mean = mean_of(found)
        ratio.append(mean['ratio'])
        yield {'scenes': {name: mean}}
    yield {'summary': {'mean_ratio': float(np.mean(ratio)), 'worst_ratio': max(ratio)}}


if __name__ == '__main__':
    study(main, scenes={'choices': list(SCENES)})
