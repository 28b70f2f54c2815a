# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the floor goes on from one range bin to the next: the terrain models.

Each set is a few linear motions of one state, ``x <- F x + s G e`` with e standard normal, and
says how fast the floor may change; which one holds where is the segmentation of the swath.

terrain
    Nine kinds of floor, smooth ones with slopes, rough ones whose bins scatter, see `terrain`.
height_two_rw
    The height h of the floor is a random walk, slow (smooth floor) or fast (rough floor).
height_rw_ncs
    State (h, b), b the slope dh/dr over slant range. `rw`: h is a random walk and b means
    nothing; it is drawn anew from N(0, redrawn_slope_std^2), so that a slope model that takes over
    has something to select from. `ncs`, nearly constant slope: h <- h + dS b + dS^2/2 e, b <- b +
    dS e.
angle_two_rw
    The angle theta is a random walk, the second one growing linearly along the swath.

Source: Saucan, Chonavel, Sintes, Le Caillec, OCEANS 2013, equations 7 to 12. Two formulas differ
from the paper: its F_NCS has dS^2/2 in place of the 1 that keeps the slope, and its `rw` sets b to
zero; see docs.
"""

from __future__ import annotations

import math

from attrs import field, frozen
import numpy as np
from scipy.special import ndtr, ndtri

from ...acoustics.array import angle_of_depth
from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.markov import check_transition_matrix, persistent
from .bins import Geometry
from .config import BathymetryConfig, DEFAULT_SIGMAS_DEG
from .terrain import EITHER, Terrain, terrain_of, walks_of

HEIGHT_STD, ANGLE_STD = 1.0, math.radians(5.0)
FIRST_RETURN_ERROR = 0.25
"""Metres by which the first return may be found too early."""


@frozen(eq=False)
class UnknownHeight:
    """Where the floor starts below a sonar whose height is not known well.

    The height of the floor is normal, mean and std, but not lower than `lowest`: there the first
    return would have come later. Angles are those at which such a floor is seen at the first bin,
    from `height` of the array with `reach` and `tilt`, see `bins.Geometry`; None for
    heights.
    """

    mean: float
    std: float
    lowest: float
    view: tuple[float, float, float] | None

    def quantile(self, level: FloatArray) -> FloatArray:
        """States (N,) at probabilities `level` (N,)."""
        below = ndtr((self.lowest - self.mean) / self.std)
        whole = np.clip(below + (1.0 - below) * level, 1e-12, 1.0 - 1e-12)
        z = np.maximum(self.mean + self.std * ndtri(whole), self.lowest)
        if self.view is None:
            return z
        height, reach, tilt = self.view
        return np.arcsin(np.clip((height - z) / reach, -1.0, 1.0)) - tilt


@frozen(eq=False)
class TerrainModels:
    """M models over n states.

    F (M, n, n), G (M, n, k); scale (T, M): noise of each model at each bin; transition (M, M);
    initial (M,) probabilities before the first bin; mean (n,) and std (n,) of the state then;
    coast: the model that crosses bins without an echo. rough (M,): models that mean rough
    floor. start: the law of the first state where it is no normal one. favour (T, M): factors on
    the predicted probability of each model in each bin, from elsewhere; (0, M) for none. terrain:
    the motions as the Gaussian engine takes them, None for particles; with those of the model set
    `terrain` F, G and scale say nothing.
    """

    names: tuple[str, ...]
    state_names: tuple[str, ...]
    F: FloatArray
    G: FloatArray
    scale: FloatArray
    transition: FloatArray
    initial: FloatArray
    mean: FloatArray
    std: FloatArray
    coast: int
    rough: BoolArray
    start: UnknownHeight | None = None
    favour: FloatArray = field(factory=lambda: np.empty((0, 0)))
    terrain: Terrain | None = None

    @property
    def either(self) -> BoolArray:
        """Models (M,) of floor that may be smooth or rough."""
        return np.array([self.terrain is not None and name == EITHER for name in self.names])

    @property
    def least_variance(self) -> FloatArray:
        """Variance (T,) of the first state that particles cannot do without: of half the noise of
        the model with the least."""
        each = np.square(self.scale) * np.square(self.G[:, 0]).sum(axis=1)
        return np.asarray(0.25 * each.min(axis=1))

    def draw(self, particles: int, rng: np.random.Generator) -> FloatArray:
        """Particles (M, n, N) of the state before the first bin.

        One draw in each of N equal slices of the normal distribution, the slices of further states
        in random order: among a hundred independent draws there could be gaps wider than the
        likelihood.
        """
        M, n = len(self.names), len(self.state_names)
        x = np.empty((M, n, particles))
        for j in range(M):
            for a in range(n):
                level = (np.arange(particles) + rng.random(particles)) / particles
                level = level if a == 0 else rng.permutation(level)
                if a == 0 and self.start is not None:
                    x[j, a] = self.start.quantile(level)
                    continue
                x[j, a] = self.mean[a] + self.std[a] * ndtri(np.clip(level, 1e-12, 1.0 - 1e-12))
        return x


def build_models(
    config: BathymetryConfig,
    ranges: FloatArray,
    geometry: Geometry,
    first: int,
    floor_below: float,
) -> TerrainModels:
    """The models that `config` names for bins at `ranges` (T,) m, T > 1, of which the bin number
    `first` is the first with an echo; floor_below: how far below the array the floor is said to
    be, m."""
    T = len(ranges)
    mean, std = _start(config, geometry, first, floor_below)
    start = _unknown_height(config, ranges, geometry, first, floor_below)
    if config.is_terrain:
        terrain = terrain_of(_bin_width(ranges))
        M = len(terrain.names)
        return TerrainModels(
            names=terrain.names,
            state_names=_states(config),
            F=np.ones((M, 1, 1)),
            G=np.zeros((M, 1, 1)),
            scale=np.zeros((T, M)),
            transition=terrain.transition,
            initial=terrain.stationary,
            mean=np.array([mean]),
            std=np.array([std]),
            coast=0,
            rough=terrain.rough,
            start=start,
            terrain=terrain,
        )
    M, slope_set = config.model_count(), config.model_set == 'height_rw_ncs'
    if slope_set:
        F, G = _slope_motions(config, ranges)
        scale = np.ones((1, M))
    else:
        F, G = np.ones((M, 1, 1)), np.ones((M, 1, 1))
        scale = _noises(config, ranges)
    names = ('rw', 'ncs') if slope_set else ('rw_smooth', 'rw_rough')
    transition = _transition(config, M)
    initial = np.array(config.initial_probabilities or [1.0 / M] * M)
    walks = None
    if config.is_gaussian:
        walks = walks_of(names, scale[0], transition, initial, _bin_width(ranges))
    return TerrainModels(
        names=names,
        state_names=_states(config),
        F=F,
        G=G,
        scale=np.array(np.broadcast_to(scale, (T, M)), order='C'),
        transition=transition,
        initial=initial,
        mean=np.array([mean, 0.0][: F.shape[1]]),
        std=np.array([std, config.initial_slope_std][: F.shape[1]]),
        coast=1 if slope_set else int(np.argmin(scale.sum(axis=0))),
        rough=np.arange(M) == (0 if slope_set else 1),
        start=start,
        terrain=walks,
    )


def _states(config: BathymetryConfig) -> tuple[str, ...]:
    if config.model_set == 'height_rw_ncs':
        return 'height', 'slope'
    return ('angle',) if config.model_set == 'angle_two_rw' else ('height',)


def _bin_width(ranges: FloatArray) -> float:
    return float(np.median(np.diff(ranges)))


def _growth(config: BathymetryConfig, ranges: FloatArray) -> float:
    """What the noises stated at the reference bin are multiplied by."""
    reference = config.sigma_reference_bin
    return math.sqrt(_bin_width(ranges) / reference) if reference > 0.0 else 1.0


def _slope_motions(config: BathymetryConfig, ranges: FloatArray) -> tuple[FloatArray, FloatArray]:
    """F (2, 2, 2) and G (2, 2, 2) of `rw` and `ncs`, noises included."""
    rough, bend = _growth(config, ranges) * np.array(config.sigmas_used)
    width = _bin_width(ranges)
    F = np.array([[[1.0, 0.0], [0.0, 0.0]], [[1.0, width], [0.0, 1.0]]])
    G = np.zeros((2, 2, 2))
    G[0] = np.diag([rough, config.redrawn_slope_std])
    G[1, :, 0] = bend * 0.5 * width**2, bend * width
    return F, G


def _noises(config: BathymetryConfig, ranges: FloatArray) -> FloatArray:
    """Noise (1 or T, M) of each random walk over a bin."""
    if config.model_set == 'angle_two_rw':
        first, start, end = np.deg2rad(config.sigmas_deg or DEFAULT_SIGMAS_DEG)
        along = (ranges - ranges[0]) / (ranges[-1] - ranges[0])
        noises = np.column_stack([np.full(len(ranges), first), start + (end - start) * along])
    else:
        noises = np.array([config.sigmas_used])
    return _growth(config, ranges) * noises


def _transition(config: BathymetryConfig, models: int) -> FloatArray:
    if config.transition_matrix:
        return check_transition_matrix(np.reshape(config.transition_matrix, (models, models)))
    return persistent(models, config.stay_used)


def _start(
    config: BathymetryConfig, geometry: Geometry, first: int, floor_below: float
) -> tuple[float, float]:
    """Mean and standard deviation of the first state before the first bin."""
    if geometry.of_heights:
        mean = float(geometry.height[first]) - floor_below + config.initial_mean
        return mean, config.sonar_height_std or config.initial_std or HEIGHT_STD
    if config.initial_std > 0.0:
        return config.initial_mean, config.initial_std
    reach, tilt = float(geometry.reach[first]), float(geometry.tilt[first])
    return float(angle_of_depth(min(floor_below, reach), reach, tilt)), ANGLE_STD


def _unknown_height(
    config: BathymetryConfig,
    ranges: FloatArray,
    geometry: Geometry,
    first: int,
    floor_below: float,
) -> UnknownHeight | None:
    """The start when `sonar_height_std` says that the floor may be elsewhere."""
    if not config.sonar_height_std > 0.0:
        return None
    height = float(geometry.height[first])
    view = height, float(geometry.reach[first]), float(geometry.tilt[first])
    offset = config.initial_mean if geometry.of_heights else 0.0
    return UnknownHeight(
        mean=height - floor_below + offset,
        std=config.sonar_height_std,
        lowest=height - float(ranges[first]) - FIRST_RETURN_ERROR,
        view=None if geometry.of_heights else view,
    )
