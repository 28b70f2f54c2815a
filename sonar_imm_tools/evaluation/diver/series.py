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

"""Estimates as flat arrays, for scoring and reports.

A run is a list of `Estimate`, one per stamp, each with one row per track. Scoring needs columns
over the whole run, from which the rows of a track or of a stamp can be picked. `Series` holds
them, sorted by stamp.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray

STATES = ('px', 'py', 'vx', 'vy')


@frozen(eq=False, kw_only=True)
class Series:
    """Rows of many estimates, sorted by stamp; rows of one stamp stay together.

    scan_ns: (scans,) stamps of all estimates, also of those without rows.
    stamp_ns, track_id, track_state: (n,). state: (n, 4) px, py, vx, vy in metres and m/s, velocity
    NaN where unknown. covariance: (n, 4, 4), NaN likewise. probabilities: (n, models).
    nis: (n,), NaN without a hit; nis_dof: (n,) its degrees of freedom, NaN where unknown.
    """

    scan_ns: IntArray
    stamp_ns: IntArray
    track_id: IntArray
    track_state: IntArray
    state: FloatArray
    covariance: FloatArray
    model_names: tuple[str, ...]
    probabilities: FloatArray
    nis: FloatArray
    nis_dof: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def pick(self, rows: NDArray) -> Series:
        """The same run with some of its rows (a mask or indices); `scan_ns` is kept."""
        return Series(
            scan_ns=self.scan_ns,
            model_names=self.model_names,
            **{name: getattr(self, name)[rows] for name in _ROW_FIELDS},
        )

    def confirmed(self) -> Series:
        """Without the rows of tentative tracks."""
        return self.pick(self.track_state > 0)

    def hits(self) -> Series:
        """The rows that were updated by a measurement."""
        return self.pick(np.isfinite(self.nis) & (self.nis_dof > 0))

    def longest_track(self) -> int | None:
        """Id of the track with most rows (the lowest such id), None without rows."""
        ids, counts = np.unique(self.track_id, return_counts=True)
        return int(ids[np.argmax(counts)]) if len(ids) else None


_ROW_FIELDS = (
    'stamp_ns',
    'track_id',
    'track_state',
    'state',
    'covariance',
    'probabilities',
    'nis',
    'nis_dof',
)


def series_of(estimates: Iterable[Estimate]) -> Series:
    """Concatenate `estimates`, sorted by stamp.

    Truth tables, which state no covariance and no model, work too. Raises ValueError when there
    is no column px or py, or when the models change from one estimate to another.
    """
    ordered = sorted(estimates, key=lambda estimate: estimate.stamp_ns)
    filled = [estimate for estimate in ordered if len(estimate.xyz)]
    models = filled[0].model_names if filled else ()
    if any(estimate.model_names != models for estimate in filled):
        raise ValueError('the models change within the recording: it holds more than one run')
    stamps = np.array([estimate.stamp_ns for estimate in filled], np.int64)
    return Series(
        scan_ns=np.unique(np.array([estimate.stamp_ns for estimate in ordered], np.int64)),
        stamp_ns=np.repeat(stamps, [len(estimate.xyz) for estimate in filled]),
        track_id=_extra(filled, 'track_id', 0).astype(np.int64),
        track_state=_extra(filled, 'track_state', 1).astype(np.int64),
        state=_stack([_states(estimate) for estimate in filled], (4,)),
        covariance=_stack([_covariance(estimate) for estimate in filled], (4, 4)),
        model_names=models,
        probabilities=_stack([_probabilities(estimate) for estimate in filled], (len(models),)),
        nis=_extra(filled, 'nis', np.nan),
        nis_dof=_extra(filled, 'nis_dof', np.nan),
    )


def _states(estimate: Estimate) -> FloatArray:
    """(rows, 4). A truth table has px, py, vx, vy among the extras, having no covariance."""
    known = {**dict(zip(estimate.state_names, estimate.state.T)), **estimate.extras}
    for name in ('px', 'py'):
        if name not in known:
            raise ValueError(f"the estimates have no column '{name}'")
    unknown = np.full(len(estimate.xyz), np.nan)
    return np.column_stack([np.asarray(known.get(name, unknown), float) for name in STATES])


def _covariance(estimate: Estimate) -> FloatArray:
    full = np.full((len(estimate.xyz), 4, 4), np.nan)
    own = [index for index, name in enumerate(estimate.state_names) if name in STATES]
    ours = [STATES.index(estimate.state_names[index]) for index in own]
    full[:, np.array(ours, int)[:, None], np.array(ours, int)] = estimate.covariance[
        :, np.array(own, int)[:, None], np.array(own, int)
    ]
    return full


def _probabilities(estimate: Estimate) -> FloatArray:
    return estimate.probabilities.reshape(len(estimate.xyz), len(estimate.model_names))


def _extra(estimates: list[Estimate], name: str, default: float) -> FloatArray:
    columns = [
        estimate.extras.get(name, np.full(len(estimate.xyz), default)) for estimate in estimates
    ]
    return _stack([np.asarray(column, float) for column in columns], ())


def _stack(blocks: list[NDArray], tail: tuple[int, ...]) -> NDArray:
    return np.concatenate([np.empty((0, *tail)), *blocks])
