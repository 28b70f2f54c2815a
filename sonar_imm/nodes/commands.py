"""What ``ros2 run sonar_imm NAME_node`` starts: the ``main`` of ``sonar_imm/nodes/NAME.py``, in a
process that does algebra in one thread."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
import sys

from ..threads import one_blas_thread
from .stopping import stopper


def main() -> int:
    """Start the node that this program is called after, e.g. ``diver_node``."""
    stopper.listen()
    one_blas_thread()  # before the node's module imports numpy
    name = Path(sys.argv[0]).stem.removesuffix('_node')
    return int(import_module(f'{__package__}.{name}').main())
