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

"""A run as a file of the Rerun viewer, which draws what Foxglove cannot: every track with the
ellipsoid of its covariance, and all columns as curves.

Needs the package ``rerun-sdk`` (extra ``[rerun]``), which is imported here only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun
from scipy.spatial.transform import Rotation

from ..estimates import Estimate
from ..evaluation.run_folder import read_truth, RunFolder

_SIGMAS = 2.0
_THINNEST = 0.005


def write_rerun(run: Path, file: Path) -> int:
    """Write the estimates of the run folder `run` to `file`; gives how many there were.

    Entities: ``<system>/points``, ``<system>/covariance`` (2 sigma), a curve
    ``<system>/track_<id>/<column>`` for each column of a track, and ``truth``. Raises `BagError`
    for a folder that holds no run.
    """
    folder = RunFolder(run)
    facts = folder.read_run()
    estimates = folder.read_estimates()
    file.parent.mkdir(parents=True, exist_ok=True)
    with rerun.RecordingStream(f'sonar_imm {facts["system"]}') as stream:
        stream.save(file)
        for estimate in estimates:
            _log(stream, facts['system'], estimate)
        for true in read_truth(facts) or []:
            stream.set_time('stamp', timestamp=np.datetime64(true.stamp_ns, 'ns'))
            stream.log('truth', rerun.Points3D(_places(true), colors=(255, 255, 255)))
    return len(estimates)


def _log(stream: rerun.RecordingStream, system: str, estimate: Estimate) -> None:
    """Log one estimate at its stamp."""
    stream.set_time('stamp', timestamp=np.datetime64(estimate.stamp_ns, 'ns'))
    columns = estimate.columns()
    places = _places(estimate)
    ids = columns.get('track_id')
    classes = None if ids is None else ids.astype(np.uint16)
    stream.log(f'{system}/points', rerun.Points3D(places, class_ids=classes))
    covariances = _place_covariances(estimate)
    if covariances is not None:
        half_sizes, turns = _ellipsoids(covariances)
        drawn = rerun.Ellipsoids3D(
            centers=places, half_sizes=half_sizes, quaternions=turns, class_ids=classes
        )
        stream.log(f'{system}/covariance', drawn)
    if ids is None:
        return  # one row per range bin: thousands of curves would show nothing
    for row, track in enumerate(ids.tolist()):
        for name, column in columns.items():
            if np.isfinite(column[row]):
                stream.log(f'{system}/track_{track}/{name}', rerun.Scalars(float(column[row])))


def _places(estimate: Estimate) -> np.ndarray:
    return np.asarray(estimate.xyz, float).reshape(-1, 3)


def _place_covariances(estimate: Estimate) -> np.ndarray | None:
    """Covariances (n, 3, 3) of the places, m²; None where the estimate has none."""
    columns = estimate.columns()
    for prefix, axes in (('place_cov_', 'xyz'), ('cov_', ('px', 'py'))):
        if f'{prefix}{axes[0]}_{axes[1]}' not in columns:
            continue
        found = np.zeros((len(estimate), 3, 3))
        for i, a in enumerate(axes):
            for j, b in enumerate(axes[i:], start=i):
                found[:, i, j] = found[:, j, i] = columns[f'{prefix}{a}_{b}']
        return found
    return None


def _ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half axes (n, 3) of the 2 sigma ellipsoids and the quaternions (n, 4), x y z w, of their
    axes. An axis without a variance has half a centimetre, to be seen at all."""
    values, axes = np.linalg.eigh(np.nan_to_num(covariances))
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation, not a mirror image
    half_sizes = _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    return np.maximum(half_sizes, _THINNEST), Rotation.from_matrix(axes).as_quat()
