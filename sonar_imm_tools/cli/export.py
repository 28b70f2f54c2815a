# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm export``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

from sonar_imm.files import whole

from . import options as opt
from .common import print_json, say

FORMATS = ('xyz', 'las', 'laz', 'tif')
HORIZON_FORMATS = ('csv', 'geojson', 'sgy', 'segy', 'seg')
TRACK_FORMATS = ('gpx', 'kml', 'geojson', 'csv', 'parquet')


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm export out survey.laz --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.tif --cell 0.5 --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.csv', 'sonar-imm export out horizons.csv --epsg 32615',
        'sonar-imm export out picks.sgy --segy line.seg', 'sonar-imm export out tracks.gpx',
        'sonar-imm export out tracks.geojson --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out map.geojson --map --epsg 32632 --origin 500000,6000000'))
@click.argument('run', type=opt.FOLDER)
@click.argument('out', type=opt.FILE)
@opt.crs
@opt.origin
@click.option('--cell', type=opt.POSITIVE, default=1.0,
    show_default=True, help='Side of the cells of a grid, in metres.')
@click.option('--segy', 'original', type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help='horizons: the SEG-Y file that the recording was converted from.')
@click.option('--map', 'as_map', is_flag=True,
    help='obstacles: .geojson with those that are known at the end, in place of their tracks.')
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@opt.json
def command(
    run: Path, out: Path, epsg: int | None, origin: tuple[float, float, float], cell: float,
    original: Path | None, as_map: bool, overwrite: bool, as_json: bool,
) -> None:
    """Write the soundings, horizons or tracks of a RUN to OUT for charts and other programs.

    What is written follows from the ending of OUT. Soundings: .xyz (easting, northing, height and
    its standard deviation as text), .csv, .las and .laz (points with all columns), .tif (a grid
    of depth, uncertainty, label, count and what competes with the depth); they come from
    recordings with navigation. Horizons of the fathometer: .csv (picks by horizon), .geojson
    (points along the track), .sgy, .segy or .seg (the file given by --segy with picks in place
    of its samples). Where the recording has no fixes by satellite, the places of horizons come
    from its navigation, with --crs and --origin. Tracks of divers and obstacles: .gpx, .kml,
    .geojson (lines and points with uncertainty and model), .csv and .parquet; --crs and
    --origin say where they lie where the run does not.
    """
    from ..offline.run_folder import RunFolder
    from ..recordings.sources import BagError

    kind = out.suffix.lower().lstrip('.')
    every = dict.fromkeys(FORMATS + HORIZON_FORMATS + TRACK_FORMATS)
    if kind not in every:
        known = ', '.join(f'.{name}' for name in every)
        raise click.UsageError(f"'{out.name}' ends in none of {known}")
    if out.exists() and not overwrite:
        raise BagError(f'{out} is there already; choose another name or say --overwrite')
    folder = RunFolder(run)
    folder.keep_from(out)
    if original is not None and out.exists() and out.samefile(original):
        raise click.UsageError('OUT is the file given by --segy, which stays as it is')
    asked = _Asked(run, folder, folder.read_run(), out, kind, epsg, origin)
    if as_map:
        result, text = _export_map(asked)
    elif kind == 'csv' and folder.soundings():
        result, text = _export_soundings(asked, cell)
    elif kind in TRACK_FORMATS and asked.record['system'] != 'fathometer':
        result, text = _export_tracks(asked)
    elif kind in HORIZON_FORMATS + TRACK_FORMATS:
        result, text = _export_horizons(asked, original)
    else:
        result, text = _export_soundings(asked, cell)
    print_json({'out': str(out), **result}) if as_json else say(f'{out}: {text}')
# fmt: on


class _Asked(NamedTuple):
    """What is to be exported; record: the run.json of the run."""

    run: Path
    folder: Any
    record: dict[str, Any]
    out: Path
    kind: str
    epsg: int | None
    origin: tuple[float, float, float]


Told = tuple[dict[str, Any], str]
"""What was written, as JSON and in words."""


def _export_soundings(asked: _Asked, cell: float) -> Told:
    from ..offline.run_folder import RUN
    from ..recordings.export import points as export
    from ..recordings.sources import BagError
    from ..survey.chart import chart_of, OF_ONE_RUN, write_geotiff
    from ..survey.line import budget_of, unstated, without_far

    if (place := asked.folder.soundings()) is None:
        raise BagError(
            f'{asked.run} holds no soundings: the recording has no navigation, or is of another '
            'system'
        )
    own = export.origin_of(asked.record, asked.run)
    whole_run = export.read_points(place).placed(own, asked.epsg, asked.origin)
    points = without_far(whole_run)
    result: dict[str, Any] = {'soundings': len(points)}
    shape = ''
    with whole(asked.out) as unfinished:
        if asked.kind == 'tif':
            chart = chart_of(points, cell, *budget_of(asked.record))
            write_geotiff(unfinished, chart, asked.epsg, OF_ONE_RUN)
            result |= dict(zip(('rows', 'columns'), chart.shape))
            shape = f' in {result["rows"]} by {result["columns"]} cells'
            if missing := unstated(asked.record):
                result['assumed'] = missing
                shape += f'; {RUN} does not state {", ".join(missing)}: default values'
        elif asked.kind == 'xyz':
            export.write_xyz(unfinished, points)
        elif asked.kind == 'csv':
            export.write_table(unfinished, points)
        else:
            export.write_las(unfinished, points, asked.epsg)
    if far := len(whole_run) - len(points):
        result['far'] = far
        shape += f'; {far} far away left out: no ship that sees the others can have seen them'
    return result, f'{len(points)} soundings{shape}'


