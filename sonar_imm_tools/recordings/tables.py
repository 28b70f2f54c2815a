# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of any origin: any names of columns, any unit of time.

Columns are found by their usual names (`columns`); columns with other names are mapped by hand.
A row that cannot be read raises `BadRow`. Rows and their table need each other, so both are here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
from decimal import Decimal
import functools
import itertools
import math
from pathlib import Path
import re
from typing import ClassVar

from attrs import frozen

from sonar_imm.parameters import did_you_mean

from .columns import (
    ALIASES,
    DAY_NAMES,
    factor_of,
    FRACTIONS,
    LOTEK,
    name_of,
    NO,
    NOTHING,
    plain,
    quantities_of,
    rank_of,
    time_unit_of,
    YES,
    zone_in,
)
from .convert_options import CsvOptions, TIME_UNITS
from .sources import BagError
from .times import (
    BadRow,
    dated,
    DAYS,
    form_of,
    GPS,
    HHMMSS,
    hhmmss,
    moment_ns,
    of_gps_ns,
    orders_of,
    split_time,
    text_of_days,
    TIME_OF_DAY,
    TIME_TEXT,
)

LONGEST_NS = 10**8 * 10**9
"""A recording is shorter, a date since 1970 longer."""
ASKED = (
    'x', 'y', 'z', 'depth', 'latitude', 'longitude', 'range', 'bearing', 'heading',
    'vessel_x', 'vessel_y', 'vessel_latitude', 'vessel_longitude',
)  # fmt: skip
"""Quantities of which two columns with other values are a question."""
LOOKED_AT = 1000
"""Rows by which a file is judged."""

_THOUSANDS = re.compile(r'[-+]?\d{1,3}(,\d{3})+$')
_DECIMAL_COMMA = re.compile(r'[-+]?\d*,(\d{1,2}|\d{4,})$')
NUMBER = re.compile(r'[-+]?(\d+([.,]\d*)?|[.,]\d+)$')
_ZERO = re.compile(r'[-+]?0*([.,]0*)?$')

_NO_WORDS, _WORDS = (
    {word for word in words if len(word) > 1 and word.isalpha()} for words in (NO, (*YES, *NO))
)


