# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracking a recording offline: the same readers, the same tracker and the same order as live.

A tracker revises its estimates when late input arrives. Offline only the final estimate of each
stamp is wanted, in order of stamps. `Revisions` holds estimates only while they can still change,
so that memory does not grow with the recording.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
import json
import time
from typing import Any

from attrs import asdict, define, field, frozen
import numpy as np

from msg_adapters.inputs import inputs_of
from msg_adapters.inputs.topic import tag_numbers
from sonar_imm import __version__
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import Config
from sonar_imm.trackers import System

from .. import SECOND
from ..recordings.measurements import fitting_topics, measurements_of, Received
from ..recordings.reader import BagError, BagReader
from ..recordings.sources import TARGET_NAMES
from .initial import Initial, target_numbers
from .jobs import processes
from .run_folder import AS_CSV, fingerprint, finite, RUN, run_record, RunFolder

TO_THE_END = 2**62
AHEAD = 4
"""Tasks of each process that may wait or be done: what bounds the memory of a shared run."""


@frozen(kw_only=True)
class InputOptions:
    """How to treat a recording.

    topics: input by topic name, None to pick what fits by name; smooth: condition each estimate on
    later input too, which takes memory in proportion to the recording. jobs: processes that share
    the work where a tracker can share it; the estimates do not depend on it. detector: parameters
    of the detector of images that are not the default. origin: where the frame of the navigation
    lies on Earth. initial: where divers are said to be.
    """

    topics: Mapping[str, str] | None = None
    order: str = 'recorded'
    world_frame: str = 'enu'
    frame_id: str = ''
    smooth: bool = False
    jobs: int = 1
    detector: Mapping[str, Any] = field(factory=dict)
    origin: Origin | None = None
    initial: tuple[Initial, ...] = ()


@define
class Refused:
    """How many messages were refused for one reason, and the sentence of the first one."""

    count: int
    example: str


OF_HEALTH = (
    'covariance_repairs', 'not_started', 'names_without_track', 'pings_moving_alike',
    'waiting_for_vessel',
)  # fmt: skip
"""What run.json counts of the health of a tracker."""


class Revisions:
    """Holds estimates while they can still be revised; the last one of a stamp, and of each
    instrument, counts.

    window_ns: how far back a late measurement can reach. When the clock was restarted, what is
    held from before is final.
    """

    def __init__(self, window_ns: int):
        self.window_ns = window_ns
        self._held: dict[tuple[int, int], Estimate] = {}

    def add(self, estimates: Iterable[Estimate]) -> list[Estimate]:
        """Add the estimates of one measurement; gives those that became final, oldest first."""
        final: list[Estimate] = []
        for estimate in estimates:
            newest = max(self._held, default=(estimate.stamp_ns, 0))[0]
            if estimate.stamp_ns < newest - self.window_ns:
                final += self.finish()
            self._held[estimate.stamp_ns, estimate.source] = estimate
        if self._held:
            oldest = max(self._held)[0] - self.window_ns
            final += self._release(sorted(key for key in self._held if key[0] < oldest))
        return final

    def finish(self) -> list[Estimate]:
        """Everything still held, oldest first."""
        return self._release(sorted(self._held))

    def _release(self, keys: list[tuple[int, int]]) -> list[Estimate]:
        return [self._held.pop(key) for key in keys]


def final_estimates(estimates: Iterable[Estimate], config: Config) -> list[Estimate]:
    """The final estimate of each stamp out of everything a live tracker of `config` published."""
    revisions = Revisions(window_ns(config))
    final = [each for estimate in estimates for each in revisions.add([estimate])]
    return final + revisions.finish()


def window_ns(config: Config) -> int:
    """How far back later input can change the estimates of a tracker."""
    if getattr(config, 'smoothing_lag', 0):
        return TO_THE_END  # a lag in records, which come at any rate
    return round(getattr(config, 'history', 0.0) * SECOND)


