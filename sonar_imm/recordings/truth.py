"""Truth as messages, below the topic ``/truth``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msg_adapters.estimates import write_true_profile, write_true_reflectors, write_truth
from msg_adapters.table import encode_table

from ..simulation.obstacle.simulator import TrueObstacle
from ..simulation.scene import TrueProfile, TrueReflectors, TrueTrack
from .conversion import Record
from .messages import ros_message

TRUTH_TOPIC = '/truth/estimate'


def track_records(
    stamps: NDArray[np.int64], position: NDArray, velocity: NDArray, track_id: int, frame_id: str
) -> list[Record]:
    """One truth message per stamp, of one target."""
    return [
        (
            int(stamp),
            TRUTH_TOPIC,
            write_truth(
                [place],
                [speed],
                [track_id],
                stamp_ns=int(stamp),
                frame_id=frame_id,
                make=ros_message,
            ),
        )
        for stamp, place, speed in zip(stamps, position, velocity)
    ]


def true_track_records(track: TrueTrack, frame_id: str) -> list[Record]:
    """One truth message per stamp."""
    return track_records(track.stamp_ns, track.position, track.velocity, track.track_id, frame_id)


def profile_record(profile: TrueProfile) -> Record:
    """The message of a true profile, below ``/truth``."""
    columns = {
        'range': profile.range,
        'height': profile.height,
        'angle': profile.angle,
        'patch': profile.patch,
        'valid': profile.valid,
    }
    message = write_true_profile(
        profile.xyz,
        columns,
        stamp_ns=profile.stamp_ns,
        frame_id=profile.frame_id,
        make=ros_message,
    )
    prefix, name = TRUTH_TOPIC.rsplit('/', 1)
    return profile.stamp_ns, prefix + namespaced(profile.namespace, f'/{name}'), message


def reflectors_record(true: TrueReflectors) -> Record:
    """The message of the true reflectors of one record."""
    message = write_true_reflectors(
        true.depth,
        true.amplitude,
        true.track_id,
        stamp_ns=true.stamp_ns,
        frame_id=true.frame_id,
        make=ros_message,
    )
    return true.stamp_ns, TRUTH_TOPIC, message


def namespaced(namespace: str, topic: str) -> str:
    return f'/{namespace}{topic}' if namespace else topic


def true_obstacle_records(true: TrueObstacle, frame_id: str) -> list[Record]:
    """One truth message per ping: the position on the map and relative to the sonar."""
    place = {name: np.array([value], np.float32) for name, value in zip('xyz', true.position)}
    records: list[Record] = []
    for k, stamp in enumerate(true.stamp_ns):
        columns = {
            **place,
            'range': true.range[k : k + 1],
            'bearing': true.bearing[k : k + 1],
            'vertical_offset': true.vertical_offset[k : k + 1],
            'in_beam': true.in_beam[k : k + 1],
            'track_id': np.array([true.track_id], np.uint32),
        }
        records.append(
            (
                int(stamp),
                TRUTH_TOPIC,
                encode_table(columns, stamp_ns=int(stamp), frame_id=frame_id, make=ros_message),
            )
        )
    return records
