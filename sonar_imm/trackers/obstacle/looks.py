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

"""What it says of an obstacle's height that it is no longer seen (`misses: evidence`).

Where an obstacle lies at the elevation eps, a ping shows it with the probability p B(eps): p is
how often this obstacle gives an echo inside the beam, B the pattern of the beam, 1 inside and 0
outside. So with the depth z of a component N(m, S), and eps = eps(m) + (z - m) / d, a ping
multiplies the density of z by

    f(z) = 1 - p B(z)                        without an echo,
    f(z) = outlier + (1 - outlier) B(z)      with one, which may not be the obstacle's.

B is the difference of two normal distribution functions, so that Z = E f is known in closed form;
Z weighs the component, and its derivatives give mean and covariance of what is left of it,

    x + P[:, z] (log Z)',    P + P[:, z] P[z, :] (log Z)''.

Used is the last echo and the misses since: where it was seen then, and is not now. The next echo
shows that it was in the beam all the time, and only faint; so the filter goes on without all this,
and what is published is a copy. A beam that is higher than stated therefore harms no track. Nor
does the life of a track depend on it: misses that put an obstacle out of the beam would excuse
themselves.

p is learned when an echo comes, from how many misses it ends. So misses of what always gave an
echo say a lot, and those of what flickers little. Where exactly a beam ends is not known: its
pattern falls off, and how far out an obstacle is still seen depends on its strength. That error is
the same in every ping, so a tenth to both sides of the edge (`filters.EDGE`) an echo is believed
as inside and a miss as outside.

Source: docs/obstacle.md, section Misses; Minka 2001, 'A family of algorithms for approximate
Bayesian inference', for the moments.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from .filters import DepthSlices, Mixture, Sonar

PINGS = 10.0
"""As many pings in the beam the stated probability of a detection counts for."""
SUREST = 0.95
"""Largest p: an echo may also be given to a neighbour."""


class Looks(NamedTuple):
    """Of T tracks: `seen` (T,), pings with an echo; `due` (T,), pings up to the last echo in which
    the beam held the obstacle; `missed` (T,), expected number of pings since, in which it did;
    `silent` (T,), whether the newest ping had none; `shown`: the mixture with what the last echo
    and the misses since say."""

    seen: Annotated[FloatArray, 'T']
    due: Annotated[FloatArray, 'T']
    missed: Annotated[FloatArray, 'T']
    silent: Annotated[BoolArray, 'T']
    shown: Mixture

    @staticmethod
    def first(mixture: Mixture, silent: bool = False) -> Looks:
        """Of tracks that begin, with an echo or, out of memory, without."""
        T = len(mixture.mu)
        return Looks(np.ones(T), np.ones(T), np.zeros(T), np.full(T, silent), mixture)

    def rows(self, which: np.ndarray) -> Looks:
        seen, due, missed, silent, shown = self
        return Looks(seen[which], due[which], missed[which], silent[which], shown.rows(which))

    def joined(self, other: Looks) -> Looks:
        seen, due, missed, silent = (np.concatenate(both) for both in zip(self[:4], other[:4]))
        return Looks(seen, due, missed, silent, self.shown.joined(other.shown))

    def advanced(self, filter_: DepthSlices, before: Sonar, after: Sonar, dt: float) -> Looks:
        """As the sonar will see the obstacles `dt` seconds later."""
        silent = np.flatnonzero(self.silent)
        if not len(silent):
            return self
        later, _ = filter_.advance(self.shown.rows(silent), before, after, dt)
        return self._replace(shown=self.shown.replaced(silent, later))

    def after(
        self, hit: BoolArray, mixture: Mixture, filter_: DepthSlices, sonar: Sonar, last: Sonar
    ) -> Looks:
        """With one more ping, which had an echo of the tracks where `hit` (T,); last: the sonar in
        the ping before."""
        silent, fresh = np.flatnonzero(~hit), np.flatnonzero(~hit & ~self.silent)
        shown = filter_.seen(mixture, sonar, sonar)
        if len(silent):
            shown = shown.replaced(silent, self.shown.rows(silent))
        if len(fresh):
            shown = shown.replaced(fresh, filter_.seen(mixture.rows(fresh), sonar, last))
        due = np.where(hit, self.due + 1.0 + self.missed, self.due)
        missed = np.where(hit, 0.0, self.missed)
        if len(silent):
            mean = np.einsum('tk,tk->t', mixture.mu[silent], mixture.x[silent, :, 0])
            stated = filter_.config.detection_at(mean)
            p = (PINGS * stated + self.seen[silent]) / (PINGS + self.due[silent])
            later, inside = filter_.missed(shown.rows(silent), np.minimum(p, SUREST), sonar)
            shown = shown.replaced(silent, later)
            missed[silent] += inside
        return Looks(self.seen + hit, due, missed, ~hit, shown)
