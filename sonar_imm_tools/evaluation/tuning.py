# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters by the likelihood of a user's own bags: which ones the data determine, and where.

    maximise   sum_k log p(measurement k | those before it; parameters) + log prior

Each system has a module `evaluation.<system>.predictive` with

- ``tunables(config, measurements) -> list[Tunable]``: what can be fitted, and where it starts;
- ``Scored``: its tracker, which notes the log predictive density of every stamp in ``scores``;
- ``for_tuning(config)``: the config without what costs time and changes no prediction.

The coordinates are logarithms of positive numbers and logits of probabilities. The prior is normal
around the configured value. Nelder-Mead finds the maximum from two starts, central differences its
curvature. With covariances that are wrong by a large factor the tracker rejects most measurements,
and the likelihood has several maxima. So standard deviations and scales are first tried on a grid
over their whole range.

A parameter is ``determined`` if three conditions hold: its standard error is small, it is not at a
bound, and fitting it improves the prediction of data that were not fitted. For the last one each
half of the bags is predicted with what was fitted to the other half, with and without the
parameter; the least supported parameter is dropped until all have support. All others are ``not
determined``: they keep their values, and the determined ones are fitted once more.

The sums are exact (`math.fsum`), so that neither the order of recordings nor the number of
processes changes a byte. In one file, since it is one estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from importlib import import_module
import itertools
import math
from typing import Any

from attrs import evolve, frozen
import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray, IndexArray
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import Config, ConfigError, did_you_mean
from sonar_imm.trackers import SYSTEMS

from ..offline.batch import Job
from ..offline.jobs import processes
from ..offline.tracking import OfflineRun
from ..recordings.reader import BagReader

FEWEST = 20
"""Measurements below which nothing is fitted."""
DETERMINED = 0.35
"""Standard error, of a logarithm or logit, up to which a parameter is determined."""
SUPPORT = 2.0
"""Held-out gain of log likelihood, over both halves, from which a parameter is determined. A fit
of a parameter that is right already reaches it by chance in 2 % of cases."""
STEP = 0.15
"""Of central differences."""
EVALUATIONS = 40
"""Most evaluations of a fit, for each parameter."""
PRECISION = 0.02
"""Of coordinates and of the log likelihood, at which Nelder-Mead stops."""
SPACING = 1.2
"""Largest spacing of the grid of scales, in their logarithm."""
WHOLE, FIRST, SECOND = 'whole', 'first', 'second'
DETERMINES, LEAVES = 'determined', 'not determined'
"""Verdicts."""

Scores = dict[int, tuple[float, int]]
"""Log predictive density, and the number of measurements, by stamp."""


@frozen(kw_only=True)
class Tunable:
    """A parameter that can be fitted: `start` is the value that it has, or that stands for an
    automatic one. place: of an element, where the parameter is the list `whole`. kind: ``log`` or
    ``logit``. std: of the prior, in that coordinate. least: a bound beside those of the
    parameter. usual: whether it is fitted without being asked for. scanned: whether a grid between
    the bounds is tried first. step: of the differences."""

    name: str
    start: float
    kind: str = 'log'
    std: float = 1.5
    least: float = 1e-12
    place: int | None = None
    whole: tuple[float, ...] = ()
    usual: bool = True
    scanned: bool = False
    step: float = STEP

    @classmethod
    def of(cls, config: Config, name: str, **settings: Any) -> Tunable:
        """A parameter that starts as it is configured."""
        return cls(name=name, start=getattr(config, name), **settings)

    @property
    def label(self) -> str:
        return self.name if self.place is None else f'{self.name}[{self.place}]'

    def coordinate(self, value: float) -> float:
        return math.log(value / (1.0 - value)) if self.kind == 'logit' else math.log(value)

    def value(self, coordinate: float) -> float:
        if self.kind == 'logit':
            return 1.0 / (1.0 + math.exp(-coordinate))
        return math.exp(coordinate)

    def bounds(self, config: Config) -> tuple[float, float]:
        """Of the coordinate: four standard deviations, and what is possible."""
        spec = next(spec for spec in config.specs() if spec.name == self.name)
        edge = (1e-6, 1.0 - 1e-6) if self.kind == 'logit' else (1e-12, 1e12)
        low = min(max(edge[0], self.least, spec.low or 0.0), self.start)
        high = max(min(edge[1], edge[1] if spec.high is None else spec.high), self.start)
        u = self.coordinate(self.start)
        around = u - 4.0 * self.std, u + 4.0 * self.std
        return max(around[0], self.coordinate(low)), min(around[1], self.coordinate(high))

    def grid(self, config: Config) -> list[float]:
        """Return the coordinates that are tried first, none for most parameters."""
        if not self.scanned:
            return []
        low, high = self.bounds(config)
        return np.linspace(low, high, math.ceil((high - low) / SPACING) + 1).tolist()


