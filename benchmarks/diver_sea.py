# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker at sea: depth, misplaced instruments, errors that last, few receivers.

    python -m benchmarks.diver_sea --out docs/results/diver_sea.json

Every number is that of the whole tracker on simulated scenes, from the first fix through track
logic, one diver known to be there (`max_tracks: 1`). RMSE is horizontal, from 10 s on; NEES is of
the horizontal position (2 is due), for depth also of all three coordinates (3 is due).

`receivers`: raw arrivals; one diver swims legs of 7 to 15 s at .75 m/s for 100 s, a ping a second,
ranges of .5 m. `two receivers` 80 m apart, `third from ping 40`, scored before and after it; one
range a ping: `buoys`, four at the corners of 80 m in turn; `ship on a circle` of 50 m at 5 m/s, of
the diver and of a transponder that stands; `ship on a line`; `one receiver`. `inside` is the share
in the 95 % ellipse; `sure and wrong` the share of runs of which a fifth of the estimates have a
NEES above 50; `begins s` is the median of the first confirmed estimate; `tracked` of the runs have
one. Side A and side B are in the estimate, so its RMSE is half their distance.

`few`: of eight receivers about, so many hear a ping (2 % wild, .3 m of path); `echo` has a
transmitter, `tag` none, in steps of 1 s and of 29 s, in which a diver turns several times. `ratio`
is the RMSE of the default over that of `heading_speed` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.diver_accuracy import INSIDE
from benchmarks.study import final_estimates, first_track, Parts, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Arrivals
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

SETTLED = 10.0
"""Seconds from the start that are not scored."""

Values = Mapping[str, Any]
Cells = list[tuple[str, str, str, Values, Values]]
"""Row, column, scenario, what it changes, parameters."""


def score(scene: Scene, config: DiverConfig) -> np.ndarray:
    """Rows (k, 4) of squared horizontal error, horizontal NEES, squared depth error and whole
    NEES; the last two NaN where depth is no state. A stamp without a track gives NaN."""
    final = final_estimates(DiverTracker(config), (i.measurement for i in scene.measurements))
    return score_of(final, scene)


def score_of(final: Mapping[int, Estimate], scene: Scene) -> np.ndarray:
    """As `score`, of estimates by stamp."""
    track = truths(scene, TrueTrack)[0]
    rows: list[list[Any]] = []
    for k, stamp in enumerate(track.stamp_ns.tolist()):
        if (stamp - track.stamp_ns[0]) * 1e-9 < SETTLED or stamp not in final:
            continue
        estimate = final[stamp]
        if (found := first_track(estimate, track.position[k, :2])) is None:
            rows.append([np.nan] * 4)
            continue
        error, flat = found
        deep = whole = np.nan
        if 'pz' in estimate.state_names:
            found = first_track(estimate, track.position[k, :3])
            assert found is not None
            deep, whole = found[0][2] ** 2, found[1]
        rows.append([error @ error, flat, deep, whole])
    return np.array(rows)


def errors(scene: Values, config: Values, runs: int, name: str) -> dict[str, Any]:
    """RMSE and NEES over `runs` scenes. `scene` and `config` may hold functions of the run."""
    rows: list[np.ndarray] = []
    for seed in range(1000, 1000 + runs):
        made = simulate(scenario(name, scene), seed)
        values = {key: v(made) if callable(v) else v for key, v in config.items()}
        # What is assumed of instruments is judged in the table of what is not stated.
        exact = not any(values.get(name) for name in EVERY)
        values = {'model_set': 'heading_speed', **values}
        values |= {'systematic_errors': 'exact'} if exact else {}
        rows.append(score(made, DiverConfig(max_tracks=1, **values)))
    every = np.concatenate(rows)
    seen = np.isfinite(every[:, 0])
    mean = every[seen].mean(axis=0)
    return {
        'rmse': float(np.sqrt(mean[0])),
        'nees': float(mean[1]),
        'rmse_depth': float(np.sqrt(mean[2])),
        'nees_3d': float(mean[3]),
        'without_track': float(1.0 - seen.mean()),
    }


def middle_depth(scene: Scene) -> float:
    return float(truths(scene, TrueTrack)[0].position[:, 2].mean())


