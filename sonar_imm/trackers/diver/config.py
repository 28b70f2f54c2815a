# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters of the diver tracker, each with its unit, range and meaning."""

from __future__ import annotations

from collections.abc import Mapping
import re
from typing import Any, cast

from attrs import evolve, fields, frozen

from ...parameters import Config, constant, inherited, live, MODELS, parameter, ParameterSpec
from ..model_checks import chain_problems
from ..own_models import diver_models
from ..shared_parameters import (
    DetectionParameters,
    OriginParameters,
    StreamParameters,
    TrackLifeParameters,
)

MODEL_SETS = ('families', 'heading_speed')

TARGETS: dict[str, dict[str, Any]] = {
    'diver': {},
    'rov': {
        'speed_mean': 0.4,
        'speed_std': 0.3,
        'velocity_std': 0.5,
        'hover_enter': 0.05,
        'hover_stay': 0.95,
        'acceleration_noise': (0.05, 0.4, 0.02),
        'vertical_speed_std': 0.3,
    },
    'fish': {
        'speed_mean': 0.6,
        'speed_std': 0.5,
        'velocity_std': 0.8,
        'brisk_speed_noise': 0.2,
        'stay_probability': 0.7,
        'acceleration_noise': (0.1, 1.0, 0.05),
        'vertical_speed_std': 0.3,
    },
    'boat': {
        'speed_mean': 6.0,
        'speed_std': 5.0,
        'velocity_std': 8.0,
        'speed_noise': 0.05,
        'brisk_speed_noise': 0.5,
        'lateral_noise': 1.0,
        'stay_probability': 0.95,
        'acceleration_noise': (0.3, 2.5, 0.1),
    },
    'ship': {
        'speed_mean': 6.0,
        'speed_std': 3.0,
        'velocity_std': 7.0,
        'speed_noise': 0.02,
        'brisk_speed_noise': 0.1,
        'lateral_noise': 0.5,
        'stay_probability': 0.98,
        'hover_enter': 0.001,
        'acceleration_noise': (0.03, 0.3, 0.01),
    },
}
"""What takes the place of the defaults for each kind of target, in the units of the parameters."""

AFLOAT = 2.0
"""Standard deviation on each axis of the velocity of what a fix shows, m/s, where nothing is said
of it. A boat is tracked no other way, and it costs a diver nothing."""

ADAPTATIONS = ('counts', 'fixed')
SYSTEMATIC = ('mixed', 'consider', 'estimate', 'exact')
ASSOCIATIONS = ('gnn', 'jipda')
VESSELS = ('moving', 'fixed')
RELATIVE_AXES = ('flu', 'frd', 'enu', 'ned')
OF_SENSOR = (
    'fix_std',
    'detection_probability',
    'clutter_density',
    'coverage_sector',
    'coverage_file',
)
"""Parameters that may differ from sensor to sensor."""

CLUTTER = 1e-6
"""False fixes per square metre and scan where nobody says how many there are."""

SECTOR = 6
"""Numbers of a sector."""

_WORD = re.compile(r'[A-Za-z0-9_]+')


