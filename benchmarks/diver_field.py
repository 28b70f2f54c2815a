# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers in the field: what sensors do wrong, and what a tracker with nothing configured makes of
it.

    python -m benchmarks.diver_field --out docs/results/diver_field.json
    python -m benchmarks.diver_field --runs 4 --only 'radar clumps' 'existence, 1 s, 2 false'

`clumps`: three targets on slow legs, P_D .9, a scan a second, and false fixes where something
lies: four clumps of .2 to 1.2 a scan each and two anywhere; `clean` is the same without false
fixes. Of radar: boats, 4 m on each axis, clumps of 8 m; of divers: .7 m, clumps of 3 m. GOSPA is
the mean over scans of order 2, cutoff 20 m (boats) or 8 m. Missed and false targets are means of
a scan.

`existence`: four divers, .7 m, P_D .9, and 2 or 10 false fixes a scan in a square of 160 m, all
there from the start. Of tracks that are published with an existence near .6, .82 and .95: the
share of which a diver is near, within 3 m and what he swims from scan to scan. Brier: the mean
square of existence less what is true, over all published rows. `delay s`: until half of the divers
have a confirmed track near them.

Fixes that are off by a vector, and outliers: `diver_bursts`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
import time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.diver_bursts import CASES, FAULTS, scans, single, TARGETS
from benchmarks.study import mean_of, Parts, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

Scene = Callable[[range], Mapping[str, Any]]
"""What makes the row of a scene from its seeds."""

SECOND = 10**9
P_DETECTION = 0.9
NEAR = 3.0
"""Metres from a diver within which a track is his, and what he swims between scans."""
SAID = {'.6': (0.5, 0.7), '.82': (0.7, 0.9), '.95': (0.9, 0.98)}
"""Bins of the stated existence."""


class Field(NamedTuple):
    """Scans of a scene, and the places (K, T, 2) of the targets at them."""

    scans: list[Fixes]
    truth: FloatArray


class Kind(NamedTuple):
    """Targets and the sensor that sees them."""

    settings: dict[str, Any]
    """Parameters of the tracker."""
    std: float
    """Standard deviation of a fix on each axis, m."""
    speed: float
    """Of the targets, m/s."""
    half: float
    """Half the side of the square with everything in it, m."""
    clump: float
    """Standard deviation of a clump, m."""
    cutoff: float
    """Of GOSPA, m."""


RADAR = Kind({'target': 'boat'}, 4.0, 4.0, 400.0, 8.0, 20.0)
DIVERS = Kind({}, 0.7, 0.75, 60.0, 3.0, 8.0)


def legs(rng: np.random.Generator, count: int, targets: int, dt: float, kind: Kind) -> FloatArray:
    """Places (count, targets, 2): legs of a minute, back towards the middle near an edge."""
    place = rng.uniform(-0.6, 0.6, (targets, 2)) * kind.half
    course = rng.uniform(-np.pi, np.pi, targets)
    found = np.empty((count, targets, 2))
    for k in range(count):
        found[k] = place
        turns = rng.uniform(size=targets) < dt / 60.0
        course = np.where(turns, course + rng.uniform(-1.5, 1.5, targets), course)
        out = np.abs(place).max(axis=1) > 0.9 * kind.half
        course = np.where(out, np.arctan2(-place[:, 1], -place[:, 0]), course)
        place = place + kind.speed * dt * np.column_stack([np.cos(course), np.sin(course)])
    return found


def scans_of(
    rng: np.random.Generator,
    truth: FloatArray,
    dt: float,
    kind: Kind,
    false: Callable[[], FloatArray],
) -> list[Fixes]:
    """Scans of the targets; false: makes the false fixes (n, 2) of a scan."""
    scans = []
    for k, places in enumerate(truth, start=1):
        seen = places[rng.uniform(size=len(places)) < P_DETECTION]
        z = np.concatenate([seen + rng.normal(scale=kind.std, size=seen.shape), false()])
        z = rng.permutation(z)
        covariance = np.tile(kind.std**2 * np.eye(2), (len(z), 1, 1))
        position = np.column_stack([z, np.zeros(len(z))])
        scans.append(
            Fixes(stamp_ns=round(k * dt * SECOND), position=position, covariance=covariance)
        )
    return scans


def uniform(rng: np.random.Generator, mean: float, half: float) -> Callable[[], FloatArray]:
    """False fixes anywhere in a square."""
    return lambda: rng.uniform(-half, half, (rng.poisson(mean), 2))


