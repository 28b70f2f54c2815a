# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles: how far above or below the sonar is an echo, which only has range and bearing? Writes
obstacle.html, or the file that is named."""

import sys

import numpy as np
import plotly.graph_objects as go

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm_tools.simulation import obstacle as scenes

config = scenes.scenario('approach')
scene = scenes.simulate(config, seed=1)
tracker = SYSTEMS['obstacle'].build(ObstacleConfig(**config.instruments()))
rows = []
for received in scene.measurements:  # navigation, altitude and detections, as they came
    for estimate in tracker.process(received.measurement):
        for k in range(len(estimate)):
            state = dict(zip(estimate.state_names, estimate.state[k]))
            band = [float(estimate.extras[f'vertical_offset_{end}'][k]) for end in ('lo', 'hi')]
            track = int(estimate.extras['track_id'][k])
            rows.append((track, state['range'], state['vertical_offset'], *band))
track, distance, offset, low, high = np.array(rows).T
longest = track == max(set(track), key=list(track).count)
print(f'{longest.sum()} estimates of one obstacle, down to {distance[longest].min():.0f} m')

figure = go.Figure(layout_title_text='Vertical offset of an obstacle while it is approached')
bands = (('90 % band, upper end', low), ('90 % band, lower end', high))
for name, values in (('estimate', offset), *bands):
    figure.add_scatter(x=distance[longest], y=values[longest], name=name)
figure.update_xaxes(title='range, m', autorange='reversed')
figure.update_yaxes(title='below the sonar, m', autorange='reversed')
figure.write_html(sys.argv[1] if len(sys.argv) > 1 else 'obstacle.html')
