# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an instrument was: positions by satellite in a recording, at the stamps of estimates.

They are the messages ``sensor_msgs/NavSatFix`` of the topic ``position``, or of the only topic of
that type. Between two of them the place is interpolated; a stamp further than `GAP_S` from both
has none.

Without them the topic ``nav`` (nav_msgs/Odometry, ENU metres) tells places, once it is said where
its origin lies.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import FloatArray, IntArray

from .messages import ros_message
from .reader import BagReader
from .sources import BagError

TYPE, TOPIC = 'sensor_msgs/msg/NavSatFix', 'position'
NAV_TYPE, NAV_TOPIC = 'nav_msgs/msg/Odometry', 'nav'
GAP_S = 30.0
_NO_FIX = -1


@frozen(eq=False)
class Positions:
    """Fixes of one instrument by time: stamp_ns (n,) increasing, longitude and latitude (n,) in
    degrees."""

    stamp_ns: IntArray
    longitude: FloatArray
    latitude: FloatArray

    def at(self, stamp_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Longitude and latitude (k,) at stamp_ns (k,), NaN where there is no fix near."""
        seconds = 1e-9 * (self.stamp_ns - self.stamp_ns[0])
        when = 1e-9 * (stamp_ns - self.stamp_ns[0])
        after = np.clip(np.searchsorted(seconds, when), 0, len(seconds) - 1)
        before = np.maximum(after - 1, 0)
        away = np.minimum(np.abs(seconds[after] - when), np.abs(seconds[before] - when))
        # Across the date line the longitude goes on.
        turned = np.unwrap(self.longitude, period=360.0)
        east = (np.interp(when, seconds, turned) + 180.0) % 360.0 - 180.0
        north = np.interp(when, seconds, self.latitude)
        near = away <= GAP_S
        return np.where(near, east, np.nan), np.where(near, north, np.nan)


def read_positions(bag: BagReader) -> Positions | None:
    """The positions in an open recording, None when there are none. Raises `BagError` when several
    topics have some."""
    topics = [topic.name for topic in bag.topics if topic.type_name == TYPE]

    def fix(message: Any) -> tuple[float, float] | None:
        place = float(message.longitude), float(message.latitude)
        good = abs(place[0]) <= 360.0 and abs(place[1]) <= 90.0
        return place if good and message.status.status != _NO_FIX else None

    found = _read(bag, _named(topics, TOPIC) or topics, fix)
    return None if found is None else Positions(found[0], *found[1].T)


def navigation_topics(bag: BagReader) -> list[str]:
    """The topics of a recording that navigation comes on."""
    return _named([topic.name for topic in bag.topics if topic.type_name == NAV_TYPE], NAV_TOPIC)


def read_navigated(
    bag: BagReader, degrees: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> Positions | None:
    """The positions by the navigation of an open recording, None when there is none. degrees:
    gives longitude and latitude (n,) of places (n, 2) east and north, m. Raises `BagError` when
    several topics have some."""

    def place(message: Any) -> tuple[float, float]:
        position = message.pose.pose.position
        return float(position.x), float(position.y)

    found = _read(bag, navigation_topics(bag), place)
    return None if found is None else Positions(found[0], *degrees(found[1]))


def _named(topics: list[str], name: str) -> list[str]:
    return [topic for topic in topics if f'/{topic}'.endswith(f'/{name}')]


def _read(
    bag: BagReader, topics: list[str], place: Callable[[Any], tuple[float, float] | None]
) -> tuple[IntArray, FloatArray] | None:
    """Stamps (n,) and places (n, 2) of the messages of one topic, by time; what is not finite and
    what `place` gives None for is left out."""
    if len(topics) > 1:
        raise BagError(f'several topics have positions: {", ".join(topics)}')
    rows = {}
    for item in bag.messages(topics) if topics else ():
        here, stamp = place(item.message), item.message.header.stamp
        if here is not None and np.isfinite(here).all():
            rows[stamp.sec * 10**9 + stamp.nanosec] = here
    if not rows:
        return None
    stamps = sorted(rows)
    return np.array(stamps, np.int64), np.array([rows[stamp] for stamp in stamps])


def write_position(stamp_ns: int, longitude: float, latitude: float) -> Any:
    """A fix as a message; its height is not known."""
    seconds, rest = divmod(stamp_ns, 10**9)
    stamp = ros_message('builtin_interfaces/msg/Time', sec=seconds, nanosec=rest)
    header = ros_message('std_msgs/msg/Header', stamp=stamp, frame_id='wgs84')
    return ros_message(
        TYPE, header=header, longitude=longitude, latitude=latitude, altitude=float('nan')
    )
