"""Set up what has to be set before rclpy is imported anywhere."""

import os
import tempfile

# Messages check what is put into them only when asked to, and only at their import.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='sonar_imm_ros_log_')
# Nodes of one context still find each other, and nobody else does.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
os.environ.pop('ROS_LOCALHOST_ONLY', None)
