# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Floors of all kinds, by `terrain` and by walks, on the same pings.

    python -m benchmarks.bathymetry_floors --out docs/results/bathymetry_floors.json

An array of eight staves 15 m above the reference floor, 30 to 10 dB, 1200 bins of .05 m; a patch,
where there is one, is 10 m long. Prints RMSE of the height over all valid bins and inside of the
patch (m), the share of heights within two standard deviations, the same inside of the patch, the
overlap of the patch with the bins called rough, or, without a patch, the share of bins called
rough; of `terrain` both also with `winding` floor counted as rough (`_either`), which roughness
correlated over metres is as well, and the share of the patch and of the rest that is told smooth
(`told_smooth_patch`, `told_smooth`). `calibration`:
of `terrain`, the bins of all floors by their probability of rough floor, the mean of it and the
share that is rough.

`arrays`: `terrain` on the floor `white .5`, with errors of the array in its samples, as they are
and measured from the echoes, mean over arrays with the fault at other staves; `used`: share of the
bins with a height, `named`: share of the arrays whose warnings name the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Any

from attrs import evolve, frozen
import numpy as np
from scipy.ndimage import gaussian_filter1d

from benchmarks.bathymetry_paper import EXACT_ARRAY
from benchmarks.study import Parts, rms, Row, study
from sonar_imm.acoustics import array
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.ping import Ping, track_ping
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import TrueProfile
from sonar_imm_tools.simulation.bathymetry.simulator import hear, scenario

METHODS: dict[str, dict[str, Any]] = {
    'terrain': {'model_set': 'terrain'},
    'two walks': {'model_set': 'height_two_rw'},
    'paper': {
        'model_set': 'height_two_rw',
        'sigmas': (0.01, 1.0),
        'transition_matrix': (0.98, 0.02, 0.02, 0.98),
    },
}
EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
Shape = Callable[[FloatArray], FloatArray]


@frozen
class FloorKind:
    """A floor: its smooth shape over range, the standard deviation of a patch, m, the length over
    which that is correlated (the kernel that smooths it), where it lies, and the ratio of signal
    to noise at the first and the last bin."""

    shape: Shape
    std: float = 0.0
    length: float = 0.0
    patch: tuple[float, float] = (40.0, 50.0)
    decibels: tuple[float, float] = (30.0, 10.0)


def slope(rise: float) -> Shape:
    return lambda r: rise * (r - 40.0)


def wave(height: float, length: float) -> Shape:
    return lambda r: height * np.sin(2.0 * np.pi * r / length)


def steps(*each: tuple[float, float]) -> Shape:
    """Steps at ranges, each by so many metres."""
    return lambda r: np.sum([rise * (r >= place) for place, rise in each], axis=0)


flat = slope(0.0)
NEAR, FAR, FAINT = (20.0, 27.0), (58.0, 68.0), (20.0, 0.0)
FLOORS: dict[str, FloorKind] = {
    'flat': FloorKind(flat),
    'white .5': FloorKind(flat, 0.5),
    'rises .07': FloorKind(slope(0.07)),
    'rises .18': FloorKind(slope(0.18)),
    'falls .28': FloorKind(slope(-0.28)),
    'wave .5 m over 7 m': FloorKind(wave(0.5, 7.0)),
    'wave 1 m over 13 m': FloorKind(wave(1.0, 13.0)),
    'wave .7 m over 20 m': FloorKind(wave(0.7, 20.0)),
    'wave 1 m over 40 m': FloorKind(wave(1.0, 40.0)),
    'steps of 1.5 and 2 m': FloorKind(steps((35.0, 1.5), (55.0, -2.0))),
    'ledge of 2.5 m': FloorKind(steps((45.0, 2.5))),
    'white .2': FloorKind(flat, 0.2),
    'white .8': FloorKind(flat, 0.8),
    'correlated .4 over .4 m': FloorKind(flat, 0.4, 0.4),
    'correlated 1 over .8 m': FloorKind(flat, 1.0, 0.8),
    'correlated .5 over 1.5 m': FloorKind(flat, 0.5, 1.5),
    'near, white .15': FloorKind(flat, 0.15, 0.0, NEAR),
    'near, .4 over .3 m': FloorKind(flat, 0.4, 0.3, NEAR),
    'far, white .7': FloorKind(flat, 0.7, 0.0, FAR),
    'far, .6 over .5 m': FloorKind(flat, 0.6, 0.5, FAR),
    'white .5 on a slope of .12': FloorKind(slope(0.12), 0.5),
    '20 to 0 dB, white .5': FloorKind(flat, 0.5, 0.0, (40.0, 50.0), FAINT),
    '20 to 0 dB, slope .1': FloorKind(slope(0.1), decibels=FAINT),
}


