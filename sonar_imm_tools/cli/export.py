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

"""``sonar-imm export``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.files import whole

from .common import example, json_option, place_options, print_json, say

FORMATS = ('xyz', 'las', 'laz', 'tif')
HORIZON_FORMATS = ('csv', 'geojson', 'sgy', 'segy', 'seg')
TRACK_FORMATS = ('gpx', 'kml', 'geojson', 'csv', 'parquet')


@click.command(
    epilog=example(
        'sonar-imm export out survey.laz --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.tif --cell 0.5 --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.xyz',
        'sonar-imm export out horizons.csv --epsg 32615',
        'sonar-imm export out picks.sgy --segy line.seg',
        'sonar-imm export out tracks.gpx',
        'sonar-imm export out tracks.geojson --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out map.geojson --map --epsg 32632 --origin 500000,6000000',
    )
)
@click.argument('run', type=click.Path(path_type=Path, file_okay=False))
@click.argument('out', type=click.Path(path_type=Path, dir_okay=False))
@place_options
@click.option(
    '--cell',
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help='Side of the cells of a grid, in metres.',
)
@click.option(
    '--segy',
    'original',
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help='horizons: the SEG-Y file that the recording was converted from.',
)
@click.option(
    '--map',
    'as_map',
    is_flag=True,
    help='obstacles: .geojson with those that are known at the end, in place of their tracks.',
)
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@json_option
def command(
    run: Path,
    out: Path,
    epsg: int | None,
    origin: tuple[float, float, float],
    cell: float,
    original: Path | None,
    as_map: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the soundings, horizons or tracks of a RUN to OUT for charts and other programs.

    What is written follows from the ending of OUT. Soundings: .xyz (easting, northing, height and
    its standard deviation as text), .las and .laz (points with all columns), .tif (a grid of
    depth, uncertainty, label, count and what competes with the depth); they come from recordings
    with navigation. Horizons of the fathometer: .csv (picks by horizon), .geojson (points along
    the track), .sgy, .segy or .seg (the file given by --segy with picks in place of its samples).
    Where the recording has no fixes by satellite, the places of horizons come from its navigation,
    with --crs and --origin. Tracks of divers and obstacles: .gpx, .kml, .geojson (lines and points
    with uncertainty and model), .csv and .parquet; --crs and --origin say where they lie where the
    run does not.
    """
    from ..offline.run_folder import RunFolder, SOUNDINGS
    from ..recordings.export.points import read_points, write_las, write_xyz
    from ..recordings.sources import BagError
    from ..survey.chart import chart_of, OF_ONE_RUN, write_geotiff
    from ..survey.line import budget_of

    kind = out.suffix.lower().lstrip('.')
    every = dict.fromkeys(FORMATS + HORIZON_FORMATS + TRACK_FORMATS)
    if kind not in every:
        known = ', '.join(f'.{name}' for name in every)
        raise click.UsageError(f"'{out.name}' ends in none of {known}")
    if out.exists() and not overwrite:
        raise BagError(f'{out} is there already; choose another name or say --overwrite')
    record = RunFolder(run).read_run()
    if as_map:
        _export_map(run, record, out, kind, epsg, origin, as_json)
        return
    if kind in TRACK_FORMATS and record['system'] != 'fathometer':
        _export_tracks(run, out, kind, epsg, origin, as_json)
        return
    if kind in HORIZON_FORMATS + TRACK_FORMATS:
        _export_horizons(run, record, out, kind, epsg, origin, original, as_json)
        return
    if not (run / SOUNDINGS).is_file():
        raise BagError(
            f'{run} holds no soundings: the recording has no navigation, or is of another system'
        )
    points = read_points(run / SOUNDINGS)
    points = points.moved(origin)
    result: dict[str, Any] = {'out': str(out), 'soundings': len(points)}
    with whole(out) as unfinished:
        if kind == 'tif':
            chart = chart_of(points, cell, *budget_of(record))
            write_geotiff(unfinished, chart, epsg, OF_ONE_RUN)
            result |= dict(zip(('rows', 'columns'), chart.shape))
        elif kind == 'xyz':
            write_xyz(unfinished, points)
        else:
            write_las(unfinished, points, epsg)
    if as_json:
        print_json(result)
        return
    shape = f' in {result["rows"]} by {result["columns"]} cells' if 'rows' in result else ''
    say(f'{out}: {len(points)} soundings{shape}')


