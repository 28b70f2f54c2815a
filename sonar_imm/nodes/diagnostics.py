# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What /diagnostics says of a node, in the shape of diagnostic_updater.

Two entries per node: ``<node>: input`` (rates, silence, refused and lost messages) and
``<node>: tracker`` (what the tracker says of itself, and how long it takes). Everything here is
measured with the steady clock of the machine: under simulated time, paused or looped, silence
still shows. Nothing here knows of subscriptions and clocks; the node tells what happened and when.

From what is found in one period comes a level that a watchdog can use. A value at its limit is now
above and now below it. So a finding counts only after it was there in `RISE` periods in a row, and
is over only after it was gone for `FALL` periods in a row. What is final by itself (an error that
was caught, a silence, which has its own patience) counts at once. A period without a message says
nothing of what only messages show, so that slow sensors count too, beside fast ones as well.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from attrs import define
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import numpy as np

from .ages import Ages
from .qos import Endpoints, latched_qos, output_qos

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)
RISE, FALL = 2, 5
"""Periods of diagnostics, of one second by default."""
_WORSE = (OK, WARN, STALE, ERROR)
"""From good to bad; the numbers of the message are in another order."""
MUCH_LOST = 0.1
_WINDOW = 1000
_PATIENCE = 5.0
"""Mean intervals after which an input that is not needed is said to be gone."""
_AGES = 40
"""Messages of an input in which two clocks are looked for."""
_LEAST_OFFSET = 0.5
"""Seconds between them that are said: less is the way that messages take."""
UNUSED_REASONS = frozenset(
    {
        'doubted',
        'far_from_origin',
        'full',
        'heading_unmeasured',
        'navigation_gap',
        'navigation_missing',
        'no_origin',
        'other_depths',
        'other_frame',
        'position_unmeasured',
        'too_late',
        'unknown_type',
        'vessel_pose_gap',
        'vessel_pose_missing',
    }
)
"""Counts of a tracker that say that a message was of no use."""
UNUSED_HINTS = {
    'too_late': 'too_late (older than the history: a long delay, or clocks that disagree)',
    'doubted': 'doubted (their stamps do not go on from those before)',
}
UNUSED_WINDOW = 10.0
"""Seconds over which the share is taken."""
UNUSED_SHARE, UNUSED_LEAST = 0.1, 5
"""The share, and the number of messages, from which on it is said."""


class Stamp(NamedTuple):
    """The stamp of a message. age: the time of arrival less it, s, from any zero; frame_id: of its
    header; used: whether the message was of use."""

    age: float
    frame_id: str = ''
    used: bool = True


