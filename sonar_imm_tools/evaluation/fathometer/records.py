# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Records of a run, each with its truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from attrs import frozen
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray

from ... import SECOND
from ..columns import MissingColumn, read_columns

_FOUND = (
    'depth', 'amplitude', 'relative_amplitude', 'cov_depth_depth', 'track_id', 'existence',
    'sigma', 'preview',
)  # fmt: skip
_TRUE = ('depth', 'amplitude', 'track_id?')


@frozen(eq=False)
class Reflections:
    """K reflectors: depth (K,) m, strength (K,), track_id (K,)."""

    depth: FloatArray
    strength: FloatArray
    track_id: IntArray

    def __len__(self) -> int:
        return len(self.depth)


@frozen(eq=False)
class Record:
    """The estimate of one record, and its truth.

    found: the K reflectors; their strengths are amplitudes corrected for spreading. depth_std,
    existence: (K,) of these. pmf: (orders,) of the number of reflectors, from `order_min` on.
    true: None when not known.
    """

    stamp_ns: int
    preview: bool
    found: Reflections
    depth_std: FloatArray
    existence: FloatArray
    pmf: FloatArray
    order_min: int
    sigma: float
    true: Reflections | None = None

    @property
    def order(self) -> int:
        """The most probable number of reflectors."""
        return self.order_min + int(np.argmax(self.pmf))


@frozen(eq=False)
class Image:
    """Depth responses side by side, in units of their noise: value (depths, records); depth
    (depths,) m; stamp_ns (records,)."""

    value: FloatArray
    depth: FloatArray
    stamp_ns: IntArray


def records_of(
    estimates: Iterable[Estimate],
    truth: Sequence[Estimate] | None = None,
    *,
    lag: float = 0.0,
    gap: float = 60.0,
) -> list[Record]:
    """Records in order of stamps, each with the truth nearest to `lag` seconds after it, if that
    is within `gap` seconds. Raises `BagError` when the columns are those of something else."""
    known = sorted(truth or [], key=lambda table: table.stamp_ns)
    stamps = np.array([table.stamp_ns for table in known], np.int64)
    true = [_true(table) for table in known]
    records = []
    for estimate in sorted(estimates, key=lambda estimate: estimate.stamp_ns):
        nearest = None
        if len(stamps):
            away = np.abs(stamps - (estimate.stamp_ns + round(lag * SECOND)))
            best = int(np.argmin(away))
            nearest = true[best] if away[best] <= gap * SECOND else None
        records.append(_record(estimate, nearest))
    return records


def _record(estimate: Estimate, true: Reflections | None) -> Record:
    missing = "not estimates of reflectors: there is no column '{}'"
    columns = read_columns(estimate, _FOUND, missing)
    if not estimate.model_names or not all(n.startswith('order_') for n in estimate.model_names):
        raise MissingColumn(missing.format('prob_order_<k>'))
    there = np.isfinite(columns['depth'])
    relative = columns['relative_amplitude']
    strength = np.where(np.isfinite(relative), relative, columns['amplitude'])
    ids = columns['track_id'][there].astype(np.int64)
    return Record(
        stamp_ns=estimate.stamp_ns,
        preview=bool(columns['preview'][0]),
        found=Reflections(columns['depth'][there], strength[there], ids),
        depth_std=np.sqrt(columns['cov_depth_depth'][there]),
        existence=columns['existence'][there],
        pmf=estimate.probabilities[0],
        order_min=int(estimate.model_names[0][len('order_') :]),
        sigma=float(columns['sigma'][0]),
        true=true,
    )


def _true(estimate: Estimate) -> Reflections:
    columns = read_columns(
        estimate, _TRUE, "the truth is not that of reflectors: it has no column '{}'"
    )
    ids = columns['track_id']
    ids = np.where(np.isfinite(ids), ids, np.arange(len(ids)))
    there = np.isfinite(columns['depth'])
    return Reflections(
        columns['depth'][there], columns['amplitude'][there], ids[there].astype(np.int64)
    )
