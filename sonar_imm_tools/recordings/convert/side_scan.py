# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Pictures of the water as detections: XTF of a side scan, folders of PNG and JPEG.

Each ping of a side scan is an image of one beam abeam. Where a side has channels of phases too,
it is an interferometer and becomes ``/snapshot``.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
import math
from pathlib import Path
from typing import Any

from attrs import define, evolve, Factory
import numpy as np

from msg_adapters.detections import write_detections
from msg_adapters.snapshots import write_snapshot
from sonar_imm.measurements import MAX_IMAGE_CELLS, Rejection, Snapshot, SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig

from ..conversion import ConversionReport, converter
from ..convert_options import PicturesOptions, XtfOptions
from ..csv_table import CsvTable
from ..messages import ros_message
from ..places import Degrees
from ..sources import BagError
from ..tables import Row
from ..times import BadRow
from ..xtf import pings_in
from .bag_images import SYSTEM
from .navigation import ground_message, Message, Record, speed_of, write_records

LOOKS = {'starboard': -90.0, 'port': 90.0}
"""Where side scan looks, degrees to port of ahead."""
MOST_CLIPPED = 0.01
"""Of the samples, at full scale, before it is said."""
LEAST_FULL_SCALE = 127
ABEAM: dict[str, Any] = {'horizontal_fov_deg': 3.0, 'vertical_fov_deg': 80.0}
"""Parameters of the obstacle tracker for the narrow, high beam of a side scan."""


@converter(XtfOptions)
def convert_xtf(path: Path, how: XtfOptions, report: ConversionReport) -> None:
    """Convert the side scan of an XTF file: echoes to ``/detections``, and where a side has a
    channel of phases to ``/port/snapshot`` and ``/starboard/snapshot``. Processed soundings of a
    multibeam become ``/ground``.
    """
    config = DetectorConfig.from_mapping(how.parameters)
    mount = {**ABEAM, 'sonar_mount_rpy_deg': [0.0, 0.0, LOOKS[how.side]]}
    phases, seen = False, _Seen(how)

    def messages(ping: Record) -> Iterator[Message]:
        nonlocal phases
        seen.ping(ping)
        if ping['soundings'] is not None:
            yield _ground(ping)
            return
        sides = _sides(ping, how.port_samples)
        if not sides:
            raise Rejection('no_side_scan', 'it has no channel of side scan')
        if how.side not in sides and not any(map(_is_phase, chain(*sides.values()))):
            (other,) = sides
            raise Rejection('other_side', f'it has channels of {other} alone: --side {other}')
        if (image := _image(ping, sides.get(how.side, []), how)) is not None:
            mount['max_range'] = max(mount.get('max_range', 1.0), float(image.range[-1]))
            found = detect(image, config)
            # An image of one beam cannot show how wide it is.
            wide = np.full(len(found), np.radians(config.beam_width_deg) ** 2 / 12.0)
            seen.image(image, sides[how.side], len(found))
            found = evolve(found, var_bearing=wide, extent_bearing=np.full(len(found), np.nan))
            yield Message('/detections', write_detections(found, ros_message))
        for side, channels in sides.items():
            if (snapshot := _interferometer(ping, side, channels, how)) is not None:
                phases = True
                yield Message(f'/{side}/snapshot', write_snapshot(snapshot, ros_message))

    pings = pings_in(path, report, how.units)
    write_records(path, pings, report, how, messages, {SYSTEM: mount})
    seen.tell(path, report)
    if set(report.messages) <= {'/nav', '/altitude', '/ground'}:
        return
    other = next(side for side in LOOKS if side != how.side)
    report.notes['side'] = f'echoes of {how.side}; those of the other by --side {other}'
    report.notes['samples'] = (
        'amplitudes and phases' if phases else 'magnitude only: no channel is called a phase'
    )


@define
class _Seen:
    """What of a file of side scan has to be said at its end."""

    how: XtfOptions
    pings: int = 0
    headings: int = 0
    layback: float = 0.0
    images: int = 0
    echoes: int = 0
    samples: int = 0
    clipped: int = 0
    top: int = 0
    """The highest sample."""
    frequencies: set[float] = Factory(set)

    def ping(self, ping: Record) -> None:
        self.pings += 1
        self.headings += ping['heading'] != 0.0
        self.layback = max(self.layback, ping['layback'])

    def image(self, image: SonarImage, channels: list[Record], echoes: int) -> None:
        """Count the echoes and samples of an image. channels: of its side."""
        self.images += 1
        self.echoes += echoes
        magnitudes = _magnitudes(channels, self.how)
        self.frequencies |= {float(channel['frequency']) for channel in magnitudes}
        samples = magnitudes[0]['samples']
        if samples.dtype.kind in 'iu':
            self.samples += len(samples)
            if (top := int(samples.max())) > self.top:
                self.top, self.clipped = top, 0
            # Of a converter of 8, 12 or 15 bits the highest value is all ones, too.
            if self.top >= LEAST_FULL_SCALE and not self.top & (self.top + 1):
                self.clipped += int((samples == self.top).sum())

    def tell(self, path: Path, report: ConversionReport) -> None:
        if self.images and not self.echoes:
            report.questions.append(
                f'{path.name}: no echo was found in {self.images} pings of {self.how.side}; is '
                'the other --side meant, or another threshold (--set threshold_margin_db=-3.0)?'
            )
        if self.pings and not self.headings and '/nav' in report.messages:
            report.questions.append(
                f'{path.name}: the heading is 0 in all {self.pings} pings; does the file hold '
                'one? Echoes lie to the east and west of the line now'
            )
        if self.layback > 0.0:
            report.questions.append(
                f'{path.name}: the places are those of the ship, and the sonar is up to '
                f'{self.layback:g} m behind them (layback), which is not taken off'
            )
        if self.clipped > MOST_CLIPPED * self.samples:
            report.questions.append(
                f'{path.name}: {self.clipped / self.samples:.1%} of the samples are at full '
                'scale: was the gain too high?'
            )
        if len(self.frequencies) > 1:
            listed = ', '.join(f'{frequency:g}' for frequency in sorted(self.frequencies))
            report.notes['frequencies'] = f'{listed} Hz; --frequency HZ chooses one'


