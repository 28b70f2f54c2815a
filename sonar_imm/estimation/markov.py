# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Markov chains over models: checks, stationary distribution, irregular time steps, persistence.

Convention: ``P[i, j] = Pr(model j at k | model i at k-1)``; rows sum to one.

A chain is stated at a reference step, but measurements of a sonar come at irregular times.
`RateChain` turns the matrix into a generator once, ``P(step) = expm(G step)``, and gives ``P(dt)``
for any step, so that ten steps of 0.1 s equal one of 1 s. `ModelChain` is what a filter takes: a
matrix or such a chain, with the probabilities at the start. `adaptation` corrects a chain by data.

``P(dt)`` is computed by uniformisation: with the largest rate q, ``U = I + G / q`` is itself a
transition matrix, and ``P(h) = sum_k Poisson(k; q h) U^k`` is a mixture of its powers, which are
kept. No term is negative, so there is nothing to cancel, and no eigenvector is asked for, so a
defective generator is nothing special. A long step is halved until ``q h <= 1`` and the result
squared.

Reference: Stewart, *Introduction to the Numerical Solution of Markov Chains* (1994), ch. 8.
"""

from __future__ import annotations

from collections import OrderedDict
import math

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray, IntArray

NOT_EMBEDDABLE = 1e-6
"""A chain whose generator misses the matrix by more has none."""

_CACHED_STEPS = 256
_TERMS = 24
"""Of the series for at most one event a step, whose tail is then below 1e-24."""


def check_transition_matrix(
    matrix: ArrayLike, *, atol: float = 1e-6, name: str = 'the transition matrix'
) -> FloatArray:
    """Return `matrix` as (M, M) float64 with rows renormalised to one; ValueError, which calls it
    `name`, when it is not a transition matrix."""
    P = np.array(matrix, dtype=np.float64)
    if P.ndim != 2 or P.shape[0] != P.shape[1] or not len(P):
        raise ValueError(f'{name} has to be square, its shape is {P.shape}')
    if not np.isfinite(P).all() or (P < 0.0).any() or (P > 1.0 + atol).any():
        raise ValueError(f'{name} has to hold probabilities between 0 and 1')
    sums = P.sum(axis=1)
    worst = int(np.argmax(np.abs(sums - 1.0)))
    if abs(sums[worst] - 1.0) > atol:
        raise ValueError(f'row {worst} of {name} sums to {sums[worst]:.6g}, not 1')
    return P / sums[:, None]


class RateChain:
    """A chain stated at `step` seconds, usable at any step.

    The generator is the matrix logarithm. For some matrices it has negative rates and is not
    valid. Those rates are set to zero, and `residual` says how far ``P(step)`` then is from the
    matrix given (0 when the matrix is embeddable).

    >>> chain = RateChain([[0.9, 0.1], [0.2, 0.8]], step=1.0)
    >>> chain.transition(2.0).round(6).tolist()  # the square of the matrix
    [[0.83, 0.17], [0.34, 0.66]]
    """

    def __init__(self, matrix: ArrayLike, step: float):
        if not step > 0.0:
            raise ValueError(f'the reference step must be positive, got {step}')
        self.matrix = check_transition_matrix(matrix)
        self.step = float(step)
        self._settle(_generator(self.matrix, self.step))
        self.residual = float(np.abs(self._exponential(self.step) - self.matrix).max())

    @classmethod
    def of_generator(cls, generator: FloatArray, step: float) -> RateChain:
        """The chain of rates (M, M), per second, whose rows sum to zero."""
        chain = cls.__new__(cls)
        chain.step, chain.residual = float(step), 0.0
        chain._settle(generator)
        chain.matrix = chain._exponential(step)
        return chain

    def _settle(self, generator: FloatArray) -> None:
        self.generator = generator
        self._fastest = float(np.abs(generator).max())
        self._powers = _powers(generator, self._fastest)
        self._cache: OrderedDict[float, FloatArray] = OrderedDict()

    def transition(self, dt: float) -> FloatArray:
        """P(dt), (M, M), read-only. The matrix as given when dt is the reference step and it is
        embeddable."""
        if not 0.0 <= dt < math.inf:
            raise ValueError(f'a time step is finite and cannot be negative, got {dt}')
        found = self._cache.get(dt)
        if found is None:
            found = self._compute(dt)
            found.flags.writeable = False
            self._cache[dt] = found
            if len(self._cache) > _CACHED_STEPS:
                self._cache.popitem(last=False)
        return found

    def _compute(self, dt: float) -> FloatArray:
        if dt == self.step and self.residual < 1e-9:
            return self.matrix.copy()
        return self._exponential(dt)

    def _exponential(self, dt: float) -> FloatArray:
        events = self._fastest * dt
        halvings = max(0, math.ceil(math.log2(events))) if events > 1.0 else 0
        mixture = _poisson(events / 2.0**halvings) @ self._powers
        P = _stochastic(mixture.reshape(self.generator.shape))
        for _ in range(halvings):
            P = _stochastic(P @ P)
        return P


class ModelChain:
    """The models of a filter as a Markov chain: probabilities at the start and over any step.

    transition: (M, M) over `step` seconds, or a `RateChain`. initial: (M,) probabilities at the
    start, uniform if None. Other steps than `step` follow from the generator of the matrix, which
    is computed when it is first needed.

    Raises ValueError when transition or initial are no probabilities of M models.
    """

    def __init__(
        self,
        transition: ArrayLike | RateChain,
        step: float,
        models: int,
        initial: ArrayLike | None = None,
    ):
        if not step > 0.0:
            raise ValueError('dt has to be positive')
        self.step = step
        self._rates = transition if isinstance(transition, RateChain) else None
        matrix = transition.transition(step) if isinstance(transition, RateChain) else transition
        self.matrix = check_transition_matrix(matrix)
        mu = np.full(models, 1.0 / models) if initial is None else initial
        self.initial = np.array(mu, np.float64)
        if self.matrix.shape != (models, models) or not _are_probabilities(self.initial, models):
            raise ValueError(
                f'transition and initial need {models} x {models} and {models} probabilities'
            )

    def over(self, dt: float) -> FloatArray:
        """Return the transition matrix (M, M) over dt seconds. Raises ValueError where the matrix
        has no generator and dt is not its step."""
        if dt == self.step:
            return self.matrix
        if self._rates is None:
            rates = RateChain(self.matrix, self.step)
            if rates.residual > NOT_EMBEDDABLE:
                raise ValueError(
                    'the transition matrix has no generator, so only steps of dt = '
                    f'{self.step:g} s can be taken, not of {dt:g} s'
                )
            self._rates = rates
        return self._rates.transition(dt)


def _are_probabilities(mu: FloatArray, models: int) -> bool:
    return mu.shape == (models,) and bool((mu >= 0.0).all()) and abs(mu.sum() - 1.0) <= 1e-6


def _stochastic(P: FloatArray) -> FloatArray:
    """Rows that add up to one but for rounding, made to: an error kept would grow with P @ P."""
    return np.asarray(P / P.sum(axis=-1, keepdims=True))


def _powers(generator: FloatArray, fastest: float) -> FloatArray:
    """U^0, U^1, ... as rows (_TERMS, M M), U = I + G / fastest."""
    M = len(generator)
    U = np.eye(M) + generator / fastest if fastest > 0.0 else np.eye(M)
    U = _stochastic(np.clip(U, 0.0, None))
    powers = [np.eye(M)]
    for _ in range(_TERMS - 1):
        powers.append(_stochastic(powers[-1] @ U))
    return np.reshape(powers, (_TERMS, M * M))


def _poisson(mean: float) -> FloatArray:
    """Pr(k events), k = 0 .. _TERMS - 1, but for a factor that all have."""
    return np.cumprod(np.concatenate([[1.0], mean / np.arange(1, _TERMS)]))


def _generator(P: FloatArray, step: float) -> FloatArray:
    if np.array_equal(P, np.eye(len(P))):
        return np.zeros_like(P)
    from scipy.linalg import logm

    # A zero eigenvalue (identical rows) has no logarithm: the chain forgets everything at once.
    # Mixing in a little of the identity stands for a very fast, finite rate; the residual tells
    # how little that changes.
    singular = np.abs(np.linalg.eigvals(P)).min() < 1e-9
    base = (1.0 - 1e-8) * P + 1e-8 * np.eye(len(P)) if singular else P
    G = np.real(np.asarray(logm(base), dtype=np.complex128)) / step
    np.fill_diagonal(G, 0.0)
    G = np.clip(G, 0.0, None)
    np.fill_diagonal(G, -G.sum(axis=1))
    return G


def persistent(models: int, stay: float) -> FloatArray:
    """(M, M): a model is kept with probability `stay`, else each other one is as probable.

    >>> persistent(3, 0.9).round(3).tolist()
    [[0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]]
    """
    P = np.full((models, models), (1.0 - stay) / max(models - 1, 1))
    np.fill_diagonal(P, stay if models > 1 else 1.0)
    return P


def persistent_headings(directions: int, stay: float, concentration: float) -> FloatArray:
    """Transition matrix of headings at 2 pi j / directions: stay with probability `stay`, else
    turn by an angle a with weight exp(kappa cos a), kappa = `concentration`."""
    turns = 2.0 * np.pi * np.arange(1, directions) / directions
    weights = np.exp(concentration * (np.cos(turns) - 1.0))
    row = np.concatenate([[stay], (1.0 - stay) * weights / weights.sum()])
    lag = np.arange(directions)
    return np.asarray(row[(lag[None, :] - lag[:, None]) % directions])


def with_hover(P: FloatArray, enter: float, stay: float) -> FloatArray:
    """Append a model that every other model enters with probability `enter`. It is kept with
    probability `stay` and left uniformly. `enter` scales down all entries of a row alike."""
    M = len(P)
    out = np.empty((M + 1, M + 1))
    out[:M, :M] = (1.0 - enter) * P
    out[:M, M] = enter
    out[M, :M] = (1.0 - stay) / M
    out[M, M] = stay
    return out


def family_generator(family: IntArray, blocks: list[FloatArray], rate: float) -> FloatArray:
    """Return the generator (M, M) of the chains of all families.

    The rate between two families is `rate` / 3, spread evenly over the models. Between the first
    two families the index in the family is kept.
    """
    size = np.bincount(family)
    out = np.asarray(rate / 3.0 / size[family][None] * (family[:, None] != family[None]))
    count = int(size[0])
    for a, b in ((0, 1), (1, 0)):
        kept = slice(a * count, (a + 1) * count), slice(b * count, (b + 1) * count)
        out[kept] = rate / 3.0 * np.eye(count)
    first = 0
    for block in blocks:
        own = slice(first, first + len(block))
        out[own, own] = block
        first += len(block)
    np.fill_diagonal(out, 0.0)
    np.fill_diagonal(out, -out.sum(axis=1))
    return out
