# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Transition probabilities that are learnt from the data, for each target by itself.

Learning does not change the chain. It gives a *correction*, a factor for each transition, that is
applied to the matrix of the next step: ``P(dt) = rownorm(P0(dt) * correction)``. So it works at
irregular steps too.

The correction is that of a Dirichlet prior: expected transitions ``n_ij += W_ij mu_j``, W the
mixing weights, on top of a prior worth `weight` transitions per row, against those that the
nominal chain predicts. At a constant step it is ``P = rownorm(n + weight P0)``, the mean of the
posterior.

Where the models are families, a target learns inside each family only: how often it goes from one
to another is too rare to be learnt from one target.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from .arrays import FloatArray, IndexArray, IntArray


class Chain(Protocol):
    """A Markov chain over models, such as `markov.RateChain`."""

    matrix: FloatArray
    step: float

    def transition(self, dt: float) -> FloatArray:
        """P(dt), (M, M)."""
        ...


class AdaptiveChain:
    """A chain and the way the data of T targets correct it. What was learnt is a value that the
    caller keeps: `fresh` makes it, `learn` updates it.

    weight: how many transitions per row the prior is worth; family (M,): the family of each model,
    where targets learn inside of families only; learns: False for the chain as it is.
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
        # The E transitions that can be learnt, row by row.
        self._i, self._j = np.nonzero((family[:, None] == family) & learns)
        self._first = np.flatnonzero(np.diff(self._i, prepend=-1))
        self._prior = weight * chain.matrix[self._i, self._j]

    def initial_counts(self, targets: int) -> FloatArray:
        """Return what is known before anything was learnt: (targets, 2, E), transitions seen and
        expected, of the E that can be learnt."""
        return np.zeros((targets, 2, len(self._i)))

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        """Return the matrices of a step of dt seconds: (targets, M, M), or (1, M, M) when nothing
        can be learnt."""
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
        """Return what is learnt after a step that used `transition` (targets or 1, M, M) and took
        the model probabilities (targets, M) from `mu_before` to `mu_after`. Only the targets `hit`
        (all by default), which were measured, learn: a miss holds no information on
        transitions."""
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