class OfflineRun:
    """One pass of a tracker over an open recording. The counters are complete after `estimates`.

    topics: input by topic name, as used. refused: by reason code. durations: seconds of each call
    of the tracker. Raises `BagError` when no topic fits the tracker.
    """

    def __init__(
        self, bag: BagReader, system: System, config: Config, options: InputOptions | None = None
    ):
        self.options = options or InputOptions()
        self.bag = bag
        self.system = system
        chosen = fitting_topics(bag, system.name, self.options.topics)
        settings = config.as_dict()
        wanted = {name: entry for name, entry in chosen.items() if entry.wanted(settings)}
        self.topics = {name: entry.name for name, entry in wanted.items()}
        entries = {entry.name: entry for entry in inputs_of(system.name)}
        made = [entry.makes or entry.name for entry in wanted.values()]
        self._kinds = {kind for name in made for kind in entries[name].measurements}
        build = system.build_smoother if self.options.smooth else system.build
        self.tracker: Any = build(config.for_inputs(frozenset(self.topics.values())))
        self.refused: dict[str, Refused] = {}
        self.messages = 0
        self.durations = array('d')
        self._window_ns = window_ns(config)
        self._intake = Intake(self.tracker, self.options.frame_id)
        tags = getattr(self.tracker.config, 'tags', ())
        self._names = target_numbers(tags, bag.target_names)
        for place in self.options.initial:
            try:
                place.start(1, self._names)
            except Rejection as rejection:
                raise BagError(f'--initial: {rejection.sentence}') from None

    @property
    def total(self) -> int:
        """How many messages there are to read."""
        return sum(topic.count for topic in self.bag.topics if topic.name in self.topics)

    def estimates(self, advance: Callable[[int], None] = lambda count: None) -> Iterator[Estimate]:
        """Run the tracker; yields final estimates by stamp. `advance` hears of each message."""
        revisions = Revisions(self._window_ns)
        self.system.warm(self.tracker, self._kinds)
        share = self.options.jobs > 1 and hasattr(self.tracker, 'tasks')
        for made in self._shared_out(advance) if share else self._in_turn(advance):
            final = revisions.add(made)
            if not self.options.smooth:
                yield from final
        last = revisions.add(getattr(self.tracker, 'finish', list)()) + revisions.finish()
        if not self.options.smooth:
            yield from last
        elif last:
            yield from self.tracker.smoothed()

    def _in_turn(self, advance: Callable[[int], None]) -> Iterator[list[Estimate]]:
        """What the tracker makes of each measurement."""
        for measurement in self._measurements(advance):
            begin = time.perf_counter()
            made = self.tracker.process(measurement)
            self.durations.append(time.perf_counter() - begin)
            yield made

    def _shared_out(self, advance: Callable[[int], None]) -> Iterator[list[Estimate]]:
        """The same from a tracker whose work falls into tasks that need nothing of each other, so
        that `jobs` processes can do them: ``process(m)`` is ``take(work(task))`` for all of
        ``tasks(m)``, in order. A task can be pickled, and ``work`` needs no tracker."""
        ahead = AHEAD * self.options.jobs
        waiting: deque[Future[tuple[Any, float]]] = deque()
        with processes(self.options.jobs) as pool:
            try:
                for measurement in self._measurements(advance):
                    for task in self.tracker.tasks(measurement):
                        waiting.append(pool.submit(_timed, self.tracker.work, task))
                    while waiting and (len(waiting) > ahead or waiting[0].done()):
                        yield self._taken(waiting.popleft())
                while waiting:
                    yield self._taken(waiting.popleft())
            finally:
                for future in waiting:
                    future.cancel()

    def _taken(self, done: Future[tuple[Any, float]]) -> list[Estimate]:
        found, seconds = done.result()
        self.durations.append(seconds)
        made: list[Estimate] = self.tracker.take(found)
        return made

    def read(self, advance: Callable[[int], None] = lambda count: None) -> Iterator[Received]:
        """Measurements and refusals of the messages, in order; `advance` hears of each message."""
        for item in measurements_of(
            self.bag,
            self.system.name,
            self.topics,
            world_frame=self.options.world_frame,
            order=self.options.order,
            settings=self.tracker.config.as_dict(),
            detector=self.options.detector,
        ):
            self.messages += 1
            advance(1)
            if item.measurement is not None:
                yield item

    def _measurements(self, advance: Callable[[int], None]) -> Iterator[Any]:
        initial = list(self.options.initial)
        for item in self.read(advance):
            measurement = item.measurement
            stamp = getattr(measurement, 'stamp_ns', None)
            if initial and stamp is not None:
                due = [place for place in initial if (place.stamp_ns or 0) <= stamp]
                initial = [place for place in initial if place not in due]
                for place in sorted(due, key=lambda place: place.stamp_ns or 0):
                    yield from self._admitted('--initial', place, stamp)
            yield from self._admitted(item.topic, measurement)
        for _ in initial:
            late = Rejection('outside', 'the time of a start lies after the recording')
            yield from self._admitted('--initial', late)

    def _admitted(self, topic: str, measurement: Any, first_ns: int = 0) -> Iterator[Any]:
        """Yield a measurement, or a start as of `first_ns`, for the tracker, if not refused."""
        try:
            if isinstance(measurement, Rejection):
                raise measurement
            if isinstance(measurement, Initial):
                measurement = measurement.start(first_ns, self._names)
            admitted = self._intake.admit(measurement)
        except Rejection as rejection:
            first = Refused(0, f'{topic}: {rejection.sentence}')
            self.refused.setdefault(rejection.reason, first).count += 1
            return
        if admitted is not None:
            yield admitted

    def recipe(self) -> dict[str, Any]:
        """What decides about the estimates, and is known before: as run.json has it."""
        options = self.options
        return {
            'system': self.system.name,
            **fingerprint(self.bag.path),
            'topics': self.topics,
            'order': options.order,
            'smoothed': options.smooth,
            'world_frame': options.world_frame,
            'frame_id': options.frame_id,
            'parameters': self.tracker.config.as_dict(),
            **({'detector': dict(options.detector)} if options.detector else {}),
            **({'initial': [asdict(each) for each in options.initial]} if options.initial else {}),
        }

    def outcomes(self) -> dict[str, int]:
        """What happened to the messages: counts of the tracker, covariances it had to repair,
        pings in which most obstacles moved alike, and messages refused before."""
        counts = {name: count for name, count in sorted(self.tracker.counts.items()) if count}
        health = self.tracker.health()
        for name in OF_HEALTH:
            if count := health.get(name):
                counts[name] = int(count)
        if self._intake.repeats.rows:
            counts['repeated_rows'] = self._intake.repeats.rows
        refused = sum(entry.count for entry in self.refused.values())
        return {**counts, 'refused': refused} if refused else counts

    def findings(self) -> dict[str, Any]:
        """What only some runs have, as plain values: where the frame of the tracks lies on Earth;
        the names of targets by target ID, as the parameter `tags` lists and the recording notes
        them; where /tf_static says that the sonar is on its vehicle; the obstacles that are known
        at the end; what the echoes show of the staves of an array."""
        origin = getattr(self.tracker, 'origin', None) or self.options.origin
        tags = tag_numbers(getattr(self.tracker.config, 'tags', ()))
        names = {str(number): tag for tag, number in tags.items() if tag != str(number)}
        found = {
            'origin': None if origin is None else asdict(origin),
            TARGET_NAMES: names | self.bag.target_names or None,
            'mounting': self._intake.mounting or None,
            'landmarks': getattr(self.tracker, 'known', lambda: None)(),
            'array': getattr(self.tracker, 'array', dict)() or None,
        }
        return {name: value for name, value in found.items() if value is not None}

    def failure(self) -> str:
        """Why nothing came of the recording, when all of it was refused; else nothing."""
        found = {reason: (entry.count, entry.example) for reason, entry in self.refused.items()}
        counts, refusals = self.tracker.counts, getattr(self.tracker, 'refusals', None)
        # A tracker that refuses records itself counts those that it used.
        if refusals is None:
            used = self.messages - sum(count for count, _ in found.values())
        else:
            used = counts['used']
            found |= {reason: (counts[reason], refusals[reason]) for reason in refusals}
        if used or not found:
            return ''
        reasons = sorted(found.items(), key=lambda item: -item[1][0])
        return 'nothing could be used of the recording; refused: ' + '; '.join(
            f'{count} ({reason}: {sentence})' for reason, (count, sentence) in reasons
        )

    def timings(self) -> dict[str, float]:
        """Milliseconds that the tracker takes per measurement: total, median and 99 % point."""
        spent = np.array(self.durations) * 1e3
        if not len(spent):
            return {}
        return {
            'tracker_total_ms': float(spent.sum()),
            'tracker_p50_ms': float(np.median(spent)),
            'tracker_p99_ms': float(np.percentile(spent, 99.0)),
        }


