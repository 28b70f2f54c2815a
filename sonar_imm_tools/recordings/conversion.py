# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What every converter shares: counting bad rows, writing the bag, reporting what was done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import functools
import json
import math
from operator import itemgetter
from pathlib import Path
import re
from typing import Any, TypeVar

from attrs import define, Factory
import numpy as np

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.intake.leaps import FASTEST, NEAR
from sonar_imm.measurements import Rejection, VesselFix

from .. import SECOND
from .messages import cdr_of
from .sources import BagError, TARGET_NAMES
from .tables import Row, Table
from .times import BadRow
from .writer import BagWriter

T = TypeVar('T')
Record = tuple[int, str, Any]
"""(stamp in ns, topic, rosbags message)"""
Converter = Callable[[Path, Any, 'ConversionReport'], None]

JUMP = 3600 * SECOND
"""A clock that goes further than this from one ping to the next is off, or was set."""
PAUSE = 30 * 24 * JUMP
"""Tables may pause for longer than `JUMP`; a longer pause than this is told."""
MOST_OFF = 0.1
"""Of more records than this share that seem off, it is the order of the file that is another."""
NEIGHBOURS = 5
_OF_TABLES = re.compile('--(?=(column|time-zone|time-unit|time-offset|date-order|ignore)( |$))')
MOST_NAMED = 20
"""At most this many bad rows are listed; all are counted."""


@define
class ConversionReport:
    """What a conversion did.

    messages: by topic; rows: lines or records read; bad_rows: left out; problems: one sentence for
    each of the first bad rows and for the file as a whole; questions: what is kept and looks
    wrong; reasons: bad rows by a word, of those that have one; kinds: all bad rows by kind, with
    one of each in `examples`; target_names: target IDs by name;
    notes: facts worth telling, such as the origin of local coordinates, also kept in the bag.
    """

    path: Path
    rows: int = 0
    bad_rows: int = 0
    messages: Counter[str] = Factory(Counter)
    problems: list[str] = Factory(list)
    questions: list[str] = Factory(list)
    notes: dict[str, str] = Factory(dict)
    reasons: Counter[str] = Factory(Counter)
    kinds: Counter[str] = Factory(Counter)
    target_names: dict[str, int] = Factory(dict)
    examples: dict[str, str] = Factory(dict)

    def bad_row(self, path: Path, where: str, why: object) -> None:
        """Count a bad row and name it while there are few."""
        self.bad_rows += 1
        if reason := getattr(why, 'reason', ''):
            self.reasons[reason.replace('_', ' ')] += 1
        kind = reason or re.sub(r"'.*'|[-\d.]+", '', str(why))
        self.kinds[kind] += 1
        sentence = f'{path.name}, {where}: {why}'
        self.examples.setdefault(kind, sentence)
        if self.bad_rows <= MOST_NAMED:
            self.problems.append(sentence)
        elif self.bad_rows == MOST_NAMED + 1:
            self.problems.append('further bad rows are counted but not listed')

    @contextmanager
    def leaving_out(self, path: Path, where: str) -> Iterator[None]:
        """Count a record as a bad row where it is rejected within."""
        try:
            yield
        except (BadRow, Rejection) as error:
            self.bad_row(path, where, error)

    def nothing(self, what: object) -> BagError:
        """The error of a file without a usable record, with its commonest problem."""
        words = f' ({self.problems[0]})' if self.problems else ''
        for kind, count in self.kinds.most_common(1):
            words = f' ({count} of {self.rows} rows, the first: {self.examples[kind]})'
        return BagError(f'{what} holds nothing that could be converted{words}')

    def read_rows(self, table: Table, parse: Callable[[Row], T]) -> Iterator[tuple[Row, T]]:
        """Yield the rows of `table` that `parse` accepts; count and name the others."""
        for row in table:
            self.rows += 1
            try:
                if row.line == table.cut_line:
                    raise BadRow('the line is cut off', 'cut off')
                yield row, parse(row)
            except (BadRow, Rejection) as error:
                self.bad_row(table.path, f'line {row.line}', error)
        self.note_columns(table)

    def note_columns(self, table: Table) -> None:
        """Note which columns of a file were taken for what, and which were not."""
        taken, left = table.columns_used()
        self.notes[f'columns of {table.path.name}'] = taken
        self.problems += table.problems
        for name, form in (table.forms | table.orders).items():
            if form not in ('', 'YMD'):
                self.notes[f'{name} of {table.path.name}'] = f'{table.header(name)} is {form}'
        for name, other, sign, way in (('z', 'depth', 1.0, 'up'), ('depth', 'z', -1.0, 'down')):
            header = table.header(name)
            values = table.first_numbers(table.index[name], sign) if table.has(name) else []
            sounds = name == 'depth' or re.search('depth|tiefe|down', header.lower())
            if sounds and values and max(values) > 0.0 and (name == 'z' or min(values) >= 0.0):
                self.questions.append(
                    f'{table.path.name}: {name} counts {way} and {header} is '
                    f'{"a depth" if name == "z" else "negative"}; is --column '
                    f"'{other}={header}' meant?"
                )
        if left:
            self.notes[f'ignored columns of {table.path.name}'] = left


