"""The reference vectors of a diver at sea, group by group."""

from functools import cache
from pathlib import Path

import numpy as np

FILE = Path(__file__).resolve().parents[1] / 'vectors/diver_sea/diver_sea.npz'


@cache
def _all():
    with np.load(FILE, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def vectors(group):
    """The arrays of a group by their names in it."""
    return {
        name.split('/')[1]: value for name, value in _all().items() if name.split('/')[0] == group
    }
