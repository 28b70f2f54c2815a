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
    python -m benchmarks.diver_field --runs 4 --only 'radar clumps' 'diver, b 3 m off'

*One target* (`max_tracks: 1`), 200 fixes, one a second. RMSE, NEES (2 is due) and the share in the
95 % ellipse are of all fixes after the tenth; `rows`: mean number alive. `warned`: share of the
runs in which the warning of the scene stands at the end; `other`: mean number of other warnings.
`clean` has clean scenes alone, with ten times the runs.

- `clean`, and faults of fixes, of which the tracker is told the kind of target only of a `rov`.
  `bursts`: ten fixes 25 m off, twice; `two 100 m`: two fixes, thrice; `multipath`: 15 to 40 m in
  runs of six, 30 % of the fixes; `reflections`: the same with another vector at each fix;
  `outliers`: 15 % of 30 m on each axis; `singles`: 3 % by 20 to 60 m; `8 m`: thirty fixes, twice;
  `begins`: the first five fixes.
- Covariances that are wrong or not stated, and errors that last: correlated over 5 or 60 s.
- Two sensors a and b that report in turn, each with a covariance of its own; `unnamed`: as one.

*Scans*, 200, one a second, P_D .9. GOSPA is the mean over scans, of order 2, cutoff 8 m (boats
20 m); `missed` and `false` targets are means of a scan.

- `clumps`: three targets on slow legs, and false fixes where something lies: four clumps of .2 to
  1.2 a scan each and two anywhere; `clean` is the same without false fixes. Of radar: boats, 4 m
  on each axis, clumps of 8 m; of divers: .7 m, clumps of 3 m.
- `scans`: fixes of .7 m, two or five false ones in a square of 120 m. `kept`: share of runs in
  which the first target keeps its number. In `new diver`, the first target is missed two or four
  times while another one appears 10 to 30 m away.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
import time
from typing import Any, NamedTuple
import zlib

import numpy as np

from benchmarks.diver_accuracy import INSIDE, integrated, legs, smooth_turns
from benchmarks.study import first_track, mean_of, Parts, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECOND = 10**9
COUNT, FIRST = 200, 10
P_DETECTION = 0.9

# -- one target ----------------------------------------------------------------------------------


class Scene(NamedTuple):
    """Fixes of one target, and what they state."""

    target: str
    std: float
    """Standard deviation of a fix on each axis, m."""
    warning: str = ''
    """Part of the warning that is due."""
    fault: str = ''
    """What is wrong with some fixes, see `FAULTS`."""
    stated: float | None = 1.0
    """Stated variance relative to the true one; None: no covariance is stated."""
    every: float = 1.0
    """Seconds between fixes."""
    lasting: float = 0.0
    """Standard deviation of an error that lasts, m."""
    time: float = 60.0
    """Its correlation time, s."""
    sensors: tuple[str, ...] = ('',)
    """Sensors that report in turn; the faults below are those of the second."""
    off: tuple[float, float] = (0.0, 0.0)
    """Offset, m."""
    late: float = 0.0
    """Delay of the stamps, s."""
    times: float = 1.0
    """Standard deviation relative to what is stated."""


BURST = 'taken for bursts', 'the estimate holds both'
FAULTS = {
    'clean': '',
    **dict.fromkeys(('bursts', 'two 100 m', 'multipath', '8 m', 'begins'), 'taken for'),
    **dict.fromkeys(('reflections', 'outliers', 'singles'), 'taken for outliers'),
}
"""Faults of fixes, and what is due to be said."""

PAIRS: dict[str, dict[str, Any]] = {
    'two sensors': {},
    'b 10 m off': {'off': (6.0, 8.0), 'warning': 'm apart'},
    'b 3 m off': {'off': (1.8, 2.4), 'warning': 'm apart'},
    'b 2 s late': {'late': 2.0, 'warning': 'stamps of sensor b are'},
    'b worse': {'times': 4.0, 'warning': 'of sensor b too small'},
    'b better': {'times': 0.2, 'warning': 'of sensor b are too small or'},
    'unnamed, 10 m': {'off': (6.0, 8.0), 'warning': 'two groups', 'sensors': ('', '')},
    'unnamed, 3 m': {'off': (1.8, 2.4), 'warning': 'two groups', 'sensors': ('', '')},
}
"""What two sensors do."""