SWELL: Values = {'depth': (1.0, 19.0), 'swell_height': 1.0}
DEPTH: dict[str, tuple[Values, Values]] = {
    'told 0 m': ({}, {}),
    'told its depth without swell': ({}, {'target_z': middle_depth}),
    'pressure, .2 m': ({'depth_std': 0.2}, {'dimensions': 3}),
    'depth bank': ({}, {'dimensions': 3}),
}
OFF: dict[str, Values] = {
    'receivers': {'receiver_position_std': 1.0},
    'clocks': {'receiver_clock_std': 5e-4},
    'sound': {'sound_speed_std': 5.0},
}
EVERY: Values = {key: value for error in OFF.values() for key, value in error.items()}
LASTING: Values = {'fix_bias_std': 1.0, 'fix_bias_time': 60.0, 'fix_std': 0.5}
TABLES: dict[str, Cells] = {
    'depth': [
        (f'{row}, diver {diver}', column, 'multistatic', {'receiver_depths': at, **swims, **more},
         config)
        for row, at in (('2, 5, 8, 12 m', (2.0, 5.0, 8.0, 12.0)), ('5 m', (5.0,) * 4))
        for diver, swims in (('U(1, 19) m, swell', SWELL), ('10 m', {'depth': (10.0, 10.0)}))
        for column, (more, config) in DEPTH.items()
    ],
    'systematic': [
        (row, how, 'multistatic', scene, config)
        for row, scene in {'nothing, told all three': {}, **OFF, 'all': EVERY}.items()
        for how, config in {
            'ignore': {},
            **{
                how: {**(scene or EVERY), 'systematic_errors': how}
                for how in ('consider', 'mixed', 'estimate')
            },
        }.items()
    ],
    'lasting': [
        ('1 m, 60 s, 0.5 m', column, 'lasting_errors', LASTING, config)
        for column, config in {
            'white part alone stated': {},
            'stated total, as white': {'covariance_scale': 5.0},
            'Gauss-Markov, right': {'fix_bias_std': 1.0, 'fix_bias_time': 60.0},
            'tau x 3': {'fix_bias_std': 1.0, 'fix_bias_time': 180.0},
        }.items()
    ],
}  # fmt: skip

FIRST, GOOD_NEES = 60.0, 4.0
"""Seconds within which what is not stated has to warn, and the mean NEES that needs no warning."""
STATED: dict[str, Values] = {
    'multistatic': {},
    'at_depth': {'dimensions': 3},
    'misplaced_receivers': EVERY,
    'lasting_errors': {'fix_bias_std': 1.0},
}


def warned(name: str, config: Values, runs: int) -> dict[str, Any]:
    """Of the first minute of `runs` scenes with default parameters and `config`: how many warn,
    after what time in the median, how many have a mean NEES of `GOOD_NEES` at most, and how many
    either."""
    after, nees = [], []
    for seed in range(runs):
        made = simulate(scenario(name, {'duration': FIRST}), seed)
        tracker, when = DiverTracker(DiverConfig(**config)), np.nan
        first = made.measurements[0].measurement.stamp_ns
        final: dict[int, Any] = {}
        for item in made.measurements:
            estimates = tracker.process(item.measurement)
            final.update((each.stamp_ns, each) for each in estimates)
            if np.isnan(when) and tracker.warnings():
                when = (item.measurement.stamp_ns - first) * 1e-9
        after.append(when)
        nees.append(float(np.nanmean(score_of(final, made)[:, 1])))
    good = np.array(nees) <= GOOD_NEES
    return {
        'runs': runs,
        'warn': int(np.isfinite(after).sum()),
        'after s': float(np.nanmedian(after)) if np.isfinite(after).any() else None,
        'NEES good': int(good.sum()),
        'either': int((good | np.isfinite(after)).sum()),
        'NEES': nees,
    }


# -- raw arrivals of few receivers ---------------------------------------------------------------

STD, SOUND = 0.5, 1500.0
SETTLED_PINGS, WRONG = 10, 50.0
BUOYS = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
POOL = np.array(
    [[0, 0], [70, 10], [-60, 45], [10, 85], [-40, -60], [80, -50], [120, 70], [-90, -10]], float
)
"""Receivers of `few`."""

Places = Callable[[int, np.random.Generator], FloatArray]
"""Where receivers (k, 2) ask at a ping."""


