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

"""Parameters that several trackers have, with the rules across them.

What may change while a tracker runs is the same in all systems: how a measurement is judged (its
error where it states none, gate, detection, clutter, the age to which a companion counts), how
tracks begin and end, and what is reported. What shapes the state or its history needs a new
tracker: models and their chains, geometry of the sonar, particles, time, seed. Pings of the
bathymetry tracker share no state, so that everything may change there.
"""

from __future__ import annotations

from attrs import frozen

from ..parameters import Config, parameter


@frozen(kw_only=True, slots=False)
class DetectionParameters(Config):
    """Which measurements may belong to a target, and how probable a detection is."""

    gate_probability: float = parameter(
        0.999,
        'chi-square probability inside which a measurement may belong to a track',
        low=0.5,
        high=0.9999999,
        read_only=False,
    )
    detection_probability: float = parameter(
        0.9,
        'probability that a scan or ping shows a target that it covers',
        low=0.01,
        high=0.9999,
        read_only=False,
    )
    clutter_density: float = parameter(
        1e-6,
        'false fixes expected in a scan, for each square metre',
        unit='1/m^2',
        low=1e-12,
        high=1e4,
        read_only=False,
    )


@frozen(kw_only=True, slots=False)
class MountingParameters(Config):
    """Where the place of the sonar on its vehicle is taken from."""

    vehicle_frame: str = parameter(
        '', 'with sonar_frame: the frame in which the poses of nav are, e.g. base_link'
    )
    sonar_frame: str = parameter(
        '',
        'the frame of the sonar (x forward, y port, z up); with it and vehicle_frame /tf_static '
        'says sonar_lever and sonar_mount_rpy_deg, and pings before it does are refused; empty: '
        'the parameters say it',
    )

    def check(self) -> list[str]:
        problems = super().check()
        if bool(self.vehicle_frame) != bool(self.sonar_frame):
            problems.append('vehicle_frame and sonar_frame need each other')
        return problems


@frozen(kw_only=True, slots=False)
class TrackLifeParameters(Config):
    """When tracks begin, are confirmed and end."""

    max_tracks: int = parameter(20, 'most targets at once', low=1, high=2000, read_only=False)
    confirm_hits: int = parameter(
        3, 'hits within confirm_window that confirm a track', low=1, high=100, read_only=False
    )
    confirm_window: int = parameter(
        5, 'scans or pings looked at for confirmation', low=1, high=100, read_only=False
    )
    delete_misses: int = parameter(
        5,
        'consecutive scans or pings that cover a confirmed target without a hit and so end its '
        'track',
        low=1,
        high=10000,
        read_only=False,
    )
    max_coast: float = parameter(
        60.0,
        'time without a hit that ends any track',
        unit='s',
        low=0.01,
        high=1e6,
        read_only=False,
    )

    def check(self) -> list[str]:
        problems = super().check()
        if self.confirm_hits > self.confirm_window:
            problems.append(
                f'confirm_hits ({self.confirm_hits}) cannot exceed confirm_window '
                f'({self.confirm_window})'
            )
        return problems


@frozen(kw_only=True, slots=False)
class StampParameters(Config):
    """Which stamps are believed."""

    max_gap: float = parameter(
        3600.0,
        'a stamp further ahead than this is doubted until the following ones agree',
        unit='s',
        low=1.0,
        high=1e8,
    )
    restart_after: int = parameter(
        5,
        'consecutive agreeing stamps that count as a restarted clock: further ahead than max_gap, '
        'more than five minutes late, or a repeated beginning; 20 times as many where it may be a '
        'burst of late messages',
        low=2,
        high=1000,
    )


@frozen(kw_only=True, slots=False)
class StreamParameters(StampParameters):
    """Which stamps are believed, and how long late measurements are put in their place."""

    history: float = parameter(
        10.0,
        'how late a measurement may be and still be used, in its right place',
        unit='s',
        low=0.0,
        high=3600.0,
    )
