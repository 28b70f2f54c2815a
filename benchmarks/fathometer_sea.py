# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer at sea: pressure against cross-spectra, gaps, dips, speed of sound, multiples.

    python -m benchmarks.fathometer_sea --out docs/results/fathometer_sea.json

`table`: pressure against cross-spectra of the same model, run by run. 16 hydrophones 0.25 m apart,
100 Hz to 2800 Hz, at 30 m and half a metre about it, told to 0.03 m; layers of amplitude 0.35,
0.25 and 0.2 at 52 m, 58.5 m and 66 m that walk by 0.05 m from record to record; ships and noise of
the hydrophones. Pressure is drawn from the cross-spectral model over each whole record, in whole
numbers of 2.5 steps to a standard deviation where it says so; cross-spectra are drawn from the
same model frequency by frequency, of as many snapshots as fit into the record side by side, which
gives a response of the same noise. Every row has the same floors. Rows are written as runs end. P
is the share of records whose number of reflectors is right, OSPA of second order with a cutoff of
2 m.

`gaps`: traces of six layers of 7 to 34 sigma that walk by .1 or .15 m from record to record, or of
eight that are deeper by so many m in each as well ('dip'), with the pulse of 50 to 4000 Hz: 20
records, then none for some, in which the layers go on, then 10 more. The tracker has its defaults
(depth_std 0.1 m). 'gap not seen': a record_interval longer than any gap; 'Kalman': one filter for
each layer with the same depth_std, which knows which echo is of which layer: the highest point of
the record within 0.25 m of where that is. 'sound': the speed is off by so many m/s, or drawn with
the standard deviation of 10 m/s that is the default.

P: share of the records whose number of layers is right, before the gap, in the first record after
it, in the later ones and in all; inside: depths within two stated standard deviations; kept: share
of the layers that have the ID in the fourth record after the gap that they had before it; named:
IDs given in a run; dipping: the mean probability of it.

`multiples`: tracks are drawn, not filtered. Four primaries, the first 8 to 14 m below the surface,
the others 2 to 8 m below each other, found with errors of 0.03 m beside one of 0.03 m of the
array's depth that all share, and of all surface multiples and peg-legs that lie between the
deepest primary and 45 m two, drawn at random. The floor is flat, or each layer walks by 0.05 m a
record. 'no sign': polarity positive. 'sign': positive primaries, multiples with the sign they
have. Told after so many records: how many of the multiples ('found') and of the primaries
('falsely') have a probability of more than a half.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import Any

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from benchmarks.fathometer_paper import score
from benchmarks.study import mean_of, Parts, rms, standard_error, study
from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.multiples import Multiples, Seen, ways_above
from sonar_imm.trackers.fathometer.pressure import automatic_snapshot
from sonar_imm.trackers.fathometer.tracker import FathometerConfig, FathometerTracker
from sonar_imm_tools.simulation.fathometer.scenario import Drift, FathometerScenario
from sonar_imm_tools.simulation.fathometer.simulator import (
    cross_spectra,
    pressure_blocks,
    scenario,
)

THREE, AMPLITUDES = np.array([52.0, 58.5, 66.0]), np.array([0.35, 0.25, 0.2])
SETTLED = 4
"""Records after which a run is scored once more."""
MIRROR: dict[str, Any] = {'noise_depth_min': 0.0, 'noise_depth_max': 0.0}
LONG: dict[str, Any] = {'record_seconds': 20.0, 'records': 20}
FEW: dict[str, Any] = {'snapshot_seconds': 1.4, **MIRROR}
ROWS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    '8 s, pressure': ('pressure', {}, {}),
    '8 s, pressure, snapshots of 1.4 s': ('pressure', {}, FEW),
    '8 s, pressure, int8': ('pressure', {'steps_per_sigma': 2.5}, {}),
    '8 s, cross-spectra': ('csdm', {}, MIRROR),
    '20 s, pressure': ('pressure', LONG, {}),
    '20 s, pressure, pulse of the band': ('pressure', LONG, {'pulse': 'band'}),
    '20 s, pressure, conventional': ('pressure', LONG, {'processor': 'conventional'}),
    '20 s, cross-spectra': ('csdm', LONG, MIRROR),
}
"""Name: level, what differs of the scene, what differs of the tracker."""


