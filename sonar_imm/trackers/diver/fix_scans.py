# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the fixes of a scan do to the tracks, and where they begin new ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...estimation.arrays import BoolArray
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, Start
from . import soft
from .births import Birth, births_from_fixes
from .config import DiverConfig
from .names import is_named
from .scan import Scan
from .sensing import Positions


def take_fixes(scan: Scan, group: Positions) -> list[Birth]:
    """Update the tracks by fixes; gives where they put new divers."""
    if group.target_id is not None:
        return births_from_fixes(group, ~_take_named(scan, group))
    told, named, existence = scan.config, scan.named, scan.existence
    scan.config = told.of_sensor(group.sensor)
    if told.named_tracks == 'share':
        scan.named = np.zeros(len(named), bool)
    births = _take_nameless(scan, group)
    # The life of a named track hangs on its own fixes.
    scan.existence = np.where(named, existence, scan.existence)
    scan.config, scan.named = told, named
    return births


def _take_nameless(scan: Scan, group: Positions) -> list[Birth]:
    """Update the tracks by fixes that do not say whose they are."""
    if scan.config.association == 'gnn':
        return births_from_fixes(group, ~scan.associate_and_update(group))
    claimed = soft.take_softly(scan, group)
    return births_from_fixes(group, claimed < 0.5, soft.birth_existence(scan.config, claimed))


def _take_named(scan: Scan, group: Positions) -> BoolArray:
    """Update each track by the fix that says it is its own, without association; True (D,) where
    there is a track of that name."""
    names = np.asarray(group.target_id)
    tracks, row = np.nonzero(scan.before.target_id[:, None] == names[None])
    if len(tracks):
        scan.update_by_fixes(group, tracks, row)
    return np.isin(np.arange(len(names)), row)


def shows_all(item: Measurement, config: DiverConfig) -> bool:
    """Whether a diver of whom `item` says nothing was missed by it."""
    if isinstance(item, Fixes):
        return item.target_id is None or not len(item) or bool((item.target_id == NOBODY).any())
    if isinstance(item, Fix) and item.target_id != NOBODY:
        return False
    if isinstance(item, Start) or (isinstance(item, Arrivals) and is_named(item)):
        return False
    return config.fixes_are_scans


def each_name_once(births: Sequence[Birth]) -> list[Birth]:
    """Without a second birth of the same name."""
    names = [birth.target_id for birth in births]
    return [
        birth
        for place, birth in enumerate(births)
        if birth.target_id == NOBODY or names.index(birth.target_id) == place
    ]
