# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which pulse: that of the band, or what the processor makes of each record.

    python -m benchmarks.fathometer_pulse --out docs/results/fathometer_pulse.json

Scenes as cross-spectra, tracked with either pulse and either polarity. ``drift``: the drift of
the paper, 32 hydrophones, seven to nine layers, MVDR (a quarter of the snapshot with four times as
many, which says as much and is made four times as fast). ``strong`` and ``signed``: 16 hydrophones
(as in `fathometer_sea`), 100 snapshots, six layers of 7 to 34 sigma, in ``signed`` two of them
negative; ``strong 32`` and ``signed 32`` under the array of the drift; a tenth as many records for
each run. What is in the file already is kept. P is the share of records whose number of
reflectors is right; OSPA of second order with a cutoff of 2 m; wrong signs per record. The first
five records are not scored.

``ghosts``: what a response without any noise holds besides the layers, in units of one record's
noise: the matrices are the exact ones, the layers are fitted with either pulse and taken off, and
the largest peaks further than 0.4 m from any layer are listed, each with the nearest place
z_i + z_j - z_k. MVDR is no linear function of the matrices, so that echoes that interfere beat.
Then, with the strongest layer alone, what its echo leaves by distance, its phase left in and taken
off. Then the exact echo of one layer (what changes with the sign of its amplitude) beside the
pulses of processor and band, by distance, and how much of it there is in each octave, against W,
as it is ('all noise') and with the share of the surface only ('processor').
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from attrs import evolve
import numpy as np

from benchmarks import fathometer_paper
from benchmarks.study import known, mean_of, Parts, rms, standard_error, study
from sonar_imm.acoustics.fathometer import (
    coherence_and_power,
    echo_spectrum,
    steering,
    surface_share,
)
from sonar_imm.acoustics.pulse import band_pulse, Pulse
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import CrossSpectra
from sonar_imm.trackers.fathometer.response import array_response, lattice_of_array
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.field import expected_csdm
from sonar_imm_tools.simulation.fathometer.scenario import Drift, drift_of
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    FathometerScenario,
    scenario,
)

DEPTHS = np.array([52.0, 55.2, 58.5, 61.7, 66.0, 69.3])
STRENGTHS = np.array([0.35, 0.3, 0.25, 0.22, 0.2, 0.15])
SIGNS = {'strong': np.ones(6), 'signed': np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0])}
SCENES = {'strong': 16, 'signed': 16, 'strong 32': 32, 'signed 32': 32, 'drift': 32}
"""Hydrophones of each."""
UNSCORED = 5


def records_of(
    config: FathometerScenario, floor: Drift, rng: np.random.Generator
) -> Iterator[tuple[CrossSpectra, np.ndarray, np.ndarray]]:
    """Cross-spectra, true depths and true amplitudes of each record."""
    for record in range(config.records):
        depth = float(floor.array_depth_stated[record])
        here = floor.present[record]
        spectra = cross_spectra(config, floor, record, depth, rng)
        yield spectra, floor.depth[record, here], floor.amplitude[record, here]


def drift(seed: int, records: int) -> tuple[FathometerScenario, Drift, np.random.Generator]:
    scale = records / 300
    config = FathometerScenario(
        records=records,
        snapshot_seconds=0.35,
        snapshots=256,
        appearing=(int(140 * scale), int(262 * scale)),
        fading=(int(85 * scale),),
    )
    rng = np.random.default_rng(seed)
    return config, drift_of(config, rng), rng


