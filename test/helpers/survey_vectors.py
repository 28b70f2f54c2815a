# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The survey among the reference vectors: seven lines with biases, and what a prototype makes."""

from pathlib import Path

import numpy as np

from sonar_imm_tools.recordings.export.points import Points
from sonar_imm_tools.simulation.survey import budget
from sonar_imm_tools.survey.grid import Soundings
from sonar_imm_tools.survey.line import Line, line_of

FILE = Path(__file__).parents[1] / 'vectors' / 'survey' / 'scene.npz'
BUDGET = budget()


def scene():
    return np.load(FILE)


def box(data):
    return tuple(int(v) for v in data['ext'])


def lines(data):
    """The seven lines."""
    made = []
    for k in range(7):
        rows = data['line'] == k
        x, y, z = data['p_mm'][rows].T * 1e-3
        columns = {
            'x': x, 'y': y, 'z': z, 'vertical_uncertainty': data['vu'][rows].astype(float),
            'range': data['range_mm'][rows] * 1e-3,
            'beam_angle': data['beam'][rows].astype(float),
            'side': data['side'][rows].astype(float), 'label': data['label'][rows].astype(float),
            'geometry_std': np.zeros(len(x)),
        }  # fmt: skip
        made.append(line_of(Points(data['stamp_ns'][rows], columns), BUDGET))
    return made


def together(parts):
    number = np.concatenate([np.full(len(part), k) for k, part in enumerate(parts)])
    return Soundings(Line.joined(parts), number)


def dense(nodes, where, name):
    """Values of nodes as an array (nx, ny), NaN where there are none."""
    table = np.full(where[2:], np.nan)
    table[nodes.ix - where[0], nodes.iy - where[1]] = getattr(nodes, name)
    return table
