# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The independent reference cases."""

from pathlib import Path

import numpy as np
import pytest

VECTORS = Path(__file__).parents[1] / 'vectors' / 'diver'


@pytest.fixture(scope='session')
def diver_reference():
    """``diver_reference(case, key)``: an array of `imm_reference.npz`; without key, its keys."""
    with np.load(VECTORS / 'imm_reference.npz') as archive:
        arrays = {name: archive[name] for name in archive.files}

    def get(case, key=None):
        if key is None:
            return {name.split('/', 1)[1] for name in arrays if name.startswith(case + '/')}
        return arrays[f'{case}/{key}']

    return get
