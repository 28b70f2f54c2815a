# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Gauss-Markov step: vectors, and that steps compose."""

from helpers.sea_vectors import vectors
import pytest

from sonar_imm.estimation.gauss_markov import gauss_markov


def test_the_steps_of_the_vectors():
    v = vectors('gauss_markov')
    for dt, a, q in zip(v['dt'], v['out_a'], v['out_q']):
        assert gauss_markov(float(v['std']), float(v['time']), dt) == pytest.approx((a, q), 1e-9)


def test_steps_compose_and_keep_the_variance():
    whole, part = gauss_markov(2.0, 60.0, 10.0), gauss_markov(2.0, 60.0, 1.0)
    variance, fade = 0.0, 1.0
    for _ in range(10):
        variance, fade = part[0] ** 2 * variance + part[1], fade * part[0]
    assert (fade, variance) == pytest.approx(whole)
    assert part[0] ** 2 * 4.0 + part[1] == pytest.approx(4.0)
