# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Fathometer: reflectors below a drifting array, their number unknown. Writes fathometer.html, or
the file that is named."""

import sys

import numpy as np
import plotly.graph_objects as go

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm_tools.simulation import fathometer as scenes

config = scenes.scenario('drift_traces', {'records': 40})
scene = scenes.simulate(config, seed=1)
tracker = SYSTEMS['fathometer'].build(FathometerConfig(**config.instruments()))
rows = []
for record, received in enumerate(scene.measurements):
    for estimate in tracker.process(received.measurement):
        depth = estimate.state[:, estimate.state_names.index('depth')]
        for k in range(len(estimate)):
            track = int(estimate.extras['track_id'][k])
            rows.append((record, track, depth[k], float(estimate.extras['existence'][k])))
record, track, depth, existence = np.array(rows).T
names = sorted(set(track[existence > 0.5]))
tables = [table for truth in scene.truth for table in truth.tables(scene.frame_id)]
there = {int(name) for table in tables for name in table.columns['track_id']}
print(f'{len(names)} tracks of {len(there)} reflectors in {len(scene.measurements)} records')

figure = go.Figure(layout_title_text='Reflectors below the array')
for name in names:
    its = (track == name) & (existence > 0.5)
    figure.add_scatter(x=record[its], y=depth[its], name=f'reflector {name:.0f}', mode='markers')
figure.update_yaxes(title='depth, m', autorange='reversed').update_xaxes(title='record')
figure.write_html(sys.argv[1] if len(sys.argv) > 1 else 'fathometer.html')
