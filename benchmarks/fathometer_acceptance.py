# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the fathometer has to show on the vectors, through ``track``, with the runs stated.

    python -m benchmarks.fathometer_acceptance --out docs/results/fathometer_acceptance.json

Each set of vectors is written as a bag and tracked by the command with that many seeds; every
number is the mean over the seeds, with the worst beside it, and the limit. What is no recording
(the exact filter, signed likelihoods, depths in the sediment, the processors on ``pressure.npz``)
does not go through the command: `fathometer_vectors` has it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import io
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks import fathometer_vectors
from benchmarks.fathometer_paper import reflectors
from benchmarks.fathometer_paper import score as score_of
from benchmarks.study import Parts, rms, study
from msg_adapters.array_records import write_trace
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Trace
from sonar_imm_tools.cli import main as command
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.simulation.fathometer.scenario import PRESENT

FOLDER = Path(__file__).parents[1] / 'test' / 'vectors'
Truth = Mapping[str, np.ndarray]
Score = Callable[[Sequence[Estimate], Truth], dict[str, float]]
SECOND = 10**9


def write_bag(truth: Truth, out: Path) -> None:
    """One trace per record, a second apart, as the vectors have them."""
    depth = truth['depth'].astype(float)
    sigma = np.broadcast_to(np.ravel(truth['sigma']).astype(float), len(truth['amplitude']))
    reference = truth.get('array_depth', truth.get('reference_depth'))
    reference = np.broadcast_to(np.ravel(reference), len(sigma)) if reference is not None else None
    with BagWriter(out) as bag:
        for k, amplitude in enumerate(truth['amplitude'].astype(float)):
            trace = Trace(
                stamp_ns=(k + 1) * SECOND,
                frame_id='array',
                depth=depth,
                amplitude=amplitude,
                sigma=np.full(len(depth), sigma[k]),
                reference_depth=None if reference is None else float(reference[k]),
            )
            bag.write('/trace', write_trace(trace, ros_message), trace.stamp_ns)


