# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Truth as messages, below the topic ``/truth``, also from a CSV of positions; simulated scenes as
bags, each measurement on the input topic of its tracker.

A velocity that the file does not state comes from central differences of the positions. It is as
noisy as these: with one position per second and 0.5 m of noise it is good to about 0.4 m/s.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.inputs import inputs_of, InputTopic, made_inputs
from msg_adapters.table import encode_table
from sonar_imm.trackers import SYSTEMS
from sonar_imm.truth import Scene, TrueTrack, Truth

from .conversion import ConversionReport, converter, flags_of, Record, write_bag
from .convert_options import TruthOptions
from .messages import ros_message
from .places import LocalFrame
from .table_files import open_table
from .tables import CsvOptions, Row
from .writer import BagWriter

TRUTH_TOPIC = '/truth/estimate'


def records_of(true: Truth, frame_id: str) -> list[Record]:
    """The messages of a truth; `frame_id` is for one without a frame of its own."""
    prefix, _, name = TRUTH_TOPIC.rpartition('/')
    records = []
    for table in true.tables(frame_id):
        columns, stamp, frame = table.columns, table.stamp_ns, table.frame_id
        message = encode_table(columns, stamp_ns=stamp, frame_id=frame, make=ros_message)
        records.append((stamp, prefix + namespaced(table.namespace, f'/{name}'), message))
    return records


def namespaced(namespace: str, topic: str) -> str:
    return f'/{namespace}{topic}' if namespace else topic


@converter(TruthOptions)
def convert_truth(path: Path, how: TruthOptions, report: ConversionReport) -> None:
    """Convert a CSV of true positions to ``/truth/estimate``.

    Columns: ``stamp``, positions as in `convert_fixes`; optional ``vx vy`` [m/s] and ``id`` for
    several targets, whose names become track ids in order of appearance unless they are numbers.
    values: as in `TruthOptions`.
    """
    records = _records(path, report, how.options, how.frame_id, how.origin)
    write_bag(report, records, path, how)


def truth_records(
    how: Any, report: ConversionReport, origin: tuple[float, ...] | None
) -> list[Record]:
    """Read the truth beside another file into records, none where the options `how` name no file;
    bad rows and notes go to `report`."""
    if how.truth is None:
        return []
    with flags_of('truth', report):
        return _records(how.truth, report, how.truth_options, how.frame_id, origin)


def _records(
    path: str | Path,
    report: ConversionReport,
    options: CsvOptions | None,
    frame_id: str,
    origin: tuple[float, ...] | None,
) -> list[Record]:
    table = open_table(path, options)
    table.require('stamp')
    frame = LocalFrame(table, origin)
    with_velocity = table.has('vx', 'vy')

    def parse(row: Row) -> tuple[int, str, list[float]]:
        velocity = [row.optional('vx'), row.optional('vy')]
        return row.stamp_ns(), row.text('id'), [*frame.position(row), *velocity]

    rows = [parsed for _, parsed in report.read_rows(table, parse)]
    records = []
    for name, track_id in number_names([name for _, name, _ in rows]).items():
        own = [stamp for stamp, owner, _ in rows if owner == name]
        stamps, first = np.unique(np.array(own, np.int64), return_index=True)
        values = np.array([values for _, owner, values in rows if owner == name])[first]
        position, velocity = values[:, :3], values[:, 3:]
        if not with_velocity:
            velocity = difference_velocity(stamps, position[:, :2])
        records += records_of(TrueTrack(track_id, stamps, position, velocity), frame_id)
    report.notes.update(frame.notes())
    if origin is not None and not frame.geodetic:
        report.notes['truth'] = (
            f'x and y of {table.path.name} count from latitude {origin[0]:g}, longitude '
            f'{origin[1]:g}; from another place: --origin LAT,LON'
        )
    report.notes['truth_velocity'] = 'stated' if with_velocity else 'central differences'
    return records


def number_names(names: list[str]) -> dict[str, int]:
    """Number names: their own number when all are whole numbers, else their order from 1."""
    distinct = list(dict.fromkeys(names))
    if distinct and all(name.isdecimal() and int(name) < 2**16 for name in distinct):
        return {name: int(name) for name in distinct}
    return {name: number for number, name in enumerate(distinct, start=1)}


def difference_velocity(stamps_ns: NDArray[np.int64], position: ArrayLike) -> NDArray[np.float64]:
    """Velocity (n, 2) by central differences of positions (n, 2); NaN for n = 1."""
    position = np.asarray(position, np.float64)
    if len(position) < 2:
        return np.full(position.shape, np.nan)
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    return np.gradient(position, seconds, axis=0)


def write_scene(
    scene: Scene,
    out: str | Path,
    *,
    provenance: dict[str, str],
    compressed: bool = False,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
) -> ConversionReport:
    """Write measurements and truth, in the order of reception, and the `parameters` of the
    instruments by the names of nodes. Raises `BagError`."""
    report = ConversionReport(Path(out))
    inputs: dict[type, InputTopic] = {}
    for system in SYSTEMS:
        for entry in (*inputs_of(system), *made_inputs(system)):
            for measurement in entry.measurements:
                inputs.setdefault(measurement, entry)
    records: list[Record] = []
    images = False
    for item in scene.measurements:
        entry = inputs[type(item.measurement)]
        images |= bool(entry.makes)
        topic = namespaced(item.namespace, f'/{entry.name}')
        records.append((item.received_ns, topic, entry.write(item.measurement, ros_message)))
    for true in scene.truth:
        records += records_of(true, scene.frame_id)
    with BagWriter(
        out, compressed=compressed or images, custom_data=provenance, parameters=parameters
    ) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
    report.messages = bag.counts
    return report
