# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy and consistency of estimates.

*Accuracy*: `gospa` and `ospa` for sets of targets, where some are missed,
some are false and the pairing is not known; `identity_switches` along time.

*Consistency*: the squared error, normalised by its own covariance, is chi-square distributed when
the filter is consistent (`nees` for states, `nis` for innovations). One value says little; the
average of many has narrow `average_bounds`. An average above them means an overconfident filter,
one below them a filter that wastes information. `interval_coverage` tests any interval.

References: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*
(2001), sec. 5.4; Schuhmacher, Vo, Vo, *A consistent metric for performance evaluation of
multi-object filters*, IEEE TSP 56(8), 2008; Rahmathullah, Garcia-Fernandez, Svensson, *Generalized
optimal sub-pattern assignment metric*, FUSION 2017.
"""

from __future__ import annotations

from itertools import repeat
import math
from typing import NamedTuple

from attrs import frozen
import numpy as np

from .arrays import FloatArray, IntArray
from .association import gate_threshold
from .kalman import factorise, log_density


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised estimation error squared ``e' P^-1 e`` (...,), chi-square with n degrees of
    freedom. e: (..., n); P: (..., n, n).

    Raises CovarianceError when a covariance is not positive definite.
    """
    return log_density(error, factorise(covariance))[0]


