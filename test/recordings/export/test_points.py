# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Soundings in coordinate systems and in the frame of other lines."""

import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm_tools.recordings.export.points import origin_of, Points
from sonar_imm_tools.recordings.sources import BagError

NOWHERE = (0.0, 0.0, 0.0)


def seen_from(origin, latitude, longitude):
    x, y = origin.local(latitude, longitude)[:2]
    return Points(np.arange(len(x)), {'x': x, 'y': y, 'z': -20.0 * np.ones(len(x))})


def test_places_are_the_same_from_either_origin():
    rng = np.random.default_rng(1)
    latitude, longitude = 54.3 + rng.uniform(-1, 1, 40) / 60, 10.1 + rng.uniform(-1, 1, 40) / 60
    here, there = Origin(54.3, 10.1), Origin(54.29, 10.12)
    moved = seen_from(here, latitude, longitude).placed(here, None, NOWHERE, there)
    wanted = seen_from(there, latitude, longitude)
    for name in 'xy':
        assert np.allclose(moved[name], wanted[name], atol=2e-3)
    assert (moved['z'] == -20.0).all()


def test_the_central_meridian_of_utm_is_500_km_east_and_scaled():
    pytest.importorskip('rasterio')
    own = Origin(54.3, 9.0)
    points = Points(np.arange(2), {name: np.array([0.0, 0.0]) for name in 'xz'})
    points.columns['y'] = np.array([0.0, 1000.0])
    there = points.placed(own, 25832, NOWHERE)
    assert there['x'] == pytest.approx(500_000.0, abs=1e-3)
    assert np.diff(there['y']) == pytest.approx(999.6, abs=0.01)


def test_a_stated_place_of_the_origin_counts_before_its_latitude():
    points = Points(np.arange(1), {name: np.array([1.0]) for name in 'xyz'})
    moved = points.placed(Origin(54.3, 9.0), 25832, (500.0, 600.0, 7.0))
    assert [moved[name][0] for name in 'xyz'] == [501.0, 601.0, 8.0]
    assert points.placed(None, 25832, NOWHERE)['x'][0] == 1.0


def test_an_origin_that_is_none_is_one_sentence():
    assert origin_of(None, 'a') is None and origin_of({}, 'a') is None
    assert origin_of({'origin': {'latitude': 1, 'longitude': '2'}}, 'a') == Origin(1.0, 2.0)
    for wrong in ([1, 2], {'latitude': 'x'}, 'x', {'up': 1}):
        with pytest.raises(BagError, match='cannot be understood'):
            origin_of({'origin': wrong}, 'a')
