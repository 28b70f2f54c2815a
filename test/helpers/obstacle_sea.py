# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recorded encounters at sea: measurements, truth, and the answers of an independent filter."""

import functools
from pathlib import Path

import numpy as np

from helpers.obstacle_runs import AS_STATED, run, SECOND
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

VECTORS = Path(__file__).parents[1] / 'vectors' / 'obstacle_sea'
ENCOUNTERS = (
    ('swaying_approach', 0), ('moving_target', 0), ('starts_moving', 0), ('seabed_and_fixed', 0),
    ('seabed_and_fixed', 1),
)  # fmt: skip
KINDS = ('fixed', 'swaying', 'moving', 'seabed')


def encounter(name, number=0):
    """The arrays of one encounter, by key."""
    with np.load(VECTORS / f'{name}.npz') as file:
        head = f'{number:02d}/'
        return {key[len(head) :]: file[key] for key in file.files if key.startswith(head)}


def measurements(data, altitude=True):
    for k, t in enumerate(data['t']):
        stamp = SECOND + round(float(t) * SECOND)
        if altitude:
            yield Altitude(stamp_ns=stamp, altitude=float(data['altitude'][k]))
        yield Navigation(
            stamp_ns=stamp, position=data['odom_p'][k], orientation=data['odom_q'][k],
            velocity=data['odom_v'][k].astype(float), turn_rate=data['odom_w'][k].astype(float),
            frame_id='odom',
        )  # fmt: skip
        seen = np.isfinite(data['meas_range'][k])
        yield Detections(
            stamp_ns=stamp,
            range=data['meas_range'][[k]] if seen else [],
            bearing=data['meas_bearing'][[k]] if seen else [],
        )


def track(data, altitude=True, **values):
    """The estimates of an encounter, ping by ping."""
    lever = tuple(float(value) for value in data['sonar_lever_flu'])
    config = ObstacleConfig(sonar_lever=lever, **{**AS_STATED, **values})
    return list(run(ObstacleTracker(config), measurements(data, altitude)).values())


@functools.cache
def tracked(name, number=0, **values):
    """The arrays of an encounter and the estimates of it."""
    data = encounter(name, number)
    return data, track(data, **values)


def column(estimates, name, pings):
    """(n,) of the only, or the longest, track."""
    return np.array([oldest(estimates[k])[name] for k in pings])


def oldest(estimate):
    row = int(np.argmin(estimate.extras['track_id']))
    return {name: values[row] for name, values in estimate.columns().items()}