@frozen
class Row:
    """One line of data; the methods raise `BadRow`."""

    table: Table
    line: int
    cells: list[str]

    def text(self, name: str) -> str:
        """The cell as text; empty when the column is missing or the line is short."""
        self.table.used.add(name)
        index = self.table.index.get(name, len(self.cells))
        return self.cells[index].strip() if index < len(self.cells) else ''

    def bad(self, name: str, why: str, reason: str = '') -> BadRow:
        """The error of a row whose cell cannot be used: its header, its text, and `why`."""
        return BadRow(f"{self.table.header(name)} is '{self.text(name)[:40]}'{why}", reason)

    def number(self, name: str) -> float:
        """A number that has to be there and finite. Raises `BadRow`."""
        value = self.optional(name)
        if math.isnan(value):
            raise BadRow(f'{self.table.header(name)} is empty')
        return value

    def empty(self, *names: str) -> bool:
        """Whether all of these cells are empty, or not a number, as some write that."""
        return all(self.text(name).lower() in NOTHING for name in names)

    def optional(self, name: str) -> float:
        """A number in the unit of its quantity (`columns.UNITS`); NaN when the cell is empty,
        missing or NaN."""
        if self.empty(name):
            return math.nan
        number = self._with_point(name)
        try:
            value = float(number)
        except ValueError:
            raise self.bad(name, ', not a number') from None
        if math.isinf(value):
            raise BadRow(f'{self.table.header(name)} is infinite')
        return value * self.table.factor(name)

    def _with_point(self, name: str) -> str:
        """The text of a number with a decimal point. Raises `BadRow`."""
        text = self.text(name)
        comma, point = text.rfind(','), text.rfind('.')
        if comma < 0:
            return text
        if point >= 0:
            mark = ',' if comma > point else '.'
            return text.replace('.' if mark == ',' else ',', '').replace(mark, '.')
        if _THOUSANDS.match(text) and not self.table.decimal_comma:
            raise self.bad(
                name,
                ': the comma may be that of thousands or a decimal one; write a decimal point',
            )
        return text.replace(',', '.')

    def height(self) -> float:
        """z, or minus the depth, in metres; 0 without either."""
        z = self.optional('z') if self.table.has('z') else -self.optional('depth')
        return 0.0 if math.isnan(z) else z

    def require_valid(self) -> None:
        """Raise `BadRow` for a row that the column ``valid``, or ``status`` where it holds words
        such as OK and error, marks as invalid, or whose ``quality`` is a word such as bad. What
        other words and numbers say of a quality is not known."""
        if self.table.has_words('quality') and plain(self.text('quality')) in _NO_WORDS:
            raise BadRow('the row is flagged as invalid', 'flagged invalid')
        name = 'valid' if self.table.has('valid') or not self.table.has_status else 'status'
        flag = self.text(name).lower()
        if self.table.flags(name) == {'a', 'v'}:  # active and void, as in NMEA
            flag = {'a': 'ok', 'v': 'no'}.get(flag, flag)
        if flag and {flag, plain(flag)}.isdisjoint(YES):
            if not {flag, plain(flag)}.isdisjoint(NO):
                raise BadRow('the row is flagged as invalid', 'flagged invalid')
            raise BadRow(f"{self.table.header(name)} is '{flag[:40]}', neither true nor false")

    def seconds_ns(self, name: str) -> int:
        """A duration or a time as integer nanoseconds, exactly as written."""
        try:
            nanoseconds = Decimal(self._with_point(name)) * self.table.time_scale(name)
            if not abs(nanoseconds) < 2**63:
                why = 'is the time unit right (--time-unit ms, us or ns)?'
                raise self.bad(name, f', beyond the year 2262; {why}')
            return round(nanoseconds)
        except ArithmeticError:
            raise self.bad(name, ', not a time: a number or 2024-05-31T10:00:00Z') from None

    def stamp_ns(self, name: str = 'stamp') -> int:
        """A time since 1970 in integer nanoseconds, with the offset of the options added."""
        stamp = moment_ns(self._moment(name), lambda: self._zone(name))
        if stamp is None:
            stamp = self.seconds_ns(name)
            if self.table.time_form(name) == GPS:
                stamp = of_gps_ns(stamp)
            if 0 <= stamp <= 86400 * 10**9 and self.table.has('date') and name == 'stamp':
                stamp += moment_ns(self._dated('00:00'), lambda: self._zone(name)) or 0
        if name == 'stamp':
            stamp = self._with_fraction(stamp)
        stamp += self.table.options.time_offset_ns
        if not stamp and self.table.counts_from_zero(name):
            stamp = 1  # a stamp of 0 means none in ROS
        if not 0 < stamp < 2**31 * 10**9:
            raise BadRow(
                f'{self.table.header(name)} is {stamp} ns since 1970, which no ROS stamp '
                'can hold; set the time offset or the time unit'
            )
        return stamp

    def _with_fraction(self, stamp_ns: int) -> int:
        """A time with the part of a second that stands in a column of its own."""
        unit = self.table.fraction_unit
        own = round(self.number('fraction') * unit) if unit else 0
        if stamp_ns % 10**9 == 0:
            return stamp_ns + own
        if unit and abs(stamp_ns % 10**9 - own) > unit:
            stamp, fraction = map(self.table.header, ('stamp', 'fraction'))
            raise BadRow(f'{stamp} has another part of a second than {fraction}')
        return stamp_ns

    def _dated(self, clock: str) -> str:
        """A time of day with the date of its own column."""
        header, order = self.table.header('date'), self.table.date_order('date')
        return dated(self.text('date'), clock, header, order)

    def _moment(self, name: str) -> str:
        """The text of a time, with the date of its own column where it has only a time of day."""
        text, form = self.text(name), self.table.time_form(name)
        if TIME_TEXT.match(text):
            return text
        if parts := None if self.table.time_unit(name) else split_time(text):
            return dated(*parts, self.table.header(name), self.table.date_order(name))
        if form in DAYS:
            try:
                days = Decimal(self._with_point(name))
                moment = text_of_days(days, form)
            except (ArithmeticError, ValueError):
                return text
            own_date = 0 <= days < 1 and self.table.has('date')
            return self._dated(moment[11:]) if own_date else moment
        clock = hhmmss(text) if form == HHMMSS else text
        if form == HHMMSS and not clock:
            raise self.bad(name, ', not a time as HHMMSS')
        if not TIME_OF_DAY.match(clock):
            return text
        if not self.table.has('date'):
            what = f'a time of day{" as HHMMSS" if form == HHMMSS else ""}'
            why = f', {what}, and no column holds the date: add one, named date'
            raise self.bad(name, why, 'no date')
        return self._dated(clock)

    def _zone(self, name: str) -> str:
        """The zone of a time that does not say it."""
        if self.table.options.time_zone:
            return self.table.options.time_zone
        for header in (self.table.with_unit(name), self.table.with_unit('date')):
            if zone := zone_in(header):
                return zone
        how = '--time-zone UTC, or that of the clock, e.g. --time-zone +02:00'
        raise self.bad(name, f' without a time zone; say {how}', 'no time zone')


