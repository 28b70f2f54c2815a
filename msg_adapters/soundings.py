# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Soundings as messages: the PointCloud2 of ``~/soundings``, which gridders like CUBE take."""

from __future__ import annotations

from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimates import PLACES, places
from sonar_imm.measurements import Ground, Rejection
from sonar_imm.soundings import COLUMNS, LATER, Soundings

from .headers import head_of, Make, swap_axes, to_enu
from .table import decode_table, require_columns, scalar_column, table_of

MOST_SOUNDINGS = 1_000_000


def write_soundings(soundings: Soundings, make: Make) -> Any:
    """Write the table of ``~/soundings``, one row per bin with an echo, nothing NaN."""
    return table_of(soundings, soundings.columns, make)


def read_soundings(message: Any) -> Soundings:
    """Read what `write_soundings` wrote. Raises `Rejection`."""
    columns = decode_table(message)
    later = (*PLACES, *LATER)  # which older tables lack
    require_columns(columns, tuple(n for n in COLUMNS if n not in later), 'soundings')
    for name, coarse in zip(PLACES, 'xyz'):
        columns.setdefault(name, columns[coarse].astype(np.float64))
    for name, value in LATER.items():
        columns.setdefault(name, np.full(len(columns['x']), value, COLUMNS[name]))
    for name, kind in COLUMNS.items():
        if columns[name].dtype != np.dtype(kind) or columns[name].ndim != 1:
            raise Rejection(
                'bad_field', f'column {name} of a table of soundings is not {np.dtype(kind).name}'
            )
    return Soundings(**head_of(message), columns={name: columns[name] for name in COLUMNS})


def read_ground(message: Any, *, world_frame: str = 'enu', **_: Any) -> Ground:
    """Read soundings as the floor under obstacles: a table with the columns ``px py pz``, else
    ``x y z``, and ``vertical_uncertainty``, a variance m^2, where it is there. Rows that are not
    finite are left out. Raises `Rejection`."""
    wanted = (*PLACES, *'xyz', 'vertical_uncertainty')
    columns = decode_table(message, wanted, most_rows=MOST_SOUNDINGS)
    names = PLACES if set(PLACES) <= columns.keys() else tuple('xyz')
    if columns or message.height * message.width:
        require_columns(columns, names, 'ground')
    axes = [scalar_column(columns, name) for name in names] if columns else np.empty((3, 0))
    position = np.column_stack([*axes])
    variance = np.zeros(len(position))
    if 'vertical_uncertainty' in columns:
        variance = scalar_column(columns, 'vertical_uncertainty')
        variance = np.where(np.isfinite(variance) & (variance > 0.0), variance, 0.0)
    kept = np.isfinite(position).all(axis=1)
    ground = Ground(
        **head_of(message),
        position=position[kept],
        variance=variance[kept],
    )
    return to_enu(ground, world_frame, _turned)


def write_ground(ground: Ground, make: Make) -> Any:
    """Write the table that `read_ground` reads."""
    columns: dict[str, Any] = {
        **dict(zip('xyz', ground.position.T.astype(np.float32))),
        'vertical_uncertainty': ground.variance.astype(np.float32),
        **places(ground.position),
    }
    return table_of(ground, columns, make)


def _turned(ground: Ground) -> Ground:
    return evolve(ground, position=swap_axes(ground.position))