def heard(floor: FloorKind, seed: int) -> tuple[Snapshot, TrueProfile]:
    """One ping of a floor, and what is true of it."""
    config = scenario('paper', {'snr_near_db': floor.decibels[0], 'snr_far_db': floor.decibels[1]})
    rng = np.random.default_rng(seed)
    ranges = config.first_range + config.bin_width * np.arange(1200, dtype=np.float64)
    patch = (ranges >= floor.patch[0]) & (ranges < floor.patch[1]) & (floor.std > 0.0)
    rough = rng.normal(size=len(ranges))
    if floor.length > 0.0:
        rough = gaussian_filter1d(rough, floor.length / config.bin_width)
        rough /= rough.std()
    height = floor.shape(ranges) + floor.std * patch * rough
    depth = config.sonar_height - height
    tilt = math.radians(config.tilt_deg)
    outward = np.nan_to_num(array.across_track(depth, ranges))
    truth = TrueProfile(
        stamp_ns=1_000 + seed,
        frame_id='sonar',
        range=ranges,
        height=height,
        angle=array.angle_of_depth(depth, ranges, tilt),
        patch=patch,
        valid=np.abs(depth) <= ranges,
        xyz=np.column_stack([np.zeros(len(ranges)), -outward, -depth]),
        namespace='',
    )
    return hear(config, truth, rng), truth


FAULTS = (
    'none',
    'one stave dead',
    'one stave weaker by 6 dB',
    'one stave weaker by 9 dB, its noise as the others',
    'one stave of noise',
    'one stave of noise, 25 dB louder',
    'one stave with 6 dB more noise',
    'one stave with 10 dB more noise',
    'one stave inverted',
    'gains of 3 dB',
    'gains of 3 dB before a common noise',
    'phases of 20 deg',
    'two neighbours exchanged',
    'two others exchanged',
    'conjugated',
)


def spoiled(fault: str, snapshot: Snapshot, seed: int) -> Snapshot:
    """A ping of noise variance 1 whose array has a fault, at another stave for each seed."""
    rng = np.random.default_rng(seed)
    y = np.array(snapshot.iq, np.complex128)
    bins, staves = y.shape
    one, other = rng.permutation(staves)[:2]
    beside = one + 1 if one < staves - 1 else one - 1
    noise = math.sqrt(0.5) * rng.normal(size=(bins, staves, 2)).view(np.complex128)[..., 0]
    gains = 10.0 ** (0.15 * rng.normal(size=staves))
    if fault == 'one stave dead':
        y[:, one] = 0.0
    elif fault == 'one stave weaker by 6 dB':
        y[:, one] *= 10.0**-0.3
    elif fault == 'one stave weaker by 9 dB, its noise as the others':
        y[:, one] = 10.0**-0.45 * y[:, one] + math.sqrt(1.0 - 10.0**-0.9) * noise[:, one]
    elif fault == 'one stave of noise':
        y[:, one] = noise[:, one]
    elif fault == 'one stave of noise, 25 dB louder':
        y[:, one] = 10.0**1.25 * noise[:, one]
    elif fault.endswith('more noise'):
        y[:, one] += math.sqrt(10.0 ** (0.6 if '6 dB' in fault else 1.0) - 1.0) * noise[:, one]
    elif fault == 'one stave inverted':
        y[:, one] *= -1.0
    elif fault == 'gains of 3 dB':
        y *= gains
    elif fault == 'gains of 3 dB before a common noise':
        gains /= gains.max()
        y = gains * y + np.sqrt(1.0 - np.square(gains)) * noise
    elif fault == 'phases of 20 deg':
        y *= np.exp(1j * math.radians(20.0) * rng.normal(size=staves))
    elif fault.endswith('exchanged'):
        pair = [one, beside if fault.startswith('two neighbours') else other]
        y[:, pair] = y[:, pair[::-1]]
    elif fault == 'conjugated':
        y = y.conj()
    return evolve(snapshot, iq=y.astype(np.complex64))


