# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A results folder as a file of the Rerun viewer: every track with the ellipsoid of its
covariance, and its states, their standard deviations and its models as curves.

Needs the package ``rerun-sdk`` (extra ``[rerun]``), which is imported here only.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import rerun
from rerun import blueprint
from scipy.spatial.transform import Rotation

from sonar_imm.estimates import Estimate

from ..offline.run_folder import read_truth, RunFolder

_SIGMAS = 2.0
_THINNEST = 0.005


def write_rerun(run: Path, file: Path) -> int:
    """Write the estimates of the run folder `run` to `file`; gives how many there were.

    Entities: ``<system>/points``, ``<system>/covariance`` (2 sigma), ``truth``, and of every track
    that was confirmed ``<system>/track_<id>/state/<name>``, ``.../std/<name>`` and
    ``.../probability/<model>``. The first picture has the scene and the curves of the track that
    lasted longest. Raises `BagError` for a folder that holds no run.
    """
    folder = RunFolder(run)
    facts = folder.read_run()
    system, estimates = facts['system'], folder.read_estimates()
    lasting = _confirmed(estimates)
    file.parent.mkdir(parents=True, exist_ok=True)
    with rerun.RecordingStream(f'sonar_imm {system}') as stream:
        stream.save(file, default_blueprint=_first_picture(system, lasting))
        for estimate in estimates:
            _log(stream, system, estimate, lasting)
        for true in read_truth(facts) or []:
            stream.set_time('stamp', timestamp=np.datetime64(true.stamp_ns, 'ns'))
            stream.log('truth', rerun.Points3D(true.xyz, colors=(255, 255, 255)))
    return len(estimates)


def _confirmed(estimates: list[Estimate]) -> Counter[int]:
    """How often each track that was ever confirmed was estimated; without states all tracks."""
    seen: Counter[int] = Counter()
    confirmed: set[int] = set()
    for estimate in estimates:
        ids = estimate.extras.get('track_id')
        if ids is None:
            continue
        seen.update(ids.tolist())
        states = estimate.extras.get('track_state', np.ones(len(ids)))
        confirmed.update(ids[states >= 1].tolist())
    return Counter({track: count for track, count in seen.items() if track in confirmed})


def _first_picture(system: str, lasting: Counter[int]) -> blueprint.Blueprint:
    scene = blueprint.Spatial3DView(origin='/', name=system)
    if not lasting:
        return blueprint.Blueprint(scene)
    track = max(lasting, key=lasting.__getitem__)
    curves = [
        blueprint.TimeSeriesView(origin=f'/{system}/track_{track}/{kind}', name=f'{track}: {kind}')
        for kind in ('probability', 'state', 'std')
    ]
    beside = blueprint.Vertical(*curves)
    return blueprint.Blueprint(blueprint.Horizontal(scene, beside, column_shares=[3, 2]))


def _log(
    stream: rerun.RecordingStream, system: str, estimate: Estimate, lasting: Counter[int]
) -> None:
    """Log one estimate at its stamp; curves of the tracks in `lasting`."""
    stream.set_time('stamp', timestamp=np.datetime64(estimate.stamp_ns, 'ns'))
    ids = estimate.extras.get('track_id')
    classes = None if ids is None else ids.astype(np.uint16)
    stream.log(f'{system}/points', rerun.Points3D(estimate.xyz, class_ids=classes))
    covariances = _place_covariances(estimate)
    if covariances is not None:
        half_sizes, turns = _ellipsoids(covariances)
        drawn = rerun.Ellipsoids3D(
            centers=estimate.xyz, half_sizes=half_sizes, quaternions=turns, class_ids=classes
        )
        stream.log(f'{system}/covariance', drawn)
    if ids is None:
        return  # one row per range bin: thousands of curves would show nothing
    stds = np.sqrt(np.maximum(np.einsum('nii->ni', estimate.covariance), 0.0))
    tables = (
        ('state', estimate.state_names, estimate.state),
        ('std', estimate.state_names, stds),
        ('probability', estimate.model_names, estimate.probabilities),
    )
    for row, track in enumerate(ids.tolist()):
        if track not in lasting:
            continue
        for kind, names, table in tables:
            for name, value in zip(names, table[row].tolist()):
                if np.isfinite(value):
                    path = f'{system}/track_{track}/{kind}/{name}'
                    stream.log(path, rerun.Scalars(value))


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