def _export_map(asked: _Asked) -> Told:
    """The obstacles that are known at the end of a run."""
    from ..recordings.export.tracks import write_obstacles
    from ..recordings.sources import BagError

    if asked.kind != 'geojson':
        raise click.UsageError('--map writes .geojson')
    landmarks = asked.record.get('landmarks', [])
    if not landmarks:
        raise BagError(f'{asked.run} knows no obstacles at its end')
    if asked.epsg is None:
        why = 'places are in metres: say with --epsg and --origin where their origin lies'
        raise click.UsageError(why)
    try:
        with whole(asked.out) as unfinished:
            write_obstacles(unfinished, landmarks, asked.epsg, asked.origin)
    except (KeyError, TypeError, ValueError):
        why = f"'landmarks' in the run.json of {asked.run} cannot be understood"
        raise BagError(why) from None
    return {'obstacles': len(landmarks)}, f'{len(landmarks)} obstacles'


def _to_degrees(asked: _Asked) -> Callable[[Any], Any] | None:
    """Longitude and latitude (n,) of places (n, 2 or 3) in metres; None where nobody says it."""
    if asked.epsg is None:
        return None
    import numpy as np

    from ..recordings.export.points import degrees_of

    epsg, shift = asked.epsg, np.array(asked.origin[:2])
    return lambda places: degrees_of(places[:, :2] + shift, epsg)


def _export_tracks(asked: _Asked) -> Told:
    from ..evaluation.numbers import counted
    from ..recordings.export.points import origin_of
    from ..recordings.export.tracks import tracks_of, write_tracks
    from ..recordings.sources import names_of_targets, TARGET_NAMES

    degrees = _to_degrees(asked)
    if degrees is None and (own := origin_of(asked.record, asked.run)) is not None:
        degrees = own.degrees
    names = names_of_targets(asked.record.get(TARGET_NAMES))
    tracks = tracks_of(asked.folder.read_estimates(), degrees, names)
    with whole(asked.out) as unfinished:
        left_out = write_tracks(unfinished, tracks, asked.kind, asked.run.name)
    count = sum(1 for _ in tracks.each())
    left = f', {left_out} left out that have no place on Earth' if left_out else ''
    result = {'rows': len(tracks), 'left_out': left_out, 'tracks': count}
    return result, f'{counted(count, "track")}, {counted(len(tracks), "row")}{left}'


def _export_horizons(asked: _Asked, original: Path | None) -> Told:
    from ..recordings.export.horizons import picks_of, write_geojson, write_horizons, write_picks
    from ..recordings.positions import navigation_topics, read_navigated, read_positions
    from ..recordings.reader import BagReader
    from ..recordings.sources import BagError

    run, record, out, kind = asked.run, asked.record, asked.out, asked.kind
    if record['system'] != 'fathometer':
        raise BagError(f'{run} is of {record["system"]}: only the fathometer has horizons')
    if kind not in HORIZON_FORMATS:
        raise BagError(f'{run} is of the fathometer: .{kind} is for tracks')
    segy = kind in ('sgy', 'segy', 'seg')
    if segy and original is None:
        why = 'SEG-Y needs --segy, the file that the recording was converted from'
        raise click.UsageError(why)
    positions, notes, degrees = None, {}, _to_degrees(asked)
    if Path(record['bag']).exists():
        with BagReader(record['bag']) as bag:
            positions, notes = read_positions(bag), bag.custom_data
            if positions is None and degrees is not None:
                positions = read_navigated(bag, degrees)
            elif positions is None and kind == 'geojson' and navigation_topics(bag):
                raise BagError(
                    'the recording has navigation in metres: say with --epsg and --origin where '
                    'its origin lies'
                )
    elif segy or kind == 'geojson':
        raise BagError(f'{record["bag"]}, the recording of {run}, is gone')
    speed = record['parameters'].get('sound_speed', 1500.0)
    if isinstance(speed, bool) or not isinstance(speed, (int, float)) or not 0.0 < speed < 1e5:
        raise BagError(f'the sound_speed in the run.json of {run} is no speed')
    picks = picks_of(asked.folder.read_estimates(), float(speed), positions)
    left_out = 0
    with whole(out) as unfinished:
        if kind == 'csv':
            write_horizons(unfinished, picks, notes.get('source', run.name), asked.epsg)
        elif kind == 'geojson':
            left_out = write_geojson(unfinished, picks)
        elif original is not None:
            left_out = write_picks(unfinished, picks, original, notes)
    count = len(set(picks.horizon.tolist()))
    left = f', {left_out} left out' if left_out else ''
    result = {'picks': len(picks), 'left_out': left_out, 'horizons': count}
    return result, f'{len(picks)} picks of {count} horizons{left}'
