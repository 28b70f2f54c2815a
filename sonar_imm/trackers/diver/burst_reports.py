# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Numbers and sentences about bursts, outliers and sensors that disagree (`bursts`)."""

from __future__ import annotations

from collections.abc import Iterator
import math
from typing import NamedTuple

import numpy as np

from ...estimation.association import TENTATIVE
from . import bursts
from .config import DiverConfig
from .known import Feature, Known
from .scales import delay_probabilities
from .scan import Scan
from .sensors import Sensors

FEATURES = {'burst_since': Feature(0, kind=np.int64), 'strange': Feature(False, kind=np.bool_)}
"""burst_since: stamp of the first fix of the burst that was counted last, 0 for none; strange:
whether the last fix of the track began an offset or was an outlier."""

ENOUGH_ALONE = 3
"""Number of outliers for a sentence about them."""

SURELY_LATE = 0.95
"""Probability of a delay of a sensor that triggers a warning."""

ENOUGH_OTHERS = 10
"""Number of fixes of either sensor for a sentence about two sensors."""


class BurstCounts(NamedTuple):
    """Fixes of bursts and outliers so far."""

    fixes: int = 0
    """Number of fixes in bursts."""
    runs: int = 0
    """Number of bursts."""
    nearest: float = math.inf
    """Smallest offset of a burst, m."""
    alone: int = 0
    """Number of outliers."""
    taken: int = 0
    """Number of fixes of tracks, with these."""
    explained: tuple[str, ...] = ()
    """Offsets between sensors, and delays, that are known now."""

    def warnings(self) -> list[str]:
        """Return sentences about bursts and outliers."""
        found = []
        if self.runs:
            runs = f'{self.runs} runs' if self.runs > 1 else '1 run'
            found.append(
                f'{self.fixes} fixes in {runs} lay {self.nearest:.2g} m or more from where the '
                'target can have been and agreed with one another: taken for bursts (multipath?), '
                'not for the target; if it can do that, raise speed_std'
            )
        if self.alone >= ENOUGH_ALONE:
            found.append(
                f'{self.alone} of {self.taken} fixes lay alone where the target cannot have been: '
                'taken for outliers'
            )
        return found


class Burst(NamedTuple):
    """The most probable burst of a track."""

    track: int
    row: int
    offset: np.ndarray
    """(2,) m."""
    of_sensors: bool
    """Whether it is the offset between sensors that disagree."""


def count_bursts(known: Known, scan: Scan) -> Known:
    """Count bursts and outliers. A stage of the tracker."""
    if not scan.fixes or not len(known):
        return known
    counts: BurstCounts = known.memory['bursts']
    running = list(current_bursts(known))
    explained = (
        *('two places' for _ in np.flatnonzero(bursts.turning(known))),
        *('two sensors' for burst in running if burst.of_sensors),
        *(f'late {number}' for number in late_sensors(known)),
    )
    if not set(explained) <= set(counts.explained):
        # What was taken for bursts, outliers or wrong covariances before was this.
        counts = BurstCounts(taken=counts.taken)
        known = known.with_memory(fixes=known.memory['fixes'].without_sums())
    counts = counts._replace(explained=explained)
    rows, T = known.rows, len(known)
    hit, before, since = known['nis_dof'] > 0, known['strange'], np.zeros(T, np.int64)
    taken = [group.association.taken for group in scan.fixes if group.association is not None]
    strange = np.any(taken, axis=0) & ~hit
    counts = counts._replace(taken=counts.taken + int((hit | strange).sum()))
    bursting = np.zeros(T, np.bool_)
    for burst in running:
        start, fixes = (int(rows.key[name][burst.row]) for name in ('since', 'fixes'))
        old = start == known['burst_since'][burst.track]
        took = int(rows.key['took'][burst.row] == known.stamp_ns)
        bursting[burst.track], since[burst.track] = True, start
        if burst.of_sensors:
            continue
        counts = counts._replace(
            runs=counts.runs + (not old),
            fixes=counts.fixes + (took if old else fixes),
            nearest=min(counts.nearest, float(np.hypot(*burst.offset))),
        )
    alone = int((before & ~bursting & (hit | strange)).sum())
    known = known.with_memory(bursts=counts._replace(alone=counts.alone + alone))
    return known.with_columns(strange=strange, burst_since=since)


