# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What once made the fathometer tracker sure and wrong, in one table.

    python -m benchmarks.fathometer_robust --out docs/results/fathometer_robust.json

Traces of six or eight layers of 7 to 34 sigma (`fathometer_gaps`, `fathometer_dips`) at the
defaults: 30 or 120 missing records, layers that dip, a speed of sound that is off by so many m/s
or drawn with the standard deviation of 10 m/s that is the default. Six layers, two of them
negative (``signed``) or none (``strong``), with `polarity: both` and `pulse: processor`, at 16 or
32 hydrophones (`fathometer_pulse`, 30 records, scored after 5).

P: share of the records whose number of reflectors is right ('1st', '2nd' after a gap, 'later' from
the third on); inside: depths within two stated standard deviations. Rows are written as runs end,
and a file that is there already is added to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import fathometer_dips, fathometer_gaps, fathometer_pulse
from benchmarks.study import known, mean_of, Parts, standard_error, study
from sonar_imm.estimation.arrays import FloatArray

ARRAY, SPEED, GAP, LONG = 30.0, 1500.0, 30, 120
"""Depth of the array of the traces, m; speed that trackers assume, m/s; missing records, and so
many that sets begin anew."""
Rows = dict[str, dict[str, float]]


def after_gap(seed: int, particles: int) -> Rows:
    made = {}
    for walk in fathometer_gaps.CASES:
        traces, truth = fathometer_gaps.scene(GAP, walk, seed)
        found = fathometer_gaps.summary(
            [fathometer_gaps.tracked(traces, truth, particles=particles)]
        )
        made[f'30 missing, walk {walk:g} m'] = found
    return made


def dipping(seed: int, particles: int, cases: Sequence[tuple[float, int]]) -> Rows:
    """cases: dip, m per record, and missing records."""
    made = {}
    for dip, gap in cases:
        traces, truth = fathometer_dips.case('parallel', dip, gap, seed)
        found = fathometer_gaps.tracked(traces, truth, particles=particles)
        right = found['right']
        made[f'dip {dip:g} m, {gap} missing'] = fathometer_dips.summary([found]) | {
            'P': float(right.mean()),
            'P, record 1': float(right[0]),
            'P, record 2': float(right[1]),
        }
    return made


def speeds(seed: int, particles: int) -> Rows:
    """The speed only scales what is seen, so that one run serves all speeds."""
    traces, truth = fathometer_gaps.scene(0, 0.1, seed)
    found = fathometer_gaps.tracked(traces, truth, particles=particles, sound_speed_std=10.0)
    drawn = 10.0 * np.random.default_rng([seed, 2]).standard_normal(400)
    return {
        name: {'P': float(np.mean(found['right'])), 'inside': within(found['found'], truth, off)}
        for name, off in (
            ('sound 5 m/s faster', np.array([5.0])),
            ('sound 10 m/s faster', np.array([10.0])),
            ('sound drawn', drawn),
        )
    }


def within(found: FloatArray, truth: FloatArray, faster: FloatArray) -> float:
    """Share of errors and stated deviations (T, K, 2) within two of these, if the sound were so
    many m/s faster (R,) than is assumed and the layers (T, K) as much deeper."""
    error = found[..., 0] - faster[:, None, None] / SPEED * (truth - ARRAY)
    seen = np.isfinite(found[..., 0])
    return float(np.mean(np.abs(error[:, seen]) <= 2.0 * found[seen][:, 1]))


def six_layers(seed: int, particles: int, scene: str) -> Rows:
    found = fathometer_pulse.run(scene, seed, 30, particles, ['processor'], ['both'])
    return {f'{scene}, both': found[f'{scene}, processor, both']}


CASES: dict[str, Callable[..., Rows]] = {
    'gap': after_gap,
    'dip': partial(dipping, cases=((0.4, 0), (0.4, GAP))),
    'long gap': partial(dipping, cases=((0.0, LONG), (0.1, LONG))),
    'speed': speeds,
    **{
        scene: partial(six_layers, scene=scene)
        for scene in ('signed', 'strong', 'signed 32', 'strong 32')
    },
}


def main(
    runs: int = 20,
    particles: int = 20_000,
    cases: Sequence[str] = tuple(CASES),
    out: Path | None = None,
) -> Parts:
    yield known(out)
    for case in cases:
        rows: dict[str, list[dict[str, float]]] = {}
        for seed in range(runs):
            for name, row in CASES[case](seed, particles).items():
                each = rows.setdefault(name, [])
                each.append(row)
                spread = {
                    f'{k}, s.e.': standard_error([r[k] for r in each])
                    for k in ('P', 'OSPA')
                    if k in row
                }
                yield {
                    'table': {
                        name: {'runs': len(each), 'particles': particles} | mean_of(each) | spread
                    }
                }


if __name__ == '__main__':
    study(main, cases={'choices': list(CASES)})