WRONG = {
    'diver, R true': Scene('diver', 1.0),
    'diver, 5 s, R true': Scene('diver', 1.0, every=5.0),
    'boat, R true': Scene('boat', 1.0),
    'diver, R / 6': Scene('diver', 1.0, 'too small', stated=1.0 / 6.0),
    'diver, R / 100': Scene('diver', 1.0, 'too small', stated=1e-2),
    'diver, R / 1e4': Scene('diver', 1.0, 'too small', stated=1e-4),
    'boat, R / 1e4': Scene('boat', 1.0, 'too small', stated=1e-4),
    'diver, R / 1e6': Scene('diver', 1.0, 'too small', stated=1e-6),
    'diver, R times 50': Scene('diver', 1.0, 'too large', stated=50.0),
    'diver, 6 m, no covariance': Scene('diver', 6.0, 'no message states', stated=None),
    '1 m of 5 s': Scene('diver', 0.01, 'fix_bias_std', stated=1e4, lasting=1.0, time=5.0),
    '1 m of 60 s': Scene('diver', 0.01, 'fix_bias_std', stated=1e4, lasting=1.0),
    '.3 m, and 3 m of 60 s': Scene('diver', 0.3, 'fix_bias_std', stated=1.0 / 0.09, lasting=3.0),
}
"""Covariances that are wrong, and errors that last."""

SINGLE: dict[str, Scene] = {
    **{
        f'{target}, {fault}': Scene(target, std, due, fault)
        for target, std in (('diver', 1.0), ('rov', 0.3), ('slow boat', 1.0))
        for fault, due in FAULTS.items()
    },
    **WRONG,
    **{
        f'{target}, {name}': Scene(target, std, **{'sensors': ('a', 'b'), **values})
        for target, std in (('diver', 0.3), ('rov', 0.3), ('boat', 1.0))
        for name, values in PAIRS.items()
    },
}


def path(target: str, rng: np.random.Generator, seconds: float) -> FloatArray:
    """Places (k, 2) of a target each .1 s."""
    if 'boat' in target:
        speed, rate = (3.0, 8.0) if target == 'slow boat' else (6.0, 8.0)
        heading = smooth_turns(rng, seconds, rate, 10.0)
        return integrated(np.full(len(heading), speed), heading)
    swum, heading = legs(rng, seconds, *((0.75, 15.0) if target == 'diver' else (0.5, 8.0)), 90.0)
    if target == 'rov':
        swum = np.where(np.sin(0.005 * np.arange(len(swum))) > 0.7, 0.0, swum)
    return integrated(swum, heading)


def turned(rng: np.random.Generator, least: float, most: float) -> FloatArray:
    """A vector (2,) of a length between two."""
    angle, length = rng.uniform(-np.pi, np.pi), rng.uniform(least, most)
    return length * np.array([np.cos(angle), np.sin(angle)])


def runs_of_six(rng: np.random.Generator) -> list[range]:
    """Runs of six fixes that are 30 % of all."""
    found, k = [], 30
    while k < COUNT:
        if rng.uniform() < 0.3 / 6.0 / 0.7:
            found.append(range(k, min(k + 6, COUNT)))
            k += 6
        else:
            k += 1
    return found


def offsets(rng: np.random.Generator, fault: str) -> FloatArray:
    """By how much each fix (COUNT, 2) is off."""
    off = np.zeros((COUNT, 2))
    fixed = {
        'bursts': ((60, 140), 10, 25.0),
        'two 100 m': ((50, 100, 150), 2, 100.0),
        '8 m': ((50, 130), 30, 8.0),
        'begins': ((0,), 5, 25.0),
    }
    if fault in fixed:
        starts, length, distance = fixed[fault]
        for k in starts:
            off[k : k + length] = turned(rng, distance, distance)
    if fault in ('multipath', 'reflections'):
        for run in runs_of_six(rng):
            one = turned(rng, 15.0, 40.0)
            off[run] = [one if fault == 'multipath' else turned(rng, 15.0, 40.0) for _ in run]
    share = {'outliers': 0.15, 'singles': 0.03}.get(fault)
    wild = np.flatnonzero(rng.uniform(size=COUNT - 20) < share) if share else np.empty(0, int)
    for k in (20 + wild).tolist():
        off[k] = 30.0 * rng.normal(size=2) if fault == 'outliers' else turned(rng, 20.0, 60.0)
    return off


def fixes_of(scene: Scene, seed: int) -> tuple[list[Fix], FloatArray]:
    """Fixes of a scene, and the places (COUNT, 2) of the target at their stamps."""
    rng = np.random.default_rng([seed, 47])
    places = path(scene.target, rng, COUNT * scene.every + 6.0)
    fine = 0.1 * np.arange(len(places))
    at = 5.0 + scene.every * np.arange(COUNT)
    kept, bias = np.exp(-scene.every / scene.time), scene.lasting * rng.normal(size=2)
    items, truth = [], np.column_stack([np.interp(at, fine, axis) for axis in places.T])
    off = offsets(rng, scene.fault)
    for k, second in enumerate(at):
        of_b = k % len(scene.sensors) == 1
        bias = kept * bias + scene.lasting * np.sqrt(1.0 - kept**2) * rng.normal(size=2)
        shown = second - scene.late if of_b else second
        z = [np.interp(shown, fine, axis) for axis in places.T]
        z = z + scene.std * (scene.times if of_b else 1.0) * rng.normal(size=2)
        z = z + bias + off[k] + (scene.off if of_b else (0.0, 0.0))
        covariance = None
        if scene.stated is not None:
            covariance = np.diag([scene.std**2 * scene.stated] * 2 + [np.nan])
        items.append(
            Fix(
                stamp_ns=round((100.0 + second) * 1e9),
                position=np.append(z, 0.0),
                covariance=covariance,
                frame_id='map',
                sensor=scene.sensors[k % len(scene.sensors)],
            )
        )
    return items, truth


