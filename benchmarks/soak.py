# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A day at sea, as fast as it can be computed: does memory grow, does anything become slower?

    python -m benchmarks.soak --out docs/results/soak.json            # every tracker, 24 h
    python -m benchmarks.soak --live --hours 1 --out FILE             # every node in lock-step
    python -m benchmarks.soak --only diver --hours 2

The messages of a shipped recording are sent again and again, their stamps moved on, until so many
hours have passed by their stamps. Told are the slope of the resident memory against those hours
with the 95 % interval of Theil and Sen, after the first tenth, in which caches fill; CPU time per
message (live: delay) in the first and in the last tenth; and whether what was counted is what was
sent. Each run is a process of its own; those that are in the file already are not made again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
import itertools
from pathlib import Path
import sys
import time
from typing import Any

import numpy as np
from scipy.stats import theilslopes

from benchmarks.study import in_fresh_process, known, Parts, ROOT, study
from msg_adapters.inputs import inputs_of
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.measurements import fitting_topics
from sonar_imm_tools.recordings.reader import BagReader

SECOND = 10**9
SAMPLES = 200
"""Readings of the resident memory."""
BAGS = {
    # recording, input that estimates are made of, seconds between its messages; None: as recorded
    'diver': ('diver_table1', 'fix', None),
    'obstacle': ('obstacle_movers', 'detections', None),
    'bathymetry': ('bathymetry_paper', 'snapshot', 2.0),
    'fathometer': ('fathometer_drift', 'trace', 20.0),
}


def recorded(system: str) -> tuple[list[tuple[str, Any]], float, float]:
    """Messages of the recording by input, its length in s, and how far stamps are spread."""
    name, primary, period = BAGS[system]
    names = {entry.name for entry in inputs_of(system)}
    with BagReader(ROOT / 'bags' / name) as bag:
        wanted = {t.name: t.name.lstrip('/') for t in bag.topics if t.name.lstrip('/') in names}
        inputs = fitting_topics(bag, system, wanted)
        messages = [(inputs[item.topic].name, item) for item in bag.messages([*inputs])]
    stamps = [_stamp_ns(item.message) for topic, item in messages if topic == primary]
    own = (stamps[-1] - stamps[0]) / (len(stamps) - 1) / SECOND
    spread = 1.0 if period is None else period / own
    length = (stamps[-1] - stamps[0]) / SECOND * spread + own * spread
    return messages, length, spread


def stamps_of(system: str, hours: float) -> Iterator[tuple[str, Any, int]]:
    """Input, message of the recording and stamp to give it, for so many hours."""
    messages, length, spread = recorded(system)
    first = _stamp_ns(messages[0][1].message)
    for turn in itertools.count():
        if turn * length > hours * 3600.0:
            return
        for topic, item in messages:
            after = (_stamp_ns(item.message) - first) * spread + turn * length * SECOND
            yield topic, item, first + round(after)


