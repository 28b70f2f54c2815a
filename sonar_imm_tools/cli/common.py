# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What several subcommands share: parameters, JSON and progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import json
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

import click

from msg_adapters.inputs import FEEDERS
from sonar_imm.node_config import chosen_types, DetectorNodeConfig, node_config_type, NodeConfig
from sonar_imm.parameters import (
    Config,
    ConfigError,
    parameters_from_yaml,
    ParameterSpec,
    sections_of,
    small_text,
    unknown_parameters,
)
from sonar_imm.texts import visible
from sonar_imm.trackers import System

from ..recordings.own_files import OF_FRAMES, OwnParameters, write_ros_parameters

Advance = Callable[[int], None]

SECONDS_BETWEEN_LINES = 5.0
OF_EVERY_NODE = ('use_sim_time', 'qos_overrides', 'start_type_description_service')
"""Parameters that `ros2 param dump` writes of every node, and no tracker needs."""


def typed_overrides(config_type: type[Config], overrides: dict[str, str]) -> dict[str, Any]:
    """Texts of ``--set`` in the types of the parameters; of others texts, which Config refuses."""
    specs = specs_with(config_type, {}, overrides)
    return {name: _typed(text, specs.get(name)) for name, text in overrides.items()}


def specs_with(
    config_type: type[Config], values: Mapping[str, Any], overrides: Mapping[str, str]
) -> dict[str, ParameterSpec]:
    """The parameters by name where `values` of a file and texts of ``--set`` are given."""
    plain = {spec.name: spec for spec in config_type.specs()}
    typed = {name: _typed(text, plain.get(name)) for name, text in overrides.items()}
    return {spec.name: spec for spec in config_type.specs_with({**values, **typed})}


def _typed(text: str, spec: ParameterSpec | None) -> Any:
    if spec is None:
        return text
    if spec.kind.endswith('[]'):
        parts = [part.strip() for part in text.strip('[]() ').split(',') if part.strip()]
        return [_scalar(part, spec.kind[:-2]) for part in parts]
    return _scalar(text, spec.kind)


def _scalar(text: str, kind: str) -> Any:
    if kind == 'bool':
        return {'true': True, 'false': False}.get(text.lower(), text)
    if kind == 'str':
        return text
    try:
        return int(text) if kind == 'int' else float(text)
    except ValueError:
        return text


def load_config(
    system: System, params: Path | OwnParameters | None, overrides: dict[str, str]
) -> tuple[Config, NodeConfig]:
    """The parameters of tracker and node: defaults, then the file, then ``--set``. A recording's
    own file sets what it may, a line on stderr names the rest.

    Raises `ConfigError` with one sentence for each mistake.
    """
    tracker, node = system.config_type(), node_config_type(system)
    values = _parameters_of(params, system, system.name, report=True) if params else {}
    specs = {spec.name: spec for spec in node.specs()} | specs_with(tracker, values, overrides)
    values |= {name: _typed(text, specs.get(name)) for name, text in overrides.items()}
    others = _detector_specs(system)
    if unknown := [name for name in values if name not in specs and name not in others]:
        raise ConfigError(*unknown_parameters(unknown, specs))
    given = node.from_mapping(values, ignore_unknown=True)
    # Checked too, though a recording has its own.
    chosen_types(system.name, given.input_types)
    return tracker.from_mapping(values, ignore_unknown=True), given


def load_detector(
    system: System, params: Path | OwnParameters | None, overrides: dict[str, str]
) -> dict[str, Any]:
    """Parameters of the detector before the tracker that are not the default: of the section of
    its node in the file, then ``--set``. Empty for a system without one.

    Raises `ConfigError` with one sentence for each mistake.
    """
    if not params and not overrides:
        return {}
    specs = _detector_specs(system)
    if not specs:
        return {}
    from sonar_imm.trackers.obstacle.detector import DetectorConfig

    # A file for the tracker's node alone says nothing of the detector.
    feeder = FEEDERS[system.name]
    values = _parameters_of(params, system, feeder, needed=False) if params else {}
    values |= {k: _typed(text, specs[k]) for k, text in overrides.items() if k in specs}
    config = DetectorConfig.from_mapping(values, ignore_unknown=True)
    defaults = DetectorConfig().as_dict()
    return {k: value for k, value in config.as_dict().items() if value != defaults[k]}


