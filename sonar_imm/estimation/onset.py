# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a floor begins in the traces of a line: a chain along the depth, and one along the line.

Along the depth a trace is, sample by sample from the top,

    transmit pulse [0, r)        loud
    water          [r, k)        quiet, but for runs of what is loud: fish
    onset          [k, k + w)    loud, or in a few of the traces faded: quiet
    below          [k + w, n)    runs of either, that begin loud below a loud onset

with the log likelihoods of a sample as quiet, loud or onset, each times `temper`: samples within a
pulse say the same. The last cell stands for a floor that is not in the window.

Along the line the onset walks, by the distances of `WALK`, or jumps anywhere; the end of the
transmit pulse stays. Both are kept as they are found by all traces so far, each by itself, and the
sums over all r, k, fish and runs are exact: one pass down and one up. Causal: nothing waits for
later traces.

Source: L. R. Rabiner, *A tutorial on hidden Markov models*, Proceedings of the IEEE 77 (1989).
"""

from __future__ import annotations

from functools import cached_property
import math
from typing import Annotated

from attrs import define, field, frozen
import numpy as np

from .arrays import FloatArray
from .onset_kernels import onset_pass
from .particles import normalise

__all__ = ['OnsetChain', 'OnsetState']

WALK = (0.75, 0.15), (0.2, 0.6), (0.05, 1.5)
"""Share and standard deviation, m, of the ways the onset goes from trace to trace."""
LEAVE_FISH, ENTER_BELOW, LEAVE_BELOW = 1.0, 0.1, 0.25
"""Probability per metre that a run of fish ends, and that runs below begin and end."""
RING_STAYS, RING_SHARE, RING_SPREAD = 0.98, 0.35, 1e-3
RING_LONGER, RING_BEYOND = 2.0, 20
"""By how many times, and samples besides, the transmit pulse is longer than at the first look."""
_REACH = 6.0


@frozen(eq=False)
class OnsetState:
    """Posterior of the onset (n,), the last cell for none, and of the transmit pulse (R,)."""

    onset: Annotated[FloatArray, 'n']
    ring: Annotated[FloatArray, 'r']

    @property
    def found(self) -> int:
        """The most probable onset, -1 where there is probably none."""
        best = int(np.argmax(self.onset))
        return -1 if best == len(self.onset) - 1 else best

    @property
    def ring_length(self) -> int:
        """The most probable length of the transmit pulse, samples."""
        return int(np.argmax(self.ring))


@define(eq=False, slots=False)
class OnsetChain:
    """For traces of `cells` samples `step` m apart: pulse, m; ring: samples of the transmit pulse
    at a first look, -1 where there can be none; jump: probability per trace; fish_rate: runs of
    fish per m."""

    step: float
    cells: int
    pulse: float
    ring: int
    jump: float = 0.005
    fish_rate: float = 0.001
    temper: float = field(init=False)
    window: int = field(init=False)

    def __attrs_post_init__(self) -> None:
        self.temper = min(1.0, 0.5 * self.step / self.pulse)
        self.window = max(2, round(2.0 * self.pulse / self.step))

    @cached_property
    def _kernel(self) -> FloatArray:
        """Probabilities of the walk (2 m + 1,) by distance in cells."""
        reach = min(max(1, int(_REACH / self.step)), self.cells - 1)
        away = self.step * np.arange(-reach, reach + 1)
        walk = np.zeros(len(away))
        for share, std in WALK:
            density = np.exp(-0.5 * np.square(away / math.hypot(std, 0.3 * self.step)))
            walk += share * density / density.sum()
        return walk

    @cached_property
    def _ring_prior(self) -> FloatArray:
        if self.ring < 0:
            return np.ones(1)
        # The look sees it down to a tenth of the loudest.
        longest = min(RING_SHARE * self.cells, RING_LONGER * self.ring + RING_BEYOND)
        cell = np.arange(max(1, int(longest)))
        away = np.abs(cell - self.ring)
        prior = np.exp(-0.5 * away) + RING_SPREAD * np.exp(-away * self.step)
        return np.asarray(prior / prior.sum())

    def start(self) -> OnsetState:
        """Before the first trace."""
        return OnsetState(np.full(self.cells, 1.0 / self.cells), self._ring_prior)

    def predict(self, state: OnsetState) -> OnsetState:
        """Before the next trace."""
        walk = self._kernel
        half = len(walk) // 2
        onset = np.convolve(state.onset, walk)[half : half + self.cells]
        onset = (1.0 - self.jump) * onset + self.jump / self.cells
        ring = RING_STAYS * state.ring + (1.0 - RING_STAYS) * self._ring_prior
        return OnsetState(onset / onset.sum(), ring)

    def update(
        self, state: OnsetState, quiet: FloatArray, loud: FloatArray, onset: FloatArray
    ) -> OnsetState:
        """After a trace, by the log likelihoods (n,) of its samples as each kind; state: of
        `start` or of the trace before."""
        before = self.predict(state)
        rates = np.array(
            [
                min(0.5, self.fish_rate * self.step),
                min(0.5, LEAVE_FISH * self.step),
                min(0.5, ENTER_BELOW * self.step),
                min(0.5, LEAVE_BELOW * self.step),
            ]
        )
        with np.errstate(divide='ignore'):
            prior = np.log(before.onset), np.log(before.ring)
        found, ring = np.empty(self.cells), np.empty(len(before.ring))
        a = self.temper
        onset_pass(a * quiet, a * loud, a * onset, *prior, rates, self.window, found, ring)
        return OnsetState(normalise(found)[0], normalise(ring)[0])
