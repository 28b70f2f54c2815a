"""Set up what has to be set before rclpy is imported anywhere."""

import importlib.util
import os
import tempfile

import hypothesis

# The same examples in every run: what fails here fails everywhere, and nowhere by chance.
hypothesis.settings.register_profile('same', derandomize=True, deadline=None)
hypothesis.settings.load_profile('same')

# Messages check what is put into them only when asked to, and only at their import.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_LOG_DIR'] = tempfile.mkdtemp(prefix='sonar_imm_ros_log_')
# Nodes of one context still find each other, and nobody else does.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
os.environ.pop('ROS_LOCALHOST_ONLY', None)

# Without ROS the rest of the package is still tested, e.g. on the oldest numpy.
collect_ignore = [] if importlib.util.find_spec('rclpy') else ['nodes', 'system']


def pytest_report_header():
    return f'not collected, they need rclpy: {collect_ignore}' if collect_ignore else None