def path(seed: int, motion: str = 'legs', **values: Any) -> TrueTrack:
    """A diver of the simulator."""
    scene = simulate(scenario('multistatic', {'motion': motion, **values}), seed)
    return truths(scene, TrueTrack)[0]


def transponder(stamp_ns: int, at: FloatArray, target: FloatArray, rng: Any) -> Arrivals:
    """Two-way ranges of a target (2,) from places (k, 2)."""
    place = np.column_stack([at, np.zeros(len(at))])
    length = 2.0 * np.hypot(*(at - target).T) + 2.0 * STD * rng.normal(size=len(at))
    nothing = np.full(len(at), np.nan)
    return Arrivals(
        stamp_ns=stamp_ns,
        tx_id=np.arange(len(at)) + 1,
        rx_id=np.arange(len(at)),
        tx=place,
        rx=place,
        toa=length / SOUND,
        var_toa=np.full(len(at), (2.0 * STD / SOUND) ** 2),
        bearing=nothing,
        var_bearing=nothing,
        frame_id='map',
    )


def followed(pings: list[Arrivals], track: TrueTrack, **values: Any) -> FloatArray:
    """Number of the ping, squared error, m^2, and NEES (K, 3) of the estimates of a diver with a
    confirmed track."""
    at = {int(stamp): k for k, stamp in enumerate(track.stamp_ns)}
    rows: list[tuple[float, float, float]] = []
    tracker = DiverTracker(DiverConfig(**values))
    for stamp, estimate in sorted(final_estimates(tracker, pings).items()):
        if (found := first_track(estimate, track.position[at[stamp], :2])) is not None:
            error, nees = found
            rows.append((at[stamp], float(error @ error), nees))
    return np.reshape(rows, (-1, 3))


# -- sides and single ranges ---------------------------------------------------------------------


def baseline(third: int = 10**9) -> Places:
    """Two receivers 80 m apart, turned at random, and a third from a ping on."""

    def places(k: int, rng: np.random.Generator) -> FloatArray:
        angle = rng.uniform(0.0, np.pi)
        turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        every = np.array([[-40.0, 0.0], [40.0, 0.0], [10.0, 70.0]]) @ turned
        return every[: 3 if k >= third else 2]

    return places


def circle(k: int, rng: np.random.Generator) -> FloatArray:
    angle = 2.0 * np.pi * k / 63.0
    return 50.0 * np.array([[np.cos(angle), np.sin(angle)]])


SCENES: dict[str, tuple[Places, str, int]] = {
    'two receivers': (baseline(), 'legs', 100),
    'third from ping 40': (baseline(40), 'legs', 40),
    'four buoys in turn': (lambda k, rng: BUOYS[[k % 4]], 'legs', 100),
    'ship on a circle, diver': (circle, 'legs', 100),
    'ship on a circle, transponder': (circle, 'still', 100),
    'ship on a line': (lambda k, rng: np.array([[5.0 * k - 150.0, -60.0]]), 'legs', 100),
    'one receiver': (lambda k, rng: np.zeros((1, 2)), 'legs', 100),
}
"""Places, motion, and the ping from which on the estimates are another row."""


def with_few_receivers(name: str, seeds: range) -> dict[str, dict[str, float | None]]:
    """Rows of a scene over its seeds."""
    places, motion, change = SCENES[name]
    scores = []
    for seed in seeds:
        track = path(seed, motion, duration=99.0)
        rng = np.random.default_rng([49, seed])
        pings = [
            transponder(int(stamp), places(k, np.random.default_rng([50, seed])), at, rng)
            for k, (stamp, at) in enumerate(zip(track.stamp_ns, track.position[:, :2]))
        ]
        scores.append(followed(pings, track))
    rows = {name: row_of(scores, SETTLED_PINGS, change)}
    if change < len(track.stamp_ns):
        rows[f'{name}, after'] = row_of(scores, change + 2, len(track.stamp_ns))
    return rows


def row_of(scores: list[FloatArray], first: int, last: int) -> dict[str, float | None]:
    """The numbers of the pings from `first` to before `last`."""
    parts = [score[(score[:, 0] >= first) & (score[:, 0] < last)] for score in scores]
    shown = [part for part in parts if len(part)]
    row: dict[str, float | None] = {'tracked': len(shown) / len(scores)}
    if not shown:
        return row
    _, square, nees = np.concatenate(shown).T
    return row | {
        'RMSE': float(np.sqrt(square.mean())),
        'median': float(np.sqrt(np.median(square))),
        'NEES': float(nees.mean()),
        'inside': float((nees < INSIDE).mean()),
        'sure and wrong': float(np.mean([(part[:, 2] > WRONG).mean() > 0.2 for part in shown])),
        'begins s': float(np.median([score[0, 0] for score in scores if len(score)])),
    }


