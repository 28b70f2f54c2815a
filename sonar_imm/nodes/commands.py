"""What ``ros2 run sonar_imm <name>_node`` starts: the ``main`` of a node, in a process that does
algebra in one thread."""

from __future__ import annotations

from importlib import import_module

from ..threads import one_blas_thread


def _run(module: str) -> int:
    one_blas_thread()  # before the node's module imports numpy
    return int(import_module(f'{__package__}.{module}').main())


def bathymetry() -> int:
    """``bathymetry_node``."""
    return _run('bathymetry')


def diver() -> int:
    """``diver_node``."""
    return _run('diver')


def fathometer() -> int:
    """``fathometer_node``."""
    return _run('fathometer')


def obstacle() -> int:
    """``obstacle_node``."""
    return _run('obstacle')


def fls_detector() -> int:
    """``fls_detector_node``."""
    return _run('fls_detector')
