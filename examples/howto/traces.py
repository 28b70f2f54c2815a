# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Traces of a profiler over three layers that wander, in noise, as traces.csv."""

import numpy as np

rng = np.random.default_rng(5)
depth = np.arange(0.0, 40.0, 0.1)  # below the profiler, m
layers, strengths = np.array([14.0, 19.5, 27.0]), (1.0, 0.5, 0.3)
with open('traces.csv', 'w') as file:
    print('time,depth,amplitude,std', file=file)
    for ping in range(60):
        layers += rng.normal(scale=0.05, size=3)
        trace = rng.normal(scale=0.05, size=len(depth))
        for layer, strength in zip(layers, strengths):
            trace += strength * np.exp(-0.5 * ((depth - layer) / 0.25) ** 2)
        for one, value in zip(depth, trace):
            print(
                f'2026-05-04T10:{ping // 60:02}:{ping % 60:02}Z,{one:.1f},{value:.4f},0.05',
                file=file,
            )
