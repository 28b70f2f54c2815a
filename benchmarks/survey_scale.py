# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a survey of many lines costs: CPU by stage, and how much memory workers need.

    nice python -m benchmarks.survey_scale --lines 1000 --length 200

Groups of fifty lines beside each other on a slope, each group the same soundings moved aside, so
that lines overlap their neighbours throughout; then `sonar-imm survey --adjust` as the command
does it. `stages`: seconds of CPU of all processes, and per million soundings. `memory`: of a
worker, MB (the part that is its own and not of a file), after the first tenth of the lines and the
most until the end; of the process that holds the survey, the most; and of both the peak resident
set size, as the system counts it, with what they share with each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import tempfile
import threading
import time

from attrs import define, Factory
import pyarrow
import pyarrow.parquet

from benchmarks.study import Parts, study
from sonar_imm_tools.offline.jobs import workers
from sonar_imm_tools.simulation.survey import scenario, simulate
from sonar_imm_tools.survey.jobs import Options
from sonar_imm_tools.survey.making import make, Progress, sources_of
from sonar_imm_tools.survey.products import folder_of, write

GROUP, SPACING = 50, 40.0
TICKS = os.sysconf('SC_CLK_TCK')


def main(lines: int = 200, length: float = 100.0, jobs: int = 2) -> Parts:
    with tempfile.TemporaryDirectory() as folder:
        soundings = write_lines(Path(folder) / 'lines', lines, length)
        yield {'lines': lines, 'soundings': soundings, 'jobs': jobs}
        yield surveyed(Path(folder) / 'lines', Path(folder) / 'chart', jobs, soundings)


def write_lines(place: Path, lines: int, length: float) -> int:
    """Lines as soundings.parquet below `place`; how many soundings."""
    settings = {
        'lines': min(GROUP, lines),
        'cross_lines': 0,
        'terrain': 'slope',
        'length': length,
        'fish': False,
        'ghost': False,
    }
    scene = simulate(scenario('survey', settings), 1)
    total = 0
    for k in range(lines):
        points = scene.points[k % GROUP]
        folder = place / f'line_{k:05d}'
        folder.mkdir(parents=True)
        moved = points.moved((0.0, k // GROUP * GROUP * SPACING, 0.0))
        columns = {'stamp_ns': moved.stamp_ns, **moved.columns}
        columns |= {f'p{name}': moved[name] for name in 'xyz'}
        pyarrow.parquet.write_table(pyarrow.table(columns), folder / 'soundings.parquet')
        total += len(points)
    return total


def surveyed(runs: Path, out: Path, jobs: int, soundings: int) -> dict[str, object]:
    """Costs of a survey of the lines below `runs`."""
    watch = Watch()
    progress = Progress(begin=watch.begin, say=lambda text: None, warn=lambda text: None)
    options = Options(adjusted=True)
    sources = sources_of(runs)
    begun = time.perf_counter()
    with folder_of(out, options, runs) as place, watch, workers(jobs) as run:
        survey = make(sources, place, options, run, progress)
        watch.begin('products', 0)
        write(survey, place)
        watch.begin('', 0)
    stages = {
        name: {'cpu_s': seconds, 'cpu_s_per_million': seconds / soundings * 1e6}
        for name, seconds in watch.stages.items()
    }
    return {
        'stages': stages,
        'wall_s': time.perf_counter() - begun,
        'tiles': len(survey.tiles),
        'memory': {
            'worker': {
                'first_tenth': watch.early,
                'most': watch.most,
                'peak_rss': watch.peak,
            },
            'command': {'most': watch.own, 'peak_rss': _memory_mb(os.getpid(), 'VmHWM')},
        },
    }


@define
class Watch:
    """Hears of the stages of a survey, and looks at its processes every fifth of a second."""

    stages: dict[str, float] = Factory(dict)
    early: float = 0.0
    most: float = 0.0
    own: float = 0.0
    peak: float = 0.0
    _stage: str = ''
    _spent: float = 0.0
    _is_early: bool = True
    _ended: threading.Event = Factory(threading.Event)
    _thread: threading.Thread | None = None

    def __enter__(self) -> Watch:
        self._spent = _cpu_seconds()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def begin(self, what: str, total: int) -> Callable[[int], None]:
        now = _cpu_seconds()
        if self._stage:
            self.stages[self._stage] = self.stages.get(self._stage, 0.0) + now - self._spent
        self._stage, self._spent = what, now
        left = total - total // 10

        def advance(count: int) -> None:
            nonlocal total
            total -= count
            if what == 'lines' and total < left:
                self._is_early = False
            if what == 'statistics' and total == 0:
                self.begin('adjustment', 0)  # what the command does between two rounds

        return advance

    def _look(self) -> None:
        while not self._ended.wait(0.2):
            for child in _descendants():
                used = _memory_mb(child, 'RssAnon')
                self.peak = max(self.peak, _memory_mb(child, 'VmHWM'))
                self.most = max(self.most, used)
                if self._is_early:
                    self.early = max(self.early, used)
            self.own = max(self.own, _memory_mb(os.getpid(), 'RssAnon'))


def _descendants(process: int | str = 'self') -> Iterator[int]:
    """Workers are children of a process that has loaded the libraries for them."""
    try:
        for task in Path(f'/proc/{process}/task').iterdir():
            for child in map(int, (task / 'children').read_text().split()):
                yield child
                yield from _descendants(child)
    except OSError:  # it has ended
        return


def _cpu_seconds() -> float:
    """Of this process and of all below it that live."""
    total = 0.0
    for process in (os.getpid(), *_descendants()):
        try:
            fields = Path(f'/proc/{process}/stat').read_text().rpartition(')')[2].split()
        except OSError:
            continue
        total += (int(fields[11]) + int(fields[12])) / TICKS
    return total


def _memory_mb(process: int, kind: str) -> float:
    """What the system says of the memory of a process, MB; RssAnon: what no file holds."""
    try:
        lines = Path(f'/proc/{process}/status').read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith(kind)) / 1024


if __name__ == '__main__':
    study(main)
