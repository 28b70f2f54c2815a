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

"""``sonar-imm sweep``."""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from attrs import evolve
import click

from sonar_imm.node_config import hears_transforms
from sonar_imm.trackers import SYSTEMS

from .common import (
    example,
    json_option,
    load_config,
    load_detector,
    params_option,
    print_json,
    progress,
    say,
    set_option,
    topic_option,
    typed_overrides,
)

if TYPE_CHECKING:
    from ..evaluation.sweep import Sweep


@click.command(
    epilog=example(
        'sonar-imm sweep diver --runs 100',
        'sonar-imm sweep diver --runs 500 --seed 1 --scenario circle --set speed=0.5 --out circle',
        'sonar-imm sweep obstacle --runs 2000 --scheduler tcp://10.0.0.5:8786 --json',
    )
)
@click.argument('system', type=click.Choice(list(SYSTEMS)))
@click.option('--runs', type=click.IntRange(min=1), required=True, help='How many runs.')
@click.option(
    '--seed',
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help='Seed of the first run; each further run takes the next number.',
)
@click.option(
    '--scenario',
    default=None,
    help='Name of the scene; by default the first one of `sonar-imm simulate SYSTEM --list`.',
)
@set_option
@params_option('Parameter file of the tracker: ROS 2 form or a plain mapping.')
@topic_option
@click.option(
    '--workers',
    type=click.IntRange(min=1),
    help='Processes on this machine; by default one per core. With 1 all runs are in this '
    'process, and dask is not needed.',
)
@click.option(
    '--scheduler',
    metavar='ADDRESS',
    help='Run on the cluster of this dask scheduler instead; its workers need the same sonar_imm.',
)
@click.option(
    '--out',
    type=click.Path(path_type=Path, file_okay=False),
    help='Folder for sweep.csv, one row per run, and sweep.json.',
)
@click.option('--overwrite', is_flag=True, help='Replace an earlier sweep in --out.')
@json_option
def command(
    system: str,
    runs: int,
    seed: int,
    scenario: str | None,
    overrides: dict[str, str],
    params: Path | None,
    topics: dict[str, str],
    workers: int | None,
    scheduler: str | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate, track and score SYSTEM under many seeds, and summarise the scores.

    --set changes the scene, --params the tracker. Without --params the tracker gets the parameters
    of the instruments from the scene. The scores of a seed are those of `sonar-imm evaluate` and
    do not depend on the number of processes. A run that fails is listed and left out; the exit
    code is 1 when more than half of the runs fail.
    """
    if scheduler is not None and workers is not None:
        raise click.UsageError('--workers and --scheduler exclude each other')
    from ..evaluation import sweep as sweeps

    sweep = planned(system, scenario, overrides, params, topics)
    if out is not None:
        sweeps.prepare(out, overwrite=overwrite)
    seeds = range(seed, seed + runs)
    if scheduler is not None:
        coming = sweeps.run_on_cluster(
            sweep, seeds, scheduler, lambda sentence: click.echo(sentence, err=True)
        )
    elif (count := min(runs, workers or _processors())) == 1:
        coming = sweeps.run_here(sweep, seeds)
    else:
        coming = sweeps.run_on_processes(sweep, seeds, count)
    outcomes = []
    with progress('runs', runs, quiet=as_json) as advance:
        for outcome in coming:
            outcomes.append(outcome)
            advance(1)
    content = sweeps.record(sweep, outcomes)
    if out is not None:
        sweeps.write(out, content, outcomes)
    print_json(content) if as_json else _print(content, out)
    if 2 * len(content['failures']) > runs:
        raise click.exceptions.Exit(1)


def _processors() -> int:
    """Those that this process may use, where the system says it (not macOS, nor Windows)."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def planned(
    system: str,
    scenario: str | None,
    overrides: dict[str, str],
    params: Path | None = None,
    topics: dict[str, str] | None = None,
) -> Sweep:
    """What all runs have in common, from the texts of a command line. Raises `ConfigError`."""
    from ..evaluation.sweep import Sweep
    from ..offline.tracking import InputOptions
    from ..recordings.own_files import unusual
    from .track import inputs_by_topic

    scenes = import_module(SYSTEMS[system].scenes)
    name = scenario or next(iter(scenes.SCENARIOS))
    scene = scenes.scenario(name, typed_overrides(type(scenes.scenario(name)), overrides))
    config, node = load_config(SYSTEMS[system], params, {})
    if params is None:
        config = evolve(config, **unusual(scene.instruments(), type(config)))
    return Sweep(
        system=system,
        scenario=name,
        scene=scene,
        config=config,
        options=InputOptions(
            topics=inputs_by_topic(topics or {}),
            frame_id=node.frame_id,
            use_tf_static=hears_transforms(node),
            world_frame=node.world_frame_convention,
            detector=load_detector(SYSTEMS[system], params, {})
            if params
            else scene.feeder_instruments(),
        ),
    )


def _print(content: dict[str, Any], out: Path | None) -> None:
    seeds, summary, failures = content['seeds'], content['summary'], content['failures']
    say(
        f'{content["system"]} {content["scenario"]}: {len(seeds)} runs, seeds {seeds[0]} to '
        f'{seeds[-1]}' + (f', {len(failures)} failed' if failures else '')
    )
    if summary:
        width = max(map(len, summary))
        say(f'  {"metric":<{width}} {"mean":>11} {"std":>11} {"std error":>11} {"runs":>6}')
    for name, entry in summary.items():
        numbers = ' '.join(f'{entry[key]:11.4g}' for key in ('mean', 'std', 'stderr'))
        say(f'  {name:<{width}} {numbers} {entry["runs"]:6d}')
    seeds_by_reason: dict[str, list[str]] = {}
    for seed, sentence in failures.items():
        seeds_by_reason.setdefault(sentence, []).append(seed)
    for sentence, which in seeds_by_reason.items():
        click.echo(f'failed: seed {", ".join(which)}: {sentence}', err=True)
    if out is not None:
        say(f'written to {out}')
