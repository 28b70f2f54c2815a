# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Labels of rough floor over range, roughness and correlation, and how often they are right.

    python -m benchmarks.bathymetry_labels --out docs/results/bathymetry_labels.json

`cells`: overlap of a rough patch with the bins that are more probably rough than not, for three
sets of models: the default, `height_bank` and `scatter_bank`. The patch lies at 20 to 26, 40 to 50
or 58 to 68 m; its heights are white, or correlated as exp(-distance / length). `exact`: what can
be had at most, by the exact smoother that is told the level of the floor and the law of the
heights, and the share of bins of which it is not sure (.1 to .9). `floors`: the same
on slopes and undulations, and with Gaussian correlation, a fourth of the pings. `calibration`:
bins of all cells in which roughness of the patch is detectable, by the probability of rough floor:
how many, the mean probability and the share that is rough. `verdicts`: bins called smooth and
rough, and how many of them are; the smooth ones by whether the patch is as rough as `rough_std`.
`amplitude`: with the power of the echoes as further evidence, where the patch is brighter by so
much, and known to be; a fourth of the pings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from attrs import evolve, fields
import numpy as np
from scipy.special import kve

from benchmarks.study import Parts, study, truths
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.grid_kernels import state_log_likelihoods
from sonar_imm.trackers.bathymetry.ping import (
    CANNOT_TELL,
    estimate_of,
    Look,
    look,
    Ping,
    ROUGH,
    run,
    SMOOTH,
)
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig
from sonar_imm.truth import TrueProfile
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

SETS = {
    'two walks': BathymetryConfig(model_set='height_two_rw', layover='ignored'),
    'height_bank': BathymetryConfig(model_set='height_bank', layover='ignored'),
    'scatter_bank': BathymetryConfig(model_set='scatter_bank', layover='ignored'),
}
PATCHES = {'20-26 m': (20.0, 26.0), '40-50 m': (40.0, 50.0), '58-68 m': (58.0, 68.0)}
STDS = (0.1, 0.2, 0.3, 0.5)
LENGTHS = {'white': 0.0, '.3 m': 0.3, '1 m': 1.0}
FLOORS: dict[str, dict[str, Any]] = {
    'slope .1': {'slope': 0.1},
    'slope .1, patch of .3 m': {'slope': 0.1, 'patch_std': 0.3},
    'undulation .5 m in 15 m': {'undulation_height': 0.5, 'undulation_length': 15.0},
    'undulation .2 m in 20 m': {'undulation_height': 0.2, 'undulation_length': 20.0},
    'Gaussian 1 m': {'correlation_length': 1.0},
    'Gaussian 1 m, patch of .2 m': {'correlation_length': 1.0, 'patch_std': 0.2},
    'no patch': {'patch_std': 0.0},
    'no patch, slope .1': {'patch_std': 0.0, 'slope': 0.1},
    'no patch, undulation .5 m in 15 m': {
        'patch_std': 0.0,
        'undulation_height': 0.5,
        'undulation_length': 15.0,
    },
}
BECOMES_ROUGH, BECOMES_SMOOTH = 1.0 / 400.0, 1.0 / 200.0
"""Per bin, as `exact` is told: the patches have 120 to 200 of 600 bins."""
CELLS, REACH = 121, 5.0
"""Of the grid of `exact`, and how many standard deviations of the roughness it reaches."""
AROUND, WHOLE = 15.0, 1e3
"""Of a ping the bins so near to the middle of the patch are used, m: of `floors` all."""
EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
CONTRASTS = {'3 dB': 3.0, '6 dB': 6.0}


class Labels:
    """Bins of pings: probability of rough floor, whether they are, what is said, and the standard
    deviation that roughness needs to be seen."""

    def __init__(self) -> None:
        self.rough: list[FloatArray] = []
        self.patch: list[BoolArray] = []
        self.verdict: list[FloatArray] = []
        self.detectable: list[FloatArray] = []
        self.std: list[FloatArray] = []

    def add(self, seen: Look, favour: FloatArray | None, truth: Any, std: float) -> None:
        """One ping whose patch is as rough as `std`."""
        track = run(seen, favour)
        table = estimate_of(seen, track).extras
        chosen = truth.valid & (table['valid'] > 0)
        self.rough.append(track.probability[:, seen.models.rough].sum(axis=1)[chosen])
        self.patch.append((truth.patch & (std > 0.0))[chosen])
        self.verdict.append(table['told'][chosen])
        self.detectable.append(table['detectable_std'][chosen].astype(float))
        self.std.append(np.full(int(chosen.sum()), std))

    def extend(self, other: Labels) -> None:
        for name, part in vars(other).items():
            getattr(self, name).extend(part)

    def whole(self) -> tuple[np.ndarray, ...]:
        parts = (self.rough, self.patch, self.verdict, self.detectable, self.std)
        return tuple(np.concatenate(part) for part in parts)

    def overlap(self) -> float:
        rough, patch, *_ = self.whole()
        label = rough > 0.5
        return float((label & patch).sum() / max((label | patch).sum(), 1))

    def row(self) -> dict[str, float]:
        """Overlap, bins of smooth floor called rough, bins that cannot be told."""
        _, patch, verdict, *_ = self.whole()
        return {
            'overlap': self.overlap(),
            'falsely_rough': float((verdict[~patch] == ROUGH).mean()),
            'cannot_tell': float((verdict == CANNOT_TELL).mean()),
        }


