# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Online multiple-model tracking for four kinds of sonar: library, ROS 2 nodes and command."""

from __future__ import annotations

from importlib import import_module
from typing import Any, TYPE_CHECKING

import msg_adapters as _adapters

if TYPE_CHECKING:
    from .estimation.imm_filter import IMM, MeasurementModel, position, range_bearing
    from .estimation.motion import ca, ct, cv, hover, Model, Motion
    from .estimation.particle_imm import ParticleIMM

__all__ = [
    'ca',
    'ct',
    'cv',
    'hover',
    'IMM',
    'MeasurementModel',
    'Model',
    'Motion',
    'ParticleIMM',
    'position',
    'range_bearing',
]
_MODULES = dict.fromkeys(('ca', 'ct', 'cv', 'hover', 'Model', 'Motion'), 'motion')
_MODULES['ParticleIMM'] = 'particle_imm'

__version__ = '1.0.0'


def _check_adapters() -> None:
    """Raise ImportError when `msg_adapters` is not ours: ROS workspaces merge packages."""
    owner = getattr(_adapters, '__owner__', None)
    version = getattr(_adapters, '__version__', None)
    if (owner, version) != ('sonar_imm', __version__):
        found = getattr(_adapters, '__file__', None) or list(_adapters.__path__)
        raise ImportError(
            f'sonar_imm {__version__} ({__file__}) needs its own module '
            f'msg_adapters, but Python found {found} (owner {owner}, version '
            f'{version}); another package or an older install hides it'
        )


_check_adapters()


def __dir__() -> list[str]:
    """Return the names of `__all__` and the version, whether imported yet or not."""
    return [*__all__, '__version__']


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` when it is first asked for: numpy and scipy take a moment."""
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module = _MODULES.get(name, 'imm_filter')
    return getattr(import_module(f'{__name__}.estimation.{module}'), name)
