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
``<node>: tracker`` (what the tracker says of itself, and how long it takes). When a finding
becomes a level is decided in `health`. Everything here is
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

from .health import ERROR, FALL, Finding, Hysteresis, RISE, STALE, summary, told, WARN
from .qos import Endpoints, latched_qos, output_qos
from .unused import Unused

MUCH_LOST = 0.1
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
        rise: int = RISE,
        fall: int = FALL,
    ):
        """Report as `name`; `topics` maps input names to resolved topic names.

        required: inputs that are all needed; one_of: inputs of which one is enough. rise, fall:
        see `health.Hysteresis`.
        """
        self._name = name
        self._topics = dict(topics)
        self._needed = [(name,) for name in required] + ([tuple(one_of)] if one_of else [])
        self._meter = meter
        self._before = (None, Counter(), Counter(), 0, Counter())
        self._of_input, self._of_tracker = Hysteresis(rise, fall), Hysteresis(rise, fall)
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
                fresh.total() == 0,
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
        sentences, last = [], self._meter.last
        for names in self._needed:
            heard = [name for name in names if name in last]
            silence = now - max((last[name] for name in heard), default=-np.inf)
            where = ' or '.join(self._topics[name] for name in heard or names)
            if not heard:
                sentences.append(f'no message yet on {where}')
            elif silence > stale_after:
                sentences.append(f'no message for {silence:.1f} s on {where}')
        return sentences

    def _gone(self, now: float, stale_after: float) -> list[tuple[str, str]]:
        """Other inputs that came, and do not any more, and a sentence about each."""
        gone = []
        for name, last in self._meter.last.items():
            limit = max(stale_after, _PATIENCE * self._meter.interval(name))
            if now - last > limit:
                sentence = f'nothing more on {self._topics[name]} for {now - last:.1f} s'
                gone.append((name, sentence))
        return gone

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
        found = [
            Finding(one.split(' for ')[0], STALE, one, at_once=True, passing=True) for one in stale
        ]
        if refused and refused.total() >= fresh.total():
            sentence = f'every message is refused: {_most(refused)}'
            found.append(Finding('refused', ERROR, sentence))
        elif refused:
            sentence = f'messages are refused: {_most(refused)}'
            found.append(Finding('refused', WARN, sentence))
        if missing:
            many = missing.total() > max(2, MUCH_LOST * fresh.total())
            found.append(Finding('lost', WARN, _share_lost(missing, fresh), at_once=many))
        if incompatible:
            sentence = 'a peer has an incompatible quality of service'
            found.append(Finding('incompatible', WARN, sentence, timed=True))
        if not stale:
            gone = self._gone(now, stale_after)
            found += [Finding(f'gone {one}', WARN, text, timed=True) for one, text in gone]
        counting = self._of_input.settle(found, quiet=not fresh)
        level, text = told(counting, 'receiving')
        if not enabled:
            text += ' (disabled, input is not used)'
        return self._status('input', level, text, values)

    def _tracker_status(
        self,
        quiet: bool,
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
        found = [Finding(_wording(one), WARN, one) for one in warnings]
        if stale and enabled:
            sentence = f'waiting for input: {stale[0]}'
            found.append(Finding('stale', STALE, sentence, at_once=True, passing=True))
        if dropped:
            sentence = f'input comes faster than it can be processed: {dropped} messages dropped'
            found.append(Finding('dropped', WARN, sentence, at_once=True))
        elif rate * p50 > 1000.0:
            sentence = 'input comes faster than it can be processed'
            found.append(Finding('slow', WARN, sentence))
        if health.get('moving_alike'):
            sentence = 'most obstacles move alike: navigation may drift'
            found.append(Finding('moving_alike', WARN, sentence))
        if counts.get('internal_error'):
            sentence = 'an internal error was caught, see the log'
            found.append(Finding('internal_error', ERROR, sentence, at_once=True))
        counting = self._of_tracker.settle(found, quiet=quiet)
        level, text = told(counting, 'tracking' if enabled else 'disabled')
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


class Announcer:
    """Publishes what a `Reporter` made: all of it on /diagnostics, and on ``~/health`` one status,
    latched. health: the newest one."""

    def __init__(self, endpoints: Endpoints, name: str):
        self._name = name
        self.health = DiagnosticStatus(level=STALE, name=name, message='starting')
        self._all = endpoints.advertise(DiagnosticArray, '/diagnostics', output_qos())
        self._one = endpoints.advertise(DiagnosticStatus, '~/health', latched_qos())

    def publish(self, message: DiagnosticArray) -> None:
        self._all.publish(message)
        self.health = summary(self._name, message.status)
        self._one.publish(self.health)


def _share_lost(missing: Counter[str], fresh: Counter[str]) -> str:
    shares = ', '.join(
        f'{100 * n / (n + fresh[topic]):.1f} % on {topic}' for topic, n in missing.most_common(3)
    )
    return f'messages are lost before they can be read: {shares}'


def _wording(sentence: str) -> str:
    """What stays of a sentence whose numbers change."""
    return ''.join(letter for letter in sentence if letter.isalpha())[:60]


def _most(refused: Counter[str]) -> str:
    return ', '.join(reason for reason, _ in refused.most_common(3))