# -- few receivers a ping ------------------------------------------------------------------------

KINDS: dict[str, tuple[bool, dict[str, Any]]] = {
    'echo, 1 s': (False, {'duration': 99.0}),
    'tag, 1 s': (True, {'duration': 99.0}),
    'tag, 29 s': (True, {'duration': 2000.0, 'step': 29.0, 'turn_deg': 180.0}),
}


def thinned(seed: int, receivers: int, passive: bool, track: TrueTrack) -> list[Arrivals]:
    """Pings that some of the receivers hear."""
    rng, std = np.random.default_rng([51, seed, receivers]), 0.3
    pings = []
    for stamp, target in zip(track.stamp_ns, track.position[:, :2]):
        own = np.sort(rng.permutation(len(POOL))[:receivers])
        length = np.hypot(*(POOL[own] - target).T) + std * rng.normal(size=receivers)
        length += (0.0 if passive else np.hypot(*target)) * np.ones(receivers)
        length += (rng.random(receivers) < 0.02) * rng.uniform(5.0, 50.0, receivers)
        nothing = np.full(receivers, np.nan)
        pings.append(
            Arrivals(
                stamp_ns=int(stamp),
                tx_id=np.zeros(receivers),
                rx_id=own,
                tx=np.full((receivers, 3), np.nan if passive else 0.0),
                rx=np.column_stack([POOL[own], np.zeros(receivers)]),
                toa=length / SOUND + (5.0 if passive else 0.0),
                var_toa=np.full(receivers, (std / SOUND) ** 2),
                bearing=nothing,
                var_bearing=nothing,
                frame_id='map',
            )
        )
    return pings


def few(kind: str, receivers: int, seeds: range) -> dict[str, float]:
    """The default and `heading_speed` alone."""
    passive, values = KINDS[kind]
    late: dict[str, list[FloatArray]] = {'families': [], 'heading_speed': []}
    for seed in seeds:
        track = path(seed, **values)
        pings = thinned(seed, receivers, passive, track)
        for model_set, scores in late.items():
            score = followed(pings, track, max_tracks=1, model_set=model_set)
            scores.append(score[score[:, 0] >= SETTLED_PINGS])
    columns = {name: np.concatenate(scores).T for name, scores in late.items()}
    nees = {name: each[2] for name, each in columns.items()}
    rmse = {name: float(np.sqrt(each[1].mean())) for name, each in columns.items()}
    return {
        'RMSE': rmse['families'],
        'heading_speed': rmse['heading_speed'],
        'ratio': rmse['families'] / rmse['heading_speed'],
        'NEES': float(nees['families'].mean()),
        'heading_speed NEES': float(nees['heading_speed'].mean()),
        'inside': float((nees['families'] < INSIDE).mean()),
    }


PARTS = (*TABLES, 'untold', 'receivers', 'few')


def main(runs: int = 20, first: int = 2000, parts: Sequence[str] = PARTS) -> Parts:
    """first: seed of the raw arrivals."""
    yield {'runs': runs}
    for name, cells in TABLES.items():
        for row, column, scene_name, scene, config in cells if name in parts else ():
            yield {name: {row: {column: errors(scene, config, runs, scene_name)}}}
    for name, config in STATED.items() if 'untold' in parts else ():
        yield {'untold': {f'{name}, nothing stated': warned(name, {}, runs)}}
        if config:
            yield {'untold': {f'{name}, stated': warned(name, config, runs)}}
    seeds = range(first, first + runs)
    for name in SCENES if 'receivers' in parts else ():
        yield {'receivers': with_few_receivers(name, seeds)}
    for kind in KINDS if 'few' in parts else ():
        for receivers in (5, 4, 3):
            yield {'few': {f'{kind}, {receivers} receivers': few(kind, receivers, seeds)}}


if __name__ == '__main__':
    study(
        main,
        shown=lambda row: {k: value for k, value in row.items() if not isinstance(value, list)},
        parts={'choices': PARTS},
    )
