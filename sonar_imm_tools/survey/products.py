# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The files of a survey: charts, provenance, coverage, adjustment, crossings, and their page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import json
import math
import os
from pathlib import Path
import shutil
from typing import Any

from attrs import asdict, fields
import numpy as np
import plotly.offline

from sonar_imm import __version__
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.files import hindrance, mark, MARKER, remove_leftovers, replaced, whole
from sonar_imm.parameters import ConfigError
from sonar_imm.texts import visible

from ..evaluation.plotting import COLOURS, Picture
from ..evaluation.report import rendered
from ..offline.run_folder import REPORT
from ..recordings.export import CsvWriter
from ..recordings.sources import BagError
from .adjustment import described, Mistie
from .chart import BANDS, Chart, values_of, write_geotiff
from .grid import Nodes
from .jobs import kept, Options, TILE, Tile, write_json
from .making import extent_of, SURVEY, Survey, WORK

CHART, TILES, PROVENANCE, COVERAGE, ADJUSTMENT, CROSSINGS = (
    'survey.tif',
    'tiles',
    'provenance.parquet',
    'coverage.geojson',
    'adjustment.json',
    'crossings.csv',
)
KIND = 'survey'
"""What the marker of a survey says."""
OPTIONS = 'options.json'
OWN = (WORK, TILES, SURVEY, CHART, PROVENANCE, COVERAGE, ADJUSTMENT, CROSSINGS, REPORT, MARKER)
"""All that belongs to a survey."""
OF_A_SURVEY = (*BANDS, 'cell')
"""Bands of survey.tif and of the tiles."""


@contextlib.contextmanager
def folder_of(
    out: Path, options: Options, runs: Path, *, resume: bool = False, overwrite: bool = False
) -> Iterator[Path]:
    """Yield the folder to make a survey of `runs` in: `out` itself, or, where an earlier survey is
    replaced, a new one that takes its place at the end. Where nothing was there and the survey
    cannot be made, nothing stays.

    Raises `BagError` when something is there and neither `resume` nor `overwrite` is said, when
    nothing shows that this package made it, or when it was made with other options.
    """
    remove_leftovers(out)
    wanted = json.loads(json.dumps(asdict(options)))
    if out.exists() and not out.is_dir():
        raise BagError(f'{out} is a file; a folder is needed')
    if out.is_dir() and out.samefile(runs):
        raise BagError(f'{out} holds the lines; choose another folder for the survey')
    there = out.is_dir() and any(out.iterdir())
    if there and not (resume or overwrite):
        raise BagError(
            f'{out} is there already; choose another folder, or say --resume or --overwrite'
        )
    if overwrite and any(os.path.lexists(out / name) for name in OWN):
        if why := hindrance(out, KIND, [runs], known=_is_survey(out)):
            raise BagError(why)
        with replaced(out, OWN) as place:
            mark(place, KIND)
            write_json(place / WORK / OPTIONS, wanted)
            yield place
        return
    if there and resume:
        _check_options(out, wanted)
        yield out
        return
    out.mkdir(parents=True, exist_ok=True)
    mark(out, KIND)
    try:
        write_json(out / WORK / OPTIONS, wanted)
        yield out
    except (BagError, ConfigError):
        _remove(out)
        raise


def _check_options(out: Path, wanted: Mapping[str, Any]) -> None:
    """Raise `BagError` where no survey with these options can be taken up again at `out`."""
    known = kept(out / WORK / OPTIONS)
    if not isinstance(known, dict):
        raise BagError(f'{out} holds no survey that could be taken up again')
    for name in (WORK, TILES):
        if (out / name).is_symlink():
            raise BagError(f'{out / name} is a link, through which nothing is written; remove it')
    if other := [name for name in wanted if known.get(name) != wanted[name]]:
        raise BagError(
            f'{out} was made with another {", ".join(other)}; choose another folder or say '
            '--overwrite'
        )


