# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bins with two surfaces: how many are gated, and how many bins of one surface are lost.

    python -m benchmarks.bathymetry_layover --out docs/results/bathymetry_layover.json

Each ping has an object of its own, at 22 to 60 m: a ledge of .8 to 3 m, a box of 1 to 4 m, a wall
of 2 to 6 m or a boulder of .6 to 2 m radius; or none. A bin has two surfaces if the second one
lies .5 m or more beside the strongest, at most 15 dB below it and at 0 dB or more at a stave; it
has one if no other answers. `soundings`: share of the bins with two that become soundings, of
these `near`: inside two standard deviations of a surface, and `rmse` to the nearest; with layover
ignored where it says so, else gated. `ranges`: the share of those with two that are caught, of all
objects, by the slant range of the bin.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.bathymetry_paper import EXACT_ARRAY
from benchmarks.study import Parts, study
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.objects import (
    Facets,
    facets_of,
    second_of,
    surfaces_of,
)
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr

SIZES = {'ledge': (0.8, 3.0), 'box': (1.0, 4.0), 'wall': (2.0, 6.0), 'boulder': (0.6, 2.0)}
FAINT = {'snr_near_db': 20.0, 'snr_far_db': 0.0}
THERMAL = {'noise_fades': False}
BANDS = ((17.0, 30.0), (30.0, 40.0), (40.0, 50.0), (50.0, 77.0))
SETTINGS: dict[str, dict[str, Any]] = {
    '8 staves, 30-10 dB': {},
    '8 staves, 20-0 dB': FAINT,
    '4 staves, 30-10 dB': {'staves': 4},
    '2 staves, 30-10 dB': {'staves': 2},
    '0.5 % differ': {'decorrelation': 0.005},
    '2 % differ': {'decorrelation': 0.02},
}
FLAT: dict[str, tuple[str, dict[str, Any]]] = {
    'flat': ('thermal', {'patch_std': 0.0}),
    'flat, 20-0 dB': ('thermal', {'patch_std': 0.0, **FAINT}),
    'white patch': ('thermal', {}),
    'patch over 1 m': ('correlated', THERMAL),
    'noise that fades': ('paper', {}),
    'slope .1': ('slope', THERMAL),
    'undulation .5 m in 15 m': ('undulating', THERMAL),
    'spikes': ('spikes', THERMAL),
    'shadows': ('shadow', THERMAL),
    'noise not stated': ('thermal', {'state_noise': False}),
    'noise from the water column': ('water_column', THERMAL),
    '0.5 % differ': ('thermal', {'decorrelation': 0.005}),
    '2 staves': ('thermal', {'staves': 2}),
    '4 staves': ('thermal', {'staves': 4}),
    'surface echoes, not told': ('multipath', THERMAL),
    'surface echoes at -10 dB, not told': ('multipath', {'multipath_level_db': -10.0, **THERMAL}),
}


class Bins:
    """Counts over pings."""

    def __init__(self) -> None:
        self.double = self.caught = self.single = self.lost = self.kept = 0
        self.ignored = self.near_ignored = 0
        self.error_ignored = 0.0
        self.ranges: list[FloatArray] = []
        self.marked: list[BoolArray] = []


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


def count(bins: Bins, snapshot: Snapshot, facets: Facets) -> None:
    """Add what both settings make of one ping."""
    power, height = surfaces_of(facets, len(snapshot))
    number, _, _ = second_of(power, height)
    double, single = number >= 2, (power > 0.0).sum(axis=1) == 1
    estimates = []
    for value in ('gated', 'ignored'):
        config = BathymetryConfig(layover=value, seed=1, **EXACT_ARRAY)
        (estimate,) = BathymetryTracker(config).process(snapshot)
        estimates.append(estimate)
    gated, ignored = (estimate.extras['valid'] > 0 for estimate in estimates)
    sd = np.sqrt(estimates[0].covariance[:, 0, 0])
    with np.errstate(invalid='ignore'):
        off = np.abs(height - estimates[0].state[:, :1])
    nearest = np.nanmin(np.where(power > 0.0, off, np.inf), axis=1)
    marked = estimates[0].extras['surfaces'] == 2
    bins.double, bins.single = bins.double + int(double.sum()), bins.single + int(single.sum())
    bins.caught += int((marked & double).sum())
    bins.lost += int((marked & single).sum())
    bins.ranges.append(snapshot.range[double])
    bins.marked.append(marked[double])
    bins.kept += int((gated & double).sum())
    bins.ignored += int((ignored & double).sum())
    bins.near_ignored += int((nearest < 2.0 * sd)[ignored & double].sum())
    bins.error_ignored += float(np.square(nearest[ignored & double]).sum())


def shares(bins: Bins) -> dict[str, float]:
    """The row of a table."""
    return {
        'bins_two': bins.double,
        'caught': bins.caught / bins.double,
        'lost': bins.lost / bins.single,
        'soundings': bins.kept / bins.double,
        'soundings_ignored': bins.ignored / bins.double,
        'near_ignored': bins.near_ignored / bins.ignored,
        'rmse_ignored_m': float(np.sqrt(bins.error_ignored / bins.ignored)),
    }


def by_range(
    ranges: Sequence[FloatArray], caught: Sequence[BoolArray]
) -> dict[str, dict[str, float]]:
    """Of bins with two surfaces, at slant ranges and caught or not, how many are, by range."""
    at, found = np.concatenate(ranges), np.concatenate(caught)
    table = {}
    for low, high in BANDS:
        here = (at >= low) & (at < high)
        row = {'bins_two': int(here.sum()), 'caught': float(found[here].mean())}
        table[f'{low:g} to {high:g} m'] = row
    return table


def lost(name: str, pings: int, seed: int) -> dict[str, float]:
    """Bins of a floor without objects that are gated, and the worst ping."""
    scene_name, changes = FLAT[name]
    config = scenario(scene_name, {'pings': pings, **changes})
    values = {**config.instruments(), **EXACT_ARRAY, 'layover': 'gated'}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    parts = []
    for item in simulate(config, seed).measurements:
        (estimate,) = tracker.process(item.measurement)
        parts.append(float((estimate.extras['surfaces'] == 2).mean()))
    return {'lost': float(np.mean(parts)), 'worst_ping': max(parts)}


def main(pings: int = 40, seed: int = 1) -> Parts:
    yield {'pings': pings, 'seed': seed}
    for name, changes in SETTINGS.items():
        ranges: list[FloatArray] = []
        marked: list[BoolArray] = []
        for kind in SIZES:
            bins = Bins()
            for ping in objects(kind, pings, seed, changes):
                count(bins, *ping)
            yield {'objects': {f'{kind}, {name}': shares(bins)}}
            ranges, marked = ranges + bins.ranges, marked + bins.marked
        for band, row in by_range(ranges, marked).items():
            yield {'ranges': {f'{name}, {band}': row}}
    for name in FLAT:
        yield {'floors': {name: lost(name, pings, seed)}}


if __name__ == '__main__':
    study(main)