def exact(seen: Look, std: float, kept: float) -> FloatArray:
    """Probability (T,) of rough floor on flat floor at height 0 whose roughness is normal with a
    standard deviation of `std` m and a correlation of `kept` from bin to bin; forward-backward
    over smooth floor and the heights of rough floor."""
    ping = seen.likelihood
    heights = std * np.linspace(-REACH, REACH, CELLS)
    places = np.append(heights, 0.0)
    law = np.exp(-0.5 * np.square(heights / std))
    law /= law.sum()
    off = (heights[None, :] - kept * heights[:, None]) / (std * np.sqrt(1.0 - kept * kept))
    walk = np.exp(-0.5 * np.square(off))
    walk /= walk.sum(axis=1, keepdims=True)
    step = np.zeros((CELLS + 1, CELLS + 1))
    step[:-1, :-1], step[:-1, -1] = (1.0 - BECOMES_SMOOTH) * walk, BECOMES_SMOOTH
    step[-1, :-1], step[-1, -1] = BECOMES_ROUGH * law, 1.0 - BECOMES_ROUGH
    T = len(ping.ranges)
    level, sines, work = np.zeros((T, len(places))), np.empty(len(places)), np.empty((4, 256))
    for k in np.flatnonzero(ping.echo).tolist():
        state_log_likelihoods(places, ping, k, sines, work, level[k])
    level = np.exp(level - level.max(axis=1, keepdims=True))
    share = BECOMES_ROUGH / (BECOMES_ROUGH + BECOMES_SMOOTH)
    before = np.empty_like(level)
    p = np.append(share * law, 1.0 - share)
    for t in range(T):
        before[t] = p
        p = p * level[t]
        p = p / p.sum() @ step
    rough, later = np.empty(T), np.ones(len(places))
    for t in range(T - 1, -1, -1):
        later = later * level[t] / later.max()
        p = before[t] * later
        rough[t] = p[:-1].sum() / p.sum()
        later = step @ later
    return rough


def pings(
    changes: Mapping[str, Any], count: int, seed: int, around: float = AROUND
) -> Iterator[tuple[Snapshot, Any]]:
    """Snapshots and what is true of them, within `around` m of the middle of the patch."""
    config = scenario('paper', {'pings': count, **changes})
    scene = simulate(config, seed)
    for item, truth in zip(scene.measurements, truths(scene, TrueProfile)):
        near = np.abs(truth.range - 0.5 * (config.patch_start + config.patch_end)) < around
        yield part_of(item.measurement, near), part_of(truth, near)


def part_of(table: Any, bins: BoolArray) -> Any:
    """Some bins of a snapshot, or of what is true of it."""
    values = {e.name: getattr(table, e.name) for e in fields(type(table)) if e.init}
    return evolve(
        table,
        **{
            name: value[bins]
            for name, value in values.items()
            if isinstance(value, np.ndarray) and len(value) == len(bins)
        },
    )


def most(changes: Mapping[str, Any], count: int, seed: int, length: float) -> tuple[float, float]:
    """Overlap of `exact` with the patch, and the share of bins of which it is not sure."""
    both = either = unsure = bins = 0
    for snapshot, truth in pings(changes, count, seed):
        seen = look(Ping(SETS['two walks'], snapshot, None))
        kept = float(np.exp(-np.diff(snapshot.range).mean() / length)) if length else 0.0
        used = truth.valid & seen.likelihood.echo
        p, patch = exact(seen, changes['patch_std'], kept)[used], truth.patch[used]
        both += int(((p > 0.5) & patch).sum())
        either += int(((p > 0.5) | patch).sum())
        unsure, bins = unsure + int(((p > 0.1) & (p < 0.9)).sum()), bins + len(p)
    return both / either, unsure / bins


def labelled(
    changes: Mapping[str, Any], count: int, seed: int, around: float = AROUND
) -> dict[str, Labels]:
    """What each set makes of the same pings."""
    std = float(changes.get('patch_std', 0.5))
    found = {name: Labels() for name in SETS}
    for snapshot, truth in pings(changes, count, seed, around):
        for name, config in SETS.items():
            found[name].add(look(Ping(config, snapshot, None)), None, truth, std)
    return found


def calibration(labels: Labels) -> dict[str, dict[str, float]]:
    """By class of probability, bins where the roughness of the patch is detectable."""
    rough, patch, _, detectable, std = labels.whole()
    chosen = detectable <= std
    table = {}
    for low, high in zip(EDGES, EDGES[1:]):
        bins = chosen & (rough >= low) & ((rough < high) | (high == 1.0))
        if bins.sum() >= 20:
            table[f'{low:g} to {high:g}'] = {
                'bins': int(bins.sum()),
                'said': float(rough[bins].mean()),
                'right': float(patch[bins].mean()),
            }
    return table