def floor_of(config: FathometerScenario, seed: int) -> Drift:
    rng = np.random.default_rng([seed, 0])
    T = config.records
    depth = THREE + np.cumsum(0.05 * rng.standard_normal((T, 3)), axis=0)
    array = config.array_depth + rng.uniform(-0.5, 0.5, T)
    stated = array + config.array_depth_std * rng.standard_normal(T)
    amplitude = np.tile(AMPLITUDES, (T, 1))
    return Drift(depth, amplitude, amplitude > 0.0, array, stated)


def with_pressure(
    level: str, scene: dict[str, Any], options: Sequence[dict[str, Any]], seed: int
) -> list[dict[str, Any]]:
    """One run with each of `options`, which see the same noise; numbers of each record."""
    config = scenario('pressure', {'level': level, 'steps_per_sigma': 0.0, **scene})
    floor, rng = floor_of(config, seed), np.random.default_rng([seed, 1])
    stated = {k: v for k, v in config.instruments().items() if k not in ('window', 'overlap')}
    stated |= {'depth_min': config.depth_min, 'depth_max': config.depth_max}
    stated.pop('snapshot_seconds', None)
    settings = [FathometerConfig(**{**stated, **each}, seed=seed) for each in options]
    if level == 'csdm':
        reach = config.depth_max - config.array_depth
        seconds = automatic_snapshot(settings[0], config.phones, reach)
        count = round(config.record_seconds / seconds)
        config = evolve(config, snapshot_seconds=seconds, snapshots=count)
        # Drawn frequency by frequency, their noise does not fade.
        settings = [evolve(each, window='rectangular', overlap=0.0) for each in settings]
    trackers = [FathometerTracker(each) for each in settings]
    found: list[dict[str, Any]] = [{'right': [], 'ospa': []} for _ in options]
    for record in range(config.records):
        depth = float(floor.array_depth_stated[record])
        if level == 'csdm':
            measured: list[Any] = [cross_spectra(config, floor, record, depth, rng)]
        else:
            measured = pressure_blocks(config, floor, record, depth, rng)
        for tracker, rows in zip(trackers, found):
            for estimate in (each for item in measured for each in tracker.process(item)):
                right, distance = score(estimate, floor.depth[record])
                rows['right'].append(right)
                rows['ospa'].append(distance)
    return found


def row_of(runs: list[dict[str, Any]]) -> dict[str, float]:
    def mean(name: str, first: int) -> tuple[float, float]:
        each = [float(np.mean(found[name][first:])) for found in runs]
        return float(np.mean(each)), standard_error(each)

    row: dict[str, float] = {}
    for first, label in ((0, ''), (SETTLED, f' from record {SETTLED}')):
        for name, title in (('right', 'P'), ('ospa', 'OSPA')):
            value, error = mean(name, first)
            row[f'{title}{label}'] = value
            row[f'{title}{label}, s.e.'] = error
    return row


# -- gaps, dips, speed of sound --------------------------------------------------------------

LAYERS = np.array([46.0, 52.3, 58.1, 65.4, 71.2, 78.9])
SIGMAS = np.array([34.0, 25.0, 18.0, 12.0, 9.0, 7.0])
STEP, BEFORE, AFTER, SECONDS = 1.0 / 64.0, 20, 10, 10.0
DEPTH = 38.0 + STEP * np.arange(3072)
DIPPING = np.array([46.0, 51.3, 55.1, 59.4, 64.2, 68.9, 73.0, 78.2])
DIPPING_SIGMAS = np.array([34.0, 28.0, 22.0, 17.0, 13.0, 11.0, 9.0, 7.0])
DIPPING_DEPTH = 40.0 + STEP * np.arange(4608)
ARRAY, SPEED = 30.0, 1500.0
"""Depth of the array of the traces, m; speed that trackers assume, m/s."""


