# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Floors of all kinds, faults of the array, bins with two surfaces.

    python -m benchmarks.bathymetry_accuracy --out docs/results/bathymetry_accuracy.json

`floors`: `terrain` and walks on the same pings of eight staves 15 m above the reference floor, 30
to 10 dB, 1200 bins of .05 m; a patch, where there is one, is 10 m long. RMSE of the height over
all valid bins and inside of the patch (m), the share of heights within two standard deviations,
the same inside of the patch, the overlap of the patch with the bins called rough, or, without a
patch, the share of bins called rough; both also with `winding` floor counted as rough (`_either`),
which roughness correlated over metres is as well, and the share of the patch and of the rest that
is told smooth (`told_smooth_patch`, `told_smooth`). `calibration`: of `terrain`, the bins of all
floors by their probability of rough floor, the mean of it and the share that is rough.

`arrays`: `terrain` on the floor `white .5`, with errors of the array in its samples, as they are
and measured from the echoes, mean over arrays with the fault at other staves; `used`: share of the
bins with a height, `named`: share of the arrays whose warnings name the fault.

`gated` and `resolved`, what `layover` is: each ping has an object of its own, at 22 to 60 m: a
ledge of .8 to 3 m, a box of 1 to 4 m, a wall of 2 to 6 m or a boulder of .6 to 2 m radius; or
none. A bin has two surfaces if the second one lies .5 m or more beside the strongest, at most 15
dB below it and at 0 dB or more at a stave; it has one if no other answers.

`caught`: share of the bins with two surfaces that are marked (gated) or get both heights
(resolved); `false`: share of the bins of one surface that are, too; `doubt`: share of those with
two that are neither. Of bins with two heights: `rmse_m` of both against the nearest surface that
answers, `inside` two standard deviations, and `inside_facets`: against the nearest facet, because
surfaces count at their mean height, and that of a round face lies between the parts above and
below its nearest one, where nothing is. `ranges`: the share that is caught, of all objects, by the
slant range of the bin. `floors`: shares of the bins of floors without objects that are marked.
`oversampled`: of a flat floor, where a pulse spans several bins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import math
from typing import Any

from attrs import evolve, frozen
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import resample

from benchmarks.bathymetry_paper import EXACT_ARRAY
from benchmarks.study import Parts, rms, Row, study
from sonar_imm.acoustics import array
from sonar_imm.acoustics.layover import GATE
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.ping import Ping, track_ping
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import TrueProfile
from sonar_imm_tools.simulation.bathymetry.objects import (
    Facets,
    facets_of,
    second_of,
    surfaces_of,
)
from sonar_imm_tools.simulation.bathymetry.simulator import hear, scenario, simulate, snr

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
    'one stave of noise',
    'one stave with 10 dB more noise',
    'one stave inverted',
    'gains of 3 dB',
    'phases of 20 deg',
    'two neighbours exchanged',
    'conjugated',
)


def spoiled(fault: str, snapshot: Snapshot, seed: int) -> Snapshot:
    """A ping of noise variance 1 whose array has a fault, at another stave for each seed."""
    rng = np.random.default_rng(seed)
    y = np.array(snapshot.iq, np.complex128)
    bins, staves = y.shape
    one = rng.permutation(staves)[0]
    beside = one + 1 if one < staves - 1 else one - 1
    noise = math.sqrt(0.5) * rng.normal(size=(bins, staves, 2)).view(np.complex128)[..., 0]
    gains = 10.0 ** (0.15 * rng.normal(size=staves))
    if fault == 'one stave dead':
        y[:, one] = 0.0
    elif fault == 'one stave weaker by 6 dB':
        y[:, one] *= 10.0**-0.3
    elif fault == 'one stave of noise':
        y[:, one] = noise[:, one]
    elif fault == 'one stave with 10 dB more noise':
        y[:, one] += 3.0 * noise[:, one]
    elif fault == 'one stave inverted':
        y[:, one] *= -1.0
    elif fault == 'gains of 3 dB':
        y *= gains
    elif fault == 'phases of 20 deg':
        y *= np.exp(1j * math.radians(20.0) * rng.normal(size=staves))
    elif fault == 'two neighbours exchanged':
        y[:, [one, beside]] = y[:, [beside, one]]
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


