# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Logs of NMEA 0183 sentences and AIS messages: positions of targets, and of the vessel itself.

Positions of targets are those that AIS reports (``!AIVDM``: messages 1, 2, 3, 18, 19 and 27, by
MMSI) and targets with latitude and longitude (``TLL``). Tracked targets with distance and bearing
(``TTM``) and those of the USBL of a vessel (``USRTH``, ``PSIMSSB``) are placed from the vessel's
last position. That is in ``GGA``, ``RMC``, ``GLL`` or ``GNS`` of one talker, its heading in
``HDT``, ``THS`` or ``PSIMSNS``.

In this order a time is that before the sentence (seconds since 1970 or ISO 8601), that of its tag
block (``\\c:...*hh\\``), or the vessel's clock as of the last sentence that had one, with the date
of ``ZDA`` or ``RMC``. An AIS report says the second at which it was true; its time is moved there.
Each sentence is read with what those before it said, so all kinds of sentence stand here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from datetime import date as Date
from datetime import datetime, timedelta, timezone
from datetime import time as Time
import math
from pathlib import Path
import re
from typing import Any

from attrs import define, Factory
import numpy as np

from msg_adapters.fixes import write_geodetic
from msg_adapters.navigation import write_heading
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import quaternion
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Rejection, VesselFix, VesselHeading

from ... import SECOND
from ..conversion import ConversionReport, converter, Leaps, Record
from ..convert_options import FixesOptions, NmeaOptions
from ..messages import ros_message
from ..places import check_place
from ..sources import BagError
from ..table_files import TrackFile
from ..times import BadRow, iso_ns, moment_ns
from .fixes import write_fixes

LONGEST_LINE = 1000
LATER = timedelta(hours=12)
"""A time of day that is further back than this belongs to the next day."""
HALF_MINUTE = 30 * SECOND
LENGTHS = {'K': 1000.0, 'N': 1852.0, 'S': 1609.344}
"""Metres of the units of ``TTM``: kilometres, nautical and statute miles."""
ACCURATE, INACCURATE = 5.0, 15.0
"""Standard deviation on each axis of an AIS position, m: the report says better or worse than
10 m."""
SENTENCE = re.compile(r'^(?P<before>.*?)(?P<sentence>[$!][A-Z]{4,8},.*?\*[0-9A-Fa-f]{2})\s*$')
"""A sentence, behind a time or a tag block where there is one."""
USBL = ('USRTH', 'PSIMSSB', 'PSIMSNS')
OTHER_USBL = ('PSIMLBP', 'PTSAG', 'PTSAX')
"""Sentences of targets that are not read."""
OWN = re.compile(r'\$([A-Z]{2})(?:GGA|RMC|GLL|GNS),')
"""A sentence with the position of the receiver itself, and its talker."""
FARTHEST_CLOCK = 600.0
"""Seconds between the clock of a logger and that of a receiver in one zone."""
APART = 20.0
"""Metres between what is said of one moment from which on it is of two receivers; two decimals of
a minute are 18 m."""
_CLOCK = re.compile(r'\d{6}(\.\d*)?$')
_TAG_BLOCK = re.compile(r'\\(?:[^\\]*,)?c:(\d+)[^\\]*\\\s*$')


@define
class _Log:
    """What was read so far. clock: ns since 1970 of the last sentence with a time; place: of the
    vessel (latitude, longitude), degrees; std: of its position, m, NaN when nobody says."""

    day: Date | None = None
    clock: int | None = None
    of_day: Time | None = None
    place: tuple[float, float] | None = None
    heading: float = math.nan
    std: float = math.nan
    own: list[VesselFix] = Factory(list)
    headings: list[VesselHeading] = Factory(list)
    targets: list[dict[str, str]] = Factory(list)
    unread: Counter[str] = Factory(Counter)
    hears: bool = False
    """Whether the vessel has a USBL."""
    talkers: Counter[str] = Factory(Counter)
    """How many sentences each talker says of the place of the receiver."""
    talker: str = ''
    """That of the vessel's positions, where several say them."""
    apart: list[float] = Factory(list)
    """Metres between two positions of one moment."""
    seen: tuple[VesselFix, str, str] | None = None
    """The first position of the last moment, its talker and its kind of sentence."""
    no_zone: int = 0
    """How many times before a sentence name no zone."""
    ahead: list[float] = Factory(list)
    """Seconds from the time in a sentence, UTC, to that before it; of the nearest day."""

    def zone(self, stated: str) -> str:
        """Return the zone of times before a sentence that name none: `stated`, else UTC."""
        self.no_zone += not stated
        return stated or 'UTC'

    def now(self) -> int:
        """The time of the sentence that is read. Raises `BadRow`."""
        if self.clock is not None:
            return self.clock
        if self.of_day is not None:
            raise BadRow(
                'has a time of day and no date: say that of the first line with --date 2024-05-31',
                'no date',
            )
        raise BadRow(
            'has no time, and none came before it; log a time before each line, or sentences with '
            'a time',
            'no time',
        )

    def bow(self) -> float:
        """The heading, degrees, of what counts from the bow. Raises `BadRow`."""
        if math.isnan(self.heading):
            raise BadRow('counts from the bow and no heading came before it', 'no heading')
        return self.heading