def followed(scene: Scene, seed: int) -> dict[str, float]:
    """The numbers of a run with one target."""
    items, truth = fixes_of(scene, seed)
    told: dict[str, Any] = {} if scene.target == 'slow boat' else {'target': scene.target}
    tracker = DiverTracker(DiverConfig(max_tracks=1, **told))
    square, nees, rows, start = [], [], 0, time.process_time()
    for k, item in enumerate(items):
        last = tracker.process(item)[-1]
        rows += len(tracker._stream.state.rows)
        if k >= FIRST and (found := first_track(last, truth[k])) is not None:
            square.append(found[0] @ found[0])
            nees.append(found[1])
    spent, said = time.process_time() - start, tracker.warnings()
    words = BURST if scene.warning == 'taken for' else (scene.warning,)
    due = [bool(scene.warning) and any(word in text for word in words) for text in said]
    return {
        'square': float(np.mean(square)),
        'NEES': float(np.mean(nees)),
        'inside': float(np.mean(np.array(nees) <= INSIDE)),
        'followed': len(nees) / (COUNT - FIRST),
        'rows': rows / COUNT,
        'ms': 1e3 * spent / COUNT,
        'warned': float(any(due)),
        'other': float(len(said) - sum(due)),
    }


def one_target(scene: Scene, seeds: Iterable[int]) -> dict[str, Any]:
    """The row of a scene with one target."""
    found: dict[str, Any] = mean_of([followed(scene, seed) for seed in seeds])
    return {'RMSE m': found.pop('square') ** 0.5, **found}


# -- scans ---------------------------------------------------------------------------------------


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
CASES = 'clean', 'reflections', 'burst', 'crossing', 'new diver 2', 'new diver 4'


def courses(rng: np.random.Generator, targets: int, kind: Kind) -> FloatArray:
    """Places (COUNT, targets, 2): legs of a minute, back towards the middle near an edge."""
    place = rng.uniform(-0.6, 0.6, (targets, 2)) * kind.half
    course = rng.uniform(-np.pi, np.pi, targets)
    found = np.empty((COUNT, targets, 2))
    for k in range(COUNT):
        found[k] = place
        turns = rng.uniform(size=targets) < 1.0 / 60.0
        course = np.where(turns, course + rng.uniform(-1.5, 1.5, targets), course)
        out = np.abs(place).max(axis=1) > 0.9 * kind.half
        course = np.where(out, np.arctan2(-place[:, 1], -place[:, 0]), course)
        place = place + kind.speed * np.column_stack([np.cos(course), np.sin(course)])
    return found


def scans_of(
    rng: np.random.Generator,
    shown: FloatArray,
    kind: Kind,
    false: Callable[[], FloatArray],
) -> list[Fixes]:
    """Scans of what is shown (K, T, 2), NaN for a target that is not; false: makes the false fixes
    (n, 2) of a scan."""
    scans = []
    for k, places in enumerate(shown, start=1):
        seen = places[(rng.uniform(size=len(places)) < P_DETECTION) & np.isfinite(places[:, 0])]
        z = np.concatenate([seen + rng.normal(scale=kind.std, size=seen.shape), false()])
        z = rng.permutation(z)
        covariance = np.tile(kind.std**2 * np.eye(2), (len(z), 1, 1))
        position = np.column_stack([z, np.zeros(len(z))])
        scans.append(Fixes(stamp_ns=k * SECOND, position=position, covariance=covariance))
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


def judged(
    scans: list[Fixes], truth: FloatArray, kind: Kind
) -> tuple[dict[str, float], list[tuple[FloatArray, FloatArray]]]:
    """The numbers of scans of targets at truth (K, T, 2), NaN before one is there, and the IDs and
    places of confirmed tracks after each."""
    tracker, distance, missed, false = DiverTracker(DiverConfig(**kind.settings)), [], 0, 0
    begin, shown = time.process_time(), []
    for scan, places in zip(scans, truth):
        estimate = tracker.process(scan)[-1]
        firm = estimate.extras['track_state'] > 0
        shown.append((estimate.extras['track_id'][firm], estimate.state[firm, :2]))
        due = places[np.isfinite(places[:, 0])]
        found = gospa(due, shown[-1][1], kind.cutoff)
        distance.append(found.distance)
        matched = int((found.estimate_of >= 0).sum())
        missed, false = missed + len(due) - matched, false + len(shown[-1][1]) - matched
    cost = 1e3 * (time.process_time() - begin) / len(scans)
    return {
        'GOSPA': float(np.mean(distance)),
        'missed': missed / len(scans),
        'false': false / len(scans),
        'ms a scan': cost,
        'warnings': float(len(tracker.warnings())),
    }, shown


