# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How many multiples are marked, and how many primaries, after so many records.

    python -m benchmarks.fathometer_multiples --out docs/results/fathometer_multiples.json

Tracks are drawn, not filtered: four primaries, the first 8 to 14 m below the surface, the others 2
to 8 m below each other, found with errors of 0.03 m beside one of 0.03 m of the array's depth that
all share, and of all surface multiples and peg-legs that lie between the deepest primary and 45 m
two, drawn at random. The floor is flat, or each layer walks by 0.05 m a record. `no sign`:
polarity positive. `sign`: positive primaries, multiples with the sign they have. Marked: more than
a half.
"""

from __future__ import annotations

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.trackers.fathometer.multiples import Multiples, Seen, ways_above
from sonar_imm.trackers.fathometer.tracker import FathometerConfig

PRIMARIES, DEEPEST, ERROR, RECORDS = 4, 45.0, 0.03, (1, 5, 20, 60)
FLOORS = {'flat floor': 0.0, 'walk .05 m': 0.05}
"""Name: how far a layer walks from record to record, m."""


def drawn(rng: np.random.Generator, walk: float) -> tuple[np.ndarray, np.ndarray]:
    """Depths (T, K) as they are found and sign (K,) of the amplitudes; multiples come last."""
    while True:
        first = np.cumsum(np.append(rng.uniform(8.0, 14.0), rng.uniform(2.0, 8.0, PRIMARIES - 1)))
        ways = ways_above(np.ones(PRIMARIES), PRIMARIES)
        ends = (first[ways.member] * ways.factor).sum(axis=1)
        free = np.flatnonzero((ends > first[-1] + 1.0) & (ends < DEEPEST))
        if len(free) < 2:
            continue
        which = rng.choice(free, 2, replace=False)
        if abs(np.diff(ends[which])[0]) > 1.0:
            break
    steps = walk * rng.standard_normal((max(RECORDS), PRIMARIES))
    z = first + np.cumsum(steps, axis=0)
    multiple = (z[:, ways.member[which]] * ways.factor[which]).sum(axis=2)
    found = np.column_stack([z, multiple])
    # Depths are those of the array plus what is heard; a peg-leg is as wrong as a primary.
    found += ERROR * rng.standard_normal((len(found), 1))
    return found + ERROR * rng.standard_normal(found.shape), np.append(
        np.ones(PRIMARIES), ways.sign[which]
    )


def run(rng: np.random.Generator, walk: float, polarity: str) -> dict[int, np.ndarray]:
    """Which reflectors are marked (K,) after so many records, primaries first."""
    config = FathometerConfig(polarity=polarity, depth_std=max(walk, 0.02))
    found, sign = drawn(rng, walk)
    if polarity == 'positive':
        sign = np.ones(len(sign))
    marked, kept = Multiples(), {}
    for k, depth in enumerate(found, start=1):
        order = np.argsort(depth)
        ids = (1 + order).astype(np.uint32)
        variance = np.full(len(depth), ERROR**2)
        seen = Seen(ids, depth[order], variance, sign[order], ERROR**2)
        if k in RECORDS:
            probability = np.empty(len(depth))
            probability[order] = marked.probabilities(seen, config, DEEPEST)
            kept[k] = probability > 0.5
        marked = marked.after(seen)
    return kept


def main(runs: int = 200) -> Parts:
    for name, walk in FLOORS.items():
        for label, polarity in (('no sign', 'positive'), ('sign', 'both')):
            rng = np.random.default_rng(1)
            found = [run(rng, walk, polarity) for _ in range(runs)]
            row: dict[str, float] = {'runs': float(runs)}
            for k in RECORDS:
                marked = np.array([each[k] for each in found])
                row[f'{k}: found'] = float(marked[:, PRIMARIES:].mean())
                row[f'{k}: falsely'] = float(marked[:, :PRIMARIES].mean())
            yield {'table': {f'{name}, {label}': row}}


if __name__ == '__main__':
    study(main)
