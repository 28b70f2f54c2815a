# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two lines that cross: the horizons of both at the place where they do, compared.

Where two profiler lines cross, each saw the same floor at another time and on another course, with
nothing in common but the instrument. The difference of a horizon's depths, divided by what both
runs state of its error, is the only independent judgement that such data allow.

The tracks are straight between positions, in metres around the first of them. At each crossing a
horizon counts that was found within `AT` metres of it, or two `position_std` where they are more,
and within `REACH` metres often enough for a slope; its depth is that of the nearest record, moved
along the slope. Its variance is that of the record, or the scatter of its records about the slope
where this is more. A place that is wrong counts by the slope in every direction, which the slopes
along both lines give together, and for both lines. Horizons are matched by least total distance,
none further apart than the larger `min_separation` of both runs.

Not judged is what is cut: a horizon at the first or last depth that is tracked lies there or
beyond, and below a floor that is cut nobody can tell multiples from horizons. The others are also
judged after the shift that is common to all of a crossing (another depth of the instrument, of the
water, another speed of sound near the surface), and together they say how far lines differ by
more than is stated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sonar_imm.acoustics.geodesy import EARTH_RADIUS
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.fathometer.tracker import FathometerConfig

from ...offline.run_folder import RunFolder
from ...recordings.positions import read_positions
from ...recordings.reader import BagReader
from ...recordings.sources import BagError
from ..plotting import COLOURS, Picture
from .figures import responses

AT, REACH, LEAST = 5.0, 25.0, 5


class Line(NamedTuple):
    """A tracked line: its records in order of time that have a place; east and north (T,) m;
    separation: `min_separation` of the run, m; first and last depth that is tracked, and the step
    of depths, m."""

    name: str
    records: tuple[Estimate, ...]
    longitude: FloatArray
    latitude: FloatArray
    separation: float
    first: float
    last: float
    step: float


class Horizon(NamedTuple):
    """A horizon at a crossing: depth and std m, slope in m per m along the line; cut: it lies at
    the end of the depths that are tracked."""

    track_id: int
    depth: float
    std: float
    slope: float
    is_bottom: float
    multiple: float
    cut: bool


def crossing_metrics(a: RunFolder, b: RunFolder, position_std: float) -> dict[str, Any]:
    """The crossings of two runs of the fathometer as plain values. Raises `BagError`."""
    lines = _line(a), _line(b)
    origin = float(lines[0].longitude[0]), float(lines[0].latitude[0])
    tracks = [_plane(line, origin) for line in lines]
    crossings = []

    def between(values: FloatArray, row: int, share: float) -> float:
        return float(values[row] + share * (values[row + 1] - values[row]))

    for i, j, s, t, directions in _meetings(*tracks):
        found = [
            _horizons(line, track, row + share, position_std)
            for line, track, row, share in zip(lines, tracks, (i, j), (s, t))
        ]
        limit = max(line.separation for line in lines)
        sine, cosine = np.linalg.det(directions), directions[0] @ directions[1]
        crossings.append(
            {
                'stamp_a_ns': lines[0].records[i].stamp_ns,
                'stamp_b_ns': lines[1].records[j].stamp_ns,
                'longitude': between(lines[0].longitude, i, s),
                'latitude': between(lines[0].latitude, i, s),
                'angle_deg': float(np.degrees(np.arctan2(abs(sine), abs(cosine)))),
                **compared(found[0], found[1], limit, directions, position_std),
            }
        )
    matched = [pair for crossing in crossings for pair in crossing['horizons']]
    return {
        'line_a': lines[0].name,
        'line_b': lines[1].name,
        'position_std_m': position_std,
        'crossings': crossings,
        'matched': len(matched),
        **summary([pair for pair in matched if pair['judged']]),
    }


