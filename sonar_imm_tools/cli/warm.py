# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm warm``: compile before the first recording or the first start of a node."""

from __future__ import annotations

from pathlib import Path

import click

from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import load_config, say


# fmt: off
@click.command(cls=opt.Renewed,
    epilog=opt.example('sonar-imm warm', 'sonar-imm warm fathometer --set heave=memory'))
@opt.systems
@opt.params(help='ROS 2 parameter file of the tracker; with exactly one system.')
@opt.overrides
def command(systems: tuple[str, ...], params: Path | None, overrides: dict[str, str]) -> None:
    """Compile the kernels of the trackers, all of them by default.

    Once for each version on each machine: into NUMBA_CACHE_DIR if that is set, else into the
    folder of the package if that can be written, else into the cache folder of the user.
    Parameters choose what is compiled; those of the default configuration by default.
    """
    if (params or overrides) and len(systems) != 1:
        raise click.UsageError('--params and --set need exactly one system')
    for name in systems or SYSTEMS:
        system = SYSTEMS[name]
        tracker = system.build(load_config(system, params, overrides)[0])
        say(f'{name}: {system.warm(tracker) or "nothing to compile"}')
# fmt: on