@converter(NmeaOptions)
def convert_nmea(path: Path, how: NmeaOptions, report: ConversionReport) -> None:
    """Convert a log of sentences to ``/fixes`` of its targets, and ``/nav_fix`` and ``/heading``
    of the vessel; where it holds no targets, the vessel's positions are the fixes.
    """
    log = _read(path, report, how)
    rows, beside = log.targets, list[Record]()
    if how.own == 'fixes' or (how.own == 'auto' and not (log.targets or log.hears)):
        rows += [_row(fix.stamp_ns, fix.latitude, fix.longitude, fix.height) for fix in log.own]
        report.notes['own'] = 'the positions of the receiver itself are the fixes'
    else:
        beside += [(fix.stamp_ns, '/nav_fix', write_geodetic(fix, ros_message)) for fix in log.own]
    beside += [
        (each.stamp_ns, '/heading', write_heading(each, ros_message)) for each in log.headings
    ]
    _tell_receivers(log, path, report, how.talker)
    _tell_zone(log, path, report)
    leaps = Leaps()
    leaps.saw_all(log.own)
    leaps.tell(path, report)
    if log.unread:
        counts = log.unread.most_common(12)
        report.notes['not used'] = ', '.join(f'{count} {name}' for name, count in counts)
    if not rows:
        if log.unread and not report.problems:
            report.problems.append(f'not used: {report.notes["not used"]}')
        raise report.nothing(path)
    shared = ('truth', 'truth_options', 'frame_id', 'origin', 'storage')
    fixes, lines = FixesOptions(**{name: getattr(how, name) for name in shared}), report.rows
    write_fixes(TrackFile(path, None, rows, 'a log of NMEA sentences'), report, fixes, beside)
    report.rows = lines


def _tell_receivers(log: _Log, path: Path, report: ConversionReport, chosen: str) -> None:
    """Say that a log holds positions of several receivers. Raises `BagError` where they lie apart
    and nobody has chosen."""
    apart = float(np.median(log.apart)) if len(log.apart) > 1 else 0.0
    if len(log.talkers) > 1:
        counts = ', '.join(f'{talker} ({count})' for talker, count in log.talkers.most_common())
        if apart > APART and not chosen:
            options = ' or '.join(f'--talker {talker}' for talker in log.talkers)
            raise BagError(
                f'{path} holds positions of the talkers {counts}, which are {apart:.3g} m apart: '
                f'two receivers. Say which: {options}'
            )
        report.notes['talkers'] = f'{counts}: the positions of {log.talker} are used'
    elif apart > APART:
        report.questions.append(
            f'{path.name}: {len(log.apart)} positions of one moment are {apart:.3g} m apart: are '
            'there two receivers in one log? The first of each moment is used'
        )


def _tell_zone(log: _Log, path: Path, report: ConversionReport) -> None:
    """Say that times before sentences name no zone. Raises `BagError` where those in the sentences
    are others."""
    if not log.no_zone:
        return
    ahead = float(np.median(log.ahead)) if log.ahead else 0.0
    if abs(ahead) > FARTHEST_CLOCK:
        raise BagError(
            f'{path}: the times before the sentences name no zone and are {ahead / 3600.0:+.2g} h '
            'from those in the sentences (UTC); say --time-zone, e.g. --time-zone +02:00 or UTC'
        )
    if not log.ahead:
        report.questions.append(
            f'{path.name}: the times before the sentences name no zone and are taken for UTC; is '
            '--time-zone +02:00 or another one meant?'
        )


