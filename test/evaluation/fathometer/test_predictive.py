# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What of the fathometer is tuned."""

import numpy as np
import pytest

from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm_tools.evaluation.fathometer.predictive import tunables


def names(sigma=None, **values):
    trace = Trace(stamp_ns=1, depth=np.arange(3.0), amplitude=np.ones(3), sigma=sigma)
    return [found.name for found in tunables(FathometerConfig(**values), [trace])]


ALWAYS = ['depth_std', 'amplitude_std_sigmas']


@pytest.mark.parametrize('pulse, more', [('gaussian', ['pulse_width']), ('auto', [])])
def test_the_width_of_a_pulse_that_has_one_is_tuned(pulse, more):
    assert names(np.ones(3), pulse=pulse) == ALWAYS + more


def test_the_noise_of_traces_that_do_not_state_it_is_tuned():
    assert names(noise_sigma=0.5, pulse='auto') == ['noise_sigma', *ALWAYS]
