# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The best plane wave in each of many snapshots, and the best two; two kernels.

`beam_peaks` finds the largest value of a trigonometric polynomial, by Horner's rule over a grid of
directions at a time. `fit_waves` goes on from the grid: see `layover`. In its coordinates, the
middle c of both phase steps and half their distance d, the sum and the difference of both waves
are orthogonal, and the power of two is a sum of two squares without singularity:

    p = |sum_q cos(d q) z_q|^2 / sum_q cos^2(d q)  +  the same with sin,   z_q = exp(-i c q) y_q

with q counted from the middle of the array.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..estimation.jit import kernel

BESIDE = 0.2
CLOSEST = 1e-4
"""Half the smallest difference of both phase steps, rad; nearer the fit does not change."""
HALF_CIRCLE = 0.5 * math.pi


@kernel
def beam_peaks(
    form: NDArray[np.complex128],
    cosine: NDArray[np.float64],
    sine: NDArray[np.float64],
    beam: NDArray[np.float64],
    scratch: NDArray[np.float64],
    height: NDArray[np.float64],
    place: NDArray[np.float64],
) -> None:
    """Largest value of Re sum_k form_k z^k over a grid of z = cosine - i sine (m,), for every bin
    of form (n, P), and its place on the grid, between points by a parabola through the highest
    and its neighbours; into height (n,) and place (n,). beam and scratch (m,)."""
    last, top_k = cosine.shape[0] - 1, form.shape[1] - 1
    for t in range(form.shape[0]):
        a, b = form[t, top_k].real, form[t, top_k].imag
        for i in range(last + 1):
            beam[i] = a
            scratch[i] = b
        for k in range(top_k - 1, -1, -1):
            a, b = form[t, k].real, form[t, k].imag
            for i in range(last + 1):
                x = beam[i] * cosine[i] + scratch[i] * sine[i] + a
                scratch[i] = scratch[i] * cosine[i] - beam[i] * sine[i] + b
                beam[i] = x
        best = 1
        for i in range(2, last):
            best = i if beam[i] > beam[best] else best
        if beam[0] > beam[best]:
            best = 1
        elif beam[last] > beam[best]:
            best = last - 1
        below, top, above = beam[best - 1], beam[best], beam[best + 1]
        bend = below - 2.0 * top + above
        shift = 0.5 * (below - above) / bend if bend < 0.0 else 0.0
        shift = min(max(shift, -1.0), 1.0)
        height[t] = top + shift * (0.5 * (above - below) + 0.5 * shift * bend)
        place[t] = best + shift