def _read(path: Path, report: ConversionReport, how: NmeaOptions) -> _Log:
    try:
        import pyais
        import pynmea2
    except ImportError:
        raise BagError(
            "logs of NMEA sentences need pyais and pynmea2: pip install 'sonar_imm[nmea]'"
        ) from None
    log = _Log(
        talkers=Counter(match[1] for _, line in _lines(path) if (match := OWN.search(line)))
    )
    try:
        log.day = Date.fromisoformat(how.date) if how.date else None
    except ValueError:
        raise BagError(f"'{how.date}' is no date; write 2024-05-31") from None
    if how.talker and how.talker not in log.talkers:
        raise BagError(
            f'no position in {path} is of the talker {how.talker}; there are '
            f'{", ".join(log.talkers) or "none"}'
        )
    log.talker = how.talker or next((talker for talker, _ in log.talkers.most_common(1)), '')
    wrong = (pynmea2.ParseError, pyais.exceptions.AISBaseException, BadRow, Rejection)
    for number, line in _lines(path):
        report.rows += 1
        found = SENTENCE.match(line)
        if found is None:
            report.bad_row(path, f'line {number}', 'is no sentence with a checksum')
            continue
        try:
            stamp = _stamp(found['before'], lambda: log.zone(how.time_zone))
            sentence = found['sentence']
            head = sentence[1:].partition(',')[0]
            if head in USBL:
                _take_usbl(log, sentence, stamp)
            elif head[2:] == 'THS':  # which pynmea2 does not know
                _, degrees, mode = _fields(sentence)[:3]
                log.clock = stamp or log.clock
                if mode == 'V':
                    raise BadRow('is flagged as invalid', 'flagged invalid')
                _take_heading(log, float(degrees or 'nan'))
            elif head in OTHER_USBL:
                log.hears = True
                raise BadRow(
                    f'{head} is of a USBL and not read; --own fixes tracks the vessel itself',
                    'not read',
                )
            elif sentence[3:6] in ('VDM', 'VDO'):
                _take_ais(log, pyais.decode(sentence.encode()), stamp, sentence[3:6] == 'VDO')
            else:
                _take(log, pynmea2.parse(sentence, check=True), stamp)
        except pynmea2.SentenceTypeError:
            log.unread[head] += 1
        except wrong as error:
            report.bad_row(path, f'line {number}', error)
        except (ValueError, TypeError, IndexError, AttributeError, KeyError) as error:
            # Neither library promises more for sentences of the right sum and the wrong content.
            report.bad_row(path, f'line {number}', f'cannot be understood: {error}')
    return log


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with path.open(encoding='ascii', errors='replace') as file:
            for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ''), start=1):
                if line.strip():
                    yield number, line.strip()
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None


def _stamp(before: str, zone: Callable[[], str]) -> int | None:
    """The time that stands before a sentence, ns since 1970, in `zone` where it names none."""
    if block := _TAG_BLOCK.search(before):
        number = int(block.group(1))
        return number * (10**6 if number > 10**11 else SECOND)
    text = before.split('\\')[0].strip(' \t,;[]')
    if not text:
        return None
    if (stamp_ns := moment_ns(text, zone)) is not None:
        return stamp_ns
    if re.fullmatch(r'\d{9,10}(\.\d+)?', text):
        return round(float(text) * 1e6) * 1000
    return int(text) * 10**6 if re.fullmatch(r'\d{12,13}', text) else None


