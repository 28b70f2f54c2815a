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

"""Soundings: the part of a bathymetry estimate that goes into a chart.

One row for each bin with an echo, in the frame of the navigation. The columns are the contract of
``~/soundings`` and of soundings.csv. Everything a gridder reads is float32: the CUBE node for
ROS 2 reads four-byte floats whatever a field declares, and knows no NaN. The place stands at the
end once more in float64.
"""

from __future__ import annotations

from collections.abc import Mapping

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from .estimates import Estimate, places

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
    'px': np.float64,
    'py': np.float64,
    'pz': np.float64,
}
"""x y z m in the frame of the navigation; uncertainties: variances, m^2 (horizontal: of x and y
together); intensity: 10 log10 of the mean power of a stave, dB; beam_angle: rad from straight
down, port positive; label: number of the most probable terrain model; range m; side: 0 port, 1
starboard; px py pz: the same place as x y z, which at map coordinates are half a metre coarse."""


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
    there, or the sound speed says nothing at the height of the array.
    """
    if 'vertical_uncertainty' not in estimate.extras:
        return None
    exact = places(estimate.xyz)
    columns = {**dict(zip('xyz', estimate.xyz.T)), **exact, **estimate.extras}
    kept = np.asarray(estimate.extras['valid'], bool)
    with np.errstate(over='ignore'):
        table: dict[str, np.ndarray] = {
            name: np.asarray(columns[name]).astype(kind) for name, kind in COLUMNS.items()
        }
    for column in table.values():
        kept = kept & np.isfinite(column)
    return Soundings(
        estimate.stamp_ns,
        estimate.frame_id,
        {name: np.ascontiguousarray(column[kept]) for name, column in table.items()},
    )
