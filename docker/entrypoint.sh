#!/bin/sh
# Sources ROS 2 and the workspace, then becomes the command: signals reach the node itself.
set -e
. /opt/ros/jazzy/setup.sh
. /ws/install/local_setup.sh
exec "$@"
