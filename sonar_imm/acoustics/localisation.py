# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A position from one ping by maximum likelihood, or the reason why there is none.

`localise` takes the arrivals of one ping (range sums from known transmitters, bearings, or one-way
arrivals from a tag whose time of emission is unknown) and gives a `Localisation` or a `Refusal`
with a short reason. What guards it:

* **Ghosts.** Two ellipses cross at two points or more. Every minimum of the sum of squares within
  a likelihood ratio of about 100 to 1 of the best one is reported in `alternatives`, and the fix
  is called ambiguous.
* **Singular baseline.** Between transmitter and receiver the gradient of the range sum vanishes. A
  fix is refused when its largest standard deviation or the condition number of its covariance
  passes the limit, or when two standard deviations away the likelihood is not what the covariance
  says.
* **Late reflections.** When the chi-square test fails, the row whose removal helps most is left
  out, one at a time, while a degree of freedom remains to test the rest with.
* **Plausibility.** A fix further than `max_range` from the instruments is refused.

The covariance is the inverse of the Fisher information at the solution. An error of the sound
speed is common to all arrivals and is not in it.
"""

from __future__ import annotations

import math

from attrs import frozen
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from ..estimation.arrays import FloatArray, IndexArray
from .arrival_fit import ArrivalFit, BoolArray, Minima, minimise
from .multistatic import emission_time


@frozen(kw_only=True)
class Limits:
    """What a fix must satisfy.

    max_range: m from the middle of the instruments; max_std: m, along the worst axis;
    max_condition: of the covariance; min_p_value: of the chi-square test; max_outliers: rows that
    may be left out (0: none); refuse_ambiguous: turn an ambiguous fix into a refusal.
    """

    max_range: float = 10_000.0
    max_std: float = 100.0
    max_condition: float = 1e8
    min_p_value: float = 1e-3
    max_outliers: int = 10
    refuse_ambiguous: bool = False


DEFAULT_LIMITS = Limits()


@frozen(eq=False)
class Candidate:
    """Another position (2,) that explains the ping nearly as well, with its covariance (2, 2) and
    chi-square."""

    position: FloatArray
    covariance: FloatArray
    cost: float

    def distance2(self, position: FloatArray) -> float:
        """Squared Mahalanobis distance of another position (2,) from this one."""
        # Where one direction is known far better than the other, rounding can leave a covariance
        # without an inverse: no variance counts as less than its share of the larger one.
        variances, axes = np.linalg.eigh(self.covariance)
        least = variances[1] / MOST_CONDITION
        along = (position - self.position) @ axes
        return float(np.sum(np.square(along) / np.maximum(variances, least)))


@frozen(eq=False, kw_only=True)
class Localisation:
    """A fix: position (2,) m, covariance (2, 2) m^2, chi-square `cost` with `dof` degrees of
    freedom and its p-value (1 where dof is 0 and nothing can be tested); best of `alternatives`
    first.

    used, used_bearing: (n,) which arrival times and bearings the fix rests on. emission_time (s,
    on the clock of the arrivals) and var_emission_time (s^2): None when every row has a
    transmitter.
    """

    position: FloatArray
    covariance: FloatArray
    cost: float
    dof: int
    p_value: float
    ambiguous: bool
    alternatives: tuple[Candidate, ...]
    used: BoolArray
    used_bearing: BoolArray
    emission_time: float | None = None
    var_emission_time: float | None = None


@frozen(eq=False)
class Refusal:
    """No fix. `reason` is one of too_few, singular_geometry, poor_fit, ambiguous, diverged,
    out_of_range."""

    reason: str
    sentence: str
    alternatives: tuple[Candidate, ...] = ()


LARGEST = 1e12
"""Positions, times and bearings beyond this (m, s, rad), and variances beyond its square or below
the inverse of that, are no measurements; within it no square overflows."""

AMBIGUITY_COST = 9.21
"""Chi-square above the best within which another minimum is an alternative: likelihood ratio of
100 to 1."""

MOST_CONDITION = 1e14
"""Most that one direction can be better known than the other: beyond, an inverse has no digits."""

DISTINCT = 4.0
"""Squared Mahalanobis distance beyond which two minima are two positions."""

SEEDS = 4
"""Minima from which the search goes on when a row is left out."""

MOST_SUSPECTS = 32
"""Rows of which one is left out, those that fit worst: to try every one of n rows costs n^2."""

ASIDE = 2.0
QUADRATIC = (0.3, 3.5)
"""What chi-square may rise by `ASIDE` standard deviations from the fix, as a share of the
ASIDE^2 it rises by where the covariance describes the likelihood."""


def localise(
    rx: ArrayLike,
    toa: ArrayLike,
    var_toa: ArrayLike,
    *,
    tx: ArrayLike | None = None,
    bearing: ArrayLike | None = None,
    var_bearing: ArrayLike | None = None,
    target_z: float = 0.0,
    sound_speed: float = 1500.0,
    limits: Limits = DEFAULT_LIMITS,
) -> Localisation | Refusal:
    """Find the target of one ping from its n arrivals.

    rx (n, 3) m; toa (n,) s and var_toa (n,) s^2; tx (n, 3) m, rows of NaN (or None) where the
    target itself emits; bearing (n,) rad and var_bearing (n,) rad^2. A time or bearing that is not
    finite or has no positive variance is not used. The times of rows with a transmitter count from
    its transmission. Raises ValueError for arrays whose lengths differ or receivers that are not
    finite.
    """
    tx_, rx_, times, bearings = _checked(tx, rx, toa, var_toa, bearing, var_bearing)
    times[(np.abs(tx_) > LARGEST).any(axis=-1)] = np.nan
    fit = _problem(tx_, rx_, times, bearings, target_z, sound_speed, limits.max_range)
    if _dof(fit, np.ones(len(fit.weight), bool)) < 0:
        return Refusal('too_few', f'{len(fit.weight)} arrival times and bearings fix no position')
    kept, minima = _search(fit, limits)
    if not len(minima.cost):
        return Refusal('diverged', 'the search for the position did not converge')
    candidates = _candidates(fit, minima)
    if not candidates:
        return Refusal(
            'out_of_range',
            f'the position lies further than {limits.max_range:g} m from the instruments',
        )
    best, *rivals = candidates
    dof = _dof(fit, kept)
    refusal = _doubt(fit, fit.weight * kept, best, dof, limits)
    if refusal is not None:
        return refusal
    if rivals and limits.refuse_ambiguous:
        return Refusal(
            'ambiguous',
            f'{len(candidates)} positions explain the arrivals about equally well',
            tuple(candidates),
        )
    emission, var_emission = _emission(fit, kept, best, sound_speed)
    return Localisation(
        position=best.position,
        covariance=best.covariance,
        cost=best.cost,
        dof=dof,
        p_value=_p_value(best.cost, dof),
        ambiguous=bool(rivals),
        alternatives=tuple(rivals),
        used=_spread(kept[: len(fit.rx)], _usable(times)),
        used_bearing=_spread(kept[len(fit.rx) :], _usable(bearings)),
        emission_time=emission,
        var_emission_time=var_emission,
    )


def _checked(
    tx: ArrayLike | None,
    rx: ArrayLike,
    toa: ArrayLike,
    var_toa: ArrayLike,
    bearing: ArrayLike | None,
    var_bearing: ArrayLike | None,
) -> tuple[FloatArray, ...]:
    """tx (n, 3), rx (n, 3), and times (n, 2), bearings (n, 2) as pairs of value and variance."""
    rx_ = np.asarray(rx, np.float64)
    n = len(rx_)
    tx_ = np.full((n, 3), np.nan) if tx is None else np.asarray(tx, np.float64)
    missing = np.full(n, np.nan)
    columns = [
        missing if values is None else np.asarray(values, np.float64)
        for values in (toa, var_toa, bearing, var_bearing)
    ]
    if rx_.shape != (n, 3) or tx_.shape != (n, 3) or any(each.shape != (n,) for each in columns):
        raise ValueError('every arrival needs tx and rx positions (n, 3), a time and a variance')
    if not (np.abs(rx_) <= LARGEST).all():
        raise ValueError(f'a receiver position is not finite or beyond {LARGEST:g} m')
    return tx_, rx_, np.column_stack(columns[:2]), np.column_stack(columns[2:])


def _problem(
    tx: FloatArray,
    rx: FloatArray,
    times: FloatArray,
    bearings: FloatArray,
    target_z: float,
    sound_speed: float,
    max_range: float,
) -> ArrivalFit:
    """The least-squares problem of the usable rows."""
    hears, sees = _usable(times), _usable(bearings)
    active: BoolArray = np.asarray(np.isfinite(tx[hears]).all(axis=-1))
    toa, var_toa = times[hears].T
    # Passive times may count from any epoch: from their own first arrival they keep their digits.
    epoch = float(toa[~active].min(initial=np.inf))
    path = sound_speed * (toa - np.where(active, 0.0, epoch))
    variance = np.concatenate([sound_speed**2 * var_toa, bearings[sees, 1]])
    return ArrivalFit(
        tx=np.where(active[:, None], tx[hears], rx[hears]),
        rx=rx[hears],
        active=active,
        bearing_rx=rx[sees],
        observed=np.concatenate([path, bearings[sees, 0]]),
        weight=1.0 / variance,
        target_z=target_z,
        max_range=max_range,
        epoch=epoch,
    )


def _usable(rows: FloatArray) -> BoolArray:
    """Which (n,) of the pairs of value and variance (n, 2) hold a measurement."""
    value, variance = rows.T
    return np.asarray(
        (np.abs(value) <= LARGEST) & (variance >= LARGEST**-2) & (variance <= LARGEST**2)
    )


def _spread(kept: BoolArray, usable: BoolArray) -> BoolArray:
    """What was kept of the usable rows, for all rows (n,)."""
    out = usable.copy()
    out[usable] = kept
    return out


def _dof(fit: ArrivalFit, kept: BoolArray) -> int:
    """Rows less unknowns: x, y and, where passive rows are kept, the time of emission."""
    return int(kept.sum()) - 2 - int((kept[: len(fit.rx)] & ~fit.active).any())


def _p_value(cost: float, dof: int) -> float:
    return float(chdtrc(dof, cost)) if dof > 0 else 1.0


def _search(fit: ArrivalFit, limits: Limits) -> tuple[BoolArray, Minima]:
    """Which rows (m,) to keep, and the minima of the sum of squares over them, best first."""
    kept = np.ones(len(fit.weight), bool)
    minima = minimise(fit, fit.starts(fit.weight), fit.weight).distinct()
    for _ in range(limits.max_outliers):
        dof = _dof(fit, kept)
        if dof < 2 or not len(minima.cost) or _p_value(minima.cost[0], dof) >= limits.min_p_value:
            break
        seeds = minima.position[:SEEDS]
        suspects = _suspects(fit, seeds, kept)
        weights = fit.weight * kept * (1.0 - np.eye(len(kept)))[suspects]
        trials = minimise(
            fit, np.tile(seeds, (len(suspects), 1)), np.repeat(weights, len(seeds), axis=0)
        )
        kept[suspects[int(np.argmin(trials.cost)) // len(seeds)]] = False
        weight = fit.weight * kept
        afresh = minimise(fit, fit.starts(weight), weight)
        # Leaving out another row may do as well and lead elsewhere: such fixes compete too.
        minima = afresh.joined(trials).distinct()
    return kept, minima


def _suspects(fit: ArrivalFit, seeds: FloatArray, kept: BoolArray) -> IndexArray:
    """The rows kept (m,), in their order, that may be the one to leave out: all, or the
    `MOST_SUSPECTS` that are furthest from what some of the seeds (k, 2) would cause."""
    rows = np.flatnonzero(kept)
    if len(rows) <= MOST_SUSPECTS:
        return rows
    weight = fit.weight * kept
    residual, _ = fit.residuals(seeds, weight)
    misfit = (weight * np.square(residual)).max(axis=0)[rows]
    return rows[np.sort(np.argsort(-misfit, kind='stable')[:MOST_SUSPECTS])]


def _candidates(fit: ArrivalFit, minima: Minima) -> list[Candidate]:
    """The minima in range that match the best one or nearly so, apart from each other."""
    near = np.linalg.norm(minima.position - fit.centre, axis=-1) <= fit.max_range
    level = minima.cost <= minima.cost[0] + AMBIGUITY_COST
    found: list[Candidate] = []
    for index in np.flatnonzero(near & level):
        position = minima.position[index]
        if all(other.distance2(position) > DISTINCT for other in found):
            cost = float(minima.cost[index])
            found.append(Candidate(position, _covariance(fit, minima.information[index]), cost))
    return found


def _covariance(fit: ArrivalFit, information: FloatArray) -> FloatArray:
    """The covariance (2, 2) of a fix with this information (2, 2).

    That the target is in range is the weakest of priors, and keeps the inverse finite. On the
    line of a line array accurate times leave one direction unknown: what is known of the other
    is then no more than numbers can hold beside it.
    """
    least = 1.0 / fit.max_range**2
    (a, b), (_, d) = information.tolist()
    # The larger eigenvalue times the smaller one is the determinant.
    larger = 0.5 * (a + d) + math.hypot(0.5 * (a - d), b)
    if larger**2 <= MOST_CONDITION * max(a * d - b * b, larger * least):
        return np.asarray(np.linalg.inv(information + least * np.eye(2)))
    known, axes = np.linalg.eigh(information)
    known = np.maximum(known, 0.0) + least
    known[1] = min(known[1], MOST_CONDITION * known[0])
    return np.asarray((axes / known) @ axes.T)


def _doubt(
    fit: ArrivalFit, weight: FloatArray, best: Candidate, dof: int, limits: Limits
) -> Refusal | None:
    """Why the best candidate is refused, or None."""
    variances, axes = np.linalg.eigh(best.covariance)
    if variances[1] > limits.max_std**2 or variances[1] > limits.max_condition * variances[0]:
        return Refusal(
            'singular_geometry',
            f'the geometry leaves a standard deviation of {np.sqrt(variances[1]):.3g} m',
        )
    aside = ASIDE * (axes * np.sqrt(variances)).T
    around = fit.cost(best.position + np.concatenate([aside, -aside]), weight)
    rise = (around - best.cost) / ASIDE**2
    if rise.min() < QUADRATIC[0] or rise.max() > QUADRATIC[1]:
        return Refusal(
            'singular_geometry',
            'around the fix the likelihood is not what its '
            'covariance says, as near the line between transmitter and receiver',
        )
    p_value = _p_value(best.cost, dof)
    if p_value < limits.min_p_value:
        return Refusal(
            'poor_fit',
            f'chi-square {best.cost:.4g} with {dof} degrees of freedom (p = {p_value:.2g})',
        )
    return None


def _emission(
    fit: ArrivalFit, kept: BoolArray, best: Candidate, sound_speed: float
) -> tuple[float | None, float | None]:
    """Time of emission and its variance from the passive rows kept; None without such rows."""
    rows = np.flatnonzero(kept[: len(fit.rx)] & ~fit.active)
    if not len(rows):
        return None, None
    time, variance = emission_time(
        fit.observed[rows] / sound_speed,
        1.0 / (sound_speed**2 * fit.weight[rows]),
        fit.rx[rows],
        best.position,
        target_z=fit.target_z,
        sound_speed=sound_speed,
        covariance=best.covariance,
    )
    return fit.epoch + time, variance
