# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracked reflectors as horizons: picks in a CSV for interpretation packages, GeoJSON, and SEG-Y.

The CSV has one line per pick, horizon after horizon, with a header: import wizards of seismic
interpretation packages ask which column is what. Two-way times count from the array where its
depth is known, else from depth 0, and belong to the water's speed of sound.

SEG-Y is the file that was converted, with picks in place of its samples and all headers as they
were, so that the picks lie over the line in any program that shows it. Each trace is zero but at
its picks, where it has the number of the horizon. In the trace header, in words that revision 1 of
SEG-Y leaves unassigned,

    bytes 233-236   the sample of the bottom, in thousandths, from 0 at the first; -1 without one
    bytes 237-240   the number of its horizon, 0 without one
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
import json
from pathlib import Path
import shutil
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.acoustics.geodesy import EARTH_RADIUS
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray

from ..convert_options import SegyOptions
from ..positions import Positions
from ..segy_lines import opened_for_change, READ_OPTIONS, read_segy, SegyLine
from ..sources import BagError
from . import CsvWriter
from .points import places_of

_COPIED = ('existence', 'is_bottom', 'multiple_probability')


@frozen(eq=False)
class Picks:
    """K picks by horizon, then time: horizon (K,) its number; record (K,) from 1 on; stamp_ns
    (K,); two_way_time (K,) s; depth and depth_std (K,) m; columns (K,) by name; longitude and
    latitude (K,) degrees, NaN where unknown; distance (K,) along the line from the first record
    that has a place, m, NaN where unknown."""

    horizon: IntArray
    record: IntArray
    stamp_ns: IntArray
    two_way_time: FloatArray
    depth: FloatArray
    depth_std: FloatArray
    columns: dict[str, FloatArray]
    longitude: FloatArray
    latitude: FloatArray
    distance: FloatArray

    def __len__(self) -> int:
        return len(self.horizon)


def picks_of(
    estimates: Sequence[Estimate], sound_speed: float, positions: Positions | None
) -> Picks:
    """The reflectors of all records, previews left out. Raises `BagError` for estimates of another
    system."""
    rows: list[tuple[tuple[int, ...], tuple[float, ...]]] = []
    stamps: list[int] = []
    for estimate in estimates:
        columns = estimate.columns()
        if 'two_way_time' not in columns:
            raise BagError('these estimates have no two_way_time: they are not of the fathometer')
        if columns['preview'][0]:
            continue
        stamps.append(estimate.stamp_ns)
        for k in np.flatnonzero(np.isfinite(columns['depth'])):
            depth, time = float(columns['depth'][k]), float(columns['two_way_time'][k])
            if not np.isfinite(time):
                time = 2.0 * depth / sound_speed
            std = float(np.sqrt(columns['cov_depth_depth'][k]))
            where = (int(columns['track_id'][k]), len(stamps), estimate.stamp_ns)
            own = (float(columns[name][k]) for name in _COPIED)
            rows.append((where, (time, depth, std, *own)))
    if not rows:
        raise BagError('there are no reflectors to export')
    rows.sort(key=lambda row: row[0])
    horizon, record, stamp_ns = np.array([where for where, _ in rows], np.int64).T
    two_way_time, depths, stds, *copied = np.array([numbers for _, numbers in rows]).T
    east = north = np.full(len(stamps), np.nan)
    if positions is not None:
        east, north = positions.at(np.array(stamps, np.int64))
    line = (column[record - 1] for column in (east, north, _along(east, north)))
    extra = dict(zip(_COPIED, copied))
    return Picks(horizon, record, stamp_ns, two_way_time, depths, stds, extra, *line)


