# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulated scenes as bags: each measurement on the input topic of its tracker."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msg_adapters.inputs import inputs_of, InputTopic, made_inputs
from sonar_imm.trackers import SYSTEMS
from sonar_imm.truth import Scene

from .conversion import ConversionReport, Record
from .messages import ros_message
from .truth import namespaced, records_of
from .writer import BagWriter


def write_scene(
    scene: Scene,
    out: str | Path,
    *,
    provenance: dict[str, str],
    compressed: bool = False,
    parameters: Mapping[str, Mapping[str, Any]] | None = None,
) -> ConversionReport:
    """Write measurements and truth, in the order of reception, and the `parameters` of the
    instruments by the names of nodes. Raises `BagError`."""
    report = ConversionReport(Path(out))
    inputs: dict[type, InputTopic] = {}
    for system in SYSTEMS:
        for entry in (*inputs_of(system), *made_inputs(system)):
            for measurement in entry.measurements:
                inputs.setdefault(measurement, entry)
    records: list[Record] = []
    for item in scene.measurements:
        entry = inputs[type(item.measurement)]
        topic = namespaced(item.namespace, f'/{entry.name}')
        records.append((item.received_ns, topic, entry.write(item.measurement, ros_message)))
    for true in scene.truth:
        records += records_of(true, scene.frame_id)
    images = any(inputs[type(item.measurement)].makes for item in scene.measurements)
    with BagWriter(
        out, compressed=compressed or images, custom_data=provenance, parameters=parameters
    ) as bag:
        for log_ns, topic, message in sorted(records, key=lambda record: record[0]):
            bag.write(topic, message, log_ns)
            report.messages[topic] += 1
    return report