def _take(log: _Log, sentence: Any, stamp: int | None) -> None:
    """What a sentence of NMEA 0183 says. Raises `BadRow` or `Rejection`."""
    kind = getattr(sentence, 'sentence_type', '')
    if not kind:  # of a maker
        log.unread[sentence.identifier()] += 1
        return
    day: Any = getattr(sentence, 'datestamp', None) if kind != 'ZDA' else None
    if kind == 'ZDA':
        day = Date(int(sentence.year), int(sentence.month), int(sentence.day))
    if isinstance(day, Date) and day != log.day:
        log.day, log.of_day = day, None
    clock = getattr(sentence, 'timestamp', None)
    if stamp is not None:
        log.clock = stamp
        if clock and kind not in ('GST', 'TLL', 'TTM'):
            own = 3600 * clock.hour + 60 * clock.minute + clock.second
            log.ahead.append((stamp / SECOND - own + 43200.0) % 86400.0 - 43200.0)
    elif clock and kind != 'GST':
        if not _CLOCK.match(str(sentence.data[sentence.name_to_idx['timestamp']])):
            raise BadRow('has a time that cannot be read as HHMMSS', 'unreadable time')
        _tell_time(log, clock)
    if kind in ('GGA', 'RMC', 'GLL', 'GNS'):
        _take_own(log, sentence)
    elif kind == 'HDT':
        _take_heading(log, float(sentence.data[0] or 'nan'))
    elif kind == 'GST':
        log.std = max(map(float, (sentence.std_dev_latitude, sentence.std_dev_longitude)))
    elif kind == 'TLL':
        log.hears = True
        row = _row(log.now(), sentence.latitude, sentence.longitude)
        log.targets.append(row | {'id': str(sentence.target_name or sentence.target_number)})
    elif kind == 'TTM':  # by distance and bearing from the vessel
        log.hears = True
        bearing = float(sentence.bearing) + (log.bow() if sentence.brg_ref == 'R' else 0.0)
        distance = float(sentence.distance) * LENGTHS.get(sentence.dist_unit or 'N', math.nan)
        angle = math.radians(bearing)
        away = np.array([distance * math.sin(angle), distance * math.cos(angle), 0.0])
        _take_target(log, away, str(sentence.name or sentence.target_number))
    elif not isinstance(day, Date):
        log.unread[kind] += 1


def _tell_time(log: _Log, clock: Time) -> None:
    """Set the clock of the log by a time of day."""
    clock = clock.replace(tzinfo=None)
    if log.day is None:
        log.of_day = clock
        return
    if log.of_day is not None:
        back = datetime.combine(log.day, log.of_day) - datetime.combine(log.day, clock)
        log.day += timedelta(days=int(back > LATER))
    log.of_day = clock
    log.clock = iso_ns(
        log.day.isoformat(), clock.strftime('%H:%M:%S'), f'.{clock.microsecond:06d}', timezone.utc
    )


def _take_own(log: _Log, sentence: Any) -> None:
    kind = sentence.sentence_type
    good = {'GGA': 'gps_qual', 'RMC': 'status', 'GLL': 'status', 'GNS': 'mode_indicator'}[kind]
    if not sentence.lat or str(getattr(sentence, good, '')) in ('0', 'V', 'N', 'NN'):
        raise BadRow('has no valid position', 'no position')
    latitude, longitude = float(sentence.latitude), float(sentence.longitude)
    check_place(latitude, longitude)
    stamp_ns = log.now()
    height = (sentence.altitude, sentence.geo_sep) if kind == 'GGA' else ()
    fix = VesselFix(
        stamp_ns=stamp_ns,
        latitude=latitude,
        longitude=longitude,
        height=sum((float(part or 0.0) for part in height), 0.0),
        covariance=log.std**2 * np.diag([1.0, 1.0, 4.0]) if log.std > 0.0 else None,
        frame_id='gps',
    )
    apart = 0.0
    if log.seen is None or log.seen[0].stamp_ns != stamp_ns:
        log.seen = fix, sentence.talker, kind
    else:
        first, talker, other = log.seen
        there = Origin(first.latitude, first.longitude, 0.0)
        apart = float(np.hypot(*there.local(fix.latitude, fix.longitude, 0.0)[:2]))
        # A receiver says one kind of sentence once.
        log.apart += [apart] if talker != sentence.talker or kind == other else []
    if sentence.talker != log.talker:
        return
    if not log.own or log.own[-1].stamp_ns != stamp_ns:
        log.own.append(fix)
    elif apart > APART:
        return
    elif kind == 'GGA':  # of several of one moment the one with a height
        log.own[-1] = fix
    log.place = fix.latitude, fix.longitude


def _take_heading(log: _Log, degrees: float, roll: float = 0.0, pitch: float = 0.0) -> None:
    """How the vessel lies, degrees: clockwise from true north, and the Euler angles of axes
    forward, left, up. Raises `BadRow`."""
    if not 0.0 <= degrees <= 360.0:
        raise BadRow('has no heading from 0 to 360 degrees', 'no heading')
    log.heading, stamp_ns = degrees % 360.0, log.now()
    if log.headings and log.headings[-1].stamp_ns == stamp_ns:
        return
    level = [angle if abs(angle) <= 90.0 else 0.0 for angle in (roll, pitch)]
    angles = [math.radians(angle) for angle in (*level, 90.0 - degrees)]
    log.headings.append(
        VesselHeading(
            stamp_ns=stamp_ns, orientation=np.array(quaternion(*angles)), frame_id='vessel'
        )
    )


