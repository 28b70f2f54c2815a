# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What /diagnostics says of a node, in the shape of diagnostic_updater.

Two entries a node: ``<node>: input`` (rates, silence, refused and lost messages) and
``<node>: tracker`` (what the tracker says of itself, and how long it takes). Everything here is
measured with the steady clock of the machine: under simulated time, paused or looped, silence
still shows.

The class knows nothing of subscriptions and clocks; the node tells it what happened and when.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np

from .unused import Unused

_WINDOW = 1000
_PATIENCE = 5.0
"""Mean intervals after which an input that is not needed is said to be gone."""


class Meter:
    """Arrivals of messages and time spent on them; times in seconds of the steady clock."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.doubted: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.first: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self._durations: deque[float] = deque(maxlen=_WINDOW)

    def arrived(self, topic: str, now: float) -> None:
        """Note a message on `topic`."""
        self.received[topic] += 1
        self.first.setdefault(topic, now)
        self.last[topic] = now

    def interval(self, topic: str) -> float:
        """Mean seconds between the messages on `topic`; 0 where there were less than two."""
        gaps = self.received[topic] - 1
        return (self.last[topic] - self.first[topic]) / gaps if gaps > 0 else 0.0

    def spent(self, seconds: float) -> None:
        """Note how long one message took from the middleware to its last output."""
        self._durations.append(seconds)

    def compute_ms(self) -> tuple[float, float]:
        """Median and 99th percentile of the last messages, ms; NaN without any."""
        if not self._durations:
            return np.nan, np.nan
        p50, p99 = np.percentile(np.fromiter(self._durations, float), (50, 99))
        return 1e3 * float(p50), 1e3 * float(p99)


class Reporter:
    """Turns a `Meter` and the tracker's own numbers into a DiagnosticArray, once a period."""

    def __init__(
        self,
        name: str,
        topics: Mapping[str, str],
        meter: Meter,
        *,
        required: Collection[str] = (),
        one_of: Collection[str] = (),
    ):
        """Report as `name`; `topics` maps input names to resolved topic names.

        required: inputs that are all needed; one_of: inputs of which one is enough.
        """
        self._name = name
        self._topics = dict(topics)
        self._needed = [(name,) for name in required] + ([tuple(one_of)] if one_of else [])
        self._meter = meter
        self._before = (None, Counter(), Counter(), 0, Counter())
        self._unused = Unused()

    def report(
        self,
        stamp: Any,
        now: float,
        *,
        enabled: bool,
        stale_after: float,
        counts: Mapping[str, int],
        health: Mapping[str, float],
        warnings: Sequence[str] = (),
        lost: Mapping[str, int],
        incompatible: Mapping[str, str],
    ) -> DiagnosticArray:
        """Write both entries. stamp: builtin_interfaces/Time; now: steady seconds."""
        then, received_before, refused_before, dropped_before, lost_before = self._before
        meter = self._meter
        elapsed = np.nan if then is None else max(now - then, 1e-9)
        fresh = meter.received - received_before
        refused = meter.refused - refused_before
        dropped = meter.dropped.total()
        missing = Counter(lost) - lost_before
        self._before = (
            now,
            meter.received.copy(),
            meter.refused.copy(),
            dropped,
            Counter(lost),
        )

        stale = self._stale(now, stale_after)
        message = DiagnosticArray()
        message.header.stamp = stamp
        message.status = [
            self._input_status(
                now,
                elapsed,
                fresh,
                refused,
                enabled,
                stale_after,
                lost,
                missing,
                incompatible,
                stale,
            ),
            self._tracker_status(
                (fresh + missing).total() / elapsed,
                dropped - dropped_before,
                enabled,
                counts,
                health,
                [
                    *warnings,
                    *filter(None, [self._unused.sentence(now, meter.received.total(), counts)]),
                ],
                stale,
            ),
        ]
        return message

    def _stale(self, now: float, stale_after: float) -> list[str]:
        """Sentences about what is needed and does not come."""
        told, last = [], self._meter.last
        for names in self._needed:
            heard = [name for name in names if name in last]
            silence = now - max((last[name] for name in heard), default=-np.inf)
            where = ' or '.join(self._topics[name] for name in heard or names)
            if not heard:
                told.append(f'no message yet on {where}')
            elif silence > stale_after:
                told.append(f'no message for {silence:.1f} s on {where}')
        return told

    def _gone(self, now: float, stale_after: float) -> list[str]:
        """Sentences about other inputs that came, and do not any more."""
        told = []
        for name, last in self._meter.last.items():
            limit = max(stale_after, _PATIENCE * self._meter.interval(name))
            if now - last > limit:
                told.append(f'nothing more on {self._topics[name]} for {now - last:.1f} s')
        return told

    def _input_status(
        self,
        now: float,
        elapsed: float,
        fresh: Counter[str],
        refused: Counter[str],
        enabled: bool,
        stale_after: float,
        lost: Mapping[str, int],
        missing: Counter[str],
        incompatible: Mapping[str, str],
        stale: Sequence[str],
    ) -> DiagnosticStatus:
        meter = self._meter
        values: dict[str, Any] = {}
        for name, topic in self._topics.items():
            values[f'{name} topic'] = topic
            values[f'{name} received'] = meter.received[name]
            values[f'{name} rate [Hz]'] = fresh[name] / elapsed
            if meter.dropped[name]:
                values[f'{name} dropped, waited too long'] = meter.dropped[name]
            values[f'{name} silent for [s]'] = now - meter.last.get(name, np.nan)
        values |= {f'refused: {reason}': n for reason, n in sorted(meter.refused.items())}
        values |= {f'doubtful: {reason}': n for reason, n in sorted(meter.doubted.items())}
        values |= {f'lost on {topic}': n for topic, n in sorted(lost.items())}
        values |= {
            f'incompatible peer on {topic}': policy
            for topic, policy in sorted(incompatible.items())
        }
        level, text = DiagnosticStatus.OK, 'receiving'
        if stale:
            level, text = DiagnosticStatus.STALE, '; '.join(stale)
        elif refused and refused.total() >= fresh.total():
            level, text = DiagnosticStatus.ERROR, f'every message is refused: {_most(refused)}'
        elif refused:
            level, text = DiagnosticStatus.WARN, f'messages are refused: {_most(refused)}'
        elif incompatible:
            level, text = DiagnosticStatus.WARN, 'a peer has an incompatible quality of service'
        elif missing:
            level, text = DiagnosticStatus.WARN, _share_lost(missing, fresh)
        elif gone := self._gone(now, stale_after):
            level, text = DiagnosticStatus.WARN, '; '.join(gone)
        if not enabled:
            text += ' (disabled, input is not used)'
        return self._status('input', level, text, values)

    def _tracker_status(
        self,
        rate: float,
        dropped: int,
        enabled: bool,
        counts: Mapping[str, int],
        health: Mapping[str, float],
        warnings: Sequence[str],
        stale: Sequence[str],
    ) -> DiagnosticStatus:
        p50, p99 = self._meter.compute_ms()
        values: dict[str, Any] = {f'count: {reason}': n for reason, n in sorted(counts.items())}
        values |= dict(health)
        values |= {'compute time p50 [ms]': p50, 'compute time p99 [ms]': p99}
        level, text = DiagnosticStatus.OK, 'tracking' if enabled else 'disabled'
        if stale and enabled:
            level, text = DiagnosticStatus.STALE, f'waiting for input: {stale[0]}'
        if warnings:
            level, text = DiagnosticStatus.WARN, '; '.join(warnings)
        if dropped:
            level, text = (
                DiagnosticStatus.WARN,
                (f'input comes faster than it can be processed: {dropped} messages dropped'),
            )
        elif rate * p50 > 1000.0:
            level, text = DiagnosticStatus.WARN, 'input comes faster than it can be processed'
        elif health.get('moving_alike'):
            level, text = DiagnosticStatus.WARN, 'most obstacles move alike: navigation may drift'
        if counts.get('internal_error'):
            level, text = DiagnosticStatus.ERROR, 'an internal error was caught, see the log'
        return self._status('tracker', level, text, values)

    def _status(
        self, part: str, level: bytes, text: str, values: Mapping[str, Any]
    ) -> DiagnosticStatus:
        pairs = [
            KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
            for key, value in values.items()
        ]
        return DiagnosticStatus(
            level=level,
            name=f'{self._name}: {part}',
            message=text,
            hardware_id='sonar_imm',
            values=pairs,
        )


def _share_lost(missing: Counter[str], fresh: Counter[str]) -> str:
    shares = ', '.join(
        f'{100 * n / (n + fresh[topic]):.1f} % on {topic}' for topic, n in missing.most_common(3)
    )
    return f'messages are lost before they can be read: {shares}'


def _most(refused: Counter[str]) -> str:
    return ', '.join(reason for reason, _ in refused.most_common(3))