def nis(innovation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Normalised innovation squared ``nu' S^-1 nu`` (...,), nu (..., m), S (..., m, m).

    >>> import numpy as np
    >>> float(nis(np.array([2.0, 0.0]), np.diag([4.0, 1.0])))
    1.0
    """
    return nees(innovation, covariance)


def average_bounds(count: int, dimension: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds of the average of `count` independent chi-square values of `dimension`
    degrees of freedom.

    Errors of one run are correlated in time: for states, `count` is the number of runs, not of
    steps.

    >>> low, high = average_bounds(100, 2)  # NIS of 100 fixes: inside these in 95 % of all cases
    >>> round(low, 3), round(high, 3)
    (1.627, 2.411)
    """
    tail = 0.5 * (1.0 - probability)
    low, high = (gate_threshold(p, count * dimension) for p in (tail, 1.0 - tail))
    return low / count, high / count


NIS_MEMORY = 50.0
"""Innovations over which `NisMemory` gathers and forgets."""
_LEAST = 0.75 * NIS_MEMORY
FARTHEST = 9.0
"""More, for each degree of freedom, is a sharp turn or another's echo, and says nothing of noise:
it counts as so much."""
_SIGMAS = 5.0
"""A false alarm is so rare then that what the models cannot know (a target that turns as none of
them does, echoes that are not Gaussian) has room."""


@frozen
class NisMemory:
    """Normalised innovations squared of the last hits, older ones forgotten: a value, for filters
    whose state is one.

    nis, dof: their weighted sums; square: of the degrees of freedom, with squared weights; count:
    of the weights.
    """

    nis: float = 0.0
    dof: float = 0.0
    square: float = 0.0
    count: float = 0.0

    def after(self, nis: FloatArray, dof: FloatArray | int) -> NisMemory:
        """With the hits nis (K,) of dof (K,) degrees of freedom."""
        keep = 1.0 - 1.0 / NIS_MEMORY
        gathered, freedom, square, count = self.nis, self.dof, self.square, self.count
        each = repeat(dof) if isinstance(dof, int) else dof.tolist()
        for value, m in zip(nis.tolist(), each):
            gathered = keep * gathered + min(value, FARTHEST * m)
            freedom = keep * freedom + m
            square = keep * keep * square + m
            count = keep * count + 1.0
        return NisMemory(gathered, freedom, square, count)

    @property
    def mean(self) -> float:
        """For each degree of freedom, 1 where all is well; NaN without a hit."""
        return self.nis / self.dof if self.dof else math.nan

    @property
    def bounds(self) -> tuple[float, float]:
        """What the mean of a consistent filter stays between: a weighted sum of chi-squares, as
        the chi-square of the same variance, by the cube root of Wilson and Hilferty."""
        if self.count < _LEAST:
            return 0.0, math.inf
        spread = 2.0 * self.square / (9.0 * self.dof**2)
        away = _SIGMAS * math.sqrt(spread)
        return max(0.0, 1.0 - spread - away) ** 3, (1.0 - spread + away) ** 3

    @property
    def verdict(self) -> int:
        """1: innovations are larger than stated; -1: smaller; 0: no evidence of either."""
        low, high = self.bounds
        return int(self.mean > high) - int(self.mean < low)

    def warnings(self, what: str, advice: str, *, more_than_stated: bool = False) -> list[str]:
        """A sentence where `what` states covariances that cannot be true; more_than_stated: that
        is known before there are hits enough for a verdict."""
        verdict = 1 if more_than_stated else self.verdict
        if not verdict:
            return []
        more = 'more' if verdict > 0 else 'less'
        return [
            f'what the sensor states cannot be true: {what} miss by {more} than stated, mean NIS '
            f'{self.mean:.2g} for each coordinate, 1 is due; {advice}'
        ]


TWICE, ENOUGH, MOST_EACH = 2.0, 10.0, 4.0
"""Covariance, in units of the stated one, that `excess` asks for; evidence that is enough; the
most of an innovation that counts as evidence, for each degree of freedom."""


def excess(evidence: float, nis: FloatArray, dof: FloatArray) -> float:
    """The evidence after hits nis (K,) of dof (K,) degrees of freedom that innovations have
    `TWICE` the stated covariance: the sum of log-likelihood ratios since it was last at 0 (Page
    1954, *Continuous inspection schemes*), `ENOUGH` long before a mean is sure. It stays between 0
    and twice `ENOUGH`.

    >>> import numpy as np
    >>> excess(0.0, np.array([12.0]), np.array([3.0])) > 1.5 > excess(1.5, np.ones(1), np.ones(1))
    True
    """
    for value, m in zip(nis.tolist(), dof.tolist()):
        gained = 0.5 * (1.0 - 1.0 / TWICE) * min(value, MOST_EACH * m)
        evidence += gained - 0.5 * m * math.log(TWICE)
        evidence = min(max(evidence, 0.0), 2.0 * ENOUGH)
    return evidence


def interval_coverage(truth: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Share of `truth` inside [low, high], NaN when there is none."""
    inside = (low <= truth) & (truth <= high)
    return float(np.mean(inside)) if inside.size else math.nan


class Gospa(NamedTuple):
    """The distance, and the three parts that add up to ``distance ** order``: localisation, missed
    and false.

    estimate_of: (truths,) index of the estimate matched to each truth, -1 for the missed.
    """

    distance: float
    localisation: float
    missed: float
    false: float
    estimate_of: IntArray


def gospa(truth: FloatArray, estimate: FloatArray, cutoff: float, order: float = 2.0) -> Gospa:
    """Generalised OSPA (alpha = 2) between the point sets `truth` (T, n) and `estimate` (D, n).
    Either may be empty.

    ``(min sum over matched d^p + c^p / 2 (missed + false))^(1/p)``; points `cutoff` or more apart
    are not matched.

    >>> import numpy as np
    >>> found = gospa(np.array([[0.0, 0.0], [50.0, 0.0]]), np.array([[3.0, 4.0]]), cutoff=10.0)
    >>> round(found.distance, 3)  # sqrt(5^2 + 10^2 / 2): one is 5 m off, one is missed
    8.66
    """
    cost, rows, columns = _match(truth, estimate, cutoff, order)
    near = cost < cutoff**order
    estimate_of = np.full(len(truth), -1, np.int64)
    estimate_of[rows[near]] = columns[near]
    matched = int(near.sum())
    localisation = float(cost[near].sum())
    missed = 0.5 * cutoff**order * (len(truth) - matched)
    false = 0.5 * cutoff**order * (len(estimate) - matched)
    return Gospa(
        (localisation + missed + false) ** (1.0 / order), localisation, missed, false, estimate_of
    )


def ospa(truth: FloatArray, estimate: FloatArray, cutoff: float, order: float = 2.0) -> float:
    """Optimal sub-pattern assignment distance between two point sets (T, n) and (D, n): a mean
    error per target, in the units of the points, between 0 and `cutoff`."""
    most = max(len(truth), len(estimate))
    if most == 0:
        return 0.0
    cost, _, _ = _match(truth, estimate, cutoff, order)
    unmatched = cutoff**order * abs(len(truth) - len(estimate))
    return float(((cost.sum() + unmatched) / most) ** (1.0 / order))


def _match(
    truth: FloatArray, estimate: FloatArray, cutoff: float, order: float
) -> tuple[FloatArray, IntArray, IntArray]:
    """Costs, rows and columns of the assignment of least total ``min(d, cutoff)^order``."""
    if cutoff <= 0.0 or order < 1.0:
        raise ValueError('GOSPA and OSPA need cutoff > 0 and order >= 1')
    from scipy.optimize import linear_sum_assignment

    if not len(truth) or not len(estimate):
        return np.empty(0), np.empty(0, np.int64), np.empty(0, np.int64)
    distance = np.linalg.norm(truth[:, None] - estimate, axis=-1)
    cost = np.minimum(distance, cutoff) ** order
    rows, columns = linear_sum_assignment(cost)
    return cost[rows, columns], rows, columns


def identity_switches(track_id: IntArray) -> int:
    """How often a target is taken over by another track: `switches_by_scan` summed."""
    return int(switches_by_scan(track_id).sum())


def switches_by_scan(track_id: IntArray) -> IntArray:
    """How many targets are taken over by another track at each of K scans, (K,).

    track_id: (K, T) id of the track on each target over time, -1 where it is missed. A gap is no
    switch; coming back under another identity is one, at the scan where it comes back.
    """
    followed = np.asarray(track_id)
    switches = np.zeros(len(followed), np.int64)
    for column in followed.T:
        scans = np.flatnonzero(column != -1)
        changed = np.flatnonzero(np.diff(column[scans])) + 1
        np.add.at(switches, scans[changed], 1)
    return switches


def switching_gospa(distance: FloatArray, switches: IntArray, penalty: float) -> float:
    """One number of a whole run: ``sqrt(mean over scans of (d^2 + penalty^2 s))``, with the GOSPA
    distance d (K,) of second order and the identity switches s (K,) of each scan.

    It is the metric on trajectories of Garcia-Fernandez, Rahmathullah and Svensson (*A metric on
    the space of finite sets of trajectories*, IEEE TSP 68, 2020), but with the pairing of each
    scan by itself, so that it is an upper bound of theirs.
    """
    if not len(distance):
        return math.nan
    return float(np.sqrt(np.mean(np.square(distance) + penalty**2 * np.asarray(switches))))
