# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Another Python that compiles kernels, or loads them."""

import os
from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).parents[2]


def run(code, root, cache, **environment):
    """What `code` prints in a process of its own, with the package at `root`."""
    environment |= {'NUMBA_CACHE_DIR': str(cache), 'PYTHONPATH': str(root)}
    environment = {**os.environ, **environment}
    command = [sys.executable, '-c', code]
    done = subprocess.run(
        command, cwd=root, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()