def clumps(seed: int, kind: Kind, clean: bool = False) -> dict[str, float]:
    """GOSPA of targets among clumps of false fixes."""
    rng = np.random.default_rng([47, seed])
    truth = courses(rng, 3, kind)
    none = np.empty((0, 2))
    scans = scans_of(rng, truth, kind, (lambda: none) if clean else clumped(rng, kind))
    return judged(scans, truth, kind)[0]


def swimmers(rng: np.random.Generator, case: str) -> FloatArray:
    """Positions (COUNT, T, 2) of the targets, NaN before one is there."""
    count = {'burst': 3, 'clean': 2, 'crossing': 2}.get(case, 1)
    truth = courses(rng, count, DIVERS)
    if case == 'crossing':
        truth[:, 1] += truth[0, 0] + [3.0, 0.0] - truth[0, 1]
    if case.startswith('new diver'):
        way = 0.5 * np.maximum(np.arange(COUNT) - 80, 0)[:, None] * turned(rng, 1.0, 1.0)
        new = truth[80, 0] + turned(rng, 10.0, 30.0) + way
        new[:80] = np.nan
        truth = np.concatenate([truth, new[:, None]], axis=1)
    return truth


def identity(seed: int, case: str, false: float) -> dict[str, float]:
    """GOSPA, and whether the first target keeps its number."""
    rng = np.random.default_rng([seed, zlib.crc32(f'{case} {false}'.encode())])
    truth = swimmers(rng, case)
    seen = truth.copy()
    if case == 'reflections':
        for run in runs_of_six(rng):
            seen[run, 0] += turned(rng, 15.0, 40.0)
    if case in ('burst', 'crossing'):
        for k in (50, 120):
            seen[k : k + 12, 0] += turned(rng, 25.0, 25.0)
    if case.startswith('new diver'):
        seen[80 : 80 + int(case[-1]), 0] = np.nan
    scans = scans_of(rng, seen, DIVERS, uniform(rng, false, DIVERS.half))
    row, shown = judged(scans, truth, DIVERS)
    near = [
        int(ids[apart.argmin()]) if len(ids) and apart.min() < 4.0 else -1
        for (ids, place), there in zip(shown, truth[:, 0])
        for apart in (np.hypot(*(place - there).T),)
    ]
    first, last = (
        next((each for each in order if each >= 0), -1) for order in (near[29::-1], near[::-1])
    )
    return {**row, 'kept': float(first == last)}


def averaged(run: Callable[..., Mapping[str, float]], *arguments: Any) -> Callable[..., Any]:
    """What makes the row of a scene from its seeds: the mean of its runs."""
    return lambda seeds: mean_of([run(seed, *arguments) for seed in seeds])


MANY = 10


def many_clean(target: str, seeds: range) -> Mapping[str, Any]:
    """The row of a clean scene of `MANY` times the seeds."""
    return one_target(
        SINGLE[f'{target}, clean'], range(seeds.start, seeds.start + MANY * len(seeds))
    )


SCENES: dict[str, dict[str, Callable[[range], Mapping[str, Any]]]] = {
    'clumps': {
        'radar clumps': averaged(clumps, RADAR),
        'divers clumps': averaged(clumps, DIVERS),
        'radar clean': averaged(clumps, RADAR, True),
        'divers clean': averaged(clumps, DIVERS, True),
    },
    'scans': {
        f'{case}, {false:g} false': averaged(identity, case, false)
        for false in (2.0, 5.0)
        for case in CASES
    },
    'single': {name: partial(one_target, scene) for name, scene in SINGLE.items()},
    'clean': {
        f'{target}, {MANY} times the runs': partial(many_clean, target)
        for target in ('diver', 'rov', 'slow boat')
    },
}
NAMES = tuple(name for scenes in SCENES.values() for name in scenes)


def main(runs: int = 20, first: int = 100, only: tuple[str, ...] = NAMES) -> Parts:
    yield {'runs': runs, 'first': first}
    for table, scenes in SCENES.items():
        for name in scenes:
            if name in only:
                yield {table: {name: scenes[name](range(first, first + runs))}}


if __name__ == '__main__':
    study(main, only={'choices': NAMES})
