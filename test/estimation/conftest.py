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
