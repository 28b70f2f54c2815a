# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Soundings: the part of a bathymetry estimate that goes into a chart.

One row for each bin with an echo, in the frame of the navigation; two where both of its surfaces
are known (``layover: resolved``). The columns are the contract of
``~/soundings`` and of soundings.csv. Everything a gridder reads is float32: the CUBE node for
ROS 2 reads four-byte floats whatever a field declares, and knows no NaN. The place stands at the
end once more in float64.
"""

from __future__ import annotations

from collections.abc import Mapping

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from .estimates import Estimate, PLACES, places

SIDES = ('port', 'starboard')
"""Names of the numbers in the column `side`."""
COLUMNS: dict[str, type] = {
    'x': np.float32,
    'y': np.float32,
    'z': np.float32,
    'vertical_uncertainty': np.float32,
    'horizontal_uncertainty': np.float32,
    'intensity': np.float32,
    'beam_angle': np.float32,
    'label': np.uint8,
    'label_probability': np.float32,
    'range': np.float32,
    'side': np.uint8,
    'surface': np.uint8,
    'existence': np.float32,
    'geometry_std': np.float32,
    'px': np.float64,
    'py': np.float64,
    'pz': np.float64,
}
"""x y z m in the frame of the navigation; uncertainties: variances, m^2 (horizontal: of x and y
together); intensity: 10 log10 of the mean power of a stave, dB; beam_angle: rad from straight
down, port positive; label: number of the most probable terrain model; range m; side: 0 port, 1
starboard; surface: 1, of two the lower, or 2, the upper; existence: probability of a second
surface in the bin; geometry_std m: what of the vertical uncertainty all pings have in common, as a
standard deviation; px py pz: the same place as x y z, which at map coordinates are half a metre
coarse."""

LATER = {'surface': 1, 'existence': 0.0, 'geometry_std': 0.0}
"""Columns that older tables lack, with what they mean."""


@frozen(eq=False)
class Soundings:
    """The soundings of one ping: columns (n,) by name, as in `COLUMNS`."""

    stamp_ns: int
    frame_id: str
    columns: Mapping[str, NDArray]

    def __len__(self) -> int:
        return len(self.columns['x'])


def soundings_of(estimate: Estimate) -> Soundings | None:
    """The soundings in a bathymetry estimate, None for one made without navigation.

    Rows without an echo are left out, and those of which something is not known: no ray reaches
    there, or the sound speed says nothing at the height of the array. A second surface follows
    the first one of its bin.
    """
    extras = estimate.extras
    if 'vertical_uncertainty' not in extras:
        return None
    n = len(estimate)
    lower = {
        **dict(zip('xyz', estimate.xyz.T)),
        **places(estimate.xyz),
        **extras,
        'geometry_std': extras.get('geometry_std', np.zeros(n)),
        'surface': np.ones(n),
        'existence': extras.get('existence_2', np.zeros(n)),
    }
    surfaces = [lower]
    if 'height_2' in extras:
        own = {name: extras[f'{name}_2'] for name in COLUMNS if f'{name}_2' in extras}
        exact = {name: own[place] for name, place in zip('xyz', PLACES)}
        surfaces.append({**lower, **own, **exact, 'surface': np.full(n, 2)})
    # Bin by bin, the lower surface first.
    with np.errstate(over='ignore', invalid='ignore'):
        table: dict[str, np.ndarray] = {
            name: np.column_stack([columns[name] for columns in surfaces]).astype(kind).ravel()
            for name, kind in COLUMNS.items()
        }
    kept = np.repeat(np.asarray(extras['valid'], bool), len(surfaces))
    for column in table.values():
        kept = kept & np.isfinite(column)
    return Soundings(
        estimate.stamp_ns,
        estimate.frame_id,
        {name: np.ascontiguousarray(column[kept]) for name, column in table.items()},
    )
