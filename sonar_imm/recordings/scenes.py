"""Simulated scenes as bags.

What a scene holds is told apart by its class: `MEASUREMENTS` says on which topic a measurement
goes and who writes it, `TRUTHS` how the truth becomes messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from msg_adapters.arrivals import write_arrivals
from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Arrivals, Fix
from sonar_imm.simulation.scene import Scene, TrueTrack

from .conversion import ConversionReport, Record
from .convert_truth import track_records
from .messages import ros_message
from .writer import BagWriter


def true_track_records(track: TrueTrack, frame_id: str) -> list[Record]:
    """One truth message a stamp."""
    return track_records(
        track.stamp_ns, track.position, track.velocity, track.track_id, frame_id
    )


MEASUREMENTS: dict[type, tuple[str, Callable[..., Any]]] = {
    Fix: ('/fix', write_fix),
    Arrivals: ('/arrivals', write_arrivals),
}
"""Topic and writer ``(measurement, make) -> message`` by class of measurement."""

TRUTHS: dict[type, Callable[[Any, str], Iterable[Record]]] = {
    TrueTrack: true_track_records,
}
"""Writer ``(truth, frame_id) -> records`` by class of truth."""


def write_scene(scene: Scene, out: str | Path, *, provenance: dict[str, str]) -> ConversionReport:
    """Write measurements and truth, in the order of reception. Raises `BagError`."""
    report = ConversionReport(Path(out))
    records: list[Record] = []
    for one in scene.measurements:
        topic, write = MEASUREMENTS[type(one.measurement)]
        records.append((one.received_ns, topic, write(one.measurement, ros_message)))
    for true in scene.truth:
        records += TRUTHS[type(true)](true, scene.frame_id)
    with BagWriter(out, custom_data=provenance) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1
    return report
