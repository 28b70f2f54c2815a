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

"""The files of a survey: charts, provenance, coverage, the adjustment and where lines cross."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import csv
import json
from pathlib import Path
import shutil
from typing import Any

from attrs import asdict
import numpy as np

from sonar_imm import __version__
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.files import whole
from sonar_imm.parameters import ConfigError

from ..offline.run_folder import REPORT
from ..recordings.sources import BagError
from .adjustment import described, robust_rms
from .chart import BANDS, Chart, values_of, write_geotiff
from .grid import Nodes
from .jobs import Options, TILE, Tile, write_json
from .making import extent_of, SURVEY, Survey, WORK
from .report import write_report

CHART, TILES, PROVENANCE, COVERAGE, ADJUSTMENT, CROSSINGS = (
    'survey.tif',
    'tiles',
    'provenance.parquet',
    'coverage.geojson',
    'adjustment.json',
    'crossings.csv',
)
OF_A_SURVEY = (*BANDS, 'cell')
"""Bands of survey.tif and of the tiles."""


@contextlib.contextmanager
def folder_of(
    out: Path, options: Options, *, resume: bool = False, overwrite: bool = False
) -> Iterator[None]:
    """The folder of a survey, made or taken up again. Where nothing was there and what is asked
    for cannot be done, nothing stays.

    Raises `BagError` when something is there and neither may be said of it, or when it was made
    with other options.
    """
    wanted = json.loads(json.dumps(asdict(options)))
    file = out / WORK / 'options.json'
    if out.exists() and not out.is_dir():
        raise BagError(f'{out} is a file; a folder is needed')
    there = out.is_dir() and any(out.iterdir())
    if there and resume:
        try:
            known = json.loads(file.read_text(encoding='utf-8'))
        except (OSError, ValueError):
            raise BagError(f'{out} holds no survey that could be taken up again') from None
        if other := [name for name in wanted if known.get(name) != wanted[name]]:
            raise BagError(
                f'{out} was made with another {", ".join(other)}; choose another folder or say '
                '--overwrite'
            )
    elif there and not overwrite:
        raise BagError(
            f'{out} is there already; choose another folder, or say --resume or --overwrite'
        )
    elif there:
        _remove(out)
    write_json(file, wanted)
    try:
        yield
    except (BagError, ConfigError):
        if not (there and resume):
            _remove(out)
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def _remove(out: Path) -> None:
    """Remove what a survey consists of; other files stay."""
    for name in (WORK, TILES):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in (SURVEY, CHART, PROVENANCE, COVERAGE, ADJUSTMENT, CROSSINGS, REPORT):
        (out / name).unlink(missing_ok=True)


def write(survey: Survey, out: Path) -> dict[str, Any]:
    """Write all files; gives the content of survey.json, which is the last of them. Raises
    `BagError`."""
    found = list(survey.nodes())
    west, north, cell, rows, columns = extent_of([tile for tile, _ in found])
    bands = {name: np.full((rows, columns), np.nan, np.float32) for name in OF_A_SURVEY}
    auto = survey.options.resolution == 0.0
    names_of_tiles = {f'{tile.name}.tif' for tile, _ in found}
    for stale in sorted((out / TILES).glob('*.tif')):
        if stale.name not in names_of_tiles:
            stale.unlink()
    epsg = survey.epsg or None
    for tile, nodes in found:
        own = _bands(tile, nodes)
        if auto:
            place = out / TILES / f'{tile.name}.tif'
            side = TILE * tile.cell
            chart = Chart(tile.i * side, (tile.j + 1) * side, tile.cell, own)
            with whole(place) as unfinished:
                write_geotiff(unfinished, chart, epsg, OF_A_SURVEY)
        times = round(tile.cell / cell)
        top = round((north - (tile.j + 1) * TILE * tile.cell) / cell)
        left = round((tile.i * TILE * tile.cell - west) / cell)
        where = slice(top, top + TILE * times), slice(left, left + TILE * times)
        for name, values in own.items():
            bands[name][where] = np.repeat(np.repeat(values, times, axis=0), times, axis=1)
    chart = Chart(west, north, cell, bands)
    with whole(out / CHART) as unfinished:
        write_geotiff(unfinished, chart, epsg, OF_A_SURVEY)
    _write_provenance(out / PROVENANCE, survey, found)
    write_json(out / COVERAGE, _coverage(chart, survey.epsg))
    _write_crossings(out / CROSSINGS, survey)
    crossings = {
        'cells': survey.crossing_cells,
        'rms_before': survey.rms_before,
        'rms_after': survey.adjustment.rms[-1] if survey.adjustment else None,
    }
    names = [unit.name for unit in survey.units]
    told: dict[str, Any] = {'parameters': [], 'not_told': []}
    if survey.adjustment is not None:
        told = described(survey.adjustment, names)
    write_json(out / ADJUSTMENT, {**told, 'crossings': crossings})
    write_report(out, survey, chart, told)
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
            {'name': tile.name, 'cell': tile.cell, 'i': tile.i, 'j': tile.j, 'nodes': len(nodes.z)}
            for tile, nodes in found
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


def _write_provenance(path: Path, survey: Survey, found: list[tuple[Tile, Nodes]]) -> None:
    """One row for each line that a depth was made of."""
    import pyarrow
    import pyarrow.parquet

    schema = pyarrow.schema(
        [
            ('x', pyarrow.float64()),
            ('y', pyarrow.float64()),
            ('cell', pyarrow.float32()),
            ('line', pyarrow.string()),
            ('count', pyarrow.int32()),
            ('residual', pyarrow.float32()),
        ]
    )
    names = np.array([unit.line for unit in survey.units])
    with (
        whole(path) as unfinished,
        pyarrow.parquet.ParquetWriter(str(unfinished), schema) as writer,
    ):
        for tile, nodes in found:
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
    return {
        'type': 'FeatureCollection',
        'name': f'coverage in {where}',
        'features': features,
    }


def _write_crossings(path: Path, survey: Survey) -> None:
    """One row for each pair of lines that share cells, first less second, in m."""
    names = [unit.name for unit in survey.units]

    def summary(found: Mapping[tuple[int, int], FloatArray], pair: tuple[int, int]) -> list[str]:
        if pair not in found:
            return ['', '']
        return [f'{float(np.median(found[pair])):.4f}', f'{robust_rms(found[pair]):.4f}']

    with whole(path) as unfinished, unfinished.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        kinds = ('median_before', 'rms_before', 'median_after', 'rms_after')
        writer.writerow(['line_a', 'line_b', 'cells', *kinds])
        for pair in sorted({*survey.before, *survey.after}):
            apart = survey.after.get(pair, survey.before.get(pair, np.zeros(0)))
            row = [*summary(survey.before, pair), *summary(survey.after, pair)]
            writer.writerow([names[pair[0]], names[pair[1]], len(apart), *row])