@kernel
def fit_waves(
    y: NDArray[np.complex128],
    phase: NDArray[np.float64],
    turn: NDArray[np.float64],
    widest: float,
    real: NDArray[np.float64],
    imaginary: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    """Find the power of the best wave and of the best two, into found (n, 2), for snapshots
    y (n, P).

    phase (m,): grid of phase steps from stave to stave; turn (8, m): cosine and sine of it, of
    its multiple that leads to the middle of the array, of its half, and of P times its half; no
    phase step lies beyond `widest`; real and imaginary (m,) are scratch. The search for two begins
    beside the best one, where a second one explains most, and once more on either side of the best
    one.
    """
    (n, P), m = y.shape, phase.shape[0]
    half, beside = 0.5 * (P - 1), 0.5 * (phase[1] - phase[0])
    for t in range(n):
        for i in range(m):
            real[i] = y[t, P - 1].real
            imaginary[i] = y[t, P - 1].imag
        for k in range(P - 2, -1, -1):
            for i in range(m):
                x = real[i] * turn[0, i] + imaginary[i] * turn[1, i] + y[t, k].real
                imaginary[i] = imaginary[i] * turn[0, i] - real[i] * turn[1, i] + y[t, k].imag
                real[i] = x
        top, place = 0.0, -1
        for i in range(m):
            x = real[i] * turn[2, i] - imaginary[i] * turn[3, i]
            imaginary[i] = imaginary[i] * turn[2, i] + real[i] * turn[3, i]
            real[i] = x
            power = x * x + imaginary[i] * imaginary[i]
            if power > top:
                top, place = power, i
        if place < 0:
            continue
        # One climb from the best wave, then, unless there are two staves, three for pairs.
        alone = 0.0
        for start in range(1 if P == 2 else 4):
            c, d = phase[place], 0.0
            if start == 1:
                # The wave that was found, at the middle of the array: its beam is b.
                b = complex(0.0, 0.0)
                for p in range(P):
                    angle = (half - p) * alone
                    b += complex(math.cos(angle), math.sin(angle)) * y[t, p]
                cosine, sine = math.cos(0.5 * alone), math.sin(0.5 * alone)
                far_cosine, far_sine = math.cos(0.5 * P * alone), math.sin(0.5 * P * alone)
                top, place = -1.0, 0
                for i in range(m):
                    between = P * (turn[5, i] * cosine - turn[4, i] * sine)
                    if abs(between) < BESIDE:
                        continue
                    g = (turn[7, i] * far_cosine - turn[6, i] * far_sine) / between
                    rest = complex(real[i], imaginary[i]) - g * b
                    power = (rest.real * rest.real + rest.imag * rest.imag) / (1.0 - g * g)
                    if power > top:
                        top, place = power, i
                c = 0.5 * (phase[place] + alone)
                d = abs(phase[place] - c)
            elif start > 1:
                c, d = alone + (beside if start == 3 else -beside), beside
            # Climb to the next maximum from c and d on, of one wave for d = 0: Newton's method,
            # also where the power is convex, with a shorter step where one loses.
            pair = d > 0.0
            if d > HALF_CIRCLE:
                c, d = c + math.pi, math.pi - d  # the other middle of two points of a circle
            best, at_c, at_d = -1.0, c, d
            c_step, d_step, share = 0.0, 0.0, 1.0
            c_slope, d_slope, cc, cd, dd = 0.0, 0.0, 0.0, 0.0, 0.0
            for _ in range(30):
                wave = complex(math.cos(half * c), math.sin(half * c))
                onward = complex(math.cos(c), -math.sin(c))
                beat = complex(math.cos(half * d), -math.sin(half * d))
                faster = complex(math.cos(d), math.sin(d))
                C0 = C1 = C2 = S0 = S1 = S2 = 0j
                n0, n1, n2 = 0.0, 0.0, 0.0
                for p in range(P):
                    q, z = p - half, wave * y[t, p]
                    even, odd = beat.real, beat.imag
                    C0 += complex(even * z.real, even * z.imag)
                    S0 += complex(odd * z.real, odd * z.imag)
                    even, odd = q * even, q * odd
                    C1 += complex(even * z.real, even * z.imag)
                    S1 += complex(odd * z.real, odd * z.imag)
                    even, odd = q * even, q * odd
                    C2 += complex(even * z.real, even * z.imag)
                    S2 += complex(odd * z.real, odd * z.imag)
                    n0 += beat.imag * beat.imag
                    n1 += 2.0 * q * beat.imag * beat.real
                    n2 += 2.0 * q * q * (1.0 - 2.0 * beat.imag * beat.imag)
                    wave *= onward
                    beat *= faster
                rest = P - n0
                A = (C0 * C0.conjugate()).real / rest
                B = (S0 * S0.conjugate()).real / n0 if pair else 0.0
                gain = A + B - best
                if gain > 0.0:
                    best, at_c, at_d = A + B, c, d
                    if gain < 1e-8 * best:
                        break
                    c_slope = 2.0 * (C0.conjugate() * C1).imag / rest
                    cc = 2.0 * (C1 * C1.conjugate() - C0.conjugate() * C2).real / rest
                    if pair:
                        A_d = (A * n1 - 2.0 * (C0.conjugate() * S1).real) / rest
                        B_c = 2.0 * (S0.conjugate() * S1).imag / n0
                        B_d = (2.0 * (S0.conjugate() * C1).real - B * n1) / n0
                        bend = (S1.conjugate() * C1 + C0.conjugate() * S2).imag
                        cd = (c_slope * n1 - 2.0 * bend) / rest
                        bend = (C1.conjugate() * S1 + S0.conjugate() * C2).imag
                        cd += (2.0 * bend - B_c * n1) / n0
                        dd = 2.0 * (S1 * S1.conjugate() - C0.conjugate() * C2).real
                        dd = (dd + 2.0 * A_d * n1 + A * n2) / rest
                        cc += 2.0 * (S1 * S1.conjugate() - S0.conjugate() * S2).real / n0
                        bend = 2.0 * (C1 * C1.conjugate() - S0.conjugate() * S2).real
                        dd += (bend - 2.0 * B_d * n1 - B * n2) / n0
                        c_slope, d_slope = c_slope + B_c, A_d + B_d
                    else:
                        dd = 0.5 * cc
                    # Newton's step with the size of the curvatures (eigenvalues), whatever sign.
                    mean = 0.5 * (cc + dd)
                    apart = math.sqrt(0.25 * (cc - dd) * (cc - dd) + cd * cd)
                    high, low = abs(mean + apart), abs(mean - apart)
                    tilt = 0.5 * (1.0 / high - 1.0 / low) / apart
                    level = 1.0 / high - tilt * (mean + apart)
                    c_step = level * c_slope + tilt * (cc * c_slope + cd * d_slope)
                    d_step = level * d_slope + tilt * (cd * c_slope + dd * d_slope)
                    share = min(1.0, 2.0 / (P * math.sqrt(c_step * c_step + d_step * d_step)))
                elif gain > -1e-12 * best:
                    break
                else:
                    share *= 0.25
                c = at_c + share * c_step
                if pair:
                    d = abs(at_d + share * d_step)
                    if d > HALF_CIRCLE:
                        c, d = c + math.pi, math.pi - d
                    d = max(d, CLOSEST)
                if not abs(c) + d <= widest:
                    break
            if start == 0:
                found[t, 0], alone = best, at_c
            elif start == 1 or best > found[t, 1]:
                found[t, 1] = best