def scene(
    gap: int,
    walk: float,
    seed: int,
    dip: float | FloatArray = 0.0,
    depth: NDArray[np.floating[Any]] = DEPTH,
    layers: FloatArray = LAYERS,
    sigmas: FloatArray = SIGMAS,
) -> tuple[list[Trace], FloatArray]:
    """Traces, and the true depths (records, layers). dip: what the layers (layers,) are deeper by
    from record to record (records,), m."""
    rng = np.random.default_rng([seed, gap])
    moved = walk * rng.standard_normal((BEFORE + gap + AFTER, len(layers))) + dip
    every = layers + np.cumsum(moved, axis=0)
    there = np.r_[0:BEFORE, BEFORE + gap : len(every)]
    pulse, lags = band_pulse(50.0, 4000.0, 1500.0), np.arange(2 * len(depth))
    spectrum = np.fft.rfft(pulse(STEP * np.minimum(lags, len(lags) - lags)))
    root = np.sqrt(spectrum.real.clip(min=0.0))
    traces = []
    for k in there:
        noise = np.fft.irfft(root * np.fft.rfft(rng.standard_normal(len(lags))), len(lags))
        echoes = pulse(depth[:, None] - every[k]) @ sigmas
        traces.append(
            Trace(
                stamp_ns=round((k + 1) * SECONDS * 1e9),
                depth=depth,
                amplitude=noise[: len(depth)] / noise.std() + echoes,
                sigma=np.ones(len(depth)),
                reference_depth=ARRAY,
            )
        )
    return traces, every[there]


def dipping(kind: str, dip: float, gap: int, seed: int) -> tuple[list[Trace], FloatArray]:
    """Traces of eight layers, and their true depths (records, 8). kind: 'parallel': all dip alike;
    'fan': by half to one and a half times `dip`; 'turn': down for 15 records, then up."""
    slope: float | FloatArray = dip
    if kind == 'fan':
        slope = dip * np.linspace(0.5, 1.5, len(DIPPING))
    if kind == 'turn':
        slope = np.where(np.arange(BEFORE + gap + AFTER) < 15, dip, -dip)[:, None]
    return scene(gap, 0.1, seed, slope, DIPPING_DEPTH, DIPPING, DIPPING_SIGMAS)


def highest(trace: Trace, depth: float) -> float:
    """The depth of the highest point of a record within 0.25 m of `depth`."""
    near = np.flatnonzero(np.abs(trace.depth - depth) < 0.25)
    return float(trace.depth[near[np.argmax(trace.amplitude[near])]])


def seen_variance(sigmas: FloatArray) -> FloatArray:
    """Variance (K,) of the depth of the highest point of echoes of so many sigmas (K,), m^2."""
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    curvature = -float(np.diff(pulse(np.array([-1e-3, 0.0, 1e-3])), 2)[0]) / 1e-6
    return 1.0 / (np.square(sigmas) * curvature) + STEP**2 / 12.0


def kalman(traces: Sequence[Trace], truth: FloatArray, gap: int) -> FloatArray:
    """Errors and stated standard deviations (records, 6, 2) with known association."""
    found = np.empty((*truth.shape, 2))
    for i, r in enumerate(seen_variance(SIGMAS)):
        mean, P = 0.0, 1e6
        for k, trace in enumerate(traces):
            seen = highest(trace, truth[k, i])
            P += 0.1**2 * (1 + gap * (k == BEFORE))
            gain = P / (P + r)
            mean, P = mean + gain * (seen - mean), (1.0 - gain) * P
            found[k, i] = mean - truth[k, i], np.sqrt(P)
    return found


def tracked(traces: Sequence[Trace], truth: FloatArray, **parameters: Any) -> dict[str, Any]:
    """right (records,), errors and stated standard deviations of layers that were found
    (records, 6, 2), ids (records, 6), 0 where a layer was not found."""
    config = FathometerConfig(**{'array_depth_std': 0.0, 'sound_speed_std': 0.0, **parameters})
    tracker = FathometerTracker(config)
    right = np.zeros(len(traces), bool)
    found, ids = np.full((*truth.shape, 2), np.nan), np.zeros(truth.shape, int)
    named: set[int] = set()
    dipping = []
    for k, trace in enumerate(traces):
        (estimate,) = tracker.process(trace)
        right[k] = int(np.argmax(estimate.probabilities[0])) + config.order_min == truth.shape[1]
        if not np.isfinite(estimate.state[:, 0]).all():
            continue
        named.update(estimate.extras['track_id'].tolist())
        dipping.append(float(np.mean(estimate.extras['dipping'])))
        for i, z in enumerate(truth[k]):
            row = int(np.argmin(np.abs(estimate.state[:, 0] - z)))
            error = estimate.state[row, 0] - z
            if abs(error) < 0.5:
                found[k, i] = error, np.sqrt(estimate.covariance[row, 0, 0])
                ids[k, i] = estimate.extras['track_id'][row]
    return {
        'right': right,
        'found': found,
        'ids': ids,
        'named': len(named),
        'dipping': float(np.mean(dipping)),
    }