@frozen(eq=False)
class Recording:
    """One instrument of a recording: its config, and its measurements in the order of stamps."""

    system: str
    config: Config
    frame_id: str
    measurements: tuple[Any, ...]

    @classmethod
    def read(cls, job: Job) -> Recording:
        """What `job` would track. Raises `BagError` and `ConfigError`."""
        options = evolve(job.options, order='stamp', smooth=False)
        with BagReader(job.bag) as reader:
            run = OfflineRun(reader, SYSTEMS[job.system], job.config, options)
            taken = [item.measurement for item in run.read()]
        found = tuple(item for item in taken if not isinstance(item, Rejection))
        config = _predictive(job.system).for_tuning(run.tracker.config)
        return cls(job.system, config, options.frame_id, found)

    def scores(self, values: Mapping[str, Any], until: float = math.inf) -> Scores:
        """What a tracker with these parameters predicts, stamp by stamp, up to `until`."""
        specs, inside = {spec.name: spec for spec in self.config.specs()}, {}
        for name, value in values.items():  # rounding and steps may leave the range
            low, high = specs[name].low, specs[name].high
            limits = -math.inf if low is None else low, math.inf if high is None else high
            clipped = np.clip(value, *limits).tolist()
            inside[name] = tuple(clipped) if isinstance(value, tuple) else clipped
        config = evolve(self.config, **inside)
        tracker = _predictive(self.system).Scored(config, self.measurements)
        intake = Intake(tracker, self.frame_id)
        for measurement in self.measurements:
            if measurement.stamp_ns > until:
                break
            try:
                admitted = intake.admit(measurement)
            except Rejection:
                continue
            if admitted is not None:
                tracker.process(admitted)
        found: Scores = tracker.scores
        return found


def _predictive(system: str) -> Any:
    return import_module(f'{SYSTEMS[system].judge}.predictive')


_read: dict[str, Recording] = {}


def _recording(job: Job) -> Recording:
    """A recording, read once in each process."""
    key = f'{job.bag.resolve()}\n{job!r}'
    if key not in _read:
        _read[key] = Recording.read(job)
    return _read[key]


def values_of(tunables: Sequence[Tunable], u: FloatArray) -> dict[str, Any]:
    """The parameters at coordinates u (p,)."""
    values: dict[str, Any] = {}
    lists: dict[str, dict[int, float]] = {}
    for tunable, coordinate in zip(tunables, u.tolist()):
        value = tunable.value(coordinate)
        if tunable.place is None:
            values[tunable.name] = value
        else:
            lists.setdefault(tunable.name, {})[tunable.place] = value
    for name, elements in lists.items():
        whole = next(list(t.whole) for t in tunables if t.name == name)
        for place, value in elements.items():
            whole[place] = value
        values[name] = tuple(whole)
    return values


@frozen
class Fitting:
    """What a process needs to evaluate the posterior. split: the stamp
    that divides each recording into halves."""

    jobs: tuple[Job, ...]
    tunables: tuple[Tunable, ...]
    split: tuple[int, ...]

    def scores(self, u: FloatArray | None, part: str = WHOLE) -> tuple[float, int]:
        """Sum of log predictive densities of a part, given all before it, and of how many
        measurements; u None: at what is configured."""
        terms, count = [], 0
        for job, split in zip(self.jobs, self.split):
            recording = _recording(job)
            values = {} if u is None else values_of(self.tunables, u)
            found = recording.scores(values, split if part == FIRST else math.inf)
            for stamp_ns, (score, measured) in found.items():
                if part == WHOLE or (stamp_ns <= split) == (part == FIRST):
                    terms.append(score)
                    count += measured
        return math.fsum(terms), count

    def posterior(self, u: FloatArray, part: str = WHOLE) -> float:
        start = [t.coordinate(t.start) for t in self.tunables]
        std = [t.std for t in self.tunables]
        prior = -0.5 * float(np.square((u - start) / std).sum())
        return self.scores(u, part)[0] + prior