class Scores:
    """Sums over the pings of one floor by one method."""

    def __init__(self) -> None:
        self.pings: list[dict[str, Any]] = []

    def score(self, estimate: Estimate, truth: TrueProfile) -> None:
        table = estimate.columns()
        used = (table['valid'] > 0) & truth.valid
        rough = table['rough'] if 'rough' in table else table['prob_rw_rough']
        either = rough + table.get('prob_winding', 0.0)
        error = (table['height'] - truth.height)[used]
        self.pings.append(
            {
                'error': error,
                'inside': np.abs(error) < 2.0 * np.sqrt(table['cov_height_height'][used]),
                'rough': rough[used],
                'either': either[used],
                'smooth': table['told'][used] == 0,
                'patch': truth.patch[used],
            }
        )

    def whole(self, name: str) -> Any:
        return np.concatenate([ping[name] for ping in self.pings])

    def row(self) -> dict[str, float | None]:
        error, inside, patch = (self.whole(name) for name in ('error', 'inside', 'patch'))
        rough, there = self.whole('rough') > 0.5, bool(patch.any())
        either, smooth = self.whole('either') > 0.5, self.whole('smooth')
        return {
            'rmse': float(np.sqrt(np.mean(np.square(error)))),
            'inside': float(inside.mean()),
            'rmse_patch': float(np.sqrt(np.mean(np.square(error[patch])))) if there else None,
            'inside_patch': float(inside[patch].mean()) if there else None,
            'overlap': float((rough & patch).sum() / (rough | patch).sum()) if there else None,
            'overlap_either': float((either & patch).sum() / (either | patch).sum())
            if there
            else None,
            'called_rough': None if there else float(rough.mean()),
            'called_either': None if there else float(either.mean()),
            'told_smooth': float(smooth[~patch].mean()),
            'told_smooth_patch': float(smooth[patch].mean()) if there else None,
        }


def calibration(found: Sequence[Scores]) -> dict[str, dict[str, float]]:
    rough, patch = (np.concatenate([s.whole(name) for s in found]) for name in ('rough', 'patch'))
    table: dict[str, dict[str, float]] = {'all': {'brier': float(np.mean((rough - patch) ** 2))}}
    for low, high in zip(EDGES, EDGES[1:]):
        bins = (rough >= low) & ((rough < high) | (high == 1.0))
        table[f'{low:g} to {high:g}'] = {
            'bins': int(bins.sum()),
            'said': float(rough[bins].mean()),
            'right': float(patch[bins].mean()),
        }
    return table


def of_array(fault: str, pings: int, seed: int, **values: Any) -> dict[str, float]:
    """The heights that a tracker of one array with a fault gives."""
    scores = Scores()
    tracker = BathymetryTracker(BathymetryConfig(**EXACT_ARRAY, **values))
    for ping in range(pings):
        clean, truth = heard(FLOORS['white .5'], 100_000 * seed + 50_000 + ping)
        for estimate in tracker.process(spoiled(fault, clean, seed)):
            scores.score(estimate, truth)
    error, inside, patch = (scores.whole(name) for name in ('error', 'inside', 'patch'))
    found = {'used': len(error) / (pings * len(truth.range))}
    for name, where in (('smooth', ~patch), ('patch', patch)):
        if where.any():
            found[f'rmse_{name}'] = rms(error[where])
            found[f'inside_{name}'] = float(inside[where].mean())
    starts = 'stave ', 'staves ', 'echoes fit the other sign'
    named = any(said.startswith(starts) for said in tracker.warnings())
    return found | {'named': float(named)}


def arrays(pings: int, seed: int, others: int) -> Parts:
    """All faults, at the staves of so many seeds."""
    for fault in FAULTS:
        for name, does in (('as it is', False), ('measured', True)):
            rows = [
                of_array(fault, pings, seed + k, calibrate_array=does, conjugate_auto=does)
                for k in range(others)
            ]
            row = {
                each: float(np.mean([row[each] for row in rows if each in row]))
                for each in max(rows, key=len)
            }
            yield {'arrays': {f'{fault}, {name}': row}}


def main(pings: int = 10, seed: int = 1, array_seeds: int = 5) -> Parts:
    yield {'pings': pings, 'seed': seed}
    yield from arrays(max(pings // 2, 5), 1000 + seed, array_seeds)
    methods = {name: BathymetryConfig(**EXACT_ARRAY, **values) for name, values in METHODS.items()}
    of_terrain = []
    for number, (name, floor) in enumerate(FLOORS.items()):
        found = {method: Scores() for method in methods}
        for ping in range(pings):
            snapshot, truth = heard(floor, 100_000 * seed + 1000 * number + ping)
            for method, config in methods.items():
                found[method].score(track_ping(Ping(config, snapshot, None)).estimate, truth)
        of_terrain.append(found['terrain'])
        yield {'floors': {name: {method: scores.row() for method, scores in found.items()}}}
    yield {'calibration': calibration(of_terrain)}


def shown(row: Row) -> Row:
    """What is printed of a method: the numbers that there are."""
    return {name: value for name, value in row.items() if value is not None}


if __name__ == '__main__':
    study(main, shown=shown)
