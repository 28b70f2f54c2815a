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

"""Tracks in messages of other packages, made where those are installed and asked for.

- ``marine_interfaces/Contact`` (and ContactArray) of unh_marine_autonomy: place and velocity in
  the frame of the estimate with covariances, a covariance that begins with -1 where there is no
  velocity; ``geo_pose`` where it is known where the frame lies on Earth, else its latitude is NaN.
  All is proposed by a machine: ``ORIGIN_AUTO``, ``STATUS_PROPOSED``.
- ``vision_msgs/Detection3DArray``: place with covariance; the box has no size, which is not
  estimated.
- ``geographic_msgs/GeoPoseStamped``: latitude, longitude in degrees, height above the ellipsoid in
  metres, NaN where it is not estimated; a quaternion of zeros: the orientation is not known. The
  message has no covariance. ``header.frame_id`` says whose it is: ``diver_3``.

Variances of what is not estimated are `UNKNOWN_VARIANCE`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate, PLACES

from .displays.tracks import confirmed_rows, Drawn
from .fixes import UNKNOWN_VARIANCE
from .headers import Make, make_header, make_pose, make_stated_pose, make_stated_twist, make_vector

CONTACT = 'marine_interfaces/msg/Contact'
CONTACTS = 'marine_interfaces/msg/ContactArray'
DETECTIONS = 'vision_msgs/msg/Detection3DArray'
GEO_POSE = 'geographic_msgs/msg/GeoPoseStamped'
TOPICS = {CONTACT: 'contact', CONTACTS: 'contacts', DETECTIONS: 'tracks_3d', GEO_POSE: 'geo_pose'}
"""Topics, without ``~/``, by the types that can be asked for."""
_ATTRIBUTES = ('above', 'collision_probability', 'cpa_distance', 'cpa_time', 'target_id')
"""Columns that a Contact has among its attributes, where the estimate has them."""
_NO_TURN = (0.0, 0.0, 0.0, 0.0)


class Motion(NamedTuple):
    """Where one target is and how it moves, in the frame of the estimate. velocity: None where
    it is not estimated. A covariance is (3, 3)."""

    place: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray | None
    velocity_covariance: np.ndarray

    @property
    def has_height(self) -> bool:
        """Whether z is estimated."""
        return bool(self.covariance[2, 2] < UNKNOWN_VARIANCE)


def motion_of(estimate: Estimate, row: int) -> Motion:
    """Where one diver or obstacle is and how it moves."""
    extras = estimate.extras
    covariance, velocity_covariance = (np.eye(3) * UNKNOWN_VARIANCE for _ in range(2))
    place, velocity = np.array(estimate.xyz[row], np.float64), np.zeros(3)
    if 'px' in estimate.state_names:
        axes = 'xyz' if 'pz' in estimate.state_names else 'xy'
        at, moving = ([estimate.state_names.index(k + axis) for axis in axes] for k in 'pv')
        n = len(axes)
        place[:n], velocity[:n] = estimate.state[row, at], estimate.state[row, moving]
        covariance[:n, :n] = estimate.covariance[row][np.ix_(at, at)]
        velocity_covariance[:n, :n] = estimate.covariance[row][np.ix_(moving, moving)]
    else:
        place = np.array([extras[name][row] for name in PLACES], np.float64)
        _fill(covariance, 'place_cov', 'xyz', extras, row)
        velocity[:2] = [extras[name][row] if name in extras else np.nan for name in ('vx', 'vy')]
        _fill(velocity_covariance, 'vel_cov', 'xy', extras, row)
    if not np.isfinite(place[2]):
        place[2], covariance[2], covariance[:, 2] = 0.0, 0.0, 0.0
        covariance[2, 2] = UNKNOWN_VARIANCE
    moves = velocity if np.isfinite(velocity).all() else None
    return Motion(place, covariance, moves, velocity_covariance)


class Neighbours:
    """What the tracks of one system are in messages of other packages; as `displays.Displays`.

    types: those of `TOPICS` that are asked for; origin: where the frame of the tracks lies on
    Earth, None where that is not known (yet).
    """

    def __init__(self, system: str, types: tuple[str, ...], origin: Callable[[], Origin | None]):
        self.topics: Mapping[str, str] = {TOPICS[name]: name for name in types}
        self._system, self._origin = system, origin

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        """The confirmed tracks, those without a place left out."""
        wanted = {type_name for topic, type_name in self.topics.items() if is_wanted(topic)}
        if not wanted:
            return
        rows = [(int(row), motion_of(estimate, row)) for row in confirmed_rows(estimate)]
        rows = [(row, motion) for row, motion in rows if np.isfinite(motion.place).all()]
        header = make_header(estimate.stamp_ns, estimate.frame_id, make)
        if wanted & {CONTACT, CONTACTS}:
            contacts = [self._contact(estimate, row, motion, make) for row, motion in rows]
            if CONTACT in wanted:
                yield from ((TOPICS[CONTACT], contact) for contact in contacts)
            if CONTACTS in wanted:
                yield TOPICS[CONTACTS], make(CONTACTS, header=header, contacts=contacts)
        if DETECTIONS in wanted:
            found = [self._detection(estimate, row, motion, make) for row, motion in rows]
            yield TOPICS[DETECTIONS], make(DETECTIONS, header=header, detections=found)
        origin = self._origin()
        if GEO_POSE in wanted and origin is not None:
            for row, motion in rows:
                whose = make_header(estimate.stamp_ns, self._id(estimate, row), make)
                pose = _geo_pose(origin, motion, make)
                yield TOPICS[GEO_POSE], make(GEO_POSE, header=whose, pose=pose)

    def forget(self, make: Make) -> Drawn:
        return iter(())

    def _id(self, estimate: Estimate, row: int) -> str:
        return f'{self._system}_{int(estimate.extras["track_id"][row])}'

    def _contact(self, estimate: Estimate, row: int, motion: Motion, make: Make) -> Any:
        columns = {**_above(estimate), **estimate.extras}
        shown = {name: columns[name][row] for name in _ATTRIBUTES if name in columns}
        classification = make(
            'marine_interfaces/msg/Classification', class_id=self._system, probability=1.0
        )
        kinematics = make(
            'marine_interfaces/msg/Kinematics',
            pose=_pose(motion, make),
            orientation_availability=0,
            twist=_twist(motion, make),
        )
        return make(
            CONTACT,
            header=make_header(estimate.stamp_ns, estimate.frame_id, make),
            id=self._id(estimate, row),
            existence_probability=_existence(estimate, row),
            classification=[classification],
            kinematics=kinematics,
            shape=make(
                'marine_interfaces/msg/Shape',
                type=0,
                footprint=make('geometry_msgs/msg/Polygon', points=[]),
                dimensions=make_vector((0.0, 0.0, 0.0), make),
            ),
            geo_pose=_geo_pose(self._origin(), motion, make),
            source=f'sonar_imm.{self._system}',
            origin_kind=0,
            status=0,
            note='',
            observation_ids=[],
            attributes=[
                make('diagnostic_msgs/msg/KeyValue', key=name, value=f'{value:g}')
                for name, value in shown.items()
                if np.isfinite(value)
            ],
        )

    def _detection(self, estimate: Estimate, row: int, motion: Motion, make: Make) -> Any:
        hypothesis = make(
            'vision_msgs/msg/ObjectHypothesis',
            class_id=self._system,
            score=_existence(estimate, row),
        )
        pose = _pose(motion, make)
        result = make('vision_msgs/msg/ObjectHypothesisWithPose', hypothesis=hypothesis, pose=pose)
        return make(
            'vision_msgs/msg/Detection3D',
            header=make_header(estimate.stamp_ns, estimate.frame_id, make),
            results=[result],
            bbox=make(
                'vision_msgs/msg/BoundingBox3D',
                center=make_pose(motion.place, make),
                size=make_vector((0.0, 0.0, 0.0), make),
            ),
            id=self._id(estimate, row),
        )


def _fill(
    covariance: np.ndarray, name: str, axes: str, extras: Mapping[str, np.ndarray], row: int
) -> None:
    """Put the columns ``<name>_<a>_<b>`` of one row in, where they are finite."""
    for i, a in enumerate(axes):
        for j, b in enumerate(axes[i:], start=i):
            column = extras.get(f'{name}_{a}_{b}')
            if column is not None and np.isfinite(column[row]):
                covariance[i, j] = covariance[j, i] = column[row]


def _existence(estimate: Estimate, row: int) -> float:
    """That a track exists; one whose hits are counted does, once it is confirmed."""
    value = float(estimate.extras['existence'][row]) if 'existence' in estimate.extras else 1.0
    return value if np.isfinite(value) else 1.0


def _above(estimate: Estimate) -> dict[str, np.ndarray]:
    """The probability that an obstacle is above, a column as the others."""
    if 'above' not in estimate.model_names:
        return {}
    return {'above': estimate.probabilities[:, estimate.model_names.index('above')]}


def _pose(motion: Motion, make: Make) -> Any:
    return make_stated_pose(motion.place, _six(motion.covariance), make)


def _twist(motion: Motion, make: Make) -> Any:
    covariance = _six(motion.velocity_covariance)
    if motion.velocity is None:
        covariance[0, 0] = -1.0
    return make_stated_twist(
        (0.0,) * 3 if motion.velocity is None else motion.velocity, covariance, make
    )


def _geo_pose(origin: Origin | None, motion: Motion, make: Make) -> Any:
    latitude = longitude = altitude = np.nan
    if origin is not None:
        latitude, longitude, altitude = origin.geodetic(motion.place)
    return make(
        'geographic_msgs/msg/GeoPose',
        position=make(
            'geographic_msgs/msg/GeoPoint',
            latitude=latitude,
            longitude=longitude,
            altitude=altitude if motion.has_height else np.nan,
        ),
        orientation=make_vector(_NO_TURN, make, 'Quaternion'),
    )


def _six(block: np.ndarray) -> np.ndarray:
    """A covariance (3, 3) in the (6, 6) of ROS; the rest is not estimated."""
    covariance = np.eye(6) * UNKNOWN_VARIANCE
    covariance[:3, :3] = block
    return covariance
