# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimate and truth of each ping bin by bin, and their scores: errors, coverage of the band,
and segmentation.

Heights and angles are scored in bins with an echo. Shadows are scored apart, because there the
estimate is a prediction of the models. The segmentation is scored by labels: rough where the rough
models have more than half of the probability. Where the estimate has both surfaces of a bin, each
is compared with the nearest of the true ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import BoolArray, FloatArray, IntArray
from sonar_imm.soundings import SIDES
from sonar_imm.trackers.bathymetry.terrain import KINDS

from ... import SECOND
from ..columns import read_columns
from ..numbers import error_summary

_BINS = (
    'range?', 'valid', 'height?', 'angle?', 'beam_angle?', 'vertical_uncertainty?', 'rough?',
    'surfaces?', 'told?', 'height_2?', 'height_2_std?', 'vertical_uncertainty_2?',
)  # fmt: skip
_TRUE = ('range?', 'height?', 'angle?', 'patch?', 'valid?', 'surfaces?', 'height_2?')
FAR = 0.55
"""Share of a bin by which the range of the true floor may differ from that of the estimate: half a
bin, and a margin for single precision."""


@frozen(eq=False)
class TrueFloor:
    """The true floor at the bins of one ping, each (n,): height m and angle rad, NaN where
    unknown; patch: rough floor; echo: neither shadow nor water column; surfaces: how many answer,
    None where the truth does not say it, and height_2 m of the second strongest, NaN for none."""

    height: FloatArray
    angle: FloatArray
    patch: BoolArray
    echo: BoolArray
    surfaces: IntArray | None = None
    height_2: FloatArray | None = None

    def to_nearest(self, height: FloatArray) -> FloatArray:
        """Distance (n,) of heights (n,) to the nearest of the true surfaces, m."""
        off = np.abs(height - self.height)
        return off if self.height_2 is None else np.fmin(off, np.abs(height - self.height_2))


@frozen(eq=False)
class Profile:
    """The estimate of one ping, each (n,): height m, angle rad and their standard deviations;
    probabilities (n, M) of the models; valid: bins with an echo of one surface; two: bins with
    echoes of two, None where the tracker does not look for them; truth: None where unknown;
    side: empty where the estimate does not say it; rough: probability (n,) of rough floor where
    the estimate itself says it; verdict (n,): smooth 0, rough 1 or cannot
    tell 2, None where the estimate does not say it; upper: height m and standard deviation
    (n,) each of the upper of two surfaces, NaN for none, None where the tracker does not say them:
    the height is then that of the lower, and unsure (n,): bins with an echo of one surface or two.
    """

    stamp_ns: int
    range: FloatArray
    height: FloatArray
    height_std: FloatArray
    angle: FloatArray
    angle_std: FloatArray
    valid: BoolArray
    probabilities: FloatArray
    truth: TrueFloor | None
    side: str = ''
    rough: FloatArray | None = None
    two: BoolArray | None = None
    verdict: FloatArray | None = None
    upper: tuple[FloatArray, FloatArray] | None = None
    unsure: BoolArray | None = None

    @property
    def echoes(self) -> BoolArray:
        """Bins (n,) with an echo."""
        echoes = self.valid if self.two is None else self.valid | self.two
        return echoes if self.unsure is None else echoes | self.unsure


@frozen(eq=False)
class Swath:
    """All pings of a run in order; rough: which of `model_names` mean rough floor."""

    profiles: tuple[Profile, ...]
    model_names: tuple[str, ...]
    rough: BoolArray

    def roughness(self, profile: Profile) -> FloatArray:
        """Probability (n,) that the floor is rough; NaN when no model means rough floor."""
        if profile.rough is not None:
            return profile.rough
        if not self.rough.any():
            return np.full(len(profile.range), np.nan)
        return profile.probabilities[:, self.rough].sum(axis=1)


def profiles_of(estimates: Iterable[Estimate], truth: Iterable[Estimate] | None) -> Swath:
    """The estimates of a run, each with the truth of the same stamp and side."""
    known = {(table.stamp_ns, table.source): table for table in truth or ()}
    profiles: list[Profile] = []
    names: tuple[str, ...] = ()
    for estimate in estimates:
        names, stamp = estimate.model_names, estimate.stamp_ns
        # A single side that is no namespace: its truth names no side.
        true = known.get((stamp, estimate.source), known.get((stamp, 0)))
        profiles.append(profile_of(estimate, true))
    return Swath(tuple(profiles), names, rough_models(names))


def rough_models(names: tuple[str, ...]) -> BoolArray:
    """Return which models (M,) mean rough floor. Beside a constant slope it is the random walk,
    beside `steady` floor the rough `KINDS`; of walks, whose noise grows from model to model, the
    upper half. A single model never does."""
    if 'steady' in names:
        known = {kind.name for kind in KINDS if kind.rough}
        return np.array([name in known for name in names])
    if 'ncs' in names:
        return np.array([name == 'rw' for name in names])
    rough = np.arange(len(names)) >= len(names) // 2
    return rough & (len(names) > 1)


