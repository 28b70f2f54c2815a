# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Arrival times from a CSV, with the positions of the receivers from a second one.

Two kinds of file are understood:

- *Synchronised one-way arrivals* of an acoustic tag: ``ping``, ``receiver`` and the absolute time
  of ``arrival``. The time of emission is unknown. So a ping is stamped with its earliest arrival,
  ``toa`` counts from there, and the transmitter is NaN. The emission lies before the stamp by the
  travel time to the nearest receiver. ``tag``, where there is such a column, says which tag was
  heard, so that each has its own track (``tx_id``; 0 is nobody's).
- *Travel times* from known transmitters: ``stamp`` (the transmission), ``transmitter``,
  ``receiver`` and ``toa``. Rows with the same ``ping``, or with the same stamp where there is no
  such column, are one ping.

Optional in both: ``var_toa`` or ``std_toa``, ``bearing`` [rad] with ``var_bearing`` or
``std_bearing``, ``elevation`` [rad, up positive] and ``depth`` [m, down positive, the diver's own
report] likewise.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msg_adapters.arrivals import write_arrivals
from sonar_imm.measurements import Arrivals

from ..columns import LOTEK, name_of, THELMA
from ..conversion import ConversionReport, converter, flags_of, Record, write_bag
from ..convert_options import ArrivalsOptions, DetectionsOptions
from ..messages import ros_message
from ..places import LocalFrame, origin_parameters
from ..sources import BagError
from ..table_files import CsvTable
from ..tables import CsvOptions, Row, Table
from ..times import BadRow
from ..truth import number_names, truth_records

_NOWHERE = (math.nan, math.nan, math.nan)
Places = Mapping[str, tuple[float, float, float]]
OPTIONAL = (
    'var_toa', 'bearing', 'var_bearing', 'elevation', 'var_elevation', 'depth', 'var_depth',
)  # fmt: skip


class Arrival(NamedTuple):
    """One line; `time_ns` is the absolute arrival, or the transmission when `toa` is a number;
    optional: as in `OPTIONAL`, NaN for what is not stated."""

    ping: str
    time_ns: int
    toa: float
    transmitter: str
    receiver: str
    optional: tuple[float, ...]
    tag: str = ''


@converter(ArrivalsOptions)
def convert_arrivals(path: Path, how: ArrivalsOptions, report: ConversionReport) -> None:
    """Convert a CSV of arrivals to the topic ``/arrivals``, one message per ping."""
    places, origin = read_places(
        how.receivers, report, how.receiver_options, how.origin, 'receiver'
    )
    senders: Places | None = places
    if how.transmitters is not None:
        files = how.transmitters, report, how.receiver_options
        senders = read_places(*files, origin, 'transmitter')[0]
    default = math.nan if how.toa_std is None else how.toa_std**2
    pings: dict[tuple[object, str], list[Arrival]] = {}
    table = CsvTable(path, how.options)
    table.require('receiver')
    if table.has('toa', 'transmitter'):
        table.require('stamp')
    else:
        table.require('ping', 'arrival')
        senders = None
    rows = report.read_rows(table, lambda row: _parse(row, places, senders, default))
    for _, arrival in rows:
        key = (arrival.ping if table.has('ping') else arrival.time_ns, arrival.tag)
        pings.setdefault(key, []).append(arrival)
    write_pings(table, pings, Stations(places, senders, origin), report, how)


class Stations(NamedTuple):
    """Positions of receivers and transmitters by name, and the origin of their local metres.
    transmitters: None where nobody knows when a ping was emitted."""

    receivers: Places
    transmitters: Places | None
    origin: tuple[float, ...] | None


def write_pings(
    table: Table,
    pings: Mapping[tuple[object, str], list[Arrival]],
    stations: Stations,
    report: ConversionReport,
    how: ArrivalsOptions | DetectionsOptions,
) -> None:
    """Write one message for each ping, by its name and its tag. Raises `BagError`."""
    places, senders, origin = stations
    heard = (arrival.tag for ping in pings.values() for arrival in ping)
    tags = number_names([tag for tag in heard if tag])  # as ``tx_id`` has them
    report.target_names = tags
    if any(str(number) != name for name, number in tags.items()):
        report.notes['tag'] = ', '.join(f'{name} is {number}' for name, number in tags.items())
    numbers = number_names(list(places))
    sender_numbers = number_names(list(senders or ()))
    records: list[Record] = []
    streams: dict[str, list[int]] = {}
    for label, ping in pings.items():
        with report.leaving_out(table.path, f'ping {label[0]}'):
            stamp = min(arrival.time_ns for arrival in ping)
            late = [(arrival.time_ns - stamp) * 1e-9 for arrival in ping]
            if senders is None:
                toa, tx = late, [_NOWHERE for _ in ping]
                tx_id = [tags.get(arrival.tag, 0) for arrival in ping]
            else:
                toa = [arrival.toa + more for arrival, more in zip(ping, late)]
                tx = [senders[arrival.transmitter] for arrival in ping]
                tx_id = [sender_numbers[arrival.transmitter] for arrival in ping]
            measurement = Arrivals(
                stamp_ns=stamp,
                frame_id=how.frame_id,
                toa=toa,
                tx_id=tx_id,
                rx_id=[numbers[arrival.receiver] for arrival in ping],
                tx=np.array(tx),
                rx=np.array([places[arrival.receiver] for arrival in ping]),
                **dict(zip(OPTIONAL, zip(*(arrival.optional for arrival in ping)))),
            )
            records.append((stamp, '/arrivals', write_arrivals(measurement, ros_message)))
            streams.setdefault(label[1], []).append(stamp)
    if records:
        records += truth_records(how, report, origin)
    if any(name != str(number) for name, number in numbers.items()):
        report.notes['receivers'] = ', '.join(f'{name} = {numbers[name]}' for name in numbers)
    if senders is None:
        report.notes['emission'] = 'unknown; the stamp is the earliest arrival of the ping'
    write_bag(report, records, table.path, how, {'diver': origin_parameters(origin)}, streams)


def _parse(row: Row, places: Places, senders: Places | None, default: float) -> Arrival:
    row.require_valid()
    passive = senders is None
    receiver, transmitter = row.text('receiver'), '' if passive else row.text('transmitter')
    if receiver not in places:
        raise BadRow(f"the position of receiver '{receiver}' is not known")
    if senders is not None and transmitter not in senders:
        raise BadRow(f"the position of transmitter '{transmitter}' is not known")
    ping = row.text('ping')
    if passive and not ping:
        raise BadRow('the ping is empty')
    time_ns = row.stamp_ns('arrival' if passive else 'stamp')
    toa = math.nan if passive else row.seconds_ns('toa') * 1e-9
    optional = dict.fromkeys(OPTIONAL, math.nan)
    for name in ('bearing', 'elevation', 'depth'):
        optional |= {name: row.optional(name), f'var_{name}': _variance(row, name)}
    var_toa = _variance(row, 'toa')
    optional['var_toa'] = default if math.isnan(var_toa) else var_toa
    tag = row.text('tag') if passive and names_tags(row.table) else ''
    return Arrival(ping, time_ns, toa, transmitter, receiver, tuple(optional.values()), tag)


def name_columns(table: Table) -> None:
    """Find the columns of makers of receivers whose names mean other things elsewhere: ``TOA`` of
    Lotek, the part of a second, and ``ID`` of Thelma beside a receiver, a tag."""
    names = {name_of(header) for header in table.headers}
    if LOTEK <= names and table.has('toa'):
        table.index['fraction'] = table.index.pop('toa')
    if THELMA <= names and table.has('id'):
        table.index['tag'] = table.index['id']


def names_tags(table: Table) -> bool:
    """Whether a column says which tag was heard, and not which receiver has heard it."""
    return table.has('tag') and table.index['tag'] != table.index.get('receiver')


def _variance(row: Row, what: str) -> float:
    """The variance that a row states, also as a standard deviation; NaN without either."""
    if row.table.has(f'var_{what}'):
        return row.optional(f'var_{what}')
    std = row.optional(f'std_{what}')
    return std * std


def read_places(
    path: str | Path,
    report: ConversionReport,
    options: CsvOptions | None,
    origin: tuple[float, ...] | None,
    name: str,
) -> tuple[dict[str, tuple[float, float, float]], tuple[float, ...] | None]:
    """Read the positions of receivers or transmitters by name, and the origin of local metres."""
    places: dict[str, tuple[float, float, float]] = {}

    def parse(row: Row) -> tuple[str, tuple[float, float, float]]:
        if not row.text(name):
            raise BadRow(f'the {name} has no name')
        if row.text(name) in places:
            raise BadRow(f"{name} '{row.text(name)}' is listed twice; the first position is used")
        return row.text(name), frame.position(row)

    with flags_of('receiver', report):
        table = CsvTable(path, options)
        table.require(name)
        frame = LocalFrame(table, origin)
        for _, (label, place) in report.read_rows(table, parse):
            places[label] = place
        if not places:
            raise BagError(f'{table.path} lists no {name} with a position')
    report.notes.update(frame.notes())
    return places, frame.origin
