# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Set up what has to be set before rclpy is imported anywhere."""

import gc
import importlib.util
import os
import tempfile

from helpers.kernel_types import in_effect
from helpers.source import commits
import hypothesis
import pytest

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
collect_ignore = [] if importlib.util.find_spec('rclpy') else ['nodes', 'replay', 'system']

SHARES = 8
"""Of the statistical tests `make test` runs every so many-th, another share after each commit."""


def pytest_addoption(parser):
    parser.addoption(
        '--statistics',
        choices=('all', 'share', 'none'),
        default='all',
        help='which of the tests marked statistics to run: all, the share of this commit, or none',
    )


def pytest_collection(session):
    """What is imported stays: nobody looks for garbage in it, which took a third of the time."""
    gc.disable()


def pytest_collection_finish(session):
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Every other worker begins at the other end: each loads what the other has compiled."""
    report = yield
    odd = os.environ.get('PYTEST_XDIST_WORKER', '').endswith(tuple('13579'))
    folder = isinstance(collector, getattr(pytest, 'Directory', ()))  # since pytest 8
    if odd and folder and len(collector.config.args) == 1:
        report.result.reverse()
    return report


def pytest_collection_modifyitems(config, items):
    """Files in their order; leave out the statistical tests that are not wanted in this run."""
    if len(config.args) == 1:
        items.sort(key=lambda item: str(item.path))
    wanted = config.getoption('--statistics')
    if wanted == 'all':
        return
    statistics = [item for item in items if item.get_closest_marker('statistics')]
    turn = commits() % SHARES
    run = statistics[turn::SHARES] if wanted == 'share' else []
    left_out = set(statistics) - set(run)
    config.hook.pytest_deselected(items=sorted(left_out, key=lambda item: item.nodeid))
    items[:] = [item for item in items if item not in left_out]


def pytest_report_header():
    lines = [f'OpenBLAS kernels: {", ".join(sorted(in_effect())) or "unknown"}']
    if collect_ignore:
        lines.append(f'not collected, they need rclpy: {collect_ignore}')
    return lines


def pytest_sessionstart(session):
    """A run that is asked for under one kernel type must not quietly be a run under another."""
    wanted = os.environ.get('OPENBLAS_CORETYPE')
    if wanted and {name.lower() for name in in_effect()} != {wanted.lower()}:
        raise pytest.UsageError(
            f'OPENBLAS_CORETYPE={wanted}, but in effect is '
            f'{", ".join(sorted(in_effect())) or "nothing that can be asked"}'
        )
