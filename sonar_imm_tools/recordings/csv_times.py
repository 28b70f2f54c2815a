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

"""Times as people write them in tables, in integer nanoseconds since 1970."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone, tzinfo
from decimal import Decimal
import re
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from .sources import BagError

TIME_TEXT = re.compile(
    r'(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d)?)([.,]\d+)?\s*(Z|[+-]\d\d:?\d\d)?$'
)
TIME_OF_DAY = re.compile(r'\d\d?:\d\d(:\d\d)?([.,]\d+)?\s*(Z|[+-]\d\d:?\d\d)?$')
_DATES = (
    (re.compile(r'(\d{4})[-/.](\d\d?)[-/.](\d\d?)$'), (1, 2, 3)),
    (re.compile(r'(\d{4})(\d\d)(\d\d)$'), (1, 2, 3)),
    (re.compile(r'(\d\d?)\.(\d\d?)\.(\d{4})$'), (3, 2, 1)),
)
"""Forms of a date that can be read in one way only, with the places of year, month and day."""


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
    if offset := re.match(r'([+-])(\d\d):?(\d\d)$', name):
        hours, minutes = int(offset.group(2)), int(offset.group(3))
        if hours < 24 and minutes < 60:
            ahead = timedelta(hours=hours, minutes=minutes)
            return timezone(ahead if offset.group(1) == '+' else -ahead)
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise BagError(
            f"there is no time zone '{name}'; write UTC, +02:00 or Europe/Berlin"
        ) from None


def iso_ns(date: str, clock: str, fraction: str | None, zone: tzinfo) -> int:
    """Nanoseconds since 1970 of an ISO 8601 time."""
    try:
        moment = datetime.fromisoformat(f'{date}T{clock}').replace(tzinfo=zone)
    except ValueError:
        raise BadRow(f"'{date} {clock}' is no date and time of the calendar") from None
    elapsed = moment - datetime(1970, 1, 1, tzinfo=timezone.utc)
    nanoseconds = (elapsed.days * 86400 + elapsed.seconds) * 10**9
    return nanoseconds + round(Decimal('0.' + (fraction or '.0')[1:]) * 10**9)


def dated(date: str, clock: str, header: str) -> str:
    """A date and a time of day as one text; header: of the date. Raises `BadRow` for a date that
    can be read in several ways."""
    for form, places in _DATES:
        if found := form.match(date):
            year, month, day = (int(found.group(place)) for place in places)
            padded = clock if clock[2] == ':' else f'0{clock}'
            return f'{year:04d}-{month:02d}-{day:02d} {padded}'
    raise BadRow(f"{header} is '{date[:40]}', which can be read in several ways; write 2024-05-31")
