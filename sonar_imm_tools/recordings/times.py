# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Times of tables: dates, times of day, zones and days of spreadsheets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta, timezone, tzinfo
from decimal import Decimal
import itertools
import re
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from sonar_imm.estimation.arrays import FloatArray, IntArray

from .columns import plain
from .sources import BagError

_ZONE = r'\s*(Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)?$'
TIME_TEXT = re.compile(r'(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d)?)([.,]\d+)?' + _ZONE)
_COMPACT = re.compile(r'(\d{4})(\d\d)(\d\d)[T ]?(\d\d)(\d\d)(\d\d)([.,]\d+)?' + _ZONE)
TIME_OF_DAY = re.compile(r'(\d\d?):(\d\d)(?::(\d\d))?([.,]\d+)?\s*(?:([AaPp])\.?[Mm]\.?)?' + _ZONE)
_DATE_AND_CLOCK = re.compile(r'(.*\S)[T ,]\s*(\d\d?:\d\d.*)$')
ORDERS = {'DMY': (2, 1, 0), 'MDY': (2, 0, 1), 'YMD': (0, 1, 2)}
"""Places of year, month and day in a date of three numbers."""
_MONTHS = (
    'jan ene', 'feb fev', 'mar maerz mrz', 'apr abr avr', 'may mai maj', 'jun juin', 'jul juil',
    'aug ago aou', 'sep set', 'oct okt out', 'nov', 'dec dez dic des',
)  # fmt: skip
"""How the names of the months begin."""

HHMMSS, GPS = 'HHMMSS', 'gps'
DAYS = {
    'datenum': Decimal(719529), 'excel': Decimal(25569), 'julian': Decimal('2440587.5'),
    'mjd': Decimal(40587),
}  # fmt: skip
"""Days from day 0 of MATLAB, of spreadsheets and of the Julian calendar to 1970."""
_DAYS_SINCE_1900 = (25000, 73000)
"""Days of 1968 to 2099 by a spreadsheet."""
SHORTEST_STEP = 2e-3
"""Seconds; no instrument gives positions more often."""
_DIGITS = re.compile(r'(\d+)([.,]\d+)?$')

LEAPS = (
    362793600, 394329600, 425865600, 489024000, 567993600, 631152000, 662688000, 709948800,
    741484800, 773020800, 820454400, 867715200, 915148800, 1136073600, 1230768000, 1341100800,
    1435708800, 1483228800,
)  # fmt: skip
"""Seconds since 1970 at which a leap second was inserted since 1980; none is planned."""
GPS_EPOCH = 315964800
"""1980-01-06, in seconds since 1970."""
LEAST_EPOCH = 1e8
"""Seconds; fewer are counted from the start of a recording."""


def gps_minus_utc(seconds: FloatArray | IntArray) -> IntArray:
    """Return GPS time minus UTC (n,), s, at seconds since 1970 (n,).

    Source: IERS Bulletin C.
    """
    return np.searchsorted(np.array(LEAPS), seconds, side='right')


