# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The independent vectors through ``track`` on a bag, as a user would run them."""

import csv
import json

from attrs import evolve
from helpers.bathymetry_cases import vector
import numpy as np
import pytest

from msg_adapters.snapshots import write_snapshot
from sonar_imm.trackers.state_file import json_parameters
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.writer import BagWriter, ros_message


def tracked(name, tmp_path):
    """The case and the columns of its estimate.csv."""
    case, config, snapshot = vector(name)
    bag, file = tmp_path / 'bag', tmp_path / 'params.yaml'
    with BagWriter(bag) as writer:
        message = write_snapshot(evolve(snapshot, stamp_ns=10**9), ros_message)
        writer.write('/snapshot', message, 10**9)
    values = json_parameters(config)
    file.write_text(json.dumps({'/**': {'ros__parameters': values}}))
    assert main(['track', str(bag), str(tmp_path / 'out'), '--params', str(file)]) == 0
    with open(tmp_path / 'out' / 'estimate.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    return case, {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


@pytest.mark.parametrize('name', ['set_ii_0', 'set_ii_1', 'set_iii_0', 'set_iii_1'])
def test_particles_meet_the_exact_filter(name, tmp_path):
    case, table = tracked(name, tmp_path)
    state = 'angle' if name.startswith('set_iii') else 'height'
    error = np.abs(table[state] - case['m'].ravel()) / np.sqrt(case['v'].ravel())
    assert error.mean() <= 0.035
    rough = case['mu'].reshape(len(error), 2)[:, 1]
    assert np.abs(table['prob_rw_rough'] - rough).mean() <= 0.006
