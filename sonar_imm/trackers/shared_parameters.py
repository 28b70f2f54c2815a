# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Parameters that several trackers have, with the rules across them.

What may change while a tracker runs is the same in all systems: how a measurement is judged (its
error where it states none, gate, detection, clutter, the age to which a companion counts), how
tracks begin and end, and what is reported. What shapes the state or its history needs a new
tracker: models and their chains, geometry of the sonar, particles, time, seed. Pings of the
bathymetry tracker share no state, so that everything may change there.
"""

from __future__ import annotations

from attrs import frozen

from ..acoustics.geodesy import Origin
from ..parameters import Config, constant, live, parameter


@frozen(kw_only=True, slots=False)
class DetectionParameters(Config):
    """Which measurements may belong to a target, and how probable a detection is."""

    # fmt: off
    gate_probability: float = live(0.999, '',
        'chi-square probability inside which a measurement may belong to a track',
        range=(0.5, 0.9999999))
    detection_probability: float = live(0.9, '',
        'probability that a scan or ping shows a target that it covers', range=(0.01, 0.9999))
    clutter_density: float = live(1e-6, '1/m^2',
        'number of false fixes expected in a scan, per square metre', range=(1e-12, 1e4))
    # fmt: on


@frozen(kw_only=True, slots=False)
class MountingParameters(Config):
    """Where the place of the sonar on its vehicle is taken from."""

    # fmt: off
    vehicle_frame: str = parameter('', '',
        'frame of the poses of nav, e.g. base_link; together with sonar_frame')
    sonar_frame: str = parameter('', '',
        'frame of the sonar (x forward, y port, z up): with vehicle_frame, /tf_static gives '
        'sonar_lever and sonar_mount_rpy_deg, and earlier pings are refused. Empty: as those two '
        'parameters say')
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check()
        if bool(self.vehicle_frame) != bool(self.sonar_frame):
            problems.append('vehicle_frame and sonar_frame need each other')
        return problems


@frozen(kw_only=True, slots=False)
class OriginParameters(Config):
    """Where the origin of the frame of the tracks lies on Earth."""

    # fmt: off
    origin: tuple[float, ...] = parameter((0.0, 0.0, 0.0), 'deg, deg, m',
        'latitude, longitude and height above the ellipsoid of the origin of the tracks; both 0: '
        'unknown')
    # fmt: on

    def check(self) -> list[str]:
        problems = super().check()
        if len(self.origin) != 3:
            problems.append(f'origin needs three values, got {len(self.origin)}')
        for value, what, most in zip(
            self.origin, ('latitude', 'longitude', 'height'), (90.0, 360.0, 12000.0)
        ):
            if abs(value) > most:
                problems.append(
                    f'origin: {what} must be between {-most:g} and {most:g}, got {value:g}'
                )
        return problems

    def stated_origin(self) -> Origin | None:
        """Return the origin that is stated, None for none."""
        return Origin(*self.origin) if any(self.origin[:2]) else None


@frozen(kw_only=True, slots=False)
class TrackLifeParameters(Config):
    """When tracks begin, are confirmed and end."""

    # fmt: off
    max_tracks: int = live(20, '', 'largest number of targets tracked at once', range=(1, 2000))
    confirm_hits: int = live(3, '', 'number of hits that confirm a track', range=(1, 100))
    max_coast: float = live(60.0, 's', 'time without a hit that ends any track', range=(0.01, 1e6))
    # fmt: on


@frozen(kw_only=True, slots=False)
class StampParameters(Config):
    """Which stamps are believed."""

    # fmt: off
    max_gap: float = constant(3600.0, 's',
        'a stamp further ahead of the last one than this is not trusted until the following '
        'stamps agree with it', range=(1.0, 1e8))
    restart_after: int = constant(5, '',
        'number of consecutive agreeing stamps that count as a restarted clock: further ahead '
        'than max_gap, more than five minutes late, or a repeated beginning; 20 times as many '
        'where late messages may be the reason', range=(2, 1000))
    # fmt: on


@frozen(kw_only=True, slots=False)
class StreamParameters(StampParameters):
    """Which stamps are believed, and how long late measurements are put in their place."""

    # fmt: off
    history: float = parameter(10.0, 's',
        'how late a measurement may arrive and still be inserted at its stamp',
        range=(0.0, 3600.0))
    # fmt: on
