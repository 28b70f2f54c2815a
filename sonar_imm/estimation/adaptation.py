# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Transition probabilities that adapt to the data of each target.

The chain itself does not change. Each transition gets a *correction* factor on the matrix of the
next step: ``P(dt) = rownorm(P0(dt) * correction)``. So adaptation works at irregular steps.

The correction follows from a Dirichlet prior. Expected transitions ``n_ij += W_ij mu_j``, W the
mixing weights, plus a prior of `weight` transitions per row, are divided by the transitions
predicted by the nominal chain. At a constant step, ``P = rownorm(n + weight P0)``, the posterior
mean.

With families of models, only transitions inside each family adapt: transitions between families
are too rare.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .arrays import FloatArray, IndexArray, IntArray


class Chain(Protocol):
    """A Markov chain of models, such as `markov.RateChain`."""

    matrix: FloatArray
    step: float

    def transition(self, dt: float) -> FloatArray:
        """Return P(dt), (M, M)."""
        ...


class AdaptiveChain:
    """A chain with corrections from the data of T targets.

    The caller stores the transition counts: `initial_counts` creates them, `learn` updates them.

    :param weight: number of transitions per row of the prior.
    :param family: (M,) family of each model, for adaptation inside families only.
    :param learns: False for the nominal chain.
    """

    def __init__(
        self,
        chain: Chain,
        *,
        weight: float = 2.0,
        family: IntArray | None = None,
        learns: bool = True,
    ):
        self.chain = chain
        self.weight = weight
        M = len(chain.matrix)
        family = np.zeros(M, np.int64) if family is None else family
        # The E adaptive transitions, row by row.
        self._i, self._j = np.nonzero((family[:, None] == family) & learns)
        self._first = np.flatnonzero(np.diff(self._i, prepend=-1))
        self._prior = weight * chain.matrix[self._i, self._j]

    def initial_counts(self, targets: int) -> FloatArray:
        """Return initial counts (targets, 2, E): observed and expected transitions of E adaptive
        ones."""
        return np.zeros((targets, 2, len(self._i)))

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        """Return the matrices of a step of dt seconds:

        (targets, M, M), or (1, M, M) without adaptation.
        """
        nominal = self.chain.transition(dt)
        if not len(self._i):
            return np.array(nominal[None])
        given = learnt[:, 1] + self._prior
        known = given > 0.0
        factor = np.where(known, (learnt[:, 0] + self._prior) / np.where(known, given, 1.0), 1.0)
        due = nominal[self._i, self._j]
        changed = due * factor
        total = np.add.reduceat(changed, self._first, axis=1)[:, self._i]
        kept = np.add.reduceat(due, self._first)[self._i]
        out = np.repeat(nominal[None], len(learnt), axis=0)
        possible = total > 0.0
        out[:, self._i, self._j] = np.where(
            possible, changed / np.where(possible, total, 1.0) * kept, due
        )
        return out

    def learn(
        self,
        learnt: FloatArray,
        transition: FloatArray,
        mu_before: FloatArray,
        mu_after: FloatArray,
        dt: float,
        hit: IndexArray | None = None,
    ) -> FloatArray:
        """Return the transition counts after a step.

        :param transition: (targets or 1, M, M) used in the step.
        :param mu_before: (targets, M) model probabilities before the step.
        :param mu_after: (targets, M) model probabilities after the update.
        :param hit: indices of measured targets, all by default. A miss contains no information on
            transitions.
        """
        if not len(self._i):
            return learnt
        hit = np.arange(len(learnt)) if hit is None else hit
        used = transition if len(transition) == 1 else transition[hit]
        joint = used * mu_before[hit][:, :, None]
        reach = joint.sum(axis=1)
        share = mu_after[hit] / np.where(reach > 0.0, reach, 1.0)
        posterior = joint * share[:, None]
        nominal = self.chain.transition(dt)[self._i, self._j]
        out = learnt.copy()
        out[hit, 0] += posterior[:, self._i, self._j]
        out[hit, 1] += posterior.sum(axis=2)[:, self._i] * nominal
        return out
