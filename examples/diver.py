# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers: noisy fixes of one diver become a track. Writes diver.html, or the file that is
named."""

import sys

import numpy as np
import plotly.graph_objects as go

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm_tools.simulation import diver as scenes

scene = scenes.simulate(scenes.scenario('table1'), seed=1)
tracker = SYSTEMS['diver'].build(DiverConfig())
fixes, track = [], []
for received in scene.measurements:
    fixes.append(received.measurement.position[:2])
    for estimate in tracker.process(received.measurement):
        if len(estimate):  # before a track is confirmed there are no rows
            track.append([estimate.stamp_ns, *estimate.state[0, :2]])
newest = {stamp: place for stamp, *place in track}  # late fixes revise earlier estimates
truth = {int(t): p for t, p in zip(scene.truth[0].stamp_ns, scene.truth[0].position)}
error = [np.linalg.norm(np.subtract(newest[t], truth[t][:2])) for t in newest if t in truth]
print(f'position RMSE {np.sqrt(np.mean(np.square(error))):.2f} m from {len(fixes)} fixes')

figure = go.Figure(layout_title_text='A diver, its fixes and its track')
for name, places, mode in (
    ('fixes', fixes, 'markers'),
    ('truth', scene.truth[0].position[:, :2], 'lines'),
    ('track', list(newest.values()), 'lines+markers'),
):
    x, y = np.array(places).T
    figure.add_scatter(x=x, y=y, name=name, mode=mode)
figure.update_yaxes(scaleanchor='x', title='north, m').update_xaxes(title='east, m')
figure.write_html(sys.argv[1] if len(sys.argv) > 1 else 'diver.html')