def floors(pings: int, seed: int) -> Parts:
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


# -- two surfaces -------------------------------------------------------------------------------

SIZES = {'ledge': (0.8, 3.0), 'box': (1.0, 4.0), 'wall': (2.0, 6.0), 'boulder': (0.6, 2.0)}
BANDS = ((17.0, 30.0), (30.0, 40.0), (40.0, 50.0), (50.0, 77.0))
SETTINGS: dict[str, dict[str, Any]] = {
    '8 staves, 30-10 dB': {},
    '8 staves, 20-0 dB': {'snr_near_db': 20.0, 'snr_far_db': 0.0},
    '8 staves, 10-0 dB': {'snr_near_db': 10.0, 'snr_far_db': 0.0},
    '4 staves, 30-10 dB': {'staves': 4},
    '2 staves, 30-10 dB': {'staves': 2},
    '0.5 % differ': {'decorrelation': 0.005},
    '2 % differ': {'decorrelation': 0.02},
}
THERMAL = {'noise_fades': False}
BARE: dict[str, tuple[str, dict[str, Any]]] = {
    'noise that fades': ('paper', {}),
    'surface echoes at -10 dB, not told': ('multipath', {'multipath_level_db': -10.0, **THERMAL}),
}
"""Floors without objects."""


def objects(
    kind: str, pings: int, seed: int, changes: Mapping[str, Any]
) -> Iterator[tuple[Snapshot, Facets]]:
    """Pings, and the facets that each of them sees."""
    rng = np.random.default_rng((seed, list(SIZES).index(kind)))
    for _ in range(pings):
        size, distance = rng.uniform(*SIZES[kind]), rng.uniform(16.0, 58.0)
        placed = {'object': kind, 'object_size': size, 'object_distance': distance, 'pings': 1}
        config = scenario('ledge', {**placed, **changes})
        scene = simulate(config, int(rng.integers(1 << 31)))
        snapshot: Snapshot = scene.measurements[0].measurement
        yield snapshot, facets_of(config, snapshot.range, snr(config, snapshot.range))


def tracked(snapshot: Snapshot, layover: str) -> Estimate:
    config = BathymetryConfig(layover=layover, seed=1, **EXACT_ARRAY)
    (estimate,) = BathymetryTracker(config).process(snapshot)
    return estimate


def bins_of(snapshot: Snapshot, facets: Facets, layover: str) -> dict[str, np.ndarray]:
    """What each bin of a ping with two surfaces (n,), and each height of bins that got two (m, 2),
    came to."""
    estimate = tracked(snapshot, layover)
    power, height = surfaces_of(facets, len(snapshot))
    double, single = second_of(power, height)[0] >= 2, (power > 0.0).sum(axis=1) == 1
    marked, valid = estimate.extras['surfaces'] == 2, estimate.extras['valid'] > 0
    found = {
        'range': snapshot.range[double],
        'caught': marked[double],
        'doubt': (~valid & (estimate.extras['surfaces'] == 1))[double],
        'false': marked[single],
    }
    if layover == 'gated':
        return found
    chosen = np.flatnonzero(marked & (power > 0.0).any(axis=1))
    both = np.column_stack([estimate.state[:, 0], estimate.extras['height_2']])[chosen]
    sd = np.column_stack([np.sqrt(estimate.covariance[:, 0, 0]), estimate.extras['height_2_std']])[
        chosen
    ]
    there = np.where(power > 0.0, height, np.nan)[chosen]
    facet = [
        np.abs(pair - facets.height[facets.bin == place, None]).min(axis=0)
        for pair, place in zip(both, chosen)
    ]
    off = np.nanmin(np.abs(both[:, :, None] - there[:, None, :]), axis=2)
    return {**found, 'off': off, 'sd': sd, 'facet': np.reshape(facet, (-1, 2))}


def row_of(bins: Mapping[str, np.ndarray]) -> dict[str, float]:
    row = {'bins_two': len(bins['caught'])}
    shares = {name: float(bins[name].mean()) for name in ('caught', 'doubt', 'false')}
    if 'off' not in bins:
        return {**row, **shares}
    return {
        **row,
        **shares,
        'rmse_m': rms(bins['off']),
        'inside': float((bins['off'] < 2.0 * bins['sd']).mean()),
        'inside_facets': float((bins['facet'] < 2.0 * bins['sd']).mean()),
    }


