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

"""Estimates of divers, or their true states, as flat arrays."""

from __future__ import annotations

from collections.abc import Iterable

from attrs import evolve, frozen
import numpy as np

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IntArray

from ..columns import column, covariance_of, read_rows, Rows

STATES = ('px', 'py', 'vx', 'vy')


@frozen(eq=False, kw_only=True)
class Series(Rows):
    """Rows of tracks, in metres and m/s; velocities and their covariance are NaN where unknown.

    place, place_covariance: x, y, z and their covariance, NaN where depth is not estimated; z: of
    the point that is drawn, which of truth is its height. nis: NaN without a hit; nis_dof: its
    degrees of freedom, NaN where unknown.
    """

    track_id: IntArray = column('track_id', dtype=np.int64, default=0)
    track_state: IntArray = column('track_state', dtype=np.int64, default=1)
    state: FloatArray = column('px', 'py', 'vx?', 'vy?')
    covariance: FloatArray = covariance_of(*STATES)
    place: FloatArray = column('px', 'py', 'pz?')
    place_covariance: FloatArray = covariance_of('px', 'py', 'pz')
    z: FloatArray = column('z?')
    model_names: tuple[str, ...]
    probabilities: FloatArray = column('prob_*')
    nis: FloatArray = column('nis?')
    nis_dof: FloatArray = column('nis_dof?')

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


def series_of(estimates: Iterable[Estimate]) -> Series:
    """The rows of `estimates` by stamp. Truth tables, which state no covariance and no model, work
    too.

    Raises ValueError when there is no column px or py, or when the models change from one estimate
    to another.
    """
    estimates = list(estimates)
    models = {estimate.model_names for estimate in estimates if len(estimate)}
    if len(models) > 1:
        raise ValueError('the models change within the recording: it holds more than one run')
    series = read_rows(
        Series,
        estimates,
        "the estimates have no column '{}'",
        model_names=next(iter(models), ()),
    )
    return evolve(series, scan_ns=np.unique(series.scan_ns))
