"""How the floor goes on from one range bin to the next: the terrain models.

Each set is a few linear motions of one state, ``x <- F x + s G e`` with e standard normal, and
says how fast the floor may change; which one holds where is the segmentation of the swath.

height_two_rw
    The height h of the floor is a random walk, slow (smooth floor) or fast (rough floor).
height_bank
    The same with as many walks as there are sigmas.
height_rw_ncs
    State (h, b), b the slope dh/dr over slant range. `rw`: h is a random walk and b means
    nothing; it is drawn anew from N(0, redrawn_slope_std^2), so that a slope model that takes over
    has something to select from. `ncs`, nearly constant slope: h <- h + dS b + dS^2/2 e, b <- b +
    dS e.
angle_two_rw
    The angle theta is a random walk, the second one growing linearly along the swath.

variant `paper` uses the formulas as printed: F_NCS has dS^2/2 where the slope should persist (it
forgets the slope at once and is a random walk in disguise), and b is zeroed, not drawn anew.

Source: Saucan, Chonavel, Sintes, Le Caillec, OCEANS 2013, equations 7 to 12; see docs.
"""

from __future__ import annotations

import math

from attrs import frozen
import numpy as np
from scipy.special import ndtri

from ...acoustics.array import angle_of_depth
from ...estimation.arrays import FloatArray
from ...estimation.markov import check_transition_matrix, persistent
from .config import BathymetryConfig, DEFAULT_SIGMAS, DEFAULT_SIGMAS_DEG

HEIGHT_STD, ANGLE_STD = 1.0, math.radians(5.0)
HEIGHT_STEP, ANGLE_STEP = 0.01, math.radians(0.05)
MOST_CELLS = 20_000
"""The grid has at most so many cells to either side of its middle."""


@frozen(eq=False)
class TerrainModels:
    """M models over n states.

    F (M, n, n), G (M, n, k); scale (T, M): noise of each model at each bin; transition (M, M);
    initial (M,) probabilities before the first bin; mean (n,) and std (n,) of the state then;
    coast: the model that crosses bins where nothing is heard.
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
                x[j, a] = self.mean[a] + self.std[a] * ndtri(np.clip(level, 1e-12, 1.0 - 1e-12))
        return x


def build_models(config: BathymetryConfig, ranges: FloatArray, first: int) -> TerrainModels:
    """The models that `config` names for bins at `ranges` (T,) m, T > 1, of which the bin number
    `first` is the first with an echo."""
    M, T = config.model_count(), len(ranges)
    slope_set = config.model_set == 'height_rw_ncs'
    if slope_set:
        F, G = _slope_motions(config, ranges)
        scale = np.ones((1, M))
    else:
        F, G = np.ones((M, 1, 1)), np.ones((M, 1, 1))
        scale = _noises(config, ranges)
    mean, std = _start(config, float(ranges[first]))
    return TerrainModels(
        names=_names(config, M),
        state_names=_states(config),
        F=F,
        G=G,
        scale=np.array(np.broadcast_to(scale, (T, M)), order='C'),
        transition=_transition(config, M),
        initial=np.array(config.initial_probabilities or [1.0 / M] * M),
        mean=np.array([mean, 0.0][: F.shape[1]]),
        std=np.array([std, config.initial_slope_std][: F.shape[1]]),
        coast=1 if slope_set else int(np.argmin(scale.sum(axis=0))),
    )


def _names(config: BathymetryConfig, models: int) -> tuple[str, ...]:
    if config.model_set == 'height_rw_ncs':
        return 'rw', 'ncs'
    if config.model_set == 'height_bank':
        return tuple(f'rw_{number}' for number in range(1, models + 1))
    return 'rw_smooth', 'rw_rough'


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
    rough, bend = _growth(config, ranges) * np.array(
        config.sigmas or DEFAULT_SIGMAS['height_rw_ncs']
    )
    width, paper = _bin_width(ranges), config.variant == 'paper'
    keep = 0.5 * width**2 if paper else 1.0
    F = np.array([[[1.0, 0.0], [0.0, 0.0]], [[1.0, width], [0.0, keep]]])
    G = np.zeros((2, 2, 2))
    G[0] = np.diag([rough, 0.0 if paper else config.redrawn_slope_std])
    G[1, :, 0] = bend * 0.5 * width**2, bend * width
    return F, G


def _noises(config: BathymetryConfig, ranges: FloatArray) -> FloatArray:
    """Noise (1 or T, M) of each random walk over a bin."""
    if config.model_set == 'angle_two_rw':
        first, start, end = np.deg2rad(config.sigmas_deg or DEFAULT_SIGMAS_DEG)
        along = (ranges - ranges[0]) / (ranges[-1] - ranges[0])
        noises = np.column_stack([np.full(len(ranges), first), start + (end - start) * along])
    else:
        noises = np.array([config.sigmas or DEFAULT_SIGMAS[config.model_set]])
    return _growth(config, ranges) * noises


def _transition(config: BathymetryConfig, models: int) -> FloatArray:
    if config.transition_matrix:
        return check_transition_matrix(np.reshape(config.transition_matrix, (models, models)))
    return persistent(models, config.stay_probability)


def _start(config: BathymetryConfig, first_range: float) -> tuple[float, float]:
    """Mean and standard deviation of the first state before the first bin."""
    if config.initial_std > 0.0:
        return config.initial_mean, config.initial_std
    if config.model_set != 'angle_two_rw':
        return config.initial_mean, HEIGHT_STD
    depth = min(config.sonar_height, first_range)
    return float(angle_of_depth(depth, first_range, math.radians(config.tilt_deg))), ANGLE_STD


def grid_cells(config: BathymetryConfig, models: TerrainModels) -> FloatArray:
    """Cells (G,) for the grid engine: even, one of them at the mean of the start."""
    angle = config.model_set == 'angle_two_rw'
    step = config.grid_step
    if not step > 0.0:
        noises = models.scale[models.scale > 0.0]
        step = min(noises.min(initial=np.inf), ANGLE_STEP if angle else HEIGHT_STEP)
    extent = math.pi if angle else config.grid_extent
    count = math.ceil(min(extent / step, MOST_CELLS))
    cells = models.mean[0] + extent * np.arange(-count, count + 1) / count
    return cells[np.abs(cells) <= 0.5 * math.pi] if angle else cells
