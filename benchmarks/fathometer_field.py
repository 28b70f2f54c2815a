# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer in the field: hydrophones that differ, waves and faults, a depth that is told
wrongly, what can be counted, and profiler lines. Nothing is told to the tracker but what a
recording has.

    python -m benchmarks.fathometer_field --out docs/results/fathometer_field.json

phones: cross-spectra of 16 hydrophones 0.25 m apart from 100 to 2800 Hz, 100 snapshots, three
layers, 10 records, scored after four, with `phone_correction` off and full.

moving: traces of six layers of 7 to 25 sigma, 100 to 2800 Hz, 44 records, scored after eight; the
floor moves, or the depth of the array is told wrongly (in m, rms, anew in each record, or slowly:
an autoregression of 0.9). Without jumps: common_jump_probability 0. ids: for each layer.

counted: scenes of 3 to 7 layers of log-uniform 1.5 to 20 sigma; how probable the numbers of
reflectors above 4 sigma, and of all, were said to be, and how often it was so.

profilers: the lines of real data, if SONAR_IMM_DATA names them, converted and tracked by the
command as docs/fathometer.md says, with the water found and off. The floor is picked without a
tracker: the first of three successive samples above an eighth of what loud traces reach (`edge`),
and the greatest of the four from there on (`followed`); a record is followed when a reflector lies
within 1 m of that. at_twice_the_floor: reflectors within 1 m of that, of which so many are marked
as multiples. Where lines cross, their
horizons are compared; L3 and L9 cross where the floor is at 4 m, above the first sample that is
taken (4.5 m), so that this crossing is made once more from the end of the transmit pulse on (3.4
m). depth_std and the form of the likelihood were chosen on L2 and L9; the rule by which the first
return keeps its name, and the chain of the water, were made with all four in view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from benchmarks.study import DATA, Parts, standard_error, study
from sonar_imm.acoustics.ambient import sample_csdm, surface_noise_csdm
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.estimation.consistency import ospa
from sonar_imm.measurements import CrossSpectra, Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.cli import main as command
from sonar_imm_tools.evaluation.fathometer.crossing import crossing_metrics, summary
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.segy_lines import read_segy

SPACING = 0.376


def real_lines() -> list[Path]:
    return sorted((DATA / 'sbp_chiapas').glob('*.seg'))


# -- profiler lines -------------------------------------------------------------------------------

FIRST, PICKED, STACK, NEAR = 12, 74, 4, 1.0
UNCUT = 9
"""The first sample after the transmit pulse."""
FEW = ('--set', 'particles=5000')
ROWS: dict[str, tuple[str, ...]] = {'default': (), 'water off': ('--set', 'water=off')}
_RUN, _REACH, _LOUD = 3, 4, 8.0


def profilers(folder: Path) -> Parts:
    """Every line under every row, and the crossings of the default row."""
    paths = {path.stem.split('_SBP_')[1][:2]: path for path in real_lines()}
    for line, path in paths.items():
        convert(path, folder / f'{line}.bag', FIRST)
        for row, extra in ROWS.items():
            out = folder / (line if not extra else 'other')
            call('track', folder / f'{line}.bag', out, '--overwrite', *FEW, *extra)
            yield {'lines': {line: {row: followed(path, RunFolder(out))}}}
    for line in ('L3', 'L9'):
        convert(paths[line], folder / f'{line}_uncut.bag', UNCUT)
        call('track', folder / f'{line}_uncut.bag', folder / f'{line}_uncut', *FEW)
    crossings = {}
    for a, b, cut in (('L1', 'L9', ''), ('L2', 'L9', ''), ('L3', 'L9', ''), ('L3', 'L9', 'uncut')):
        first, other = (RunFolder(folder / (f'{c}_{cut}' if cut else c)) for c in (a, b))
        name = f'{a} x {b}, {cut}' if cut else f'{a} x {b}'
        crossings[name] = crossing_metrics(first, other, 3.0)
    horizons = [h for c in crossings.values() for at in c['crossings'] for h in at['horizons']]
    between = summary([h for h in horizons if h['judged']])
    yield {'crossings': crossings, 'between_lines': between}


def convert(path: Path, bag: Path, first: int) -> None:
    call(
        *('convert', 'segy', path, bag, '--sample-spacing', SPACING),
        *('--first-sample', first, '--samples', FIRST + PICKED - first, '--stack', STACK),
    )


