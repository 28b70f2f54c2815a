"""Simulated scenes as bags."""

from __future__ import annotations

from pathlib import Path

from msg_adapters.arrivals import write_arrivals
from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Arrivals, Fix
from sonar_imm.simulation.scene import Scene

from .conversion import ConversionReport, Record
from .convert_truth import track_records
from .messages import ros_message
from .writer import BagWriter

_WRITERS = {Fix: ('/fix', write_fix), Arrivals: ('/arrivals', write_arrivals)}


def write_scene(scene: Scene, out: str | Path, *, provenance: dict[str, str]) -> ConversionReport:
    """Write measurements and truth, in the order of reception. Raises `BagError`."""
    report = ConversionReport(Path(out))
    records: list[Record] = []
    for one in scene.measurements:
        topic, write = _WRITERS[type(one.measurement)]
        records.append((one.received_ns, topic, write(one.measurement, ros_message)))
    for track in scene.truth:
        records += track_records(
            track.stamp_ns, track.position, track.velocity, track.track_id, scene.frame_id
        )
    with BagWriter(out, custom_data=provenance) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1
    return report
