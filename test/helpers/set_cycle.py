# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One cycle of the particle filter for sets, and its likelihood from the definition."""

from collections.abc import Iterable, Iterator
import math

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.set_filter import SetFilter, SetStep, Weighted


def cycle(
    filter_: SetFilter, before: Weighted | None, b: FloatArray, key: tuple[int, int]
) -> SetStep:
    """Take the record b in; before: None before the first one."""
    record = filter_.record(b, key)
    sets = filter_.propagate(before or filter_.start(record), record)
    return filter_.move(filter_.resample(filter_.weigh(sets, record), record), record)


def weigh(model, b, sets):
    """Log likelihood (N,) of the record against that of an empty one, -inf where an amplitude is
    not of its member's sign, and the amplitudes (N, J), their mean given the set, in units of the
    noise."""
    log_likelihood = np.zeros(len(sets.order))
    amplitude = np.zeros(sets.cell.shape)
    for m in np.unique(sets.order[sets.order > 0]):
        at = np.flatnonzero(sets.order == m)
        z = sets.cell[at, :m]
        A = model.gram[np.abs(z[:, :, None] - z[:, None, :])]
        precision, expected = np.full(z.shape, model.ridge), np.zeros(z.shape)
        if model.amplitude_memory:
            precision = 1.0 / sets.prior_variance[at, :m]
            expected = sets.prior_mean[at, :m]
        h = b[z + sets.shift[at, None]] + precision * expected
        A = A + precision[:, :, None] * np.eye(m)
        a = np.linalg.solve(A, h[..., None])[..., 0]
        value = 0.5 * np.einsum('im,im->i', h, a) - m * model.penalty
        if model.amplitude_prior == 'marginal':
            value -= 0.5 * np.linalg.slogdet(A)[1]
        if model.amplitude_memory:
            value -= 0.5 * np.sum(precision * np.square(expected), axis=1)
            value += m * model.penalty + 0.5 * np.sum(np.log(precision), axis=1)
        amplitude[at, :m] = a
        log_likelihood[at] = np.where((a * sets.sign[at, :m] > 0.0).all(axis=1), value, -math.inf)
    return log_likelihood, amplitude


def steps(filter_: SetFilter, records: Iterable[FloatArray], seed: int) -> Iterator[SetStep]:
    """Of the records in turn; one that nothing explains lets the filter begin anew."""
    before = None
    for name, b in enumerate(records):
        step = cycle(filter_, before, b, (seed, name))
        before = step.after if step.ok else None
        yield step
