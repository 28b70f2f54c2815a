"""Simulated scenes as bags.

What a scene holds is told apart by its class: `MEASUREMENTS` says on which topic a measurement
goes and who writes it, `TRUTHS` how the truth becomes messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.array_depth import write_array_depth
from msg_adapters.array_records import write_csdm, write_pressure, write_trace
from msg_adapters.arrivals import write_arrivals
from msg_adapters.detections import write_detections
from msg_adapters.estimates import write_true_profile, write_true_reflectors
from msg_adapters.fixes import write_fix
from msg_adapters.navigation import write_navigation, write_range
from msg_adapters.snapshots import write_snapshot
from msg_adapters.table import encode_table
from sonar_imm.measurements import (
    Altitude,
    ArrayDepth,
    Arrivals,
    CrossSpectra,
    Detections,
    Fix,
    Navigation,
    Pressure,
    Snapshot,
    Trace,
)
from sonar_imm.simulation.obstacle import TrueObstacle
from sonar_imm.simulation.scene import Scene, TrueProfile, TrueReflectors, TrueTrack

from .conversion import ConversionReport, Record
from .convert_truth import track_records, TRUTH_TOPIC
from .messages import ros_message
from .writer import BagWriter


def true_track_records(track: TrueTrack, frame_id: str) -> list[Record]:
    """One truth message a stamp."""
    return track_records(
        track.stamp_ns, track.position, track.velocity, track.track_id, frame_id
    )


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
    return profile.stamp_ns, prefix + _namespaced(profile.namespace, f'/{name}'), message


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


def _namespaced(namespace: str, topic: str) -> str:
    return f'/{namespace}{topic}' if namespace else topic


def true_obstacle_records(true: TrueObstacle, frame_id: str) -> list[Record]:
    """One truth message a ping: where the obstacle is on the map and seen from the sonar."""
    place = {name: np.array([value], np.float32) for name, value in zip('xyz', true.position)}
    records: list[Record] = []
    for k, stamp in enumerate(true.stamp_ns):
        columns = {**place, 'range': true.range[k:k + 1], 'bearing': true.bearing[k:k + 1],
                   'vertical_offset': true.vertical_offset[k:k + 1],
                   'in_beam': true.in_beam[k:k + 1],
                   'track_id': np.array([true.track_id], np.uint32)}
        records.append((int(stamp), TRUTH_TOPIC, encode_table(
            columns, stamp_ns=int(stamp), frame_id=frame_id, make=ros_message)))
    return records


MEASUREMENTS: dict[type, tuple[str, Callable[..., Any]]] = {
    Fix: ('/fix', write_fix),
    Arrivals: ('/arrivals', write_arrivals),
    Snapshot: ('/snapshot', write_snapshot),
    Detections: ('/detections', write_detections),
    Navigation: ('/nav', write_navigation),
    Altitude: ('/altitude', write_range),
    CrossSpectra: ('/csdm', write_csdm),
    Pressure: ('/pressure', write_pressure),
    Trace: ('/trace', write_trace),
    ArrayDepth: ('/array_depth', write_array_depth),
}
"""Topic and writer ``(measurement, make) -> message`` by class of measurement."""

TRUTHS: dict[type, Callable[[Any, str], Iterable[Record]]] = {
    TrueTrack: true_track_records,
    TrueProfile: lambda profile, frame_id: [profile_record(profile)],
    TrueObstacle: true_obstacle_records,
    TrueReflectors: lambda true, frame_id: [reflectors_record(true)],
}
"""Writer ``(truth, frame_id) -> records`` by class of truth."""


def write_scene(scene: Scene, out: str | Path, *, provenance: dict[str, str]) -> ConversionReport:
    """Write measurements and truth, in the order of reception. Raises `BagError`."""
    report = ConversionReport(Path(out))
    records: list[Record] = []
    for one in scene.measurements:
        topic, write = MEASUREMENTS[type(one.measurement)]
        topic = _namespaced(one.namespace, topic)
        records.append((one.received_ns, topic, write(one.measurement, ros_message)))
    for true in scene.truth:
        records += TRUTHS[type(true)](true, scene.frame_id)
    with BagWriter(out, custom_data=provenance) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1
    return report