def call(*arguments: Any) -> None:
    if command([str(argument) for argument in arguments]):
        raise SystemExit('the command failed')


def followed(path: Path, run: RunFolder) -> dict[str, float]:
    """How a tracked line goes with what is picked without a tracker."""
    raw = read_segy(path).amplitude
    count = len(raw) // STACK
    amplitude = raw[: STACK * count].reshape(count, STACK, -1).mean(axis=1)
    edges, peaks = picked(amplitude[:, FIRST : FIRST + PICKED])
    rows, ids, double = [], set(), []
    for estimate, edge, peak in zip(run.read_estimates(), edges, peaks):
        columns = estimate.columns()
        depth, bottom = columns['depth'], int(np.argmax(columns['is_bottom']))
        away = np.abs(np.nan_to_num(depth, nan=1e9) - SPACING * (FIRST + peak))
        if away.min() < NEAR:
            ids.add(int(columns['track_id'][np.argmin(away)]))
        at_edge = (np.abs(depth - SPACING * (FIRST + edge)) < NEAR).any()
        there = np.isfinite(depth)
        rows.append((away.min() < NEAR, away[bottom] < NEAR, at_edge, there.sum()))
        twice = np.abs(depth[there] - 2.0 * depth[bottom]) < NEAR
        double += list(columns['multiple_probability'][there][twice] > 0.5)
    at_peak, by_bottom, at_edges, number = np.mean(np.array(rows, np.float64), axis=0).tolist()
    return {
        'records': count,
        'followed': at_peak,
        'followed_by_is_bottom': by_bottom,
        'followed_edge': at_edges,
        'ids_per_100': 100.0 * len(ids) / count,
        'reflectors': number,
        'at_twice_the_floor': len(double),
        'of_these_marked': int(np.sum(double)),
    }


def picked(amplitude: FloatArray) -> tuple[IntArray, IntArray]:
    """Sample at which each trace (T, n) first begins, and of its first peak; -1 where none is."""
    loud = float(np.quantile(amplitude.max(axis=1), 0.99)) / _LOUD
    above = amplitude > loud
    count = amplitude.shape[1] - _RUN + 1
    run = np.logical_and.reduce([above[:, k : k + count] for k in range(_RUN)])
    edges = np.where(run.any(axis=1), run.argmax(axis=1), -1)
    reach = [int(np.argmax(trace[i : i + _REACH])) for i, trace in zip(edges, amplitude)]
    return edges, np.where(edges < 0, -1, edges + reach)


# -- layers below an array ------------------------------------------------------------------------

LAYERS = np.array([52.0, 56.5, 60.0, 64.2, 68.0, 72.5])
STRENGTH = np.array([25.0, 18.0, 13.0, 10.0, 8.5, 7.0])
BAND: dict[str, Any] = {'frequency_min': 100.0, 'frequency_max': 2800.0, 'sound_speed_std': 0.0}
MOVING, UNSCORED, ARRAY = 44, 8, 30.0


