# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Both surfaces of bins that have two: which are found, and how far their heights are off.

    python -m benchmarks.bathymetry_resolved --out docs/results/bathymetry_resolved.json

The pings of `bathymetry_layover`, with objects of other seeds, under ``layover: resolved``.
`caught`: share of the bins with two surfaces that get both heights; `doubt`: that are neither
(no sounding); `silent`: without an echo; `false`: share of the bins of one surface that get two.
Of bins with two heights: `rmse`, both against the nearest surface that answers, `inside` two
standard deviations, the median `sd`, and `outer`: both the lowest and the highest surface met
within .6 m. Surfaces count at their mean height; that of a round face lies between the parts above
and below its nearest one, where nothing is. `facets`: the same against the nearest facet.
`ranges`: the share that is caught, of all objects, by the slant range of the bin.
`existence`: how often there are two where the tracker says so, over all objects.
`ship`: the same below a ship in a swell, from the soundings and the two strongest surfaces.
`rays`: two level surfaces along 120 bins below a ship, as the array of `moving` and of
`moving_profile` has their directions, under which rays bend.
`bound`: sd of two heights from one bin, the Cramer-Rao bound of normal echoes at known ratios, and
what the tracker reaches along 60 bins. `oversampled`: ledges whose pulse spans several
bins, judged at every so many bins, and flat floors alike. `cost`: CPU time, see
`benchmarks.speed.bathymetry`.
"""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import Any

from attrs import evolve
import numpy as np
from scipy.signal import resample

from benchmarks.bathymetry_layover import by_range, FLAT, objects, SIZES
from benchmarks.bathymetry_paper import EXACT_ARRAY
from benchmarks.layover_tables import circular
from benchmarks.speed.bathymetry import bench_layover
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.acoustics import array
from sonar_imm.acoustics.layover import GATE
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import TrueProfile
from sonar_imm_tools.simulation.bathymetry.objects import Facets, second_of, surfaces_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr

SETTINGS: dict[str, dict[str, Any]] = {
    '8 staves, 30-10 dB': {},
    '8 staves, 20-5 dB': {'snr_near_db': 20.0, 'snr_far_db': 5.0},
    '8 staves, 10-0 dB': {'snr_near_db': 10.0, 'snr_far_db': 0.0},
    '4 staves, 30-10 dB': {'staves': 4},
    '0.5 % differ': {'decorrelation': 0.005},
    'noise fades with the echo': {'noise_fades': True},
}
CLASSES = (0.0, 0.01, 0.3, 0.5, 0.7, 0.95, 0.99, 1.0 + 1e-6)
APART, RATIOS = (0.3, 0.5, 1.0, 2.0, 4.0), (10.0, 20.0, 30.0)
STRETCH = (38.0, 44.0)
AT, HEIGHT, TILT = 40.0, 15.0, math.radians(30.0)


class Tally:
    """Bins of some pings; each list holds an array per ping."""

    def __init__(self) -> None:
        self.double = self.single = self.caught = self.doubt = self.silent = self.false = 0
        self.off: list[FloatArray] = []
        self.off_facets: list[FloatArray] = []
        self.sd: list[FloatArray] = []
        self.outer: list[BoolArray] = []
        self.of_three: list[FloatArray] = []
        self.stated: list[FloatArray] = []
        self.true: list[BoolArray] = []
        self.ranges: list[FloatArray] = []
        self.pair: list[BoolArray] = []

    def add(self, ranges: FloatArray, estimate: Estimate, facets: Facets) -> None:
        """One ping with bins at these ranges (T,), and the facets that it sees."""
        power, height = surfaces_of(facets, len(estimate))
        number = second_of(power, height)[0]
        double, single = number >= 2, (power > 0.0).sum(axis=1) == 1
        surfaces, valid = estimate.extras['surfaces'], estimate.extras['valid'] > 0
        pair = surfaces == 2
        self.double, self.single = self.double + int(double.sum()), self.single + int(single.sum())
        self.caught += int((pair & double).sum())
        self.ranges.append(ranges[double])
        self.pair.append(pair[double])
        self.doubt += int((~valid & (surfaces == 1) & double).sum())
        self.silent += int(((surfaces == 0) & double).sum())
        self.false += int((pair & single).sum())
        there = np.where(power > 0.0, height, np.nan)
        found = np.column_stack([estimate.state[:, 0], estimate.extras['height_2']])
        lower_sd = np.sqrt(estimate.covariance[:, 0, 0])
        sd = np.column_stack([lower_sd, estimate.extras['height_2_std']])
        chosen = pair & (power > 0.0).any(axis=1)
        off = np.nanmin(np.abs(found[chosen, :, None] - there[chosen, None, :]), axis=2)
        self.off.append(off)
        self.off_facets.append(off_facets(found, chosen, facets))
        self.sd.append(sd[chosen])
        self.of_three.append(off[number[chosen] == 3])
        both = pair & double
        ends = np.column_stack([np.nanmin(there[both], axis=1), np.nanmax(there[both], axis=1)])
        self.outer.append((np.abs(found[both] - ends) < 0.6).all(axis=1))
        clear = (double | single) & (surfaces > 0)
        self.stated.append(estimate.extras['existence_2'][clear])
        self.true.append(double[clear])

    def row(self) -> dict[str, float]:
        off, sd = np.concatenate(self.off), np.concatenate(self.sd)
        near = np.concatenate(self.off_facets)
        three = np.concatenate(self.of_three)
        return {
            'bins_two': self.double,
            'caught': self.caught / self.double,
            'doubt': self.doubt / self.double,
            'silent': self.silent / self.double,
            'false': self.false / self.single,
            'rmse_m': rms(off),
            'median_m': float(np.median(off)),
            'inside': float((off < 2.0 * sd).mean()),
            'rmse_facets_m': rms(near),
            'inside_facets': float((near < 2.0 * sd).mean()),
            'sd_m': float(np.median(sd)),
            'outer': float(np.concatenate(self.outer).mean()),
            'bins_three': len(three),
            'rmse_three_m': rms(three) if len(three) else math.nan,
        }


def off_facets(found: FloatArray, chosen: BoolArray, facets: Facets) -> FloatArray:
    """Distance (n, 2) of heights found (T, 2) in the bins `chosen` (T,) to the nearest facet."""
    off = [
        np.abs(found[place] - facets.height[facets.bin == place, None]).min(axis=0)
        for place in np.flatnonzero(chosen)
    ]
    return np.array(off).reshape(-1, 2)


def tracked(snapshot: Snapshot, layover: str = 'resolved') -> Estimate:
    config = BathymetryConfig(layover=layover, seed=1, **EXACT_ARRAY)
    (estimate,) = BathymetryTracker(config).process(snapshot)
    return estimate


def calibration(stated: FloatArray, true: BoolArray) -> Iterator[tuple[str, dict[str, float]]]:
    """Bins by the existence that is stated, and how many have two surfaces."""
    for low, high in zip(CLASSES[:-1], CLASSES[1:]):
        chosen = (stated >= low) & (stated < high)
        if chosen.any():
            row = {'stated': float(stated[chosen].mean()), 'right': float(true[chosen].mean())}
            yield f'{low:g} to {min(high, 1.0):g}', {'bins': int(chosen.sum()), **row}


def floors(name: str, pings: int, seed: int) -> dict[str, float]:
    """Bins of a floor without objects that get two heights, or become no sounding for doubt."""
    scene_name, changes = FLAT[name]
    config = scenario(scene_name, {'pings': pings, **changes})
    values = {**config.instruments(), **EXACT_ARRAY, 'layover': 'resolved'}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    false = doubt = bins = 0
    for item in simulate(config, seed).measurements:
        (estimate,) = tracker.process(item.measurement)
        surfaces, valid = estimate.extras['surfaces'], estimate.extras['valid'] > 0
        false, bins = false + int((surfaces == 2).sum()), bins + len(estimate)
        doubt += int(((surfaces == 1) & ~valid).sum())
    return {'bins': bins, 'false': false / bins, 'doubt': doubt / bins}


def below_ship(kind: str, pings: int, seed: int) -> dict[str, float]:
    """Soundings of objects below a ship: of bins with two of them, errors to the nearest of the
    two strongest surfaces."""
    rng = np.random.default_rng((seed, list(SIZES).index(kind)))
    off, sd, double, caught = [], [], 0, 0
    for _ in range(max(pings // 4, 1)):
        size, distance = rng.uniform(*SIZES[kind]), rng.uniform(16.0, 58.0)
        placed = {'object': kind, 'object_size': size, 'object_distance': distance, 'pings': 4}
        config = scenario('moving_ledge', placed)
        scene = simulate(config, int(rng.integers(1 << 31)))
        values = config.instruments() | EXACT_ARRAY
        values |= {'navigation': 'required', 'layover': 'resolved'}
        tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
        made = [each for item in scene.measurements for each in tracker.process(item.measurement)]
        for estimate, true in zip(made, scene.truth):
            assert isinstance(true, TrueProfile)
            assert true.surfaces is not None and true.height_2 is not None
            pair = estimate.extras['surfaces'] == 2
            double, caught = (
                double + int((true.surfaces > 1).sum()),
                caught + int((pair & (true.surfaces > 1)).sum()),
            )
            for place, end in (('pz', ''), ('pz_2', '_2')):
                z = estimate.extras[place]
                error = np.fmin(np.abs(z - true.height), np.abs(z - true.height_2))
                known = pair & np.isfinite(error)
                off.append(error[known])
                sd.append(np.sqrt(estimate.extras[f'vertical_uncertainty{end}'][known]))
    errors, stds = np.concatenate(off), np.concatenate(sd)
    return {
        'bins_two': double,
        'caught': caught / double,
        'rmse_m': rms(errors),
        'median_m': float(np.median(errors)),
        'inside': float((errors < 2.0 * stds).mean()),
        'sd_m': float(np.median(stds)),
    }


def two_levels(name: str, up: float, pings: int, seed: int) -> dict[str, float]:
    """Soundings of a level floor below a ship and of another one `up` m higher, which answer
    together in the bins of `STRETCH`, from the directions that the scene has for either."""
    rng = np.random.default_rng((seed, round(10.0 * up)))
    flat = {'patch_std': 0.0, 'noise_fades': False, 'pings': pings}
    config = scenario(name, flat)
    higher = scenario(name, {**flat, 'sonar_height': config.sonar_height - up})
    scene = simulate(config, seed)
    floors = truths(scene, TrueProfile), truths(simulate(higher, seed), TrueProfile)
    values = config.instruments() | EXACT_ARRAY
    values |= {'navigation': 'required', 'layover': 'resolved'}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    made, number = [], 0
    for item in scene.measurements:
        measurement = item.measurement
        if isinstance(measurement, Snapshot):
            ranges = measurement.range
            y = math.sqrt(config.noise_variance) * circular(rng, len(ranges), config.staves)
            for level, floor in enumerate((floors[0][number], floors[1][number])):
                answers = floor.valid & ((level == 0) | in_stretch(ranges))
                power = config.noise_variance * snr(config, ranges) * answers
                sine = np.nan_to_num(np.sin(floor.angle))
                echo = (
                    circular(rng, len(ranges), 1) * rng.exponential(size=(len(ranges), 1)) ** 0.5
                )
                wave = array.steering(sine, config.staves, config.spacing_wavelengths)
                y += np.sqrt(power)[:, None] * echo * wave
            measurement, number = evolve(measurement, iq=y.astype(np.complex64)), number + 1
        made += tracker.process(measurement)
    off, sd, caught, false = [], [], 0, 0
    for estimate, levels in zip(made, zip(*floors)):
        here = in_stretch(levels[0].range)
        pair = estimate.extras['surfaces'] == 2
        caught, false = caught + int((pair & here).sum()), false + int((pair & ~here).sum())
        for end, surface in zip(('', '_2'), levels):
            off.append((estimate.extras[f'pz{end}'] - surface.height)[pair & here])
            sd.append(np.sqrt(estimate.extras[f'vertical_uncertainty{end}'][pair & here]))
    errors, stds = np.concatenate(off), np.concatenate(sd)
    bins = len(made) * int(in_stretch(floors[0][0].range).sum())
    return {
        'bins_two': bins,
        'caught': caught / bins,
        'false': false / sum(len(estimate) for estimate in made),
        'rmse_m': rms(errors),
        'inside': float((np.abs(errors) < 2.0 * stds).mean()),
        'sd_m': float(np.median(stds)),
    }


def in_stretch(ranges: FloatArray) -> BoolArray:
    return np.asarray((ranges >= STRETCH[0]) & (ranges < STRETCH[1]))


def bound(apart: float, decibels: float, staves: int = 8) -> float:
    """Cramer-Rao bound of two heights at `AT` m, RMS of both sd in m, from one bin of normal
    echoes of known power: F_ij = tr(R^-1 R_i R^-1 R_j), R = I + v (a1 a1^H + a2 a2^H)."""
    v = 10.0 ** (0.1 * decibels)

    def covariance(heights: FloatArray) -> FloatArray:
        sine = array.direction_sine(HEIGHT - heights, np.full(2, AT), TILT)
        a = array.steering(sine, staves, 0.5)
        return np.asarray(np.eye(staves) + v * a.T @ a.conj())

    heights, small = np.array([0.0, apart]), 1e-4
    inverse = np.linalg.inv(covariance(heights))
    slopes = [
        inverse @ (covariance(heights + step) - covariance(heights - step)) / (2.0 * small)
        for step in small * np.eye(2)
    ]
    F = np.array([[np.trace(a @ b).real for b in slopes] for a in slopes])
    return float(np.sqrt(np.trace(np.linalg.inv(F)) / 2.0))


def reached(apart: float, decibels: float, pings: int, seed: int) -> dict[str, float]:
    """What the tracker makes of two level surfaces along 60 bins at `AT` m."""
    rng = np.random.default_rng((seed, round(10.0 * apart), round(decibels)))
    ranges = AT + 0.05 * (np.arange(160) - 80)
    at = np.abs(np.arange(160) - 80) < 30
    off, caught = [], 0
    for _ in range(pings):
        y = circular(rng, 160, 8)
        for height in (0.0, apart):
            sine = array.direction_sine(np.full(160, HEIGHT - height), ranges, TILT)
            fading = np.sqrt(10.0 ** (0.1 * decibels) * rng.exponential(size=(160, 1)))
            echo = fading * circular(rng, 160, 1) * array.steering(sine, 8, 0.5)
            y += echo * (at[:, None] | (height == 0.0))
        snapshot = Snapshot(
            stamp_ns=1, range=ranges, iq=y.astype(np.complex64), noise_variance=np.ones(160)
        )
        estimate = tracked(snapshot)
        pair = (estimate.extras['surfaces'] == 2) & at
        caught += int(pair.sum())
        off.append(estimate.state[pair, 0])
        off.append(estimate.extras['height_2'][pair] - apart)
    return {'caught': caught / (pings * at.sum()), 'rmse_m': rms(np.concatenate(off))}


def oversampled(times: int, pings: int, seed: int) -> dict[str, float]:
    """Bins marked beside ledges and on a flat floor, where a pulse spans `times` bins: samples
    between bins are interpolated with their band, judged are the bins themselves."""
    double = caught = single = lost = 0
    for snapshot, facets in objects('ledge', pings, seed, {}):
        marked = finer(snapshot, times).extras['existence_2'][::times] > GATE
        power, height = surfaces_of(facets, len(snapshot))
        two, one = second_of(power, height)[0] >= 2, (power > 0.0).sum(axis=1) == 1
        double, caught = double + int(two.sum()), caught + int((marked & two).sum())
        single, lost = single + int(one.sum()), lost + int((marked & one).sum())
    flat = simulate(scenario('thermal', {'patch_std': 0.0, 'pings': pings}), seed).measurements
    marks = [finer(item.measurement, times).extras['existence_2'] > GATE for item in flat]
    row = {'caught': caught / double, 'lost': lost / single}
    return {**row, 'lost_flat': float(np.mean(marks))}


def finer(snapshot: Snapshot, times: int) -> Estimate:
    """The estimate of a snapshot with so many times as many bins."""
    bins, width = len(snapshot), snapshot.range[1] - snapshot.range[0]
    assert snapshot.noise_variance is not None
    return tracked(
        evolve(
            snapshot,
            range=snapshot.range[0] + width / times * np.arange(bins * times),
            iq=resample(snapshot.iq, bins * times, axis=0).astype(np.complex64),
            noise_variance=np.repeat(snapshot.noise_variance, times),
        )
    )


def main(pings: int = 40, seed: int = 7) -> Parts:
    yield {'pings': pings, 'seed': seed}
    yield {'cost': bench_layover()}
    stated: list[FloatArray] = []
    true: list[BoolArray] = []
    for name, changes in SETTINGS.items():
        ranges: list[FloatArray] = []
        pair: list[BoolArray] = []
        for kind in SIZES:
            tally = Tally()
            for snapshot, facets in objects(kind, pings, seed, changes):
                tally.add(snapshot.range, tracked(snapshot), facets)
            yield {'objects': {f'{kind}, {name}': tally.row()}}
            stated, true = stated + tally.stated, true + tally.true
            ranges, pair = ranges + tally.ranges, pair + tally.pair
        for band, row in by_range(ranges, pair).items():
            yield {'ranges': {f'{name}, {band}': row}}
    for name, row in calibration(np.concatenate(stated), np.concatenate(true)):
        yield {'existence': {name: row}}
    for kind in SIZES:
        yield {'ship': {kind: below_ship(kind, pings, seed)}}
    for name in ('moving', 'moving_profile'):
        for up in (1.0, 2.0, 4.0):
            row = two_levels(name, up, max(pings // 4, 1), seed)
            yield {'rays': {f'{name}, {up:g} m': row}}
    for decibels in RATIOS:
        for apart in APART:
            name = f'{decibels:g} dB, {apart:g} m'
            row = reached(apart, decibels, max(pings // 4, 1), seed)
            yield {'bound': {name: {'one_bin_m': bound(apart, decibels), **row}}}
    for times in (1, 2, 4):
        row = oversampled(times, max(pings // 2, 1), seed)
        yield {'oversampled': {f'{times} bins per pulse': row}}
    for name in FLAT:
        yield {'floors': {name: floors(name, pings, seed)}}


if __name__ == '__main__':
    study(main)
