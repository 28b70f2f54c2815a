# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Judges: scores and summaries of finished runs, one judge per system.

The metrics of a diver track and of a sea floor differ. So each system has a module that judges its
runs, `System.judge`, which is a `Judge`, and beside it ``figures``, whose ``sections`` show the
scores. Everything else is the same for all of them: how a run and its truth are read (`Case`), the
page, the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import functools
from importlib import import_module
import math
from pathlib import Path
from typing import Any, Protocol, TYPE_CHECKING, TypeVar

from attrs import frozen

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.parameters import Config
from sonar_imm.trackers import SYSTEMS

from ..offline.run_folder import read_measurements, read_truth, RunFolder
from ..recordings.sources import BagError
from .numbers import Card, cards, Check, fill, front, lines, look_up, Metric, Text, verdict

if TYPE_CHECKING:  # it loads plotly, which only a report needs and which takes a second
    from .report import Part, Section

TRUTH_GAP = 60.0
T = TypeVar('T')
C = TypeVar('C', bound=Config)


@frozen
class Limit:
    """What an error may be at most: `meaning` names the error, e.g. 'position RMSE', and `metric`
    is its dotted name in ``metrics.json``. missed: what is said where there is truth and no error
    could be measured; empty for nothing."""

    value: float
    unit: str
    meaning: str
    metric: str
    missed: str = ''

    def check(self, error: float, *, at_most: float | None = None, remark: str = '') -> Check:
        """Compare `error` with the limit, or with `at_most` instead; `remark` follows it."""
        limit = self.value if at_most is None else at_most
        return Check(
            f'{self.meaning} against truth',
            f'{error:.2f} {self.unit}{remark}',
            f'at most {limit:g} {self.unit}',
            error <= limit,
        )


@frozen(kw_only=True)
class JudgeOptions:
    """What a run is compared with, and how.

    truth_bag: where the truth is, None for the tracked recording itself. lag: seconds by which the
    truth is later than the estimate it is compared with. gap: seconds without truth across which
    it is not interpolated. cutoff: distance from which an estimate is on no target, None for what
    is usual in the system.
    """

    truth_bag: Path | None = None
    lag: float = 0.0
    gap: float = TRUTH_GAP
    cutoff: float | None = None


@frozen(eq=False, kw_only=True)
class Judgement:
    """Scores and summary of one run.

    run: the content of ``run.json``; metrics: that of ``metrics.json``. words: the result in a few
    sentences. shown: which metrics people see, and how. seen: what was tracked, in a few words.
    sections: makes the sections of the report. accuracy: compares the error with a limit (None for
    `LIMIT` of the system); None without truth.
    """

    run: Mapping[str, Any]
    metrics: dict[str, Any]
    words: Text
    shown: Sequence[Metric]
    sections: Callable[[], Iterable[Section]]
    accuracy: Callable[[float | None], Check | None]
    seen: Text = ''

    @property
    def summary(self) -> str:
        """The result in a few sentences."""
        return fill(self.words, self.metrics)

    @property
    def lines(self) -> tuple[tuple[str, str], ...]:
        """Label and value of the most important numbers."""
        return lines(self.shown, self.metrics)

    @property
    def headline(self) -> str:
        """What was tracked and how well, in one line."""
        numbers = (f'{card.title} {card.value}' for card in front(self.cards))
        return '; '.join([fill(self.seen, self.metrics), *numbers])

    @property
    def cards(self) -> tuple[Card, ...]:
        """The key numbers of the report."""
        return cards(self.shown, self.metrics)

    def part(self, checks: Sequence[Check] = ()) -> Part:
        """The part of the report for this run, with further `checks`."""
        from .report import Part

        return Part(
            run=self.run,
            metrics=self.metrics,
            summary=self.summary,
            seen=fill(self.seen, self.metrics),
            verdict=verdict(self.shown, self.metrics),
            checks=tuple(checks),
            cards=self.cards,
            sections=tuple(self.sections()),
        )


@frozen(eq=False)
class Case:
    """A run that is to be judged: its folder, the content of ``run.json``, and what it is compared
    with. What cannot be read, or is of another system, raises `BagError` that names the file."""

    folder: RunFolder
    run: Mapping[str, Any]
    options: JudgeOptions

    def estimates(self, read: Callable[[list[Estimate]], T]) -> T:
        """What `read` makes of the estimates."""
        return self._read(read, self.folder.read_estimates(), self.folder.path)

    def truth(self, read: Callable[[list[Estimate]], T]) -> T | None:
        """What `read` makes of the truth; None where there is none."""
        tables = read_truth(self.run, self.options.truth_bag)
        place = self.options.truth_bag or Path(self.run['bag'])
        return None if tables is None else self._read(read, tables, place)

    def measurements(self) -> Iterable[Any]:
        """What was tracked, in the order recorded; nothing when the recording is gone."""
        return read_measurements(self.run)

    def config(self, kind: type[C]) -> C:
        """The parameters of the tracker."""
        return kind.from_mapping(self.run['parameters'], ignore_unknown=True)

    def origin(self) -> Origin | None:
        """Where the frame of the tracks lies on Earth, None when only the parameters may say."""
        return Origin(**self.run['origin']) if self.run.get('origin') else None

    @staticmethod
    def _read(read: Callable[[list[Estimate]], T], tables: list[Estimate], place: Path) -> T:
        try:
            return read(tables)
        except ValueError as error:
            raise BagError(f'{place}: {error}') from None


class Judge(Protocol):
    """What the module `System.judge` provides. LIMIT: of the error for the shipped recordings;
    REMARK follows the error where it is checked; METRICS: how people see the scores; SEEN says
    what was tracked."""

    LIMIT: Limit
    METRICS: Sequence[Metric]
    REMARK: Text
    SEEN: Text

    def summary_sentence(self, metrics: Mapping[str, Any]) -> str:
        """Tell the result in a few sentences."""
        ...

    def scored(self, case: Case) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """Give the metrics of a run, and the arguments of ``figures.sections``."""
        ...


def judge(folder: RunFolder, options: JudgeOptions | None = None) -> Judgement:
    """Judge a run of any system. Raises `BagError` when it or the truth cannot be read."""
    run = folder.read_run()
    name = SYSTEMS[run['system']].judge
    system: Judge = import_module(name)
    metrics, shown = system.scored(Case(folder, run, options or JudgeOptions()))
    return Judgement(
        run=run,
        metrics=metrics,
        words=system.summary_sentence,
        shown=system.METRICS,
        seen=system.SEEN,
        # plotly, which only a report needs, takes a second to load.
        sections=lambda: import_module(f'{name}.figures').sections(*shown),
        accuracy=functools.partial(_accuracy, system, metrics),
    )


def _accuracy(system: Judge, metrics: dict[str, Any], at_most: float | None) -> Check | None:
    limit = system.LIMIT
    error = look_up(metrics, limit.metric)
    if error is None or math.isnan(error):
        if error is None or not limit.missed:
            return None
        return Check(f'{limit.meaning} against truth', limit.missed, 'at least one', good=False)
    return limit.check(error, at_most=at_most, remark=fill(system.REMARK, metrics))
