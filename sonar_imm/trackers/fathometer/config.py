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

"""Parameters of the fathometer tracker, each with its unit, range and meaning."""

from __future__ import annotations

from functools import partial

from attrs import frozen

from ...acoustics.fathometer import OUTPUTS, PROCESSORS
from ...acoustics.spectra import WINDOWS
from ...estimation.set_model import PRIORS
from ...parameters import inherited, parameter
from ..model_checks import matrix_problems
from ..shared_parameters import StampParameters

live = partial(parameter, read_only=False)

PULSES = ('band', 'processor', 'envelope', 'gaussian', 'file')
PROPOSALS = ('data', 'prior')
POLARITIES = ('positive', 'both')
MULTIPLES = ('mark', 'off')
HEAVES = ('none', 'independent', 'memory')
MAX_MEMBERS = 50_000_000
MAX_DECAYS = 8


@frozen(kw_only=True)
class FathometerConfig(StampParameters):
    """Everything the fathometer tracker can be told."""

    # -- array and sound --------------------------------------------------------------------------
    phones: int = parameter(
        32, 'hydrophones of the array; 0: as many as the first record has', low=0, high=256
    )
    element_spacing: float = parameter(
        0.18, 'distance between hydrophones', unit='m', low=1e-4, high=100.0
    )
    sound_speed: float = parameter(1500.0, 'speed of sound', unit='m/s', low=1300.0, high=1700.0)
    array_depth: float = parameter(
        0.0,
        'depth of the deepest hydrophone, where neither the record nor a companion instrument '
        'tells; 0: depths are counted from it',
        unit='m',
        low=0.0,
        high=12000.0,
    )
    array_depth_age: float = live(
        30.0, 'a depth from the companion is used so long', unit='s', low=0.0, high=86400.0
    )
    array_depth_std: float = live(
        0.03,
        'error of the depth of the array as it is told, a part of the error of every reflector; '
        '0: depths are judged as seen from the array',
        unit='m',
        low=0.0,
        high=1000.0,
    )

    heave: str = parameter(
        'none',
        'whether the error of the told depth, of standard deviation array_depth_std, is a state '
        'that all reflectors share: none; independent, wrong anew in each record; memory, by '
        'heave_memory',
        choices=HEAVES,
    )
    heave_memory: float = parameter(
        0.9, 'memory: how much of the error stays from record to record', low=0.01, high=0.99
    )

    # -- from pressure to cross-spectra -----------------------------------------------------------
    snapshot_seconds: float = parameter(
        0.0,
        'length of a snapshot; 0: as the depths to be tracked and the number of hydrophones need, '
        'of cross-spectra one over the spacing of their frequencies',
        unit='s',
        low=0.0,
        high=1000.0,
    )
    overlap: float = parameter(0.5, 'share that snapshots have in common', low=0.0, high=0.95)
    window: str = parameter('hann', 'window of a snapshot', choices=WINDOWS)
    record_seconds: float = parameter(
        89.6, 'pressure averaged for one record', unit='s', low=1e-3, high=86400.0
    )
    preview_seconds: float = parameter(
        0.0,
        'an estimate that is not committed, from the sliding average, so often; 0: none',
        unit='s',
        low=0.0,
        high=86400.0,
    )

    # -- from cross-spectra to a depth response ---------------------------------------------------
    processor: str = parameter('mvdr', 'how the array looks up and down', choices=PROCESSORS)
    output: str = parameter(
        'coherence',
        'what is made of both beams: their coherence; their correlation, which red noise spoils; '
        'or printed, equations (2) and (4) of the paper to the letter: for mvdr the echoes lie '
        'above the array then',
        choices=OUTPUTS,
    )
    envelope: bool = parameter(
        False, 'of arrays: the envelope of the response, as the paper has it, in place of it'
    )
    loading: float = live(
        1e-2,
        'mvdr: diagonal loading, in units of the mean power of a hydrophone',
        low=0.0,
        high=1e6,
    )
    white_noise_gain_db: float = live(
        -3.0,
        'white_noise: least gain, against the most there is',
        unit='dB',
        low=-60.0,
        high=-0.01,
    )
    frequency_min: float = parameter(50.0, 'lower edge of the band', unit='Hz', low=0.0, high=1e6)
    frequency_max: float = parameter(
        4000.0, 'upper edge of the band', unit='Hz', low=1.0, high=1e6
    )
    depth_min: float = parameter(
        0.0,
        'least depth of a reflector; 0 together with depth_max: the whole trace, or 10 m to 110 m '
        'below the array',
        unit='m',
        low=0.0,
        high=12000.0,
    )
    depth_max: float = parameter(
        0.0, 'greatest depth of a reflector', unit='m', low=0.0, high=12000.0
    )
    depth_step: float = parameter(
        0.0,
        'distance of the depths that are told apart; 0: as the trace has it, or a sixth of the '
        'shortest half wavelength',
        unit='m',
        low=0.0,
        high=100.0,
    )
    noise_depth_min: float = live(
        180.0,
        'noise is measured between this depth and noise_depth_max, where no reflectors are; over '
        'the whole trace when it does not reach there. 0 together with noise_depth_max, and with '
        'automatic snapshots that are too short for it: where the depths tracked have their '
        'mirror image at the array, or in what reflectors leave of a trace',
        unit='m',
        low=0.0,
        high=12000.0,
    )
    noise_depth_max: float = live(
        300.0, 'end of the depths where noise is measured', unit='m', low=0.0, high=12000.0
    )
    noise_sigma: float = live(
        0.0,
        'standard deviation of the noise; 0: as the trace says, else measured',
        low=0.0,
        high=1e30,
    )
    remove_background: bool = live(
        False, 'take the median of the noise off the trace first: for envelopes'
    )

    # -- pulse ------------------------------------------------------------------------------------
    pulse: str = parameter(
        'band',
        'what one reflector leaves on the response: that of a flat band; what the mvdr processor '
        'makes of each record of an array (of other records, band); that of the envelope of a '
        'band; a Gaussian; or from a file',
        choices=PULSES,
    )
    pulse_width: float = parameter(
        0.5, 'gaussian: its standard deviation', unit='m', low=1e-4, high=100.0
    )
    pulse_file: str = parameter(
        '', 'file: a CSV of two columns, distance in m from 0 on, and value'
    )

    # -- volume scatter ---------------------------------------------------------------------------
    scatter_decay: tuple[float, ...] = parameter(
        (),
        'volume scatter below the first reflector, for envelopes: the depths over which it may '
        'fall to 1/e, tried in each record; empty: no volume scatter',
        kind='float[]',
        unit='m',
        low=0.01,
        high=1000.0,
    )
    scatter_spread: float = parameter(
        0.4,
        'scatter_decay: standard deviation of the scatter over its mean',
        low=0.01,
        high=2.0,
    )

    # -- sediment ---------------------------------------------------------------------------------
    sediment_sound_speed: float = live(
        0.0,
        'speed of sound just below the bottom, for sediment_depth; 0: as in the water',
        unit='m/s',
        low=0.0,
        high=8000.0,
    )
    sediment_sound_speed_std: float = live(
        0.0, 'error of sediment_sound_speed', unit='m/s', low=0.0, high=2000.0
    )
    sediment_sound_speed_gradient: float = live(
        0.0,
        'growth of the speed of sound with the depth below the bottom',
        unit='1/s',
        low=0.0,
        high=10.0,
    )

    # -- the set of reflectors --------------------------------------------------------------------
    order_min: int = parameter(1, 'least number of reflectors', low=0, high=64)
    order_max: int = parameter(12, 'greatest number of reflectors', low=1, high=64)
    order_switch_probability: float = parameter(
        0.05, 'that a record has one reflector more, and one less', low=0.0, high=0.5
    )
    order_transition_matrix: tuple[float, ...] = parameter(
        (),
        'transition matrix of the number of reflectors, row-major, row = from; empty: '
        'order_switch_probability',
        kind='float[]',
        low=0.0,
        high=1.0,
    )
    depth_std: float = parameter(
        0.1, 'how far a reflector moves from record to record', unit='m', low=1e-4, high=100.0
    )
    min_separation: float = parameter(
        0.4, 'least distance of two reflectors', unit='m', low=1e-4, high=1000.0
    )
    polarity: str = parameter(
        'positive',
        'sign of the reflectors looked for: where the impedance grows with depth they are '
        'positive; envelopes (remove_background) have no negative ones',
        choices=POLARITIES,
    )
    negative_probability: float = parameter(
        0.05, 'polarity both: that a new reflector is negative', low=1e-6, high=0.999
    )
    amplitude_prior: str = parameter(
        'marginal',
        'amplitudes integrated out, or the best ones with a penalty of log(N)/2 or log(N) each',
        choices=PRIORS,
    )
    amplitude_std_sigmas: float = parameter(
        7.5,
        'marginal: standard deviation of amplitudes, in units of the noise',
        low=0.01,
        high=1e6,
    )
    amplitude_memory: float = parameter(
        0.0,
        'marginal: how much of its amplitude a reflector keeps from record to record; 0: none',
        low=0.0,
        high=0.9999,
    )

    # -- computation ------------------------------------------------------------------------------
    particles: int = parameter(20_000, 'sets of reflectors tried', low=2, high=10_000_000)
    proposal: str = parameter(
        'data',
        'where particles go: where the record has peaks, or blindly (the bootstrap filter)',
        choices=PROPOSALS,
    )
    threads: int = parameter(
        1, 'processor cores used; the result does not depend on it', low=1, high=256
    )
    seed: int = parameter(0, 'of the random numbers', low=0, high=2**63 - 1)
    smoothing_lag: int = parameter(0, 'revise the estimate so many records later', low=0, high=100)

    # -- output -----------------------------------------------------------------------------------
    existence_min: float = live(
        0.5, 'least probability with which a reflector is reported', low=0.0, high=1.0
    )
    multiples: str = live(
        'mark',
        'whether reflectors get a probability of being multiples of others, by depths from the '
        'surface; they are never left out',
        choices=MULTIPLES,
    )
    track_memory: int = live(
        5, 'a reflector not seen for so many records gets a new id', low=0, high=10_000
    )

    # -- time -------------------------------------------------------------------------------------
    max_gap: float = inherited(StampParameters, 'max_gap', 30.0 * 86_400.0)
    restart_after: int = inherited(StampParameters, 'restart_after', 3)

    def check(self) -> list[str]:
        problems = super().check()
        if self.frequency_min >= self.frequency_max:
            problems.append('frequency_max must exceed frequency_min')
        if self.noise_depth_min >= self.noise_depth_max and not self.noise_from_mirror:
            problems.append('noise_depth_max must exceed noise_depth_min')
        if self.depth_max <= self.depth_min and (self.depth_min or self.depth_max):
            problems.append('depth_max must exceed depth_min')
        if self.order_max < self.order_min:
            problems.append('order_max cannot be less than order_min')
        else:
            problems += matrix_problems(
                self.order_transition_matrix,
                self.orders,
                f'order_min {self.order_min} to order_max {self.order_max}',
                name='order_transition_matrix',
            )
        if self.heave != 'none' and not self.array_depth_std:
            problems.append(f'heave {self.heave} needs array_depth_std')
        if self.particles * self.order_max > MAX_MEMBERS:
            problems.append(
                f'particles times order_max cannot exceed {MAX_MEMBERS}, for lack of memory'
            )
        if self.output == 'printed' and self.processor == 'white_noise':
            problems.append('output printed needs processor conventional or mvdr')
        if self.pulse == 'file' and not self.pulse_file:
            problems.append('pulse file needs pulse_file')
        if self.amplitude_memory and self.amplitude_prior != 'marginal':
            problems.append('amplitude_memory needs amplitude_prior marginal')
        if self.scatter_decay:
            problems += self._scatter_problems()
        if self.preview_seconds > self.record_seconds:
            problems.append('preview_seconds cannot exceed record_seconds')
        if 0.0 < self.snapshot_seconds < 1e-3:
            problems.append('snapshot_seconds is 0 or at least 0.001')
        if self.record_seconds < self.snapshot_seconds:
            problems.append('record_seconds cannot be less than snapshot_seconds')
        return problems

    def _scatter_problems(self) -> list[str]:
        problems = []
        if self.pulse == 'band':
            problems.append('scatter_decay is for envelopes: it needs pulse gaussian or file')
        if self.negative_share:
            problems.append('scatter_decay is for envelopes: it needs polarity positive')
        if self.amplitude_memory:
            problems.append('scatter_decay and amplitude_memory exclude each other')
        if len(self.scatter_decay) > MAX_DECAYS:
            problems.append(f'scatter_decay has at most {MAX_DECAYS} values')
        return problems

    @property
    def noise_from_mirror(self) -> bool:
        """True when no depths of noise are given."""
        return not (self.noise_depth_min or self.noise_depth_max)

    @property
    def negative_share(self) -> float:
        """How many of the new reflectors are negative."""
        if self.polarity == 'positive' or self.remove_background:
            return 0.0
        return self.negative_probability

    @property
    def orders(self) -> int:
        """How many numbers of reflectors are possible."""
        return self.order_max - self.order_min + 1
