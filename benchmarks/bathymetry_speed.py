# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bins of bathymetry per second of CPU time, every number from one run.

    python -m benchmarks.bathymetry_speed --out docs/results/bathymetry_speed.json

Whole `process` of a ping of 2000 bins and 8 staves in complex64, best of some rounds in turn:
particles and grid, at rest and on a ship that moves, with straight and with bent rays, without and
with the test for a second surface; and other models and sizes at rest. `numpy` is the same filter,
bin by bin.
"""

from __future__ import annotations

from functools import partial
import time
from typing import Any

from benchmarks.bathymetry_paper import WALKS
from benchmarks.speed.bathymetry import a_ping, cut, numpy_filter, PEER_BINS, rates, Timed
from benchmarks.study import Parts, study
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

ENGINES: dict[str, dict[str, Any]] = {
    'terrain': {},
    'particles': WALKS,
    'grid': {**WALKS, 'engine': 'grid'},
}
SCENES = {'at rest': 'paper', 'moving': 'moving', 'moving, bent rays': 'moving_profile'}
LAYOVERS = ('ignored', 'gated')
SIZES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    'grid, forward-backward': ({**WALKS, 'engine': 'grid', 'smoothing': 'states'}, {}),
    'height_bank': ({'model_set': 'height_bank'}, {}),
    'scatter_bank': ({'model_set': 'scatter_bank'}, {}),
    '1000 particles': ({**WALKS, 'particles_per_model': 1000}, {}),
    'four walks': ({'model_set': 'height_bank', 'engine': 'particles'}, {}),
    '2 staves': (WALKS, {'staves': 2}),
    '32 staves': (WALKS, {'staves': 32}),
}


def methods_of(scene_name: str) -> dict[str, Timed]:
    """Every engine on one ping of a scene, by name and layover."""
    config = scenario(scene_name, {'pings': 1, 'last_range': 117.0})
    measurements = [item.measurement for item in simulate(config, 1).measurements]
    ping = next(item for item in measurements if isinstance(item, Snapshot))
    inputs = frozenset({'snapshot', 'nav'} if config.moving else {'snapshot'})
    methods: dict[str, Timed] = {}
    for name, values in ENGINES.items():
        for layover in LAYOVERS:
            known = {**config.instruments(), **values, 'layover': layover}
            tracker = BathymetryTracker(BathymetryConfig.from_mapping(known).for_inputs(inputs))
            for measurement in measurements:
                if measurement is not ping:
                    tracker.process(measurement)
            methods[f'{name}|{layover}'] = partial(tracker.process, ping), len(ping)
    return methods


def sizes() -> dict[str, Timed]:
    """Other models and sizes, at rest, without layover; and plain numpy."""
    methods: dict[str, Timed] = {}
    for name, (values, changes) in SIZES.items():
        ping = a_ping(**changes)
        tracker = BathymetryTracker(BathymetryConfig(layover='ignored', **values))
        methods[name] = partial(tracker.process, ping), len(ping)
    short = cut(a_ping(), PEER_BINS)
    return {**methods, 'numpy, bin by bin': (partial(numpy_filter, short), PEER_BINS)}


def main(rounds: int = 5) -> Parts:
    yield {'rounds': rounds}
    for title, scene_name in SCENES.items():
        speed = rates(methods_of(scene_name), rounds, clock=time.process_time)
        for name in ENGINES:
            row = {layover: speed[f'{name}|{layover}'] for layover in LAYOVERS}
            yield {'scenes': {f'{title}, {name}': row}}
    speed = rates(sizes(), rounds, clock=time.process_time)
    yield {'sizes': {name: {'ignored': value} for name, value in speed.items()}}


if __name__ == '__main__':
    study(main, digits=0)
