# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Jumps that all members of a set make together: against sums over all sets, jumps and walks."""

from attrs import evolve
from helpers.set_cycle import cycle
import numpy as np
from oracles.set_jumps import exact
import pytest

from sonar_imm.estimation.set_filter import LagSmoother, SetFilter
from sonar_imm.estimation.set_model import SetModel, Walks
from sonar_imm.estimation.set_shifts import Jump, Shift

CELLS, JUMP_AT = 11, 3


@pytest.fixture(scope='module')
def model():
    return SetModel(
        cells=CELLS, separation=2, order_min=0,
        transition=np.array([[0.6, 0.3, 0.1], [0.15, 0.5, 0.35], [0.05, 0.15, 0.8]]),
        start=np.array([0.2, 0.3, 0.5]), walk=np.array([0.25, 0.6, 0.15]),
        gram=np.exp(-0.5 * np.square(np.arange(CELLS) / 1.2)), amplitude_std=3.0,
        negative_probability=0.3, jump=Jump(probability=0.15, std=3.0, step=2, reach=3),
    )  # fmt: skip


@pytest.fixture(scope='module')
def records():
    """Two echoes, one of them negative, that are four cells deeper from a record on."""
    rng, cell, made = np.random.default_rng(4), np.arange(CELLS), []
    for k in range(7):
        places = np.array([1.0, 5.0]) + 4.0 * (k >= JUMP_AT)
        echoes = np.exp(-0.5 * np.square((cell[:, None] - places) / 1.2)) @ [2.6, -2.2]
        made.append(echoes + 0.7 * rng.standard_normal(CELLS))
    return np.array(made)


def run(model, records, particles, seed):
    """PMFs (T, orders), intensities (T, n), log evidence (T,), probability that members jumped and
    mean jump (T, 2)."""
    tracker, before, found = SetFilter(model, particles), None, []
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (seed, name))
        before = step.after
        pmf, sums, _, jump = tracker.summarise(step)
        found.append((pmf, sums[0], step.log_evidence, (jump[0], jump[0] * jump[1])))
    return tuple(np.array(column) for column in zip(*found))


@pytest.mark.parametrize(
    'change',
    [
        {},
        {'walk_share': 0.0, 'birth_share': 0.0},
        {'jump': Jump(probability=0.4, std=1.0, step=1, reach=5), 'negative_probability': 0.0},
    ],
)
def test_sets_that_jump_are_the_exact_ones(model, records, change):
    changed = evolve(model, **change)
    wanted = exact(changed, records)
    found = run(changed, records, 60_000, seed=1)
    assert 0.5 * np.abs(found[0] - wanted.pmf).sum(axis=1).max() < 0.015
    assert np.abs(found[1] - wanted.intensity).sum(axis=1).max() < 0.06
    assert found[2] == pytest.approx(wanted.log_evidence, abs=0.05)
    assert found[3][:, 0] == pytest.approx(wanted.jump[:, 0], abs=0.02)
    assert found[3][:, 1] == pytest.approx(wanted.jump[:, 1], abs=0.06)
    if not change:
        assert wanted.jump[JUMP_AT, 0] > 0.5 > wanted.jump[[1, 2, 4, 5, 6], 0].max()


def test_what_a_jump_is_beforehand():
    jump = Jump(probability=0.1, std=3.0, step=2, reach=6)
    tables, places = jump.tables(), np.arange(-12, 13, 2)
    density = 0.1 * np.exp(-0.5 * np.square(places / 3.0))
    density /= density.sum() / 0.1
    assert np.exp(tables.log_prior[0]) == pytest.approx(density + 0.9 * (places == 0))
    assert tables.prior[0] == pytest.approx(np.cumsum(density + 0.9 * (places == 0)))
    assert jump.pad == 12


def test_jumps_do_not_go_with_a_shift_and_have_bounds(model):
    with pytest.raises(ValueError, match='shift'):
        evolve(model, shift=Shift(std=1.0))
    for change in ({'probability': 1.0}, {'std': 0.0}, {'step': 0}, {'reach': 0}, {'reach': 900}):
        with pytest.raises(ValueError, match='jump'):
            evolve(model.jump, **change)


def test_what_is_smoothed_jumped_when_it_did(model, records):
    tracker, smoother, before, found = SetFilter(model, 4000), LagSmoother(2), None, []
    for name, b in enumerate(records):
        step = cycle(tracker, before, b, (2, name))
        before = step.after
        if earlier := smoother.push(step):
            found.append(tracker.summarise(earlier).jump[0])
            places = tracker.summarise(earlier).sums[0]
            assert places.sum() <= 2.0 + 1e-9
    # The first that comes out is record 0.
    assert int(np.argmax(found)) == JUMP_AT


@pytest.mark.parametrize('centre', [CELLS, -3 * CELLS, 8])
def test_walks_that_lead_off_the_lattice_leave_numbers(model, records, centre):
    """As of a slope that is steep at the end of the lattice, wherever a jump leads before."""
    tracker, probability = SetFilter(model, 300), np.array([[0.2, 0.6, 0.2]])
    walks = Walks(np.zeros(CELLS, np.int64), np.array([centre]), probability, True)
    before = cycle(tracker, None, records[0], (1, 0)).after
    sets = tracker.propagate(before, tracker.record(records[1], (1, 1), walks=walks))
    assert not np.isnan(sets.log_weight).any()
    # Of nothing and of those that all died the births are left.
    assert np.isfinite(sets.log_weight).any()
    assert ((sets.sets.cell >= 0) & (sets.sets.cell < CELLS)).all()
