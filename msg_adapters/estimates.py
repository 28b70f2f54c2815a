"""Estimates as messages.

The PointCloud2 table of ``~/estimate`` is the lossless contract and reads back bit for bit.
Odometry and JointState are views of one row for displays and plots; Odometry has no room for the
covariance between position and velocity.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Rejection

from .fixes import UNKNOWN_VARIANCE
from .headers import Make, make_header, stamp_ns
from .table import decode_table, encode_table, require_columns


def write_estimate(estimate: Estimate, make: Make) -> Any:
    """Write the PointCloud2 table of ``~/estimate``, one row per target; it may have no rows."""
    return encode_table(
        estimate.columns(), stamp_ns=estimate.stamp_ns, frame_id=estimate.frame_id, make=make
    )


def read_estimate(message: Any) -> Estimate:
    """Read what `write_estimate` or `write_truth` wrote.

    Columns without a covariance, as in a truth table, come back as extras. Raises `Rejection`.
    """
    columns = decode_table(message)
    require_columns(columns, ('x', 'y', 'z'), 'estimates')
    try:
        return Estimate.from_columns(
            columns, stamp_ns=stamp_ns(message), frame_id=str(message.header.frame_id)
        )
    except (ValueError, KeyError) as error:
        raise Rejection('missing_column', f'not an estimate table: {error}') from None


def write_truth(
    position: ArrayLike,
    velocity: ArrayLike,
    track_id: ArrayLike,
    *,
    stamp_ns: int,
    frame_id: str,
    make: Make,
) -> Any:
    """Write the truth at one stamp as the table ``x y z px py vx vy track_id``.

    position: (n, 2) or (n, 3) metres; velocity: (n, 2) m/s, NaN where unknown; track_id: (n,).
    """
    place = np.asarray(position, np.float64)
    speed = np.asarray(velocity, np.float64)
    xyz = np.zeros((len(place), 3), np.float32)
    xyz[:, : place.shape[1]] = place
    columns: dict[str, NDArray] = dict(zip('xyz', xyz.T))
    columns.update(
        px=place[:, 0],
        py=place[:, 1],
        vx=speed[:, 0],
        vy=speed[:, 1],
        track_id=np.asarray(track_id, np.uint32),
    )
    return encode_table(columns, stamp_ns=stamp_ns, frame_id=frame_id, make=make)


def write_true_profile(
    xyz: ArrayLike, columns: Mapping[str, ArrayLike], *, stamp_ns: int, frame_id: str, make: Make
) -> Any:
    """Write the true floor under one ping, one row per range bin: ``x y z``, then `columns`.

    xyz: (n, 3) metres; columns: (n,) each, ``range height angle`` as f8, ``patch valid`` as u1.
    """
    table: dict[str, NDArray] = dict(zip('xyz', np.asarray(xyz, np.float32).reshape(-1, 3).T))
    table.update((name, np.asarray(values)) for name, values in columns.items())
    return encode_table(table, stamp_ns=stamp_ns, frame_id=frame_id, make=make)


def write_true_reflectors(
    depth: ArrayLike,
    amplitude: ArrayLike,
    track_id: ArrayLike,
    *,
    stamp_ns: int,
    frame_id: str,
    make: Make,
) -> Any:
    """Write the true reflectors of one record as the table ``x y z depth amplitude track_id``.

    depth: (K,) metres, down positive; amplitude, track_id: (K,). It may have no rows.
    """
    z = -np.asarray(depth, np.float64)
    zero = np.zeros(len(z), np.float32)
    columns = {
        'x': zero,
        'y': zero,
        'z': z.astype(np.float32),
        'depth': -z,
        'amplitude': np.asarray(amplitude, np.float64),
        'track_id': np.asarray(track_id, np.uint32),
    }
    return encode_table(columns, stamp_ns=stamp_ns, frame_id=frame_id, make=make)


def write_odometry(estimate: Estimate, row: int, make: Make) -> Any:
    """Write one diver as nav_msgs/Odometry.

    The orientation is the identity and the child frame ``diver_<track_id>`` is aligned with the
    world, so the twist is the velocity in the world. What is not estimated (z, attitude, turn
    rates) has a large variance, not zero.
    """
    index = [estimate.state_names.index(name) for name in ('px', 'py', 'vx', 'vy')]
    px, py, vx, vy = (float(value) for value in estimate.state[row, index])
    covariance = estimate.covariance[row][np.ix_(index, index)]
    track_id = int(estimate.extras['track_id'][row]) if 'track_id' in estimate.extras else row
    pose = make(
        'geometry_msgs/msg/Pose',
        position=make('geometry_msgs/msg/Point', x=px, y=py, z=float(estimate.xyz[row, 2])),
        orientation=make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0),
    )
    twist = make(
        'geometry_msgs/msg/Twist',
        linear=make('geometry_msgs/msg/Vector3', x=vx, y=vy, z=0.0),
        angular=make('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0),
    )
    return make(
        'nav_msgs/msg/Odometry',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        child_frame_id=f'diver_{track_id}',
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose,
            covariance=_planar(covariance[:2, :2]),
        ),
        twist=make(
            'geometry_msgs/msg/TwistWithCovariance',
            twist=twist,
            covariance=_planar(covariance[2:, 2:]),
        ),
    )


def write_model_probabilities(estimate: Estimate, row: int, make: Make) -> Any:
    """Write one row's model probabilities as JointState: name = model, position = probability.

    JointState is borrowed because every plotting tool shows its values by name.
    """
    return make(
        'sensor_msgs/msg/JointState',
        header=make_header(estimate.stamp_ns, estimate.frame_id, make),
        name=list(estimate.model_names),
        position=np.asarray(estimate.probabilities[row], np.float64),
    )


def _planar(block: np.ndarray) -> np.ndarray:
    """Put an x-y covariance (2, 2) into the 36 numbers of ROS."""
    covariance = np.diag(np.full(6, UNKNOWN_VARIANCE))
    covariance[:2, :2] = block
    return covariance.ravel()
