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

"""What nodes of tracks send to others: messages of other packages, and targets for a plotter.

Both are off by default. `also_publish` names message types (`msg_adapters.neighbours`), which have
to be installed. `targets_to` is the address to which the confirmed tracks go as sentences of NMEA
0183 over UDP, one per datagram:

- ``TLL``: latitude and longitude, where it is known where the frame of the tracks lies on Earth;
- ``TTM``: distance over ground in nautical miles and bearing in degrees clockwise from the bow,
  with speed, course, and distance and time of the closest approach;
- AIS message 21 in ``AIVDM``, encoded by pyais: a virtual aid to navigation at that latitude and
  longitude. Not a position report of a vessel: a plotter would draw a ship and offer to call it.

They go out at most every `targets_period` seconds; a track that is over is sent once more as lost,
for which AIS has no word: there the plotter drops it as old.
A network that refuses does not stop the node: it is said once, and in /diagnostics.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
import math
import operator
import socket
import time
from typing import Any
import zlib

import numpy as np

from msg_adapters.displays.tracks import confirmed_rows
from msg_adapters.neighbours import motion_of, Neighbours

from ..acoustics.geodesy import Origin
from ..estimates import Estimate
from ..node_config import udp_address
from ..parameters import ConfigError
from .base import TrackerNode
from .messages import message_class
from .outputs import DisplayPublisher

MILE, KNOT = 1852.0, 1852.0 / 3600.0
"""Metres, and metres per second."""
ISOLATED_DANGER, SPECIAL_MARK = 28, 30
"""Kinds of aids to navigation of AIS message 21."""
ACCURATE = 10.0
"""An AIS position is accurate when it is better than this, m."""


class TracksNode(TrackerNode):
    """A node of targets that have a place, as divers and obstacles do."""

    def prepare(self) -> None:
        """Offer the messages of other packages too. Raises `ConfigError` for one that is not
        installed."""
        types = self._node_config.also_publish
        for type_name in types:
            try:
                message_class(type_name)
            except ImportError as error:
                raise ConfigError(f"parameter 'also_publish': {error}") from None
        super().prepare()
        neighbours = Neighbours(self._name, types, self.origin)
        self._neighbours = DisplayPublisher(neighbours, self.advertise)
        self._targets = Targets(
            self._node_config.targets_to,
            self._node_config.targets_as,
            self._node_config.targets_period,
            self._name.upper(),
            self.get_logger().warning,
            sender=self._full_name,
        )

    def release(self) -> None:
        super().release()
        self._targets.close()

    def origin(self) -> Origin | None:
        """Where the frame of the tracks lies on Earth, None where that is not known."""
        raise NotImplementedError

    def show(self, estimates: list[Estimate]) -> None:
        super().show(estimates)
        self._neighbours.publish(estimates[-1])
        self._targets.send(estimates[-1], self.origin())

    def start_afresh(self) -> None:
        super().start_afresh()
        self._targets.forget()

    def work_report(self) -> dict[str, Any]:
        report = super().work_report()
        report['warnings'] += filter(None, [self._targets.trouble])
        return report


class Targets:
    """Sends tracks as targets to one address, ``''``: does nothing.

    form: ``'tll'``, ``'ttm'`` or ``'ais'``; period: least time between two rounds, s; name: what a
    target is called before its number; warn: is told once why targets cannot be sent; sender: the
    node, whose identities of AIS differ. Raises `ConfigError` where ``'ais'`` is wanted without
    pyais.
    """

    def __init__(
        self,
        address: str,
        form: str,
        period: float,
        name: str,
        warn: Callable[[str], Any],
        sender: str = '',
    ):
        self._address, self._warn, self._period = address, warn, period
        self._form, self._name = form, name
        # 99MID6xxx is a virtual aid to navigation; below 200 MID is the code of no country.
        self._identity = 990_006_000 + zlib.crc32(sender.encode()) % 200 * 10_000
        if address and form == 'ais':
            self._encode = _ais_encoder()
        self._next_round = -math.inf
        self._socket: socket.socket | None = None
        self._shown: dict[int, str] = {}
        self._warned = False
        self.trouble = ''

    def send(self, estimate: Estimate, origin: Origin | None) -> None:
        """Send the confirmed tracks, and those that ended since the last round as lost."""
        now = time.monotonic()
        if not self._address or now < self._next_round:
            return
        self._next_round = now + self._period
        sentences, shown = [], {}
        for row in confirmed_rows(estimate):
            if self._form == 'ttm':
                fields = self._ttm(estimate, row)
            elif origin is None or not np.isfinite(motion_of(estimate, row).place).all():
                continue
            elif self._form == 'ais':
                sentences.append(self._ais(estimate, row, origin))
                continue
            else:
                fields = self._tll(estimate, row, origin)
            if fields is not None:
                sentences.append(_sentence(fields))
                shown[int(estimate.extras['track_id'][row])] = self._lost(fields)
        ended = [lost for each, lost in self._shown.items() if each not in shown]
        self._shown = shown
        self._send([*sentences, *ended])

    def forget(self) -> None:
        """Send all as lost."""
        self._send([*self._shown.values()])
        self._shown = {}

    def close(self) -> None:
        """Send no more."""
        self.forget()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, sentences: list[str]) -> None:
        for sentence in sentences:
            try:
                if self._socket is None:
                    self._socket = _connected(self._address)
                self._socket.send(f'{sentence}\r\n'.encode('ascii'))
                self.trouble = ''
            except OSError as error:
                self.trouble = (
                    f'targets cannot be sent to {self._address}: {error.strerror}; it is tried '
                    'again with the next ones'
                )
                if not self._warned:
                    self._warn(f'{self.trouble} (said once)')
                self._warned = True
                return

    def _lost(self, fields: list[str]) -> str:
        fields = list(fields)
        fields[fields.index('T', len(fields) - 4)] = 'L'
        return _sentence(fields)

    def _ais(self, estimate: Estimate, row: int, origin: Origin) -> str:
        motion = motion_of(estimate, row)
        latitude, longitude, _ = (float(value) for value in origin.geodetic(motion.place))
        track_id = int(estimate.extras['track_id'][row])
        error = float(np.linalg.eigvalsh(motion.covariance[:2, :2])[-1])
        (sentence,) = self._encode(
            {
                'type': 21,
                'mmsi': self._identity + track_id % 1000,
                'aid_type': SPECIAL_MARK if self._name == 'DIVER' else ISOLATED_DANGER,
                'name': f'{self._name}{track_id}',
                'accuracy': 4.0 * error < ACCURATE**2,  # of two standard deviations
                'lat': latitude,
                'lon': longitude,
                'second': estimate.stamp_ns // 10**9 % 60,
                'virtual_aid': 1,
            }
        )
        return sentence

    def _tll(self, estimate: Estimate, row: int, origin: Origin) -> list[str]:
        place = motion_of(estimate, row).place
        latitude, longitude, _ = (float(value) for value in origin.geodetic(place))
        number, name = self._called(estimate, row)
        at = (*_degrees(latitude, 2, 'NS'), *_degrees(longitude, 3, 'EW'))
        return ['RATLL', number, *at, name, _clock(estimate.stamp_ns), 'T', '']

    def _ttm(self, estimate: Estimate, row: int) -> list[str] | None:
        distance, bearing, offset = (float(value) for value in estimate.state[row, :3])
        if not (math.isfinite(distance) and math.isfinite(bearing)):
            return None
        if math.isfinite(offset):
            distance = math.sqrt(max(distance**2 - offset**2, 0.0))
        speed = course = ''
        velocity = motion_of(estimate, row).velocity
        if velocity is not None:
            speed = f'{math.hypot(velocity[0], velocity[1]) / KNOT:.1f}'
            course = _angle(math.degrees(math.atan2(velocity[0], velocity[1])))
        number, name = self._called(estimate, row)
        # To port is positive here, clockwise there.
        at = (f'{distance / MILE:.4f}', _angle(-math.degrees(bearing)), 'R')
        nearest = _column(estimate, 'cpa_distance', row, MILE, 4)
        soon = _column(estimate, 'cpa_time', row, 60.0, 1)
        moves = (speed, course, 'T', nearest, soon, 'N')
        return ['RATTM', number, *at, *moves, name, 'T', '', _clock(estimate.stamp_ns), 'A']

    def _called(self, estimate: Estimate, row: int) -> tuple[str, str]:
        """Number of two digits and name of a target."""
        track_id = int(estimate.extras['track_id'][row])
        return f'{track_id % 100:02d}', f'{self._name}{track_id}'


def _ais_encoder() -> Callable[[dict[str, Any]], list[str]]:
    try:
        from pyais import encode_dict
    except ImportError:
        raise ConfigError(
            "parameter 'targets_as': ais needs pyais: pip install 'sonar_imm[nmea]'"
        ) from None
    return partial(encode_dict, talker_id='AI', sentence_type='VDM')


def _connected(address: str) -> socket.socket:
    host, port, family = udp_address(address)
    made = socket.socket(family, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        made.connect((host, port))
    except OSError:
        made.close()
        raise
    return made


def _sentence(fields: list[str]) -> str:
    body = ','.join(fields)
    return f'${body}*{reduce(operator.xor, body.encode("ascii")):02X}'


def _degrees(value: float, digits: int, sides: str) -> tuple[str, str]:
    """Degrees and minutes, and the hemisphere."""
    # Rounded before it is split, so that no minute is 60.
    degrees, minutes = divmod(round(abs(value) * 60.0, 5), 60.0)
    return f'{int(degrees):0{digits}d}{minutes:08.5f}', sides[value < 0.0]


def _angle(degrees: float) -> str:
    """Clockwise, 0 to 359.9."""
    return f'{round(degrees, 1) % 360.0:.1f}'


def _clock(stamp_ns: int) -> str:
    """The time of day, UTC."""
    hundredths = stamp_ns // 10**7 % 8_640_000
    minutes, rest = divmod(hundredths, 6000)
    return f'{minutes // 60:02d}{minutes % 60:02d}{rest / 100.0:05.2f}'


def _column(estimate: Estimate, name: str, row: int, unit: float, digits: int) -> str:
    """A column as text, empty where it is not known."""
    value = float(estimate.extras[name][row]) if name in estimate.extras else math.nan
    return f'{value / unit:.{digits}f}' if math.isfinite(value) else ''