def _along(longitude: FloatArray, latitude: FloatArray) -> FloatArray:
    """Distance (T,) from the first of the places (T,) that is known, m, NaN where one is not."""
    way, there = np.full(len(longitude), np.nan), np.flatnonzero(np.isfinite(longitude))
    turned = np.radians(np.unwrap(longitude[there], period=360.0))
    north = np.radians(latitude[there])
    # Records are short steps apart.
    east = np.diff(turned) * np.cos(0.5 * (north[1:] + north[:-1]))
    steps = EARTH_RADIUS * np.hypot(east, np.diff(north))
    way[there] = np.append(0.0, np.cumsum(steps))[: len(there)]
    return way


def write_horizons(path: Path, picks: Picks, line: str, epsg: int | None) -> None:
    """The CSV. line: its name; epsg: of the columns x and y, which are empty without it."""
    x, y = _projected(picks, epsg)
    with path.open('w', encoding='utf-8', errors='backslashreplace', newline='') as file:
        writer = CsvWriter(file)
        writer.write(
            (
                *('horizon', 'line', 'trace', 'x', 'y', 'longitude', 'latitude', 'twt_ms'),
                *('depth_m', 'depth_std_m', *_COPIED, 'time_utc', 'distance_m'),
            )
        )
        for k in range(len(picks)):
            writer.write(
                (
                    int(picks.horizon[k]),
                    line,
                    int(picks.record[k]),
                    *(_number(value[k], 2) for value in (x, y)),
                    *(_number(value[k], 7) for value in (picks.longitude, picks.latitude)),
                    f'{1e3 * picks.two_way_time[k]:.4f}',
                    f'{picks.depth[k]:.3f}',
                    f'{picks.depth_std[k]:.3f}',
                    *(_number(picks.columns[name][k], 3) for name in _COPIED),
                    utc_text(int(picks.stamp_ns[k])),
                    _number(picks.distance[k], 2),
                )
            )


def write_geojson(path: Path, picks: Picks) -> int:
    """Points along the track (RFC 7946), the third coordinate the height, minus the depth. Gives
    how many picks have no place and are left out. Raises `BagError` when all are."""
    there = np.isfinite(picks.longitude)
    if not there.any():
        raise BagError('the recording has no positions (sensor_msgs/NavSatFix), so no GeoJSON')
    features = []
    for k in np.flatnonzero(there):
        longitude, latitude, depth, std, time, distance = (
            float(column[k])
            for column in (
                *(picks.longitude, picks.latitude, picks.depth, picks.depth_std),
                *(picks.two_way_time, picks.distance),
            )
        )
        extra = {name: float(picks.columns[name][k]) for name in _COPIED}
        properties = {
            'horizon': int(picks.horizon[k]),
            'trace': int(picks.record[k]),
            'time_utc': utc_text(int(picks.stamp_ns[k])),
            'twt_ms': round(1e3 * time, 4),
            'depth_m': round(depth, 3),
            'depth_std_m': round(std, 3),
            'distance_m': round(distance, 2),
            # JSON has no NaN.
            **{name: round(v, 3) if np.isfinite(v) else None for name, v in extra.items()},
        }
        place = [round(longitude, 7), round(latitude, 7), round(-depth, 3)]
        features.append(feature('Point', place, properties))
    write_features(path, features)
    return int((~there).sum())


def _projected(picks: Picks, epsg: int | None) -> tuple[FloatArray, FloatArray]:
    """x and y (K,) in the coordinate system, NaN without one. Needs rasterio."""
    x, y = np.full(len(picks), np.nan), np.full(len(picks), np.nan)
    there = np.isfinite(picks.longitude)
    if epsg is None:
        return x, y
    if not there.any():
        raise BagError('the recording has no positions (sensor_msgs/NavSatFix) to give in x and y')
    x[there], y[there] = places_of(picks.longitude[there], picks.latitude[there], epsg)
    return x, y


def _number(value: float, digits: int) -> str:
    return f'{value:.{digits}f}' if np.isfinite(value) else ''


def feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    """A feature of GeoJSON; kind: of its geometry."""
    geometry = {'type': kind, 'coordinates': coordinates}
    return {'type': 'Feature', 'geometry': geometry, 'properties': properties}


