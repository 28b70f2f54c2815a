# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""The Autoferry sensor fusion data set: radar and lidar detections of boats, with clutter, in NED.

A record of ``scenario13_detections.json`` is one scan of one sensor: ``measurement`` is 2 x M,
north then east relative to the own ship (a flat pair for M = 1, empty for none), and
``ownshipPosition`` is north and east of the own ship. Every record is a scan of fixes, also one
without detections: that nothing was seen is evidence too. Infrared and camera (bearings only) are
left out. The targets are boats, not divers.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_imm.measurements import Fixes

DATA = Path(os.environ.get('SONAR_IMM_DATA', '../shared/data'))
SENSORS = {'lidar': 1, 'radar': 2}


def autoferry(sensor: str, time_offset_ns: int = 0) -> tuple[list[Fixes], NDArray[np.float64]]:
    """The scans of radar or lidar in scenario 13 by time, and the truth: rows (stamp s, id, x, y),
    east and north in m. time_offset_ns: added to the stamps of the scans."""
    folder = DATA / 'autoferry'
    scans = scans_of(_read(folder / 'scenario13_detections.json'), sensor, time_offset_ns)
    return scans, truth_of(_read(folder / 'scenario13_groundTruth.json'))


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding='utf-8'))


def scans_of(records: Any, sensor: str, time_offset_ns: int = 0) -> list[Fixes]:
    """The scans of one sensor by time."""
    scans = [
        Fixes(
            stamp_ns=_nanoseconds(record['time']) + time_offset_ns,
            position=np.pad(_east_north(record), ((0, 0), (0, 1))),
            covariance=None,
            frame_id='map',
        )
        for record in records
        if record['sensorID'] == SENSORS[sensor]
    ]
    return sorted(scans, key=lambda scan: scan.stamp_ns)


def _east_north(record: Any) -> NDArray[np.float64]:
    """Detections (M, 2) of one record as east, north in the world."""
    relative = np.array(record['measurement'], np.float64).reshape(2, -1)
    return (relative + np.array(record['ownshipPosition'])[:, None])[::-1].T


def truth_of(groups: Any) -> NDArray[np.float64]:
    """Rows (stamp s, id, x, y) by time; in the file targets are repeated, each with its time."""
    rows = {
        (_nanoseconds(target['time']), int(target['targetID'])): target['position'][1::-1]
        for group in groups
        for target in group
    }
    return np.array(
        [(stamp * 1e-9, number, *rows[stamp, number]) for stamp, number in sorted(rows)]
    )


def _nanoseconds(seconds: float) -> int:
    """A double resolves about 0.2 us today."""
    return round(seconds * 1e9)
