# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Latitude and longitude against the closed form of the ellipsoid, written out here."""

import math

import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin

A, F = 6378137.0, 1.0 / 298.257223563
E2 = F * (2.0 - F)


def earth(latitude, longitude, height):
    """Earth-centred metres: the textbook formula."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    N = A / math.sqrt(1.0 - E2 * math.sin(phi) ** 2)
    return np.array(
        [
            (N + height) * math.cos(phi) * math.cos(lam),
            (N + height) * math.cos(phi) * math.sin(lam),
            (N * (1.0 - E2) + height) * math.sin(phi),
        ]
    )


def numeric_axes(latitude, longitude, height=0.0, step=1e-4):
    """East, north, up (3, 3) as columns, by differences of the formula above."""
    there = earth(latitude, longitude, height)
    columns = [
        earth(latitude, longitude + step, height) - earth(latitude, longitude - step, height),
        earth(latitude + step, longitude, height) - earth(latitude - step, longitude, height),
        earth(latitude, longitude, height + 1.0) - there,
    ]
    return np.array([column / np.linalg.norm(column) for column in columns]).T


PLACES = [(59.1, 10.2, 0.0), (-33.9, 151.2, 20.0), (0.001, -179.9999, -5.0), (78.2, 15.6, 3.0)]


@pytest.mark.parametrize('place', PLACES)
def test_metres_are_those_of_the_ellipsoid_and_come_back(place):
    origin = Origin(*place)
    rng = np.random.default_rng(3)
    for scale in (10.0, 3e3, 3e4):
        east, north, up = rng.normal(scale=scale, size=3) * [1.0, 1.0, 0.001]
        there = earth(*place) + numeric_axes(*place) @ [east, north, up]
        latitude, longitude, height = origin.geodetic(np.array([east, north, up]))
        assert earth(latitude, longitude, height) == pytest.approx(there, abs=2e-3)
        back = origin.local(latitude, longitude, height)
        assert back == pytest.approx([east, north, up], abs=1e-6)


def test_many_places_at_once():
    origin = Origin(59.1, 10.2)
    enu = np.arange(12.0).reshape(4, 3) * 100.0
    assert origin.geodetic(enu)[2] == pytest.approx(origin.geodetic(enu[2]))
    assert origin.geodetic(np.empty((0, 3))).shape == (0, 3)


def test_axes_turn_with_the_place():
    origin = Origin(59.1, 10.2)
    assert origin.turn(59.1, 10.2) == pytest.approx(np.eye(3))
    turn = origin.turn(59.15, 10.5)
    expected = numeric_axes(59.1, 10.2).T @ numeric_axes(59.15, 10.5)
    assert origin.axes(59.15, 10.5) == pytest.approx(expected, abs=1e-8)
    # Up to the tilt of the vertical, a height of 20 km over the radius of the Earth.
    assert turn == pytest.approx(expected, abs=20.0 / 6371.0)
    assert turn[:2, :2] == pytest.approx(expected[:2, :2], abs=1e-5)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
    # The meridians converge: what is east there points a little north here.
    assert math.degrees(math.atan2(turn[1, 0], turn[0, 0])) == pytest.approx(0.257, abs=0.005)


@pytest.mark.parametrize('place', PLACES)
def test_a_place_without_height_lies_on_the_ellipsoid_and_not_in_the_plane(place):
    """In the plane 100 km away: 785 m above the ellipsoid, 12 m too near to the origin."""
    origin = Origin(*place)
    there, expected = [], []
    for north, east in ((0.0, 0.0), (0.9, 0.2), (-0.3, 1.1), (6.0, -4.0)):
        latitude, longitude = place[0] + north, place[1] + east
        step = earth(latitude, longitude, place[2] - 3.0) - earth(*place)
        there.append((numeric_axes(*place).T @ step)[:2])
        expected.append(earth(latitude, longitude, place[2] - 3.0))
    found = origin.at_height(np.array(there), -3.0)
    assert [earth(*each) for each in found] == [pytest.approx(e, abs=0.01) for e in expected]
    assert found[:, 2] == pytest.approx(place[2] - 3.0, abs=1e-3)
    longitude, latitude = origin.degrees(np.array([[*there[1], np.nan], [1e5, 0.0, -785.0]]))
    assert latitude[0] == pytest.approx(found[1, 0], abs=1e-6)
    assert [latitude[1], longitude[1]] == pytest.approx(origin.geodetic([1e5, 0.0, -785.0])[:2])
    assert origin.at_height(np.array([3.0, 4.0])).shape == (3,)
    assert np.isnan(origin.at_height(np.array([[1e7, 0.0]]))).all()
