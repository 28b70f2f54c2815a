"""Online multiple-model tracking for four kinds of sonar: library, ROS 2 nodes and command."""

from __future__ import annotations

import msg_adapters as _adapters

__version__ = '0.1.0'


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