@converter(PicturesOptions)
def convert_pictures(path: Path, how: PicturesOptions, report: ConversionReport) -> None:
    """Convert a folder of PNG and JPEG, with a CSV of their stamps, to ``/detections``."""
    config = DetectorConfig.from_mapping(how.parameters)
    table = CsvTable(_table_of(path, how.table), how.options)
    table.require('stamp', 'file')
    degrees = Degrees(table) if table.has('latitude', 'longitude') else None

    def rows() -> Iterator[Record]:
        for row, record in report.read_rows(table, lambda row: _picture_row(row, degrees, how)):
            yield {**record, 'where': f'line {row.line}'}

    def messages(record: Record) -> Iterator[Message]:
        image = _picture(path, record, how.frame_id)
        yield Message('/detections', write_detections(detect(image, config), ros_message))

    write_records(path, rows(), report, how, messages)


def _ground(ping: Record) -> Message:
    """The soundings of a ping of a multibeam. Raises `Rejection`."""
    found = ping['soundings']
    found = found[np.isfinite(found).all(axis=1) & (found[:, 2] != 0.0)]
    if not len(found):
        raise Rejection('no_soundings', 'none of its soundings is valid')
    below = 0.0 if ping['nav'] is None else ping['nav'].position[2]
    return ground_message(ping, np.column_stack([found[:, :2], -found[:, 2] - below]))


def _sides(ping: Record, port_samples: str) -> dict[str, list[Record]]:
    """The channels of each side, their samples from near to far."""
    found: dict[str, list[Record]] = {}
    for channel in ping['channels']:
        if channel['side'] in LOOKS and len(channel['samples']):
            samples = channel['samples']
            if len(samples) > MAX_IMAGE_CELLS:  # before each takes eight bytes and more
                raise Rejection('too_large', f'a channel has {len(samples)} samples')
            if channel['side'] == 'port' and port_samples == 'far':
                samples = samples[::-1]
            found.setdefault(channel['side'], []).append({**channel, 'samples': samples})
    return found


def _magnitudes(channels: list[Record], how: XtfOptions) -> list[Record]:
    """The channels of magnitudes of a side, first the one that is used."""
    found = [channel for channel in channels if not _is_phase(channel)]
    if (wanted := how.frequency) is not None:
        found.sort(key=lambda channel: abs(channel['frequency'] - wanted))
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


def _image(ping: Record, channels: list[Record], how: XtfOptions) -> SonarImage | None:
    """The magnitudes of one side: an image of one beam, seen from the array."""
    magnitudes = _magnitudes(channels, how)
    if not magnitudes:
        return None
    return SonarImage(
        stamp_ns=ping['stamp_ns'],
        range=_ranges(magnitudes[0], speed_of(ping)),
        bearing=np.zeros(1),
        amplitude=np.abs(magnitudes[0]['samples'].astype(np.float64))[:, None],
        frame_id=how.frame_id,
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
    distance, speed = _ranges(magnitudes[0], speed_of(ping)), speed_of(ping)
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


def _table_of(folder: Path, named: Path | str | None) -> Path:
    if named is not None:
        return Path(named)
    found = sorted(folder.glob('*.csv'))
    if len(found) != 1:
        raise BagError(
            f'{folder} holds {len(found)} CSV files; name the one with the stamps by --table'
        )
    return found[0]


def _picture_row(row: Row, degrees: Degrees | None, how: PicturesOptions) -> Record:
    """What the table says of a picture. Raises `BadRow`."""
    usual = {'near_range': how.near_range, 'far_range': how.far_range, 'fov': how.fov}
    given = {name: row.optional(name) for name in usual}
    near, far, fov = (
        (default or 0.0) if math.isnan(given[name]) else given[name]
        for name, default in usual.items()
    )
    if not (0.0 <= near < far and 0.0 < fov <= 360.0):
        raise BadRow('does not say its ranges and directions: --far-range and --fov', 'geometry')
    place = row.optional('x'), row.optional('y')
    if degrees is not None:
        place = (math.nan, math.nan)
        if not row.empty('latitude', 'longitude'):
            place = degrees.unchecked(row)[::-1]
    return {
        'stamp_ns': row.stamp_ns(),
        'file': row.text('file'),
        'grid': (near, far, math.radians(fov)),
        'units': 'metres' if degrees is None else 'degrees',
        'place': place,
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
        # By these names alone: other formats are read by programs that Pillow starts.
        with Image.open(path, formats=('PNG', 'JPEG')) as picture:
            if picture.width * picture.height > MAX_IMAGE_CELLS:
                raise BadRow(f"'{record['file']}' has too many pixels", 'no picture')
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
