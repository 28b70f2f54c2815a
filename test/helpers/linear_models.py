# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Model set `linear` of the diver tracker, for tests that compare with a filter in closed form:
one constant velocity for each value of `acceleration_noise`. pytest has the folder `test` on its
path, so that the name is registered as that of an installed package is."""

from sonar_imm import cv
from sonar_imm.estimation.markov import persistent


class Linear:
    """A `DiverModels`."""

    def __init__(self, config):
        noises = config.acceleration_noise or (0.25,)
        self.models = [cv(noise, f'cv_{k}') for k, noise in enumerate(noises)]
        self.transition = persistent(len(noises), 0.85)
        self.start = {'vx': (0.0, config.velocity_std), 'vy': (0.0, config.velocity_std)}
