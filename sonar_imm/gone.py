# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Names that earlier versions had, and what a user does instead.

One version long, each removed command, kind of conversion, parameter, choice and program answers
with its sentence instead of "unknown". Keys are ``command NAME``, ``kind NAME``,
``parameter NAME``, ``choice PARAMETER VALUE``, ``executable NAME`` and ``option COMMAND NAME``.
"""

from __future__ import annotations

__all__ = ['GONE']

_BRIDGE = 'was removed: republish ~/odometry or ~/obstacles with a node of your own'
_WITH_ITS_SET = 'was removed together with its model set'
_ROLL = 'was removed: use the elevation of the echoes, or let the vehicle roll'
_OWN_SET = 'was removed: families contains constant velocity; docs/howto/own_model.md adds a set'
_LEARNT = 'was removed: counts is the form that learns; benchmarks/diver_paper.py has the others'
_RAW_FILE = 'was removed: convert the file to npz (kind snapshots) or to XTF'
_LIVE_VIEW = (
    'was removed: view opens the report; show live topics with foxglove_bridge and '
    'config/foxglove_SYSTEM.json'
)

GONE: dict[str, str] = {
    'command fuse': 'was removed: give both sensors to one diver node (parameter sensors)',
    'command chart': 'was removed: record ~/soundings and run sonar-imm survey',
    'command sweep': 'was removed: use sonar-imm simulate --seed, track --jobs and evaluate',
    'option warm --jobs': 'was removed: one process compiles all kernels',
    'kind ek80': _RAW_FILE,
    'kind kongsberg': _RAW_FILE,
    'kind autoferry': 'was removed: write the positions as CSV (kind fixes)',
    'executable composed_node': 'was removed: start one process per node',
    **{f'parameter {name}': _BRIDGE for name in ('targets_to', 'targets_as', 'targets_period')},
    'parameter also_publish': _BRIDGE,
    **{
        f'parameter {name}': _WITH_ITS_SET
        for name in (
            *('lateral_speed_std', 'lateral_speed_time', 'fixed_speed', 'velocity_noise'),
            *('turn_rate_deg', 'baseline_stay_probability'),
        )
    },
    'parameter adaptation_guard': 'was removed together with adaptation: paper',
    **{
        f'choice model_set {name}': _OWN_SET
        for name in (
            *('cv', 'cv_cv', 'cv_ct', 'world_headings', 'relative_headings'),
            'heading_speed_lateral',
        )
    },
    'choice adaptation paper': _LEARNT,
    'choice adaptation ratio': _LEARNT,
    'parameter variant': 'was removed: the printed form is in benchmarks/bathymetry_paper.py',
    **{
        f'parameter {name}': 'was removed: the printed form is in benchmarks/fathometer_paper.py'
        for name in ('amplitude_prior', 'proposal')
    },
    **{
        f'parameter {name}': _ROLL
        for name in ('vertical_beam_width_deg', 'fading_db', 'intensity_weight')
    },
    **{
        f'option view {name}': _LIVE_VIEW
        for name in (
            *('--live', '--host', '--port', '--layout', '--loop', '--rate', '--topics'),
            '--start-paused',
        )
    },
}
"""What each removed name answers, after the name itself."""