def inside(errors: FloatArray) -> float:
    """Share of errors (..., 2), each with its stated standard deviation, within two of these."""
    errors = errors[np.isfinite(errors).all(axis=-1)]
    return float(np.mean(np.abs(errors[:, 0]) <= 2.0 * errors[:, 1]))


def summary(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    right = np.array([run['right'] for run in runs])
    found = np.array([run['found'] for run in runs])
    ids = np.array([run['ids'] for run in runs])
    before = ids[:, BEFORE - 1 : BEFORE]
    same, known = (ids[:, BEFORE:] == before) & (before > 0), before[:, 0] > 0
    after, errors = found[:, BEFORE:], found[:, BEFORE, :, 0]
    return {
        'P': float(right.mean()),
        'P, before': float(right[:, :BEFORE].mean()),
        'P, 1st': float(right[:, BEFORE].mean()),
        'P, 2nd': float(right[:, BEFORE + 1].mean()),
        'P, later': float(right[:, BEFORE + 2 :].mean()),
        'found, 1st': float(np.isfinite(errors).mean()),
        'error, 1st, m': rms(errors[np.isfinite(errors)]),
        'inside': inside(found),
        'inside, before': inside(found[:, :BEFORE]),
        'inside, after': inside(after),
        'inside, 1st': inside(after[:, 0]),
        'inside, later': inside(after[:, 1:]),
        'kept, 4th': float(same[:, 3][known].mean()) if known.any() else 0.0,
        **{
            name: float(np.mean([run[name] for run in runs]))
            for name in ('named', 'dipping')
            if name in runs[0]
        },
    }


Rows = dict[str, dict[str, float]]


def after_gap(seed: int, particles: int, walk: float, gap: int, name: str) -> Rows:
    """Rows of the tracker, of one that takes the gap for a record, and of the Kalman filters."""
    traces, truth = scene(gap, walk, seed)
    known = np.ones(truth.shape, int)
    unseen = {'record_interval': 86400.0, 'slope_std': 0.0}
    return {
        name: summary([tracked(traces, truth, particles=particles)]),
        f'{name}, gap not seen': summary([tracked(traces, truth, particles=particles, **unseen)]),
        f'{name}, Kalman': summary(
            [{'right': known[:, 0], 'found': kalman(traces, truth, gap), 'ids': known}]
        ),
    }


def along_dips(seed: int, particles: int, dip: float, gap: int, name: str) -> Rows:
    traces, truth = dipping('parallel', dip, gap, seed)
    return {name: summary([tracked(traces, truth, particles=particles)])}


def speeds(seed: int, particles: int) -> Rows:
    """The speed only scales what is seen, so that one run serves all speeds."""
    traces, truth = scene(0, 0.1, seed)
    found = tracked(traces, truth, particles=particles, sound_speed_std=10.0)
    drawn = 10.0 * np.random.default_rng([seed, 2]).standard_normal(400)
    return {
        name: {'P': float(np.mean(found['right'])), 'inside': within(found['found'], truth, off)}
        for name, off in (
            ('sound 5 m/s faster', np.array([5.0])),
            ('sound drawn', drawn),
        )
    }


def within(found: FloatArray, truth: FloatArray, faster: FloatArray) -> float:
    """Share of errors and stated deviations (T, K, 2) within two of these, if the sound were so
    many m/s faster (R,) than is assumed and the layers (T, K) as much deeper."""
    error = found[..., 0] - faster[:, None, None] / SPEED * (truth - ARRAY)
    seen = np.isfinite(found[..., 0])
    return float(np.mean(np.abs(error[:, seen]) <= 2.0 * found[seen][:, 1]))


CASES: dict[str, Callable[..., Rows]] = {
    **{
        name: partial(after_gap, walk=walk, gap=30, name=name)
        for walk in (0.1, 0.15)
        for name in [f'30 missing, walk {walk:g} m']
    },
    **{
        name: partial(along_dips, dip=dip, gap=gap, name=name)
        for dip, gap in ((0.4, 0), (0.4, 30), (0.0, 120), (0.1, 120))
        for name in [f'dip {dip:g} m, {gap} missing']
    },
    'speed': speeds,
}

# -- multiples ------------------------------------------------------------------------------------

PRIMARIES, DEEPEST, ERROR, RECORDS = 4, 45.0, 0.03, (1, 5, 20, 60)
FLOORS = {'flat floor': 0.0, 'walk .05 m': 0.05}
"""Name: how far a layer walks from record to record, m."""


def drawn(rng: np.random.Generator, walk: float) -> tuple[np.ndarray, np.ndarray]:
    """Depths (T, K) as they are found and sign (K,) of the amplitudes; multiples come last."""
    while True:
        first = np.cumsum(np.append(rng.uniform(8.0, 14.0), rng.uniform(2.0, 8.0, PRIMARIES - 1)))
        ways = ways_above(np.ones(PRIMARIES), PRIMARIES)
        ends = (first[ways.member] * ways.factor).sum(axis=1)
        free = np.flatnonzero((ends > first[-1] + 1.0) & (ends < DEEPEST))
        if len(free) < 2:
            continue
        which = rng.choice(free, 2, replace=False)
        if abs(np.diff(ends[which])[0]) > 1.0:
            break
    steps = walk * rng.standard_normal((max(RECORDS), PRIMARIES))
    z = first + np.cumsum(steps, axis=0)
    multiple = (z[:, ways.member[which]] * ways.factor[which]).sum(axis=2)
    found = np.column_stack([z, multiple])
    # Depths are those of the array plus what is heard; a peg-leg is as wrong as a primary.
    found += ERROR * rng.standard_normal((len(found), 1))
    return found + ERROR * rng.standard_normal(found.shape), np.append(
        np.ones(PRIMARIES), ways.sign[which]
    )


def multiples_marked(
    rng: np.random.Generator, walk: float, polarity: str
) -> dict[int, np.ndarray]:
    """Which reflectors are marked (K,) after so many records, primaries first."""
    config = FathometerConfig(polarity=polarity, depth_std=max(walk, 0.02))
    found, sign = drawn(rng, walk)
    if polarity == 'positive':
        sign = np.ones(len(sign))
    marked, kept = Multiples(), {}
    for k, depth in enumerate(found, start=1):
        order = np.argsort(depth)
        ids = (1 + order).astype(np.uint32)
        variance = np.full(len(depth), ERROR**2)
        seen = Seen(ids, depth[order], variance, sign[order], ERROR**2)
        if k in RECORDS:
            probability = np.empty(len(depth))
            probability[order] = marked.probabilities(seen, config, DEEPEST)
            kept[k] = probability > 0.5
        marked = marked.after(seen)
    return kept


def multiples(runs: int) -> Parts:
    for name, walk in FLOORS.items():
        for label, polarity in (('no sign', 'positive'), ('sign', 'both')):
            rng = np.random.default_rng(1)
            found = [multiples_marked(rng, walk, polarity) for _ in range(runs)]
            row: dict[str, float] = {'runs': float(runs)}
            for k in RECORDS:
                marked = np.array([each[k] for each in found])
                row[f'{k}: found'] = float(marked[:, PRIMARIES:].mean())
                row[f'{k}: falsely'] = float(marked[:, :PRIMARIES].mean())
            yield {'multiples': {f'{name}, {label}': row}}


PARTS = ('pressure', *CASES, 'multiples')


def main(
    runs: int = 20, particles: int = 5000, drawn: int = 400, parts: Sequence[str] = PARTS
) -> Parts:
    """drawn: runs of the tracks with multiples."""
    yield {'runs': runs, 'particles': particles}
    # Rows of one level and scene see the same noise, which is drawn once.
    wanted = ROWS if 'pressure' in parts else ()
    for (level, changes), group in groupby(wanted, key=lambda name: ROWS[name][:2]):
        names = list(group)
        options = [{'particles': particles, **ROWS[name][2]} for name in names]
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        for seed in range(runs):
            for name, each in zip(names, with_pressure(level, changes, options, seed)):
                found[name].append(each)
                yield {'table': {name: {'runs': seed + 1, **row_of(found[name])}}}
    for case in CASES:
        scored: dict[str, list[Mapping[str, float]]] = {}
        for seed in range(runs if case in parts else 0):
            for name, row in CASES[case](seed, particles).items():
                scored.setdefault(name, []).append(row)
        for name, rows in scored.items():
            yield {'gaps': {name: {'runs': len(rows)} | mean_of(rows)}}
    if 'multiples' in parts:
        yield from multiples(drawn)


if __name__ == '__main__':
    study(main, parts={'choices': PARTS})
