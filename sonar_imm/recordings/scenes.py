"""Simulated scenes as bags.

`MEASUREMENTS` gives the topic and the writer for each class of measurement, `TRUTHS` the writer
for each class of truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from msg_adapters.array_depth import write_array_depth
from msg_adapters.array_records import write_csdm, write_pressure, write_trace
from msg_adapters.arrivals import write_arrivals
from msg_adapters.detections import write_detections
from msg_adapters.fixes import write_fix
from msg_adapters.navigation import write_navigation, write_range
from msg_adapters.snapshots import write_snapshot

from ..measurements import (
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
from ..simulation.obstacle.simulator import TrueObstacle
from ..simulation.scene import Scene, TrueProfile, TrueReflectors, TrueTrack
from .conversion import ConversionReport, Record
from .messages import ros_message
from .truth import (
    namespaced,
    profile_record,
    reflectors_record,
    true_obstacle_records,
    true_track_records,
)
from .writer import BagWriter

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
        topic = namespaced(one.namespace, topic)
        records.append((one.received_ns, topic, write(one.measurement, ros_message)))
    for true in scene.truth:
        records += TRUTHS[type(true)](true, scene.frame_id)
    with BagWriter(out, custom_data=provenance) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1
    return report
