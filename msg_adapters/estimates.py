# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates as messages.

The PointCloud2 table of ``~/estimate`` is the lossless contract and reads back bit for bit.
Odometry and JointState are views of one row for displays and plots; Odometry has no room for the
covariance between position and velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Rejection

from .headers import head_of, Make, make_header, make_stated_pose, make_stated_twist
from .table import decode_table, is_finite, layout_of, packed_table

NOT_ESTIMATED = 1.0
"""Variance of a z or a vertical speed that is not estimated, m^2 and m^2/s^2: it says nothing, but
RViz would draw a million as an ellipsoid two kilometres high."""
ALIGNED = 1e-9
"""Variance, rad^2, of an orientation that is so by definition; some programs refuse zeros."""


def write_estimate(estimate: Estimate, make: Make) -> Any:
    """Write the PointCloud2 table of ``~/estimate``, one row per target; it may have no rows."""
    packed, fields, is_dense = _packed(estimate, make)
    header = make_header(estimate.stamp_ns, estimate.frame_id, make)
    return packed_table(packed, fields, is_dense, header, make)


def _packed(estimate: Estimate, make: Make) -> tuple[NDArray, tuple[Any, ...], bool]:
    """The rows of `Estimate.columns` as `encode_table` packs them, their fields, and whether all
    numbers are finite. States, covariances and probabilities go in as one block: column by column
    a live node would spend a tenth of its time on columns of one number."""
    extras = estimate.extras
    layout = tuple((name, value.dtype, value.shape[1:]) for name, value in extras.items())
    plan = _plan(make, estimate.state_names, estimate.model_names, layout)
    packed = np.empty(len(estimate), plan.dtype)
    whole = packed.view(plan.pieces)
    upper = estimate.covariance[:, plan.upper[0], plan.upper[1]]
    whole['xyz'] = np.asarray(estimate.xyz).reshape(-1, 3)
    whole['block'] = np.concatenate([estimate.state, upper, estimate.probabilities], axis=1)
    for name, column in extras.items():
        packed[name] = column
    columns = [whole['xyz'], whole['block'], *(extras[name] for name in plan.inexact)]
    return packed, plan.fields, is_finite(packed, columns, flat=plan.flat)


class _Plan(NamedTuple):
    """Where the columns of estimates lie. pieces: the same rows as xyz, one block, and the rest;
    upper: rows and columns of the covariances sent; inexact: extras that may hold NaN; flat: no
    column has several numbers."""

    dtype: np.dtype
    fields: tuple[Any, ...]
    pieces: np.dtype
    upper: tuple[NDArray, NDArray]
    inexact: tuple[str, ...]
    flat: bool


@lru_cache(maxsize=64)
def _plan(
    make: Make,
    states: tuple[str, ...],
    models: tuple[str, ...],
    extras: tuple[tuple[str, np.dtype, tuple[int, ...]], ...],
) -> _Plan:
    """What does not change from one estimate of a tracker to the next."""
    n, m = len(states), len(models)
    upper = np.triu_indices(n)
    empty = Estimate(
        stamp_ns=0,
        frame_id='',
        xyz=np.empty((0, 3)),
        state_names=states,
        state=np.empty((0, n)),
        covariance=np.empty((0, n, n)),
        model_names=models,
        probabilities=np.empty((0, m)),
        extras={name: np.empty((0, *shape), dtype) for name, dtype, shape in extras},
    ).columns()
    layout = tuple((name, column.dtype, column.shape[1:]) for name, column in empty.items())
    dtype, fields = layout_of(make, layout)
    pieces = np.dtype(
        {
            'names': ['xyz', 'block'],
            'formats': [('<f4', 3), ('<f8', n + len(upper[0]) + m)],
            'offsets': [0, 12],
            'itemsize': dtype.itemsize,
        }
    )
    inexact = tuple(name for name, kind, _ in extras if kind.kind == 'f')
    flat = not any(shape for _, _, shape in extras)
    return _Plan(dtype, fields, pieces, upper, inexact, flat)


def read_estimate(message: Any) -> Estimate:
    """Read what `write_estimate` wrote, or a table of truth.

    Columns without a covariance, as in truth, come back as extras. Raises `Rejection`.
    """
    columns = decode_table(message)
    try:
        return Estimate.from_columns(columns, **head_of(message))
    except (ValueError, KeyError) as error:
        raise Rejection('missing_column', f'not an estimate table: {error}') from None


def write_odometry(estimate: Estimate, row: int, make: Make) -> Any:
    """Write one diver as nav_msgs/Odometry.

    The child frame ``diver_<track_id>`` is aligned with the world, so the twist is the velocity in
    the world, and orientation and turn rates are exact: `ALIGNED`. z and its rate, where the
    tracker does not estimate them, have the variance `NOT_ESTIMATED`: displays draw it.
    """
    axes = 'xyz' if 'pz' in estimate.state_names else 'xy'
    at, moving = ([estimate.state_names.index(f'{kind}{axis}') for axis in axes] for kind in 'pv')
    place, velocity = np.zeros(3), np.zeros(3)
    place[: len(at)], velocity[: len(at)] = estimate.state[row, at], estimate.state[row, moving]
    if len(at) == 2:
        place[2] = estimate.xyz[row, 2]
    covariance = estimate.covariance[row]
    track_id = int(estimate.extras['track_id'][row]) if 'track_id' in estimate.extras else row
    return make(
        'nav_msgs/msg/Odometry',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        child_frame_id=f'diver_{track_id}',
        pose=make_stated_pose(place, _six(covariance[np.ix_(at, at)]), make),
        twist=make_stated_twist(velocity, _six(covariance[np.ix_(moving, moving)]), make),
    )


def write_model_probabilities(
    estimate: Estimate, row: int, make: Make, sums: Sequence[str] = ()
) -> Any:
    """Write one row's model probabilities as JointState: name = model, position = probability;
    behind the models those `sums` that the estimate has among its extras: sums of the models, or
    the probabilities of others, whose columns begin with ``prob_``.

    JointState is borrowed because every plotting tool shows its values by name.
    """
    sums = [name for name in sums if name in estimate.extras]
    values = [float(estimate.extras[name][row]) for name in sums]
    return make(
        'sensor_msgs/msg/JointState',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        name=[*estimate.model_names, *(name.removeprefix('prob_') for name in sums)],
        position=np.append(np.asarray(estimate.probabilities[row], np.float64), values),
    )


def write_model_shares(estimate: Estimate, make: Make) -> Any:
    """Write how large a share of the valid rows each model is the most probable one of, as
    JointState like `write_model_probabilities`; zeros without a valid row."""
    valid = np.asarray(estimate.extras['valid'], bool)
    labels = estimate.probabilities[valid].argmax(axis=1)
    count = np.bincount(labels, minlength=len(estimate.model_names))
    return make(
        'sensor_msgs/msg/JointState',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        name=list(estimate.model_names),
        position=count / max(len(labels), 1),
    )


def _six(block: np.ndarray) -> np.ndarray:
    """Put a covariance (2, 2) of x and y, or (3, 3), into the (6, 6) of ROS."""
    covariance = np.diag([NOT_ESTIMATED] * 3 + [ALIGNED] * 3)
    covariance[: len(block), : len(block)] = block
    return covariance