def maximise(
    fitting: Fitting, start: FloatArray, part: str, advance: Callable[[int], None] | None = None
) -> tuple[FloatArray, float, int]:
    """Return where the posterior is largest, how large it is, and how many evaluations it took."""
    from scipy.optimize import minimize

    config = _recording(fitting.jobs[0]).config
    bounds = np.array([t.bounds(config) for t in fitting.tunables])
    start = np.clip(start, *bounds.T)

    def cost(u: FloatArray) -> float:
        if advance is not None:
            advance(1)
        value = fitting.posterior(u, part)
        return -value if math.isfinite(value) else 1e12

    tried = 0
    for k, tunable in enumerate(fitting.tunables):
        points = np.repeat(start[None], len(grid := tunable.grid(config)), axis=0)
        points[:, k] = grid
        if len(points):
            costs = [cost(point) for point in points]
            start, tried = points[int(np.argmin(costs))], tried + len(points)
    simplex = np.tile(start, (len(start) + 1, 1))
    for k, tunable in enumerate(fitting.tunables):
        step = 0.5 * (SPACING if tunable.scanned else tunable.std)
        simplex[k + 1, k] += step if start[k] + step <= bounds[k, 1] else -step
    found = minimize(
        cost,
        start,
        method='Nelder-Mead',
        bounds=bounds,
        options={
            'initial_simplex': np.clip(simplex, *bounds.T),
            'xatol': PRECISION,
            'fatol': PRECISION,
            'maxfev': EVALUATIONS * len(start),
        },
    )
    return np.asarray(found.x), -float(found.fun), tried + int(found.nfev)


def errors(
    fitting: Fitting, best: FloatArray, evaluate: Callable[[list[FloatArray]], list[float]]
) -> FloatArray:
    """Standard errors (p,) of the coordinates by the curvature at `best`; infinite without one."""
    p = len(best)
    step = np.diag([t.step for t in fitting.tunables])
    pairs = list(itertools.combinations(range(p), 2))
    points = [best]
    for k in range(p):
        points += [best + step[k], best - step[k]]
    for i, j in pairs:
        ahead, back = best + step[i], best - step[i]
        points += [ahead + step[j], ahead - step[j], back + step[j], back - step[j]]
    f = evaluate(points)
    H = np.empty((p, p))
    for k in range(p):
        H[k, k] = -(f[1 + 2 * k] - 2.0 * f[0] + f[2 + 2 * k]) / step[k, k] ** 2
    for row, (i, j) in enumerate(pairs):
        a, b, c, d = f[1 + 2 * p + 4 * row : 5 + 2 * p + 4 * row]
        H[i, j] = H[j, i] = -(a - b - c + d) / (4.0 * step[i, i] * step[j, j])
    values = np.linalg.eigvalsh(H)
    if values[0] > 0.0:
        return np.sqrt(np.diag(np.linalg.inv(H)))
    return np.full(p, np.inf)


@frozen(kw_only=True)
class Row:
    """Result for one parameter. low, high: two standard errors to either side; None where the
    likelihood has no curvature, or is largest at a bound. held_out_gain: what fitting it gains per
    measurement that was not fitted; None where it was not tested."""

    name: str
    before: float
    after: float
    low: float | None
    high: float | None
    held_out_gain: float | None
    verdict: str
    reason: str

    @property
    def determined(self) -> bool:
        return self.verdict == DETERMINES


@frozen(kw_only=True)
class Tuned:
    """The result. held_out_gain: of all determined parameters together, per measurement; of those
    that were dropped last where none is left. values: of the determined parameters."""

    system: str
    measurements: int
    log_likelihood_before: float
    log_likelihood_after: float
    held_out_gain: float
    evaluations: int
    parameters: tuple[Row, ...]
    values: dict[str, Any]


def rounded(value: float) -> float:
    """To six digits, as it is written."""
    return float(f'{value:.6g}')


