# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers who swim in and out of what a sonar covers: tracks lost without and with stated coverage.

    python -m benchmarks.diver_coverage --runs 10 --out docs/results/diver_coverage.json

Three divers swim at .75 m/s in a sector of 90 degrees and 60 m, again and again 3 to 12 m out of
it over its far edge, and back to where the range is 40 to 55 m; a scan of fixes per second for
300 s, .5 m on each axis, .3 false fixes in a scan. `sector`: the probability of detection is .9
inside and 0 outside. `range`: it falls from .95 at the sonar to .2 at 60 m, and is stated as a
table. At 200 s one of the divers gets out of the water. Everything else is at its default.

lost: how often in an hour of a diver he is seen again under another identity. alone_s: seconds for
which a track lives on inside the sector after its diver has left the water. false_s: seconds of
confirmed tracks inside the sector further than 5 m from any diver, in an hour.
"""

from __future__ import annotations

import csv
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.estimation.consistency import switches_by_scan
from sonar_imm.measurements import Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECONDS, DIVERS, GONE, SPEED = 300, 3, 200, 0.75
REACH, HALF_WIDTH = 60.0, np.pi / 4.0
SECTOR = (0.0, 0.0, 0.0, 90.0, 0.0, REACH)
STD, AREA = 0.5, HALF_WIDTH * REACH**2
RANGES = np.array([0.0, 20.0, 40.0, 60.0])
DETECTED = np.array([0.95, 0.85, 0.5, 0.2])
NEAR = 5.0
HOUR = 3600.0


def inside(place: np.ndarray) -> np.ndarray:
    bearing = np.arctan2(place[..., 1], place[..., 0])
    return (np.hypot(*np.moveaxis(place, -1, 0)) <= REACH) & (np.abs(bearing) <= HALF_WIDTH)


def probability(scene: str, place: np.ndarray) -> np.ndarray:
    if scene == 'sector':
        return np.where(inside(place), 0.9, 0.0)
    at = np.interp(np.hypot(*np.moveaxis(place, -1, 0)), RANGES, DETECTED)
    return np.where(inside(place), at, 0.0)


def paths(rng: np.random.Generator) -> np.ndarray:
    """(seconds, divers, 2) places: out of the sector and back, again and again."""
    found = np.empty((SECONDS, DIVERS, 2))
    for diver in range(DIVERS):
        bearing = 0.5 * (diver - 1)
        place, out = _polar(rng.uniform(30.0, 50.0), bearing), True
        goal = place
        for second in range(SECONDS):
            apart = goal - place
            if np.hypot(*apart) < SPEED:
                away = rng.uniform(3.0, 12.0) + REACH if out else rng.uniform(40.0, 55.0)
                goal, out = _polar(away, bearing + rng.uniform(-0.15, 0.15)), not out
                apart = goal - place
            place = place + SPEED * apart / np.hypot(*apart)
            found[second, diver] = place
    return found


def _polar(away: float, bearing: float) -> np.ndarray:
    return away * np.array([np.cos(bearing), np.sin(bearing)])


def scans(scene: str, truth: np.ndarray, rng: np.random.Generator) -> list[Fixes]:
    made = []
    for second, places in enumerate(truth):
        there = np.arange(DIVERS) < (DIVERS if second < GONE else DIVERS - 1)
        seen = places[there & (rng.uniform(size=DIVERS) < probability(scene, places))]
        fixes = seen + STD * rng.normal(size=seen.shape)
        count = rng.poisson(0.3)
        away = REACH * np.sqrt(rng.uniform(size=count))
        bearing = rng.uniform(-HALF_WIDTH, HALF_WIDTH, count)
        clutter = away[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        position = np.vstack([fixes, clutter])
        made.append(
            Fixes(
                stamp_ns=(second + 1) * 10**9,
                position=np.column_stack([position, np.zeros(len(position))]),
                covariance=np.tile(STD**2 * np.eye(2), (len(position), 1, 1)),
            )
        )
    return made


def score(truth: np.ndarray, config: DiverConfig, items: list[Fixes]) -> dict[str, float]:
    """Of one run: lost, alone_s, false_s, squared error and its number."""
    tracker = DiverTracker(config)
    ids = np.full((SECONDS, DIVERS), -1)
    alone, false, square, count = 0.0, 0.0, 0.0, 0
    for second, item in enumerate(items):
        estimate = tracker.process(item)[-1]
        confirmed = estimate.extras['track_state'] > 0
        place, number = estimate.state[confirmed, :2], estimate.extras['track_id'][confirmed]
        present = DIVERS if second < GONE else DIVERS - 1
        free = np.ones(len(place), bool)
        for diver in range(present):
            apart = np.hypot(*(place - truth[second, diver]).T)
            if len(apart) and apart.min() < NEAR:
                free[apart < NEAR] = False
                if inside(truth[second, diver]):
                    ids[second, diver] = number[apart.argmin()]
                    square, count = square + apart.min() ** 2, count + 1
        false += float((free & inside(place)).sum())
        if second >= GONE:
            alone += float((free & inside(place) & np.isin(number, ids[:GONE, -1])).sum())
    return {
        'lost': float(switches_by_scan(ids).sum()),
        'alone_s': alone,
        'false_s': false,
        'square': square,
        'count': float(count),
    }  # fmt: skip


def case(scene: str, association: str, stated: str, runs: int) -> dict[str, float]:
    values: dict[str, Any] = {'association': association, 'clutter_density': 0.3 / AREA}
    with TemporaryDirectory() as folder:
        if stated != 'nothing':
            values['coverage_sector'] = SECTOR
        if stated == 'table':
            values['coverage_file'] = str(Path(folder) / 'table.csv')
            with Path(values['coverage_file']).open('w', newline='', encoding='utf-8') as file:
                rows = csv.writer(file)
                rows.writerows([('range', 'probability'), *zip(RANGES, DETECTED)])
        found = []
        for seed in range(runs):
            rng = np.random.default_rng([62, seed])
            truth = paths(rng)
            found.append(score(truth, DiverConfig(**values), scans(scene, truth, rng)))
    total = {name: sum(each[name] for each in found) for name in found[0]}
    hours = runs * SECONDS / HOUR
    return {
        'lost per diver hour': total['lost'] / (DIVERS * hours),
        'alone s': total['alone_s'] / runs,
        'false s per hour': total['false_s'] / hours,
        'RMSE': float(np.sqrt(total['square'] / total['count'])),
        'seen': total['count'] / sum(
            inside(paths(np.random.default_rng([62, seed]))).sum() for seed in range(runs)
        ),
    }  # fmt: skip


def main(runs: int = 10) -> Parts:
    yield {'runs': runs}
    for scene, ways in (('sector', ('nothing', 'sector')), ('range', ('nothing', 'table'))):
        for association in ('gnn', 'jipda'):
            for stated in ways:
                row = f'{scene}, {association}, stated {stated}'
                yield {'table': {row: case(scene, association, stated, runs)}}


if __name__ == '__main__':
    study(main)
