# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Soundings as points: the table of a run or its recording, plain XYZ, LAS and LAZ.

LAS keeps whole numbers times a scale: a millimetre here, from an offset at the first sounding, so
that 32 bits reach 2000 km. What LAS has no field for becomes an extra dimension of the same name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
from pathlib import Path
from typing import Any

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from msg_adapters.soundings import read_soundings
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import PLACES
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.measurements import Rejection
from sonar_imm.soundings import COLUMNS, LATER

from ..reader import BagReader
from ..sources import BagError, is_recording
from ..times import GPS_EPOCH, gps_minus_utc
from . import CsvWriter

Pair = tuple[FloatArray, FloatArray]
TOPIC = 'soundings'
"""Name of the topic of soundings in a recording, behind its namespace."""
SCALE = 0.001
"""Metres of one count in a LAS file."""
_LAS_EXTRAS = (
    'vertical_uncertainty', 'horizontal_uncertainty', 'beam_angle', 'label_probability', 'range',
    'surface', 'existence',
)  # fmt: skip


@frozen(eq=False)
class Points:
    """All soundings of a run: stamp_ns (n,), columns (n,) by name as in `soundings.COLUMNS`, but
    x y z in float64 in place of px py pz."""

    stamp_ns: IntArray
    columns: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def __getitem__(self, name: str) -> FloatArray:
        return self.columns[name]

    def moved(self, origin: tuple[float, float, float]) -> Points:
        """The same with `origin` (3,), the map coordinates of the local frame, added to x y z."""
        places = {name: self[name] + shift for name, shift in zip('xyz', origin)}
        return Points(self.stamp_ns, {**self.columns, **places})

    def placed(
        self,
        own: Origin | None,
        epsg: int | None,
        origin: tuple[float, float, float],
        frame: Origin | None = None,
    ) -> Points:
        """The same in a coordinate system, or in metres from `frame` without one.

        own: where the frame of the soundings lies on Earth; where that is not known, or map
        coordinates of its `origin` (3,) are stated, these are added. z is a height everywhere, and
        stays. Raises `BagError`. Needs rasterio with `epsg`.
        """
        if any(origin) or own is None:
            return self.moved(origin)
        if not epsg and frame in (None, own):
            return self
        longitude, latitude = own.degrees(np.column_stack([self['x'], self['y']]))
        if epsg:
            x, y = places_of(longitude, latitude, epsg)
        else:
            assert frame is not None
            x, y = frame.local(latitude, longitude, frame.height)[:2]
        return Points(self.stamp_ns, {**self.columns, 'x': x, 'y': y})


def origin_of(record: Mapping[str, Any] | None, name: object) -> Origin | None:
    """Return where the frame of a run lies on Earth; None where its run.json does not state it.
    Raises `BagError` with the `name` of the run."""
    if record is None or not record.get('origin'):
        return None
    try:
        return Origin(**{key: float(value) for key, value in record['origin'].items()})
    except (AttributeError, TypeError, ValueError, OverflowError):
        sentence = f"'origin' in the run.json of {name} cannot be understood"
        raise BagError(sentence) from None


def read_points(path: Path) -> Points:
    """The soundings of a soundings.csv or soundings.parquet, which needs pyarrow, or of a
    recording of `~/soundings`. Raises `BagError` for what is none."""
    if is_recording(path):
        return _read_recording(path)
    if path.suffix == '.parquet':
        table = read_parquet(path)
        header = _checked_header(path, table.column_names)
        try:
            stamps = table['stamp_ns'].to_numpy().astype(np.int64)
            columns = {name: table[name].to_numpy().astype(np.float64) for name in header}
        except (ValueError, TypeError, OverflowError, RuntimeError):  # as pyarrow has them too
            raise BagError(f'{path} has a column that is not numbers throughout') from None
        return _exact(stamps, columns)
    try:
        with path.open(encoding='utf-8', newline='') as file:
            reader = csv.reader(file)
            names = next(reader, [])
            header = _checked_header(path, names)
            rows = list(reader)
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise BagError(f'{path} is no CSV: {error}') from None
    try:
        stamps = np.array([int(row[names.index('stamp_ns')]) for row in rows], np.int64)
        columns = {n: np.array([float(row[names.index(n)]) for row in rows]) for n in header}
    except (ValueError, IndexError, OverflowError):
        raise BagError(f'{path} has a row that is not numbers throughout') from None
    return _exact(stamps, columns)


def _checked_header(path: Path, names: Sequence[str]) -> list[str]:
    """The columns of soundings that a table has. Raises `BagError` where one that it needs is
    missing."""
    wanted = ['stamp_ns', *(name for name in COLUMNS if name not in (*PLACES, *LATER))]
    if missing := [name for name in wanted if name not in names]:
        raise BagError(f'{path} has no column {" and ".join(missing)}')
    return [name for name in COLUMNS if name in names]


def read_parquet(path: Path) -> Any:
    """The table of a Parquet file, as pyarrow has it. Raises `BagError` for what is none."""
    import pyarrow
    import pyarrow.parquet

    try:
        with path.open('rb') as file:  # the library names only files whose names are UTF-8
            return pyarrow.parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        sentence = ' '.join(str(error).split())
        raise BagError(f'{path} cannot be read: {sentence}') from None


