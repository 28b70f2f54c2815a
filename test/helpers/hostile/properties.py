# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What must hold of every refusal and of every estimate, whatever came in."""

from __future__ import annotations

import numpy as np

from msg_adapters.estimates import write_estimate

from .streams import make

ROUNDING = 1e-9


def check_refusal(rejection):
    """A reason to count, and a sentence to show."""
    assert rejection.reason and ' ' not in rejection.reason, rejection.reason
    assert rejection.sentence and '\n' not in rejection.sentence
    assert len(rejection.sentence) < 2000


def check_estimate(estimate):
    """`check_numbers`, and that a message can hold it."""
    check_numbers(estimate)
    write_estimate(estimate, make)


def check_numbers(estimate):
    """Numbers that are finite where they must be, covariances, probabilities."""
    valid = np.asarray(estimate.extras.get('valid', np.ones(len(estimate))), bool)
    if estimate.state_names == ('depth', 'amplitude') and len(estimate) == 1:
        valid = estimate.extras['existence'] > 0.0  # a row that says that there is no reflector
    state, covariance = estimate.state[valid], estimate.covariance[valid]
    for name, values in (('state', state), ('covariance', covariance)):
        assert np.isfinite(values).all(), f'{name} {values}'
    check_covariances(covariance)
    probabilities = estimate.probabilities
    if probabilities.size:
        assert ((probabilities >= 0.0) & (probabilities <= 1.0)).all(), probabilities
        wrong = np.abs(probabilities.sum(axis=1) - 1.0).max()
        assert wrong < ROUNDING, f'probabilities sum to one but for {wrong}'
    for name, column in estimate.extras.items():
        assert len(column) == len(estimate), name
        if name in ('existence', 'label_probability', 'label_confidence'):
            assert not ((column < 0.0) | (column > 1.0)).any(), f'{name} {column}'


def check_covariances(covariance):
    """(n, d, d): symmetric, and no eigenvalue of the correlations below zero but for rounding."""
    if not covariance.size:
        return
    assert (covariance == np.swapaxes(covariance, -1, -2)).all(), 'not symmetric'
    own = np.diagonal(covariance, axis1=-2, axis2=-1)
    assert (own >= 0.0).all(), f'a variance below zero: {own}'
    std = np.sqrt(np.where(own > 0.0, own, 1.0))
    least = np.linalg.eigvalsh(covariance / std[:, :, None] / std[:, None, :]).min()
    assert least > -ROUNDING, f'an eigenvalue of a correlation is {least}'
