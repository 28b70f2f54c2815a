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

"""Volume scatter below the first member, against sums written out."""

from helpers.set_cycle import cycle
import numpy as np
from oracles.set_particles import weigh
import pytest

from sonar_imm.estimation.set_filter import SetFilter, Weighted
from sonar_imm.estimation.set_model import banded_transition, gaussian_walk, SetModel, Sets
from sonar_imm.estimation.set_scatter import (
    decaying_profile,
    fit_scatter,
    LEVEL_RATIO,
    Scatter,
    seen_against,
    without_peaks,
)

CELLS = 70
PULSE = np.exp(-0.5 * np.square(np.arange(CELLS) / 1.3))
DECAYS = np.array([4.0, 11.0])
SCATTER = Scatter(profile=decaying_profile(PULSE, DECAYS), spread=0.4, share=0.45, window=9)


def model(**overrides):
    values = {
        'cells': CELLS,
        'separation': 4,
        'order_min': 1,
        'transition': banded_transition(4, 0.05),
        'walk': gaussian_walk(0.9),
        'gram': PULSE,
        'scatter': SCATTER,
    }
    return SetModel(**{**values, **overrides})


def diffuse(rng, first=24, level=9.0, decay=11.0):
    """Speckle of many looks below `first`, and nothing above."""
    lag = np.arange(CELLS) - first
    mean = np.where(lag >= 0, level * np.exp(-np.maximum(lag, 0) / decay), 0.0)
    return mean * rng.gamma(9.0, 1.0 / 9.0, CELLS) + 0.2 * np.abs(rng.standard_normal(CELLS))


def test_the_profile_is_the_exponential_through_the_pulse():
    middle = CELLS - 1
    kernel = np.concatenate([PULSE[:0:-1], PULSE])
    kernel /= kernel.sum()
    for row, decay in zip(SCATTER.profile, DECAYS):
        for lag in (-5, -1, 0, 2, 20):
            from_lag = np.arange(0, 300)
            edge = np.where(from_lag == 0, 0.5, 1.0) * np.exp(-from_lag / decay)
            apart = lag - from_lag
            inside = np.abs(apart) < CELLS
            expected = np.sum(edge[inside] * kernel[middle + apart[inside]])
            assert row[middle + lag] == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_the_evidence_is_the_mean_over_levels_and_decays():
    b = diffuse(np.random.default_rng(1))
    fit = fit_scatter(SCATTER, b)
    x = np.maximum(without_peaks(b, SCATTER.window), 0.0) + 1.0
    levels = LEVEL_RATIO ** np.arange(int(np.log(x.max()) / np.log(LEVEL_RATIO)) + 1)
    for k in (0, 10, 24, 31, CELLS - 1):
        logs, which = [0.0], [(0.0, 0)]
        for row, profile in enumerate(SCATTER.profile):
            for level in levels:
                mean = 1.0 + level * profile[CELLS - 1 - k + np.arange(CELLS)]
                # The ratio of two gamma densities of shape 1 / spread^2, of mean `mean` and 1.
                ratio = x * (1.0 - 1.0 / mean) - np.log(mean)
                logs.append(SCATTER.share / 0.4**2 * ratio.sum())
                which.append((level, row))
        expected = np.logaddexp.reduce(logs) - np.log(len(logs))
        assert fit.evidence[k] == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert (fit.level[k], fit.row[k]) == which[int(np.argmax(logs))]


def test_the_scatter_begins_where_it_does():
    rng = np.random.default_rng(2)
    found = [
        np.argmax(fit_scatter(SCATTER, diffuse(rng, first)).evidence) for first in (12, 24, 40)
    ]
    assert np.abs(np.array(found) - (12, 24, 40)).max() <= 2


def test_echoes_do_not_look_like_scatter():
    b = 15.0 * (PULSE[np.abs(np.arange(CELLS) - 20)] + PULSE[np.abs(np.arange(CELLS) - 41)])
    assert without_peaks(b, SCATTER.window).max() < 0.4 * b.max()
    rng = np.random.default_rng(3)
    speckle = fit_scatter(SCATTER, diffuse(rng, 20, level=15.0)).evidence.max()
    assert fit_scatter(SCATTER, b).evidence.max() < 0.2 * speckle


def test_the_kernel_weighs_as_the_readable_form():
    rng = np.random.default_rng(4)
    its, b = model(), diffuse(rng)
    b[33] += 12.0
    N = 200
    sets = Sets.empty(its, N)
    sets.order[:] = rng.integers(1, 5, N)
    for i in range(N):
        m = int(sets.order[i])
        free = CELLS - (m - 1) * (its.separation - 1)
        cells = np.sort(rng.choice(free, m, replace=False)) + (its.separation - 1) * np.arange(m)
        sets.cell[i, :m] = cells
    expected, amplitude = weigh(its, b, sets)
    filter_ = SetFilter(its, N)
    step = filter_.weigh(Weighted(sets, np.zeros(N)), filter_.record(b, (1, 2)))
    log_weight, found = step.after.log_weight, step.amplitude
    fit = fit_scatter(SCATTER, b)
    assert np.isfinite(expected).sum() > 20
    assert log_weight == pytest.approx(expected, rel=1e-9)
    good = np.isfinite(expected)
    assert found[good] == pytest.approx(amplitude[good], rel=1e-8, abs=1e-9)
    # One member alone, by hand: its evidence and the marginal of what it leaves of the background.
    lone = int(np.flatnonzero((sets.order == 1) & good)[0])
    k = int(sets.cell[lone, 0])
    h, precision = seen_against(fit, b, k)[k], 1.0 + its.amplitude_std**-2
    value = 0.5 * h * h / precision - 0.5 * np.log(precision) - np.log(its.amplitude_std)
    assert expected[lone] == pytest.approx(fit.evidence[k] + value, rel=1e-12)


def test_the_filter_follows_a_floor_that_is_no_sum_of_echoes():
    rng = np.random.default_rng(5)
    its = SetFilter(model(), 1000)
    before, right = None, []
    for record in range(40):
        first = 30 + round(6.0 * np.sin(record / 6.0))
        step = cycle(its, before, diffuse(rng, first, level=6.0), (1, record))
        before = step.after if step.ok else None
        place = step.w @ step.sets.cell[:, 0]
        right.append(abs(place - first) <= 2.0)
    assert np.mean(right) >= 0.95


def test_what_cannot_be_is_refused():
    for wrong in ({'spread': -1.0}, {'share': 0.0}, {'profile': np.ones((1, 4))}):
        values = {'profile': SCATTER.profile, 'spread': 0.4, 'share': 0.45, 'window': 9}
        with pytest.raises(ValueError):
            Scatter(**{**values, **wrong})
    with pytest.raises(ValueError, match='memory'):
        model(amplitude_memory=0.5)
    with pytest.raises(ValueError, match='shorter'):
        model(scatter=Scatter(profile=np.ones((1, 21)), spread=0.4, share=0.5, window=9))
