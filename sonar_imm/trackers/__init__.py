# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

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

from collections.abc import Collection
from importlib import import_module
from pathlib import Path
import sys
import time
import traceback
from typing import Any, overload, TYPE_CHECKING

from attrs import frozen

from ..files import one_at_a_time
from ..parameters import Config, ConfigError
from .protocol import SmoothingTracker, Tracker

if TYPE_CHECKING:
    from .bathymetry.tracker import BathymetryConfig, BathymetryTracker
    from .diver.smoothing import SmoothingDiverTracker
    from .diver.tracker import DiverConfig, DiverTracker
    from .fathometer.tracker import FathometerConfig, FathometerTracker
    from .obstacle.tracker import ObstacleConfig, ObstacleTracker

LONGEST_SECONDS = 120.0
"""How long a process waits for another one that compiles: longer than that takes."""

__all__ = ['SmoothingTracker', 'System', 'SYSTEMS', 'Tracker']


@frozen(kw_only=True)
class System:
    """What there is to know of a system: its name, and what its classes are called.

    On each floor that holds something of every system, a folder or module of that name has it; the
    properties say which. They are strings, so that listing systems stays fast, and so that no
    import goes up: whoever stands higher imports what it needs.

    config, tracker, smoother: classes below `sonar_imm.trackers.<name>`, as ``module.Class``;
    smoother: '' when the tracker cannot look back. node_config: a class of
    `sonar_imm.node_config`. words: in names of topics and types that tell that this tracker is
    meant, where none can read them.
    """

    name: str
    summary: str
    config: str
    tracker: str
    smoother: str = ''
    node_config: str = 'NodeConfig'
    words: tuple[str, ...] = ()

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

    def warm(self, tracker: Tracker, inputs: Collection[type] | None = None) -> str:
        """Compile or load kernels by `Tracker.warm`.

        Returns how many, in a sentence; '' for a tracker without kernels. Raises `ConfigError` if
        numba cannot read or write its folder.
        """
        if 'numba' not in sys.modules:
            tracker.warm(inputs)
            return ''
        from ..estimation import jit

        before, start = jit.counts(), time.perf_counter()
        try:
            # Of two processes that compile a kernel for different arguments one may keep its code
            # under the name of the other's.
            with one_at_a_time(Path(__file__).with_name(self.name), LONGEST_SECONDS):
                tracker.warm(inputs)
        except Exception as error:  # what is damaged raises nearly anything when it is unpickled
            frames = traceback.extract_tb(error.__traceback__)
            if not any(frame.filename.endswith('caching.py') for frame in frames):
                raise
            why = ' '.join(str(getattr(error, 'strerror', None) or error).split())
            raise ConfigError(
                f'compiled kernels in {jit.folder()} cannot be read or kept ({why}): free or '
                'delete that folder'
            ) from None
        compiled, loaded = (now - then for now, then in zip(jit.counts(), before))
        if not compiled + loaded:
            return ''
        seconds = time.perf_counter() - start
        return f'{compiled} kernels compiled, {loaded} loaded, {seconds:.1f} s'

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
            words=('swath', 'side_scan', 'sidescan', 'snapshot', 'bathy', 'stave'),
        ),
        System(
            name='diver',
            summary='divers from multistatic fixes or raw arrival times, 16-direction IMM',
            config='config.DiverConfig',
            tracker='tracker.DiverTracker',
            smoother='smoothing.SmoothingDiverTracker',
            node_config='TracksNodeConfig',
            words=('usbl', 'fix', 'diver', 'target', 'beacon', 'acoustic', 'gps', 'gnss', 'ais'),
        ),
        System(
            name='fathometer',
            summary='sub-bottom reflectors from array noise or traces, multiple-model particle '
            'filter',
            config='config.FathometerConfig',
            tracker='tracker.FathometerTracker',
            words=('hydrophone', 'pressure', 'profil', 'trace', 'fathometer'),
        ),
        System(
            name='obstacle',
            summary='obstacles ahead of a vehicle with their height, from a forward-looking sonar '
            'and navigation, Gaussian sum over depth',
            config='config.ObstacleConfig',
            tracker='tracker.ObstacleTracker',
            node_config='ObstacleNodeConfig',
            words=('fls', 'sonar', 'detection', 'image', 'scan', 'echo', 'obstacle'),
        ),
    )
}