@contextmanager
def flags_of(prefix: str, report: ConversionReport) -> Iterator[None]:
    """Name the options of a table beside the input, as in ``--truth-column``, in every sentence
    about that table."""
    name_flags = functools.partial(_OF_TABLES.sub, f'--{prefix}-')
    problems, examples = len(report.problems), set(report.examples)
    try:
        yield
    except BagError as error:
        sentence = name_flags(error.sentence)
        if sentence == error.sentence:
            raise
        raise BagError(sentence) from None
    finally:
        report.problems[problems:] = map(name_flags, report.problems[problems:])
        for kind in report.examples.keys() - examples:
            report.examples[kind] = name_flags(report.examples[kind])


def converter(options: type[Any]) -> Callable[[Converter], Callable[..., ConversionReport]]:
    """Makes ``convert(path, out, **values)`` of a function of path, options and report; values: as
    in `options`. It raises `BagError`."""

    def decorate(work: Converter) -> Callable[..., ConversionReport]:
        @functools.wraps(work)
        def convert(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
            report = ConversionReport(Path(out))
            work(Path(path), options(**values), report)
            return report

        return convert

    return decorate


@define
class Leaps:
    """How often a ship was where it cannot have come to: of two ships, every other time."""

    count: int = 0
    last: tuple[int, float, float] | None = None

    def saw(self, stamp_ns: int, east: float, north: float) -> None:
        """east, north: metres."""
        if self.last is not None:
            seconds = abs(stamp_ns - self.last[0]) / SECOND
            way = math.hypot(east - self.last[1], north - self.last[2])
            self.count += way > NEAR + FASTEST * seconds
        self.last = stamp_ns, east, north

    def saw_all(self, fixes: Iterable[VesselFix]) -> None:
        origin = None
        for fix in fixes:
            origin = origin or Origin(fix.latitude, fix.longitude)
            self.saw(fix.stamp_ns, *origin.local(fix.latitude, fix.longitude)[:2].tolist())

    def tell(self, path: Path, report: ConversionReport) -> None:
        if self.count:
            report.questions.append(
                f'{path.name}: {self.count} times the vessel was further from its last position '
                f'than {FASTEST:g} m/s would bring it; does the file hold two vessels?'
            )


def ask_for_units(
    stamp_ns: Sequence[int], position: Sequence[Any], path: Path, report: ConversionReport
) -> None:
    """Ask where positions (n, 2), m, are too far from each of the `NEIGHBOURS` before them: there
    may be several targets, in turn."""
    times, places = np.array(stamp_ns) / SECOND, np.array(position)
    speed = np.full(len(times), np.inf)
    for k in range(1, min(NEIGHBOURS + 1, len(times))):
        far = np.linalg.norm(places[k:] - places[:-k], axis=1)
        passed = np.abs(times[k:] - times[:-k])
        speed[k:] = np.minimum(speed[k:], far / np.where(passed > 0.0, passed, np.nan))
    known = speed[np.isfinite(speed)]
    if len(known) and (usual := float(np.median(known))) > FASTEST:
        report.questions.append(
            f'{path.name}: from row to row the positions move at {usual:.3g} m/s; is their unit, '
            'or that of the time, right?'
        )


def _wrong_stamps(
    streams: Mapping[str, Sequence[int]], source: str, report: ConversionReport
) -> set[int]:
    """Stamps, ns, at which a clock is off for itself, since the ones before and after agree. A
    clock that was set is followed, and said."""
    off: set[int] = set()
    for name, ordered in streams.items():
        stamps = np.array(ordered, np.int64)
        before, there, after = stamps[:-2], stamps[1:-1], stamps[2:]
        alone = (np.abs(after - before) <= JUMP) & (np.abs(there - before) > JUMP)
        alone &= np.abs(there - after) > JUMP
        if alone.sum() > max(1, MOST_OFF * len(stamps)):
            continue
        off |= set(there[alone].tolist())
        steps = np.diff(stamps[~np.isin(stamps, there[alone])])
        for step in steps[(steps < -JUMP) | (steps > PAUSE)][:1].tolist():
            report.problems.append(
                f'{source}: the clock jumps by {step / SECOND:g} s and stays there'
                + (f' ({name})' if name else '')
            )
    for stamp in sorted(off):
        why = BadRow('its clock is off', 'clock off')
        report.bad_row(Path(source), f'{stamp / SECOND:.3f} s', why)
    return off


def write_bag(
    report: ConversionReport,
    records: Iterable[Record],
    path: Path,
    how: Any,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
    streams: Mapping[str, Sequence[int]] | None = None,
    needed: str = '',
) -> None:
    """Write `records` of the file `path` in time order into the bag of `report`; log time = stamp.
    Those whose clock is off for itself are left out and counted.

    how: options of the conversion; parameters: those of the instruments, by the names of nodes;
    streams: stamps in the order in which each clock of the file said them, by default those of
    each topic; needed: a topic without which the others are of no use. Raises `BagError` when
    there is nothing to write or the bag cannot be made.
    """
    source = path.name
    # Bytes take less room than messages.
    packed = [
        (stamp, topic, message.__msgtype__, cdr_of(message)) for stamp, topic, message in records
    ]
    own: dict[str, list[int]] = {}
    for stamp, topic, *_ in packed:
        if 'truth/' not in topic:
            own.setdefault(topic, []).append(stamp)
    off = _wrong_stamps(own if streams is None else streams, source, report)
    ordered = sorted((each for each in packed if each[0] not in off), key=itemgetter(0))
    if not ordered or (needed and all(topic != needed for _, topic, *_ in ordered)):
        raise report.nothing(source)
    with new_bag(report, source, how, parameters) as bag:
        for stamp_ns, topic, kind, raw in ordered:
            bag.write_raw(topic, kind, raw, stamp_ns)


@contextmanager
def new_bag(
    report: ConversionReport,
    source: str,
    how: Any,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
) -> Iterator[BagWriter]:
    """Open the bag of a report, which has its notes and counts its messages, for writing."""
    notes = {'source': source, 'converted_by': 'sonar-imm convert', **report.notes}
    if named := {str(number): name for name, number in report.target_names.items()}:
        notes[TARGET_NAMES] = json.dumps(named, ensure_ascii=False)
    place, storage = report.path, how.storage
    with BagWriter(place, storage=storage, custom_data=notes, parameters=parameters) as bag:
        report.messages = bag.counts
        yield bag
