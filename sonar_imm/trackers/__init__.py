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

"""The trackers: one folder per system. `SYSTEMS` says what exists; importing it does not load a
tracker.

>>> from sonar_imm.measurements import Fix
>>> from sonar_imm.trackers.diver.config import DiverConfig
>>> tracker = SYSTEMS['diver'].build(DiverConfig(fix_std=1.5))
>>> for second in range(1, 30):
...     fix = Fix(stamp_ns=second * 10**9, position=(0.5 * second, 0.0, 0.0))
...     estimates = tracker.process(fix)
>>> newest = estimates[-1]
>>> newest.state_names, newest.state.shape
(('px', 'py', 'vx', 'vy'), (1, 4))
>>> bool(abs(newest.state[0, 0] - 14.5) < 1.0), tracker.counts['used']
(True, 29)
>>> DiverConfig(fix_std=-1.0)
Traceback (most recent call last):
    ...
sonar_imm.parameters.ConfigError: parameter 'fix_std' must be between 0.0001 and 100000, got -1.0 m
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import import_module
from typing import Any, overload, TYPE_CHECKING

from attrs import field, frozen

from ..parameters import Config, ConfigError
from .protocol import SmoothingTracker, Tracker, WarmStep

if TYPE_CHECKING:
    from .bathymetry.tracker import BathymetryConfig, BathymetryTracker
    from .diver.smoothing import SmoothingDiverTracker
    from .diver.tracker import DiverConfig, DiverTracker
    from .fathometer.tracker import FathometerConfig, FathometerTracker
    from .obstacle.tracker import ObstacleConfig, ObstacleTracker

__all__ = ['SmoothingTracker', 'System', 'SYSTEMS', 'Tracker', 'WarmStep']


@frozen(kw_only=True)
class System:
    """What there is to know of a system: its name, and what its classes are called.

    On each floor that holds something of every system, a folder or module of that name has it; the
    properties say which. They are strings, so that listing systems stays fast, and so that no
    import goes up: whoever stands higher imports what it needs.

    config, tracker, smoother: classes below `sonar_imm.trackers.<name>`, as ``module.Class``;
    smoother: '' when the tracker cannot look back. node_config: a class of
    `sonar_imm.node_config`. kernels: about how many kernels each of the tracker's `warm_steps`
    needs in the default configuration, and how many lines of source they have, shared ones
    included, none where all is numpy; all_kernels: the same of all steps.
    """

    name: str
    summary: str
    config: str
    tracker: str
    smoother: str = ''
    node_config: str = 'NodeConfig'
    kernels: Mapping[str, tuple[int, int]] = field(factory=dict)
    all_kernels: tuple[int, int] = (0, 0)

    @property
    def scenes(self) -> str:
        """The module with `SCENARIOS`, `scenario` and `simulate`."""
        return f'sonar_imm_tools.simulation.{self.name}'

    @property
    def judge(self) -> str:
        """The module with `judge` and `LIMIT`, see `evaluation.judging`."""
        return f'sonar_imm_tools.evaluation.{self.name}'

    @property
    def node(self) -> str:
        """The module with `main` of the ROS 2 node."""
        return f'sonar_imm.nodes.{self.name}'

    def config_type(self) -> type[Config]:
        return self._own(self.config)

    @overload
    def build(self, config: BathymetryConfig) -> BathymetryTracker: ...
    @overload
    def build(self, config: DiverConfig) -> DiverTracker: ...
    @overload
    def build(self, config: FathometerConfig) -> FathometerTracker: ...
    @overload
    def build(self, config: ObstacleConfig) -> ObstacleTracker: ...
    @overload
    def build(self, config: Config) -> Tracker: ...

    def build(self, config: Config) -> Tracker:
        """The tracker with these parameters."""
        return self._own(self.tracker)(config)

    @overload
    def build_smoother(self, config: DiverConfig) -> SmoothingDiverTracker: ...
    @overload
    def build_smoother(self, config: Config) -> SmoothingTracker: ...

    def build_smoother(self, config: Config) -> SmoothingTracker:
        """The tracker that can look back at the end of a recording.

        Raises `ConfigError` when the system has none."""
        if not self.smoother:
            raise ConfigError(f'the {self.name} tracker has no smoother')
        return self._own(self.smoother)(config)

    def kernels_of(self, steps: Collection[str]) -> tuple[int, int]:
        """About how many kernels these steps need, and how many lines of source they have."""
        each = [self.kernels.get(step, (0, 0)) for step in steps]
        count, lines = (sum(column) for column in zip((0, 0), *each))
        return min(count, self.all_kernels[0]), min(lines, self.all_kernels[1])

    def warm(self, tracker: Tracker, inputs: Collection[type] | None = None) -> None:
        """`Tracker.warm`, with a `jit.progress` that knows how much there is to do."""
        from ..estimation import jit  # and numba, which the tracker has loaded by now

        jit.expect(self.kernels_of([name for name, _ in tracker.warm_steps(inputs)]))
        tracker.warm(inputs)

    def warm_steps(self, config: Config) -> list[WarmStep]:
        """Those of a tracker of its own, for another process: this can be pickled."""
        return self.build(config).warm_steps()

    def state_types(self) -> tuple[type, ...]:
        """Return the classes of values that a saved state of the tracker may hold."""
        types: tuple[type, ...] = self._own('state_types.STATE_TYPES')
        return types

    def _own(self, dotted: str) -> Any:
        module, _, name = dotted.rpartition('.')
        return getattr(import_module(f'{__name__}.{self.name}.{module}'), name)


SYSTEMS = {
    system.name: system
    for system in (
        System(
            name='bathymetry',
            summary='sea floor from side-scan array snapshots, IMM particle filter along each '
            'ping',
            config='config.BathymetryConfig',
            tracker='tracker.BathymetryTracker',
            node_config='BathymetryNodeConfig',
            kernels={'pings': (4, 545), 'surfaces': (3, 239)},
            all_kernels=(7, 784),
        ),
        System(
            name='diver',
            summary='divers from multistatic fixes or raw arrival times, 16-direction IMM',
            config='config.DiverConfig',
            tracker='tracker.DiverTracker',
            smoother='smoothing.SmoothingDiverTracker',
            node_config='TracksNodeConfig',
            kernels={'fixes': (29, 823), 'echoes': (15, 424), 'tags': (15, 424)},
            all_kernels=(29, 823),
        ),
        System(
            name='fathometer',
            summary='sub-bottom reflectors from array noise or traces, multiple-model particle '
            'filter',
            config='config.FathometerConfig',
            tracker='tracker.FathometerTracker',
            kernels={'records': (3, 277)},
            all_kernels=(3, 277),
        ),
        System(
            name='obstacle',
            summary='obstacles ahead of a vehicle with their height, from a forward-looking sonar '
            'and navigation, Gaussian sum over depth',
            config='config.ObstacleConfig',
            tracker='tracker.ObstacleTracker',
            node_config='ObstacleNodeConfig',
        ),
    )
}
