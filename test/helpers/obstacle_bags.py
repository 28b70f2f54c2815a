# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Runs of simulated obstacles, made as the command makes them."""

from sonar_imm_tools.cli import main


def tracked(folder, scenario='tethers', seed=1, **settings):
    """Simulate and track into `folder`; gives the folder of the run."""
    changed = [part for name, value in settings.items() for part in ('--set', f'{name}={value}')]
    bag = folder / 'scene'
    assert (
        main(
            [
                'simulate',
                'obstacle',
                str(bag),
                '--scenario',
                scenario,
                '--seed',
                str(seed),
                *changed,
            ]
        )
        == 0
    )
    assert main(['track', str(bag), str(folder / 'run')]) == 0
    return folder / 'run'
