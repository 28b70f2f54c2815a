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

"""Sets over the time of several records, against as many steps of one."""

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.estimation.set_filter import levelled, SetFilter, Weighted
from sonar_imm.estimation.set_model import (
    banded_transition,
    gaussian_walk,
    repeated_walk,
    SetModel,
    turnover,
)
from sonar_imm.estimation.set_shifts import Shift

CELLS, N = 400, 20_000


@pytest.fixture
def model():
    return SetModel(
        cells=CELLS,
        separation=2,
        order_min=1,
        transition=banded_transition(4, 0.1),
        walk=gaussian_walk(2.0),
        gram=np.exp(-0.5 * (np.arange(CELLS) / 1.5) ** 2),
    )


def test_the_sum_of_walks_is_their_convolution():
    walk = np.array([0.2, 0.5, 0.3])
    assert repeated_walk(walk, 2) == pytest.approx(np.convolve(walk, walk), abs=1e-15)
    long = repeated_walk(gaussian_walk(2.0), 50)
    place = np.arange(len(long)) - len(long) // 2
    assert long @ place == pytest.approx(0.0, abs=1e-9)
    assert np.sqrt(long @ np.square(place)) == pytest.approx(2.0 * np.sqrt(50.0), rel=0.01)


@pytest.mark.parametrize('least', [0, 1, 3])
@pytest.mark.parametrize('records', [1, 2, 7])
def test_who_left_and_was_replaced(least, records):
    """Against members that are drawn one by one."""
    P = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.3, 0.1, 0.6]])
    found = turnover(P, least, records)
    orders = found.reshape(3, -1, 3).sum(axis=1)
    assert orders == pytest.approx(np.linalg.matrix_power(P, records), abs=1e-12)
    rng, drawn = np.random.default_rng(0), np.zeros_like(found)
    for first in range(3):
        for _ in range(3000):
            old, members, j = set(range(least + first)), list(range(least + first)), first
            for _ in range(records):
                j = rng.choice(3, p=P[j])
                rng.shuffle(members)
                members = members[: least + j]
                members += [-1] * (least + j - len(members))
            extra = least + min(first, j) - len(old & set(members))
            drawn[first, 3 * extra + j] += 1.0 / 3000
    assert np.abs(found - drawn).max() < 0.035


def prior(model, steps, records):
    """Sets of two members, at 100 and 250, after so many steps without any record."""
    tracker = SetFilter(model, N)
    b = np.zeros(model.record_cells)
    sets = tracker.start(tracker.record(b, (0, 0))).sets
    sets.order[:], sets.cell[:, :2] = 2, (100, 250)
    state = Weighted(sets, np.zeros(N))
    for step in range(steps):
        state = tracker.propagate(state, tracker.record(b, (1, step), records=records))
    w = np.exp(state.log_weight - state.log_weight.max())
    w /= w.sum()
    sets = state.sets
    member = np.arange(sets.cell.shape[1]) < sets.order[:, None]
    near = (np.abs(sets.cell - 100) < 20) & member
    pmf = [w @ (sets.order == m) for m in range(1, 5)]
    place = np.where(near, sets.cell - 100.0, 0.0)
    spread = np.sqrt((w @ np.square(place)).sum() / (w @ near).sum())
    return np.array(pmf), float(w @ near.any(axis=1)), float(spread)


def test_one_long_step_is_as_several_short_ones(model):
    """The order, whether a member is still there, and how far it has walked."""
    at_once, by_steps = prior(model, 1, 5), prior(model, 5, 1)
    assert at_once[0] == pytest.approx(by_steps[0], abs=0.02)
    assert at_once[1] == pytest.approx(by_steps[1], abs=0.02) and at_once[1] < 0.95
    assert at_once[2] == pytest.approx(by_steps[2], rel=0.05)


@pytest.mark.parametrize(
    'change', [{}, {'negative_probability': 0.3}, {'shift': Shift(std=1.5, memory=0.9)}]
)
def test_proposals_after_a_gap_change_no_result(model, change):
    """With those that look at the record and those that do not."""
    changed = evolve(model, **change)
    rng = np.random.default_rng(1)
    b = rng.standard_normal(changed.record_cells)
    b[95:108] += 4.0 * np.exp(-0.5 * (np.arange(-5, 8) / 1.5) ** 2)
    found = []
    for shares in ({}, {'walk_share': 0.0, 'birth_share': 0.0}):
        tracker = SetFilter(evolve(changed, **shares), 100_000)
        sets = tracker.start(tracker.record(b, (0, 0))).sets
        sets.order[:], sets.cell[:, :2], sets.sign[:] = 2, (100, 250), 1
        record = tracker.record(b, (1, 1), records=6)
        step = tracker.weigh(tracker.propagate(Weighted(sets, np.zeros(100_000)), record), record)
        summary = tracker.summarise(step)
        found.append((step.log_evidence, summary.pmf, summary.sums[0, 90:115].sum()))
    assert found[0][0] == pytest.approx(found[1][0], abs=0.05)
    assert found[0][1] == pytest.approx(found[1][1], abs=0.02)
    assert found[0][2] == pytest.approx(found[1][2], abs=0.02)


def test_peaks_are_lowered_and_keep_their_shape(model):
    g = np.zeros((1, CELLS))
    g[0, 100], g[0, 101], g[0, 200] = 300.0, 290.0, 5.0
    low = levelled(evolve(model, separation=8), g)[0]
    assert low[100] - low[101] == pytest.approx(10.0)
    # Nine cells at the cap are worth what the peak is.
    assert low[100] == pytest.approx(model.birth_cap + np.log(9.0), abs=1e-3)
    assert low[200] == 5.0 and (low[110:190] == 0.0).all()


def test_amplitudes_and_shifts_are_forgotten_by_the_time(model):
    tracker = SetFilter(evolve(model, amplitude_memory=0.9, shift=Shift(std=1.5, memory=0.8)), 10)
    record = tracker.record(np.zeros(tracker.model.record_cells), (0, 0), records=4)
    assert record.passage.shift.memory == pytest.approx(0.8**4)
    sets = tracker.start(record).sets
    sets.prior_mean[:], sets.prior_variance[:] = 2.0, 0.5
    aged = tracker._aged(sets, record)
    assert aged.prior_mean[0, 0] == pytest.approx(2.0 * 0.9**3)
    fresh = (1.0 - 0.9**6) * model.amplitude_std**2
    assert aged.prior_variance[0, 0] == pytest.approx(0.9**6 * 0.5 + fresh)