def prepared(jobs: Sequence[Job], names: Sequence[str]) -> tuple[Fitting, int]:
    """What is to be fitted, and how many measurements there are. Raises `ConfigError` for what
    cannot be fitted, or not from so little."""
    jobs = tuple(sorted(jobs, key=lambda job: (str(job.bag), job.instrument)))
    recordings = [_recording(job) for job in jobs]
    first = recordings[0]
    every = _predictive(first.system).tunables(first.config, first.measurements)
    if not every:
        raise ConfigError(
            'these models have no parameter that a recording could fit; --set model_set=NAME '
            'chooses others'
        )
    known = {t.name for t in every}
    for name in names:
        if name not in known:
            if all(spec.name != name for spec in first.config.specs()):
                raise ConfigError(f"unknown parameter '{name}'{did_you_mean(name, known)}")
            can = ', '.join(sorted(known))
            raise ConfigError(
                f"parameter '{name}' cannot be fitted to this recording; these can: {can}"
            )
    tunables = tuple(t for t in every if (t.name in names if names else t.usual))
    for tunable in tunables:
        if len({str(getattr(each.config, tunable.name)) for each in recordings}) > 1:
            name = tunable.name
            raise ConfigError(
                f'the recordings have different {name}: --params or --set gives them one'
            )
    split, count = [], 0
    for recording in recordings:
        found = recording.scores({})
        stamps = sorted(found)
        total = sum(measured for _, measured in found.values())
        so_far = np.cumsum([found[stamp][1] for stamp in stamps])
        half = int(np.searchsorted(so_far, 0.5 * total)) if stamps else 0
        split.append(stamps[min(half, len(stamps) - 2)] if len(stamps) > 1 else 0)
        count += total if len(stamps) > 1 else 0
    if count < FEWEST:
        raise ConfigError(
            f'too little to fit: {count} measurements with something before them to predict them '
            f'from, {FEWEST} are needed'
        )
    return Fitting(jobs, tunables, tuple(split)), count


def most_evaluations(fitting: Fitting) -> int:
    """Return how many evaluations `tune` takes at most."""
    config, p = _recording(fitting.jobs[0]).config, len(fitting.tunables)
    grid = sum(len(t.grid(config)) for t in fitting.tunables)
    of_whole, of_halves = 3 * (EVALUATIONS * p + grid), p * (EVALUATIONS * (p + 1) + 2 * grid)
    return of_whole + of_halves + 2 + 2 * p**2 + p * (p + 5)


def tune(
    fitting: Fitting,
    measurements: int,
    *,
    processes_used: int = 1,
    advance: Callable[[int], None] = lambda count: None,
) -> Tuned:
    """Fit the parameters; `advance` hears of evaluations."""
    with _mapping(processes_used, advance) as together:
        return _tune(fitting, measurements, together)


Together = Callable[..., list[Any]]


