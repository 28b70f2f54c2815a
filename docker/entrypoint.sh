#!/bin/sh
# Sources ROS 2, the workspace and the target of kernels, then becomes the command: signals reach the node itself.
set -e
. /opt/ros/jazzy/setup.sh
. /ws/install/local_setup.sh
. /numba_target.sh
exec "$@"
