# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One thread of algebra in the programs of this package.

The BLAS that numpy brings starts a thread for each core as soon as it is loaded, and wakes them
for products that one core has done before they are awake. So the command and the nodes call
`one_blas_thread` before anything imports numpy. Whoever uses the package as a library keeps the
process as they made it: nothing here runs on import.
"""

from __future__ import annotations

import os
import sys

# What is set for a library, and what else of the user's own has a say in it.
_SETTINGS = {
    'OPENBLAS_NUM_THREADS': ('GOTO_NUM_THREADS', 'OMP_NUM_THREADS'),
    'MKL_NUM_THREADS': ('OMP_NUM_THREADS',),
    'BLIS_NUM_THREADS': ('OMP_NUM_THREADS',),
    'VECLIB_MAXIMUM_THREADS': (),
}


def one_blas_thread() -> bool:
    """Let this process and its children do algebra in one thread, unless the user's environment
    says otherwise. False, and nothing done, when numpy is loaded: then it is too late."""
    if 'numpy' in sys.modules:
        return False
    for name, others in _SETTINGS.items():
        if not any(os.environ.get(each) for each in (name, *others)):
            os.environ[name] = '1'
    return True