def clumped(rng: np.random.Generator, kind: Kind) -> Callable[[], FloatArray]:
    """False fixes in four clumps that stay, and two anywhere."""
    centre = rng.uniform(-0.8, 0.8, (4, 2)) * kind.half
    rate, anywhere = rng.uniform(0.2, 1.2, 4), uniform(rng, 2.0, kind.half)

    def false() -> FloatArray:
        middle = np.repeat(centre, rng.poisson(rate), axis=0)
        near = middle + rng.normal(scale=kind.clump, size=middle.shape)
        return np.concatenate([near, anywhere()])

    return false


def clumps(seed: int, kind: Kind, clean: bool = False, seconds: int = 200) -> dict[str, float]:
    """GOSPA of targets among clumps of false fixes."""
    rng = np.random.default_rng([47, seed])
    truth = legs(rng, seconds, 3, 1.0, kind)
    none = np.empty((0, 2))
    scans = scans_of(rng, truth, 1.0, kind, (lambda: none) if clean else clumped(rng, kind))
    tracker, distance, missed, false = DiverTracker(DiverConfig(**kind.settings)), [], 0, 0
    begin = time.process_time()
    for scan, places in zip(scans, truth):
        (estimate,) = tracker.process(scan)
        shown = estimate.state[estimate.extras['track_state'] > 0, :2]
        found = gospa(places, shown, kind.cutoff)
        distance.append(found.distance)
        matched = int((found.estimate_of >= 0).sum())
        missed, false = missed + len(places) - matched, false + len(shown) - matched
    cost = 1e3 * (time.process_time() - begin) / seconds
    return {
        'GOSPA': float(np.mean(distance)),
        'missed': missed / seconds,
        'false': false / seconds,
        'ms a scan': cost,
    }


def existence(seed: int, dt: float, mean: float) -> dict[str, FloatArray]:
    """Sums over published tracks: stated existence, what is true, squares, and delays."""
    rng = np.random.default_rng([48, seed])
    kind = DIVERS._replace(half=80.0)
    count = 60 if dt >= 1.0 else 300
    truth = legs(rng, count, 4, dt, kind)
    scans = scans_of(rng, truth, dt, kind, uniform(rng, mean, kind.half))
    tracker, stated, true = DiverTracker(DiverConfig()), [], []
    since, near = np.full(truth.shape[1], np.nan), NEAR + kind.speed * dt
    for k, (scan, places) in enumerate(zip(scans, truth)):
        (estimate,) = tracker.process(scan)
        apart = np.hypot(*np.moveaxis(estimate.state[:, None, :2] - places, -1, 0))
        stated += estimate.extras['existence'].tolist()
        true += (apart < near).any(axis=1).tolist()
        shown = (apart < near)[estimate.extras['track_state'] > 0].any(axis=0)
        since = np.where(np.isnan(since) & shown, k * dt, since)
    return {'stated': np.array(stated), 'true': np.array(true, float), 'delay': since}


def reliability(dt: float, mean: float, seeds: range) -> dict[str, float | None]:
    """How often what is said to exist does."""
    each = [existence(seed, dt, mean) for seed in seeds]
    stated, true, delay = (
        np.concatenate([found[name] for found in each]) for name in ('stated', 'true', 'delay')
    )
    row: dict[str, float | None] = {}
    for name, (low, high) in SAID.items():
        within = (stated >= low) & (stated < high)
        row[name] = float(true[within].mean()) if within.sum() >= 20 else None
    brier = float(np.square(stated - true).mean())
    return {**row, 'Brier': brier, 'delay s': float(np.nanmedian(delay))}


def averaged(run: Callable[..., Mapping[str, float]], *arguments: Any) -> Scene:
    """What makes the row of a scene: the mean of its runs."""
    return lambda seeds: mean_of([run(seed, *arguments) for seed in seeds])


SCENES: dict[str, Scene] = {
    'radar clumps': averaged(clumps, RADAR),
    'radar clean': averaged(clumps, RADAR, True),
    'divers clumps': averaged(clumps, DIVERS),
    'divers clean': averaged(clumps, DIVERS, True),
    **{
        f'existence, {dt:g} s, {mean:g} false': partial(reliability, dt, mean)
        for dt in (0.1, 1.0, 5.0)
        for mean in (2.0, 10.0)
    },
    **{f'{kind}, {fault}': averaged(single, kind, fault) for kind in TARGETS for fault in FAULTS},
    **{
        f'scans, {case}, {false:g} false': averaged(scans, case, false)
        for case in CASES
        for false in (2.0, 5.0)
    },
}


def main(runs: int = 20, first: int = 100, only: tuple[str, ...] = tuple(SCENES)) -> Parts:
    yield {'runs': runs, 'first': first}
    for name in only:
        yield {'table': {name: SCENES[name](range(first, first + runs))}}


if __name__ == '__main__':
    study(main, only={'choices': list(SCENES)})