class Table:
    """Named columns and an iterator over the rows of a file of any kind."""

    delimiter = ','
    UNITS_ARE_FREE: ClassVar = False
    """Whether the kind of file leaves open what unit latitudes and x have."""

    def __init__(self, path: str | Path, options: CsvOptions | None, headers: Sequence[str]):
        self.path = Path(path)
        self.options = options or CsvOptions()
        self.headers = list(headers)
        self.units: list[str] = []
        self.index = self._find_columns()
        self.used: set[str] = set()
        self.problems: list[str] = []
        self.cut_line = 0
        self._from_zero: dict[str, bool] = {}
        self._factors: dict[str, float] = {}
        self._flags: dict[str, set[str]] = {}
        self.forms: dict[str, str] = {}
        self.orders: dict[str, str] = {}

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """The number of its line, or of its record, and the cells of each row."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Row]:
        for line, cells in self.rows():
            yield Row(self, line, cells)

    def has(self, *names: str) -> bool:
        """Say whether every one of these quantities has a column."""
        return all(name in self.index for name in names)

    def require(self, *names: str) -> None:
        """Raise `BagError` naming the quantities without a column and what the file has."""
        if missing := [name for name in names if name not in self.index]:
            raise BagError(
                f'{self.path} has no column for {" and ".join(missing)}; it has '
                f'{", ".join(self.headers[:12])}; say which column holds '
                f'{"it" if len(missing) == 1 else "them"}, as in --column {missing[0]}=HEADER'
            )

    @functools.cached_property
    def first_rows(self) -> list[Row]:
        """The rows by which the file is judged."""
        return list(itertools.islice(self, LOOKED_AT))

    def first_cells(self, column: int) -> list[str]:
        """The cells of a column that are not empty, of the rows by which the file is judged."""
        cells = (row.cells[column].strip() for row in self.first_rows if column < len(row.cells))
        return [cell for cell in cells if cell.lower() not in NOTHING]

    def is_blank(self, *names: str) -> bool:
        """Say whether these quantities are empty or zero in every row that is looked at."""
        cells = (cell for name in names for cell in self.first_cells(self.index[name]))
        return all(_ZERO.match(cell) for cell in cells)

    def varies(self, column: int) -> bool:
        """Say whether a column holds numbers that change, and does not count the rows."""
        values = self.first_numbers(column, 1.0)
        steps = {after - before for before, after in itertools.pairwise(values)}
        return bool(steps - {0.0, 1.0})

    @functools.cached_property
    def decimal_comma(self) -> bool:
        """Whether commas within cells are decimal ones."""
        cells = (cell for row in self.first_rows for cell in row.cells)
        return self.delimiter != ',' or any(_DECIMAL_COMMA.match(cell.strip()) for cell in cells)

    @functools.cached_property
    def has_status(self) -> bool:
        """Whether the column ``status`` holds words for good or bad, or A and V of NMEA."""
        return self.flags('status') == {'a', 'v'} or self.has_words('status')

    def has_words(self, name: str) -> bool:
        """Say whether a column holds words for good or bad."""
        return not self.flags(name).isdisjoint(_WORDS)

    def flags(self, name: str) -> set[str]:
        """Return the words of a column in the rows by which the file is judged."""
        if name not in self._flags:
            cells = self.first_cells(self.index.get(name, len(self.headers)))
            self._flags[name] = {plain(cell) for cell in cells}
        return self._flags[name]

    def factor(self, name: str) -> float:
        """Factor from the unit of a column to that of its quantity. Raises `BagError`."""
        if name not in self._factors:
            self._factors[name] = factor_of(name, self.with_unit(name))
            self._ask_for_one(name)
        return self._factors[name]

    def _ask_for_one(self, name: str) -> None:
        """Raise `BagError` where several columns may be this quantity and hold other values."""
        own = self.index.get(name, -1)
        if name in self.options.columns or name not in ASKED or own < 0:
            return
        if rank_of(name, self.headers[own]) < 0:  # that of a target is the one
            return
        limit = 1e-6 if name.endswith('itude') else 0.02
        for other, header in enumerate(self.headers):
            if other in self.index.values() or name not in quantities_of(header):
                continue
            pairs = zip(
                self.first_numbers(own, self._factors[name]),
                self.first_numbers(other, factor_of(name, header)),
            )
            if any(abs(a - b) > limit for a, b in pairs):
                raise BagError(
                    f'{self.path}: {self.headers[own]} and {header} may both be {name}, and '
                    f"differ; say --column '{name}={self.headers[own]}' or --column "
                    f"'{name}={header}'"
                )

    def first_numbers(self, column: int, factor: float) -> list[float]:
        """The numbers of a column of the rows by which the file is judged; none where a cell is
        no number."""
        cells = self.first_cells(column)
        whole = all(NUMBER.match(cell) for cell in cells)
        return [factor * float(cell.replace(',', '.')) for cell in cells] if whole else []

    def counts_from_zero(self, name: str) -> bool:
        """Whether the first times of the file are seconds from its own start rather than a date,
        so that a time of 0 is one, and not one that is missing."""
        if name not in self._from_zero:
            times = []
            for row in self.first_rows:
                with contextlib.suppress(BadRow):
                    times.append(row.seconds_ns(name))
            self._from_zero[name] = max(times, default=0) < LONGEST_NS
        return self._from_zero[name]

    def columns_used(self) -> tuple[str, str]:
        """What was taken from which column so far, and which columns were not, as text."""
        taken = {name: k for name, k in self.index.items() if name in self.used}
        columns = (
            name if self.headers[k] == name else f'{name} = {self.headers[k]}'
            for name, k in taken.items()
        )
        left = (header for k, header in enumerate(self.headers) if k not in taken.values())
        return ', '.join(columns), ', '.join(header or '(no name)' for header in left)

    def header(self, name: str) -> str:
        """What the file calls a quantity."""
        return self.headers[self.index[name]] if name in self.index else name

    def with_unit(self, name: str) -> str:
        """Return the header of a quantity with the unit that a row below the headers states."""
        unit = self.units[self.index[name]] if self.units and name in self.index else ''
        return f'{self.header(name)} [{unit}]' if unit else self.header(name)

    def time_scale(self, name: str) -> int:
        """Nanoseconds in one unit of a time column."""
        return TIME_UNITS.get(self.time_unit(name), TIME_UNITS['s'])

    def time_unit(self, name: str) -> str:
        """The unit of a time column that the options or its header state, else empty."""
        return self.options.time_unit or time_unit_of(self.with_unit(name))

    def time_form(self, name: str) -> str:
        """How numbers of a time column are meant where they are no count of seconds: `HHMMSS` or a
        name of `DAYS`. Raises `BagError` where that is not clear."""
        if name not in self.forms:
            unit = self.time_unit(name) or DAY_NAMES.get(name_of(self.header(name)), '')
            form = unit if unit in (HHMMSS, *DAYS, GPS) else ''
            if not unit and name in self.index:
                cells = self.first_cells(self.index[name])
                form = form_of(self.header(name), cells, self.has('date'))
            self.forms[name] = form
        return self.forms[name]

    def date_order(self, name: str) -> str:
        """The order of day, month and year in dates that are only numbers; empty where the rows
        leave several."""
        if self.options.date_order or name not in self.index:
            return self.options.date_order
        if name not in self.orders:
            cells = self.first_cells(self.index[name])
            orders = orders_of([(split_time(cell) or (cell,))[0] for cell in cells])
            if LOTEK <= {name_of(header) for header in self.headers}:
                orders = ['MDY']
            self.orders[name] = orders[0] if len(orders) == 1 else ''
        return self.orders[name]

    @functools.cached_property
    def fraction_unit(self) -> int:
        """Nanoseconds in one unit of the column of the parts of seconds; 0 without such a column,
        or where its values are no parts of a second."""
        if not self.has('fraction'):
            return 0
        header = name_of(self.header('fraction'))
        unit = next((ns for begin, ns in FRACTIONS.items() if header.startswith(begin)), 10**9)
        values = self.first_numbers(self.index['fraction'], unit)
        return unit if values and all(0.0 <= value < 1e9 for value in values) else 0

    def _find_columns(self) -> dict[str, int]:
        """Match headers with quantities: mapped by hand first, then by their usual names."""
        by_hand = {}
        for name, header in self.options.columns.items():
            if header not in self.headers:
                raise BagError(
                    f"{self.path} has no column '{header}'{did_you_mean(header, self.headers)}"
                )
            by_hand[name] = self.headers.index(header)
        found = dict(by_hand)
        usual = {
            k: quantities_of(header)
            for k, header in enumerate(self.headers)
            if k not in by_hand.values()
        }
        for name in ALIASES:
            free = [k for k, names in usual.items() if name in names]
            if name not in found and free and name not in self.options.ignore:
                found[name] = min(free, key=lambda k: rank_of(name, self.headers[k]))
        return found
