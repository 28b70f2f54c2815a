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
"""Files of sonars and folders of pictures: XTF, raw files of the EK80, KMALL, .all, PNG, JPEG.

Libraries of others read the binary formats, each in a process of its own (see `foreign`), ping by
ping, so that the length of a file does not matter. Magnitudes become ``/detections`` of the
obstacle tracker, samples with a phase ``/snapshot`` of the bathymetry tracker, soundings
``/ground``, and where the ship was ``/nav``, in metres from the first position.

A ping whose clock is off for itself is left out; a clock that was set is followed, and said.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import math
from pathlib import Path
from typing import Any, NamedTuple

from attrs import define, evolve
import numpy as np

from msg_adapters.detections import SOUND_SPEEDS, write_detections
from msg_adapters.navigation import write_navigation, write_range
from msg_adapters.snapshots import write_snapshot
from msg_adapters.soundings import write_ground
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import quaternion
from sonar_imm.acoustics.rays import profile_problem
from sonar_imm.measurements import (
    Altitude,
    Ground,
    Navigation,
    Rejection,
    Snapshot,
    SonarImage,
)
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig

from ... import SECOND
from ..conversion import ConversionReport, provenance
from ..convert_options import Ek80Options, KongsbergOptions, PicturesOptions, XtfOptions
from ..csv_table import BadRow, CsvTable, Row
from ..foreign import read_apart, Record
from ..messages import ros_message
from ..sources import BagError
from ..writer import BagWriter
from .images import SYSTEM

JUMP = 3600 * SECOND
"""A clock that goes further than this from one ping to the next is off, or was set."""
LATEST = 2**31 * SECOND
LOOKS = {'starboard': -90.0, 'port': 90.0}
"""Where side scan looks, degrees to port of ahead."""
ABEAM: dict[str, Any] = {'horizontal_fov_deg': 3.0, 'vertical_fov_deg': 80.0}
"""Parameters of the obstacle tracker for the narrow, high beam of a side scan."""
HALVES: dict[int, Sequence[Sequence[int]]] = {4: ((0, 3), (1, 2)), 3: ((0,), (1,))}
"""The sectors of a split beam that make its starboard and its port half, by their number."""
EXTRAS = {'xtf': 'xtf', 'ek80': 'echosounders', 'kmall': 'echosounders', 'all': 'echosounders'}
WANTED = {'xtf': 'pyxtf', 'echosounders': 'themachinethatgoesping'}


class Message(NamedTuple):
    """A message to be written."""

    topic: str
    content: Any


def convert_xtf(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert the side scan of an XTF file: echoes to ``/detections``, and where a side has a
    channel of phases to ``/port/snapshot`` and ``/starboard/snapshot``.

    values: as in `XtfOptions`. Needs pyxtf. Raises `BagError`, `ConfigError`.
    """
    how = XtfOptions(**values)
    config = DetectorConfig.from_mapping(how.parameters)
    report = ConversionReport(Path(out))
    mount = {**ABEAM, 'sonar_mount_rpy_deg': [0.0, 0.0, LOOKS[how.side]]}
    phases = False

    def messages(ping: Record) -> Iterator[Message]:
        nonlocal phases
        sides = _sides(ping, how.port_samples)
        if not sides:
            raise Rejection('no_side_scan', 'it has no channel of side scan')
        if (image := _image(ping, sides.get(how.side, []), how.frame_id)) is not None:
            mount['max_range'] = max(mount.get('max_range', 1.0), float(image.range[-1]))
            found = detect(image, config)
            # An image of one beam cannot show how wide it is.
            wide = np.full(len(found), np.radians(config.beam_width_deg) ** 2 / 12.0)
            found = evolve(found, var_bearing=wide, extent_bearing=np.full(len(found), np.nan))
            yield Message('/detections', write_detections(found, ros_message))
        for side, channels in sides.items():
            if (snapshot := _interferometer(ping, side, channels, how)) is not None:
                phases = True
                yield Message(f'/{side}/snapshot', write_snapshot(snapshot, ros_message))

    _write(Path(path), 'xtf', report, how, messages, {SYSTEM: mount})
    other = next(side for side in LOOKS if side != how.side)
    report.notes['side'] = f'echoes of {how.side}; those of the other by --side {other}'
    report.notes['samples'] = (
        'amplitudes and phases' if phases else 'magnitude only: no channel is called a phase'
    )
    return report


