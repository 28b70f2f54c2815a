# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An interacting multiple model particle filter for any motion and any sensor, ready to use.

>>> import numpy as np
>>> from sonar_imm import ParticleIMM
>>> def walk(std):  # of a depth, m in a second
...     return lambda x, rng, dt: x + rng.normal(0.0, std * np.sqrt(dt), x.shape)
>>> def echo(x, z):  # its errors have heavy tails
...     return -np.abs(z - x[:, 0]) / 0.2
>>> rng = np.random.default_rng(1)
>>> floor = ParticleIMM(
...     models={'flat': walk(0.02), 'rough': walk(1.0)},
...     transition=[[0.98, 0.02], [0.1, 0.9]],
...     particles=rng.normal(20.0, 1.0, (2000, 1)),
...     log_likelihood=echo,
...     rng=rng,
... )
>>> steps = [floor.step(z) for z in (20.0, 20.1, None, 20.0, 22.4, 23.9)]  # m; None: no echo
>>> steps.pop()
'used'
>>> floor.estimate.mean.round(0).tolist(), floor.model_probabilities.round(1).tolist()
([24.0], [0.0, 1.0])

Each model keeps N particles of its own, and the cycle is that of every filter here:

1. *mix*: model j draws N particles from those of all models i, by systematic resampling with the
   weights ``P_ij mu_i w_in / c_j``, ``c_j = sum_i P_ij mu_i``. This is exact as N grows, where the
   Gaussian filter replaces the mixture by its moments. A model that no other leads to keeps its
   weighted particles for as long as their effective number is large enough.
2. *predict*: each model moves its particles.
3. *update*: ``w_jn <- w_jn q_jn / L_j`` with the likelihoods q of the particles, ``L_j = sum_n
   w_jn q_jn``, and ``mu_j`` proportional to ``c_j L_j``.
4. *combine*: moments of all particles of all models.

Source: Saucan, Chonavel, Sintes, Le Caillec, *Interacting multiple model particle filters for side
scan bathymetry*, OCEANS 2013; Boers, Driessen, *Interacting multiple model particle filter*, IEE
Proc. Radar 150(5), 2003.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from . import imm
from .arrays import FloatArray
from .imm_filter import Estimate, Verdict
from .markov import ModelChain, RateChain
from .particles import effective_sample_size, normalise, systematic

__all__ = ['ParticleIMM']

Propagate = Callable[[FloatArray, np.random.Generator, float], ArrayLike]
LogLikelihood = Callable[[FloatArray, Any], ArrayLike]


