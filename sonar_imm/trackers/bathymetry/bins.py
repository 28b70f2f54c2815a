# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a filter is told of each range bin of a ping, what it carries on, and what it answers.

Shapes: T bins of a ping, M models, n states, N particles per model, P staves.
"""

from __future__ import annotations

from typing import NamedTuple

from ...estimation.arrays import BoolArray, ComplexArray, FloatArray


class Geometry(NamedTuple):
    """How a state becomes a direction in each of T bins; see `acoustics.sounding`.

    of_heights: states are heights of the floor, else angles. height (T,): of the array, in the
    same terms, m; reach (T,): r C, by which a depth is divided, m; tilt (T,): psi, rad, with its
    cosine and sine; `spacing` of the staves in wavelengths, negative for a conjugated array.
    launch: where rays bend, the table of `rays.launch_table`, (0, 0) where they do not; row (T,):
    place of each range in it; first_depth and depth_step, m, of its columns.
    drift_from: the first bin that angles reach at constant height, T or more for never.
    """

    of_heights: bool
    height: FloatArray
    reach: FloatArray
    tilt: FloatArray
    cos_tilt: FloatArray
    sin_tilt: FloatArray
    spacing: float
    launch: FloatArray
    row: FloatArray
    first_depth: float
    depth_step: float
    drift_from: int


class PingLikelihood(NamedTuple):
    """The likelihood of the state in each of T bins.

    ranges (T,) in metres; echo (T,): bins with an echo; table: of `laplace.likelihood_table`;
    noise (T,): the variance it was made for; constant (T,): what the kernels leave out of the log
    likelihood. White noise: form (T, P) of `laplace.form_coefficients`, base 0, spread (T, 0).
    Beside interferers: base (T,), form = -signal beam and spread (T, P) of an
    `interference.InterferenceForm`, signal (T,) the variance of the echo.
    """

    ranges: FloatArray
    echo: BoolArray
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    constant: FloatArray
    table: FloatArray
    geometry: Geometry


class Particles(NamedTuple):
    """x (M, n, N), their weights w (M, N) and the probabilities mu (M,) of the models."""

    x: FloatArray
    w: FloatArray
    mu: FloatArray


class Track(NamedTuple):
    """The floor along one ping: mean (T, n), covariance (T, n, n), probability (T, M) of each
    model, log_likelihood (T,) of each bin given those before it, sample_size (T,) effective."""

    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray
    sample_size: FloatArray
