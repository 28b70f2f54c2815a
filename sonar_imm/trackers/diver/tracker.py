# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Diver tracker for multistatic fixes and raw arrival times.

A diver swims slowly and turns often. The tracker runs motion models for 16 headings, hovering and
other motions (`models`) in an interacting multiple model filter. The data adapt the transition
probabilities. Several assumptions run in parallel as rows of one table (`estimation.rows`): scales
of the measurement covariances, or start depths.

The measurements of one stamp form a `Scan`. It passes through stages, each a function of the
state:

    predict -> for each group of fixes: associate -> update
            -> for each ping: associate and update (`arrivals`)
            -> update transitions -> update IDs -> prune -> spawn

The stages are assembled once from the parameters. The state after a scan is one immutable value,
`Known`. For a late measurement, the later scans are recomputed (`intake.stream`). Positions that
are not in metres in the track frame are converted first (`georeferencing`).

Source: docs/diver.md, after 'multi-directional motion fusion model for diver tracking'.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import lru_cache, partial
import math
from operator import itemgetter

import numpy as np

from ...acoustics.geodesy import Origin
from ...estimates import Estimate
from ...estimation.adaptation import AdaptiveChain
from ...estimation.association import TENTATIVE, Tracks
from ...estimation.consistency import excess, NisMemory
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import Arrivals, Fix, Fixes, Measurement, Start
from . import (
    arrival_stamps,
    births,
    burst_reports,
    bursts,
    clutter,
    coverage,
    depth,
    disagreement,
    estimate,
    fixes,
    links,
    names,
    offsets,
    pairing,
    polling,
    pruning,
    ranges,
    restart,
    scales,
    sides,
)
from .config import DiverConfig
from .coverage_map import configured_coverage
from .georeferencing import Georeferencer
from .innovations import SensorConsistency
from .instruments import Instruments, Layout
from .known import Feature, Known, predict_over
from .models import build_models, ModelSet
from .scan import Group, Scan
from .sensors import Sensors

__all__ = ['DiverConfig', 'DiverTracker', 'Known']

SCORE_MEMORY = 0.9
"""Factor on the score of a track at each scan."""

GroupStage = Callable[[Known, Group], Known]
ScanStage = Callable[[Known, Scan], Known]