class Meter:
    """Arrivals of messages and time spent on them; times in seconds of the steady clock."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.refused_on: Counter[str] = Counter()
        self.doubted: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.first: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self.stamps: dict[str, deque[Stamp]] = {}
        self.estimates = Ages()
        self._durations: deque[float] = deque(maxlen=_WINDOW)

    def arrived(self, topic: str, now: float) -> None:
        """Note a message on `topic`."""
        self.received[topic] += 1
        self.first.setdefault(topic, now)
        self.last[topic] = now

    def refuse(self, topic: str, reason: str) -> None:
        """Note that a message on `topic` is refused."""
        self.refused[reason] += 1
        self.refused_on[topic] += 1

    def stamped(self, topic: str, stamp: Stamp) -> None:
        """Note the stamp of a message."""
        self.stamps.setdefault(topic, deque(maxlen=_AGES)).append(stamp)

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


def clock_offset(ages: Sequence[float]) -> float:
    """Seconds between two groups of `ages`, messages in the order of their arrival; 0 without.

    Each group has a quarter of them and is narrow beside what lies between the two, and they take
    turns: delays that vary, and a clock that is set once, are something else.
    """
    if len(ages) < _AGES:
        return 0.0
    ordered = np.sort(ages)
    cut = int(np.argmax(np.diff(ordered))) + 1
    low, high = ordered[:cut], ordered[cut:]
    offset = float(np.median(high) - np.median(low))
    turns = int(np.count_nonzero(np.diff(np.asarray(ages) >= high[0])))
    if min(len(low), len(high), turns) < _AGES // 4 or offset < _LEAST_OFFSET:
        return 0.0
    return offset if max(np.ptp(low), np.ptp(high)) < 0.25 * offset else 0.0


def unused_group(stamps: Sequence[Stamp]) -> str:
    """Which of two groups of stamps is of no use, in words; empty where both are used, or neither.

    rclpy does not say who sent a message, so that the group is named by its stamps and, where it
    has a frame of its own, by that.
    """
    ages = np.array([stamp.age for stamp in stamps])
    late = ages > 0.5 * (ages.min() + ages.max())
    groups = [[s for s, in_it in zip(stamps, late == side) if in_it] for side in (True, False)]
    shares = [sum(stamp.used for stamp in group) / len(group) for group in groups]
    if max(shares) < 0.5 or min(shares) >= 0.5:
        return ''
    lost = int(np.argmin(shares))
    frames, others = ({stamp.frame_id for stamp in groups[k]} for k in (lost, 1 - lost))
    named = f", of frame '{min(frames)}'," if frames.isdisjoint(others) else ''
    count = sum(not stamp.used for stamp in groups[lost])
    return (
        f'the publisher of the {("older", "newer")[lost]} stamps{named} is not used ({count} of '
        f'{len(groups[lost])} messages)'
    )


class Finding(NamedTuple):
    """Something that is not as it should be. key: what it is, the same from period to period;
    inputs: whose messages show it, none where those of any do; at_once: it need not be found again
    to count; timed: it can be judged in a period without a message; passing: it is over as soon as
    it is not found."""

    key: str
    level: bytes
    sentence: str
    inputs: frozenset[str] = frozenset()
    at_once: bool = False
    timed: bool = False
    passing: bool = False


@define
class _Known:
    """A finding as it was last; in how many periods it was found, and missed since; whether it
    counts."""

    finding: Finding
    found: int = 0
    missed: int = 0
    counts: bool = False


class Hysteresis:
    """Decides which findings count, once a period."""

    def __init__(self, rise: int = RISE, fall: int = FALL):
        self._rise, self._fall = rise, fall
        self._known: dict[tuple[str, bytes], _Known] = {}

    def settle(self, findings: Iterable[Finding], heard: Collection[str]) -> list[Finding]:
        """The findings that count now, the worst first. heard: inputs with a message since the
        last time; where none of them could show a finding, that it is not there says nothing. One
        that is just not there keeps its last sentence until it is over."""
        now = {(finding.key, finding.level): finding for finding in findings}
        for name, finding in now.items():
            known = self._known.setdefault(name, _Known(finding))
            known.finding, known.found, known.missed = finding, known.found + 1, 0
            known.counts |= finding.at_once or known.found >= self._rise
        for name in self._known.keys() - now.keys():
            known = self._known[name]
            finding = known.finding
            shown = finding.inputs & set(heard) if finding.inputs else heard
            if not shown and not (known.counts and (finding.timed or finding.passing)):
                continue
            known.missed += 1
            if not known.counts or finding.passing or known.missed >= self._fall:
                del self._known[name]
        counting = [known.finding for known in self._known.values() if known.counts]
        return sorted(counting, key=lambda finding: -_WORSE.index(finding.level))


def worst(levels: Iterable[bytes]) -> bytes:
    """The worst of some levels: OK, WARN, STALE, ERROR."""
    return max(levels, key=_WORSE.index, default=OK)


def level_and_text(findings: list[Finding], otherwise: str) -> tuple[bytes, str]:
    """The level of a status and its text."""
    text = '; '.join(dict.fromkeys(finding.sentence for finding in findings))
    return worst(finding.level for finding in findings), text or otherwise


def summary(name: str, parts: Iterable[DiagnosticStatus]) -> DiagnosticStatus:
    """One status for a node: the worst level of its `parts`, and the sentences behind it."""
    parts = list(parts)
    level = worst(part.level for part in parts)
    text = '; '.join(dict.fromkeys(part.message for part in parts if part.level == level))
    pairs = [(part.name.rpartition(': ')[2], part.message) for part in parts]
    return DiagnosticStatus(
        level=level,
        name=name,
        message=text,
        hardware_id='sonar_imm',
        values=[KeyValue(key=key, value=value) for key, value in pairs],
    )


class UnusedShare:
    """The share of the messages of the last seconds that the tracker could not use, and why.

    Single messages are lost at sea all the time. When a tenth of them is, something is set up
    wrongly: clocks that disagree, a sensor in another frame, a tracker without navigation.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, int, Counter[str]]] = deque()

    def forget(self) -> None:
        """Begin anew: what came before says nothing about what comes."""
        self._past.clear()

    def sentence(self, now: float, received: int, counts: Mapping[str, int]) -> str:
        """What to say, nothing where all is well. now: steady s; received, counts: so far."""
        unused = Counter({name: n for name, n in counts.items() if name in UNUSED_REASONS})
        self._past.append((now, received, unused))
        while len(self._past) > 1 and self._past[1][0] <= now - UNUSED_WINDOW:
            self._past.popleft()
        then, before, then_unused = self._past[0]
        fresh, lost = received - before, unused - then_unused
        if lost.total() < max(UNUSED_LEAST, UNUSED_SHARE * fresh):
            return ''
        reasons = ', '.join(UNUSED_HINTS.get(name, name) for name, _ in lost.most_common(3))
        share = 100.0 * min(1.0, lost.total() / max(fresh, 1))
        return f'{share:.0f} % of the messages of the last {now - then:.0f} s not used: {reasons}'