def of_gps_ns(nanoseconds: int) -> int:
    """Return nanoseconds since 1970 of those of GPS time."""
    since_1970 = nanoseconds + GPS_EPOCH * 10**9
    seconds = np.array([since_1970 // 10**9])
    leaps = int(gps_minus_utc(seconds - gps_minus_utc(seconds))[0])
    return since_1970 - leaps * 10**9


class BadRow(ValueError):
    """A row that cannot be used; the text says why, `reason` is a code where rows are counted by
    reason."""

    def __init__(self, why: str, reason: str = ''):
        super().__init__(why)
        self.reason = reason


def zone_of(name: str) -> tzinfo:
    """A time zone by what stands behind a time (``Z``, ``+0200``) or by its name. Raises
    `BagError`."""
    if name.upper() in ('Z', 'UTC', 'GMT'):
        return timezone.utc
    if offset := re.match(r'([+-])(\d\d):?(\d\d)?$', name):
        hours, minutes = int(offset.group(2)), int(offset.group(3) or 0)
        if hours < 24 and minutes < 60:
            ahead = timedelta(hours=hours, minutes=minutes)
            return timezone(ahead if offset.group(1) == '+' else -ahead)
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise BagError(
            f"there is no time zone '{name}'; write UTC, +02:00 or Europe/Berlin"
        ) from None


def moment_ns(text: str, zone: Callable[[], str]) -> int | None:
    """Nanoseconds since 1970 of a date and a time of day, in the zone that `zone` gives where the
    text names none; None for other texts. Raises `BadRow` and `BagError`."""
    if (parts := TIME_TEXT.match(text)) is None:
        return None
    date, clock, fraction, named = parts.groups()
    return iso_ns(date, clock, fraction, zone_of(named or zone()))


def iso_ns(date: str, clock: str, fraction: str | None, zone: tzinfo) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time; a leap second is the next second."""
    leap = clock.endswith(':60')
    clock = f'{clock[:-2]}59' if leap else clock
    try:
        moment = datetime.fromisoformat(f'{date}T{clock}').replace(tzinfo=zone)
    except ValueError:
        raise BadRow(f"'{date} {clock}' is no date and time of the calendar") from None
    if moment.utcoffset() != moment.replace(fold=1).utcoffset():
        raise BadRow(
            f"'{date} {clock}' is twice, or not at all, on the clocks of {zone}, which are set "
            'then; say --time-zone with an offset, e.g. +01:00',
            'clock change',
        )
    seconds = (moment - datetime(1970, 1, 1, tzinfo=timezone.utc)) // timedelta(seconds=1) + leap
    return seconds * 10**9 + round(Decimal('0.' + (fraction or '.0')[1:]) * 10**9)


def clock_text(text: str) -> str:
    """Write a time of day with hours of 24 and two digits; `text` has to match `TIME_OF_DAY`."""
    found = TIME_OF_DAY.match(text)
    assert found is not None
    hour, minute, second, fraction, half, zone = found.groups()
    if half:
        hour = str(int(hour) % 12 + (12 if half in 'Pp' else 0))
    seconds = f':{second}' if second else ''
    return f'{int(hour):02d}:{minute}{seconds}{fraction or ""}{zone or ""}'


def dated(date: str, clock: str, header: str, order: str = '') -> str:
    """A date and a time of day as one text; header: of the date; order: of its numbers, as in
    `ORDERS`, empty where it is not known. Raises `BadRow` for a date that can be read in several
    ways."""
    orders = orders_of([date])
    if order not in orders and len(orders) != 1:
        flags = ' or '.join(f'--date-order {each}' for each in orders)
        several = f'can be read in several ways: say {flags}, or'
        raise BadRow(
            f"{header} is '{date[:40]}', which {several if orders else 'is no date;'} "
            'write 2024-05-31',
            'date in several ways' if orders else 'no date',
        )
    order = order if order in orders else orders[0]
    year, month, day = (_parts(date)[place] for place in ORDERS[order])
    number = int(month) if month.isdecimal() else _month(month)
    return f'{int(year) + 2000 * (len(year) == 2)}-{number:02d}-{int(day):02d} {clock_text(clock)}'


def _parts(date: str) -> list[str]:
    """The three parts of a date, numbers or the name of a month; empty for other texts."""
    parts, year = plain(date).split('_'), len(date) - 4
    if len(parts) == 1 and year in (2, 4) and date.isdecimal():
        parts = [date[:year], date[year:-2], date[-2:]]
    numbers = sum(part.isdecimal() and len(part) in (1, 2, 4) for part in parts)
    named = sum(_month(part) > 0 for part in parts)
    return parts if len(parts) == 3 and numbers + named == 3 and numbers >= 2 else []


def _month(word: str) -> int:
    """The number of a month by its name; 0 for other words."""
    names = enumerate(_MONTHS, start=1)
    return next((k for k, starts in names if word.startswith(tuple(starts.split()))), 0)


def split_time(text: str) -> tuple[str, str] | None:
    """Split a date in any form and a time of day, None for other texts."""
    if found := _COMPACT.match(text):
        year, month, day, hour, minute, second, fraction, zone = found.groups()
        return f'{year}{month}{day}', f'{hour}:{minute}:{second}{fraction or ""}{zone or ""}'
    found = _DATE_AND_CLOCK.match(text)
    return (found[1], found[2]) if found and TIME_OF_DAY.match(found[2]) else None


def orders_of(dates: Sequence[str]) -> list[str]:
    """The orders in which all texts are dates of the calendar. Between points the day is first,
    unless the year is."""
    return [order for order in ORDERS if all(_fits(date, order) for date in dates)]


def _fits(date: str, order: str) -> bool:
    parts = _parts(date)
    if not parts:
        return False
    year, month, day = (parts[place] for place in ORDERS[order])
    if any(len(part) == 4 and part.isdecimal() for part in (month, day)) or len(year) == 1:
        return False
    if order == 'MDY' and '.' in date and month.isdecimal():
        return False
    known = 1 <= int(month) <= 12 if month.isdecimal() else _month(month) > 0
    return known and year.isdecimal() and day.isdecimal() and 1 <= int(day) <= 31


def hhmmss(text: str) -> str:
    """The time of day in one number, as in 095958.25, with colons; empty for other texts."""
    found = _DIGITS.match(text)
    if found is None or len(found[1]) > 6:
        return ''
    hour, minute, second = (found[1].zfill(6)[k : k + 2] for k in (0, 2, 4))
    valid = hour < '24' and minute < '60' and second < '60'
    return f'{hour}:{minute}:{second}{found[2] or ""}' if valid else ''


def form_of(header: str, cells: Sequence[str], with_date: bool) -> str:
    """What numbers of a column of times are: ``HHMMSS``, a name of `DAYS`, or empty for a count of
    seconds or another unit. with_date: there is a column of dates. Raises `BagError` where they
    may be several."""
    numbers = [cell.replace(',', '.') for cell in cells if _DIGITS.match(cell)]
    if not numbers or len(numbers) < len(cells):
        return ''
    if 'gps' in plain(header).split('_') and min(map(float, numbers)) > LEAST_EPOCH:
        raise BagError(
            f'{header} holds numbers such as {cells[0]}, which may be seconds of GPS time, since '
            '1980, or seconds since 1970; say --time-unit gps or --time-unit s'
        )
    clocks, values = [hhmmss(cell) for cell in numbers], [float(cell) for cell in numbers]
    widths = {len(cell.partition('.')[0]) for cell in numbers}
    if all(clocks) and (max(widths) > 4 if with_date else widths == {6} or widths == {5, 6}):
        seconds = [
            3600 * int(clock[:2]) + 60 * int(clock[3:5]) + float(clock[6:]) for clock in clocks
        ]
        padded = widths == {6} and any(cell.startswith('0') for cell in numbers)
        if padded or with_date and max(values) >= 86400.0 or _spread(seconds) < _spread(values):
            return HHMMSS
        raise BagError(
            f'{header} holds numbers such as {cells[0]}, which may be {clocks[0]} as HHMMSS or '
            'seconds; say --time-unit HHMMSS or --time-unit s'
        )
    steps = sorted(abs(after - before) for before, after in itertools.pairwise(values))
    step = steps[len(steps) // 2] if steps else 0.0
    if with_date and 0.0 <= min(values) and max(values) <= 86400.0:
        unit = 'excel' if max(values) < 1.0 and step < SHORTEST_STEP else 's'
        counted = 'parts of a day' if unit == 'excel' else 'seconds'
        raise BagError(
            f'{header} holds numbers such as {cells[0]} beside a date, which may be {counted} '
            f'since midnight, or seconds without a date; say --time-unit {unit} or --ignore date'
        )
    if steps and any('.' in cell for cell in numbers):
        for name, zero in DAYS.items():
            if step >= (0.5 if zero > 10**5 else SHORTEST_STEP):
                continue
            first, last = (day - DAYS['excel'] + zero for day in _DAYS_SINCE_1900)
            if first <= min(values) and max(values) <= last:
                raise BagError(
                    f'{header} holds numbers such as {cells[0]}, which may count days ({name}) or '
                    f'seconds; say --time-unit {name} or --time-unit s'
                )
    return ''


def _spread(values: Sequence[float]) -> float:
    """Range of the steps from value to value."""
    steps = [after - before for before, after in itertools.pairwise(values)]
    return max(steps, default=0.0) - min(steps, default=0.0)


def text_of_days(days: Decimal, unit: str) -> str:
    """The date and time of a number of days since day 0 of a unit of `DAYS`."""
    nanoseconds = round((days - DAYS[unit]) * 86400 * 10**6)
    moment = datetime(1970, 1, 1) + timedelta(microseconds=int(nanoseconds))
    return moment.isoformat(sep=' ', timespec='microseconds')