def by_range(at: FloatArray, caught: BoolArray) -> Iterator[tuple[str, dict[str, float]]]:
    """Of bins with two surfaces, at slant ranges and caught or not, how many are, by range."""
    for low, high in BANDS:
        here = (at >= low) & (at < high)
        row = {'bins_two': int(here.sum()), 'caught': float(caught[here].mean())}
        yield f'{low:g} to {high:g} m', row


def marked_floor(name: str, layover: str, pings: int, seed: int) -> dict[str, float]:
    """Shares of the bins of a floor without objects that are marked, and of the worst ping."""
    scene_name, changes = BARE[name]
    config = scenario(scene_name, {'pings': pings, **changes})
    values = {**config.instruments(), **EXACT_ARRAY, 'layover': layover}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    parts = [
        float((tracker.process(item.measurement)[0].extras['surfaces'] == 2).mean())
        for item in simulate(config, seed).measurements
    ]
    return {'false': float(np.mean(parts)), 'worst_ping': max(parts)}


def oversampled(times: int, pings: int, seed: int) -> dict[str, float]:
    """Share of the bins of a flat floor that are marked, where a pulse spans `times` of them:
    samples between bins are interpolated with their band."""
    flat = simulate(scenario('thermal', {'patch_std': 0.0, 'pings': pings}), seed).measurements
    marked = []
    for item in flat:
        ping: Snapshot = item.measurement
        bins, width = len(ping), ping.range[1] - ping.range[0]
        assert ping.noise_variance is not None
        finer = evolve(
            ping,
            range=ping.range[0] + width / times * np.arange(bins * times),
            iq=resample(ping.iq, bins * times, axis=0).astype(np.complex64),
            noise_variance=np.repeat(ping.noise_variance, times),
        )
        marked.append(float((tracked(finer, 'resolved').extras['existence_2'] > GATE).mean()))
    return {'lost_flat': float(np.mean(marked))}


def surfaces(layover: str, pings: int, seed: int) -> Parts:
    """The rows of a way to treat layover: by object, by range, and of floors without objects."""
    for name, changes in SETTINGS.items():
        if layover == 'resolved' and changes.get('staves') == 2:
            continue  # two staves mark such bins, and cannot tell the surfaces apart
        every = []
        for kind in SIZES:
            parts = [bins_of(*ping, layover) for ping in objects(kind, pings, seed, changes)]
            bins = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
            yield {layover: {f'{kind}, {name}': row_of(bins)}}
            every.append(bins)
        at, caught = (np.concatenate([bins[key] for bins in every]) for key in ('range', 'caught'))
        for band, row in by_range(at, caught):
            yield {f'{layover}, ranges': {f'{name}, {band}': row}}
    for name in BARE:
        yield {f'{layover}, floors': {name: marked_floor(name, layover, pings, seed)}}


PARTS = ('floors', 'arrays', 'gated', 'resolved')


def main(
    pings: int = 10, array_seeds: int = 5, object_pings: int = 40, parts: Sequence[str] = PARTS
) -> Parts:
    """pings: of a floor; array_seeds: arrays with a fault; object_pings: of each kind
    of object, and of a floor without."""
    yield {'pings': pings, 'objects': object_pings}
    if 'arrays' in parts:
        yield from arrays(max(pings // 2, 5), 1013, array_seeds)
    if 'floors' in parts:
        yield from floors(pings, 13)
    for layover in ('gated', 'resolved'):
        if layover in parts:
            yield from surfaces(layover, object_pings, 7)
    if 'resolved' in parts:
        for times in (1, 2, 4):
            row = oversampled(times, max(object_pings // 2, 1), 7)
            yield {'oversampled': {f'{times} bins per pulse': row}}


def shown(row: Row) -> Row:
    """What is printed of a method: the numbers that there are."""
    return {name: value for name, value in row.items() if value is not None}


if __name__ == '__main__':
    study(main, shown=shown, parts={'choices': PARTS})
