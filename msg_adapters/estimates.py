"""Estimates as messages.

The PointCloud2 table of ``~/estimate`` is the lossless contract and reads back bit for bit.
Odometry and JointState are views of one row for displays and plots; Odometry has no room for the
covariance between position and velocity.
"""

from __future__ import annotations

from typing import Any

import numpy as np

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
    """Read what `write_estimate` wrote, or a table of truth.

    Columns without a covariance, as in truth, come back as extras. Raises `Rejection`.
    """
    columns = decode_table(message)
    require_columns(columns, ('x', 'y', 'z'), 'estimates')
    try:
        return Estimate.from_columns(
            columns, stamp_ns=stamp_ns(message), frame_id=str(message.header.frame_id)
        )
    except (ValueError, KeyError) as error:
        raise Rejection('missing_column', f'not an estimate table: {error}') from None


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


def _planar(block: np.ndarray) -> np.ndarray:
    """Put an x-y covariance (2, 2) into the 36 numbers of ROS."""
    covariance = np.diag(np.full(6, UNKNOWN_VARIANCE))
    covariance[:2, :2] = block
    return covariance.ravel()