def _detector_specs(system: System) -> dict[str, ParameterSpec]:
    """Parameters of the detector before the tracker, by name."""
    if system.name not in FEEDERS:
        return {}
    from sonar_imm.trackers.obstacle.detector import DetectorConfig

    return {spec.name: spec for spec in DetectorConfig.specs()}


@contextlib.contextmanager
def node_file(system: System, params: Path | OwnParameters | None) -> Iterator[Path | None]:
    """Yields a parameter file for real nodes: `params`, of a recording's own one what is taken."""
    if not isinstance(params, OwnParameters):
        yield params
        return
    names = (system.name, *filter(None, [FEEDERS.get(system.name)]))
    with tempfile.TemporaryDirectory(prefix='sonar_imm_') as folder:
        path = Path(folder) / params.path.name
        write_ros_parameters(path, {name: _parameters_of(params, system, name) for name in names})
        yield path


def parameters_taken(system: System, params: Path | OwnParameters | None) -> dict[str, Any]:
    """What a parameter file says for the tracker, not checked. Raises `ConfigError`."""
    return _parameters_of(params, system, system.name) if params else {}


def _taken(own: OwnParameters, system: System, node_name: str, report: bool) -> dict[str, Any]:
    """What is taken from a recording's own file for a node; report: say what is not."""
    detector = set(_detector_specs(system))
    node = {spec.name for spec in node_config_type(system).specs()}
    if detector:
        node |= {spec.name for spec in DetectorNodeConfig.specs()}
    allowed = {*detector, 'input_types'}
    if node_name == system.name:
        allowed |= {spec.name for spec in system.config_type().specs()}
        allowed |= node.intersection(OF_FRAMES)
    values, sentences = own.taken(node_name, allowed, node)
    for sentence in sentences if report else ():
        click.echo(visible(sentence), err=True)
    # What nobody knows `load_config` refuses, with what may be meant.
    return values if node_name == system.name else {k: values[k] for k in values if k in allowed}


def _parameters_of(
    path: Path | OwnParameters,
    system: System,
    node_name: str,
    *,
    needed: bool = True,
    report: bool = False,
) -> dict[str, Any]:
    """What a file says for a node of `system`; needed: one for others only is a mistake."""
    if isinstance(path, OwnParameters):
        values = _taken(path, system, node_name, report)
    else:
        try:
            text = small_text(path)
            values = parameters_from_yaml(text, node_name=node_name)
        except UnicodeDecodeError:
            raise ConfigError(f'{path} is not a text file') from None
        except ConfigError as error:
            raise ConfigError(f'{path}: {error}') from None
        sections = sections_of(text) if needed and not values else []
        known = ('/**', '/*')
        if sections and not any(n in known or n.split('/')[-1] == node_name for n in sections):
            raise ConfigError(
                f"{path} is for {', '.join(sections)}, and not for '{node_name}': rename the "
                "section, or call it '/**' for any node"
            )
    return {key: value for key, value in values.items() if key.split('.')[0] not in OF_EVERY_NODE}


def print_json(result: Any) -> None:
    """Print `result` as JSON; NaN and infinity, which JSON lacks, become null."""
    from ..offline.run_folder import finite

    click.echo(json.dumps(finite(result), indent=2))


def by_topic(messages: Mapping[str, int]) -> str:
    """How many messages there are, in words."""
    return ', '.join(f'{count} on {topic}' for topic, count in sorted(messages.items()))


def say(text: str = '', *, quiet: bool = False) -> None:
    """Print a line on standard output, unless the output is JSON (`quiet`)."""
    if not quiet:
        click.echo(visible(text))


def warn(text: str) -> None:
    """Print one line on standard error. Names may hold anything: only this and `say` print."""
    click.echo(visible(' '.join(text.split())), err=True)


@contextlib.contextmanager
def progress(
    what: str, total: int | None, *, quiet: bool = False, first: str = ''
) -> Iterator[Advance]:
    """Yields ``advance(count)``: a bar on a terminal, else a line every few seconds (stderr).
    first: what a bar says until then, instead of `what`."""
    if quiet or not total:
        yield lambda count: None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(first or what, total=total)
            yield lambda count: bar.update(task, advance=count, description=what)
    else:
        # A line every few seconds, so that the log of a short job stays empty.
        done, printed = 0, time.monotonic()

        def advance(count: int) -> None:
            nonlocal done, printed
            done += count
            if time.monotonic() - printed > SECONDS_BETWEEN_LINES:
                printed = time.monotonic()
                warn(f'{what}: {done} of {total}')

        yield advance
