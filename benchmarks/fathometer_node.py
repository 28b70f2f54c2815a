# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pressure and cross-spectra through the live node, in lock-step, over the same floors.

    python -m benchmarks.fathometer_node --runs 8 --out docs/results/fathometer_node.json

Each run is the scene ``pressure`` (12 records of 8 s, 16 hydrophones, as the recording that is
shipped) three times: as pressure; as cross-spectra that are computed here, by numpy, from that
pressure as the recording has it; and as cross-spectra drawn from the model over the same floor.
Each recording is tracked offline and played to the real node, as ``sonar-imm check`` does.

`node = offline`: runs whose estimates have the same bytes. P is the share of records whose number
of reflectors is right, OSPA of second order with a cutoff of 2 m, both with their standard error
over the runs, and the difference to pressure run by run. `response apart`: the largest difference
of the depth responses of pressure and of its cross-spectra, in units of their noise; `same number`
and `depths apart` compare what the node made of both, record by record.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.study import Parts, standard_error, study
from msg_adapters.array_records import read_pressure
from sonar_imm.acoustics.spectra import effective_snapshots
from sonar_imm.measurements import CrossSpectra, Pressure
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm.truth import Received, Scene
from sonar_imm_tools.cli.checking import CheckedRecording, play_recording
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.own_files import unusual
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.scenes import write_scene
from sonar_imm_tools.simulation.fathometer.scenario import drift_of, FathometerScenario
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, scenario, simulate

KINDS = ('pressure', 'its cross-spectra', 'cross-spectra drawn')
MIRROR: dict[str, Any] = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
"""Automatic snapshots of pressure use this noise window by themselves."""


def read_back(bag: Path) -> list[Pressure]:
    with BagReader(bag) as reader:
        return [read_pressure(item.message) for item in reader.messages(['/pressure'])]


