# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of estimated floors: errors, coverage of the stated band, and segmentation.

Heights and angles are scored in bins with an echo. Shadows are scored apart, because there the
estimate is a prediction of the models. The segmentation is scored by labels: rough where the rough
models have more than half of the probability. Where the estimate has both surfaces of a bin, each
is compared with the nearest of the true ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sonar_imm.estimation.arrays import FloatArray

from ... import SECOND
from ..numbers import error_summary
from .profiles import BoolArray, Profile, Swath, TrueFloor

BAND = 2.0
"""Half width of the band in figures and scores, in standard deviations."""

Known = list[tuple[Profile, TrueFloor]]
"""The pings whose true floor is known."""

_PLACES: dict[str, Callable[[TrueFloor], BoolArray]] = {
    'all': lambda truth: truth.echo,
    'smooth': lambda truth: truth.echo & ~truth.patch,
    'patch': lambda truth: truth.echo & truth.patch,
    'shadow': lambda truth: ~truth.echo & np.isfinite(truth.angle),
}


def score(swath: Swath) -> dict[str, Any]:
    """All metrics of a run as plain numbers; without truth only those that need none."""
    profiles = swath.profiles
    stamps = [profile.stamp_ns for profile in profiles]
    metrics: dict[str, Any] = {
        'pings': len(profiles),
        'span_s': (max(stamps) - min(stamps)) / SECOND if stamps else 0.0,
        'bins': sum(len(profile.range) for profile in profiles),
        'heard_share': _mean([profile.echoes for profile in profiles]),
        'rough_share': _mean([swath.roughness(profile) > 0.5 for profile in profiles]),
        'height_std_median_m': _median([profile.height_std for profile in profiles]),
    }
    looked = [profile.two for profile in profiles if profile.two is not None]
    if looked:
        metrics['two_share'] = _mean(looked)
    metrics |= _verdicts(profiles)
    known = [(profile, profile.truth) for profile in profiles if profile.truth is not None]
    if known:
        metrics |= {'scored_pings': len(known), **_errors(known), 'gate': _gate(known)}
        metrics |= _layover(known)
        if swath.rough.any():
            metrics['segmentation'] = segmentation(swath, known)
    return metrics


def _errors(known: Known) -> dict[str, Any]:
    """Errors of height and angle, and the share inside the band, by place."""
    height: dict[str, Any] = {}
    angle: dict[str, Any] = {}
    inside: dict[str, float] = {}
    for place, choose in _PLACES.items():
        high, turn, held = [], [], []
        for profile, truth in known:
            bins = choose(truth)
            error = height_error(profile, truth)[bins]
            high.append(error)
            turn.append(np.degrees(np.abs(profile.angle - truth.angle)[bins]))
            held.append(error <= BAND * profile.height_std[bins])
        height[place] = error_summary(_finite(high))
        angle[place] = error_summary(_finite(turn), unit='deg')
        inside[place] = _mean(held)
    return {'height': height, 'angle': angle, 'inside_band': inside}


def height_error(profile: Profile, truth: TrueFloor) -> FloatArray:
    """Error (n,) of the height, of the lower one where the estimate has two."""
    error = np.abs(profile.height - truth.height)
    if profile.upper is None or profile.two is None:
        return error
    return np.where(profile.two, truth.to_nearest(profile.height), error)


def _gate(known: Known) -> dict[str, Any]:
    """How well the gate tells shadow from echo."""
    shadow = [profile.echoes[_PLACES['shadow'](truth)] for profile, truth in known]
    echo = [profile.echoes[truth.echo] for profile, truth in known]
    return {
        'shadow_bins': sum(map(len, shadow)),
        'shadow_passed_over': 1.0 - _mean(shadow),
        'echo_heard': _mean(echo),
    }


