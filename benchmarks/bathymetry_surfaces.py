# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bins with two surfaces: how many are gated, which are resolved, and how many bins of one surface
are lost.

    python -m benchmarks.bathymetry_surfaces --out docs/results/bathymetry_surfaces.json

Each ping has an object of its own, at 22 to 60 m: a ledge of .8 to 3 m, a box of 1 to 4 m, a wall
of 2 to 6 m or a boulder of .6 to 2 m radius; or none. A bin has two surfaces if the second one
lies .5 m or more beside the strongest, at most 15 dB below it and at 0 dB or more at a stave; it
has one if no other answers. `gated` and `resolved`: what `layover` is.

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

from collections.abc import Iterator, Mapping
from typing import Any

from attrs import evolve
import numpy as np
from scipy.signal import resample

from benchmarks.bathymetry_paper import EXACT_ARRAY
from benchmarks.study import Parts, rms, study
from sonar_imm.acoustics.layover import GATE
from sonar_imm.estimates import Estimate
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
FLOORS: dict[str, tuple[str, dict[str, Any]]] = {
    'flat': ('thermal', {'patch_std': 0.0}),
    'white patch': ('thermal', {}),
    'noise that fades': ('paper', {}),
    'undulation .5 m in 15 m': ('undulating', THERMAL),
    'spikes': ('spikes', THERMAL),
    'noise not stated': ('thermal', {'state_noise': False}),
    'surface echoes at -10 dB, not told': ('multipath', {'multipath_level_db': -10.0, **THERMAL}),
}


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
    scene_name, changes = FLOORS[name]
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


def main(pings: int = 40, seed: int = 7) -> Parts:
    yield {'pings': pings, 'seed': seed}
    for layover in ('gated', 'resolved'):
        for name, changes in SETTINGS.items():
            if layover == 'resolved' and changes.get('staves') == 2:
                continue  # two staves mark such bins, and cannot tell the surfaces apart
            every = []
            for kind in SIZES:
                parts = [bins_of(*ping, layover) for ping in objects(kind, pings, seed, changes)]
                bins = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
                yield {layover: {f'{kind}, {name}': row_of(bins)}}
                every.append(bins)
            at, caught = (
                np.concatenate([bins[key] for bins in every]) for key in ('range', 'caught')
            )
            for band, row in by_range(at, caught):
                yield {f'{layover}, ranges': {f'{name}, {band}': row}}
        for name in FLOORS:
            yield {f'{layover}, floors': {name: marked_floor(name, layover, pings, seed)}}
    for times in (1, 2, 4):
        row = oversampled(times, max(pings // 2, 1), seed)
        yield {'oversampled': {f'{times} bins per pulse': row}}


if __name__ == '__main__':
    study(main)
