# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Published estimates and warnings of the diver tracker."""

from __future__ import annotations

import numpy as np

from ...acoustics.geodesy import Origin
from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.association import TENTATIVE
from ...estimation.consistency import ENOUGH
from . import (
    arrival_stamps,
    births,
    burst_reports,
    bursts,
    clutter,
    depth,
    links,
    offsets,
    polling,
    ranges,
    sides,
)
from .config import DiverConfig
from .known import Known
from .models import FAMILIES, HOVER, ModelSet
from .pruning import PUBLISH_EXISTENCE
from .scales import estimated_scales, weight_without_small_scales


def estimate_of(
    known: Known, models: ModelSet, config: DiverConfig, frame_id: str, origin: Origin | None
) -> Estimate:
    """Return the estimate of a scan. origin: geodetic origin of the frame; None if unknown."""
    # The existence is NaN for tracks confirmed by hits.
    existence = links.existence_beside_bursts(known)
    shown = ~(existence <= PUBLISH_EXISTENCE)
    known, existence = known.select(shown), existence[shown]
    mean, covariance = published_state(known, models, config.burst_end)
    if known.memory['recent'].pairs:
        places = sides.likely_positions(known, models, mean)
        covariance = offsets.with_assumed_errors(
            known.memory['recent'], places, covariance, config
        )
    if known.memory['fixes'].errors_last(config.fix_bias_std > 0.0):
        covariance = with_fix_covariance(known['reported'], covariance)
    xyz = np.full((len(mean), 3), config.target_z)
    dimensions = 3 if models.height >= 0 else 2
    xyz[:, :dimensions] = mean[:, :dimensions]
    extras: dict[str, np.ndarray] = {
        'track_id': known.life.track_id,
        'track_state': known.life.status,
        'nis': known['nis'],
        'nis_dof': known['nis_dof'],
        'existence': existence,
        'target_id': known['target_id'].astype(np.int32),
        **sides.side_columns(known, models),
        **family_extras(known, models),
    }
    if models.height >= 0 and models.rows_per_track > 1:
        extras['depth_ambiguous'] = depth.ambiguous_depths(known, models).astype(np.uint8)
    if origin is not None:
        flat = models.height < 0
        place = origin.at_height(xyz[:, :2], config.target_z) if flat else origin.geodetic(xyz)
        extras |= {'latitude': place[:, 0], 'longitude': place[:, 1]}
    return Estimate(
        stamp_ns=known.stamp_ns,
        frame_id=frame_id,
        xyz=xyz,
        state_names=models.outputs,
        state=mean,
        covariance=covariance,
        model_names=models.names,
        probabilities=known.rows.model_probabilities(),
        extras=extras,
    )


