# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm bench``."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
import sys
from types import ModuleType
from typing import Any

import click

import sonar_imm
from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import node_file, print_json, say


# fmt: off
@click.command(epilog=opt.example('sonar-imm bench', 'sonar-imm bench diver --json --skip-node'))
@opt.systems
@click.option('--rounds', type=opt.COUNT, default=7, show_default=True,
    help='Paired rounds against other programs.')
@click.option('--bag', type=opt.PATH,
    help='Recording to time the node with; a shipped one by default.')
@click.option('--skip-node', is_flag=True, help='Leave out the live node (needs ROS 2).')
@click.option('--strict', is_flag=True, help='Exit code 1 when a measurement misses its goal.')
@opt.json
def command(
    systems: tuple[str, ...], rounds: int, bag: Path | None, skip_node: bool, strict: bool,
    as_json: bool,
) -> None:
    """Measure the speed of the filters, beside other libraries in the same run, and of the nodes.

    Times depend on the machine and its load; the ratio to another program hardly does. Without
    SYSTEMS all are measured. Needs the folder benchmarks/ of a source checkout.
    """
    if bag is not None and len(systems or SYSTEMS) > 1:
        raise click.UsageError('--bag needs exactly one system')
    speed = _speed()
    results = {}
    for system in systems or SYSTEMS:
        say(f'{system}:', quiet=as_json)
        results[system] = _measure(speed, system, rounds, quiet=as_json)
        if not skip_node:
            results[system]['node_ms'] = latency = _node_latency(system, bag)
            delays = f'p50 {latency["p50"]:.2f} ms, p99 {latency["p99"]:.2f} ms'
            say(f'  live node, message to estimate: {delays}', quiet=as_json)
    if as_json:
        print_json(results)
    if strict and not all(
        part.get('good', True) for result in results.values() for part in result.values()
    ):
        raise click.exceptions.Exit(1)
# fmt: on


def _speed() -> ModuleType:
    """The package `benchmarks.speed` of the source checkout that this runs from."""
    root = Path(sonar_imm.__file__).resolve().parents[1]
    if not (root / 'benchmarks' / 'speed').is_dir():
        raise click.ClickException(
            'the benches are in the folder benchmarks/ of the source, which is not installed: '
            'run `make bench` in a checkout'
        )
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    return import_module('benchmarks.speed')


def _measure(speed: ModuleType, system: str, rounds: int, *, quiet: bool) -> dict[str, Any]:
    """The benches of one system, without those that need a library that is not installed."""
    result = {}
    for bench in speed.benches_of(system):
        try:
            result[bench.name] = bench.measure(rounds)
        except ModuleNotFoundError as error:
            if (missing := (error.name or '').split('.')[0]) not in speed.PEERS:
                raise
            say(
                f'  {bench.name} left out, nothing to compare with: {missing} is not installed: '
                "pip install 'sonar_imm[test]'",
                quiet=quiet,
            )
        else:
            say(f'  {speed.sentence(bench, result[bench.name])}', quiet=quiet)
    return result


def _node_latency(system: str, bag: Path | None) -> dict[str, float]:
    from ..recordings.own_files import own_parameters
    from ..replay.harness import run_lockstep
    from ..resources import share_folder

    bag = bag or min((share_folder() / 'bags').glob(f'{system}_*'))
    with node_file(SYSTEMS[system], own_parameters(bag)) as params:
        return run_lockstep(bag, system, params_file=params).latency_ms()
