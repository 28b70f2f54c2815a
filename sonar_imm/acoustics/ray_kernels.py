# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Rays through a profile of sound speed, one kernel; what it does is told in `rays`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..estimation.jit import kernel

FLAT = 1e-9
"""Gradients (1/s) below this are none: over 20 km they bend a ray by less than a millimetre."""
MOST_LAYERS = 10_000
"""A ray crosses at most so many edges."""
HALF_CIRCLE = 0.5 * math.pi


@kernel
def trace_rays(
    depths: NDArray[np.float64],
    speeds: NDArray[np.float64],
    start: NDArray[np.float64],
    launch: NDArray[np.float64],
    time: NDArray[np.float64],
    reached: NDArray[np.float64],
    end: NDArray[np.float64],
) -> None:
    """Trace rays (E,) from depths `start` at elevations `launch` through speeds (n,) at depths
    (n,), one or more times `time` (E,) long: the depth below `start` after each, into reached
    (R, E), and at the end depth, distance, sine and cosine of the elevation, into end (4, E)."""
    n = depths.shape[0]
    for k in range(start.shape[0]):
        z, x, sine, cosine = start[k], 0.0, math.sin(launch[k]), math.cos(launch[k])
        if abs(launch[k]) == HALF_CIRCLE:
            cosine = 0.0
        for r in range(reached.shape[0]):
            left = time[k]
            layer = (
                0  # between the depths layer - 1 and layer; on an edge, the one the ray goes into
            )
            while layer < n and (z > depths[layer] or (z == depths[layer] and sine > 0.0)):
                layer += 1
            level_edges = 0
            for _ in range(MOST_LAYERS):
                inside = 0 < layer < n
                g, c = 0.0, speeds[min(layer, n - 1)]
                if inside:
                    g = (speeds[layer] - speeds[layer - 1]) / (depths[layer] - depths[layer - 1])
                    c = speeds[layer - 1] + g * (z - depths[layer - 1])
                if abs(g) < FLAT:
                    down, edge_sine, edge_cosine = sine > 0.0, sine, cosine
                    open_ended = sine == 0.0 or (layer == n if down else layer == 0)
                    spent = math.inf
                    if not open_ended:
                        spent = (depths[layer if down else layer - 1] - z) / (c * sine)
                else:
                    # Which edge the ray meets: it bends to the slower side, and the edge there is
                    # met always, the faster one only by a ray that goes to it and does not turn
                    # before.
                    faster_is_below = g > 0.0
                    faster = speeds[layer] if faster_is_below else speeds[layer - 1]
                    slower = speeds[layer - 1] if faster_is_below else speeds[layer]
                    sign = 1.0 if faster_is_below else -1.0
                    rest = 1.0 - (faster * cosine / c) ** 2
                    if sign * sine > 0.0 and rest >= 0.0:
                        down, edge, edge_sine = faster_is_below, faster, sign * math.sqrt(rest)
                    else:
                        down, edge = not faster_is_below, slower
                        edge_sine = -sign * math.sqrt(max(1.0 - (slower * cosine / c) ** 2, 0.0))
                    # atanh S = ln((1 + S) / cos) = -ln((1 - S) / cos); the one without
                    # cancellation, and with the cosines left out where they would be 0 / 0.
                    ratio = edge / c
                    both = cosine * cosine * ratio
                    if sine >= 0.0 and edge_sine >= 0.0:
                        turned = math.log((1.0 + sine) / (1.0 + edge_sine) * ratio)
                    elif sine <= 0.0 and edge_sine <= 0.0:
                        turned = math.log((1.0 - edge_sine) / ((1.0 - sine) * ratio))
                    elif sine > 0.0:
                        turned = math.log((1.0 + sine) * (1.0 - edge_sine) / both)
                    else:
                        turned = -math.log((1.0 - sine) * (1.0 + edge_sine) / both)
                    spent, edge_cosine = turned / g, ratio * cosine
                step = min(max(spent, 0.0), left)
                if abs(g) < FLAT:
                    x += c * cosine * step
                    z += c * sine * step
                else:
                    sinh, half = math.sinh(g * step), math.sinh(0.5 * g * step)
                    den = math.cosh(g * step) - sine * sinh
                    x += c * cosine * sinh / (g * den)
                    z += c * (sine * sinh - 2.0 * half * half) / (g * den)
                    tangent = math.tanh(g * step)
                    sine, cosine = (sine - tangent) / (1.0 - sine * tangent), cosine / den
                # A level ray on an edge goes to the layer it bends into. At a minimum of the speed
                # both layers send it back: it goes straight on.
                level_edges = level_edges + 1 if sine == 0.0 and not spent > 0.0 else 0
                if level_edges > 2:
                    x += c * left
                    break
                if not spent < left:
                    break
                left -= step
                z = depths[layer if down else layer - 1]
                sine, cosine = edge_sine, edge_cosine
                layer += 1 if down else -1
            reached[r, k] = z - start[k]
        end[0, k], end[1, k], end[2, k], end[3, k] = z, x, sine, cosine