def offline(system: str, hours: float) -> dict[str, float]:
    """The tracker itself, in this process."""
    config = SYSTEMS[system].config_type()()
    tracker = SYSTEMS[system].build(config)
    tracker.warm()
    readers = {
        entry.name: (tuple(entry.readers), entry.reader(next(iter(entry.readers)), 'enu', {}))
        for entry in inputs_of(system)
    }
    total = sum(1 for _ in stamps_of(system, hours))
    times, memory = np.empty(total), []
    for k, (topic, item, stamp_ns) in enumerate(stamps_of(system, hours)):
        measurement = readers[topic][1](_at(item.message, stamp_ns))
        start = time.process_time()
        tracker.process(measurement)
        times[k] = time.process_time() - start
        if k % max(1, total // SAMPLES) == 0:
            memory.append((k / total * hours, _resident_mb('self')))
    counted = sum(tracker.counts[name] for name in ('used', 'duplicate', 'too_late', 'doubted'))
    return summary(memory, times, total, counted if system != 'bathymetry' else total)


def in_node(system: str, hours: float) -> dict[str, float]:
    """The node as a process of its own, in lock-step."""
    from rclpy.serialization import deserialize_message

    from sonar_imm.nodes.messages import message_class
    from sonar_imm.nodes.qos import lockstep_qos
    from sonar_imm_tools.replay.harness import (
        local_discovery,
        NodeProcess,
        reserved_domain_id,
        START_LIMIT,
    )
    from sonar_imm_tools.replay.link import Link
    from sonar_imm_tools.replay.lockstep import LockStep

    arguments, publishers = [], {}
    for topic in {topic for topic, _ in recorded(system)[0]}:
        for policy in ('history:=keep_all', 'reliability:=reliable'):
            arguments += ['-p', f'qos_overrides./{topic}.subscription.{policy}']
    with reserved_domain_id() as domain, contextlib.ExitStack() as stack:
        with local_discovery():
            node = stack.enter_context(NodeProcess(system, domain_id=domain, arguments=arguments))
            link = stack.enter_context(Link('soak', domain_id=domain))
        step = LockStep(link, f'/{system}', trouble=node.trouble)
        for topic, item in recorded(system)[0]:
            if topic not in publishers:
                cls = message_class(item.type_name)
                publishers[topic] = link.node.create_publisher(cls, topic, lockstep_qos())
        step.connect(publishers.values(), START_LIMIT)
        total, memory = sum(1 for _ in stamps_of(system, hours)), []
        for k, (topic, item, stamp_ns) in enumerate(stamps_of(system, hours)):
            message = deserialize_message(bytes(item.raw), message_class(item.type_name))
            seconds, nanoseconds = divmod(stamp_ns, SECOND)
            message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
            step.step(publishers[topic], message)
            if k % max(1, total // SAMPLES) == 0:
                memory.append((k / total * hours, _resident_mb(node.process.pid)))
        result = summary(memory, np.array(step.delays), total, step.counts.messages)
        return result | {'exit_code': float(node.stop())}


def summary(
    memory: list[tuple[float, float]], times: np.ndarray, sent: int, counted: int
) -> dict[str, float]:
    """What is told of a run. memory: readings (hours, MB); times: s per message."""
    hours, mb = np.array(memory)[len(memory) // 10 :].T
    slope, _, low, high = theilslopes(mb, hours)
    tenth = max(1, len(times) // 10)
    return {
        'messages': float(sent),
        'uncounted': float(sent - counted),
        'memory_mb': float(mb[-1]),
        'grown_mb': float(mb[-1] - mb[len(mb) // 2]),
        'slope_mb_per_h': float(slope),
        'slope_low': float(low),
        'slope_high': float(high),
        'p99_first_ms': 1e3 * float(np.percentile(times[:tenth], 99)),
        'p99_last_ms': 1e3 * float(np.percentile(times[-tenth:], 99)),
        'p50_first_ms': 1e3 * float(np.percentile(times[:tenth], 50)),
        'p50_last_ms': 1e3 * float(np.percentile(times[-tenth:], 50)),
    }


class _At:
    """A message of a recording with another stamp; all else is read from it."""

    def __init__(self, message: Any, header: Any):
        self._message, self.header = message, header

    def __getattr__(self, name: str) -> Any:
        return getattr(self._message, name)


class _Stamp:
    def __init__(self, stamp_ns: int):
        self.sec, self.nanosec = divmod(stamp_ns, SECOND)


class _Header:
    def __init__(self, frame_id: str, stamp_ns: int):
        self.frame_id, self.stamp = frame_id, _Stamp(stamp_ns)


def _at(message: Any, stamp_ns: int) -> Any:
    return _At(message, _Header(message.header.frame_id, stamp_ns))


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _resident_mb(process: int | str) -> float:
    pages = int(Path(f'/proc/{process}/statm').read_text().split()[1])
    return pages * 4096 / 1e6


def main(
    only: Sequence[str] | None = None,
    hours: float = 24.0,
    live: bool = False,
    out: Path | None = None,
) -> Parts:
    yield (table := known(out))
    failed = []
    for system in only or BAGS:
        if table.get(system, {}).get('hours') == hours:
            continue
        try:
            row = in_fresh_process(in_node if live else offline, system, hours)
        except Exception as error:  # the others go on
            failed.append(f'{system}: the run ended with {error!r}')
        else:
            yield {system: row | {'hours': hours}}
    if failed:
        sys.exit('\n'.join(failed))


if __name__ == '__main__':
    study(
        main,
        only={'action': 'append', 'choices': list(BAGS)},
        live={'help': 'the nodes instead of the trackers'},
    )