@frozen(kw_only=True)
class DiverConfig(DetectionParameters, TrackLifeParameters, OriginParameters, StreamParameters):
    """All parameters of the diver tracker. The defaults are the `families` of the docs.

    own: values that sensors have of their own, by names as ``radar.fix_std``.
    """

    # fmt: off
    # -- which models ----------------------------------------------------------------------------
    model_set: str = parameter('families', '',
        'motion models run side by side; also a set that another package registers',
        choices=MODEL_SETS, group=MODELS)
    target: str = parameter('diver', '',
        'kind of target (diver, rov, fish, boat or ship): speeds, accelerations and turns of '
        'families wherever a parameter is at its default',
        choices=tuple(TARGETS))
    directions: int = parameter(16, '',
        'number of headings (heading_speed, families)', range=(4, 64))
    hover: bool = constant(True, '',
        'add a model for standing still (heading_speed, families)')
    reference_step: float = constant(1.0, 's',
        'time step for which the probabilities and noises of the models are stated; values for '
        'other steps are derived from them', range=(1e-3, 3600.0))
    longest_step: float = constant(2.0, 's',
        'longer gaps are crossed in steps of this length, so that the diver may turn within them',
        range=(1e-3, 3600.0))
    stay_probability: float = parameter(0.86, '',
        'probability of keeping the heading over 1 s', range=(0.0, 1.0))
    heading_concentration: float = constant(3.0, '',
        'kappa: a turn by an angle a has a probability proportional to exp(kappa cos a); 0: all '
        'turns are alike', range=(0.0, 50.0))
    hover_enter: float = constant(0.02, '',
        'probability of stopping over 1 s', range=(0.0, 1.0))
    hover_stay: float = constant(0.9, '',
        'probability of staying stopped over 1 s', range=(0.0, 1.0))
    transition_matrix: tuple[float, ...] = parameter((), '',
        'whole transition matrix over 1 s, row-major, row = from; empty: built from '
        'stay_probability', range=(0.0, 1.0), kind='float[]')
    initial_probabilities: tuple[float, ...] = parameter((), '',
        'model probabilities of a new track; empty: uniform', range=(0.0, 1.0), kind='float[]')
    family_switch_rate: float = constant(0.001, '1/s',
        'families: rate of going from one family of models to the others', range=(0.0, 10.0))
    covariance_scales: tuple[float, ...] = parameter(
        (0.02, 0.15, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5, 1e6), '',
        'families: factors by which scaled filters multiply all measurement covariances; those '
        'from 1 on determine the published covariance. With dimensions 3: one filter, scale 1',
        range=(0.01, 1e6), kind='float[]')
    sensor_delays: tuple[float, ...] = parameter((0.25, 0.5, 1.0, 2.0, 4.0), 's',
        'families: possible delays of the stamps of one of several sensors; empty: none',
        range=(1e-3, 3600.0), kind='float[]')
    adaptation: str = constant('counts', '',
        'correction of the transition matrix by the data: counts (Dirichlet) or fixed (none)',
        choices=ADAPTATIONS)
    adaptation_prior: float = constant(2.0, '',
        'adaptation counts: weight of the prior matrix, in transitions per row', range=(1e-3, 1e6))

    # -- how divers move -------------------------------------------------------------------------
    speed_mean: float = parameter(0.75, 'm/s',
        'speed expected of a new track (heading_speed, families)', range=(0.0, 20.0))
    speed_std: float = parameter(0.4, 'm/s',
        'standard deviation of the speed of a new track (heading_speed, families)',
        range=(1e-3, 20.0))
    velocity_std: float = constant(0.7, 'm/s',
        'families: standard deviation on each axis of the velocity of a new track, around zero; '
        '2 at a fix of a diver', range=(1e-3, 20.0))
    speed_noise: float = parameter(0.005, 'm/s',
        'random walk of the speed over 1 s (heading_speed, families)',
        range=(0.0, 10.0))
    brisk_speed_noise: float = constant(0.07, 'm/s',
        'families: random walk of the speed over 1 s in the brisk family, in place '
        'of speed_noise', range=(0.0, 10.0))
    lateral_noise: float = constant(0.24, 'm',
        'random walk sideways over 1 s (heading_speed, families)',
        range=(0.0, 10.0))
    hover_noise: float = constant(0.05, 'm',
        'random walk of the position over 1 s while stopped', range=(0.0, 10.0))
    acceleration_noise: tuple[float, ...] = parameter((), 'm/s^2',
        'families: acceleration noise of lively_calm, lively_sharp and quiet over 1 s; empty: '
        'that of the target', range=(0.0, 100.0), kind='float[]')

    # -- measurements ----------------------------------------------------------------------------
    fix_std: float = live(1.0, 'm',
        'standard deviation on each axis of a fix that comes without covariance',
        range=(1e-4, 1e5))
    covariance_scale: float = live(1.0, '',
        'factor by which measurement covariances are multiplied before use', range=(1e-4, 1e4))
    sound_speed: float = live(1500.0, 'm/s',
        'speed of sound with which arrival times become distances', range=(1300.0, 1700.0))
    toa_std: float = live(1e-3, 's',
        'standard deviation of an arrival time that comes without variance', range=(1e-7, 10.0))
    bearing_std_deg: float = live(2.0, 'deg',
        'standard deviation of a bearing that comes without variance', range=(1e-3, 90.0))
    target_z: float = live(0.0, 'm',
        'z of the diver that is assumed when arrival times are used', range=(-12000.0, 12000.0))
    scan_period: float = parameter(0.0, 's',
        'time in which a sensor that rotates or polls looks at all targets once: fixes without a '
        'name within it are one scan. 0: fixes of one stamp are a scan, -1: fixes are no scans '
        '(transponders polled in turn)', range=(-1.0, 3600.0))

    # -- tracks ----------------------------------------------------------------------------------
    max_tracks: int = inherited(TrackLifeParameters, 'max_tracks', 20,
        description='largest number of targets tracked at once; 1: a single target is known to '
        'be there')

    # -- outliers --------------------------------------------------------------------------------
    burst_rate: float = live(0.005, '',
        'families: probability that a fix begins a burst (fixes off by the same vector, as of '
        'multipath), and that it is a single outlier; 0: neither',
        range=(0.0, 0.3))
    burst_end: float = live(0.05, '',
        'probability that a burst ends at a fix', range=(1e-3, 0.5))
    burst_std: float = live(20.0, 'm',
        'standard deviation on each axis of the vector of a burst',
        range=(0.1, 1e4))
    outlier_probability: float = live(0.02, '',
        'probability that an arrival time is an outlier, as of a reflection', range=(1e-6, 0.5))

    # -- depth -----------------------------------------------------------------------------------
    dimensions: int = parameter(2, '',
        'number of coordinates: 2 (the target is at target_z) or 3 (depth is a state, from '
        'arrivals and from fixes with a variance of z)', range=(2, 3))
    depth_min: float = parameter(0.0, 'm',
        'least depth of a diver, positive down (dimensions 3)', range=(-1e3, 1.1e4))
    depth_max: float = parameter(20.0, 'm',
        'greatest depth of a diver, positive down (dimensions 3)', range=(-1e3, 1.1e4))
    vertical_speed_std: float = constant(0.1, 'm/s',
        'standard deviation of the vertical speed (dimensions 3)', range=(1e-4, 10.0))
    vertical_speed_time: float = constant(10.0, 's',
        'time over which the vertical speed is correlated (dimensions 3)', range=(1e-2, 1e5))

    # -- systematic errors of instruments --------------------------------------------------------
    receiver_position_std: float = parameter(0.0, 'm',
        'standard deviation on each horizontal axis of receiver positions. Where this, '
        'receiver_clock_std and sound_speed_std are 0, tracks from arrivals alone assume 0.3 m, '
        '0.1 ms and 2 m/s; exact: 1e-6', range=(0.0, 1e3))
    receiver_clock_std: float = parameter(0.0, 's',
        "standard deviation of a receiver's clock error; 0: see receiver_position_std",
        range=(0.0, 1.0))
    sound_speed_std: float = parameter(0.0, 'm/s',
        'standard deviation of sound_speed; 0: see receiver_position_std', range=(0.0, 100.0))
    bearing_bias_std_deg: float = parameter(0.0, 'deg',
        'standard deviation of a constant bearing error of a sensor (heading or mount): relative '
        'fixes, bearings of arrivals, fixes of sensors with coverage_sector', range=(0.0, 45.0))
    systematic_errors: str = constant('mixed', '',
        'treatment of errors of receivers, clocks, sound speed and bearings: consider (in the '
        'covariance, never estimated), estimate, mixed (clocks and sound speed estimated, the '
        'rest considered) or exact (nothing is off); where none is stated, 0.3 m, 0.1 ms and 2 '
        'm/s are part of the covariance of tracks from arrivals alone', choices=SYSTEMATIC)

    # -- errors of fixes that last ---------------------------------------------------------------
    fix_bias_std: float = parameter(0.0, 'm',
        'standard deviation on each axis of slowly varying fix errors, added to the covariance; '
        'for sources that filter their output, as USBL or GPS', range=(0.0, 1e4))
    fix_bias_time: float = constant(60.0, 's',
        'time over which the lasting error of the fixes (fix_bias_std) is correlated',
        range=(1e-2, 1e6))

    # -- association -----------------------------------------------------------------------------
    clutter_density: float = inherited(DetectionParameters, 'clutter_density', 0.0,
        range=(0.0, 1e4),
        description='false fixes expected per square metre and scan; 0: learnt by jipda for each '
        'place, 1e-6 with gnn')
    association: str = parameter('auto', '',
        'association of fixes: gnn (the most likely one, tracks confirmed by hits), jipda (all '
        'weighted, tracks confirmed by existence) or auto (jipda with families, else gnn)',
        choices=('auto', *ASSOCIATIONS))
    gate_probability: float = inherited(
        DetectionParameters, 'gate_probability', 0.999, constant=True)
    confirm_hits: int = inherited(TrackLifeParameters, 'confirm_hits', 3, constant=True)
    confirm_window: int = constant(5, '',
        'number of latest scans or pings in which confirm_hits are counted to confirm a track',
        range=(1, 100))
    delete_misses: int = constant(5, '',
        'number of consecutive scans or pings without a hit that cover a confirmed target and so '
        'end its track', range=(1, 10000))
    birth_density: float = live(2e-7, '1/(m^2 s)',
        'jipda: new targets expected per square metre and second',
        range=(1e-14, 1.0))
    survival_time: float = constant(500.0, 's',
        'jipda: time for which a diver is expected to stay', range=(1.0, 1e7))

    # -- what the sensor covers ------------------------------------------------------------------
    coverage_sector: tuple[float, ...] = live((), 'm, deg',
        'x, y of the sensor, direction of the middle of its sector (counterclockwise from x), '
        'width, least and greatest range; detection_probability holds inside, 0 outside. Empty: '
        'everywhere',
        kind='float[]')
    coverage_file: str = parameter('', '',
        'CSV in place of detection_probability: columns x, y, probability, or range, probability '
        '(from the place in coverage_sector, else the origin); 0 outside. Empty: none')

    # -- names -----------------------------------------------------------------------------------
    tags: tuple[str, ...] = parameter((), '',
        'names of targets: fixes on <name>/fix or <name>/relative, or in a frame of that name, '
        'go to their own track without association',
        kind='str[]')
    repeat_time: float = parameter(5.0, 's',
        'time within which equal values are repeats, left out and counted (longer where a sensor '
        'holds its values); 0: use them', range=(0.0, 3600.0))

    # -- sensors ---------------------------------------------------------------------------------
    sensors: tuple[str, ...] = parameter((), '',
        'names of sensors with their own <name>.fix_std, detection_probability, clutter_density, '
        'coverage_sector and coverage_file: for what comes on <name>/fix, /fixes or /relative, '
        'or in a frame of that name',
        kind='str[]')
    own: tuple[tuple[str, Any], ...] = ()

    # -- latitude and longitude ------------------------------------------------------------------
    origin: tuple[float, ...] = inherited(OriginParameters, 'origin', (0.0, 0.0, 0.0),
        description='latitude, longitude and height above the ellipsoid of the origin of the '
        'tracks; both 0: the first position in latitude and longitude, at that height')
    frame_id: str = parameter('', '',
        'frame of the input, and of positions given in latitude and longitude; empty: that of '
        'the first message, and map')

    # -- relative to a transceiver ---------------------------------------------------------------
    vessel: str = parameter('moving', '',
        'carrier of the transceiver of relative fixes: moving (pose from nav, or nav_fix and '
        'heading) or fixed (at the origin, x east; transceiver_lever is its place)',
        choices=VESSELS)
    transceiver_lever: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'm',
        'vector from the reference of nav, or the antenna of nav_fix, to the transceiver: x '
        'forward, y port, z up', range=(-1e4, 1e4))
    transceiver_lever_std: float = constant(0.0, 'm',
        'standard deviation of transceiver_lever on each axis', range=(0.0, 100.0))
    transceiver_mount_rpy_deg: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'deg',
        'roll, pitch, yaw of the transceiver on the vessel (forward, port, up: pitch positive '
        'nose down)', range=(-180.0, 180.0))
    relative_axes: str = parameter('flu', '',
        'axes of relative fixes whose message states none: flu (forward, port, up of the '
        'transceiver), frd (forward, starboard, down), enu or ned (of the world, by its own '
        'compass)', choices=RELATIVE_AXES)
    relative_range_std: float = live(0.5, 'm',
        'standard deviation of the range of a relative fix that comes without covariance',
        range=(1e-4, 1e4))
    relative_angle_std_deg: float = live(2.0, 'deg',
        'standard deviation of the direction of a relative fix that comes without covariance',
        range=(1e-3, 45.0))
    vessel_position_std: float = live(1.0, 'm',
        "standard deviation on each axis of the vessel's position where its message states none",
        range=(0.0, 1e4))
    vessel_heading_std_deg: float = live(1.0, 'deg',
        "standard deviation of the vessel's heading where its message states none",
        range=(0.0, 45.0))
    magnetic_declination_deg: float = parameter(0.0, 'deg',
        'angle from true to magnetic north, positive east, for headings and relative fixes '
        'levelled by a compass', range=(-180.0, 180.0))
    vessel_attitude_std_deg: float = constant(0.5, 'deg',
        "standard deviation of the vessel's roll and pitch where its message states none",
        range=(0.0, 45.0))
    vessel_max_gap: float = constant(2.0, 's',
        'longest time between two poses of the vessel that is interpolated; relative fixes in a '
        'longer gap are left out and counted', range=(0.01, 600.0))
    vessel_max_extrapolation: float = constant(0.0, 's',
        'time by which a relative fix may be newer than the newest pose of the vessel; later '
        'ones wait for the next pose', range=(0.0, 60.0))
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check() + self._place_problems() + self._sensor_problems()
        if not self.covariance_scales:
            problems.append('covariance_scales needs one value at least')
        off = 'receiver_position_std', 'receiver_clock_std', 'sound_speed_std'
        stated = [name for name in (*off, 'bearing_bias_std_deg') if getattr(self, name)]
        if self.systematic_errors == 'exact' and stated:
            problems.append(f'systematic_errors is exact, but {stated[0]} is not 0')
        if self.confirm_hits > self.confirm_window:
            problems.append(
                f'confirm_hits ({self.confirm_hits}) cannot exceed confirm_window '
                f'({self.confirm_window})'
            )
        if self.depth_min > self.depth_max:
            problems.append(
                f'depth_min ({self.depth_min:g}) cannot exceed depth_max ({self.depth_max:g})'
            )
        models = self.model_count()
        noises = len(self.acceleration_noise)
        if self.model_set == 'families' and noises not in (0, 3):
            problems.append(
                'acceleration_noise of families needs three values, of lively_calm, lively_sharp '
                f'and quiet, got {noises}'
            )
        problems += chain_problems(
            self.transition_matrix, self.initial_probabilities, models, self.model_set
        )
        return problems

    def for_target(self) -> DiverConfig:
        """These parameters with those of the kind of target where they are at their defaults."""
        if self.model_set != 'families':
            return self
        defaults = {field.name: field.default for field in fields(type(self))}
        own = {
            name: value
            for name, value in TARGETS[self.target].items()
            if getattr(self, name) == defaults[name]
        }
        return evolve(self, **own) if own else self

    def _place_problems(self) -> list[str]:
        return [
            f'{name} needs three values, got {len(getattr(self, name))}'
            for name in ('transceiver_lever', 'transceiver_mount_rpy_deg')
            if len(getattr(self, name)) != 3
        ]

    def _sensor_problems(self) -> list[str]:
        problems = []
        for name, sector in [('coverage_sector', self.coverage_sector), *self.own]:
            if not name.endswith('coverage_sector') or not sector:
                continue
            if len(sector) != SECTOR:
                problems.append(f'{name} needs {SECTOR} values, got {len(sector)}')
                continue
            width, least, greatest = sector[3:]
            if not 0.0 < width <= 360.0:
                problems.append(f'{name}: a width of {width:g} is not between 0 and 360')
            if not 0.0 <= least < greatest:
                problems.append(f'{name}: a range from {least:g} to {greatest:g} holds nothing')
        for name in ('tags', 'sensors'):
            if bad := [word for word in getattr(self, name) if not _WORD.fullmatch(word)]:
                problems.append(
                    f"{name}: '{bad[0]}' cannot be part of a topic; letters, digits and _ can"
                )
        return problems

    @property
    def fixes_are_scans(self) -> bool:
        """Whether a diver without a fix among those of a stamp was missed."""
        return self.scan_period >= 0.0

    @property
    def map_frame(self) -> str:
        """The frame of positions that come as latitude and longitude."""
        return self.frame_id or 'map'

    @classmethod
    def specs_with(cls, values: Mapping[str, Any]) -> tuple[ParameterSpec, ...]:
        """`specs`, and those of `OF_SENSOR` that `values` state of one of its `sensors`."""
        found = {spec.name: spec for spec in cls.specs()}
        sensors = values.get('sensors', ())
        names = [
            f'{sensor}.{name}'
            for sensor in (sensors if isinstance(sensors, (list, tuple)) else ())
            for name in OF_SENSOR
        ]
        own = [
            evolve(found[name.rpartition('.')[2]], name=name) for name in names if name in values
        ]
        return (*found.values(), *own)

    @classmethod
    def attributes(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        own = {spec.name: spec for spec in cls.specs_with(values) if '.' in spec.name}
        plain = {name: value for name, value in values.items() if name not in own}
        return plain | {
            'own': tuple((name, spec.convert(values[name])) for name, spec in own.items())
        }

    def as_dict(self) -> dict[str, Any]:
        stated = {name: list(v) if isinstance(v, tuple) else v for name, v in self.own}
        return super().as_dict() | stated

    def require_changeable(self, other: Config) -> None:
        super().require_changeable(other)
        for sensor in self.sensors:
            of_other = cast(DiverConfig, other).of_sensor(sensor)
            super(DiverConfig, self.of_sensor(sensor)).require_changeable(of_other)

    def of_sensor(self, sensor: str) -> DiverConfig:
        """These parameters with those of a sensor in place."""
        own = {
            name.rpartition('.')[2]: value
            for name, value in self.own
            if name.rpartition('.')[0] == sensor
        }
        return evolve(self, **own) if own else self

    @property
    def pairing(self) -> str:
        """One of `ASSOCIATIONS`. Weighing asks for the density of a fix, also where a diver does
        what is rare: `families` have that, of the other sets a sharp turn looks like clutter."""
        if self.association != 'auto':
            return self.association
        return 'jipda' if self.model_set == 'families' else 'gnn'

    @property
    def velocity_std_at_fix(self) -> float:
        """`velocity_std` of a track that begins at a fix, in m/s. Positions from arrival times
        have ghosts, which a wide one would let move."""
        usual = fields(type(self)).velocity_std.default
        anything = self.model_set == 'families' and self.target == 'diver'
        return AFLOAT if anything and self.velocity_std == usual else self.velocity_std

    @property
    def has_usual_fix_std(self) -> bool:
        """Whether `fix_std` is its default."""
        return bool(self.fix_std == fields(type(self)).fix_std.default)

    @property
    def usual_clutter(self) -> float:
        """The density of false fixes where none is learnt."""
        return self.clutter_density or CLUTTER

    def model_count(self) -> int:
        """Number of models in the set these parameters describe."""
        if self.model_set not in MODEL_SETS:
            return len(diver_models(self.model_set, self).joint.names)
        count = self.directions + int(self.hover)
        return 2 * count + 3 if self.model_set == 'families' else count
