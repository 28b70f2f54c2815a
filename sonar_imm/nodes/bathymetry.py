"""The bathymetry node: ``ros2 run sonar_imm bathymetry_node``, or
``python -m sonar_imm.nodes.bathymetry``.

Hears ``snapshot``, one message a ping, and publishes one ``~/estimate`` a ping, one row a range
bin. The points are the floor in the frame of the sonar; the column ``label`` is the number of the
most probable terrain model, by which RViz2 and Foxglove colour them (config/bathymetry.rviz,
config/foxglove_bathymetry.json), ``label_probability`` how probable it is.

One node is one side. A sonar with two sides has two nodes, in namespaces, each with a core of its
own if there is one::

    ros2 run sonar_imm bathymetry_node --ros-args -r __ns:=/port -p side:=port
    ros2 run sonar_imm bathymetry_node --ros-args -r __ns:=/starboard

No ping needs the one before. So a node that cannot keep up drops whole pings, those that waited
longer than ``max_wait``, and says so in /diagnostics, rather than show the floor of a while ago.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread

    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

from .base import run, TrackerNode


class BathymetryNode(TrackerNode):
    """Finds the sea floor along each ping of a side-scan array."""

    def __init__(self, **options: Any):
        super().__init__('bathymetry', **options)


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(BathymetryNode, args)


if __name__ == '__main__':
    sys.exit(main())