def _layover(known: Known) -> dict[str, Any]:
    """How many bins with two surfaces were found, become soundings all the same, how many with one
    were lost, and how far the heights of two lie from the nearest true one; empty where the truth
    or the estimate does not say it."""
    two, single, kept, off, held = [], [], [], [], []
    for profile, truth in known:
        if truth.surfaces is not None and profile.two is not None:
            two.append(profile.two[truth.surfaces > 1])
            kept.append(profile.valid[truth.surfaces > 1])
            single.append(profile.two[truth.surfaces == 1])
        if profile.two is not None and profile.upper is not None:
            for height, std in ((profile.height, profile.height_std), profile.upper):
                error = truth.to_nearest(height)[profile.two & truth.echo]
                off.append(error)
                held.append(error <= BAND * std[profile.two & truth.echo])
    if not two:
        return {}
    counts = {'bins': sum(map(len, two)), 'found': _mean(two), 'soundings': _mean(kept)}
    scores: dict[str, Any] = {**counts, 'lost': _mean(single)}
    if off:
        scores['heights'] = {**error_summary(_finite(off)), 'inside_band': _mean(held)}
    return {'layover': scores}


def _verdicts(profiles: Sequence[Profile]) -> dict[str, Any]:
    """Shares of the bins with an echo that are called smooth and rough, and where the truth is
    known how many of these are; the others cannot be told. Empty for runs of older versions."""
    called: dict[str, list[BoolArray]] = {'smooth': [], 'rough': []}
    right: dict[str, list[BoolArray]] = {'smooth': [], 'rough': []}
    for profile in profiles:
        if profile.verdict is None:
            return {}
        for value, name in enumerate(called):
            bins = profile.valid & (profile.verdict == value)
            called[name].append(bins[profile.valid])
            if profile.truth is not None:
                patch = profile.truth.patch if name == 'rough' else ~profile.truth.patch
                right[name].append(patch[bins & profile.truth.echo])
    if not called['rough']:
        return {}
    shares = {name: _mean(parts) for name, parts in called.items()}
    verdicts = {**shares, 'cannot_tell': 1.0 - sum(shares.values())}
    verdicts |= {f'{name}_right': _mean(parts) for name, parts in right.items() if parts}
    return {'verdicts': verdicts}


def segmentation(swath: Swath, known: Known) -> dict[str, Any]:
    """Overlap of the labels with the true patches, and by how many bins their ends are late."""
    both = either = rough = true = 0
    late_in, late_out, missed = [], [], 0
    for profile, truth in known:
        label, patch, echo = swath.roughness(profile) > 0.5, truth.patch, truth.echo
        both += int((label & patch & echo).sum())
        either += int(((label | patch) & echo).sum())
        rough += int((label & echo).sum())
        true += int((patch & echo).sum())
        for begin, end in runs(patch):
            found = np.flatnonzero(label[begin:end])
            if not len(found):
                missed += 1
                continue
            late_in.append(int(found[0]))
            smooth = np.flatnonzero(~label[end:])
            late_out.append(int(smooth[0]) if len(smooth) else len(label) - end)
    return {
        'iou': both / either if either else float('nan'),
        'recall': both / true if true else float('nan'),
        'precision': both / rough if rough else float('nan'),
        'patches': len(late_in) + missed,
        'patches_missed': missed,
        'bins_late_in': float(np.median(late_in)) if late_in else float('nan'),
        'bins_late_out': float(np.median(late_out)) if late_out else float('nan'),
    }


def runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Begin and end of each run of true `flags`, the end not included."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in zip(edges[::2], edges[1::2])]


def _finite(parts: list[FloatArray]) -> FloatArray:
    values = np.concatenate(parts) if parts else np.empty(0)
    return values[np.isfinite(values)]


def _mean(parts: list[BoolArray]) -> float:
    values = np.concatenate(parts) if parts else np.empty(0)
    return float(values.mean()) if len(values) else float('nan')


def _median(parts: list[FloatArray]) -> float:
    values = _finite(parts)
    return float(np.median(values)) if len(values) else float('nan')
