"""Simulated scenes as bags."""

from __future__ import annotations

from pathlib import Path

from msg_adapters.arrivals import write_arrivals
from msg_adapters.estimates import write_true_profile
from msg_adapters.fixes import write_fix
from msg_adapters.snapshots import write_snapshot
from sonar_imm.measurements import Arrivals, Fix, Snapshot
from sonar_imm.simulation.scene import Scene, TrueProfile

from .conversion import ConversionReport, Record
from .convert_truth import track_records, TRUTH_TOPIC
from .messages import ros_message
from .writer import BagWriter

_WRITERS = {
    Fix: ('/fix', write_fix),
    Arrivals: ('/arrivals', write_arrivals),
    Snapshot: ('/snapshot', write_snapshot),
}


def write_scene(scene: Scene, out: str | Path, *, provenance: dict[str, str]) -> ConversionReport:
    """Write measurements and truth, in the order of reception. Raises `BagError`."""
    report = ConversionReport(Path(out))
    records: list[Record] = []
    for one in scene.measurements:
        topic, write = _WRITERS[type(one.measurement)]
        topic = _namespaced(one.namespace, topic)
        records.append((one.received_ns, topic, write(one.measurement, ros_message)))
    for true in scene.truth:
        if isinstance(true, TrueProfile):
            records.append(profile_record(true))
        else:
            records += track_records(
                true.stamp_ns, true.position, true.velocity, true.track_id, scene.frame_id
            )
    with BagWriter(out, custom_data=provenance) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] = report.messages.get(topic, 0) + 1
    return report


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


def _namespaced(namespace: str, topic: str) -> str:
    return f'/{namespace}{topic}' if namespace else topic
