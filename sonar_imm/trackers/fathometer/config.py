# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the fathometer tracker, each with its unit, range and meaning."""

from __future__ import annotations

from attrs import evolve, fields, frozen

from ...acoustics.fathometer import OUTPUTS, PROCESSORS
from ...acoustics.spectra import WINDOWS
from ...parameters import constant, inherited, live, parameter
from ..model_checks import matrix_problems
from ..shared_parameters import StampParameters

PULSES = ('auto', 'band', 'processor', 'envelope', 'gaussian', 'file')
PULSE_WIDTHS = 1e-4, 100.0
POLARITIES = ('auto', 'positive', 'both')
MULTIPLES = ('mark', 'off')
PHONE_CORRECTIONS = ('off', 'gains', 'full')
WATERS = ('auto', 'off')
HEAVES = ('auto', 'none', 'independent', 'memory')
MAX_MEMBERS = 50_000_000
MVDR_GAIN = 3.0
"""By how much further echoes stand out with mvdr than with the conventional processor."""


@frozen(kw_only=True)
class FathometerConfig(StampParameters):
    """All parameters of the fathometer tracker."""

    # fmt: off
    # -- array and sound --------------------------------------------------------------------------
    phones: int = parameter(32, '',
        'number of hydrophones of the array; 0: as many as the first record has', range=(0, 256))
    element_spacing: float = parameter(0.18, 'm',
        'distance between hydrophones', range=(1e-4, 100.0))
    sound_speed: float = parameter(1500.0, 'm/s',
        'speed of sound in the water', range=(1300.0, 1700.0))
    sound_speed_std: float = parameter(10.0, 'm/s',
        'standard deviation of sound_speed, in the error of every depth below the array; 0: '
        'exact', range=(0.0, 200.0))
    array_depth: float = parameter(0.0, 'm',
        'depth of the deepest hydrophone where no record or instrument states it; 0: depths are '
        'counted from that hydrophone', range=(0.0, 12000.0))
    array_depth_age: float = constant(30.0, 's',
        'largest time between a record and the depth or position of a companion instrument that '
        'is used for it', range=(0.0, 86400.0))
    array_depth_std: float = live(0.03, 'm',
        'standard deviation of the stated depth of the array, in the error of every depth; 0: '
        'depths as seen from the array', range=(0.0, 1000.0))

    heave: str = parameter('auto', '',
        'error of the stated depth of the array as a state that all reflectors share: none, '
        'independent (new in each record), memory (correlated), or auto (independent once they '
        'move together by more than twice array_depth_std)', choices=HEAVES)
    heave_memory: float = constant(0.9, '',
        'heave memory: share of the error of the array depth that stays from record to record',
        range=(0.01, 0.99))

    # -- from pressure to cross-spectra -----------------------------------------------------------
    snapshot_seconds: float = parameter(0.0, 's',
        'length of a snapshot; 0: what depths and number of hydrophones need',
        range=(0.0, 1000.0))
    overlap: float = parameter(0.5, '',
        'share that successive snapshots have in common', range=(0.0, 0.95))
    window: str = parameter('hann', '', 'window function applied to a snapshot', choices=WINDOWS)
    record_seconds: float = parameter(89.6, 's',
        'length of pressure averaged for one record', range=(1e-3, 86400.0))
    preview_seconds: float = parameter(0.0, 's',
        'time between previews, estimates from the sliding average that are not committed; 0: '
        'none', range=(0.0, 86400.0))

    # -- hydrophones that differ ------------------------------------------------------------------
    phone_correction: str = parameter('full', '',
        'correction of hydrophones that differ: off, gains, or full (also inverted and late '
        'ones; foreign ones are left out)',
        choices=PHONE_CORRECTIONS)
    phone_least_share: float = constant(0.1, '',
        'phone_correction full: least share of the sound of its neighbours that a hydrophone '
        'has; with less it is left out', range=(0.0, 1.0))

    # -- from cross-spectra to a depth response ---------------------------------------------------
    processor: str = parameter('mvdr', '', 'beamformer that looks up and down', choices=PROCESSORS)
    output: str = constant('coherence', '',
        'response made of the beams up and down: coherence; correlation, which red noise spoils; '
        'or printed, equations (2) and (4) of the paper to the letter, which for mvdr puts the '
        'echoes above the array', choices=OUTPUTS)
    envelope: bool = constant(False, '',
        'for arrays: use the envelope of the response, as the paper does, in place of the '
        'response')
    loading: float = live(1e-2, '',
        'processor mvdr: diagonal loading, in units of the mean power of a hydrophone',
        range=(0.0, 1e6))
    white_noise_gain_db: float = constant(-3.0, 'dB',
        'processor white_noise: least white noise gain, relative to the largest possible',
        range=(-60.0, -0.01))
    frequency_min: float = parameter(50.0, 'Hz',
        'lower edge of the frequency band', range=(0.0, 1e6))
    frequency_max: float = parameter(4000.0, 'Hz',
        'upper edge of the frequency band', range=(1.0, 1e6))
    depth_min: float = parameter(0.0, 'm',
        'least depth of a reflector; 0 in both: the whole trace, or 10 to 110 m below the array',
        range=(0.0, 12000.0))
    depth_max: float = parameter(0.0, 'm',
        'greatest depth of a reflector',
        range=(0.0, 12000.0))
    depth_step: float = constant(0.0, 'm',
        'distance between the depths of the grid; 0: as the trace has it, or a sixth of the '
        'shortest half wavelength', range=(0.0, 100.0))
    noise_depth_min: float = live(180.0, 'm',
        'upper end of the depths where noise is measured; the whole trace if it does not reach '
        'there. 0 in both: at the mirror image of the depths tracked, or in what reflectors '
        'leave of a trace', range=(0.0, 12000.0))
    noise_depth_max: float = live(300.0, 'm',
        'lower end of the depths where noise is measured',
        range=(0.0, 12000.0))
    noise_sigma: float = live(0.0, '',
        'standard deviation of the noise of a trace; 0: as the trace says, else measured',
        range=(0.0, 1e30))

    # -- pulse ------------------------------------------------------------------------------------
    pulse: str = parameter('auto', '',
        'shape of one reflector in the response: band (of a flat band), processor (of mvdr, from '
        'each record of an array), envelope (of a band), gaussian or file; auto: processor for '
        'arrays longer than an eighth of the longest wave, else band, or gaussian where traces '
        'have another width', choices=PULSES)
    pulse_width: float = parameter(0.5, 'm',
        'pulse gaussian: standard deviation of the pulse', range=PULSE_WIDTHS)
    pulse_file: str = parameter('', '',
        'pulse file: CSV of distance in m from 0 on, and value')

    # -- envelopes --------------------------------------------------------------------------------
    water: str = parameter('auto', '',
        'auto: traces that are never negative are envelopes, whose noise, transmit pulse, water '
        'and floor are found; off: Gaussian noise', choices=WATERS)
    blanking: float = parameter(0.0, 'm',
        'envelopes: depth down to which the transmit pulse is left out; 0: it is found',
        range=(0.0, 12000.0))
    bottom_jump: float = constant(0.005, '',
        'envelopes: probability that the floor jumps anywhere from one record to the next',
        range=(1e-9, 0.5))
    fish_rate: float = constant(0.001, '1/m',
        'envelopes: how often a run of loud samples, as of fish, begins in the water',
        range=(1e-9, 1.0))

    # -- sediment ---------------------------------------------------------------------------------
    sediment_sound_speed: float = live(0.0, 'm/s',
        'speed of sound just below the bottom, for the column sediment_depth; 0: as in the '
        'water',
        range=(0.0, 8000.0))
    sediment_sound_speed_std: float = live(0.0, 'm/s',
        'standard deviation of sediment_sound_speed', range=(0.0, 2000.0))
    sediment_sound_speed_gradient: float = live(0.0, '1/s',
        'growth of the speed of sound with the depth below the bottom',
        range=(0.0, 10.0))

    # -- the set of reflectors --------------------------------------------------------------------
    order_min: int = parameter(1, '', 'least number of reflectors', range=(0, 64))
    order_max: int = parameter(12, '',
        'greatest number of reflectors', range=(1, 64))
    order_switch_probability: float = parameter(0.05, '',
        'probability of one reflector more than in the last record, and of one less',
        range=(0.0, 0.5))
    order_transition_matrix: tuple[float, ...] = parameter((), '',
        'transition matrix of the number of reflectors, row-major, row = from; empty: '
        'order_switch_probability', range=(0.0, 1.0), kind='float[]')
    depth_std: float = parameter(0.1, 'm',
        'standard deviation of the change of a depth from record to record',
        range=(1e-4, 100.0))
    slope_std: float = parameter(0.4, 'm',
        'standard deviation of the slope of a dipping reflector, as change of depth per record; '
        '0: all are still, as with heave',
        range=(0.0, 100.0))
    slope_switch_probability: float = constant(0.02, '',
        'slopes (slope_std): probability that from a record to the next a reflector begins to '
        'dip, ends it, or has a new slope', range=(1e-6, 0.3))
    record_interval: float = parameter(0.0, 's',
        'time between records that all values per record are meant for; 0: the median of the '
        'first intervals', range=(0.0, 86400.0))
    record_distance: float = parameter(0.0, 'm',
        'distance between records, in place of record_interval where positions are known; 0: '
        'time counts', range=(0.0, 100_000.0))
    common_jump_probability: float = parameter(0.05, '',
        'probability that all reflectors jump by the same distance, as over a fault or where the '
        'depth of the array changes unsaid; 0: never, as with heave', range=(0.0, 0.5))
    common_jump_std: float = parameter(1.5, 'm',
        'standard deviation of a common jump, cut at 2.67 of it', range=(0.01, 100.0))
    min_separation: float = parameter(0.4, 'm',
        'least distance between two reflectors', range=(1e-4, 1000.0))
    polarity: str = parameter('auto', '',
        'sign of reflectors: positive (impedance grows with depth) or both; auto: both for '
        'arrays with pulse processor, else positive', choices=POLARITIES)
    negative_probability: float = constant(0.05, '',
        'polarity both: probability that a new reflector is negative', range=(1e-6, 0.999))
    amplitude_std_sigmas: float = parameter(7.5, '',
        'standard deviation of amplitudes, in units of the noise; a third of it with processor '
        'conventional',
        range=(0.01, 1e6))
    amplitude_memory: float = constant(0.0, '',
        'share of its amplitude that a reflector keeps from record to record; 0: none',
        range=(0.0, 0.9999))

    # -- computation ------------------------------------------------------------------------------
    particles: int = parameter(20_000, '',
        'number of particles, each a set of reflectors', range=(2, 10_000_000))
    threads: int = parameter(1, '',
        'number of processor cores; the result does not depend on it', range=(1, 256))
    seed: int = parameter(0, '', 'seed of the random number generator', range=(0, 2**63 - 1))
    smoothing_lag: int = parameter(0, '',
        'number of records after which an estimate is revised; 0: never',
        range=(0, 100))

    # -- output -----------------------------------------------------------------------------------
    existence_min: float = live(0.5, '',
        'least probability of existence of a reported reflector', range=(0.0, 1.0))
    detectable_sigmas: float = constant(4.0, '',
        'amplitude, in units of the noise, above which reflectors are surely held: the columns '
        'prob_detectable_k are of the number of those above it', range=(0.1, 1000.0))
    multiples: str = constant('mark', '',
        'whether reflectors get a probability of being multiples of others, from their depths '
        'below the surface: mark or off; they are never left out', choices=MULTIPLES)
    track_memory: int = constant(5, '',
        'number of records after which a reflector that was not seen in them gets a new id',
        range=(0, 10_000))

    # -- time -------------------------------------------------------------------------------------
    max_gap: float = inherited(StampParameters, 'max_gap', 30.0 * 86_400.0)
    restart_after: int = inherited(StampParameters, 'restart_after', 3)
    # fmt: on

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
        if self.heave in ('independent', 'memory') and not self.array_depth_std:
            problems.append(f'heave {self.heave} needs array_depth_std')
        if self.particles * self.order_max > MAX_MEMBERS:
            problems.append(
                f'particles times order_max cannot exceed {MAX_MEMBERS}, for lack of memory'
            )
        if self.output == 'printed' and self.processor == 'white_noise':
            problems.append('output printed needs processor conventional or mvdr')
        if self.pulse == 'file' and not self.pulse_file:
            problems.append('pulse file needs pulse_file')
        if self.preview_seconds > self.record_seconds:
            problems.append('preview_seconds cannot exceed record_seconds')
        if 0.0 < self.snapshot_seconds < 1e-3:
            problems.append('snapshot_seconds is 0 or at least 0.001')
        if self.record_seconds < self.snapshot_seconds:
            problems.append('record_seconds cannot be less than snapshot_seconds')
        return problems

    def settled(self, hydrophones: int) -> FathometerConfig:
        """With the pulse and the polarity that `auto` stands for with the records of so many
        hydrophones, 0 for traces. Shorter arrays hear themselves down to where layers are."""
        pulse, polarity = self.pulse, self.polarity
        if 'auto' not in (pulse, polarity):
            return self
        array = hydrophones > 1 and self.processor == 'mvdr'
        if pulse == 'auto':
            aperture = self.element_spacing * (hydrophones - 1)
            is_long = 8.0 * aperture * self.frequency_min >= self.sound_speed
            plain = self.output == 'coherence' and not self.envelope
            pulse = 'processor' if array and is_long and plain else 'band'
        if polarity == 'auto':
            polarity = 'both' if array and pulse == 'processor' else 'positive'
        return evolve(self, pulse=pulse, polarity=polarity)

    @property
    def noise_from_mirror(self) -> bool:
        """True when no depths of noise are given."""
        return not (self.noise_depth_min or self.noise_depth_max)

    @property
    def noise_told(self) -> bool:
        """True when the depths of noise are not the default ones."""
        names = 'noise_depth_min', 'noise_depth_max'
        return any(
            getattr(self, name) != getattr(fields(type(self)), name).default for name in names
        )

    @property
    def negative_share(self) -> float:
        """How many of the new reflectors are negative."""
        return self.negative_probability if self.polarity == 'both' else 0.0

    @property
    def amplitude_std(self) -> float:
        """Of amplitudes, in units of the noise of the processor at hand."""
        # With a memory amplitudes are paid for once in a life: weak phantoms would be too cheap.
        drawn_anew = self.processor == 'conventional' and not self.amplitude_memory
        return self.amplitude_std_sigmas / (MVDR_GAIN if drawn_anew else 1.0)

    @property
    def orders(self) -> int:
        """How many numbers of reflectors are possible."""
        return self.order_max - self.order_min + 1
