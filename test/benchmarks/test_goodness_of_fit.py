# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The two tests of goodness of fit beside those of scipy."""

import numpy as np
import pytest
from scipy.stats import chisquare, kstest

from benchmarks.goodness_of_fit import CLASSES, kolmogorov_smirnov, pearson, TAILS, WINDOW

ROW, BEAM = 4, 10


def window(u):
    """The cells of the window around (ROW, BEAM)."""
    rows, beams = (half // 2 for half in WINDOW)
    return u[ROW - rows : ROW + rows + 1, BEAM - beams : BEAM + beams + 1].ravel()


def loud(seed):
    """A window of noise that is too loud."""
    return np.random.default_rng(seed).uniform(size=(9, 21)) ** 3


@pytest.mark.parametrize('seed', range(5))
def test_distances_are_those_of_scipy(seed):
    u = loud(seed)
    own = window(u)
    ours = kolmogorov_smirnov(u)[ROW, BEAM]
    exact = kstest(own, 'uniform', alternative='greater').statistic
    # Only at the probabilities of TAILS, the next of which is 1.8 times as great.
    assert 0.5 * exact < ours <= exact + 1e-12
    assert ours == pytest.approx(max((own < tail).mean() - tail for tail in TAILS))
    counts, _ = np.histogram(own, CLASSES)
    expected = np.diff(CLASSES) * len(own)
    assert pearson(u)[ROW, BEAM] == pytest.approx(chisquare(counts, expected)[0] / len(own))


def test_a_window_that_is_too_quiet_is_no_echo():
    assert pearson(1.0 - 1e-3 * loud(0))[ROW, BEAM] == 0.0
