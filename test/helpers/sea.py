# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The recording of a moving ship among the vectors, and small pings of our own from a ship."""

from pathlib import Path

import numpy as np

from helpers.bathymetry_cases import EXACT
from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.likelihood import ship_swath
from sonar_imm.trackers.bathymetry.ping import bin_stamps
from sonar_imm.trackers.navigation import NavigationBuffer

VECTOR = Path(__file__).parents[1] / 'vectors' / 'bathymetry_sea' / 'motion_0.npz'
START_NS = 10**18


def motion_case():
    with np.load(VECTOR) as archive:
        return dict(archive)


def sea_config(case, **values):
    stated = {
        'sonar_lever': case['lever'].tolist(), 'sonar_mount_rpy_deg': case['mount_deg'].tolist(),
        'tilt_deg': float(case['tilt_deg']), 'side': str(case['side']),
    }  # fmt: skip
    return BathymetryConfig(**{**EXACT, **stated, **values})


def navigation(case):
    return [
        Navigation(
            stamp_ns=START_NS + round(t * 1e9),
            position=p,
            orientation=q,
            frame_id='map',
        )
        for t, p, q in zip(case['tn'], case['pn'], case['qn'])
    ]  # fmt: skip


def snapshots(case):
    for t, parts in zip(case['t'], case['iq'].astype(np.float64)):
        yield Snapshot(
            stamp_ns=START_NS + round(t * 1e9),
            frame_id='sonar',
            range=case['r'],
            iq=parts[..., 0] + 1j * parts[..., 1],
            noise_variance=np.full(len(case['r']), float(case['sn2'])),
            sound_speed=float(case['c']),
        )


def swath_of(case, config, snapshot):
    """The swath of one ping."""
    poses = navigation(case)
    buffer = NavigationBuffer(tuple(each.stamp_ns for each in poses), tuple(poses))
    stamps = bin_stamps(snapshot, config)
    ranges = snapshot.ranges(config.sound_speed)
    return ship_swath(
        config, ranges, float(case['c']), config.side, float(case['dlam']), buffer.poses(stamps)
    )
