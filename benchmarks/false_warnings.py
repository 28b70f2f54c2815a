# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How often trackers warn that the sensor's word cannot be true: of true words, and of false ones.

    python -m benchmarks.false_warnings --out docs/results/false_warnings.json
    python -m benchmarks.false_warnings --bags diver_table1 --first-seed 1000

The scene of every shipped recording is simulated anew with other seeds, and tracked with true
standard deviations, with twice those, and with half, where somebody states them. Images go
through the detector. Told are the warnings raised (through the hysteresis of diagnostics, one
message being one period), in how much sensor time, and the share of the runs in which there was
one. Rows that are in the file already are not made again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from attrs import evolve
import yaml

from benchmarks.study import known, Parts, study
from sonar_imm.measurements import (
    Arrivals,
    Detections,
    Fix,
    Measurement,
    Snapshot,
    SonarImage,
    Trace,
)
from sonar_imm.nodes.diagnostics import Finding, Hysteresis, WARN
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.simulation.obstacle.simulator import ObstacleScenario

FIRST_SEED = 70_000
"""Bounds were looked for with seeds from 1000 on: these are others."""
RUNS = {
    'bathymetry_ship': 10,
    'diver_table1': 60,
    'fathometer_array': 10,
    'fathometer_drift': 4,
    'fathometer_pressure': 3,
    'obstacle_images': 20,
    'obstacle_stress': 60,
}
USUAL_RUNS = 40
FACTORS = (1.0, 2.0, 0.5)
SCALED = {
    Arrivals: ('var_toa', 'var_bearing'),
    Detections: ('var_range', 'var_bearing'),
    Fix: ('covariance',),
    Snapshot: ('noise_variance',),
    Trace: ('sigma',),
}
"""What a measurement states of its noise; variances, but for `sigma`."""
STATED = {'obstacle': ('range_std', 'bearing_std_deg')}
"""Parameters that state noise where the measurements of the scenes do not."""
MEASURED = ('fathometer_array', 'fathometer_pressure')
"""Scenes where nobody states the noise, because the tracker measures it."""


def misstated(measurement: Any, factor: float) -> Any:
    """The measurement, which states `factor` times its standard deviations."""
    changes = {}
    for name in SCALED.get(type(measurement), ()):
        value = getattr(measurement, name)
        if value is not None:
            changes[name] = value * (factor if name == 'sigma' else factor**2)
    return evolve(measurement, **changes) if changes else measurement


def detected(setting: ObstacleScenario, given: list[Measurement]) -> list[Measurement]:
    """The measurements of a scene with detections in place of its images."""
    feeder = setting.feeder_instruments()
    detector = ImageDetector(
        DetectorConfig(
            beam_width_deg=feeder['beam_width_deg'], range_resolution=feeder['range_resolution']
        )
    )
    found = [detector.process(item) if isinstance(item, SonarImage) else item for item in given]
    return [item for item in found if item is not None]


def scene_of(bag: Path) -> tuple[str, str, dict[str, Any]]:
    """The system, the scenario and its changed values, of a recording we simulated."""
    text = (bag / 'metadata.yaml').read_text(encoding='utf-8')
    notes = yaml.safe_load(text)['rosbag2_bagfile_information']['custom_data']
    system, name = notes['source'].removeprefix('simulated: ').split()
    changes = {k[4:]: yaml.safe_load(f'[{v}]') for k, v in notes.items() if k.startswith('set ')}
    scenes = import_module(SYSTEMS[system].scenes)
    specs = {spec.name: spec.kind for spec in type(scenes.scenario(name, {})).specs()}
    lists = {key for key, kind in specs.items() if kind.endswith('[]')}
    return system, name, {k: tuple(v) if k in lists else v[0] for k, v in changes.items()}


def runs(bag: Path, factor: float, seeds: range) -> Iterator[tuple[float, int]]:
    """Hours and warnings of each run."""
    system, name, changes = scene_of(bag)
    scenes = import_module(SYSTEMS[system].scenes)
    setting = scenes.scenario(name, changes)
    config = load_config(SYSTEMS[system], own_parameters(bag), {})[0]
    stated = {name: factor * getattr(config, name) for name in STATED.get(system, ())}
    tracker = SYSTEMS[system].build(evolve(config, **stated))
    for seed in seeds:
        items = scenes.simulate(setting, seed).measurements
        measurements = [i.measurement for i in sorted(items, key=lambda i: i.received_ns)]
        if any(isinstance(item, SonarImage) for item in measurements):
            measurements = detected(setting, measurements)
        tracker.reset()
        hysteresis, raised = Hysteresis(), 0
        active: set[str] = set()
        for measurement in measurements:
            tracker.process(misstated(measurement, factor))
            texts: list[str] = getattr(tracker, 'warnings', list)()
            heard = [type(measurement).__name__]
            found = hysteresis.settle([Finding(text[:20], WARN, text) for text in texts], heard)
            raised += len({finding.key for finding in found} - active)
            active = {finding.key for finding in found}
        stamps = [measurement.stamp_ns for measurement in measurements]
        yield (max(stamps) - min(stamps)) / 3.6e12, raised


def row(bag: Path, factor: float, seeds: range) -> dict[str, float]:
    """One row of the table."""
    found = list(runs(bag, factor, seeds))
    hours, raised = (sum(column) for column in zip(*found))
    return {
        'stated': factor,
        'runs': len(found),
        'minutes': 60.0 * hours,
        'warnings': raised,
        'share': sum(count > 0 for _, count in found) / len(found),
    }


def main(
    runs: int | None = None,
    first_seed: int = FIRST_SEED,
    bags: Sequence[str] = (),
    out: Path | None = None,
) -> Parts:
    yield (rows := known(out))
    for bag in sorted(Path('bags').iterdir()):
        if not bag.is_dir() or (bags and bag.name not in bags):
            continue
        seeds = range(first_seed, first_seed + (runs or RUNS.get(bag.name, USUAL_RUNS)))
        for factor in (1.0,) if bag.name in MEASURED else FACTORS:
            if (name := f'{bag.name} {factor:g}') not in rows:
                yield {name: row(bag, factor, seeds)}


if __name__ == '__main__':
    study(main, runs={'type': int, 'help': 'for each recording, instead of its usual number'})
