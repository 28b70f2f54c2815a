# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The chain of transmit pulse, water, onset and below: vectors, enumeration, and lines."""

import itertools
import math

from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.envelopes import log_likelihoods, transmit_samples
from sonar_imm.estimation.onset import (
    ENTER_BELOW,
    LEAVE_BELOW,
    LEAVE_FISH,
    OnsetChain,
    OnsetState,
)
from sonar_imm.estimation.onset_kernels import FADED, NO_FLOOR


@pytest.fixture(scope='module')
def vectors():
    return load_vectors('fathometer_in_the_field/floor')


def test_posterior_of_the_vectors(vectors):
    trace, step = vectors['trace'], float(vectors['step'])
    pulse, noise = float(vectors['pulse']), vectors['water_profile']
    chain = OnsetChain(step, trace.shape[1], pulse, transmit_samples(trace))
    assert chain.temper == pytest.approx(float(vectors['alpha']))
    state, off = chain.start(), []
    for k, row in enumerate(trace):
        state = chain.update(state, *log_likelihoods(row, noise, float(vectors['loudest'])))
        assert state.found == vectors['onset'][k] and np.argmax(state.ring) == vectors['ring'][k]
        if k % 6 == 0:
            off.append(0.5 * np.abs(state.onset - vectors['posterior'][k // 6]).sum())
    assert max(off) < 1e-6


def enumerated(chain, quiet, loud, onset, prior_onset, prior_ring):
    """Posterior of onset and transmit pulse from all of their values, and all runs, by name."""
    n, h, a = chain.cells, chain.step, chain.temper
    fish, leave = chain.fish_rate * h, LEAVE_FISH * h
    begin, end = ENTER_BELOW * h, LEAVE_BELOW * h

    def runs(cells, state, enter, leave):
        """Sum over all paths of quiet (0) and loud (1) over `cells`, before which it is state."""
        total = 0.0
        for path in itertools.product((0, 1), repeat=len(cells)):
            weight, last = 1.0, state
            for z, now in zip(cells, path):
                rate = leave if last else enter
                weight *= rate if now != last else 1.0 - rate
                weight *= math.exp(a * (loud[z] if now else quiet[z]))
                last = now
            total += weight
        return total

    onsets, rings = np.zeros(n), np.zeros(len(prior_ring))
    for r, k in itertools.product(range(len(prior_ring)), range(n)):
        last = k == n - 1
        stop = n if last else k
        if stop < r:
            continue
        weight = prior_ring[r] * prior_onset[k] * math.exp(a * loud[:r].sum())
        weight *= runs(range(r, stop), 0, fish, leave)
        if last:
            weight *= math.exp(NO_FLOOR)
        else:
            m = min(k + chain.window, n)
            weight *= (1.0 - FADED) * math.exp(a * onset[k:m].sum()) * runs(
                range(m, n), 1, begin, end
            ) + FADED * math.exp(a * quiet[k:m].sum()) * runs(range(m, n), 0, begin, end)
        onsets[k] += weight
        rings[r] += weight
    return onsets / onsets.sum(), rings / rings.sum()


@pytest.mark.parametrize('ring', [2, -1])
@pytest.mark.parametrize('seed', range(4))
def test_sums_are_those_of_all_paths(seed, ring):
    rng = np.random.default_rng(seed)
    chain = OnsetChain(0.3, 9, 0.3, ring, fish_rate=0.2)
    logs = [rng.normal(-1.0, 2.0, 9) for _ in range(3)]
    rings = rng.dirichlet(np.ones(len(chain.start().ring)))
    before = OnsetState(rng.dirichlet(np.ones(9)), rings)
    predicted = chain.predict(before)
    onset, ring = enumerated(chain, *logs, predicted.onset, predicted.ring)
    found = chain.update(before, *logs)
    assert found.onset == pytest.approx(onset, abs=1e-12)
    assert found.ring == pytest.approx(ring, abs=1e-12)


def test_probabilities_stay_sums_of_one_through_silence_and_nothing():
    chain = OnsetChain(0.1, 50, 0.2, 0)
    state = chain.start()
    for _ in range(200):
        state = chain.update(state, *(np.zeros(50) for _ in range(3)))
        assert state.onset.sum() == pytest.approx(1.0) and state.ring.sum() == pytest.approx(1.0)
    # All of it quiet: a faded floor could be anywhere, and none is sure.
    quiet = np.zeros(50), np.full(50, -50.0), np.full(50, -50.0)
    for _ in range(5):
        state = chain.update(state, *quiet)
    assert state.onset.max() < 0.2
