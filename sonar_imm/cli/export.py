"""``sonar-imm export``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .common import example, json_option, print_json, say

FORMATS = ('xyz', 'las', 'laz', 'tif')


def _numbers(
    _ctx: click.Context, _param: click.Parameter, value: str
) -> tuple[float, float, float]:
    try:
        numbers = tuple(float(part) for part in value.split(','))
    except ValueError:
        numbers = ()
    if len(numbers) not in (2, 3):
        raise click.BadParameter(f"'{value}' is not of the form X,Y or X,Y,Z")
    x, y, z = (*numbers, 0.0)[:3]
    return x, y, z


@click.command(
    epilog=example(
        'sonar-imm export out survey.laz --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.tif --cell 0.5 --epsg 32632 --origin 500000,6000000',
        'sonar-imm export out survey.xyz',
    )
)
@click.argument('run', type=click.Path(path_type=Path, file_okay=False))
@click.argument('out', type=click.Path(path_type=Path, dir_okay=False))
@click.option('--epsg', type=click.IntRange(min=1), help='Coordinate system, by its EPSG number.')
@click.option(
    '--origin',
    default='0,0',
    callback=_numbers,
    metavar='X,Y[,Z]',
    help='Coordinates in that system of the origin of the navigation.',
)
@click.option(
    '--cell',
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help='Side of the cells of a grid, in metres.',
)
@click.option('--overwrite', is_flag=True, help='Replace OUT.')
@json_option
def command(
    run: Path,
    out: Path,
    epsg: int | None,
    origin: tuple[float, float, float],
    cell: float,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the soundings of a tracked RUN to OUT for charts and other programs.

    What is written follows from the ending of OUT: .xyz (easting, northing, height and its
    standard deviation as text), .las and .laz (points with all columns), .tif (a grid of depth,
    uncertainty, label and count). Soundings come from recordings with navigation.
    """
    from ..evaluation.run_folder import RunFolder, SOUNDINGS
    from ..recordings.export.grid import grid_of, write_geotiff
    from ..recordings.export.points import read_points, write_las, write_xyz
    from ..recordings.sources import BagError

    kind = out.suffix.lower().lstrip('.')
    if kind not in FORMATS:
        raise click.UsageError(
            f"'{out.name}' ends in none of {', '.join(f'.{name}' for name in FORMATS)}"
        )
    if out.exists() and not overwrite:
        raise BagError(f'{out} is there already; choose another name or say --overwrite')
    RunFolder(run).read_run()
    if not (run / SOUNDINGS).is_file():
        raise BagError(
            f'{run} holds no soundings: the recording has no navigation, or is of another system'
        )
    points = read_points(run / SOUNDINGS)
    points = points.moved(origin)
    result: dict[str, Any] = {'out': str(out), 'soundings': len(points)}
    if kind == 'tif':
        grid = grid_of(points, cell)
        write_geotiff(out, grid, epsg)
        result |= {'rows': grid.height.shape[0], 'columns': grid.height.shape[1]}
    elif kind == 'xyz':
        write_xyz(out, points)
    else:
        write_las(out, points, epsg)
    if as_json:
        print_json(result)
        return
    shape = f' in {result["rows"]} by {result["columns"]} cells' if 'rows' in result else ''
    say(f'{out}: {len(points)} soundings{shape}')
