# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Records of a run, each with its truth, and scores of its reflectors against the true ones.

OSPA of second order (Schuhmacher, Vo and Vo 2008) is one number in metres: the RMS error of a
reflector, where one too many or too few counts as an error of the cutoff. For the other metrics
found and true reflectors are paired by least total distance, none further apart than `NEAR` times
the cutoff. Found reflectors without a partner are false, true ones are missed.

Previews are not scored, because their record revises them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray
from sonar_imm.estimation.consistency import ospa

from ... import SECOND
from ..columns import MissingColumn, read_columns
from ..numbers import error_summary

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
    missing = "the truth is not that of reflectors: it has no column '{}'"
    depth, amplitude, ids = read_columns(estimate, _TRUE, missing).values()
    ids = np.where(np.isfinite(ids), ids, np.arange(len(ids)))
    there = np.isfinite(depth)
    return Reflections(depth[there], amplitude[there], ids[there].astype(np.int64))


CUTOFF = 2.0
"""OSPA cutoff, m: the error that a false or missed reflector counts as."""
NEAR = 0.2
"""Share of the cutoff within which a found reflector can be paired with a true one."""


class Pairing(NamedTuple):
    """Indices (pairs,) into the found and the true reflectors, and the OSPA distance, m."""

    found: NDArray[np.intp]
    true: NDArray[np.intp]
    ospa: float


Scored = list[tuple[Record, Reflections, Pairing]]
"""Records, each with its truth, and which reflector is which."""


def pair(found: FloatArray, true: FloatArray, cutoff: float) -> Pairing:
    """Pair depths (K,) with depths (J,)."""
    from scipy.optimize import linear_sum_assignment

    distance = np.abs(found[:, None] - true)
    rows, columns = linear_sum_assignment(np.minimum(distance, NEAR * cutoff))
    near = distance[rows, columns] < NEAR * cutoff
    apart = ospa(true[:, None], found[:, None], cutoff, order=2.0)
    return Pairing(rows[near], columns[near], apart)


def score(records: Sequence[Record], cutoff: float = CUTOFF) -> dict[str, Any]:
    """The content of ``metrics.json``."""
    committed = [record for record in records if not record.preview]
    metrics: dict[str, Any] = {
        'records': len(committed),
        'previews': len(records) - len(committed),
        'span_s': (records[-1].stamp_ns - records[0].stamp_ns) / 1e9 if records else 0.0,
        'reflectors_mean': _mean([len(record.found) for record in committed]),
        'ids': len({int(i) for record in committed for i in record.found.track_id}),
        'cutoff_m': cutoff,
    }
    scored = [
        (record, record.true, pair(record.found.depth, record.true.depth, cutoff))
        for record in committed
        if record.true is not None
    ]
    return metrics | (_against_truth(scored) if scored else {})


def _against_truth(scored: Scored) -> dict[str, Any]:
    error = np.concatenate([r.found.depth[p.found] - t.depth[p.true] for r, t, p in scored])
    std = np.concatenate([r.depth_std[p.found] for r, _, p in scored])
    return {
        'scored_records': len(scored),
        'order_right': _mean([r.order == len(t) for r, t, _ in scored]),
        'ospa_m': _mean([p.ospa for _, _, p in scored]),
        'false_per_record': _mean([len(r.found) - len(p.found) for r, _, p in scored]),
        'missed_per_record': _mean([len(t) - len(p.true) for _, t, p in scored]),
        'depth': {
            **error_summary(np.abs(error)),
            'bias_m': _mean(error),
            'inside_2_sigma': _mean(np.abs(error) <= 2.0 * std),
        },
        'amplitude': _amplitudes(scored),
        'existence': _existence(scored),
        'identity_switches': _switches(scored),
    }


def _amplitudes(scored: Scored) -> dict[str, float]:
    """Relative errors after one common factor, because a passive array measures ratios only."""
    found = np.concatenate([r.found.strength[p.found] for r, _, p in scored])
    true = np.concatenate([t.strength[p.true] for _, t, p in scored])
    use = np.isfinite(found) & (true > 0.0)
    if not use.any():
        return {'n': 0}
    ratio = found[use] / true[use]
    factor = float(np.median(ratio))
    error = np.abs(ratio / factor - 1.0)
    return {
        'n': int(use.sum()),
        'factor': factor,
        'median_relative_error': float(np.median(error)),
        'p95_relative_error': float(np.percentile(error, 95.0)),
    }


def _existence(scored: Scored) -> dict[str, float]:
    """Stated probability of existence, and the share that was true."""
    stated = np.concatenate([r.existence for r, _, _ in scored])
    right = np.concatenate([np.isin(np.arange(len(r.found)), p.found) for r, _, p in scored])
    doubtful = stated < 0.95
    return {
        'stated_mean': _mean(stated),
        'true_share': _mean(right),
        'doubtful': int(doubtful.sum()),
        'doubtful_stated': _mean(stated[doubtful]),
        'doubtful_true': _mean(right[doubtful]),
    }


def _switches(scored: Scored) -> int:
    """How often a true reflector is found under another id than before."""
    last: dict[int, int] = {}
    switches = 0
    for record, true, p in scored:
        found = record.found.track_id[p.found].tolist()
        for who, name in zip(true.track_id[p.true].tolist(), found):
            switches += last.get(who, name) != name
            last[who] = name
    return switches


def _mean(values: Any) -> float:
    array = np.asarray(values, np.float64)
    return float(array.mean()) if array.size else float('nan')
