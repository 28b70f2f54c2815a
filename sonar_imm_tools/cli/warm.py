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

"""``sonar-imm warm``: compile before the first recording or the first start of a node."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
import time

import click

from sonar_imm.parameters import Config
from sonar_imm.trackers import SYSTEMS

from .common import (
    compiling,
    example,
    load_config,
    params_option,
    plain_lines,
    say,
    set_option,
)


@click.command(
    epilog=example(
        'sonar-imm warm', 'sonar-imm warm diver --set association=jipda', 'sonar-imm warm --jobs 4'
    )
)
@click.argument('systems', nargs=-1, type=click.Choice(list(SYSTEMS)))
@params_option('ROS 2 parameter file of the tracker; with exactly one system.')
@set_option
@click.option(
    '--jobs',
    type=click.IntRange(min=1),
    default=2,
    show_default=True,
    help='Processes; each compiles one system at a time.',
)
def command(
    systems: tuple[str, ...], params: Path | None, overrides: dict[str, str], jobs: int
) -> None:
    """Compile the kernels of the trackers, all of them by default.

    Once for each version on each machine, into the folder of the package when that can be written,
    else into the cache folder of the user. Whoever installs the package for others compiles for
    them too. Parameters choose what is compiled; those of the default configuration by default.
    """
    from ..offline.jobs import processes

    # What takes longest first, so that no process is left with it at the end.
    chosen = sorted(systems or SYSTEMS, key=lambda name: -SYSTEMS[name].all_kernels[1])
    if (params or overrides) and len(chosen) != 1:
        raise click.UsageError('--params and --set need exactly one system')
    configs = {system: load_config(SYSTEMS[system], params, overrides)[0] for system in chosen}
    with processes(min(jobs, len(chosen))) as pool:
        running = {
            system: pool.submit(_compile, system, config) for system, config in configs.items()
        }
        for system, future in running.items():
            compiled, loaded, seconds = future.result()
            say(f'{system}: {compiled} kernels compiled, {loaded} were there, {seconds:.1f} s')


def _compile(system: str, config: Config) -> tuple[int, int, float]:
    """Warm one tracker; gives how many kernels were compiled and loaded, and the seconds."""
    from sonar_imm.estimation.jit import kernels

    start, before = time.perf_counter(), Counter(kernels)
    say_now = plain_lines()
    with compiling(lambda sentence: say_now(f'{system}: {sentence}')):
        SYSTEMS[system].warm(SYSTEMS[system].build(config))
    made = kernels - before
    return made['compiled'], made['loaded'], time.perf_counter() - start
