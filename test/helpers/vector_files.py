# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The arrays of the reference vectors."""

from functools import cache
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parents[1] / 'vectors'


def load_vectors(name):
    """Return the arrays of ``test/vectors/NAME.npz`` by their names."""
    with np.load(FOLDER / f'{name}.npz', allow_pickle=False) as file:
        return {key: file[key] for key in file}


@cache
def _at_sea():
    return load_vectors('diver_sea/diver_sea')


def vectors(group):
    """The arrays of a group of those of a diver at sea, by their names in it."""
    named = ((*name.split('/'), value) for name, value in _at_sea().items())
    return {name: value for its, name, value in named if its == group}