def verdicts(labels: Labels) -> dict[str, float]:
    """How often smooth and rough are right."""
    _, patch, verdict, _, std = labels.whole()
    smooth, rough = verdict == SMOOTH, verdict == ROUGH
    strong = std >= 0.3 - 1e-9
    return {
        'smooth': float(smooth.mean()),
        'rough': float(rough.mean()),
        'cannot_tell': float((verdict == CANNOT_TELL).mean()),
        'smooth_right': float((~patch)[smooth & strong].mean()),
        'smooth_right_weaker': float((~patch)[smooth & ~strong].mean()),
        'rough_right': float(patch[rough].mean()),
        'undetectable_smooth': float((smooth & (labels.whole()[3] > 0.3)).mean()),
    }


def brightness(snapshot: Snapshot, expected: FloatArray, contrast: float) -> FloatArray:
    """Likelihood ratio (T,) of floor brighter by `contrast` to floor as expected, of echoes whose
    power is the product of two exponential numbers: 2 K0(2 sqrt(x)) for x in its mean."""
    power = np.square(np.abs(snapshot.iq)).mean(axis=1) / expected

    def log_density(x: FloatArray) -> FloatArray:
        root = 2.0 * np.sqrt(x)
        return np.asarray(np.log(kve(0, root)) - root)

    ratio = log_density(power / contrast) - np.log(contrast) - log_density(power)
    return np.asarray(np.exp(np.clip(ratio, -5.0, 5.0)))


def amplitude(
    changes: Mapping[str, Any], decibels: float, count: int, seed: int
) -> dict[str, dict[str, float]]:
    """Labels without and with the power as evidence, where the patch is brighter; each echo's
    expected power is known, as it is not at sea."""
    config = SETS['scatter_bank']
    std = float(changes.get('patch_std', 0.5))
    contrast = 10.0 ** (0.1 * decibels)
    without, using = Labels(), Labels()
    scene = scenario('paper', {'pings': count, **changes})
    for snapshot, truth in pings({**changes, 'state_signal': True}, count, seed):
        assert snapshot.signal_variance is not None
        expected = np.asarray(snapshot.signal_variance) + scene.noise_variance
        gain = np.where(truth.patch, np.sqrt(contrast), 1.0)[:, None]
        bright = evolve(snapshot, iq=(snapshot.iq * gain).astype(np.complex64))
        seen = look(Ping(config, bright, None))
        ratio = brightness(bright, expected, contrast)
        # The factors of a favour lie on the prediction, where the bin itself does as well.
        favour = np.where(seen.models.rough, ratio[:, None], 1.0)
        without.add(seen, None, truth, std)
        using.add(seen, favour, truth, std)
    rows = {'without': without.row(), 'with': using.row()}
    for name, labels in (('without', without), ('with', using)):
        rough, patch, *_ = labels.whole()
        rows[name]['rough_share'] = float((rough > 0.5).mean())
    return rows


def main(count: int = 40, seed: int = 1, only: str = '') -> Parts:
    yield {'pings': count, 'seed': seed}
    if only in ('', 'cells'):
        whole = {name: Labels() for name in SETS}
        for place, (start, end) in PATCHES.items():
            for std in STDS:
                for kind, length in LENGTHS.items():
                    changes = {
                        'patch_start': start,
                        'patch_end': end,
                        'patch_std': std,
                        'correlation_length': length,
                        'roughness_law': 'exponential',
                    }
                    found = labelled(changes, count, seed)
                    for name, labels in found.items():
                        whole[name].extend(labels)
                    row = {name: labels.overlap() for name, labels in found.items()}
                    row['exact'], row['exact_unsure'] = most(changes, count, seed, length)
                    yield {'cells': {f'{place}, {std:g} m, {kind}': row}}
        yield {'calibration': {name: calibration(labels) for name, labels in whole.items()}}
        yield {'verdicts': {name: verdicts(labels) for name, labels in whole.items()}}
    if only in ('', 'floors'):
        for name, changes in FLOORS.items():
            found = labelled(changes, max(count // 4, 1), seed, WHOLE)
            for title, labels in found.items():
                yield {'floors': {f'{name}, {title}': labels.row()}}
    if only in ('', 'amplitude'):
        far = {'patch_start': 58.0, 'patch_end': 68.0}
        for name, decibels in CONTRASTS.items():
            for std in (0.3, 0.0):
                rows = amplitude({**far, 'patch_std': std}, decibels, max(count // 4, 1), seed)
                for kind, row in rows.items():
                    yield {'amplitude': {f'{name}, patch of {std:g} m, {kind}': row}}


if __name__ == '__main__':
    study(main, only={'choices': ['', 'cells', 'floors', 'amplitude']})