class ParticleIMM:
    """A bootstrap particle filter of several models.

    models: by name (M of them), ``propagate(particles, rng, dt)``, which draws particles (N, n) dt
    seconds later. transition: (M, M), ``transition[i, j] = Pr(model j | model i before)`` over
    `dt` seconds, from whose generator that of other steps follows; or a `markov.RateChain`.
    particles: (N, n) at the start, the same for all models, or (M, N, n). log_likelihood:
    ``log_likelihood(particles, z)`` (N,), natural logarithms up to a constant, -inf for what is
    impossible; one for all models or by name. rng: source of all randomness; the same seed and
    input give the same bytes. initial: (M,) model probabilities, uniform if not given.
    resample_below: least effective number of particles, as a share of N, that a model keeps.
    stamp: of the start [s]; None: a step of `dt` before the first measurement, or its stamp.

    names: (M,); particles: (M, N, n), weights: (M, N), those of each model sum to one;
    model_probabilities: (M,); log_likelihood: of the newest measurement given those before it, NaN
    where it was missed, -inf where no particle explains it and the prediction was kept.

    Raises ValueError for what does not fit together.
    """

    def __init__(
        self,
        models: Mapping[str, Propagate],
        transition: ArrayLike | RateChain,
        particles: ArrayLike,
        log_likelihood: LogLikelihood | Mapping[str, LogLikelihood],
        rng: np.random.Generator,
        *,
        dt: float = 1.0,
        initial: ArrayLike | None = None,
        resample_below: float = 0.5,
        stamp: float | None = None,
    ):
        self.names, self._moves = tuple(models), tuple(models.values())
        M = len(self.names)
        if not M:
            raise ValueError('models need at least one')
        if callable(log_likelihood):
            self._sensors = (log_likelihood,) * M
        elif set(log_likelihood) == set(self.names):
            self._sensors = tuple(log_likelihood[name] for name in self.names)
        else:
            raise ValueError(
                f'log_likelihood is one function or one for each of {", ".join(self.names)}, got '
                f'{", ".join(log_likelihood) or "none"}'
            )
        if not isinstance(rng, np.random.Generator):
            raise ValueError(f'rng has to be a numpy.random.Generator, got {rng!r}')
        if not 0.0 <= resample_below <= 1.0:
            raise ValueError(f'resample_below is a share between 0 and 1, got {resample_below}')
        start = np.array(particles, np.float64)
        if start.ndim == 2:
            start = np.tile(start, (M, 1, 1))
        if start.ndim != 3 or len(start) != M or not start.size or not np.isfinite(start).all():
            raise ValueError(
                f'particles need finite numbers of shape (N, n) or ({M}, N, n), got shape '
                f'{np.shape(particles)}'
            )
        self._chain = ModelChain(transition, dt, M, initial)
        N = start.shape[1]
        self._rng, self._least = rng, resample_below * N
        self.particles: FloatArray = start
        self.weights: FloatArray = np.full((M, N), 1.0 / N)
        self.model_probabilities = self._chain.initial
        self.log_likelihood = math.nan
        self._stamp = stamp

    def step(self, z: Any, dt: float | None = None, *, stamp: float | None = None) -> Verdict:
        """Mix, predict and update by a measurement.

        :param z: anything that log_likelihood takes; None where nothing was measured.
        :param dt: seconds after the step before, by default `dt` of the filter.
        :param stamp: time in s instead of dt.
        :returns: ``used``, or ``too_late`` for a stamp before the newest, which changes nothing:
            particles are not computed again.
        :raises ValueError: for dt and stamp together or a dt below 0, and for functions that give
            arrays of another shape, particles that are not finite, or log-likelihoods that are
            NaN or +inf.
        """
        if stamp is not None and dt is not None:
            raise ValueError('a step has dt or stamp, not both')
        if stamp is not None:
            seconds = stamp - (stamp if self._stamp is None else self._stamp)
            if seconds < 0.0:
                return 'too_late'
        else:
            seconds = self._chain.step if dt is None else dt
        if not 0.0 <= seconds < math.inf:
            raise ValueError(f'dt is finite and cannot be negative, got {seconds}')
        x, w, c = self._mixed(self._chain.over(seconds))
        x = np.stack([self._moved(j, each, seconds) for j, each in enumerate(x)])
        mu, found = c, math.nan
        if z is not None:
            q = np.stack([self._log_likelihood(j, each, z) for j, each in enumerate(x)])
            with np.errstate(divide='ignore'):
                after, log_L = normalise(np.log(w) + q)
                joint, total = normalise(np.log(c) + log_L)
            found = float(total)
            if found > -math.inf:
                w, mu = np.where(log_L[:, None] > -math.inf, after, w), joint
        self.particles, self.weights = x, w
        self.model_probabilities, self.log_likelihood = mu, found
        self._stamp = self.stamp + seconds if stamp is None else stamp
        return 'used'

    @property
    def stamp(self) -> float:
        """Time of the newest estimate [s]; 0 at the start if none was given."""
        return 0.0 if self._stamp is None else self._stamp

    @property
    def estimate(self) -> Estimate:
        """Mean (n,) and covariance (n, n) of the newest state, over all models."""
        mean = np.einsum('jk,jka->ja', self.weights, self.particles)
        d = self.particles - mean[:, None]
        P = np.einsum('jk,jka,jkb->jab', self.weights, d, d)
        one = np.tile(np.eye(mean.shape[1]), (len(mean), 1, 1))
        total = imm.combine(mean[None], P[None], self.model_probabilities[None], one)
        return Estimate(total[0][0], total[1][0])

    @property
    def effective_sample_size(self) -> FloatArray:
        """Effective number of particles (M,) of each model, from 1 to N."""
        return effective_sample_size(self.weights)

    def _mixed(self, transition: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return particles (M, N, n) and weights (M, N) mixed for each model, and the predicted
        probabilities c (M,)."""
        mu, count = self.model_probabilities, self.weights.shape[1]
        W = transition * mu[:, None]
        c = W.sum(axis=0)
        # What nothing can become starts from the mixture of all, so that it can come back.
        W = np.where(c > imm.DEAD, W, mu[:, None])
        alone = (np.count_nonzero(W, axis=0) == 1) & (np.diag(W) > 0.0)
        kept = alone & (self.effective_sample_size >= self._least)
        x, w = self.particles.copy(), self.weights.copy()
        together = np.concatenate(self.particles)
        for j in np.flatnonzero(~kept):
            drawn = systematic((W[:, j, None] * self.weights).ravel(), count, self._rng)
            x[j], w[j] = together[drawn], 1.0 / count
        return x, w, c

    def _moved(self, j: int, x: FloatArray, dt: float) -> FloatArray:
        shape = x.shape
        moved = np.asarray(self._moves[j](x, self._rng, dt), np.float64)
        if moved.shape != shape or not np.isfinite(moved).all():
            raise ValueError(
                f"model '{self.names[j]}' has to give finite particles of shape {shape}, got "
                f'shape {moved.shape}'
            )
        return moved

    def _log_likelihood(self, j: int, x: FloatArray, z: Any) -> FloatArray:
        q = np.asarray(self._sensors[j](x, z), np.float64)
        if q.shape != x.shape[:1] or not (q < math.inf).all():
            raise ValueError(
                f"log_likelihood of model '{self.names[j]}' has to give {len(x)} numbers, none of "
                f'them NaN or +inf, got shape {q.shape}'
            )
        return q