def layers(
    seed: int, records: int, signs: np.ndarray, hydrophones: int = 16
) -> tuple[FathometerScenario, Drift, np.random.Generator]:
    """The six layers under 16 hydrophones, or 80 m deeper and weaker under the 32 of the drift."""
    changes: dict[str, Any] = {
        'level': 'csdm',
        'records': records,
        'snapshots': 100,
        'snapshot_seconds': 0.35,
    }
    config, first, strength = scenario('pressure', changes), DEPTHS, STRENGTHS
    if hydrophones == 32:
        config = FathometerScenario(**{**changes, 'snapshots': 256})
        first, strength = DEPTHS + 80.0, 0.4 * STRENGTHS
    rng = np.random.default_rng(seed)
    depth = first + np.cumsum(0.05 * rng.standard_normal((records, 6)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, records)
    stated = array + config.array_depth_std * rng.standard_normal(records)
    amplitude = np.tile(signs * strength, (records, 1))
    return config, Drift(depth, amplitude, amplitude != 0.0, array, stated), rng


def run(
    name: str,
    seed: int,
    records: int,
    particles: int,
    pulses: Sequence[str],
    polarities: Sequence[str] = ('positive', 'both'),
) -> dict[str, dict[str, float]]:
    """Scores of each of `pulses` and `polarities`."""
    if name == 'drift':
        config, floor, rng = drift(seed, records)
    else:
        config, floor, rng = layers(seed, records, SIGNS[name.split()[0]], SCENES[name])
    settings = dict(config.instruments())
    settings |= {'window': 'rectangular', 'overlap': 0.0, 'particles': particles, 'seed': seed}
    settings |= {'depth_min': config.depth_min, 'depth_max': config.depth_max}
    settings |= {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
    trackers = {
        f'{name}, {pulse}, {polarity}': FathometerTracker(
            FathometerConfig(**settings, pulse=pulse, polarity=polarity)
        )
        for pulse in pulses
        for polarity in polarities
    }
    scores: dict[str, list[list[float]]] = {label: [] for label in trackers}
    for spectra, depth, amplitude in records_of(config, floor, rng):
        for label, tracker in trackers.items():
            (found,) = tracker.process(spectra)
            scores[label].append(_score(found, depth, amplitude))
    names = ('P', 'OSPA', 'depth RMS', 'wrong signs')
    return {
        label: {
            key: float(
                np.sqrt(np.nanmean(np.square(column)))
                if key == 'depth RMS'
                else np.nanmean(column)
            )
            for key, column in zip(names, np.array(each[UNSCORED:]).T)
        }
        for label, each in scores.items()
    }


class Exact(NamedTuple):
    """Exact cross-spectra of some of the layers of ``strong``, seen by the tracker: depth (n,) of
    the layers, z (m,), and responses (m,) in units of one record's noise with the phase of echoes
    left in and taken off; the pulse of the processor."""

    depth: np.ndarray
    z: np.ndarray
    plain: np.ndarray
    turned: np.ndarray
    pulse: Pulse

    def left(self, seen: np.ndarray, pulse: Pulse) -> np.ndarray:
        """`seen` (m,) without the layers, fitted with `pulse` at the nearest cells."""
        at = np.abs(self.z[:, None] - self.depth).argmin(axis=0)
        a = np.linalg.solve(pulse(self.z[at][:, None] - self.z[at]), seen[at])
        return np.asarray(seen - pulse(self.z[:, None] - self.z[at]) @ a)


def seen_exactly(count: int, **changes: Any) -> Exact:
    """The first `count` layers, with these parameters changed."""
    config, floor, rng = layers(0, 1, SIGNS['strong'])
    floor = evolve(floor, depth=DEPTHS[None], array_depth=np.array([config.array_depth]))
    there = Drift(
        floor.depth[:, :count],
        floor.amplitude[:, :count],
        floor.present[:, :count],
        floor.array_depth,
        floor.array_depth_stated,
    )
    first = np.ceil(config.frequency_min * config.snapshot_seconds)
    last = np.floor(config.frequency_max * config.snapshot_seconds)
    frequency = np.arange(first, last + 1.0) / config.snapshot_seconds
    exact = CrossSpectra(
        stamp_ns=1, frequency=frequency, csdm=expected_csdm(config, there, 0, frequency)
    )
    settings = {k: v for k, v in config.instruments().items() if k not in ('window', 'overlap')}
    settings |= {'depth_min': config.depth_min, 'depth_max': config.depth_max}
    settings |= {'noise_depth_min': 0.0, 'noise_depth_max': 0.0, **changes}
    tracked = FathometerConfig(**settings, pulse='processor')
    lattice = lattice_of_array(config.array_depth, tracked)
    response = array_response(exact, lattice, tracked, config.array_depth)
    plain = array_response(exact, lattice, evolve(tracked, pulse='band'), config.array_depth)
    drawn = cross_spectra(config, floor, 0, config.array_depth, rng)
    sigma = float(array_response(drawn, lattice, tracked, config.array_depth).sigma[0])
    assert response.pulse is not None
    return Exact(
        there.depth[0],
        response.depth,
        plain.amplitude / sigma,
        response.amplitude / sigma,
        response.pulse,
    )


def peaks_beside() -> dict[str, list[dict[str, float]]]:
    """The largest peaks beside the layers of ``strong``, by pulse."""
    exact, config = seen_exactly(len(DEPTHS)), scenario('pressure')
    triples = (DEPTHS[:, None, None] + DEPTHS[:, None] - DEPTHS).ravel()
    band = band_pulse(config.frequency_min, config.frequency_max, config.sound_speed)
    found = {}
    for name, pulse, seen in (
        ('band', band, exact.plain),
        ('processor', exact.pulse, exact.turned),
    ):
        left = exact.left(seen, pulse)
        left[np.abs(exact.z[:, None] - DEPTHS).min(axis=1) <= 0.4] = 0.0
        size = np.abs(left)
        peaks = 1 + np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:]))
        largest = peaks[np.argsort(-size[peaks])][:8]
        found[name] = [
            {
                'depth': float(exact.z[k]),
                'sigmas': float(left[k]),
                'nearest z_i + z_j - z_k': float(triples[np.abs(triples - exact.z[k]).argmin()]),
            }
            for k in largest
        ]
    return found