class _Totals(NamedTuple):
    """Steady seconds of a report, NaN before the first, and messages until then."""

    now: float = np.nan
    received: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    refused_on: Counter[str] = Counter()
    dropped: int = 0
    lost: Counter[str] = Counter()


class _Period(NamedTuple):
    """What happened since the report before. now: steady s; elapsed: s, NaN in the first one;
    fresh, refused, refused_on, missing: messages by topic or reason; stale: sentences about what
    does not come."""

    now: float
    elapsed: float
    fresh: Counter[str]
    refused: Counter[str]
    refused_on: Counter[str]
    dropped: int
    missing: Counter[str]
    stale: Sequence[str]
    enabled: bool


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
        see `Hysteresis`.
        """
        self._name = name
        self._topics = dict(topics)
        self._needed = [(name,) for name in required] + ([tuple(one_of)] if one_of else [])
        self._meter = meter
        self._before = _Totals()
        self._of_input, self._of_tracker = Hysteresis(rise, fall), Hysteresis(rise, fall)
        self.unused = UnusedShare()

    def report(
        self,
        stamp: Any,
        now: float,
        *,
        enabled: bool,
        stale_after: float,
        max_age: float = 0.0,
        starting: str = '',
        counts: Mapping[str, int],
        health: Mapping[str, float],
        warnings: Sequence[str] = (),
        lost: Mapping[str, int],
        incompatible: Mapping[str, str],
        publishers: Callable[[str], Sequence[str]] = lambda topic: (),
    ) -> DiagnosticArray:
        """Write both entries. stamp: builtin_interfaces/Time; now: steady seconds; max_age: see
        `Ages.report`; starting: why no input is heard yet, or empty; publishers: the names of
        those of a topic."""
        meter, before = self._meter, self._before
        totals = self._before = _Totals(
            now,
            meter.received.copy(),
            meter.refused.copy(),
            meter.refused_on.copy(),
            meter.dropped.total(),
            Counter(lost),
        )
        period = _Period(
            now,
            max(now - before.now, 1e-9),  # NaN stays
            totals.received - before.received,
            totals.refused - before.refused,
            totals.refused_on - before.refused_on,
            totals.dropped - before.dropped,
            totals.lost - before.lost,
            [starting] if starting else self._stale(now, stale_after),
            enabled,
        )
        unused = self.unused.sentence(now, meter.received.total(), counts)
        sentences = [*warnings, *filter(None, [unused])]
        message = DiagnosticArray()
        message.header.stamp = stamp
        message.status = [
            self._input_status(period, stale_after, lost, incompatible, publishers),
            self._tracker_status(period, starting, counts, health, sentences, max_age),
        ]
        return message

    def _stale(self, now: float, stale_after: float) -> list[str]:
        """Sentences about what is needed and does not come."""
        sentences, last = [], self._meter.last
        for names in self._needed:
            arrived = [name for name in names if name in last]
            silence = now - max((last[name] for name in arrived), default=-np.inf)
            where = ' or '.join(self._topics[name] for name in arrived or names)
            if not arrived:
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
        period: _Period,
        stale_after: float,
        lost: Mapping[str, int],
        incompatible: Mapping[str, str],
        publishers: Callable[[str], Sequence[str]],
    ) -> DiagnosticStatus:
        meter, now, fresh, refused = self._meter, period.now, period.fresh, period.refused
        values: dict[str, Any] = {}
        for name, topic in self._topics.items():
            values[f'{name} topic'] = topic
            values[f'{name} received'] = meter.received[name]
            values[f'{name} rate [Hz]'] = fresh[name] / period.elapsed
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
            Finding(silence.split(' for ')[0], STALE, silence, at_once=True, passing=True)
            for silence in period.stale
        ]
        if refused:
            every = refused.total() >= fresh.total()
            which = 'every message is' if every else 'messages are'
            sentence = f'{which} refused: {_most(refused)}'
            # A period of all beside one of some: at least some are refused in both.
            levels = (WARN, ERROR) if every else (WARN,)
            inputs = frozenset(period.refused_on)
            found += [Finding('refused', level, sentence, inputs) for level in levels]
        if period.missing:
            many = period.missing.total() > max(2, MUCH_LOST * fresh.total())
            sentence = _share_lost(period.missing, fresh)
            inputs = frozenset(name.lstrip('~/') for name in period.missing)
            found.append(Finding('lost', WARN, sentence, inputs, at_once=many))
        if incompatible:
            sentence = 'a peer has an incompatible quality of service'
            found.append(Finding('incompatible', WARN, sentence, timed=True))
        for name, stamps in meter.stamps.items():
            offset = clock_offset([stamp.age for stamp in stamps])
            if offset and len(senders := publishers(topic := self._topics[name])) > 1:
                values[f'{name} offset of stamps [s]'] = offset
                # OK: what comes by way of a modem is as late as that, and stamped rightly.
                sentence = (
                    f'stamps on {topic} are of two groups {offset:.1f} s apart: the clocks of its '
                    f'publishers {" and ".join(sorted(senders))} disagree, or one is later'
                )
                if unused := unused_group(stamps):
                    sentence += f'; {unused}'
                found.append(Finding(f'clocks {name}', OK, sentence, timed=True))
        if not period.stale:
            gone = self._gone(now, stale_after)
            found += [Finding(f'gone {name}', WARN, text, timed=True) for name, text in gone]
        counting = self._of_input.settle(found, fresh)
        level, text = level_and_text(counting, 'receiving')
        if not period.enabled:
            text += ' (disabled, input is not used)'
        return self._status('input', level, text, values)

    def _tracker_status(
        self,
        period: _Period,
        starting: str,
        counts: Mapping[str, int],
        health: Mapping[str, float],
        warnings: Sequence[str],
        max_age: float,
    ) -> DiagnosticStatus:
        stale, enabled, dropped = period.stale, period.enabled, period.dropped
        rate = (period.fresh + period.missing).total() / period.elapsed
        p50, p99 = self._meter.compute_ms()
        values: dict[str, Any] = {f'count: {reason}': n for reason, n in sorted(counts.items())}
        values |= dict(health)
        values |= {'compute time p50 [ms]': p50, 'compute time p99 [ms]': p99}
        ages = self._meter.estimates.report(period.now, max_age)
        values |= ages.values
        found = [Finding(_wording(warning), WARN, warning) for warning in warnings]
        if stale and enabled:
            sentence = starting or f'waiting for input: {stale[0]}'
            found.append(Finding('stale', STALE, sentence, at_once=True, passing=True))
        if ages.slow:
            lost = self._before.lost.total() + self._before.dropped
            of = self._before.received.total() + self._before.lost.total()
            share = f'; {lost:,} of {of:,} messages lost' if lost else ''
            found.append(Finding('old', WARN, ages.slow + share, timed=True))
        if ages.clock:
            # OK: recordings are played, and only you can know which clock is right.
            found.append(Finding('clock', OK, ages.clock, timed=True))
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
        counting = self._of_tracker.settle(found, period.fresh)
        level, text = level_and_text(counting, 'tracking' if enabled else 'disabled')
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
        self._summary = endpoints.advertise(DiagnosticStatus, '~/health', latched_qos())

    def publish(self, message: DiagnosticArray) -> None:
        self._all.publish(message)
        self.health = summary(self._name, message.status)
        self._summary.publish(self.health)


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
