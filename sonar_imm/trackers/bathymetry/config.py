# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Parameters of the bathymetry tracker, each with its unit, range and meaning.

Pings are independent of each other, so every parameter may change while the tracker runs: the
next ping is the first to see it.
"""

from __future__ import annotations

import math

from attrs import frozen

from ...acoustics.laplace import LIKELIHOODS
from ..model_checks import chain_problems
from .sea_parameters import parameter, SeaParameters

DEFAULT_SIGMAS = {
    'height_rw_ncs': (0.5, 1.0),
    'height_two_rw': (0.01, 0.5),
    'height_bank': (0.003, 0.03, 0.07, 0.5),
}
"""Noise of each model a range bin: metres, but 1/m for the slope model `ncs`."""
PAPER_SIGMAS = {'height_rw_ncs': (1.0, 1.0), 'height_two_rw': (0.01, 1.0)}
DEFAULT_STAY, BANK_STAY, PAPER_STAY = 0.995, 0.998, 0.98
DEFAULT_SIGMAS_DEG = (0.1, 0.1, 2.0)
MODEL_SETS = ('height_rw_ncs', 'height_two_rw', 'angle_two_rw', 'height_bank')
SCALAR_SETS = ('height_two_rw', 'angle_two_rw', 'height_bank')
"""The sets of one state, which the grid engine can run."""


@frozen(kw_only=True)
class BathymetryConfig(SeaParameters):
    """Everything the bathymetry tracker can be told."""

    # -- which models ----------------------------------------------------------------------------
    model_set: str = parameter(
        'height_two_rw', 'terrain models run side by side', choices=MODEL_SETS
    )
    variant: str = parameter(
        'corrected',
        'corrected, or paper: the formulas as printed (see the docs for what is wrong), and what '
        'the paper takes where nothing else is stated: sigmas 1 m and 1/m of height_rw_ncs, 0.01 '
        'and 1 m of height_two_rw, stay_probability 0.98; neither shadow_gate nor angle_drift',
        choices=('corrected', 'paper'),
    )
    sigmas: tuple[float, ...] = parameter(
        (),
        'noise of each model over a range bin, in the order of the set: m, but 1/m for ncs; '
        'empty: values that suit most floors; any number for height_bank',
        kind='float[]',
        low=0.0,
        high=1000.0,
    )
    sigmas_deg: tuple[float, ...] = parameter(
        (),
        'angle_two_rw: noise of the first model over a range bin, and of the second at the first '
        'and at the last bin, linear between; empty: 0.1, 0.1, 2',
        kind='float[]',
        unit='deg',
        low=0.0,
        high=90.0,
    )
    sigma_reference_bin: float = parameter(
        0.0,
        'range bin at which the noises are stated, they grow with sqrt(bin / reference); '
        '0: as stated whatever the bin',
        unit='m',
        low=0.0,
        high=100.0,
    )
    rough_sigma: float = parameter(
        0.07,
        'height_bank: walks of at least this noise over a range bin are rough floor; undulations '
        'and slopes of a smooth floor need up to 0.05',
        unit='m',
        low=0.0,
        high=1000.0,
    )
    transition_matrix: tuple[float, ...] = parameter(
        (),
        'transition matrix over a range bin, row-major, row = from; empty: stay_probability',
        kind='float[]',
        low=0.0,
        high=1.0,
    )
    stay_probability: float = parameter(
        0.0,
        'probability of keeping the model over a range bin, without transition_matrix; 0: 0.995, '
        'or 0.998 in height_bank, or 0.98 in variant paper',
        low=0.0,
        high=1.0,
    )
    initial_probabilities: tuple[float, ...] = parameter(
        (),
        'model probabilities before the first bin; empty: uniform',
        kind='float[]',
        low=0.0,
        high=1.0,
    )
    initial_mean: float = parameter(
        0.0,
        'state before the first bin: height of the floor in m, or angle in rad (see initial_std)',
        low=-1000.0,
        high=1000.0,
    )
    initial_std: float = parameter(
        0.0,
        'its standard deviation, m or rad; 0: 1 m, or 5 deg around the angle at which the '
        'reference floor is first heard',
        low=0.0,
        high=1000.0,
    )
    initial_slope_std: float = parameter(
        0.1, 'standard deviation of the slope before the first bin', low=0.0, high=100.0
    )
    redrawn_slope_std: float = parameter(
        0.1,
        'height_rw_ncs: standard deviation of the slope while the random walk holds, where it '
        'means nothing; the paper has 0',
        low=0.0,
        high=100.0,
    )

    angle_drift: bool = parameter(
        True,
        'angle_two_rw: the floor is predicted at constant height, not at constant angle; near '
        'nadir it turns by degrees from bin to bin',
    )

    # -- sonar -----------------------------------------------------------------------------------
    sonar_height: float = parameter(
        15.0,
        'height of the sonar above the reference floor; with nav only where the filter starts, '
        'see also sonar_height_std',
        unit='m',
        low=0.01,
        high=12000.0,
    )
    side: str = parameter('starboard', 'side the array looks to', choices=('port', 'starboard'))
    tilt_deg: float = parameter(
        30.0, 'direction the array looks to, below the horizon', unit='deg', low=-90.0, high=90.0
    )
    element_spacing_wavelengths: float = parameter(
        0.0,
        'distance between staves in wavelengths; 0: as the snapshot says, else 0.5',
        low=0.0,
        high=100.0,
    )
    conjugate: bool = parameter(
        False, 'the phase of an echo from below broadside falls from stave to stave'
    )
    sound_speed: float = parameter(
        1500.0,
        'for snapshots that have times, and no sound speed of their own',
        unit='m/s',
        low=1300.0,
        high=1700.0,
    )

    # -- what is heard ---------------------------------------------------------------------------
    likelihood: str = parameter(
        'laplace', 'distribution of the samples of one bin', choices=LIKELIHOODS
    )
    noise_variance: float = parameter(
        0.0,
        'noise power at a stave, for snapshots that do not bring it; 0: from the water column, '
        'or blindly where there is none',
        low=0.0,
        high=1e30,
    )
    shadow_gate: bool = parameter(
        True, 'bins without a coherent echo are passed over by the smoothest model'
    )
    gate_false_alarm: float = parameter(
        1e-3, 'probability of taking noise for an echo', low=1e-9, high=0.5
    )
    decorrelation: float = parameter(
        0.0,
        'share of the power of an echo that is not the same at all staves, as of a diffuse floor '
        'under a wide aperture; acts as noise',
        low=0.0,
        high=0.95,
    )
    multipath: bool = parameter(
        False, 'expect echoes by way of the surface, as noise from where they would come'
    )
    sonar_depth: float = parameter(
        3.0, 'depth of the sonar below the surface, for multipath', unit='m', low=0.0, high=12000.0
    )
    multipath_level_db: float = parameter(
        0.0, 'power of those echoes against the floor', unit='dB', low=-60.0, high=60.0
    )

    # -- computation -----------------------------------------------------------------------------
    engine: str = parameter(
        'auto',
        'particles, or a grid: exact, without Monte Carlo noise, for sets of one state; auto: '
        'grid for height_bank, else particles',
        choices=('auto', 'particles', 'grid'),
    )
    particles_per_model: int = parameter(100, 'particles of each model', low=2, high=100_000)
    grid_step: float = parameter(
        0.0,
        'distance of grid points, m or rad; 0: the smallest noise, 0.01 m or 0.05 deg at most; '
        '0.01 m for height_bank',
        low=0.0,
        high=100.0,
    )
    grid_extent: float = parameter(
        20.0,
        'the grid reaches so far to both sides of the start, and at least 2 sonar_height_std '
        '(angles: all that can be)',
        unit='m',
        low=0.1,
        high=1000.0,
    )
    smoothing: str = parameter(
        'auto',
        'use the whole ping for each bin: modes (Kim: the model probabilities only), or states '
        '(forward-backward on the grid: everything); auto: states for height_bank on the grid, '
        'which finds nothing rough without, else none',
        choices=('auto', 'none', 'modes', 'states'),
    )
    ping_coupling: float = parameter(
        0.0,
        'how strongly the labels of neighbouring pings lean on each other, 0 for not at all; 0.15 '
        'to 0.35 suit most; needs smoothing; estimates come one ping late; heights are left alone',
        low=0.0,
        high=5.0,
    )
    seed: int = parameter(0, 'of the random numbers', low=0, high=2**63 - 1)

    def check(self) -> list[str]:
        problems = super().check() + self._check_sigmas()
        models = self.model_count()
        problems += chain_problems(
            self.transition_matrix, self.initial_probabilities, models, self.model_set
        )
        if self.runs_on_grid and self.model_set not in SCALAR_SETS:
            problems.append(
                f'engine grid needs a set of one state ({", ".join(SCALAR_SETS)}), '
                f'{self.model_set} has two'
            )
        if self.smoothing == 'states' and not self.runs_on_grid:
            problems.append('smoothing of the states needs engine grid; particles smooth modes')
        if self.ping_coupling > 0.0 and self.smoothing_used == 'none':
            problems.append(
                'ping_coupling needs what a whole ping says of each bin: smoothing states (engine '
                'grid) or modes'
            )
        if self.model_set == 'angle_two_rw' and abs(self.initial_mean) > 0.5 * math.pi:
            problems.append(
                f'initial_mean is an angle for angle_two_rw, between -pi/2 and pi/2, not '
                f'{self.initial_mean:g}'
            )
        return problems

    def _check_sigmas(self) -> list[str]:
        if self.model_set == 'angle_two_rw':
            problems = ['angle_two_rw takes sigmas_deg, not sigmas'] if self.sigmas else []
            if len(self.sigmas_deg) not in (0, 3):
                problems.append(
                    'sigmas_deg needs three values (first model, second at the first and at the '
                    f'last bin), got {len(self.sigmas_deg)}'
                )
            return problems
        problems = ['sigmas_deg is for angle_two_rw only'] if self.sigmas_deg else []
        wanted = len(DEFAULT_SIGMAS[self.model_set])
        if self.model_set == 'height_bank':
            if len(self.sigmas) > 16:
                problems.append(f'height_bank takes at most 16 sigmas, got {len(self.sigmas)}')
        elif len(self.sigmas) not in (0, wanted):
            problems.append(
                f'sigmas needs {wanted} values for model_set {self.model_set}, got '
                f'{len(self.sigmas)}'
            )
        return problems

    @property
    def runs_on_grid(self) -> bool:
        """Whether the engine is the grid."""
        return self.engine == 'grid' or (self.engine == 'auto' and self.in_bank)

    @property
    def smoothing_used(self) -> str:
        """``none``, ``modes`` or ``states``."""
        if self.smoothing != 'auto':
            return self.smoothing
        return 'states' if self.in_bank and self.runs_on_grid else 'none'

    @property
    def stay_used(self) -> float:
        """Probability of keeping the model over a range bin."""
        usual = BANK_STAY if self.in_bank else DEFAULT_STAY
        return self.stay_probability or (PAPER_STAY if self.as_printed else usual)

    @property
    def sigmas_used(self) -> tuple[float, ...]:
        """Noise of each model over a range bin, of the sets of heights."""
        usual = DEFAULT_SIGMAS[self.model_set]
        return self.sigmas or (
            PAPER_SIGMAS.get(self.model_set, usual) if self.as_printed else usual
        )

    @property
    def gate_used(self) -> bool:
        """Whether bins without an echo are passed over; the paper tracks through them."""
        return self.shadow_gate and not self.as_printed

    @property
    def drift_used(self) -> bool:
        """Whether angles are predicted at constant height; in the paper they are not."""
        return self.angle_drift and not self.as_printed

    @property
    def as_printed(self) -> bool:
        return self.variant == 'paper'

    @property
    def in_bank(self) -> bool:
        return self.model_set == 'height_bank'

    def model_count(self) -> int:
        """Number of models in the set these parameters describe."""
        if self.model_set == 'angle_two_rw':
            return 2
        return len(self.sigmas_used)
