# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the diver tracker predicts of each fix, for `evaluation.tuning`.

A scan of m fixes, of which false ones and new divers come with density l = clutter_density + b
over the area A in which fixes lie at all, with b birth_density times the time since the scan
before, has

    log p = m log l - l A + sum_t log(1 - r p + r p f / l)

over the tracks: r the probability that a track is a diver, p that it is seen, f the density of the
fix that is its own under the whole mixture, 0 where it has none. So a missed diver costs
log(1 - r p), a refused fix log l, and losing a track never pays. r begins at b / l
and follows from the same terms. Where fixes come singly, r is 1 and nobody is missed.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.measurements import Arrivals, Fix, Fixes, NOBODY
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig, MODEL_SETS
from sonar_imm.trackers.diver.known import Known
from sonar_imm.trackers.diver.scan import Group
from sonar_imm.trackers.diver.tracker import DiverTracker

from ..tuning import Scores, Tunable


def for_tuning(config: DiverConfig) -> DiverConfig:
    """One copy: the scale is what is fitted. One density of false fixes, that it can be too."""
    return evolve(config, covariance_scales=(1.0,), clutter_density=config.usual_clutter)


def tunables(config: DiverConfig, measurements: Sequence[Any]) -> list[Tunable]:
    """Raises `ConfigError` where there are arrival times."""
    if any(isinstance(item, Arrivals) for item in measurements):
        raise ConfigError(
            'tune takes fixes; what this recording holds are arrival times, whose likelihood the '
            'tracker does not keep'
        )
    scale, least = config.covariance_scale, min(1.0, config.covariance_scale)
    found = [Tunable(name='covariance_scale', start=scale, std=3.0, least=least, scanned=True)]
    if config.model_set not in MODEL_SETS:
        # A set of another package may read these where they are configured; if not, the
        # likelihood does not depend on them.
        noise = config.acceleration_noise
        for place, value in enumerate(noise):
            found.append(
                Tunable(name='acceleration_noise', start=value, place=place, whole=tuple(noise))
            )
    else:
        found.append(Tunable(name='stay_probability', start=config.stay_probability, kind='logit'))
        found.append(_of(config, 'speed_mean', std=0.7))
        found.append(_of(config, 'speed_std', std=0.7, usual=False))
        found.append(_of(config, 'speed_noise', usual=False))
    scans = any(isinstance(item, Fixes) and len(item) != 1 for item in measurements)
    found.append(_of(config, 'detection_probability', kind='logit', usual=scans))
    found.append(Tunable(name='clutter_density', start=config.usual_clutter, usual=scans))
    found.append(_of(config, 'birth_density', usual=False))
    edge = (0.0, 1.0)
    return [t for t in found if t.start > 0.0 and not (t.kind == 'logit' and t.start in edge)]


def _of(config: DiverConfig, name: str, **settings: Any) -> Tunable:
    return Tunable(name=name, start=getattr(config, name), **settings)


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
        self._group_stages = (
            *self._group_stages[:after],
            self._scoring,
            *self._group_stages[after:],
        )

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
        config, found, seen = group.config, group.association, group.detection
        assert found is not None and group.pairs is not None
        p, m = config.detection_probability, len(group.z)
        density = config.clutter_density + group.new_targets
        tracks = np.flatnonzero(found.hit)
        fix = found.fix[tracks]
        log_f = np.full(len(known), -np.inf)
        log_f[tracks] = group.pairs.track_log[tracks, fix]
        score = m * math.log(density)
        nameless = group.is_complete and group.target_id is None
        if nameless:
            score -= density * self.area
        sure = config.max_tracks == 1
        if seen is not None:
            log_f[tracks] += np.log(seen.fixes[fix] / seen.tracks[tracks])
        for track, track_id in enumerate(known.life.track_id.tolist()):
            hit = np.isfinite(log_f[track])
            ratio = math.exp(min(log_f[track] - math.log(density), 600.0)) if hit else 0.0
            if not nameless or known['target_id'][track] != NOBODY:
                if hit:
                    score += math.log(1.0 - p + p * ratio)
                continue
            r = 1.0 if sure else self.existence.get(track_id, group.new_targets / density)
            p = p if seen is None else float(seen.tracks[track])
            total = 1.0 - r * p + r * p * ratio
            score += math.log(total)
            self.existence[track_id] = r * (1.0 - p + p * ratio) / total
        # A fix that nothing came before cannot be predicted.
        return score, m if len(known) else 0


def area_of(measurements: Sequence[Any]) -> float:
    """m^2 of the rectangle in which the fixes of scans lie; 1 where there are none."""
    places = [item.position[:, :2] for item in measurements if isinstance(item, Fixes)]
    places += [item.position[None, :2] for item in measurements if isinstance(item, Fix)]
    places = [place for place in places if len(place)]
    if not places:
        return 1.0
    return float(max(np.prod(np.ptp(np.concatenate(places), axis=0)), 1.0))