def spectra_of(
    blocks: list[Pressure], config: FathometerScenario, length: int
) -> list[CrossSpectra]:
    """The cross-spectra of each record from its pressure: Hann windows of `length` samples that
    overlap by half, as many to a record as fit. No code of the tracker."""
    rate, hop = config.sample_rate, length // 2
    # Snapshots follow each other across records, so that records are whole hops long.
    count = round(config.record_seconds * rate / hop)
    size = count * hop
    pressure = np.concatenate([block.pressure for block in blocks]).astype(np.float64)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    rows = np.arange(
        np.ceil(config.frequency_min * length / rate),
        np.floor(config.frequency_max * length / rate) + 1.0,
    ).astype(int)
    found = []
    for k in range(len(pressure) // size):
        starts = [k * size + hop * n for n in range(count - 1)]
        x = np.stack(
            [np.fft.rfft(window[:, None] * pressure[s : s + length], axis=0)[rows] for s in starts]
        )
        # The block in which the last snapshot of the record ends.
        last = blocks[((k + 1) * size - 1) * len(blocks) // len(pressure)]
        found.append(
            CrossSpectra(
                stamp_ns=last.stamp_ns,
                frame_id=last.frame_id,
                frequency=rows * rate / length,
                csdm=np.einsum('sfi,sfj->fij', x, x.conj()) / len(x),
                snapshots=len(x),
                reference_depth=last.reference_depth,
            )
        )
    return found


def drawn(config: FathometerScenario, seed: int, length: int) -> list[CrossSpectra]:
    """Cross-spectra drawn frequency by frequency over the floor of that seed."""
    floor = drift_of(config, np.random.default_rng(seed))
    seconds = length / config.sample_rate
    worth = effective_snapshots('hann', 0.5, int(2.0 * config.record_seconds / seconds) - 1)
    as_spectra = evolve(
        config, level='csdm', snapshot_seconds=seconds, snapshots=round(0.5 * worth)
    )
    rng = np.random.default_rng([seed, 1])
    return [
        cross_spectra(as_spectra, floor, k, float(floor.array_depth_stated[k]), rng)
        for k in range(config.records)
    ]


def responses(measurements: list[Any], config: FathometerConfig) -> list[np.ndarray]:
    """Depth responses in units of their noise."""
    tracker, found = FathometerTracker(evolve(config, particles=2)), []
    for measurement in measurements:
        if tracker.process(measurement):
            assert tracker.response is not None
            found.append(tracker.response.amplitude / tracker.response.sigma)
    return found


def run(seed: int, folder: Path) -> dict[str, dict[str, float]]:
    config = scenario('pressure')
    stated = {**config.instruments(), 'pulse': 'band'}
    scene = simulate(config, seed)
    bags = [folder / kind.replace(' ', '_') for kind in KINDS]
    settings = FathometerConfig.from_mapping(stated)
    write_scene(scene, bags[0], provenance={}, parameters=parameters(stated))
    blocks = read_back(bags[0])
    tracker = FathometerTracker(evolve(settings, particles=2))
    for block in blocks:
        if tracker.process(block):
            break
    assert tracker.response is not None
    length = round(tracker.response.snapshot_seconds * config.sample_rate)
    computed = spectra_of(blocks, config, length)
    for bag, records in zip(bags[1:], (computed, drawn(config, seed, length))):
        received = tuple(Received(record.stamp_ns, record) for record in records)
        other = Scene(received, scene.truth, frame_id=scene.frame_id)
        write_scene(other, bag, provenance={}, parameters=parameters({**stated, **MIRROR}))
    checked = {
        kind: play_recording(bag, 'fathometer', folder / f'{bag.name}_run', quiet=True).judged()
        for kind, bag in zip(KINDS, bags)
    }
    rows = {kind: scores(recording) for kind, recording in checked.items()}
    both = responses(blocks, settings), responses(computed, evolve(settings, **MIRROR))
    rows[KINDS[1]]['response apart'] = float(
        max(np.abs(a - b).max() for a, b in zip(*both, strict=True))
    )
    live = [RunFolder(checked[kind].folder / 'live').read_estimates() for kind in KINDS[:2]]
    same, apart = [], []
    for a, b in zip(*live, strict=True):
        same.append(len(a) == len(b))
        if same[-1]:
            apart.append(np.abs(a.state[:, 0] - b.state[:, 0]).max(initial=0.0))
    rows[KINDS[1]] |= {'same number': float(np.mean(same)), 'depths apart': float(max(apart))}
    return rows


def parameters(stated: dict[str, Any]) -> dict[str, Any]:
    return {'fathometer': unusual(stated, FathometerConfig)}


def scores(checked: CheckedRecording) -> dict[str, float]:
    answered, equal, ended = (check.good for check in checked.checks[:3])
    metrics = checked.judgement.metrics
    return {
        'node = offline': float(answered and equal and ended),
        'P': metrics['order_right'],
        'OSPA': metrics['ospa_m'],
    }


def summary(runs: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    table: dict[str, dict[str, float]] = {}
    for kind in KINDS:
        row = {'runs': float(len(runs))}
        for key in runs[0][kind]:
            values = np.array([row[kind][key] for row in runs])
            if key in ('P', 'OSPA'):
                row |= {key: values.mean(), f'{key}, s.e.': standard_error(values)}
                off = values - [row['pressure'][key] for row in runs]
                row |= {f'{key} - pressure': off.mean(), f'{key} off, s.e.': standard_error(off)}
            else:
                row[key] = values.max() if 'apart' in key else values.mean()
        table[kind] = {key: float(value) for key, value in row.items()}
    return table


def main(runs: int = 8, seed: int = 100) -> Parts:
    found = []
    for number in range(seed, seed + runs):
        with TemporaryDirectory() as folder:
            found.append(run(number, Path(folder)))
        print(number, found[-1], flush=True)
    yield {'seed': seed, 'table': summary(found)}


if __name__ == '__main__':
    study(main, seed={'help': 'of the first run'})