def floors(records: int) -> dict[str, FloatArray]:
    """How deep the floor lies in each record (T,), against the first, m."""
    record = np.arange(records, dtype=np.float64)
    wave = np.asarray(np.sin(2.0 * np.pi * record / 25.0))
    return {
        'flat': 0.0 * record,
        'dip 0.18': 0.18 * record - 4.0,
        'waves 2.5': 2.5 * wave,
        'waves 5': 5.0 * wave,
        'fault 3': np.where(record >= records // 2, 3.0, 0.0),
        'fault -3': np.where(record >= records // 2, -3.0, 0.0),
    }


def depth_errors(records: int, rng: np.random.Generator) -> dict[str, FloatArray]:
    """How wrong the depth of the array is told in each record (T,), m."""
    new = rng.standard_normal(records)
    slow = 0.2 * new
    for k in range(1, records):
        slow[k] = 0.9 * slow[k - 1] + np.sqrt(1.0 - 0.81) * slow[k]
    return {'depth 0.1': 0.1 * new, 'depth 0.2': 0.2 * new, 'depth 0.5': 0.5 * new, 'slow': slow}


def layered(
    seed: int, floor: FloatArray, wrong: FloatArray, layers: FloatArray, strength: FloatArray
) -> tuple[list[Trace], FloatArray]:
    """Traces as an array sees them, and the true depths (T, K)."""
    rng, pulse = np.random.default_rng([seed, 1]), band_pulse(100.0, 2800.0, 1500.0)
    depth = 40.0 + 0.05 * np.arange(800)
    true, kernel, traces = layers + floor[:, None], pulse(0.05 * np.arange(-60.0, 61.0)), []
    for k, off in enumerate(wrong):
        noise = np.convolve(rng.standard_normal(len(depth) + 120), kernel, 'valid')
        noise /= np.sqrt(np.sum(np.square(kernel)))
        traces.append(
            Trace(
                stamp_ns=(k + 1) * 10**9,
                depth=depth,
                amplitude=pulse(depth[:, None] - true[k] - off) @ strength + noise,
                sigma=np.ones(len(depth)),
                reference_depth=ARRAY + off,
            )
        )
    return traces, true


def scored(pairs: Iterator[tuple[Estimate, FloatArray]], skip: int) -> dict[str, float]:
    """P, OSPA of second order and a cutoff of 2 m, share of the true depths (K,) within two stated
    standard deviations, and ids a layer, of estimates after the first so many."""
    right, apart, inside, ids = [], [], [], set()
    for k, (estimate, true) in enumerate(pairs):
        z = estimate.state[:, 0]
        found = z[np.isfinite(z)]
        if k < skip:
            continue
        order = estimate.model_names[int(np.argmax(estimate.probabilities[0]))]
        right.append(int(order.removeprefix('order_')) == len(true))
        apart.append(ospa(true[:, None], found[:, None], 2.0))
        for layer, place in enumerate(true.tolist()):
            off = np.abs(z - place)
            row = int(np.argmin(np.nan_to_num(off, nan=np.inf)))
            if off[row] < 1.0:
                ids.add((layer, int(estimate.extras['track_id'][row])))
                inside.append(off[row] <= 2.0 * np.sqrt(estimate.covariance[row, 0, 0]))
    return {
        'P': float(np.mean(right)),
        'OSPA': float(np.mean(apart)),
        'inside': float(np.mean(inside)) if inside else 0.0,
        'ids': len(ids) / len(true),
    }


def moving(seed: int, particles: int, kind: str, jumps: bool) -> dict[str, float]:
    rng, still = np.random.default_rng([seed, 0]), np.zeros(MOVING)
    wrong = depth_errors(MOVING, rng).get(kind, still)
    floor = floors(MOVING).get(kind, still)
    traces, true = layered(seed, floor, wrong, LAYERS, STRENGTH)
    own = BAND if jumps else {**BAND, 'common_jump_probability': 0.0}
    tracker = FathometerTracker(FathometerConfig(particles=particles, **own))
    pairs = ((tracker.process(trace)[-1], z) for trace, z in zip(traces, true))
    found = scored(pairs, UNSCORED)
    return found | {'followed': float(any('as heave' in each for each in tracker.warnings()))}


def counted(seed: int, particles: int) -> dict[str, float]:
    """Of one scene: what was said of the true number above 4 sigma and of all, and whether the
    most probable one was it; Brier scores of every number."""
    rng, still = np.random.default_rng([seed, 2]), np.zeros(40)
    layers = 45.0 + np.cumsum(rng.uniform(2.5, 5.0, rng.integers(3, 8)))
    strength = 1.5 * (20.0 / 1.5) ** rng.random(len(layers))
    traces, _ = layered(seed, still, still, layers, strength)
    tracker = FathometerTracker(FathometerConfig(particles=particles, **BAND))
    rows = []
    for k, trace in enumerate(traces):
        (estimate,) = tracker.process(trace)
        if k < 15:
            continue
        above = int(np.sum(strength > 4.0))
        sure = np.array([estimate.extras[f'prob_detectable_{n}'][0] for n in range(13)])
        held = np.append(0.0, estimate.probabilities[0])
        own = []
        for pmf in (sure, held):
            happened = np.arange(13) == above
            own += [pmf[above], np.argmax(pmf) == above, np.mean(np.square(pmf - happened))]
        rows.append(own)
    names = [f'{a}, {b}' for a in ('detectable', 'order') for b in ('said', 'right', 'Brier')]
    return dict(zip(names, np.mean(np.array(rows, np.float64), axis=0).tolist()))


# -- hydrophones ----------------------------------------------------------------------------------

FREQUENCY, PHONES, SPACING_M = np.arange(100.0, 2800.1, 5.0), 16, 0.25
HEIGHTS, ECHOES = np.array([22.0, 27.5, 34.0]), np.array([0.35, -0.2, 0.15])


def response(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Response (F, M) of the hydrophones."""
    c = np.ones((len(FREQUENCY), PHONES), np.complex128)
    every = ('gains 2', 'inverted', 'late 50 us', 'slope') if kind == 'all' else (kind,)
    if 'gains 1' in every or 'gains 2' in every:
        c *= 10.0 ** (float(every[0][-1]) * rng.standard_normal(PHONES) / 20.0)
    if 'half' in every:
        c[:, 5] *= 0.5
    if 'weak 20 dB' in every:
        c[:, 5] *= 0.1
    if 'slope' in every:
        c[:, 12] *= 100.0 / FREQUENCY
    if 'inverted' in every or 'two inverted' in every:
        c[:, 4] *= -1.0
    if 'two inverted' in every:
        c[:, 11] *= -1.0
    late = np.zeros(PHONES)
    late[9] = 50e-6 * ('late 50 us' in every)
    if 'delays 30 us' in every:
        late = 30e-6 * rng.standard_normal(PHONES)
    return c * np.exp(-2j * np.pi * FREQUENCY[:, None] * late)


FAULTS = (
    *('none', 'gains 1', 'gains 2', 'half', 'weak 20 dB', 'slope', 'inverted', 'two inverted'),
    *('late 50 us', 'delays 30 us', 'all'),
)


def phones(seed: int, particles: int, kind: str, correction: str) -> dict[str, float]:
    rng = np.random.default_rng([seed, 3])
    clean = surface_noise_csdm(FREQUENCY, PHONES, SPACING_M, HEIGHTS, ECHOES, 1500.0)
    c = response(kind, rng)
    clean = (clean + 0.01 * np.eye(PHONES)) * c[:, :, None] * c.conj()[:, None, :]
    config = FathometerConfig(
        phones=PHONES,
        element_spacing=SPACING_M,
        array_depth=ARRAY,
        depth_min=ARRAY + 12.0,
        depth_max=ARRAY + 44.0,
        phone_correction=correction,
        particles=particles,
        **BAND,
    )
    tracker = FathometerTracker(config)

    def tracked_records() -> Iterator[tuple[Estimate, FloatArray]]:
        for k in range(10):
            record = CrossSpectra(
                stamp_ns=(k + 1) * 10**9,
                frequency=FREQUENCY,
                csdm=sample_csdm(clean, 100, rng),
                snapshots=100,
                reference_depth=ARRAY,
            )
            yield tracker.process(record)[-1], ARRAY + HEIGHTS

    return scored(tracked_records(), 4)


# -- the study ------------------------------------------------------------------------------------


def rows_of(case: str) -> dict[str, Callable[[int, int], dict[str, float]]]:
    """The rows of a table, each of a seed and a number of particles."""
    if case == 'phones':
        return {
            f'{kind}, {how}': partial(phones, kind=kind, correction=how)
            for kind in FAULTS
            for how in ('off', 'full')
        }
    if case == 'moving':
        kinds = [*floors(1), *depth_errors(1, np.random.default_rng(0))]
        return {
            kind + ('' if jumps else ', without jumps'): partial(moving, kind=kind, jumps=jumps)
            for kind in kinds
            for jumps in (False, True)
        }
    return {case: counted}


CASES = ('moving', 'counted', 'phones', 'profilers')


def main(
    runs: int = 20,
    first: int = 0,
    particles: int = 3000,
    cases: Sequence[str] = CASES,
) -> Parts:
    """first: the first seed."""
    if 'profilers' in cases and real_lines():
        with tempfile.TemporaryDirectory() as folder:
            yield from profilers(Path(folder))
    for case in cases:
        for name, row in rows_of(case).items() if case != 'profilers' else ():
            found = []
            for seed in range(first, first + runs):
                found.append(row(seed, particles))
                means = {
                    key: value
                    for label in found[0]
                    for key, value in (
                        (label, float(np.mean([each[label] for each in found]))),
                        (f'{label}, s.e.', standard_error([each[label] for each in found])),
                    )
                    if not key.endswith('s.e.') or label in ('P', 'OSPA')
                }
                yield {case: {name: {'runs': len(found), 'particles': particles} | means}}


if __name__ == '__main__':
    study(main, cases={'choices': list(CASES)})