class DiverTracker:
    """Tracker of divers, boats and ships, with the interface `trackers.Tracker`.

    `process` accepts `Fix`, `Fixes`, `Arrivals`, `Start`, and the inputs of `georeferencing`.
    """

    STATE = ('_stream', '_georeferencer')

    _stream: ReplayStream[Known]
    _georeferencer: Georeferencer

    def __init__(self, config: DiverConfig):
        self.models = build_models(config := config.for_target())
        kinds = self.models.families
        self._chain = AdaptiveChain(
            self.models.chain,
            weight=config.adaptation_prior,
            family=None if kinds is None else kinds.family,
            learns=config.adaptation == 'counts',
        )
        self._apply_config(config)
        self.reset()

    def _apply_config(self, config: DiverConfig) -> None:
        """Build everything that depends on the parameters, once per change."""
        self.config, models = config, self.models
        self.rules = pruning.track_rules(config)
        layout = lru_cache(maxsize=16)(partial(Instruments.layout, config=config, models=models))

        def layouts(known: Known) -> Layout:
            return layout(known.memory['instruments'])

        covered = configured_coverage(config)
        self._associate = pairing.association_stage(models, config.pairing)
        self.features: dict[str, Feature] = {
            **fixes.FEATURES,
            **disagreement.FEATURES,
            **names.FEATURES,
            **restart.FEATURES,
            **pruning.FEATURES,
            **coverage.FEATURES,
            **depth.FEATURES,
            **burst_reports.FEATURES,
            **sides.FEATURES,
            'learnt': Feature(None, self._chain.initial_counts(0).shape[1:]),
        }
        turn = config.bearing_bias_std_deg > 0.0
        self._group_stages: tuple[GroupStage, ...] = select_stages(
            polling.remember_single_fixes,
            clutter.estimate_densities,
            len(models.scales) > 1 and scales.hearing_stage(models),
            turn and rotation_stage(models, layout),
            covered and coverage.detection_stage(covered, models),
            self._associate,
            models.families
            and restart.restart_stage(models, self._chain, layouts, self._associate),
            fixes.update_stage(models, lambda known: layouts(known).estimated_masks(models)),
            models.families and bursts.jump,
            lambda known, group: sides.drop_sides(known, models),
            config.dimensions == 3 and depth.depth_stage(models, layouts, config),
            clutter.count_clutter,
            covered and coverage.miss_stage(models, lambda known: bool(layouts(known).mask.all())),
            turn and rotation_stage(models, layout, back=True),
            births.spawn_at_fixes,
        )
        self._scan_stages: tuple[ScanStage, ...] = select_stages(
            self._update_transitions,
            models.families and burst_reports.count_bursts,
            names.id_times_stage(config.max_coast),
            pruning.pruning_stage(models, config, self.rules, bool(covered)),
            names.merge_stage(models),
            models.families and links.update_links,
            clutter.remove_first_fixes,
            births.spawn_stage(models, config, layouts, self._chain, self.features, self.rules),
        )
        self._covered, self._layouts = covered, layouts

    def reset(self) -> None:
        self._stream = ReplayStream(
            (Fix, Fixes, Arrivals, Start),
            StreamRules.of(self.config),
            step=self._process_scan,
            initial=self._empty_state(Tracks.none(self.rules)),
            survivor=lambda known: self._empty_state(known.life.none_left()),
        )
        self.counts = self._stream.counts
        self._georeferencer = Georeferencer(self.config, self.counts)

    def _empty_state(self, life: Tracks) -> Known:
        nobody = Known.empty(life, self.models, self.models.n, self.features)
        return nobody.with_memory(
            fixes=SensorConsistency(),
            arrivals=NisMemory(),
            excess=0.0,
            heights=depth.HeightCounts(),
            offsets=offsets.BiasTest(),
            recent=offsets.RecentPairs(),
            instruments=Instruments(),
            clutter=clutter.Clutters(),
            single=polling.SingleFixes(),
            stamps=arrival_stamps.ArrivalStamps(),
            last_named=names.LastNamed(),
            ranges=ranges.Ranges(),
            sensors=Sensors(),
            reporting=0,
            bursts=burst_reports.BurstCounts(),
        )

    def restored(self) -> None:
        """Recompute the states from the oldest saved one.

        :raises ValueError: the saved state belongs to other models.
        """
        base, nobody = self._stream.base, self._empty_state(Tracks.none(self.rules))
        base.require_like(nobody, len(self._layouts(base).variances))
        self._stream.restored()

    @property
    def origin(self) -> Origin | None:
        """Geodetic origin of the track frame; None if unknown."""
        return self._georeferencer.origin

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: DiverConfig) -> None:
        config = config.for_target()
        self.config.require_changeable(config)
        self._apply_config(config)
        self._georeferencer.config = config

    def warm(self, inputs: Collection[type] | None = None) -> None:
        """Do nothing: there is nothing to compile."""

    def health(self) -> dict[str, float]:
        return estimate.health(self._stream.state, len(self._georeferencer))

    def warnings(self) -> list[str]:
        """Return warnings about implausible or unused input."""
        tracker_warnings = estimate.warnings(self._stream.state, self.config, self.models)
        return [*self._georeferencer.warnings(), *tracker_warnings]

    def process(self, measurement: Measurement) -> list[Estimate]:
        return [self._estimate(known) for _, known in self._revise(measurement)]

    def _revise(self, measurement: Measurement) -> list[tuple[int, Known]]:
        """Return the new or changed states with their stamps, oldest first."""
        revised: dict[int, Known] = {}
        before = self.origin
        placed = self._georeferencer.georeference(measurement)
        if before not in (None, self.origin):
            # All that was placed lies elsewhere.
            self._stream.forget()
        for ready in placed:
            revised.update(self._stream.revise(ready))
        return sorted(revised.items(), key=itemgetter(0))

    def _estimate(self, known: Known) -> Estimate:
        frame_id = self._stream.frame_id
        return estimate.estimate_of(known, self.models, self.config, frame_id, self.origin)

    # -- one scan ------------------------------------------------------------------------------

    def _process_scan(self, previous: Known, stamp_ns: int, items: Sequence[Measurement]) -> Known:
        """Return the state after all measurements of one stamp. Pure function."""
        scan = Scan.from_items(items, self.config)
        previous = previous.with_memory(sensors=scan.number_sensors(previous.memory['sensors']))
        known = self._predict(previous, scan, stamp_ns)
        for group in scan.fixes:
            for stage in self._group_stages:
                known = stage(known, group)
        for ping in scan.pings:
            known = self._process_ping(known, scan, ping)
        for last in self._scan_stages:
            known = last(known, scan)
        return known

    def _predict(self, previous: Known, scan: Scan, stamp_ns: int) -> Known:
        """Predict the tracks to the scan. Stores the last step in `scan.prediction`."""
        dt = (stamp_ns - previous.stamp_ns) * 1e-9 if previous.stamp_ns else 0.0
        has_scales = len(previous) and len(self.models.scales) > 1
        start = previous
        for number in sorted(scan.numbers) if has_scales else ():
            start = scales.redistribute_weights(
                start, self.models.scales, self.config.sensor_delays, number
            )
        if has_scales:
            start = start.replace(rows=sides.with_sides_of(previous.rows, start.rows))
        steps = predict_over(
            self.models, self._chain, start.rows, previous['learnt'], dt, self.config.longest_step
        )
        transition = np.linalg.matrix_power(steps[-1].transition, len(steps))
        scan.previous = previous
        scan.prediction = steps[-1]._replace(transition=transition, dt=dt)
        # The sound speed error is part of the state before the first ping.
        rows = self._layouts(previous).rows_with_new_constants(steps[-1].rows, self.models)
        count = len(previous)
        columns = {
            'nis': np.full(count, 0.0),
            'nis_dof': np.zeros(count, np.uint16),
            'score': SCORE_MEMORY * previous['score'],
            'existence': previous['existence'] * math.exp(-dt / self.config.survival_time),
        }
        known = start.replace(stamp_ns=stamp_ns, rows=rows).with_columns(**columns)
        return known.add_counts(repairs=sum(step.repairs for step in steps))

    def _process_ping(self, known: Known, scan: Scan, ping: Arrivals) -> Known:
        """Update the tracks by a ping, and store the births it shows."""
        from . import arrivals  # imported late: not needed for fixes

        known, usable = arrival_stamps.with_resolution(known, ping, self.config)
        if usable is None:
            return known
        ping = usable
        known = known.replace(rows=bursts.without_offsets(known.rows))
        known, free = arrivals.associate_and_update(
            known, ping, self.config, self.models, self._covered
        )
        known = sides.count_doubts(known)
        layout = self._layouts(known)
        known = births.restart_track(known, ping, free, self.models, layout, self.config)
        found = births.births_from_ping(ping, free, self.config)
        known, more = ranges.births_from_range(known, ping, free, self.config)
        number = known.memory['sensors'].number('')
        for birth in [*found, *more]:
            scan.births.append(birth._replace(number=number))
        return known

    def _update_transitions(self, known: Known, scan: Scan) -> Known:
        """Update the transition counts by the hits.

        Also update the NIS of arrivals, except in scans with fixes.
        """
        previous, step, hit = scan.previous, scan.prediction, known['nis_dof'] > 0
        learnt = self._chain.learn(
            previous['learnt'],
            step.transition,
            previous.rows.model_probabilities(),
            known.rows.model_probabilities(),
            step.dt,
            np.flatnonzero(hit),
        )
        known = known.with_columns(learnt=learnt, nis=np.where(hit, known['nis'], np.nan))
        if not scan.pings or scan.fixes:
            return known
        confirmed = hit & (known.life.status != TENTATIVE)
        nis, dof = known['nis'][confirmed], known['nis_dof'][confirmed]
        cusum = known.memory['excess']
        if not len(self._layouts(known).variances):  # without estimated instrument errors
            cusum = excess(cusum, nis, dof)
        return known.with_memory(arrivals=known.memory['arrivals'].after(nis, dof), excess=cusum)


def select_stages(*stages: object) -> tuple:
    """Return the stages that are enabled, without False and None."""
    return tuple(stage for stage in stages if stage)


def rotation_stage(
    models: ModelSet, layout: Callable[[Instruments], Layout], *, back: bool = False
) -> GroupStage:
    """Return the stage that rotates tracks by the bearing error of a sensor about its position.

    back: rotate back.
    """

    def turn(known: Known, group: Group) -> Known:
        if group.rotation_sensor is None:
            return known
        instruments = known.memory['instruments'].with_sensor(group.rotation_sensor[0])
        place = layout(instruments)
        rows = place.rows_with_new_constants(known.rows, models)
        turned = place.rotate_about_sensor(rows, models, *group.rotation_sensor, back=back)
        return known.replace(rows=turned).with_memory(instruments=instruments)

    return turn
