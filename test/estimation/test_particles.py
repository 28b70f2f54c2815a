# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Weighted particles: log weights, effective sample size, resampling."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.special import logsumexp

from sonar_imm.estimation import particles
from sonar_imm.estimation.particles import invert, systematic


def test_normalise_survives_what_underflows():
    log_w = np.array([-1e5, -1e5 + np.log(3.0), -np.inf])
    w, log_sum = particles.normalise(log_w)
    assert w == pytest.approx([0.25, 0.75, 0.0])
    assert log_sum == pytest.approx(logsumexp(log_w))


def test_normalise_of_nothing_possible_is_uniform():
    w, log_sum = particles.normalise(np.full((2, 4), -np.inf))
    assert (w == 0.25).all() and np.isneginf(log_sum).all()


def test_effective_sample_size_lies_between_one_and_all():
    assert particles.effective_sample_size(np.full(50, 0.02)) == pytest.approx(50.0)
    assert particles.effective_sample_size(np.eye(1, 50)[0]) == pytest.approx(1.0)


# -- resampling: unbiased, bounded scatter, hostile weights ---------------------------------------


W = np.array([0.05, 0.0, 0.4, 0.15, 0.3, 0.1])


def test_each_particle_is_drawn_as_often_as_its_weight_says():
    rng = np.random.default_rng(1)
    runs, count = 20_000, 7
    copies = np.zeros((runs, len(W)))
    for run in range(runs):
        copies[run] = np.bincount(systematic(W, count, rng), minlength=len(W))
    error = copies.std(axis=0) / np.sqrt(runs)
    assert (np.abs(copies.mean(axis=0) - count * W) <= 4.5 * error + 1e-12).all()
    assert (copies[:, 1] == 0).all()


def test_indices_are_as_many_as_wanted_and_ascend():
    rng = np.random.default_rng(2)
    for count in (0, 1, 5, 1000):
        indices = systematic(W, count, rng)
        assert indices.shape == (count,)
        assert (np.diff(indices) >= 0).all()


def test_scale_of_the_weights_does_not_matter():
    first = systematic(W, 50, np.random.default_rng(3))
    other = systematic(1e-200 * W, 50, np.random.default_rng(3))
    assert np.array_equal(first, other)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-9),
    st.integers(1, 60),
    st.integers(0, 2**32),
)
def test_systematic_copies_differ_from_the_expectation_by_less_than_one(weights, count, seed):
    w = np.array(weights)
    expected = count * w / w.sum()
    copies = np.bincount(systematic(w, count, np.random.default_rng(seed)), minlength=len(w))
    assert (copies >= np.floor(expected - 1e-9)).all()
    assert (copies <= np.ceil(expected + 1e-9)).all()


@pytest.mark.parametrize(
    'weights', [[], [0.0, 0.0], [1.0, -0.1], [1.0, np.nan], [1.0, np.inf], [[1.0, 2.0]]]
)
def test_what_are_no_weights_is_refused(weights):
    with pytest.raises(ValueError, match='weights'):
        systematic(weights, 3, np.random.default_rng(0))


def test_a_point_on_a_boundary_belongs_to_what_begins_there():
    """A point of zero is not of a particle without weight that happens to be the first."""
    cumulative = np.cumsum([0.0, 0.25, 0.0, 0.25, 0.5])
    assert invert(cumulative, np.array([0.0, 0.25, 0.375, 0.5])).tolist() == [1, 3, 3, 4]


def test_a_point_at_the_very_end_belongs_to_the_last_particle_with_weight():
    cumulative = np.cumsum([0.3, 0.7, 0.0])
    assert invert(cumulative, np.array([0.0, 1.0 - 2.0**-53, 1.0])).tolist() == [0, 1, 1]