def topics_of_soundings(reader: BagReader) -> list[str]:
    """The topics of an open recording that hold soundings, by name and type."""
    return [
        topic.name
        for topic in reader.topics
        if topic.name.rpartition('/')[2] == TOPIC and topic.type_name.endswith('/PointCloud2')
    ]


def _read_recording(path: Path) -> Points:
    with BagReader(path) as reader:
        topics = topics_of_soundings(reader)
        if len(topics) != 1:
            named = f'the topics {" and ".join(topics)}' if topics else f'no topic {TOPIC}'
            raise BagError(f'{path} has {named}; a line is one')
        try:
            pings = [read_soundings(item.message) for item in reader.messages(topics)]
        except Rejection as rejection:
            raise BagError(f'{path}, topic {topics[0]}: {rejection}') from None
        recorded = sum(topic.count for topic in reader.topics if topic.name in topics)
        if len(pings) < recorded:
            raise BagError(f'{path}: only {len(pings)} of {recorded} messages can be read')
    if not pings:
        raise BagError(f'{path} has no soundings')
    stamps = np.repeat([ping.stamp_ns for ping in pings], [len(ping) for ping in pings])
    columns = {
        name: np.concatenate([ping.columns[name] for ping in pings]).astype(np.float64)
        for name in COLUMNS
    }
    return _exact(stamps.astype(np.int64), columns)


def _exact(stamps: IntArray, columns: dict[str, FloatArray]) -> Points:
    for name, exact in zip('xyz', PLACES):
        columns[name] = columns.pop(exact, columns[name])  # older tables have the coarse ones only
    for name, value in LATER.items():
        columns.setdefault(name, np.full(len(stamps), float(value)))
    return Points(stamps, columns)


def write_table(path: Path, points: Points) -> None:
    """Points as a soundings.csv, their places exact in px py pz and coarse in x y z."""
    exact = dict(zip(PLACES, 'xyz'))
    names = list(COLUMNS)
    values: list[NDArray] = [points[exact.get(name, name)].astype(COLUMNS[name]) for name in names]
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = CsvWriter(file)
        writer.write(['stamp_ns', *names])
        writer.write_columns([points.stamp_ns, *values])


def write_xyz(path: Path, points: Points) -> None:
    """One line per sounding: easting, northing, height and vertical standard deviation, in m."""
    deviation = np.sqrt(points['vertical_uncertainty'])
    with path.open('w', encoding='ascii') as file:
        for x, y, z, s in zip(points['x'], points['y'], points['z'], deviation):
            file.write(f'{x:.3f} {y:.3f} {z:.3f} {s:.3f}\n')


def write_las(path: Path, points: Points, epsg: int | None) -> None:
    """LAS 1.4, compressed where the name ends in ``.laz``.

    The intensity counts hundredths of a decibel above the weakest sounding. The class is 40,
    bathymetric bottom; the label is in the user data, the side in the point source. Needs laspy,
    and lazrs for ``.laz``.
    """
    import laspy
    from laspy.header import GpsTimeType
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(point_format=6, version='1.4')
    header.scales = np.full(3, SCALE)
    first = np.array([points[name][0] if len(points) else 0.0 for name in 'xyz'])
    header.offsets = np.round(first)
    header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32) for name in _LAS_EXTRAS])
    if epsg is not None:
        # As text, as LAS 1.4 wants it.
        header.vlrs.append(WktCoordinateSystemVlr(wkt_of(epsg)))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points[name] for name in 'xyz')
    weakest = points['intensity'].min() if len(points) else 0.0
    las.intensity = np.clip(np.round(100.0 * (points['intensity'] - weakest)), 0, 65535).astype(
        np.uint16
    )
    las.classification = np.full(len(points), 40, np.uint8)
    las.user_data = points['label'].astype(np.uint8)
    las.point_source_id = points['side'].astype(np.uint16)
    seconds = points.stamp_ns.astype(np.float64) * 1e-9
    # Adjusted standard GPS time, which the flag says.
    las.gps_time = seconds + gps_minus_utc(seconds) - GPS_EPOCH - 1e9
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD
    las.return_number = las.number_of_returns = np.ones(len(points), np.uint8)
    for name in _LAS_EXTRAS:
        las[name] = points[name].astype(np.float32)
    las.write(str(path))


def wkt_of(epsg: int) -> str:
    """A coordinate system by its EPSG number as text. Raises `BagError`. Needs rasterio."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return str(CRS.from_epsg(epsg).to_wkt())
    except CRSError:
        raise BagError(f'there is no coordinate system with the EPSG number {epsg}') from None


def places_of(longitude: FloatArray, latitude: FloatArray, epsg: int) -> Pair:
    """x and y (n,) in a coordinate system of degrees (n,). Raises `BagError`. Needs rasterio."""
    return _transformed('EPSG:4326', wkt_of(epsg), longitude, latitude)


def degrees_of(places: FloatArray, epsg: int) -> Pair:
    """Longitude and latitude (n,) of places (n, 2) in a coordinate system. Raises `BagError`.
    Needs rasterio."""
    return _transformed(wkt_of(epsg), 'EPSG:4326', places[:, 0], places[:, 1])


def _transformed(here: str, there: str, x: FloatArray, y: FloatArray) -> Pair:
    from rasterio.warp import transform

    first, second = transform(here, there, x.tolist(), y.tolist())
    return np.array(first), np.array(second)