def _remove(out: Path) -> None:
    """Remove what a survey consists of from a folder that this command made; other files stay."""
    for name in OWN:
        if (out / name).is_dir() and not (out / name).is_symlink():
            shutil.rmtree(out / name, ignore_errors=True)
        else:
            (out / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        out.rmdir()


def _is_survey(out: Path) -> bool:
    """Whether a folder has what versions without markers wrote into that of a survey."""
    found = [kept(out / SURVEY), kept(out / WORK / OPTIONS)]
    wanted = [{'version', 'lines', 'tiles'}, {field.name for field in fields(Options)}]
    return any(isinstance(a, dict) and b <= a.keys() for a, b in zip(found, wanted))


def write(survey: Survey, out: Path) -> dict[str, Any]:
    """Write all files; gives the content of survey.json, the last of them. Raises `BagError`."""
    counts = {tile: len(nodes.z) for tile, nodes in survey.nodes()}
    west, north, cell, rows, columns = extent_of(list(counts))
    bands = {name: np.full((rows, columns), np.nan, np.float32) for name in OF_A_SURVEY}
    auto = survey.options.resolution == 0.0
    names_of_tiles = {f'{tile.name}.tif' for tile in counts}
    for stale in sorted((out / TILES).glob('L*_*_*.tif')):
        if stale.name not in names_of_tiles:
            stale.unlink()
    epsg = survey.epsg or None
    for tile, nodes in survey.nodes():
        own = _bands(tile, nodes)
        if auto:
            place = out / TILES / f'{tile.name}.tif'
            side = TILE * tile.cell
            chart = Chart(tile.i * side, (tile.j + 1) * side, tile.cell, own)
            with whole(place, follow=False) as unfinished:
                write_geotiff(unfinished, chart, epsg, OF_A_SURVEY)
        times = round(tile.cell / cell)
        top = round((north - (tile.j + 1) * TILE * tile.cell) / cell)
        left = round((tile.i * TILE * tile.cell - west) / cell)
        where = slice(top, top + TILE * times), slice(left, left + TILE * times)
        for name, values in own.items():
            bands[name][where] = np.repeat(np.repeat(values, times, axis=0), times, axis=1)
    chart = Chart(west, north, cell, bands)
    with whole(out / CHART, follow=False) as unfinished:
        write_geotiff(unfinished, chart, epsg, OF_A_SURVEY)
    _write_provenance(out / PROVENANCE, survey)
    write_json(out / COVERAGE, _coverage(chart, survey.epsg))
    _write_crossings(out / CROSSINGS, survey)
    crossings = {
        'cells': survey.crossing_cells,
        'rms_before': survey.rms_before,
        'rms_after': survey.adjustment.rms[-1] if survey.adjustment else None,
    }
    names = [unit.name for unit in survey.units]
    adjustment: dict[str, Any] = {'parameters': [], 'not_told': [], 'levels': []}
    if survey.adjustment is not None:
        adjustment = described(survey.adjustment, names)
    write_json(out / ADJUSTMENT, {**adjustment, 'crossings': crossings})
    write_report(out, survey, chart, adjustment)
    options = survey.options
    content = {
        'version': __version__,
        'options': {
            'resolution': options.resolution or 'auto',
            'adjust': options.adjusted,
            'fix': list(options.fixed),
            'origin': list(options.origin),
        },
        'crs': {'epsg': epsg},
        'lines': survey.lines,
        'tiles': [
            {'name': tile.name, 'cell': tile.cell, 'i': tile.i, 'j': tile.j, 'nodes': count}
            for tile, count in counts.items()
        ],
        'warnings': list(survey.warnings),
    }
    write_json(out / SURVEY, content)
    return content


def _bands(tile: Tile, nodes: Nodes) -> dict[str, FloatArray]:
    """Bands of a tile (64, 64), the first row the northernmost."""
    place = TILE - 1 - (nodes.iy - tile.j * TILE), nodes.ix - tile.i * TILE
    values = {**values_of(nodes), 'cell': np.full(len(nodes.z), tile.cell)}
    bands = {}
    for name in OF_A_SURVEY:
        bands[name] = np.full((TILE, TILE), np.nan)
        bands[name][place] = values[name]
    return bands


def _write_provenance(path: Path, survey: Survey) -> None:
    """One row for each line that a depth was made of."""
    import pyarrow
    import pyarrow.parquet

    numbers = [('x', 'float64'), ('y', 'float64'), ('cell', 'float32')]
    seen = [('line', 'string'), ('count', 'int32'), ('residual', 'float32')]
    schema = pyarrow.schema([pyarrow.field(*column) for column in numbers + seen])
    names = np.array([visible(unit.line) for unit in survey.units])
    with (
        whole(path, follow=False) as unfinished,
        unfinished.open('wb') as file,
        pyarrow.parquet.ParquetWriter(file, schema) as writer,
    ):
        for tile, nodes in survey.nodes():
            node = nodes.seen_node
            columns = [
                (nodes.ix[node] + 0.5) * tile.cell,
                (nodes.iy[node] + 0.5) * tile.cell,
                np.full(len(node), tile.cell, np.float32),
                names[nodes.seen_line],
                nodes.seen_count.astype(np.int32),
                nodes.seen_residual.astype(np.float32),
            ]
            writer.write_table(pyarrow.table(columns, schema=schema))


def _coverage(chart: Chart, epsg: int) -> dict[str, Any]:
    """Where the chart has depths, as polygons with holes."""
    from rasterio.features import shapes
    from rasterio.transform import from_origin
    from rasterio.warp import transform_geom

    seen = np.isfinite(chart.bands['depth'])
    transform = from_origin(chart.west, chart.north, chart.cell, chart.cell)
    features = []
    for shape, _ in shapes(seen.astype(np.uint8), mask=seen, transform=transform):
        geometry = transform_geom(f'EPSG:{epsg}', 'EPSG:4326', shape) if epsg else shape
        features.append({'type': 'Feature', 'properties': {}, 'geometry': geometry})
    where = 'WGS 84' if epsg else 'local metres, no coordinate system is known'
    return {'type': 'FeatureCollection', 'name': f'coverage in {where}', 'features': features}


def _write_crossings(path: Path, survey: Survey) -> None:
    """One row for each pair of lines that share cells, first less second, in m."""
    names = [unit.name for unit in survey.units]

    def summary(of_pair: Mistie | None) -> list[str]:
        return [f'{of_pair.median:.4f}', f'{of_pair.rms:.4f}'] if of_pair else ['', '']

    with (
        whole(path, follow=False) as unfinished,
        unfinished.open('w', encoding='utf-8', errors='backslashreplace', newline='') as file,
    ):
        writer = CsvWriter(file)
        kinds = ('median_before', 'rms_before', 'median_after', 'rms_after')
        writer.write(['line_a', 'line_b', 'cells', *kinds])
        for pair in sorted({*survey.before, *survey.after}):
            before, after = survey.before.get(pair), survey.after.get(pair)
            cells = (after or before or Mistie(0, math.nan, math.nan)).cells
            row = [*summary(before), *summary(after)]
            writer.write([names[pair[0]], names[pair[1]], cells, *row])


MOST_CELLS = 400
"""Cells along the longer side of a figure."""
SUN = (math.radians(315.0), math.radians(45.0))
"""Azimuth from north, clockwise, and elevation of the light."""


def write_report(out: Path, survey: Survey, chart: Chart, content: Mapping[str, Any]) -> None:
    """Write report.html: the same survey, the same bytes. content: that of adjustment.json."""
    seen = chart.bands
    thin = max(1, math.ceil(max(chart.shape) / MOST_CELLS))
    competing = np.where(np.nan_to_num(seen['hypotheses']) > 1, seen['competing_depth'], np.nan)
    figures = [
        ('Depth', 'With the light from north-west.', hillshaded(chart, thin)),
        (
            'Uncertainty',
            'One standard deviation: noise, errors that pings and lines have in common, and what '
            'is not known of the corrections, the common level included.',
            _image(chart, seen['uncertainty'], thin, 'sd [m]', 'Cividis'),
        ),
        (
            'Competing depths',
            'Where two or more soundings contradict the depth: how much deeper they are.',
            _image(chart, competing - seen['depth'], thin, 'deeper by [m]', 'RdBu'),
        ),
        (
            'Misties',
            'Robust rms of the difference of two lines that cross.',
            misties_figure(survey),
        ),
    ]
    text = rendered(
        'survey.html',
        summary=_summary(survey, chart),
        warnings=survey.warnings,
        figures=figures,
        corrections=content['parameters'],
        not_told=content['not_told'][:20],
        plotlyjs=plotly.offline.get_plotlyjs(),
    )
    with whole(out / REPORT, follow=False) as unfinished:
        unfinished.write_bytes(f'{text}\n'.encode('utf-8', 'backslashreplace'))


def hillshaded(chart: Chart, thin: int) -> Picture:
    """Depths, darker where they turn from the light."""
    depth = chart.bands['depth'][::thin, ::thin]
    figure = _image(chart, chart.bands['depth'], thin, 'depth [m]', 'Viridis_r')
    # Rows go south.
    down = east = 0 * depth
    if min(depth.shape) > 1:
        down, east = np.gradient(-depth, thin * chart.cell)
    azimuth, elevation = SUN
    across = math.sin(azimuth) * east - math.cos(azimuth) * down
    light = math.sin(elevation) - math.cos(elevation) * across
    shade = np.clip(light / np.sqrt(1.0 + np.square(east) + np.square(down)), 0.0, 1.0)
    x, y = chart.axes(thin)
    figure.add_heatmap(
        x=x,
        y=y,
        z=(1.0 - shade).astype(np.float32),
        colorscale=[[0.0, 'rgba(0,0,0,0)'], [1.0, 'rgba(0,0,0,0.7)']],
        showscale=False,
        hoverinfo='skip',
    )
    return figure


def misties_figure(survey: Survey) -> Picture:
    """Robust rms of each pair of lines, before and after."""
    figure = Picture()
    pairs = sorted({*survey.before, *survey.after})
    for name, found, colour in (
        ('before', survey.before, COLOURS[1]),
        ('after', survey.after, COLOURS[0]),
    ):
        there = [k for k, pair in enumerate(pairs) if pair in found]
        values = [found[pairs[k]].rms for k in there]
        if there:
            figure.points(there, values, name, colour, 6)
    rms = {'title': 'rms [m]', 'rangemode': 'tozero'}
    return figure.styled(320, {'title': 'pair of lines'}, rms)


def _image(chart: Chart, values: FloatArray, thin: int, title: str, colours: str) -> Picture:
    x, y = chart.axes(thin)
    shown = values[::thin, ::thin].astype(np.float32)
    low, high = (-1.0, 1.0)
    if np.isfinite(shown).any():
        low, high = np.nanquantile(shown, [0.01, 0.99]).tolist()
    if colours == 'RdBu':
        high = max(abs(low), abs(high))
        low = -high
    figure, bar = Picture(), {'title': title}
    figure.add_heatmap(x=x, y=y, z=shown, colorscale=colours, zmin=low, zmax=high, colorbar=bar)
    axis = {'zeroline': False, 'tickformat': 'd'}
    east = {'title': 'east [m]', 'constrain': 'domain', 'nticks': 5, **axis}
    north = {'title': 'north [m]', 'scaleanchor': 'x', **axis}
    return figure.styled(560, east, north)


def _summary(survey: Survey, chart: Chart) -> str:
    lines = [line for line in survey.lines if not line['failure']]
    total = sum(line['soundings'] for line in lines)
    depth = chart.bands['depth']
    words = [
        f'{len(lines)} lines with {total:,} soundings; depths of {np.nanmin(depth):.1f} to '
        f'{np.nanmax(depth):.1f} m; median standard deviation '
        f'{np.nanmedian(chart.bands["uncertainty"]):.2f} m.'
    ]
    if survey.adjustment is not None:
        rms = survey.adjustment.rms
        words.append(f'Misties {rms[0]:.3f} m rms before the adjustment, {rms[-1]:.3f} m after.')
        levels = ', '.join(f'{std:.2f}' for _, std in survey.adjustment.levels()[:5])
        words.append(f'The common level has a standard deviation of {levels} m, in every one.')
    elif survey.crossing_cells:
        words.append(
            f'Not adjusted: misties of {survey.rms_before:.3f} m rms are in the uncertainty.'
        )
    failed = [line['name'] for line in survey.lines if line['failure']]
    if failed:
        words.append(f'Not read: {", ".join(failed)}.')
    return ' '.join(words)
