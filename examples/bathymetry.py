# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bathymetry: the sea floor along one ping of a side-scan array, and where it is rough. Writes
bathymetry.html, or the file that is named."""

import sys

import numpy as np
import plotly.graph_objects as go

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm_tools.simulation import bathymetry as scenes

config = scenes.scenario('paper', {'pings': 2})
scene = scenes.simulate(config, seed=1)
tracker = SYSTEMS['bathymetry'].build(BathymetryConfig(**config.instruments()))
(floor,) = tracker.process(scene.measurements[0].measurement)
(truth,) = scene.truth[0].tables(scene.frame_id)
valid = floor.extras['valid'] > 0

height = floor.columns()['height'][valid]
at = floor.extras['range'][valid]
true = np.interp(at, truth.columns['range'], truth.columns['height'])
print(f'height RMSE {np.sqrt(np.nanmean((height - true) ** 2)):.2f} m in {valid.sum()} bins')

figure = go.Figure(layout_title_text='The floor along one ping')
figure.add_scatter(x=at, y=height, name='estimate')
figure.add_scatter(x=at, y=true, name='truth')
for name, share in zip(floor.model_names, floor.probabilities.T):
    figure.add_scatter(x=at, y=share[valid], name=f'probability of {name}', yaxis='y2')
figure.update_layout(
    xaxis_title='range, m',
    yaxis_title='height, m',
    yaxis2={'title': 'probability', 'overlaying': 'y', 'side': 'right', 'range': [0, 4]},
)
figure.write_html(sys.argv[1] if len(sys.argv) > 1 else 'bathymetry.html')