def depths_at(truth: Truth, estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """True depths and signs of a record."""
    record = estimate.stamp_ns // SECOND - 1
    strength = truth['reflector_amplitude']
    if strength.ndim == 1:
        return truth['reflector_depth'][record], np.sign(strength)
    there = strength[record] > PRESENT * np.nanmax(strength, axis=0)
    return truth['reflector_depth'][record, there], np.ones(there.sum())


def sets(found: Sequence[Estimate], truth: Truth, after: int) -> dict[str, float]:
    """P, OSPA and wrong signs of the records later than `after`."""
    scores, wrong = [], 0
    for estimate in found:
        if estimate.stamp_ns <= after * SECOND:
            continue
        depth, sign = depths_at(truth, estimate)
        z = reflectors(estimate)
        scores.append(score_of(estimate, depth))
        near = np.abs(z[:, :1] - depth) < 0.3
        wrong += int((near & (np.sign(z[:, 1:2]) != sign)).sum())
    right, distance = np.array(scores).T
    return {
        'P': float(np.mean(right)),
        'OSPA, m': float(np.mean(distance)),
        'wrong signs': float(wrong),
    }


def heave(found: Sequence[Estimate], truth: Truth) -> dict[str, float]:
    common, relative = [], []
    for estimate in found:
        depth, _ = depths_at(truth, estimate)
        if estimate.stamp_ns > 20 * SECOND and len(estimate) == len(depth):
            error = estimate.state[:, 0] - depth
            common.append(error.mean())
            relative += list(error - error.mean())
    values = sets(found, truth, 20)
    del values['wrong signs']
    return values | {
        'common, m': rms(common),
        'relative, m': rms(relative),
    }


def multiples(found: Sequence[Estimate], truth: Truth) -> dict[str, float]:
    is_multiple = truth['is_multiple'].astype(bool)
    flags: tuple[list[bool], list[bool]] = ([], [])
    for estimate in found:
        if estimate.stamp_ns > 10 * SECOND:
            depth, _ = depths_at(truth, estimate)
            away = np.abs(estimate.state[:, :1] - depth)
            near, which = away.min(axis=1) < 0.3, is_multiple[away.argmin(axis=1)]
            marked = estimate.extras['multiple_probability'] > 0.5
            for kind, into in zip((which, ~which), flags):
                into.extend(marked[near & kind])
    return {'flagged': float(np.mean(flags[0])), 'primaries': float(np.mean(flags[1]))}


CASES: dict[str, tuple[str, tuple[str, ...], Score, dict[str, float]]] = {
    'negative': (
        'fathometer_sea/negative.npz',
        ('polarity=both',),
        lambda found, truth: sets(found, truth, 5),
        {'P': 0.95, 'OSPA, m': -0.03, 'wrong signs': -0.0},
    ),
    'negative, positive only': (
        'fathometer_sea/negative.npz',
        (),
        lambda found, truth: {'P': sets(found, truth, 5)['P']},
        {'P': -0.05},
    ),
    'heave': (
        'fathometer_sea/heave.npz',
        ('heave=independent', 'array_depth_std=0.5'),
        heave,
        {'P': 0.95, 'OSPA, m': -0.18, 'common, m': -0.20, 'relative, m': -0.02},
    ),
    'multiples': (
        'fathometer_sea/multiples.npz',
        ('polarity=both',),
        multiples,
        {'flagged': 0.85, 'primaries': -0.05},
    ),
    'mvdr_traces': (
        'fathometer/mvdr_traces.npz',
        (),
        lambda found, truth: {k: v for k, v in sets(found, truth, 0).items() if k[0] in 'PO'},
        {'P': 0.94, 'OSPA, m': -0.07},
    ),
}
"""Name: vectors, parameters, score, limits: at least so much, or at most where negative."""


def tracked(
    file: str, settings: Sequence[str], score: Score, runs: int, particles: int
) -> list[dict[str, float]]:
    """The scores of the command on one set of vectors, of each seed."""
    with np.load(FOLDER / file) as kept:
        truth = {key: kept[key] for key in kept}
    found = []
    with TemporaryDirectory() as folder:
        write_bag(truth, Path(folder) / 'bag')
        for seed in range(runs):
            out = Path(folder) / f'out_{seed}'
            given = (*settings, f'seed={seed}', f'particles={particles}')
            words = [word for each in given for word in ('--set', each)]
            with contextlib.redirect_stdout(io.StringIO()):
                if command(['track', f'{folder}/bag', str(out), *words]):
                    raise SystemExit(f'track failed on {file}')
            found.append(score(RunFolder(out).read_estimates(), truth))
    return found


def entry(values: Sequence[float], bound: float, most: bool) -> dict[str, float]:
    """A row of the table; most: the bound is the greatest that is allowed, not the least."""
    worst = max(values) if most else min(values)
    mean, side = float(np.mean(values)), 'at most' if most else 'at least'
    good = mean <= bound if most else mean >= bound
    return {'mean': mean, 'worst': float(worst), side: bound, 'good': bool(good)}


def main(runs: int = 4, particles: int = 20_000) -> Parts:
    yield {'runs': runs, 'particles': particles}
    for name, (file, settings, score, limits) in CASES.items():
        found = tracked(file, settings, score, runs, particles)
        for key, limit in limits.items():
            most = key not in ('P', 'flagged') or limit < 0.0
            row = entry([scores[key] for scores in found], abs(limit), most)
            yield {'table': {f'{name}: {key}': row}}
    for name, values in fathometer_vectors.rows(FOLDER, runs).items():
        yield {'table': {name: entry(values, fathometer_vectors.LIMITS[name], True)}}


if __name__ == '__main__':
    study(main, digits=4, runs={'help': 'seeds'})
