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

"""Parameters of the diver tracker, each with its unit, range and meaning."""

from __future__ import annotations

from attrs import frozen

from ...parameters import inherited, parameter
from ..model_checks import chain_problems
from ..shared_parameters import DetectionParameters, StreamParameters, TrackLifeParameters
from .place_parameters import PlaceParameters
from .scan_parameters import ScanParameters
from .sea_parameters import SeaParameters

MODEL_SETS = (
    'heading_speed',
    'heading_speed_lateral',
    'world_headings',
    'relative_headings',
    'cv',
    'cv_cv',
    'cv_ct',
)
BASELINES = {'cv': 1, 'cv_cv': 2, 'cv_ct': 3}
"""The single-direction sets and how many models they have."""

ADAPTATIONS = ('counts', 'paper', 'ratio', 'fixed')


@frozen(kw_only=True)
class DiverConfig(
    SeaParameters,
    ScanParameters,
    PlaceParameters,
    DetectionParameters,
    TrackLifeParameters,
    StreamParameters,
):
    """Everything the diver tracker can be told. The defaults are the `heading_speed` set of the
    docs."""

    # -- which models ----------------------------------------------------------------------------
    model_set: str = parameter(
        'heading_speed', 'motion models run side by side', choices=MODEL_SETS
    )
    directions: int = parameter(16, 'headings of the multi-direction sets', low=4, high=64)
    hover: bool = parameter(True, 'add a model for standing still (heading_speed sets)')
    reference_step: float = parameter(
        1.0,
        'time step at which probabilities and noises below are stated; other steps are '
        'derived from it',
        unit='s',
        low=1e-3,
        high=3600.0,
    )
    longest_step: float = parameter(
        2.0,
        'longer gaps are crossed in steps of this, so that the diver may turn inside them',
        unit='s',
        low=1e-3,
        high=3600.0,
    )
    stay_probability: float = parameter(
        0.86, 'probability of keeping the heading over a reference step', low=0.0, high=1.0
    )
    heading_concentration: float = parameter(
        3.0,
        'a turn by a goes with probability proportional to exp(kappa cos a); 0 turns anywhere',
        low=0.0,
        high=50.0,
    )
    hover_enter: float = parameter(
        0.02, 'probability of stopping over a reference step', low=0.0, high=1.0
    )
    hover_stay: float = parameter(
        0.9, 'probability of staying stopped over a reference step', low=0.0, high=1.0
    )
    transition_matrix: tuple[float, ...] = parameter(
        (),
        'the whole transition matrix at the reference step, row-major, row = '
        'from; empty: built from the probabilities above',
        kind='float[]',
        low=0.0,
        high=1.0,
    )
    initial_probabilities: tuple[float, ...] = parameter(
        (), 'model probabilities of a new track; empty: uniform', kind='float[]', low=0.0, high=1.0
    )
    adaptation: str = parameter(
        'counts',
        'how the data correct the transition matrix: counts (Dirichlet), eq. 1 of the paper '
        'as a product (paper) or as a ratio (ratio), both guarded, or fixed',
        choices=ADAPTATIONS,
    )
    adaptation_prior: float = parameter(
        2.0, 'counts: weight of the prior matrix, in transitions a row', low=1e-3, high=1e6
    )
    adaptation_guard: float = parameter(
        0.7,
        'paper, ratio: share of the prior matrix kept at each step; below 0.3 they degenerate',
        low=0.0,
        high=1.0,
    )

    # -- how divers move -------------------------------------------------------------------------
    speed_mean: float = parameter(
        0.75, 'speed expected of a new track (heading_speed sets)', unit='m/s', low=0.0, high=20.0
    )
    speed_std: float = parameter(0.4, 'its standard deviation', unit='m/s', low=1e-3, high=20.0)
    velocity_std: float = parameter(
        0.7,
        'velocity of a new track on each axis, around zero (sets with a velocity state)',
        unit='m/s',
        low=1e-3,
        high=20.0,
    )
    speed_noise: float = parameter(
        0.005,
        'speed random walk over a reference step (heading_speed sets)',
        unit='m/s',
        low=0.0,
        high=10.0,
    )
    lateral_noise: float = parameter(
        0.24,
        'sideways wander over a reference step (heading_speed sets)',
        unit='m',
        low=0.0,
        high=10.0,
    )
    lateral_speed_std: float = parameter(
        0.2,
        'spread of the lateral velocity of heading_speed_lateral',
        unit='m/s',
        low=0.0,
        high=10.0,
    )
    lateral_speed_time: float = parameter(
        10.0,
        'time in which the lateral velocity of heading_speed_lateral fades',
        unit='s',
        low=1e-2,
        high=1e5,
    )
    hover_noise: float = parameter(
        0.05, 'position wander over a reference step while stopped', unit='m', low=0.0, high=10.0
    )
    fixed_speed: float = parameter(1.0, 'speed of world_headings', unit='m/s', low=0.0, high=20.0)
    velocity_noise: float = parameter(
        0.19,
        'velocity noise over a reference step of world_headings and relative_headings',
        unit='m/s',
        low=0.0,
        high=10.0,
    )
    acceleration_noise: tuple[float, ...] = parameter(
        (),
        'acceleration noise of each model of cv, cv_cv or cv_ct over a reference step; empty: '
        'values tuned for divers',
        kind='float[]',
        unit='m/s^2',
        low=0.0,
        high=100.0,
    )
    turn_rate_deg: float = parameter(
        20.0, 'turn rate of the two CT models of cv_ct', unit='deg/s', low=0.0, high=180.0
    )

    baseline_stay_probability: float = parameter(
        0.85,
        'probability of keeping the model over a reference step (cv_cv, cv_ct)',
        low=0.0,
        high=1.0,
    )

    # -- measurements ----------------------------------------------------------------------------
    fix_std: float = parameter(
        1.0,
        'standard deviation on each axis of a fix that comes without covariance',
        unit='m',
        low=1e-4,
        high=1e5,
        read_only=False,
    )
    covariance_scale: float = parameter(
        1.0,
        'measurement covariances are multiplied by this before use',
        low=1e-4,
        high=1e4,
        read_only=False,
    )
    estimate_covariance_scale: bool = parameter(
        False,
        'learn a further factor from the innovations, for sensors whose stated '
        'covariances are optimistic',
    )
    sound_speed: float = parameter(
        1500.0,
        'speed of sound for arrival times',
        unit='m/s',
        low=1300.0,
        high=1700.0,
        read_only=False,
    )
    toa_std: float = parameter(
        1e-3,
        'standard deviation of an arrival time that comes without variance',
        unit='s',
        low=1e-7,
        high=10.0,
        read_only=False,
    )
    bearing_std_deg: float = parameter(
        2.0,
        'standard deviation of a bearing that comes without variance',
        unit='deg',
        low=1e-3,
        high=90.0,
        read_only=False,
    )
    target_z: float = parameter(
        0.0,
        'z of the diver assumed when arrival times are used',
        unit='m',
        low=-12000.0,
        high=12000.0,
        read_only=False,
    )
    fixes_are_scans: bool = parameter(
        True,
        'fixes of one stamp are a whole scan: a diver without one was missed. Off for '
        'transponders polled in turn',
        read_only=False,
    )

    # -- tracks ----------------------------------------------------------------------------------
    max_tracks: int = inherited(
        TrackLifeParameters,
        'max_tracks',
        20,
        description='most divers at once; 1 means a single diver is known to be there',
    )

    def check(self) -> list[str]:
        problems = super().check()
        models = self.model_count()
        if self.model_set in BASELINES and len(self.acceleration_noise) not in (0, models):
            problems.append(
                f'acceleration_noise needs one value for each of the {models} models of '
                f'{self.model_set}, got {len(self.acceleration_noise)}'
            )
        problems += chain_problems(
            self.transition_matrix, self.initial_probabilities, models, self.model_set
        )
        return problems

    def model_count(self) -> int:
        """Number of models in the set these parameters describe."""
        if self.model_set in BASELINES:
            return BASELINES[self.model_set]
        return self.directions + (
            1 if self.hover and self.model_set.startswith('heading_speed') else 0
        )