def convert_ek80(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert the complex samples, or the power and angles, of a split-beam echo sounder to
    ``/snapshot``.

    values: as in `Ek80Options`. Needs themachinethatgoesping. Raises `BagError`.
    """
    how = Ek80Options(**values)
    if _start(path)[4:8] == b'CON0':
        raise BagError(
            f'{path} is of an EK60 or ES60, which the reader of the EK80 does not know; '
            'docs/reference/formats.md shows how echopype makes an archive of it for '
            'sonar-imm convert snapshots'
        )
    report = ConversionReport(Path(out))
    others: set[str] = set()
    chosen = ''

    def messages(ping: Record) -> Iterator[Message]:
        nonlocal chosen
        if how.channel not in ping['channel'] or chosen not in ('', ping['channel']):
            others.add(ping['channel'])
            return
        if ping['iq'] is None and (ping['power'] is None or ping['angle'] is None):
            raise Rejection('power_only', 'it holds power alone, which says no direction')
        chosen = ping['channel']
        snapshot = _split_beam(ping, how)
        yield Message('/snapshot', write_snapshot(snapshot, ros_message))

    _write(Path(path), 'ek80', report, how, messages)
    report.notes['channel'] = chosen
    if others:
        report.notes['other channels'] = ', '.join(sorted(others))
    return report


def convert_kongsberg(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert the soundings of a KMALL or .all file to ``/ground``, beside ``/nav``.

    values: as in `KongsbergOptions`. Needs themachinethatgoesping. Raises `BagError`.
    """
    how = KongsbergOptions(**values)
    report = ConversionReport(Path(out))

    def messages(ping: Record) -> Iterator[Message]:
        nav = ping['nav']
        if ping['soundings'] is None or nav is None:
            raise Rejection('no_soundings', 'it has no soundings, or no position')
        # Of a file that is cut off, the library makes soundings at the ship itself.
        found = ping['soundings']
        found = found[np.isfinite(found).all(axis=1) & found.any(axis=1)]
        if not len(found):
            raise Rejection('no_soundings', 'none of its soundings is valid')
        # Soundings are level: they turn with the heading alone.
        heading = math.radians(ping['heading'])
        s, c = math.sin(heading), math.cos(heading)
        offset = np.column_stack(
            [s * found[:, 0] + c * found[:, 1], c * found[:, 0] - s * found[:, 1], -found[:, 2]]
        )
        ground = Ground(
            stamp_ns=ping['stamp_ns'],
            position=nav.position + offset,
            variance=np.zeros(len(found)),
            frame_id=nav.frame_id,
        )
        yield Message('/ground', write_ground(ground, ros_message))

    reader = 'kmall' if _start(path)[4:5] == b'#' else 'all'
    profiles: dict[str, dict[str, Any]] = {'bathymetry': {}}
    _write(Path(path), reader, report, how, messages, profiles)
    if 'sound_speed_profile' in profiles['bathymetry']:
        report.notes['sound speed'] = (
            'the last profile is in parameters.yaml beside the bag, for --params of other bags'
        )
    return report


def _start(path: str | Path) -> bytes:
    try:
        with Path(path).open('rb') as file:
            return file.read(8)
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None


def convert_pictures(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert a folder of PNG and JPEG, with a CSV of their stamps, to ``/detections``.

    values: as in `PicturesOptions`. Needs Pillow. Raises `BagError`, `ConfigError`.
    """
    how = PicturesOptions(**values)
    config = DetectorConfig.from_mapping(how.parameters)
    folder, report = Path(path), ConversionReport(Path(out))
    table = CsvTable(_table_of(folder, how.table), how.options)
    table.require('stamp', 'file')

    def rows() -> Iterator[Record]:
        for row, record in report.read_rows(table, lambda row: _picture_row(row, how)):
            yield {**record, 'where': f'line {row.line}'}

    def messages(record: Record) -> Iterator[Message]:
        image = _picture(folder, record, how.frame_id)
        yield Message('/detections', write_detections(detect(image, config), ros_message))

    _write_all(folder, rows(), report, how, messages)
    return report


@define
class _Frame:
    """Metres from the first position. missing: pings without a position."""

    frame_id: str = 'map'
    origin: Origin | None = None
    missing: int = 0
    last_ns: int = -1

    def navigation(self, record: Record) -> Navigation | None:
        """Where the ship was at a ping; None where the file does not say."""
        east, north = (float(value) for value in record['place'])
        geodetic = record['units'] == 'degrees'
        known = all(map(math.isfinite, (east, north, record['heading'])))
        on_earth = abs(east) <= 180.0 and abs(north) <= 90.0 and (east or north)
        if not (known and record['units'] and (on_earth or not geodetic)):
            self.missing += 1
            return None
        if geodetic:
            self.origin = self.origin or Origin(north, east)
            east, north = self.origin.local(north, east)[:2].tolist()
        depth, pitch, roll = (
            value if math.isfinite(value) else 0.0
            for value in (record['depth'], record['pitch'], record['roll'])
        )
        return Navigation(
            stamp_ns=record['stamp_ns'],
            position=[east, north, -depth],
            orientation=_orientation(record['heading'], pitch, roll),
            frame_id=self.frame_id,
        )

    def notes(self) -> dict[str, str]:
        if self.origin is None:
            return {}
        place = self.origin
        return {'origin': f'latitude {place.latitude!r}, longitude {place.longitude!r}'}


def _orientation(heading: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w, ENU from FLU, of degrees: from north to the east, bow up, starboard
    down."""
    return quaternion(math.radians(roll), math.radians(-pitch), math.radians(90.0 - heading))


def _write(
    path: Path,
    reader: str,
    report: ConversionReport,
    how: Any,
    messages: Any,
    parameters: dict[str, dict[str, Any]] | None = None,
) -> None:
    """Write what a reader of binary files gives."""
    try:
        records = _named(read_apart(reader, path), path, report, parameters)
        _write_all(path, records, report, how, messages, parameters)
    except ImportError:
        extra = EXTRAS[reader]
        raise BagError(
            f"{path.name} needs {WANTED[extra]}: pip install 'sonar_imm[{extra}]'"
        ) from None


def _named(
    records: Iterable[Record],
    path: Path,
    report: ConversionReport,
    parameters: dict[str, dict[str, Any]] | None,
) -> Iterator[Record]:
    """Pings with the word for their place; what is wrong with the file goes to the report, a
    profile of sound speed to the parameters of the bathymetry tracker."""
    for record in records:
        if record['kind'] == 'problem':
            report.problems.append(f'{path.name}: {record["text"]}; what came before it is kept')
        elif record['kind'] == 'profile':
            if problem := profile_problem(record['values']):
                report.problems.append(f'{path.name}: a profile of sound speed {problem}')
            elif parameters is not None:
                parameters['bathymetry']['sound_speed_profile'] = record['values']
        else:
            report.rows += 1
            yield {**record, 'where': f'ping {report.rows}'}


def _write_all(
    path: Path,
    records: Iterator[Record],
    report: ConversionReport,
    how: Any,
    messages: Any,
    parameters: dict[str, dict[str, Any]] | None = None,
) -> None:
    """Write the messages of each record and where the ship was. Raises `BagError` when there is
    none."""
    frame = _Frame()
    notes = provenance(path.name, report.notes)
    with BagWriter(
        report.path, storage=how.storage, custom_data=notes, parameters=parameters
    ) as bag:

        def write(topic: str, content: Any, stamp_ns: int) -> None:
            bag.write(topic, content, stamp_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1

        for record in _in_time(records, path, report):
            stamp_ns = record['stamp_ns']
            try:
                nav = frame.navigation(record)
                made = list(messages({**record, 'nav': nav}))
            except (Rejection, BadRow) as error:
                report.bad_row(path, record['where'], error)
                continue
            if made and nav is not None and stamp_ns != frame.last_ns:
                frame.last_ns = stamp_ns
                write('/nav', write_navigation(nav, ros_message), stamp_ns)
                _write_altitude(record, write)
            for message in made:
                write(message.topic, message.content, stamp_ns)
        if not set(report.messages) - {'/nav', '/altitude'}:
            first = f' (the first problem: {report.problems[0]})' if report.problems else ''
            raise BagError(f'{path} holds no ping that could be converted{first}')
    if frame.missing:
        report.problems.append(
            f'{path.name}: {frame.missing} pings have no position (0, 0 is none); they have no '
            'navigation'
        )
    report.notes |= frame.notes()


def _write_altitude(record: Record, write: Any) -> None:
    altitude = float(record['altitude'])
    if altitude > 0.0 and math.isfinite(altitude):
        measured = Altitude(stamp_ns=record['stamp_ns'], altitude=altitude, frame_id='sonar')
        write('/altitude', write_range(measured, ros_message), record['stamp_ns'])


def _in_time(records: Iterator[Record], path: Path, report: ConversionReport) -> Iterator[Record]:
    """The records whose clock can be believed: near that of the one before, or of the next."""
    last, held = None, None

    def lonely(record: Record) -> None:
        report.bad_row(path, record['where'], BadRow('its clock is off', 'clock off'))

    for record in records:
        stamp_ns = record['stamp_ns']
        if not 0 < stamp_ns < LATEST:
            report.bad_row(path, record['where'], BadRow('it has no time', 'no time'))
            continue
        if last is None or abs(stamp_ns - last) <= JUMP:
            if held is not None:
                lonely(held)
        elif held is not None and abs(stamp_ns - held['stamp_ns']) <= JUMP:
            report.problems.append(
                f'{path.name}, {held["where"]}: the clock jumps by '
                f'{(held["stamp_ns"] - last) / SECOND:g} s and stays there'
            )
            yield held
        else:
            if held is not None:
                lonely(held)
            held = record
            continue
        last, held = stamp_ns, None
        yield record
    if held is not None:
        lonely(held)


def _sides(ping: Record, port_samples: str) -> dict[str, list[Record]]:
    """The channels of each side, their samples from near to far."""
    found: dict[str, list[Record]] = {}
    for channel in ping['channels']:
        if channel['side'] in LOOKS and len(channel['samples']):
            samples = channel['samples']
            if channel['side'] == 'port' and port_samples == 'far':
                samples = samples[::-1]
            found.setdefault(channel['side'], []).append({**channel, 'samples': samples})
    return found


def _is_phase(channel: Record) -> bool:
    return 'phase' in channel['name'].lower()


def _ranges(channel: Record, sound_speed: float) -> np.ndarray:
    """(R,) m, middle of each sample. Raises `Rejection`."""
    far, count = float(channel['slant_range']), len(channel['samples'])
    if not (math.isfinite(far) and 0.0 < far <= 1e4):
        raise Rejection('out_of_range', f'it states a slant range of {far:g} m')
    delay = float(channel['delay'])
    near = 0.5 * sound_speed * delay if 0.0 < delay < 10.0 else 0.0
    return near + far * (np.arange(count) + 0.5) / count


def _speed(ping: Record) -> float:
    stated = float(ping['sound_speed'])
    return stated if SOUND_SPEEDS[0] <= stated <= SOUND_SPEEDS[1] else 1500.0


def _image(ping: Record, channels: list[Record], frame_id: str) -> SonarImage | None:
    """The magnitudes of one side: an image of one beam, seen from the array."""
    magnitudes = [channel for channel in channels if not _is_phase(channel)]
    if not magnitudes:
        return None
    return SonarImage(
        stamp_ns=ping['stamp_ns'],
        range=_ranges(magnitudes[0], _speed(ping)),
        bearing=np.zeros(1),
        amplitude=np.abs(magnitudes[0]['samples'].astype(np.float64))[:, None],
        frame_id=frame_id,
    )


def _interferometer(
    ping: Record, side: str, channels: list[Record], how: XtfOptions
) -> Snapshot | None:
    """Amplitudes with a phase of stave 1 against stave 0, or with one of each stave."""
    phases = [channel for channel in channels if _is_phase(channel)]
    magnitudes = [channel for channel in channels if not _is_phase(channel)]
    if not (phases and magnitudes):
        return None
    size = magnitudes[0]['samples'].astype(np.float64)
    if any(len(phase['samples']) != len(size) for phase in phases):
        raise Rejection('bad_shape', 'its phases and amplitudes are not equally many')
    turns = np.column_stack([_turns(phase['samples'], how.radians_per_count) for phase in phases])
    if len(phases) == 1:
        turns = np.column_stack([np.zeros(len(size)), turns])
    distance, speed = _ranges(magnitudes[0], _speed(ping)), _speed(ping)
    return Snapshot(
        stamp_ns=ping['stamp_ns'],
        frame_id=how.frame_id,
        range=distance,
        iq=(size[:, None] * np.exp(1j * turns)).astype(np.complex64),
        sound_speed=speed,
        frequency=float(magnitudes[0]['frequency']) or None,
        element_spacing=how.element_spacing,
        sample_rate=0.5 * speed / float(distance[1] - distance[0]) if len(size) > 1 else None,
        side=side,
    )


def _turns(samples: np.ndarray, radians_per_count: float | None) -> np.ndarray:
    if radians_per_count is None:
        whole = samples.dtype.kind in 'iu'
        radians_per_count = 2.0 * math.pi / 256**samples.dtype.itemsize if whole else 1.0
    return np.asarray(samples.astype(np.float64) * radians_per_count)


def _split_beam(ping: Record, how: Ek80Options) -> Snapshot:
    """The halves, or the chosen sums, of the sectors of a split beam."""
    interval, spacing = float(ping['sample_interval']), how.element_spacing
    if not (math.isfinite(interval) and interval > 0.0):
        raise Rejection('out_of_range', f'its samples are {interval:g} s apart')
    if ping['iq'] is None:
        iq = _of_angles(ping, how)
    else:
        sectors = ping['iq'].shape[1]
        staves = HALVES.get(sectors, ()) if how.staves is None else how.staves
        if len(staves) < 2 or any(not 0 <= k < sectors for stave in staves for k in stave):
            raise Rejection('bad_staves', f'it has {sectors} sectors; --staves says which to take')
        iq = np.stack([ping['iq'][:, list(stave)].sum(axis=1) for stave in staves], axis=1)
        if ping['chirp'] is not None:
            iq = _compressed(iq, ping['chirp'], interval)
    if spacing is None and how.staves is None and 0.0 < ping['spacing'] < 10.0:
        spacing = float(ping['spacing'])
    iq, speed = iq[1:], _speed(ping)  # the first sample lies at range 0
    return Snapshot(
        stamp_ns=ping['stamp_ns'],
        frame_id=how.frame_id,
        range=np.arange(1, 1 + len(iq)) * 0.5 * speed * interval,
        iq=iq,
        sound_speed=speed,
        frequency=float(ping['frequency']),
        element_spacing=spacing,
        sample_rate=1.0 / interval,
    )


def _of_angles(ping: Record, how: Ek80Options) -> np.ndarray:
    """(R, 2) of power and the phase of the starboard half against the port half."""
    if how.staves is not None:
        raise Rejection('bad_staves', 'it holds power and angles: there are no sectors to choose')
    if len(ping['power']) != len(ping['angle']):
        raise Rejection('bad_shape', 'its powers and angles are not equally many')
    turn = np.exp(0.5j * ping['angle'])
    size = 10.0 ** (np.asarray(ping['power'], np.float64) / 20.0)
    return np.column_stack([size * turn, size * turn.conj()])


def _compressed(iq: np.ndarray, chirp: Record, interval: float) -> np.ndarray:
    """Samples (R, N) of a chirp after the matched filter: a linear sweep with Hann edges, sent
    through the filters of the receiver (Andersen et al., 2024, Methods Ecol. Evol. 15)."""
    (low, high), duration, rate = chirp['band'], chirp['duration'], chirp['rate']
    known = all(map(math.isfinite, (low, high, duration, chirp['slope'], rate)))
    if not (known and 2.0 <= duration * rate <= 1e6 and 0.0 <= chirp['slope'] <= 0.5):
        raise Rejection('chirp', 'it is a chirp of which the file does not say how it was made')
    if (
        not abs(math.prod(step for _, step in chirp['filters']) / rate - interval)
        < 1e-3 * interval
    ):
        raise Rejection('chirp', 'it is a chirp whose filters the file does not hold')
    time = np.arange(int(duration * rate)) / rate
    replica = np.cos(2.0 * math.pi * (low + 0.5 * (high - low) / duration * time) * time)
    edges = np.hanning(round(2.0 * chirp['slope'] * duration * rate))
    rise, fall = edges[: len(edges) // 2], edges[len(edges) // 2 :]
    replica[: len(rise)] *= rise
    replica[len(replica) - len(fall) :] *= fall
    for coefficients, step in chirp['filters']:
        replica = np.convolve(replica, coefficients)[::step]
    replica /= np.sum(np.abs(replica) ** 2)
    lags = [np.correlate(stave, replica, mode='full')[len(replica) - 1 :] for stave in iq.T]
    return np.column_stack(lags)


def _table_of(folder: Path, named: Path | str | None) -> Path:
    if named is not None:
        return Path(named)
    found = sorted(folder.glob('*.csv'))
    if len(found) != 1:
        raise BagError(
            f'{folder} holds {len(found)} CSV files; name the one with the stamps by --table'
        )
    return found[0]


def _picture_row(row: Row, how: PicturesOptions) -> Record:
    """What the table says of a picture. Raises `BadRow`."""
    usual = {'near_range': how.near_range, 'far_range': how.far_range, 'fov': how.fov}
    given = {name: row.optional(name) for name in usual}
    near, far, fov = (
        (default or 0.0) if math.isnan(given[name]) else given[name]
        for name, default in usual.items()
    )
    if not (0.0 <= near < far and 0.0 < fov <= 360.0):
        raise BadRow('does not say its ranges and directions: --far-range and --fov', 'geometry')
    geodetic = row.table.has('latitude', 'longitude')
    names = ('longitude', 'latitude') if geodetic else ('x', 'y')
    return {
        'stamp_ns': row.stamp_ns(),
        'file': row.text('file'),
        'grid': (near, far, math.radians(fov)),
        'units': 'degrees' if geodetic else 'metres',
        'place': tuple(row.optional(name) for name in names),
        'heading': row.optional('heading'),
        'pitch': math.nan,
        'roll': math.nan,
        'depth': -row.height(),
        'altitude': math.nan,
    }


def _picture(folder: Path, record: Record, frame_id: str) -> SonarImage:
    """The image in a file: rows from near to far, columns from port to starboard."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise BagError("pictures need Pillow: pip install 'sonar_imm[pictures]'") from None
    path = folder / record['file']
    if folder.resolve() not in path.resolve().parents:
        raise BadRow(f"'{record['file']}' lies outside of the folder", 'no picture')
    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert('F'), np.float64)
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError) as error:
        raise BadRow(f"'{record['file']}' cannot be read: {error}", 'no picture') from None
    near, far, fov = record['grid']
    rows, beams = pixels.shape
    return SonarImage(
        stamp_ns=record['stamp_ns'],
        range=near + (far - near) * (np.arange(rows) + 0.5) / rows,
        bearing=fov * (0.5 - (np.arange(beams) + 0.5) / beams),
        amplitude=pixels,
        frame_id=frame_id,
    )