def tails() -> dict[str, dict[str, float]]:
    """What the echo of the strongest layer alone leaves, largest within .1 m of each distance,
    with its phase left in and taken off, in units of one record's noise."""
    # The layer stands on a cell.
    exact = seen_exactly(1, depth_step=0.05)
    found: dict[str, dict[str, float]] = {}
    for name, seen in (('phase left in', exact.plain), ('phase off', exact.turned)):
        left = exact.left(seen, exact.pulse)
        row = found[name] = {}
        for away in (-0.9, -0.7, -0.5, -0.3, 0.3, 0.5, 0.7, 0.9):
            near = left[np.abs(exact.z - exact.depth[0] - away) <= 0.1]
            row[f'{away:g} m'] = float(near[np.abs(near).argmax()])
    return found


ARRAYS = {
    '32 hydrophones, 50-4000 Hz': (FathometerScenario(snapshot_seconds=0.35), 57.0),
    '16 hydrophones, 100-2800 Hz': (scenario('pressure', {'snapshot_seconds': 0.35}), 22.0),
}
"""Scene and the height of the array above a layer of amplitude 0.35."""


def echoes() -> dict[str, dict[str, dict[str, float]]]:
    """The echo of one layer, without noise, and the pulses that are taken for it."""
    tables = {}
    for name, (config, height) in ARRAYS.items():
        layer = np.array([[config.array_depth + height]])
        where = np.array([config.array_depth])
        floor = Drift(layer, np.full((1, 1), 0.35), layer > 0.0, where, where)
        rows = np.arange(
            np.ceil(config.frequency_min * config.snapshot_seconds),
            np.floor(config.frequency_max * config.snapshot_seconds) + 1.0,
        )
        frequency = rows / config.snapshot_seconds
        R = expected_csdm(config, floor, 0, frequency)
        mirrored = evolve(floor, amplitude=-floor.amplitude)
        heights = config.element_spacing * np.arange(config.phones)
        w = steering(frequency, heights, config.sound_speed)
        gamma, power = coherence_and_power(R, w, 'mvdr')
        other = coherence_and_power(expected_csdm(config, mirrored, 0, frequency), w, 'mvdr')[0]
        turn = np.exp(4j * np.pi * frequency * height / config.sound_speed)
        gamma = 0.5 * (gamma - other)
        echo = (gamma * turn).real
        every = echo_spectrum(R, frequency, power)
        W = every * surface_share(R, frequency, heights, config.sound_speed)
        W = W / W.mean()
        table: dict[str, dict[str, float]] = {}
        for away in (0.05, 0.1, 0.2, 0.3, 0.5):
            shift = np.exp(4j * np.pi * frequency * away / config.sound_speed)
            table[f'pulse at {away} m'] = {
                'echo': float((gamma * turn * shift).real.mean() / echo.mean()),
                'processor': float((W * shift).real.mean()),
                'all noise': float((every * shift).real.mean()),
                'band': float(shift.real.mean()),
            }
        for low in (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0):
            octave = (frequency >= low) & (frequency < 2.0 * low)
            if octave.any():
                table[f'{low:.0f} Hz to {2 * low:.0f} Hz'] = {
                    'echo': float(echo[octave].mean() / echo.mean()),
                    'processor': float(W[octave].mean()),
                    'all noise': float(every[octave].mean()),
                    'band': 1.0,
                }
        tables[name] = table
    return tables


def _score(found: Estimate, depth: np.ndarray, amplitude: np.ndarray) -> list[float]:
    z = fathometer_paper.reflectors(found)
    away = z[:, :1] - depth
    near = np.abs(away) < 0.4
    wrong = near & (np.sign(z[:, 1:2]) != np.sign(amplitude))
    return [
        *fathometer_paper.score(found, depth),
        rms(away[near]) if near.any() else np.nan,
        float(wrong.sum()),
    ]


def main(
    runs: int = 5,
    records: int = 300,
    particles: int = 5000,
    scenes: Sequence[str] = tuple(SCENES),
    pulses: Sequence[str] = ('band', 'processor'),
    polarities: Sequence[str] = ('positive', 'both'),
    ghosts: bool = False,
    out: Path | None = None,
) -> Parts:
    yield known(out)
    if ghosts:
        yield {'ghosts': peaks_beside(), 'tails': tails(), 'echoes': echoes()}
        return
    yield {'records': records}
    for name in scenes:
        length = records if name == 'drift' else max(10, records // 10)
        scores: dict[str, list[dict[str, float]]] = {}
        for seed in range(runs):
            made = run(name, seed, length, particles, pulses, polarities)
            for label, row in made.items():
                each = scores.setdefault(label, [])
                each.append(row)
                error = {'P, s.e.': standard_error([row['P'] for row in each])}
                yield {'table': {label: {'runs': float(len(each))} | mean_of(each) | error}}


if __name__ == '__main__':
    study(main, ghosts={'help': 'only these, and echoes'}, scenes={'choices': list(SCENES)})
