# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm simulate``."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import click

from msg_adapters.inputs import FEEDERS
from sonar_imm import __version__
from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import by_topic, print_json, say, typed_overrides

SURVEY, SURVEY_SCENES = 'survey', 'sonar_imm_tools.simulation.survey'
"""Not a system: lines of soundings over one floor."""


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm simulate diver dive.bag --scenario table1 --seed 7',
        'sonar-imm simulate diver --list',
        'sonar-imm simulate survey out --soundings --set lines=5'))
@click.argument('system', type=click.Choice([*SYSTEMS, SURVEY]))
@click.argument('out_bag', type=opt.PATH, required=False)
@click.option('--scenario', default=None, help='Name of the scene; by default the first one.')
@click.option('--seed', type=click.IntRange(min=0), default=0, show_default=True,
    help='The same scenario and seed give the same bag.')
@opt.overrides
@click.option('--soundings', is_flag=True,
    help='survey: folders of soundings, as `survey` reads them.')
@click.option('--compress', is_flag=True, help='Compress the bag: pressure takes a third.')
@click.option('--list', 'list_scenarios', is_flag=True,
    help='Only list scenarios and what --set can change.')
@opt.json
def command(
    system: str, out_bag: Path | None, scenario: str | None, seed: int, overrides: dict[str, str],
    soundings: bool, compress: bool, list_scenarios: bool, as_json: bool,
) -> None:
    """Write a bag of simulated measurements with their truth to OUT_BAG.

    SYSTEM `survey` is many lines over one floor: OUT_BAG is a folder with a bag of pings for each
    line, to be tracked, or with --soundings a folder with soundings.csv; and truth.npz.
    """
    if soundings and system != SURVEY:
        raise click.UsageError(f'--soundings is for {SURVEY}')
    scenes = import_module(SYSTEMS[system].scenes if system != SURVEY else SURVEY_SCENES)
    if list_scenarios:
        _list(scenes, as_json)
        return
    if out_bag is None:
        raise click.UsageError("Missing argument 'OUT_BAG'")
    name = scenario or next(iter(scenes.SCENARIOS))
    config = scenes.scenario(name, typed_overrides(type(scenes.scenario(name)), overrides))
    if system == SURVEY:
        result, text = _simulate_survey(scenes, config, name, out_bag, seed, soundings, compress)
        print_json(result) if as_json else say(text)
        return
    from sonar_imm.truth import TrueTrack

    from ..recordings.own_files import own_parameters, unusual
    from ..recordings.truth import write_scene

    scene = scenes.simulate(config, seed)
    known = unusual(config.instruments(), SYSTEMS[system].config_type())
    sections = {system: known}
    if fed := config.feeder_instruments():
        # A scene writes its images as the only type that needs no further package.
        sections[FEEDERS[system]] = {'input_types': ['image=sensor_msgs/msg/Image'], **fed}
    notes = {'source': f'simulated: {system} {name}', 'seed': str(seed), 'sonar_imm': __version__}
    notes |= {f'set {key}': value for key, value in sorted(overrides.items())}
    made = write_scene(scene, out_bag, compressed=compress, parameters=sections, provenance=notes)
    parameters = own_parameters(out_bag)
    targets = sum(isinstance(true, TrueTrack) for true in scene.truth)
    result = {
        'bag': str(out_bag),
        'scenario': name,
        'seed': seed,
        'messages': made.messages,
        'targets': targets,
        'parameters': known,
    }
    if as_json:
        print_json(result)
        return
    what = by_topic(made.messages)
    say(f'{out_bag}: {what} ({name}, seed {seed}' + (f', {targets} targets)' if targets else ')'))
    if parameters:
        say(f'  parameters of the instruments, for the tracker: {parameters}')
# fmt: on


def _simulate_survey(
    scenes: Any, config: Any, name: str, out: Path, seed: int, soundings: bool, compress: bool
) -> tuple[dict[str, Any], str]:
    """Folders of lines, or bags, and truth.npz; what was made, as JSON and in words."""
    from sonar_imm.files import whole

    from ..recordings.export.points import write_table
    from ..recordings.own_files import unusual
    from ..recordings.sources import BagError
    from ..recordings.truth import write_scene

    if out.exists():
        raise BagError(f'{out} is there already; choose another folder')
    system, what, total = 'bathymetry', 'soundings' if soundings else 'messages', 0
    provenance = {'source': f'simulated: survey {name}', 'seed': str(seed)}
    with whole(out) as folder:
        folder.mkdir()
        if soundings:
            scene = scenes.simulate(config, seed)
            for line, points in zip(scene.names, scene.points):
                (folder / line).mkdir()
                write_table(folder / line / 'soundings.csv', points)
                total += len(points)
        else:
            scene, lines = scenes.pings_of(config, seed)
            for line, pings, told in lines:
                known = {system: unusual(told, SYSTEMS[system].config_type())}
                bag = folder / f'{line}.bag'
                report = write_scene(
                    pings, bag, compressed=compress, parameters=known, provenance=provenance
                )
                total += sum(report.messages.values())
        scenes.write_truth(folder / 'truth.npz', scene)
    result = {'out': str(out), 'scenario': name, 'seed': seed, 'lines': len(scene.names)}
    text = f'{out}: {len(scene.names)} lines, {total} {what} ({name}, seed {seed})'
    return {**result, what: total}, text


def _list(scenes: Any, as_json: bool) -> None:
    described = {name: entry[0] for name, entry in scenes.SCENARIOS.items()}
    specs = type(scenes.scenario(next(iter(described)))).specs()
    if as_json:
        parameters = {spec.name: spec.description for spec in specs}
        print_json({'scenarios': described, 'parameters': parameters})
        return
    for name, description in described.items():
        say(f'{name:<20} {description}')
    say()
    for spec in specs:
        say(
            f'--set {spec.name + "=" + str(spec.default):<34} {spec.description}'
            + (f' [{spec.unit}]' if spec.unit else '')
        )