def published_state(
    known: Known, models: ModelSet, burst_end: float
) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, q) and covariance (T, q, q) of the published state.

    All rows contribute to the mean. Only rows with scale >= 1 contribute to the covariance,
    because fixes that are better than reported look like fixes with time-correlated errors. If the
    reported covariances are correct, the row of scale 1 is the optimal filter, whose error is
    uncorrelated with all other estimates. The covariance of the mean is then its covariance plus
    the squared difference. If fixes are better, the result is conservative.
    """
    rows, each = known.rows, bursts.row_readings(known.rows, models, burst_end)
    mean, covariance = rows.combine(*each, rows.weight)
    if len(models.scales) > 1:
        own, covariance = rows.combine(*each, weight_without_small_scales(rows))
        off = mean - own
        covariance = covariance + off[:, :, None] * off[:, None, :]
    return mean, covariance


def with_fix_covariance(reported: FloatArray, covariance: FloatArray) -> FloatArray:
    """Add the covariance of one fix, `reported` (T, 3), to that of the positions (T, q, q).

    Filtering does not reduce an error that lasts. `reported`: see `fixes.FEATURES`.
    """
    xx, xy, yy = np.nan_to_num(reported).T
    covariance = covariance.copy()
    covariance[:, :2, :2] += np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0)
    return covariance


def family_extras(known: Known, models: ModelSet) -> dict[str, FloatArray]:
    """Return the extra columns of families."""
    if models.families is None:
        return {}
    each = known.rows.model_probabilities()
    family = np.eye(len(FAMILIES))[models.families.family]
    out = {f'family_{name}': each @ family[:, k] for k, name in enumerate(FAMILIES)}
    out['hover'] = each @ (models.families.kind == HOVER)
    rows, T = known.rows, len(known)
    out['covariance_scale'] = estimated_scales(rows, known.memory['reporting'])
    off = rows.key['offset'] >= 0
    weight = np.where(off, rows.weight, 0.0)
    out['burst'] = rows.total(weight, T)
    likely = np.where(out['burst'] > 0.5, out['burst'], np.nan)
    offset = bursts.row_offsets(rows) * weight[:, None]
    for axis, name in enumerate(('offset_x', 'offset_y')):
        out[name] = rows.total(offset[:, axis], T) / likely
    out['rows'] = rows.total(np.ones(len(rows)), T)
    return out


def health(known: Known, waiting: int) -> dict[str, float]:
    """Return the numbers for diagnostics. waiting: number of fixes that wait for the vessel
    pose."""
    hit = known['nis_dof'] > 0
    mean = float(np.mean(known['nis'][hit] / known['nis_dof'][hit])) if hit.any() else float('nan')
    return {
        'tracks': len(known),
        'confirmed': int((known.life.status != TENTATIVE).sum()),
        'nis_mean': mean,
        'broken_tracks': known.counts.get('broken', 0),
        'covariance_repairs': known.counts.get('repairs', 0),
        'not_started': known.counts.get('not_started', 0),
        'names_without_track': known.counts.get('names_without_track', 0),
        'fixes_mean_nis': known.memory['fixes'].together.mean_nis,
        'fixes_lag_1': known.memory['fixes'].together.lag_1,
        'arrivals_mean_nis': known.memory['arrivals'].mean,
        'waiting_for_vessel': waiting,
    }


def warnings(known: Known, config: DiverConfig, models: ModelSet) -> list[str]:
    """Return warnings about implausible or unused input."""
    advice = 'check var_toa, var_bearing and toa_std'
    stds = 'receiver_position_std', 'receiver_clock_std', 'sound_speed_std'
    unset = [name for name in stds if not getattr(config, name)]
    if config.dimensions == 2:
        unset.insert(0, 'target_z (or dimensions: 3)')
    if unset:
        advice += ', or set instrument errors: ' + ', '.join(unset)
    assumed = []
    if known.memory['fixes'].assumed:
        assumed = [
            f'no message states a covariance: fix_std {config.fix_std:g} m is assumed, and no '
            'ellipse is better than that. Set fix_std'
        ]
    memory, tracked = known.memory, bool((known.life.status != TENTATIVE).any())
    exceeds, largest = memory['excess'] >= ENOUGH, max(config.covariance_scales)
    two_places = bursts.turning(known).any()
    starving = [] if two_places else polling.warnings(memory['single'], config)
    # Of tracks that starve, nothing else is told by the fixes.
    fixes = memory['fixes'].warnings(config.fix_bias_std > 0.0, largest, memory['sensors'].names)
    of_scans = [
        *(assumed if config.has_usual_fix_std else []),
        *fixes,
        *burst_reports.warnings(known, config),
        *clutter.warnings(memory['clutter'], config, tracked),
    ]
    return [
        *(starving or of_scans),
        *memory['heights'].warnings(config),
        *memory['arrivals'].warnings('arrivals', advice, more_than_stated=exceeds),
        *arrival_stamps.warnings(memory['stamps'], config),
        *memory['offsets'].warnings(config),
        *sides.warnings(known, models),
        *ranges.warnings(known),
        *births.start_warnings(known, config),
    ]
