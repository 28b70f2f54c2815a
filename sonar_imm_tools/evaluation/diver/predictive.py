# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the diver tracker predicts of each fix, for `evaluation.tuning`.

Fixes that are false or of new divers come with density l = clutter_density + b, b birth_density
times the time since the scan before. With the probability p that a diver is seen, the density f_td
of fix d as one of track t under the whole mixture of the track, and the probability r_t that the
track is a diver, a scan of m fixes over the area A in which fixes lie at all has

    log p = m log l - l A + log sum_events prod_assigned r_t p f_td / l prod_missed (1 - r_t p)

over the joint events, in which each fix belongs to one track at most (`marginals.log_total`): two
tracks of one diver do not count his fixes twice. A missed diver costs log(1 - r p), and losing a
track never pays. r begins at b / l and follows from the same events. A fix that comes singly and
without a name is of one of the tracks, in proportion to r, and nobody is missed,

    log p = log((1 - p) l + p sum_t r_t f_t / sum_t r_t).
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimation import jipda
from sonar_imm.estimation.marginals import log_total
from sonar_imm.measurements import Arrivals, Fix, Fixes, NOBODY
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig, MODEL_SETS
from sonar_imm.trackers.diver.known import Known
from sonar_imm.trackers.diver.pairing import gate_pairs, MIN_DETECTION_PROBABILITY
from sonar_imm.trackers.diver.scan import Group
from sonar_imm.trackers.diver.tracker import DiverTracker

from ..tuning import Scores, Tunable

WIDEST_GATE = 0.9999999
"""Where a gate begins to refuse a fix the likelihood jumps, and its curvature says nothing about
the scale of covariances."""


def for_tuning(config: DiverConfig) -> DiverConfig:
    """One copy: the scale is what is fitted. One density of false fixes, that it can be too."""
    return evolve(
        config,
        covariance_scales=(1.0,),
        clutter_density=config.usual_clutter,
        gate_probability=WIDEST_GATE,
    )


def tunables(config: DiverConfig, measurements: Sequence[Any]) -> list[Tunable]:
    """Raises `ConfigError` where there are arrival times."""
    if any(isinstance(item, Arrivals) for item in measurements):
        raise ConfigError(
            'tune takes fixes; what this recording holds are arrival times, whose likelihood the '
            'tracker does not keep'
        )
    least = min(1.0, config.covariance_scale)
    found = [Tunable.of(config, 'covariance_scale', std=3.0, least=least, scanned=True)]
    if config.model_set not in MODEL_SETS:
        # A set of another package may read these where they are configured; if not, the
        # likelihood does not depend on them.
        whole = tuple(config.acceleration_noise)
        found += [
            Tunable(name='acceleration_noise', start=value, place=place, whole=whole)
            for place, value in enumerate(whole)
        ]
    else:
        found.append(Tunable.of(config, 'stay_probability', kind='logit'))
        found.append(Tunable.of(config, 'speed_mean', std=0.7))
        found.append(Tunable.of(config, 'speed_std', std=0.7, usual=False))
        found.append(Tunable.of(config, 'speed_noise', usual=False))
    scans = any(isinstance(item, Fixes) and len(item) != 1 for item in measurements)
    found.append(Tunable.of(config, 'detection_probability', kind='logit', usual=scans))
    found.append(Tunable(name='clutter_density', start=config.usual_clutter, usual=scans))
    found.append(Tunable.of(config, 'birth_density', usual=False))
    edge = (0.0, 1.0)
    return [t for t in found if t.start > 0.0 and not (t.kind == 'logit' and t.start in edge)]


class Scored(DiverTracker):
    """The tracker, with what it predicted. scores: by stamp."""

    def __init__(self, config: DiverConfig, measurements: Sequence[Any] = ()):
        self.scores: Scores = {}
        self.existence: dict[int, float] = {}
        self.area = area_of(measurements)
        super().__init__(config)

    def _apply_config(self, config: DiverConfig) -> None:
        super()._apply_config(config)
        # A track that begins anew at a fix is asked once more: that is no prediction of it.
        after = self._group_stages.index(self._associate) + 1
        stages = self._group_stages
        self._group_stages = (*stages[:after], self._scoring, *stages[after:])

    def _process_scan(self, before: Known, stamp_ns: int, items: Any) -> Known:
        self.scores[stamp_ns] = (0.0, 0)
        return super()._process_scan(before, stamp_ns, items)

    def _scoring(self, known: Known, group: Group) -> Known:
        """Add what was predicted of a group of fixes. A stage of the tracker."""
        score, count = self.scores[known.stamp_ns]
        gained, measured = self._score(known, group)
        self.scores[known.stamp_ns] = score + gained, count + measured
        return known

    def _score(self, known: Known, group: Group) -> tuple[float, int]:
        config, found, pairs = group.config, group.association, group.pairs
        assert found is not None and pairs is not None
        T, m = pairs.track_log.shape
        # A fix that nothing came before cannot be predicted.
        count = m if T else 0
        density = config.clutter_density + group.new_targets
        score = m * math.log(density)
        may = gate_pairs(group, pairs) | (pairs.direct < 1.0)
        log_ratio = np.where(may, pairs.track_log, -np.inf) - math.log(density)
        p = np.full(T, config.detection_probability)
        if group.detection is not None:
            p = np.maximum(group.detection.tracks, MIN_DETECTION_PROBABILITY)
            log_ratio += np.log(group.detection.fixes / p[:, None])
        ratio = np.exp(np.minimum(log_ratio, 600.0))
        if group.target_id is not None:
            own = np.flatnonzero(found.hit)
            gained = np.log(1.0 - p[own] + p[own] * ratio[own, found.fix[own]])
            return score + float(gained.sum()), count
        if not group.is_complete:
            r = np.nan_to_num(known['existence'], nan=1.0)
            share = p * r / r.sum() if r.sum() > 0.0 else np.zeros(T)
            return score + float(np.log(1.0 - share.sum() + share @ ratio).sum()), count
        # A name says that a track is a diver, and one without a fix may have come under his name.
        named = known['target_id'] != NOBODY
        ids, begun = known.life.track_id.tolist(), group.new_targets / density
        r = np.array([self.existence.get(track_id, begun) for track_id in ids])
        r = np.where(named | (config.max_tracks == 1), 1.0, r)
        p = np.where(named & ~may.any(axis=1), 0.0, p)
        score += log_total((r * p)[:, None] * ratio, 1.0 - r * p, may) - density * self.area
        _, _, after = jipda.associate(ratio, may, r, p)
        self.existence.update(zip(ids, after.tolist()))
        return score, count


def area_of(measurements: Sequence[Any]) -> float:
    """m^2 of the rectangle in which the fixes of scans lie; 1 where there are none."""
    places = [item.position[:, :2] for item in measurements if isinstance(item, Fixes)]
    places += [item.position[None, :2] for item in measurements if isinstance(item, Fix)]
    places = [place for place in places if len(place)]
    if not places:
        return 1.0
    return float(max(np.prod(np.ptp(np.concatenate(places), axis=0)), 1.0))
