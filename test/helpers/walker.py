# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A small real system for tests of the nodes: the walker."""

from collections import Counter
import sys
from typing import Any

import attrs
import numpy as np

import msg_adapters.displays.bathymetry
import msg_adapters.inputs.diver
from sonar_imm.estimates import Estimate
from sonar_imm.intake import KnownFrames
from sonar_imm.measurements import Fix
from sonar_imm.parameters import Config, live, parameter
from sonar_imm.trackers import System, SYSTEMS


@attrs.frozen(kw_only=True)
class WalkerConfig(Config):
    """A walker who stays where he is, and one that is slow or fast."""

    sound_speed: float = live(1500.0, 'm/s', 'speed of sound', range=(1300.0, 1700.0))
    fast_share: float = live(0.25, '', 'share of fast', range=(0.0, 1.0))
    slow_share: float = live(0.75, '', 'share of slow', range=(0.0, 1.0))
    steps: int = parameter(3, '', 'steps', range=(1, 9))
    mood: str = live('calm', '', 'mood', choices=('calm', 'hasty'))
    weights: tuple = live((), '', 'weights', range=(0.0, 1.0), kind='float[]')
    offsets: tuple = parameter((0.5, 1.5), 'm', 'offsets', range=(-9.0, 9.0))

    def check(self):
        if abs(self.fast_share + self.slow_share - 1.0) > 1e-9:
            return ['fast_share and slow_share must sum to 1']
        return []


class WalkerTracker:
    """The running mean of the fixes, in the order of their stamps; late ones revise it."""

    STATE = ('counts', 'fixes', 'frames')
    counts: Counter[str]
    fixes: dict[int, Any]
    frames: KnownFrames

    def __init__(self, config):
        self.config = config
        self.counts = Counter()
        self.explode = False
        self.reset()

    def reset(self):
        self.fixes = {}
        self.frames = KnownFrames()

    def reconfigure(self, config):
        self.config = config

    def warm(self, inputs=None):
        pass

    def health(self):
        return {'NIS': 1.25, 'tracks': float(bool(self.fixes))}

    def process(self, measurement):
        if self.explode:
            raise ZeroDivisionError('a bug')
        if measurement.stamp_ns in self.fixes:
            self.counts['duplicate'] += 1
            return []
        self.counts['used'] += 1
        self.fixes[measurement.stamp_ns] = measurement
        stamps = sorted(stamp for stamp in self.fixes if stamp >= measurement.stamp_ns)
        return [self._estimate(stamp) for stamp in stamps]

    def _estimate(self, stamp):
        used = [fix.position for key, fix in self.fixes.items() if key <= stamp]
        x, y, z = np.mean(used, axis=0)
        return Estimate(
            stamp_ns=stamp, frame_id=self.fixes[stamp].frame_id,
            xyz=np.array([[x, y, z]] * 2, np.float32), state_names=('px', 'py', 'vx', 'vy'),
            state=np.array([[x, y, 0.5, -0.25]] * 2),
            covariance=np.stack([np.diag([1.0, 2.0, 3.0, 4.0])] * 2), model_names=('slow', 'fast'),
            probabilities=np.array([[self.config.slow_share, self.config.fast_share]] * 2),
            extras={
                'track_id': np.array([7, 4], np.uint32), 'nis': np.full(2, 0.5),
                'track_state': np.array([1, 2], np.uint8),
            },
        )  # fmt: skip


class WalkerSystem(System):
    """The walker, known by its classes instead of their names."""

    def config_type(self):
        return WalkerConfig

    def build(self, config):
        return WalkerTracker(config)

    def state_types(self):
        return (Fix,)


def register(set_item):
    """Make the walker known by ``set_item(mapping, key, value)``; it hears what divers do."""
    walker = WalkerSystem(name='walker', summary='test system', config='', tracker='')
    set_item(SYSTEMS, 'walker', walker)
    set_item(sys.modules, 'msg_adapters.displays.walker', msg_adapters.displays.bathymetry)
    set_item(sys.modules, 'msg_adapters.inputs.walker', msg_adapters.inputs.diver)