def _tune(fitting: Fitting, measurements: int, together: Together) -> Tuned:
    tunables = fitting.tunables
    config = _recording(fitting.jobs[0]).config
    start = np.array([t.coordinate(t.start) for t in tunables])
    std = np.array([t.std for t in tunables])
    starts = [(fitting, start, WHOLE)]
    if not all(t.scanned for t in tunables):
        starts.append((fitting, start + std, WHOLE))
    fits = together(maximise, starts)
    best, _, _ = max(fits, key=lambda found: found[1])
    used = sum(found[2] for found in fits)

    bounds = np.array([t.bounds(config) for t in tunables])
    at_bound = np.minimum(best - bounds[:, 0], bounds[:, 1] - best) < 0.05
    se = np.full(len(best), np.inf)
    if not at_bound.all():
        free = np.flatnonzero(~at_bound)

        def evaluate(points: list[FloatArray]) -> list[float]:
            wide = np.tile(best, (len(points), 1))
            wide[:, free] = points
            return together(fitting.posterior, [(point,) for point in wide])

        part = evolve(fitting, tunables=tuple(tunables[k] for k in free))
        se[free] = errors(part, best[free], evaluate)
        used += 1 + 2 * len(free) ** 2
    sharp = (se <= DETERMINED) & ~at_bound

    before, _ = fitting.scores(None)
    values: dict[str, Any] = {}
    after, final = before, best.copy()
    gain, gains, kept, evaluations = _supported(fitting, start, sharp, together)
    used += evaluations
    if len(kept):
        again = evolve(fitting, tunables=tuple(tunables[k] for k in kept))
        if len(kept) < len(tunables):
            ((final[kept], _, evaluations),) = together(maximise, [(again, best[kept], WHOLE)])
            used += evaluations
        written = [t.coordinate(rounded(t.value(u))) for t, u in zip(again.tunables, final[kept])]
        chosen = np.array(written)
        ((after, _),) = together(again.scores, [(chosen,)])
        used += 1
        for name, value in values_of(again.tunables, chosen).items():
            several = isinstance(value, tuple)
            values[name] = [rounded(each) for each in value] if several else rounded(value)
    rows = []
    for k, tunable in enumerate(tunables):
        place = final[k]
        low = high = None
        if np.isfinite(se[k]):
            low = rounded(tunable.value(max(place - 2.0 * se[k], bounds[k, 0])))
            high = rounded(tunable.value(min(place + 2.0 * se[k], bounds[k, 1])))
        reason = ''
        if at_bound[k]:
            side = 'below' if best[k] - bounds[k, 0] < 0.05 else 'above'
            reason = f'the likelihood goes on rising {side} {tunable.value(best[k]):.4g}'
        elif not sharp[k]:
            reason = 'the likelihood hardly depends on it'
        elif k not in kept:
            reason = (
                f'with {tunable.value(place):.4g} the data that were not fitted are predicted no '
                'better than with the configured value'
            )
        value = rounded(tunable.value(place)) if k in kept else tunable.start
        rows.append(
            Row(
                name=tunable.label,
                before=tunable.start,
                after=value,
                low=low,
                high=high,
                held_out_gain=gains[k] / measurements if k in gains else None,
                verdict=DETERMINES if k in kept else LEAVES,
                reason=reason,
            )
        )
    return Tuned(
        system=fitting.jobs[0].system,
        measurements=measurements,
        log_likelihood_before=before,
        log_likelihood_after=after,
        held_out_gain=gain / measurements,
        evaluations=used,
        parameters=tuple(rows),
        values=values,
    )


def _supported(
    fitting: Fitting, start: FloatArray, sharp: BoolArray, together: Together
) -> tuple[float, dict[int, float], IndexArray, int]:
    """Drop parameters without held-out support, the weakest first.

    sharp (p,): which ones are tested. Returns the gain of log likelihood of those that are left,
    or of those that were dropped last; the gain of each that was tested; the places of those that
    are left; and the number of evaluations.
    """
    gain, used = 0.0, 0
    gains: dict[int, float] = {}
    kept: IndexArray = np.flatnonzero(sharp)
    while len(kept):
        part = evolve(fitting, tunables=tuple(fitting.tunables[k] for k in kept))
        halves = [(part, start[kept], FIRST), (part, start[kept], SECOND)]
        fits = together(maximise, halves)
        calls = []
        for (u, _, _), other in zip(fits, (SECOND, FIRST)):
            without = np.where(np.eye(len(kept), dtype=bool), start[kept], u)
            calls += [(each, other) for each in (u, None, *without)]
        used += sum(found[2] for found in fits) + len(calls)
        scores = np.reshape([score for score, _ in together(part.scores, calls)], (2, -1))
        gain, *each = (math.fsum([*scores[:, 0], *-column]) for column in scores[:, 1:].T)
        gains.update(zip(kept.tolist(), each))
        weakest = int(np.argmin(each))
        if min(gain, each[weakest]) >= SUPPORT:
            break
        kept = np.delete(kept, weakest)
    return gain, gains, kept, used


@contextlib.contextmanager
def _mapping(count: int, advance: Callable[[int], None]) -> Iterator[Together]:
    """Calls of a function with each of some arguments, here or in `count` processes."""

    def here(work: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        if work is maximise:  # which takes so long that it tells of each evaluation
            return [work(*call, advance) for call in calls]
        results = []
        for call in calls:
            results.append(work(*call))
            advance(1)
        return results

    if count == 1:
        yield here
        return
    with processes(count) as pool:

        def together(work: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> list[Any]:
            futures = [pool.submit(work, *call) for call in calls]
            results = []
            for future in futures:
                results.append(future.result())
                advance(results[-1][2] if work is maximise else 1)
            return results

        yield together