def _export_map(
    run: Path,
    record: dict[str, Any],
    out: Path,
    kind: str,
    epsg: int | None,
    origin: tuple[float, float, float],
    as_json: bool,
) -> None:
    """The obstacles that are known at the end of a run; record: its run.json."""
    from ..recordings.export.tracks import write_obstacles
    from ..recordings.sources import BagError

    if kind != 'geojson':
        raise click.UsageError('--map writes .geojson')
    landmarks = record.get('landmarks', [])
    if not landmarks:
        raise BagError(f'{run} knows no obstacles at its end')
    if epsg is None:
        raise click.UsageError(
            'places are in metres: say with --epsg and --origin where their origin lies'
        )
    with whole(out) as unfinished:
        write_obstacles(unfinished, landmarks, epsg, origin)
    if as_json:
        print_json({'out': str(out), 'obstacles': len(landmarks)})
        return
    say(f'{out}: {len(landmarks)} obstacles')


def _to_degrees(epsg: int, origin: tuple[float, float, float]) -> Callable[[Any], Any]:
    """Longitude and latitude (n,) of places (n, 2) in metres from `origin`."""
    import numpy as np

    from ..recordings.export.points import degrees_of

    return lambda places: degrees_of(places + np.array(origin[:2]), epsg)


def _export_tracks(
    run: Path,
    out: Path,
    kind: str,
    epsg: int | None,
    origin: tuple[float, float, float],
    as_json: bool,
) -> None:
    """Tracks of a run of divers or obstacles."""
    from ..offline.run_folder import RunFolder
    from ..recordings.export.tracks import tracks_of, write_tracks

    degrees = None if epsg is None else _to_degrees(epsg, origin)
    folder = RunFolder(run)
    record = folder.read_run()
    if degrees is None and (stated := record.get('origin')):
        degrees = Origin(**stated).degrees
    tracks = tracks_of(folder.read_estimates(), degrees)
    with whole(out) as unfinished:
        left_out = write_tracks(unfinished, tracks, kind, run.name)
    result = {'out': str(out), 'rows': len(tracks), 'left_out': left_out}
    result['tracks'] = sum(1 for _ in tracks.each())
    if as_json:
        print_json(result)
        return
    left = f', {left_out} left out that have no place on Earth' if left_out else ''
    say(f'{out}: {result["tracks"]} tracks, {len(tracks)} rows{left}')


def _export_horizons(
    run: Path,
    record: dict[str, Any],
    out: Path,
    kind: str,
    epsg: int | None,
    origin: tuple[float, float, float],
    original: Path | None,
    as_json: bool,
) -> None:
    """Picks of a run of the fathometer; record: its run.json."""

    from ..offline.run_folder import RunFolder
    from ..recordings.export.horizons import picks_of, write_geojson, write_horizons
    from ..recordings.export.picks import write_picks
    from ..recordings.positions import navigation_topics, read_navigated, read_positions
    from ..recordings.reader import BagReader
    from ..recordings.sources import BagError

    if record['system'] != 'fathometer':
        raise BagError(f'{run} is of {record["system"]}: only the fathometer has horizons')
    if kind not in HORIZON_FORMATS:
        raise BagError(f'{run} is of the fathometer: .{kind} is for tracks')
    segy = kind in ('sgy', 'segy', 'seg')
    if segy and original is None:
        raise click.UsageError(
            'SEG-Y needs --segy, the file that the recording was converted from'
        )
    if segy and original is not None and out.exists() and out.samefile(original):
        raise click.UsageError('OUT is the file given by --segy, which stays as it is')
    positions, notes = None, {}
    if Path(record['bag']).exists():
        with BagReader(record['bag']) as bag:
            positions, notes = read_positions(bag), bag.custom_data
            if positions is None and epsg is not None:
                positions = read_navigated(bag, _to_degrees(epsg, origin))
            elif positions is None and kind == 'geojson' and navigation_topics(bag):
                raise BagError(
                    'the recording has navigation in metres: say with --epsg and --origin where '
                    'its origin lies'
                )
    elif segy or kind == 'geojson':
        raise BagError(f'{record["bag"]}, the recording of {run}, is gone')
    speed = float(record['parameters'].get('sound_speed', 1500.0))
    picks = picks_of(RunFolder(run).read_estimates(), speed, positions)
    result: dict[str, Any] = {'out': str(out), 'picks': len(picks), 'left_out': 0}
    result['horizons'] = len(set(picks.horizon.tolist()))
    with whole(out) as unfinished:
        if kind == 'csv':
            write_horizons(unfinished, picks, notes.get('source', run.name), epsg)
        elif kind == 'geojson':
            result['left_out'] = write_geojson(unfinished, picks)
        elif original is not None:
            result['left_out'] = write_picks(unfinished, picks, original, notes)
    if as_json:
        print_json(result)
        return
    left = f', {result["left_out"]} left out' if result['left_out'] else ''
    say(f'{out}: {result["picks"]} picks of {result["horizons"]} horizons{left}')
