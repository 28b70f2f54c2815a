"""Online multiple-model tracking for four kinds of sonar: library, ROS 2 nodes and the ``sonar-imm`` command."""

__version__ = '0.1.0'