def _timed(work: Callable[[Any], Any], task: Any) -> tuple[Any, float]:
    """What a task gives, and the seconds it took."""
    begin = time.perf_counter()
    return work(task), time.perf_counter() - begin


def write_run(
    folder: RunFolder,
    offline: OfflineRun,
    advance: Callable[[int], None] = lambda count: None,
    *,
    tables: str = AS_CSV,
) -> dict[str, Any]:
    """Track into a fresh folder; gives the content of run.json, which is written last. tables: as
    `RunFolder.write_estimates` has it. Raises `BagError` when all was refused."""
    begin = time.perf_counter()
    system, path = offline.system.name, offline.bag.path
    recipe = offline.recipe()
    notes = {
        'system': system,
        'sonar_imm': __version__,
        'topics': json.dumps(offline.topics),
        'parameters': json.dumps(finite(recipe['parameters'])),
    }
    made = folder.write_estimates(offline.estimates(advance), system, tables=tables, notes=notes)
    if not made['estimates'] and (failure := offline.failure()):
        raise BagError(f'{path}: {failure}')
    seconds = time.perf_counter() - begin
    run = run_record(
        bag=str(path.resolve()),
        **recipe,
        messages=offline.messages,
        **made,
        written_bytes=sum(f.stat().st_size for f in folder.path.rglob('*') if f.is_file()),
        counts=offline.outcomes(),
        refused={reason: asdict(entry) for reason, entry in sorted(offline.refused.items())},
        warnings=list(getattr(offline.tracker, 'warnings', list)()),
        problems=list(offline.bag.problems),
        **offline.findings(),
        timings={
            'wall_s': seconds,
            'mb_per_s': recipe['bag_bytes'] / seconds * 1e-6,
            **offline.timings(),
        },
    )
    folder.write_json(RUN, run)
    return run