def profile_of(estimate: Estimate, truth: Estimate | None) -> Profile:
    """One ping; the state is a height or an angle, and the other one follows from it. With
    navigation the stated error is that of the soundings: pose and sound speed are in it."""
    missing = "the estimates are not those of a floor: there is no column '{}'"
    bins = read_columns(estimate, _BINS, missing)
    std = np.sqrt(estimate.covariance[:, 0, 0])
    # A small angle moves the point along the circle around the sonar: dh = |y| d(angle).
    arm = np.abs(estimate.xyz[:, 1].astype(np.float64))
    arm = np.where(arm > 0.0, arm, np.nan)
    in_angle = estimate.state_names[0] == 'angle'
    height_std = std * arm if in_angle else std
    if 'vertical_uncertainty' in estimate.extras:
        arm = np.abs(bins['range'] * np.sin(bins['beam_angle']))
        height_std = np.sqrt(bins['vertical_uncertainty'])
    upper = None
    if 'height_2' in estimate.extras:
        upper_std = bins['height_2_std']
        if 'vertical_uncertainty_2' in estimate.extras:
            upper_std = np.sqrt(bins['vertical_uncertainty_2'])
        upper = bins['height_2'], upper_std
    return Profile(
        stamp_ns=estimate.stamp_ns,
        range=bins['range'],
        height=bins['height'],
        height_std=height_std,
        angle=bins['angle'],
        angle_std=std if in_angle else std / arm,
        valid=bins['valid'] > 0,
        probabilities=estimate.probabilities,
        truth=None if truth is None else true_floor(truth, bins['range']),
        rough=bins['rough'] if 'rough' in estimate.extras else None,
        side=SIDES[estimate.source] if 'side' in estimate.extras else '',
        two=bins['surfaces'] == 2 if 'surfaces' in estimate.extras else None,
        verdict=bins['told'] if 'told' in estimate.extras else None,
        upper=upper,
        unsure=None if upper is None else (bins['surfaces'] == 1) & (bins['valid'] == 0),
    )


def true_floor(truth: Estimate, ranges: FloatArray) -> TrueFloor:
    """The true floor at `ranges` (n,); unknown in bins that the truth does not have."""
    where, height, angle, patch, valid, surfaces, second = read_columns(
        truth, _TRUE, "the truth is not that of a floor: it has no column '{}'"
    ).values()
    if not len(where):
        unknown, no = np.full(len(ranges), np.nan), np.zeros(len(ranges), bool)
        return TrueFloor(unknown, unknown, no, no)
    after = np.clip(np.searchsorted(where, ranges), 1, max(len(where) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(where) - 1)
    nearest = np.where(ranges - where[before] <= where[after] - ranges, before, after)
    width = float(np.median(np.diff(ranges))) if len(ranges) > 1 else np.inf
    found = np.abs(where[nearest] - ranges) <= FAR * width
    return TrueFloor(
        height=np.where(found, height[nearest], np.nan),
        angle=np.where(found, angle[nearest], np.nan),
        patch=found & (patch[nearest] > 0),
        echo=found & (valid[nearest] > 0),
        surfaces=np.where(found, surfaces[nearest], 0) if 'surfaces' in truth.extras else None,
        height_2=np.where(found, second[nearest], np.nan) if 'height_2' in truth.extras else None,
    )


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
    std = _finite([profile.height_std for profile in profiles])
    metrics: dict[str, Any] = {
        'pings': len(profiles),
        'span_s': (max(stamps) - min(stamps)) / SECOND if stamps else 0.0,
        'bins': sum(len(profile.range) for profile in profiles),
        'heard_share': _mean([profile.echoes for profile in profiles]),
        'rough_share': _mean([swath.roughness(profile) > 0.5 for profile in profiles]),
        'height_std_median_m': float(np.median(std)) if len(std) else float('nan'),
    }
    looked = [profile.two for profile in profiles if profile.two is not None]
    if looked:
        metrics['two_share'] = _mean(looked)
    metrics |= _verdicts(profiles)
    known = [(profile, profile.truth) for profile in profiles if profile.truth is not None]
    if known:
        shadow = [profile.echoes[_PLACES['shadow'](truth)] for profile, truth in known]
        metrics |= {'scored_pings': len(known), **_errors(known)}
        metrics['gate'] = {
            'shadow_bins': sum(map(len, shadow)),
            'shadow_passed_over': 1.0 - _mean(shadow),
            'echo_heard': _mean([profile.echoes[truth.echo] for profile, truth in known]),
        }
        metrics |= _layover(known)
        if swath.rough.any():
            metrics['segmentation'] = segmentation(swath, known)
    return metrics


def _errors(known: Known) -> dict[str, Any]:
    """Errors of height and angle, and the share inside the band, by place."""
    scores: dict[str, Any] = {'height': {}, 'angle': {}, 'inside_band': {}}
    for place, choose in _PLACES.items():
        high, turn, held = [], [], []
        for profile, truth in known:
            bins = choose(truth)
            error = height_error(profile, truth)[bins]
            high.append(error)
            turn.append(np.degrees(np.abs(profile.angle - truth.angle)[bins]))
            held.append(error <= BAND * profile.height_std[bins])
        scores['height'][place] = error_summary(_finite(high))
        scores['angle'][place] = error_summary(_finite(turn), unit='deg')
        scores['inside_band'][place] = _mean(held)
    return scores


def height_error(profile: Profile, truth: TrueFloor) -> FloatArray:
    """Error (n,) of the height, of the lower one where the estimate has two."""
    error = np.abs(profile.height - truth.height)
    if profile.upper is None or profile.two is None:
        return error
    return np.where(profile.two, truth.to_nearest(profile.height), error)


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
