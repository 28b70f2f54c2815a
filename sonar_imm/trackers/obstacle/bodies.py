# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""What the echoes of a body that is no point say of its place, and what they never can.

The glints of a body interfere, and the centroid of its echo wanders from ping to ping by about the
spread of the body. The spread that one image shows does not tell by how much: where one glint
outshines the others the echo looks like that of a point, and is as far off as ever. The size of a
body stays, so its mean over the pings does tell. Detections that come with their extent, as those
of images do, are therefore as uncertain as the echoes of their track were on average; a track
begins with what the parameters say of a detection without variance. Standard deviations are
averaged and not variances, in which a single echo that caught some noise would outweigh all
others.

Two errors are the same in every ping, so that no filter averages them out. They are
*considered*, that is added to what is published, while the filter goes on without them:

- the speed of sound: all ranges are wrong by the same factor (`range_scale_std`);
- the centre of a body: the mean of a few glints lies beside it, by a share `CENTRE` of the
  variance by which the centroid wanders.

Source: docs/obstacle.md, section From images; Schmidt 1966, 'Application of state space methods to
navigation problems', for considered errors.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from .filters import Sonar, View

CENTRE = 0.1
"""That of ten glints of equal strength."""
MEMORY = 30.0
"""Pings over which is averaged: aspect and range change what is seen of a body."""


class Bodies(NamedTuple):
    """Of T tracks: number (T,) of echoes with an extent, and their mean standard deviation (T, 2),
    m, in range and across it; zeros as long as there was none."""

    number: Annotated[FloatArray, 'T']
    std: Annotated[FloatArray, 'T2']

    @staticmethod
    def unknown(T: int) -> Bodies:
        return Bodies(np.zeros(T), np.zeros((T, 2)))

    def with_echoes(
        self, extended: BoolArray, z: FloatArray, R: FloatArray, own: FloatArray
    ) -> tuple[Bodies, FloatArray]:
        """Return the bodies after one detection z (T, 2), R (T, 2, 2) for each, of which some are
        `extended` (T,); and the covariance (T, 2, 2) to update with. own (2,): m^2 and rad^2,
        variances of a detection that comes without."""
        if not extended.any():
            return self, R
        metres = np.column_stack([np.ones(len(z)), z[:, 0]])
        stated = np.sqrt(np.diagonal(R, axis1=-2, axis2=-1)) * metres
        # The first echo of a track is averaged with what is believed beforehand.
        before = np.where(self.number[:, None] > 0.0, self.std, np.sqrt(own) * metres)
        weight = 1.0 / (np.minimum(self.number, MEMORY) + 2.0)
        mean = before + weight[:, None] * (stated - before)
        stated_now = extended[:, None]
        after = Bodies(self.number + extended, np.where(stated_now, mean, self.std))
        used = np.square(np.where(stated_now, mean, stated) / metres)
        return after, used[:, :, None] * np.eye(2)


def with_common_errors(view: View, sonar: Sonar, bodies: Bodies, scale_std: float) -> View:
    """The view with the errors that are the same in every ping."""
    centre = CENTRE * np.square(bodies.std)
    reach, away = view.state * [1.0, 0.0, 1.0], view.place - sonar.pose.position
    covariance = view.covariance + scale_std**2 * _outer(reach)
    covariance[:, 0, 0] += centre[:, 0]
    covariance[:, 1, 1] += centre[:, 1] / np.square(view.state[:, 0])
    place_covariance = view.place_covariance + scale_std**2 * _outer(away)
    along = away[:, :2] / np.maximum(np.hypot(*away[:, :2].T), 1e-9)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    for axis, variance in zip((along, across), centre.T):
        place_covariance[:, :2, :2] += variance[:, None, None] * _outer(axis)
    return view._replace(covariance=covariance, place_covariance=place_covariance)


def _outer(vector: FloatArray) -> FloatArray:
    """Return the outer products (T, n, n) of vectors (T, n), equal to the last bit on both
    sides."""
    return np.asarray(vector[:, :, None] * vector[:, None])