def write_features(path: Path, features: list[dict[str, Any]], **members: Any) -> None:
    """Write GeoJSON (RFC 7946); members: of the collection, before its features."""
    content = {'type': 'FeatureCollection', **members, 'features': features}
    path.write_text(json.dumps(content, allow_nan=False) + '\n', encoding='utf-8')


def utc_text(stamp_ns: int) -> str:
    """A stamp as ISO 8601 with milliseconds."""
    seconds, rest = divmod(stamp_ns, 10**9)
    moment = datetime.fromtimestamp(seconds, timezone.utc)
    return f'{moment:%Y-%m-%dT%H:%M:%S}.{rest // 1_000_000:03d}Z'


_LARGEST = {2: 2**31 - 1, 3: 2**15 - 1, 8: 2**7 - 1, 10: 2**32 - 1, 11: 2**16 - 1, 16: 2**8 - 1}
"""By the format of the samples; other formats are floats."""


def _line_of(
    original: Path, notes: Mapping[str, str]
) -> tuple[SegyLine, FloatArray, FloatArray, int]:
    """Return the line as it was converted, depth (T,) of the first sample and depth (T,) from
    sample to sample, m, and the number of traces of a stack. notes: of the conversion."""
    try:
        how = SegyOptions(stack=int(notes['stack']), **json.loads(notes['read_as']))
    except (KeyError, ValueError, TypeError):
        raise BagError(
            'the recording does not say how it was made of SEG-Y; convert it again with '
            'sonar-imm convert segy'
        ) from None
    line = read_segy(original, **{name: getattr(how, name) for name in READ_OPTIONS})
    first = line.first_depth(how.sound_speed, how.depth_offset)
    spacing = line.spacing(how.sound_speed, how.sample_spacing)
    if not (spacing > 0.0).all() or how.stack < 1:
        raise BagError('the recording states an impossible sample spacing or stack')
    return line, first, spacing, how.stack


def write_picks(out: Path, picks: Picks, original: Path, notes: Mapping[str, str]) -> int:
    """Write `out` from the SEG-Y file `original`; notes: what its conversion kept in the bag.
    Gives how many picks lie outside of the traces. Raises `BagError`, and ModuleNotFoundError
    without segyio."""
    import segyio

    line, first, spacing, stack = _line_of(original, notes)
    rows = {stamp: k for k, stamp in enumerate(line.stamps)}
    ends = np.array([rows.get(int(stamp), -1) for stamp in picks.stamp_ns])
    if (ends < 0).any():
        raise BagError(f'{original} is not the file that was tracked: its times are others')
    T, n = line.amplitude.shape
    sample = (picks.depth - first[ends]) / spacing[ends]
    nearest = np.round(sample).astype(np.int64)
    inside = (nearest >= 0) & (nearest < n)
    grid = np.zeros((T, n), np.float32)
    bottom, number = np.full(T, -1, np.int64), np.zeros(T, np.int64)
    for k in np.flatnonzero(inside):
        traces = slice(max(0, ends[k] - stack + 1), ends[k] + 1)
        grid[traces, nearest[k]] = picks.horizon[k]
        if picks.columns['is_bottom'][k] > 0.5:
            bottom[traces] = round(1e3 * float(sample[k]))
            number[traces] = picks.horizon[k]
    shutil.copyfile(original, out)
    out.chmod(0o644)
    try:
        with opened_for_change(out) as file:
            largest = _LARGEST.get(int(file.format), 2**24)
            if picks.horizon.max() > largest:
                raise BagError(
                    f'horizons have numbers up to {picks.horizon.max()}, more than samples of '
                    f'{original} hold ({largest})'
                )
            fields = segyio.TraceField
            for trace in range(T):
                file.trace[trace] = grid[trace].astype(file.dtype)
                file.header[trace].update(
                    {
                        fields.UnassignedInt1: int(bottom[trace]),
                        fields.UnassignedInt2: int(number[trace]),
                    }
                )
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return int((~inside).sum())
