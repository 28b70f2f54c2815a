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

"""Where the filter for sets looks for members: peaks without the side lobes of the others."""

from attrs import evolve
from helpers.set_cycle import cycle
import numpy as np
import pytest

from sonar_imm.estimation.set_filter import SetFilter
from sonar_imm.estimation.set_model import banded_transition, gaussian_walk, SetModel
from sonar_imm.estimation.set_proposals import begin, gains, standing_out
from sonar_imm.estimation.set_scatter import NO_SCATTER

N = 400
GRAM = np.sinc(np.arange(N) / 5.0)
MODEL = SetModel(
    cells=N,
    separation=20,
    order_min=1,
    transition=banded_transition(12, 0.05),
    walk=gaussian_walk(4.0),
    gram=GRAM,
)
PLACES = np.array([40, 85, 112, 160, 203, 251, 300, 352])
SIGMAS = np.array([34.0, 6.0, 28.0, 7.0, 22.0, 9.0, 30.0, 8.0])


def record(places, sigmas, n=N, seed=None):
    """Echoes in the n cells of a record; with the noise of `seed`, as wide as the echoes."""
    b = np.sinc((np.arange(n)[:, None] - places) / 5.0) @ sigmas
    if seed is not None:
        noise = np.fft.irfft(
            np.fft.rfft(np.random.default_rng(seed).standard_normal(n))[: n // 10], n
        )
        b += noise / noise.std()
    return b


@pytest.mark.parametrize('more', [0, 30])
def test_what_stands_out_is_each_member_without_the_others(more):
    """Also in a record that is longer than the lattice, as with a shift."""
    b = record(PLACES, SIGMAS, N + more)
    alone, peaks = standing_out(MODEL, b, GRAM)
    assert len(peaks.first) == len(PLACES)
    for place, sigma, low, high in zip(PLACES, SIGMAS, *peaks):
        assert low <= place < high and low + np.argmax(alone[low:high]) == place
        assert alone[place] == pytest.approx(sigma, rel=0.03)
    away = np.abs(np.arange(N + more)[:, None] - PLACES).min(axis=1) > MODEL.separation // 2
    assert np.abs(alone[away]).max() < 0.7 < 4.0 < np.abs(b[away]).max()


def test_negative_members_stand_out_where_there_can_be_some():
    signed = SIGMAS * np.where(np.arange(8) % 3 == 1, -1.0, 1.0)
    b = record(PLACES, signed)
    both = evolve(MODEL, negative_probability=0.05)
    g, peaks = gains(both, b, NO_SCATTER, GRAM)
    assert len(peaks.first) == 8 and g.shape == (2, N)
    for sign, low, high in zip(np.sign(signed), *peaks):
        place = low + np.argmax(g[:, low:high].max(axis=0))
        assert g[int(sign < 0), place] > 10.0 and g[int(sign > 0), place] == 0.0
    assert len(standing_out(MODEL, b, GRAM)[1].first) < 8


def test_nothing_stands_out_of_noise_and_blind_proposals_see_nothing():
    assert not len(gains(MODEL, record(PLACES, 0.0 * SIGMAS), NO_SCATTER, GRAM)[1].first)
    b, blind = record(PLACES, SIGMAS), evolve(MODEL, walk_share=0.0, birth_share=0.0)
    g, peaks = gains(blind, b, NO_SCATTER, GRAM)
    assert not len(peaks.first) and np.array_equal(g[0], 0.5 * np.square(np.maximum(b, 0.0)))
    beginning, births = begin(blind, g, peaks)
    assert beginning.decay == 1.0 and np.array_equal(beginning.elsewhere, births[0])
    assert np.diff(births[0]) == pytest.approx(1.0 / N)


@pytest.mark.parametrize('seed', range(3))
def test_the_first_record_leaves_many_sets(seed):
    """Of sets that are drawn one member after the other it leaves one, with what is in it."""
    tracker, right = SetFilter(MODEL, 4000), 0.0
    step, effective = None, []
    for k in range(4):
        step = cycle(
            tracker, step and step.after, record(PLACES, SIGMAS, seed=9 * seed + k), (seed, k)
        )
        effective.append(step.effective)
        right = tracker.summarise(step).pmf[7]
    assert effective[0] > 20.0 and min(effective[1:]) > 80.0
    assert right > 0.5