def current_bursts(known: Known) -> Iterator[Burst]:
    """Yield the burst of each confirmed track that has one, of two fixes or more.

    Of three in scans of several targets, where two may be false fixes.
    """
    rows, T = known.rows, len(known)
    if not rows.tail:
        return
    key = rows.key
    enough = key['fixes'] >= np.where(key['link'] != 0, 3, 2)
    running = np.where((key['offset'] >= 0) & enough & ~key['turns'], rows.weight, 0.0)
    offset = bursts.row_offsets(rows)
    firm = known.life.status != TENTATIVE
    for track in np.flatnonzero((rows.total(running, T) > 0.5) & firm).tolist():
        own = known.row_indices(track)
        row = int(own[running[own].argmax()])
        counts = min(int(rows.key[name][row]) for name in ('others', 'fixes'))
        yield Burst(track, row, offset[row], counts >= ENOUGH_OTHERS)


def warnings(known: Known, config: DiverConfig) -> list[str]:
    """Return sentences about bursts and outliers, and about bursts that last."""
    found: list[str] = []
    rows, sensors = known.rows, known.memory['sensors']
    readings = bursts.reading_weights(rows, config.burst_end)
    apart_in_turns = np.flatnonzero(bursts.turning(known) & (known.life.status != TENTATIVE))
    offset = bursts.row_offsets(rows)
    for track in apart_in_turns.tolist():
        own = known.row_indices(track)
        found.append(_places_apart(offset[own[rows.logw[own].argmax()]]))
    for burst in current_bursts(known):
        row, distance = burst.row, np.hypot(*burst.offset)
        if burst.of_sensors:
            found.append(_sensors_apart(sensors, int(rows.key['offset'][row]), burst.offset))
            continue
        other = 'the track was wrong before' if rows.key['link'][row] == 0 else 'another target'
        seconds = (known.stamp_ns - int(rows.key['since'][row])) * 1e-9
        found.append(
            f'for {seconds:.3g} s the fixes of track {known.life.track_id[burst.track]} have been '
            f'{distance:.2g} m off: a burst ({1.0 - readings[row]:.2g}), or {other}; the estimate '
            'holds both'
        )
    for number, (delay, weight) in late_sensors(known).items():
        found.append(
            f'the stamps of sensor {sensors.names[number] or "without a name"} are {delay:.2g} s '
            f'late ({weight:.2g}): the estimate corrects them'
        )
    return [*known.memory['bursts'].warnings(), *found]


def late_sensors(known: Known) -> dict[int, tuple[float, float]]:
    """Return delay, s, and its probability by the number of each sensor whose stamps are late."""
    found, firm = {}, known.life.status != TENTATIVE
    for number in np.flatnonzero(known.rows.key['delay'].any(axis=0)).tolist():
        delay, weight = delay_probabilities(known.rows, number)
        if (firm & (weight > SURELY_LATE)).any():
            track = int(np.where(firm, weight, 0.0).argmax())
            found[number] = float(delay[track]), float(weight[track])
    return found


def _places_apart(offset: np.ndarray) -> str:
    """Return the sentence about two places in turn, apart by `offset` (2,)."""
    return (
        f'fixes fall in two groups {np.hypot(*offset):.2g} m apart ({offset[0]:.2g} m east, '
        f'{offset[1]:.2g} m north) that take turns, a constant offset: two sensors on one topic? '
        'The estimate holds both places. Give each sensor its own frame, or correct one'
    )


def _sensors_apart(sensors: Sensors, number: int, offset: np.ndarray) -> str:
    """Return the sentence about a sensor that is off by `offset` (2,) from the others."""
    name = sensors.names[number]
    others = ' and '.join(repr(each) for each in sensors.names if each != name)
    start = f'sensors {others} and {name!r} are {np.hypot(*offset):.2g} m apart ('
    return (
        f'{start}{offset[0]:.2g} m east, {offset[1]:.2g} m north): which of them is right cannot '
        'be told, and the estimate holds both; a third sensor decides, or correct one of them'
    )
