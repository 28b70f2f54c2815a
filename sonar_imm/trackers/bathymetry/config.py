# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the bathymetry tracker, each with its unit, range and meaning.

Pings are independent of each other, so every parameter may change while the tracker runs: the
next ping is the first to see it.
"""

from __future__ import annotations

import math

from attrs import evolve, frozen

from ...acoustics.laplace import LIKELIHOODS
from ...acoustics.rays import profile_problem
from ...acoustics.sounding import ErrorBudget, GeometryDoubt
from ...parameters import constant, live
from ..model_checks import chain_problems
from ..shared_parameters import MountingParameters
from .terrain import KINDS

DEFAULT_SIGMAS = {
    'height_rw_ncs': (0.5, 1.0),
    'height_two_rw': (0.01, 0.5),
}
"""Noise of each model a range bin: metres, but 1/m for the slope model `ncs`."""
DEFAULT_STAY = 0.995
DEFAULT_SIGMAS_DEG = (0.1, 0.1, 2.0)
MODEL_SETS = ('terrain', 'height_rw_ncs', 'height_two_rw', 'angle_two_rw')
SPEED_STD, SPEED_STD_OF_NONE = 2.0, 15.0
"""m/s, of a sound speed that a snapshot states, and of one that nobody does."""
BEND_STD = 0.5
"""m/s, of the mean sound speed below the array: what bends a ray."""
USUAL_ALARM, HIGHEST_ALARM = 1e-3, 0.5
"""`gate_false_alarm`, and the highest one of a test."""
STEEP_DEG = 60.0
"""An array that looks down by so much runs angle models."""
OF_OTHER_SETS = (
    'sigmas',
    'sigmas_deg',
    'transition_matrix',
    'stay_probability',
    'initial_probabilities',
)
"""Parameters that `terrain` does not take."""
NAVIGATION = ('auto', 'required', 'ignored')
LAYOVER = ('ignored', 'gated', 'resolved')


@frozen(kw_only=True)
class BathymetryConfig(MountingParameters):
    """All parameters of the bathymetry tracker."""

    # fmt: off
    # -- which models ----------------------------------------------------------------------------
    model_set: str = live('terrain', '',
        'terrain models run side by side; height_two_rw is the particle filter of the paper, and '
        'an array with tilt_deg of 60 or more runs angle_two_rw in place of terrain',
        choices=MODEL_SETS)
    sigmas: tuple[float, ...] = live((), '',
        'process noise of each model over a range bin, in the order of model_set: m, but 1/m for '
        'ncs; empty: usual values',
        range=(0.0, 1000.0), kind='float[]')
    sigmas_deg: tuple[float, ...] = live((), 'deg',
        'angle_two_rw: process noise over a range bin, of the first model, then of the second at '
        'the first and the last bin; empty: 0.1, 0.1, 2', range=(0.0, 90.0),
        kind='float[]')
    sigma_reference_bin: float = constant(0.0, 'm',
        'range bin for which sigmas and sigmas_deg are stated: they grow with sqrt(bin / '
        'reference); 0: as stated, whatever the bin', range=(0.0, 100.0))
    rough_std: float = live(0.3, 'm',
        'floor is labelled smooth (told 0) only where roughness of this standard deviation would '
        'be seen', range=(0.0, 1000.0))
    transition_matrix: tuple[float, ...] = live((), '',
        'transition matrix over a range bin, row-major, row = from; empty: stay_probability',
        range=(0.0, 1.0), kind='float[]')
    stay_probability: float = live(0.0, '',
        'probability of keeping the model over a range bin, without transition_matrix; 0: 0.995',
        range=(0.0, 1.0))
    initial_probabilities: tuple[float, ...] = live((), '',
        'model probabilities before the first bin; empty: uniform', range=(0.0, 1.0),
        kind='float[]')
    initial_mean: float = constant(0.0, '',
        'state before the first bin: height of the floor in m, or angle in rad (see initial_std)',
        range=(-1000.0, 1000.0))
    initial_std: float = constant(0.0, '',
        'standard deviation of the state before the first bin, m or rad; 0: 1 m, or 5 deg around '
        'the angle of the first echo of the reference floor', range=(0.0, 1000.0))
    initial_slope_std: float = constant(0.1, '',
        'standard deviation of the slope before the first bin', range=(0.0, 100.0))
    redrawn_slope_std: float = constant(0.1, '',
        'height_rw_ncs: standard deviation of the slope while the random walk model holds, which '
        'has no slope; the paper has 0', range=(0.0, 100.0))

    angle_drift: bool = live(True, '',
        'angle_two_rw: predict the floor at constant height, not at constant angle')

    # -- sonar -----------------------------------------------------------------------------------
    sonar_height: float = live(15.0, 'm',
        'height of the sonar above the reference floor; with nav only at the start',
        range=(0.01, 12000.0))
    side: str = live('starboard', '', 'side the array looks to', choices=('port', 'starboard'))
    tilt_deg: float = live(30.0, 'deg',
        'direction the array looks to, below the horizon', range=(-90.0, 90.0))
    element_spacing_wavelengths: float = live(0.0, '',
        'distance between staves in wavelengths; 0: as the snapshot states, else 0.5',
        range=(0.0, 100.0))
    calibrate_array: bool = live(True, '',
        'measure gain, phase and noise of four or more staves from the echoes of each ping; not '
        'with multipath')
    conjugate: bool = live(False, '',
        'true when the phase of an echo from below broadside falls from stave to stave')
    conjugate_auto: bool = live(True, '',
        'turn conjugate round where the first pings fit a floor far better so; tilt_deg of 15 to '
        '60 only')
    sound_speed: float = live(1500.0, 'm/s',
        'speed of sound for snapshots that hold times and state no sound speed',
        range=(1300.0, 1700.0))

    # -- what is heard ---------------------------------------------------------------------------
    likelihood: str = constant('laplace', '',
        'distribution of the samples of one bin', choices=LIKELIHOODS)
    noise_variance: float = live(0.0, '',
        'noise power at a stave, for snapshots that state none; 0: from the water column, or '
        'blindly where there is none', range=(0.0, 1e30))
    gate_false_alarm: float = live(USUAL_ALARM, '',
        'probability that noise passes the test for a coherent echo, at most 0.5; 1: no test, '
        'every bin is an echo',
        range=(1e-9, 1.0))
    decorrelation: float = live(0.0, '',
        'share of the power of an echo that differs from stave to stave, as of a diffuse floor; '
        'acts as noise', range=(0.0, 0.95))
    layover: str = live('gated', '',
        'bins with echoes of two surfaces: gated (no soundings), resolved (both heights, four '
        'staves or more; else gated) or ignored, as always with multipath', choices=LAYOVER)
    multipath: bool = live(False, '',
        'expect echoes by way of the surface, as noise from their directions')
    sonar_depth: float = live(3.0, 'm',
        'depth of the sonar below the surface, for multipath', range=(0.0, 12000.0))

    # -- computation -----------------------------------------------------------------------------
    engine: str = constant('auto', '',
        'gaussian (terrain, and height_two_rw without Monte Carlo noise) or particles; auto: '
        'gaussian for terrain, else particles', choices=('auto', 'gaussian', 'particles'))
    particles_per_model: int = live(100, '',
        'number of particles of each model', range=(2, 100_000))
    smoothing: str = live('auto', '',
        'use of the whole ping for each bin: none, modes (model probabilities only) or states '
        '(terrain only); auto: states for terrain, else none',
        choices=('auto', 'none', 'modes', 'states'))
    ping_coupling: float = live(0.0, '',
        'strength with which model labels of neighbouring pings influence each other, usually '
        '0.15 to 0.35; 0: none. Needs smoothing; estimates come one ping late', range=(0.0, 5.0))
    seed: int = live(0, '', 'seed of the random number generator', range=(0, 2**63 - 1))

    # -- the ship --------------------------------------------------------------------------------
    navigation: str = live('auto', '',
        'use of nav: auto (from its first message on; required for a bag that has nav), required '
        '(pings wait for nav) or ignored (a level sonar at rest)', choices=NAVIGATION)
    sonar_lever: tuple[float, ...] = live((0.0, 0.0, 0.0), 'm',
        'vector from the navigation reference to the array: x forward, y port, z up (vehicle FLU)',
        range=(-100.0, 100.0))
    sonar_mount_rpy_deg: tuple[float, ...] = live((0.0, 0.0, 0.0), 'deg',
        'roll, pitch, yaw of the array in the vehicle (FLU: pitch positive nose down), besides '
        'side and tilt_deg', range=(-180.0, 180.0))
    max_gap: float = live(1.0, 's',
        'longest time between two poses of nav that is interpolated; pings in longer gaps are '
        'skipped', range=(0.01, 60.0))

    # -- the water -------------------------------------------------------------------------------
    sound_speed_profile: tuple[float, ...] = live((), '',
        'depth in m and sound speed in m/s in turn, linear between and constant beyond; empty: '
        'straight rays. Needs navigation', range=(-100.0, 12000.0), kind='float[]')
    water_level: float = live(0.0, 'm',
        'z of the water surface in the world; depth in sound_speed_profile is water_level - z',
        range=(-12000.0, 12000.0))

    # -- how well it is known --------------------------------------------------------------------
    sonar_height_std: float = live(0.0, 'm',
        'standard deviation of sonar_height, where the filter starts at the first return; 0: '
        'exact', range=(0.0, 1000.0))
    attitude_std_deg: float = live(0.05, 'deg',
        'standard deviation of roll and pitch in nav', range=(0.0, 45.0))
    heading_std_deg: float = live(0.1, 'deg',
        'standard deviation of the heading in nav', range=(0.0, 180.0))
    heave_std: float = live(0.05, 'm', 'standard deviation of z in nav', range=(0.0, 100.0))
    position_std: float = live(0.1, 'm',
        'standard deviation of x and of y in nav', range=(0.0, 10_000.0))
    tilt_std_deg: float = live(0.2, 'deg',
        'standard deviation of tilt_deg, the same in all pings; 0: exact', range=(0.0, 45.0))
    spacing_std: float = live(0.01, '',
        'standard deviation of the distance between staves, as a share of it; 0: exact',
        range=(0.0, 0.5))
    sound_speed_std: float = live(-1.0, 'm/s',
        'standard deviation of the sound speed, the same in all pings; 0: exact; -1: 2 where the '
        'snapshot states its sound speed, else 15', range=(-1.0, 100.0))
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check() + self._ship_problems() + self._check_sigmas()
        if self.is_terrain:
            problems += self._terrain_problems()
        else:
            problems += chain_problems(
                self.transition_matrix,
                self.initial_probabilities,
                self.model_count(),
                self.model_set,
            )
        if self.engine == 'gaussian' and self.model_set not in ('terrain', 'height_two_rw'):
            problems.append('engine gaussian is for terrain and height_two_rw only')
        if self.smoothing == 'states' and not self.is_terrain:
            problems.append(
                'smoothing of the states needs model_set terrain; other sets smooth modes'
            )
        if self.ping_coupling > 0.0 and self.smoothing_used == 'none':
            problems.append(
                'ping_coupling needs what a whole ping says of each bin: smoothing states (model '
                'set terrain) or modes'
            )
        return problems

    def _ship_problems(self) -> list[str]:
        problems = []
        if HIGHEST_ALARM < self.gate_false_alarm < 1.0:
            problems.append(
                f'gate_false_alarm is at most {HIGHEST_ALARM}, or 1 for no test, not '
                f'{self.gate_false_alarm:g}'
            )
        problems += [
            f'{name} needs three values, got {len(getattr(self, name))}'
            for name in ('sonar_lever', 'sonar_mount_rpy_deg')
            if len(getattr(self, name)) != 3
        ]
        if self.sound_speed_profile:
            if problem := profile_problem(self.sound_speed_profile):
                problems.append(f'sound_speed_profile {problem}')
            if self.navigation == 'ignored':
                problems.append(
                    'sound_speed_profile needs navigation: the depth of the sonar follows from it'
                )
        return problems

    def _terrain_problems(self) -> list[str]:
        given = [name for name in OF_OTHER_SETS if getattr(self, name)]
        problems = [
            f'terrain has models of its own and takes no {name}: height_two_rw and other sets do'
            for name in given
        ]
        if self.engine not in ('auto', 'gaussian'):
            problems.append(
                f'terrain runs on engine gaussian, not on {self.engine}, which is for other sets'
            )
        if self.smoothing == 'modes':
            problems.append('terrain smooths states, or nothing (none)')
        return problems

    def _check_sigmas(self) -> list[str]:
        if self.is_terrain:
            return []
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
        if len(self.sigmas) not in (0, wanted):
            problems.append(
                f'sigmas needs {wanted} values for model_set {self.model_set}, got '
                f'{len(self.sigmas)}'
            )
        return problems

    def for_inputs(self, inputs: frozenset[str]) -> BathymetryConfig:
        """A recording says whether there is navigation: its first pings wait for it, too."""
        if self.navigation != 'auto':
            return self
        return evolve(self, navigation='required' if 'nav' in inputs else 'ignored')

    def budget(self) -> ErrorBudget:
        """What soundings add to the variance of the filter."""
        return ErrorBudget(
            attitude=math.radians(self.attitude_std_deg),
            heading=math.radians(self.heading_std_deg),
            heave=self.heave_std,
            position=self.position_std,
            sound_speed=BEND_STD,
        )

    def doubt(self, stated: float | None) -> GeometryDoubt:
        """What all pings have in common; stated: the sound speed that a snapshot states, m/s."""
        std = self.sound_speed_std
        if std < 0.0:
            std = SPEED_STD_OF_NONE if stated is None else SPEED_STD
        speed = stated or self.sound_speed
        return GeometryDoubt(math.radians(self.tilt_std_deg), self.spacing_std, std / speed)

    @property
    def is_gated(self) -> bool:
        """Whether bins are tested for an echo."""
        return self.gate_false_alarm < 1.0

    @property
    def false_alarm(self) -> float:
        """Of the test for an echo. The first one of a ping is looked for without the gate, too."""
        return self.gate_false_alarm if self.is_gated else USUAL_ALARM

    @property
    def looks_down(self) -> bool:
        """Whether the array looks down so steeply that heights say too little of directions."""
        return abs(self.tilt_deg) >= STEEP_DEG

    def as_used(self) -> BathymetryConfig:
        """The same with the models that an array that looks down can run. Below it the height of
        a floor changes infinitely fast with the direction."""
        if not (self.is_terrain and self.looks_down):
            return self
        smoothing = 'modes' if self.ping_coupling > 0.0 else 'none'
        return evolve(
            self,
            model_set='angle_two_rw',
            engine='auto',
            smoothing=smoothing,
            angle_drift=False,
            initial_mean=0.0,
            initial_std=0.0,
        )

    @property
    def is_terrain(self) -> bool:
        """Whether the models are those of `terrain`."""
        return self.model_set == 'terrain'

    @property
    def is_gaussian(self) -> bool:
        """Whether the engine is the Gaussian one."""
        return self.is_terrain or self.engine == 'gaussian'

    @property
    def smoothing_used(self) -> str:
        """``none``, ``modes`` or ``states``."""
        if self.smoothing != 'auto':
            return self.smoothing
        return 'states' if self.is_terrain else 'none'

    @property
    def stay_used(self) -> float:
        """Probability of keeping the model over a range bin."""
        return self.stay_probability or DEFAULT_STAY

    @property
    def sigmas_used(self) -> tuple[float, ...]:
        """Noise of each model over a range bin, of the sets of heights."""
        return self.sigmas or DEFAULT_SIGMAS[self.model_set]

    @property
    def layover_used(self) -> str:
        """``ignored``, ``gated`` or ``resolved``. An echo by way of the surface is a second
        surface in every bin, which says nothing of the floor."""
        return 'ignored' if self.multipath else self.layover

    def model_count(self) -> int:
        """Number of models in the set these parameters describe."""
        return len(KINDS) if self.is_terrain else 2