def summary(judged: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Numbers of horizons that are judged. between_lines_m: standard deviation that, added to what
    is stated, makes their mean square 1 (Paule and Mandel); 0 where none is missing."""
    sigmas, difference, std = _columns(judged, 'sigmas', 'difference_m', 'std_m')
    return {
        'judged': len(judged),
        'rms_difference_m': _rms(difference),
        'rms_sigmas': _rms(sigmas),
        'inside_2_sigmas': float(np.mean(np.abs(sigmas) <= 2.0)) if len(sigmas) else float('nan'),
        'between_lines_m': _missing(difference, std) if len(judged) else float('nan'),
    }


def _missing(difference: FloatArray, std: FloatArray) -> float:
    from scipy.optimize import brentq

    def excess(missing: float) -> float:
        return float(np.mean(difference**2 / (std**2 + missing**2))) - 1.0

    # With all of the differences for it, nothing is left.
    return float(brentq(excess, 0.0, _rms(difference))) if excess(0.0) > 0.0 else 0.0


def crossing_lines(metrics: Mapping[str, Any]) -> list[str]:
    """What `crossing_metrics` found, as sentences."""
    if not metrics['crossings']:
        return [f'{metrics["line_a"]} and {metrics["line_b"]} do not cross']
    lines = []
    for crossing in metrics['crossings']:
        lines.append(
            f'crossing at {crossing["latitude"]:.6f}, {crossing["longitude"]:.6f} under '
            f'{crossing["angle_deg"]:.0f} deg: {len(crossing["horizons"])} horizons matched, '
            f'{crossing["only_a"]} and {crossing["only_b"]} seen by one line only'
        )
        for h in crossing['horizons']:
            depths = f'{h["depth_a_m"]:8.2f} m and {h["depth_b_m"]:8.2f} m'
            marks = {'bottom': h['bottom'], 'multiple': h['multiple'], 'cut': h['cut']}
            lines.append(
                f'  {depths}: {h["difference_m"]:+.2f} m = {h["sigmas"]:+.1f} stated sigma of '
                f'{h["std_m"]:.2f} m' + ''.join(f', {name}' for name, has in marks.items() if has)
            )
        if crossing['floor_cut']:
            lines.append(
                '  not judged: the floor lies at the first depth that is tracked, or above it, so '
                'that what is below may be multiples of it'
            )
        if 'shift_m' in crossing:
            lines.append(
                '  common shift {shift_m:+.2f} m +- {shift_std_m:.2f} m; after it '
                '{residual_rms_m:.2f} m rms, {residual_rms_sigmas:.1f} stated sigmas rms'.format(
                    **crossing
                )
            )
    if metrics['judged']:
        lines.append(
            f'{metrics["judged"]} horizons: {metrics["rms_difference_m"]:.2f} m rms, '
            f'{metrics["rms_sigmas"]:.1f} stated sigmas rms, '
            f'{100.0 * metrics["inside_2_sigmas"]:.0f} % within two'
        )
        if metrics['between_lines_m'] > 0.0:
            lines.append(f'lines differ by {metrics["between_lines_m"]:.2f} m more than is stated')
    return lines


def mistie_figure(metrics: Mapping[str, Any]) -> Picture:
    """The difference of each horizon that both lines have, from above, with two stated standard
    deviations; filled where it is judged. metrics: of `crossing_metrics`."""
    figure = Picture()
    for number, crossing in enumerate(metrics['crossings'], start=1):
        for judged in (True, False):
            shown = [h for h in crossing['horizons'] if h['judged'] == judged]
            if not shown:
                continue
            what = ['floor' if h['bottom'] else 'multiple' if h['multiple'] else '' for h in shown]
            depths = [0.5 * (h['depth_a_m'] + h['depth_b_m']) for h in shown]
            colour = COLOURS[(number - 1) % len(COLOURS)]
            symbol = 'circle' if judged else 'circle-open'
            figure.add_scatter(
                x=[h['difference_m'] for h in shown],
                y=[f'{kind} {depth:.1f} m ({number})' for kind, depth in zip(what, depths)],
                error_x={'array': [2.0 * h['std_m'] for h in shown], 'color': colour},
                mode='markers',
                marker={'color': colour, 'size': 9, 'symbol': symbol},
                name=f'crossing {number}' + ('' if judged else ', not judged'),
            )
    figure.add_vline(x=0.0, line_width=1)
    rows = sum(len(crossing['horizons']) for crossing in metrics['crossings'])
    title = f'{metrics["line_a"]} minus {metrics["line_b"]} [m], with two standard deviations'
    down = {'type': 'category', 'autorange': 'reversed'}
    return figure.styled(160 + 34 * rows, {'title': title}, down)


def _line(folder: RunFolder) -> Line:
    run = folder.read_run()
    if run['system'] != 'fathometer':
        raise BagError(f'{folder.path} is a run of {run["system"]}, not of the fathometer')
    if not Path(run['bag']).exists():
        raise BagError(f'{run["bag"]}, the recording of {folder.path}, is gone; it has the places')
    with BagReader(run['bag']) as bag:
        positions = read_positions(bag)
    if positions is None:
        raise BagError(f'{run["bag"]} has no positions (sensor_msgs/NavSatFix)')
    records = [record for record in folder.read_estimates() if not record.columns()['preview'][0]]
    stamps = np.array([record.stamp_ns for record in records], np.int64)
    east, north = positions.at(stamps)
    there = np.isfinite(east)
    if there.sum() < 2:
        raise BagError(f'{folder.path}: fewer than two records have a place')
    kept = tuple(record for record, good in zip(records, there) if good)
    config = FathometerConfig.from_mapping(run['parameters'], ignore_unknown=True)
    if (first := next(responses(run), None)) is None:
        raise BagError(f'{run["bag"]} holds no record of the fathometer')
    depth = first.depth.tolist()
    of_depths = config.min_separation, depth[0], depth[-1], depth[1] - depth[0]
    return Line(folder.path.name, kept, east[there], north[there], *of_depths)


def _plane(line: Line, origin: tuple[float, float]) -> FloatArray:
    """East and north (T, 2) of the origin in metres: lines are short against the Earth."""
    turned = (line.longitude - origin[0] + 180.0) % 360.0 - 180.0
    east = np.radians(turned) * EARTH_RADIUS * np.cos(np.radians(origin[1]))
    return np.column_stack([east, np.radians(line.latitude - origin[1]) * EARTH_RADIUS])


def _meetings(a: FloatArray, b: FloatArray) -> list[tuple[int, int, float, float, FloatArray]]:
    """Where the polygons a (T, 2) and b (U, 2) cross: segment of each, the share of it that is
    passed, and their directions (2, 2), unit vectors."""
    found = []
    u, v = np.diff(a, axis=0), np.diff(b, axis=0)
    for i in range(len(u)):
        apart = b[:-1] - a[i]
        across = u[i, 0] * v[:, 1] - u[i, 1] * v[:, 0]
        with np.errstate(divide='ignore', invalid='ignore'):
            s = (apart[:, 0] * v[:, 1] - apart[:, 1] * v[:, 0]) / across
            t = (apart[:, 0] * u[i, 1] - apart[:, 1] * u[i, 0]) / across
        # Half-open, so that a crossing at a position counts once.
        for j in np.flatnonzero((s >= 0.0) & (s < 1.0) & (t >= 0.0) & (t < 1.0)):
            directions = np.array([u[i], v[j]])
            directions /= np.hypot(*directions.T)[:, None]
            found.append((i, int(j), float(s[j]), float(t[j]), directions))
    return found


def _horizons(line: Line, track: FloatArray, at: float, position_std: float) -> list[Horizon]:
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(track, axis=0).T)))
    here = float(np.interp(at, np.arange(len(way)), way))
    names = ('depth', 'cov_depth_depth', 'is_bottom', 'multiple_probability')
    seen: dict[int, list[tuple[float, ...]]] = {}
    for k in np.flatnonzero(np.abs(way - here) <= REACH):
        columns = line.records[k].columns()
        for row in np.flatnonzero(np.isfinite(columns['depth'])):
            values = (float(columns[name][row]) for name in names)
            rows = seen.setdefault(int(columns['track_id'][row]), [])
            rows.append((float(way[k]) - here, *values))
    horizons = []
    for track_id, rows in seen.items():
        ahead, depth, variance, bottom, multiple = (np.array(column) for column in zip(*rows))
        near = int(np.argmin(np.abs(ahead)))
        # Of two records side by side the slope is noise, and without one the error of a place
        # says nothing.
        if len(rows) < LEAST or np.ptp(ahead) <= 0.5 * REACH:
            continue
        if abs(ahead[near]) > max(AT, 2.0 * position_std):
            continue
        spread = ahead - ahead.mean()
        slope = float(spread @ depth / (spread @ spread))
        left = depth - depth.mean() - slope * spread
        scatter = float(left @ left / (len(rows) - 2))
        std = float(np.sqrt(max(variance[near], scatter)))
        place = float(depth[near] - slope * ahead[near])
        within = min(depth[near] - line.first, line.last - depth[near])
        kind = float(bottom[near]), float(multiple[near]), bool(within <= line.step)
        horizons.append(Horizon(track_id, place, std, slope, *kind))
    return sorted(horizons, key=lambda horizon: horizon.depth)


def compared(
    a: Sequence[Horizon],
    b: Sequence[Horizon],
    limit: float,
    directions: FloatArray,
    position_std: float,
) -> dict[str, Any]:
    """The horizons of two lines where they cross, those in pairs that are less than `limit` m
    apart; directions (2, 2): unit vectors along both lines."""
    from scipy.optimize import linear_sum_assignment

    depth_a, depth_b = np.array([h.depth for h in a]), np.array([h.depth for h in b])
    distance = np.abs(depth_a.reshape(-1, 1) - depth_b.reshape(1, -1))
    rows, columns = linear_sum_assignment(np.minimum(distance, limit))
    pairs = [(a[i], b[j]) for i, j in zip(rows, columns) if distance[i, j] < limit]
    # What is uppermost and cut may be the floor, or lie below it.
    uppermost = [min(line, key=lambda h: h.depth) for line in (a, b) if len(line)]
    floor_cut = any(h.cut for h in uppermost)
    horizons = []
    for first, second in pairs:
        # Lines that are nearly parallel say nothing of the slope across them.
        slopes = np.array([first.slope, second.slope])
        gradient = np.linalg.lstsq(directions, slopes, rcond=0.3)[0]
        place = np.sqrt(2.0) * position_std * np.hypot(*gradient)
        std = float(np.sqrt(first.std**2 + second.std**2 + place**2))
        cut = first.cut or second.cut
        horizons.append(
            {
                'track_id_a': first.track_id,
                'track_id_b': second.track_id,
                'depth_a_m': first.depth,
                'depth_b_m': second.depth,
                'difference_m': first.depth - second.depth,
                'std_m': std,
                'sigmas': (first.depth - second.depth) / std,
                'bottom': first.is_bottom > 0.5 and second.is_bottom > 0.5,
                'multiple': max(first.multiple, second.multiple) > 0.5,
                'cut': cut,
                'judged': not (cut or floor_cut),
            }
        )
    return {
        'horizons': horizons,
        'only_a': len(a) - len(pairs),
        'only_b': len(b) - len(pairs),
        'floor_cut': floor_cut,
        **common_shift([pair for pair in horizons if pair['judged']]),
    }


def common_shift(judged: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The shift of line a against line b that horizons have in common, weighted by what they
    state, its standard deviation, and what it leaves; nothing for fewer than two."""
    if len(judged) < 2:
        return {}
    difference, std = _columns(judged, 'difference_m', 'std_m')
    weight = std**-2
    shift = float(weight @ difference / weight.sum())
    left = difference - shift
    # One number of them went into the shift.
    free = len(left) - 1
    return {
        'shift_m': shift,
        'shift_std_m': float(weight.sum() ** -0.5),
        'residual_rms_m': float(np.sqrt(left @ left / free)),
        'residual_rms_sigmas': float(np.sqrt(weight @ left**2 / free)),
    }


def _columns(pairs: Sequence[Mapping[str, Any]], *keys: str) -> tuple[FloatArray, ...]:
    return tuple(np.array([pair[key] for pair in pairs], np.float64) for key in keys)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float('nan')
