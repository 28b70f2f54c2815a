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


"""Obstacles as GeoJSON, for charts and for planning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .horizons import feature, utc_text, write_features
from .points import degrees_of


def write_obstacles(
    path: Path,
    landmarks: Sequence[dict[str, Any]],
    epsg: int,
    origin: tuple[float, float, float],
) -> None:
    """Points (RFC 7946), the third coordinate the height in the frame of the navigation.

    landmarks: as run.json has them, see `trackers.obstacle.memory.Landmark.row`; origin: of their
    frame in the coordinate system `epsg`. Raises `BagError`. Needs rasterio."""
    places = np.array([[each[axis] for axis in 'xyz'] for each in landmarks]) + origin
    longitude, latitude = degrees_of(places[:, :2], epsg)
    features = []
    for k, each in enumerate(landmarks):
        std = {f'{axis}_std_m': each[f'cov_{axis}_{axis}'] ** 0.5 for axis in 'xyz'}
        band = {f'{name}_m': each[name] + origin[2] for name in ('z_low', 'z_high')}
        properties = {
            'track_id': int(each['track_id']),
            'existence': round(each['existence'], 4),
            **{name: round(value, 3) for name, value in (std | band).items()},
            'last_seen_utc': utc_text(int(each['seen_ns'])),
        }
        place = [
            round(float(longitude[k]), 8),
            round(float(latitude[k]), 8),
            round(float(places[k, 2]), 3),
        ]
        features.append(feature('Point', place, properties))
    write_features(path, features)