def _take_target(log: _Log, away: FloatArray, name: str) -> None:
    """A target at `away` (3,), m east, north and up, from the last position of the vessel."""
    if log.place is None:
        raise BadRow('needs a position of the vessel before it', 'no position')
    place = Origin(*log.place, 0.0).geodetic(away)
    log.targets.append(_row(log.now(), *map(float, (*place[:2], away[2]))) | {'id': name})


def _fields(sentence: str) -> list[str]:
    """The fields of a sentence, its name first. Raises `BadRow`."""
    from pynmea2 import NMEASentence

    body, _, stated = sentence[1:].strip().rpartition('*')
    if NMEASentence.checksum(body) != int(stated, 16):
        raise BadRow('has another checksum than it states')
    return body.split(',')


def _take_usbl(log: _Log, sentence: str, stamp: int | None) -> None:
    """What a USBL says: ``USRTH`` the true bearing, elevation and slant range of a target,
    ``PSIMSSB`` its place ahead and to starboard, and its depth, ``PSIMSNS`` how the vessel lies,
    roll positive to starboard and pitch positive with the bow up. Raises `BadRow`."""
    log.hears = True
    head, *fields = _fields(sentence)
    if head == 'USRTH':
        log.clock = stamp or log.clock
        distance = float(fields[3])
        bearing, elevation = math.radians(float(fields[5])), math.radians(float(fields[6]))
        flat = distance * math.cos(elevation)
        up = -abs(distance * math.sin(elevation))
        away = np.array([flat * math.sin(bearing), flat * math.cos(bearing), up])
        _take_target(log, away, '')
        return
    clock = fields[0]
    if stamp is not None:
        log.clock = stamp
    elif not _CLOCK.match(clock):
        raise BadRow('has a time that cannot be read as HHMMSS', 'unreadable time')
    else:
        time = Time.fromisoformat(f'{clock[:2]}:{clock[2:4]}:{clock[4:6]}')
        _tell_time(log, time.replace(microsecond=int(clock[7:13].ljust(6, '0'))))
    if head == 'PSIMSNS':
        roll, pitch, _, heading = (float(field or 'nan') for field in fields[4:8])
        _take_heading(log, heading, roll, -pitch)
        return
    _, name, status, _, system, orientation, _, *numbers = fields
    if status != 'A':
        raise BadRow('is flagged as invalid', 'flagged invalid')
    if (system, orientation) != ('C', 'H'):
        raise BadRow(
            f'has the coordinates {system}, {orientation}; C, H (metres to starboard and ahead) '
            'are read',
            'other coordinates',
        )
    bow = math.radians(log.bow())
    starboard, ahead, depth = (float(number) for number in numbers[:3])
    sine, cosine = math.sin(bow), math.cos(bow)
    away = np.array([ahead * sine + starboard * cosine, ahead * cosine - starboard * sine, -depth])
    _take_target(log, away, name)


def _take_ais(log: _Log, message: Any, stamp: int | None, own: bool) -> None:
    if not hasattr(message, 'lat') or message.msg_type not in (1, 2, 3, 18, 19, 27):
        log.unread[f'AIS {message.msg_type}'] += 1
        return
    if stamp is not None:
        log.clock = stamp
    stamp_ns, second = log.now(), getattr(message, 'second', 60)
    if second < 60:
        stamp_ns -= (stamp_ns - int(second) * SECOND + HALF_MINUTE) % (60 * SECOND) - HALF_MINUTE
    latitude, longitude = float(message.lat), float(message.lon)
    if latitude > 90.0 or longitude > 180.0:
        raise BadRow('says that it has no position', 'no position')
    if own:
        log.unread['AIS reports of the own ship (VDO)'] += 1
        return
    more = {'std': str(ACCURATE if message.accuracy else INACCURATE), 'id': str(message.mmsi)}
    log.targets.append(_row(stamp_ns, latitude, longitude) | more)


def _row(stamp_ns: int, latitude: float, longitude: float, height: float = 0.0) -> dict[str, str]:
    return {
        'stamp': f'{stamp_ns // SECOND}.{stamp_ns % SECOND:09d}',
        'latitude': repr(latitude),
        'longitude': repr(longitude),
        'height': repr(height),
    }
