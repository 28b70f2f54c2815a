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

"""The Autoferry sensor fusion data set: radar and lidar detections of boats, with clutter, in NED.

A record holds one scan of one sensor. ``measurement`` is 2 x M, north then east relative to the
own ship (a flat pair for M = 1, empty for none). ``ownshipPosition`` is north and east of the own
ship. Records are not sorted by time. Every record becomes a scan of fixes, also one without
detections: that nothing was seen is evidence too. Infrared and camera (bearings only) are not
converted. The targets are boats, not divers.
"""

from __future__ import annotations

from collections.abc import Mapping
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.scans import write_scan
from sonar_imm.measurements import Fixes, Rejection
from sonar_imm.truth import TrueTrack

from ..conversion import ConversionReport, converter, Record, write_bag
from ..convert_options import AutoferryOptions
from ..csv_table import BadRow
from ..messages import ros_message
from ..sources import BagError
from ..track_files import whole_items
from ..truth import difference_velocity, records_of

SENSORS = {'lidar': 1, 'radar': 2}


@converter(AutoferryOptions)
def convert_autoferry(path: Path, how: AutoferryOptions, report: ConversionReport) -> None:
    """Convert the detections of a scenario (JSON) to the topic ``/fixes``, east-north-up; of two
    sensors to ``/radar/fixes`` and ``/lidar/fixes``, so that each may have numbers of its own.
    """
    late = how.time_offset_ns
    if not isinstance(late, Mapping):
        late = dict.fromkeys(SENSORS, late)
    if unknown := [name for name in (*how.sensors, *late) if name not in SENSORS]:
        raise BagError(f"there is no sensor '{unknown[0]}'; there are {' and '.join(SENSORS)}")
    numbers = {SENSORS[name] for name in how.sensors}
    names = {number: name for name, number in SENSORS.items()}
    offsets = {**dict.fromkeys(SENSORS, 0), **late}
    report.notes |= {'sensors': ', '.join(sorted(how.sensors)), 'targets': 'boats, not divers'}
    covariance = None if how.std is None else np.eye(2) * how.std**2
    records: list[Record] = []
    for index, record in enumerate(_json_list(path, report)):
        report.rows += 1
        try:
            if record['sensorID'] not in numbers:
                continue
            found = _east_north(record)
            scan = Fixes(
                stamp_ns=_stamp_ns(record['time'], offsets[names[record['sensorID']]]),
                position=np.column_stack([found, np.zeros(len(found))]),
                covariance=None if covariance is None else np.tile(covariance, (len(found), 1, 1)),
                frame_id=how.frame_id,
            )
            topic = f'/{names[record["sensorID"]]}/fixes' if len(numbers) > 1 else '/fixes'
            records.append((scan.stamp_ns, topic, write_scan(scan, ros_message)))
        except (KeyError, TypeError, ValueError) as error:  # covers BadRow and Rejection
            report.bad_row(path, f'record {index}', _why(error))
    if how.truth is not None:
        records += _truth_records(how.truth, report, how.frame_id)
    write_bag(report.path, records, report, source=path.name, storage=how.storage)


def _east_north(record: Any) -> NDArray[np.float64]:
    """Detections (M, 2) of one record as east, north in the world."""
    relative = np.array(record['measurement'], np.float64)
    if not relative.size:
        return np.empty((0, 2))
    if relative.shape == (2,):
        relative = relative[:, None]
    if relative.ndim != 2 or len(relative) != 2:
        raise BadRow(f'the measurement has the shape {relative.shape}, not 2 x M')
    own_ship = np.array(record['ownshipPosition'], np.float64)
    if own_ship.shape != (2,):
        raise BadRow('ownshipPosition is not a pair')
    return (relative + own_ship[:, None])[::-1].T


def _truth_records(path: str | Path, report: ConversionReport, frame_id: str) -> list[Record]:
    """Read the ground truth: lists of targets, each with its own and often repeated time."""
    tracks: dict[int, dict[int, tuple[float, float, float]]] = {}
    for index, group in enumerate(_json_list(path, report)):
        try:
            for target in group:
                north, east, down = map(float, target['position'])
                track = tracks.setdefault(int(target['targetID']), {})
                track[_stamp_ns(target['time'])] = (east, north, -down)
        except (KeyError, TypeError, ValueError) as error:
            report.bad_row(Path(path), f'record {index}', _why(error))
    records: list[Record] = []
    for track_id, track in sorted(tracks.items()):
        stamps = np.array(sorted(track), np.int64)
        position = np.array([track[stamp] for stamp in stamps.tolist()])
        velocity = difference_velocity(stamps, position[:, :2])
        records += records_of(TrueTrack(track_id, stamps, position, velocity), frame_id)
    report.notes['truth_velocity'] = 'central differences'
    return records


def _json_list(path: str | Path, report: ConversionReport) -> list[Any]:
    """Load a JSON file that holds a list; of one that is cut off, what is whole."""
    try:
        text = Path(path).read_text(encoding='utf-8-sig')
        content = json.loads(text)
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None
    except (ValueError, RecursionError) as error:
        where = f' from line {error.lineno} on' if isinstance(error, json.JSONDecodeError) else ''
        content = (
            [] if isinstance(error, UnicodeDecodeError) else whole_items(text, text.find('[') + 1)
        )
        if not content:
            raise BagError(f'{path} is not a JSON file{where}') from None
        name = Path(path).name
        report.problems.append(f'{name} is damaged{where}; what came before it is kept')
    if not isinstance(content, list):
        raise BagError(f'{path} holds no list of records; is it an Autoferry scenario?')
    return content


def _stamp_ns(seconds: Any, offset_ns: int = 0) -> int:
    """Integer nanoseconds of a JSON time; a double resolves about 0.2 us today."""
    if not isinstance(seconds, (int, float)) or not math.isfinite(seconds):
        raise BadRow(f'the time is {seconds!r}')
    stamp = round(seconds * 1e9) + offset_ns
    if not 0 < stamp < 2**31 * 10**9:
        raise BadRow(f'the time {seconds!r} does not fit a ROS stamp')
    return stamp


def _why(error: Exception) -> str:
    if isinstance(error, (BadRow, Rejection)):
        return str(error)
    if isinstance(error, KeyError) and error.args:
        return f'it has no {error.args[0]}'
    return 'it is not a record of this data set'
