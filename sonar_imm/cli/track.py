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

"""``sonar-imm track``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from attrs import frozen
import click

from ..trackers import System, SYSTEMS
from .common import (
    BAG,
    example,
    json_option,
    load_config,
    load_detector,
    print_json,
    progress,
    say,
    set_option,
    system_option,
    topic_option,
)


@click.command(
    epilog=example(
        'sonar-imm track dive.bag out',
        'sonar-imm track dive.bag out --set model_set=cv_cv',
        'sonar-imm track dive.bag out --topic fix=/usbl/pose --params my_diver.yaml',
        'sonar-imm track line1.bag line2.bag line3.bag out --jobs 3',
    )
)
@click.argument('bags', metavar='BAG...', nargs=-1, required=True, type=BAG)
@click.argument('out_dir', type=click.Path(path_type=Path))
@system_option
@click.option(
    '--params',
    type=click.Path(path_type=Path, dir_okay=False),
    help='Parameter file: ROS 2 form or a plain mapping.',
)
@set_option
@topic_option
@click.option(
    '--order',
    type=click.Choice(['recorded', 'stamp']),
    default='recorded',
    show_default=True,
    help='Messages in the order of arrival, or sorted by their stamps.',
)
@click.option('--smooth', is_flag=True, help='Condition each estimate on later measurements too.')
@click.option(
    '--jobs',
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help='Processes: for several bags, or for the pings of one where no ping needs another '
    '(bathymetry). The estimates do not depend on it.',
)
@click.option('--overwrite', is_flag=True, help='Replace an earlier run in OUT_DIR.')
@click.option('--strict', is_flag=True, help='Stop at the first damage in BAG.')
@json_option
def command(
    bags: tuple[Path, ...],
    out_dir: Path,
    system: str | None,
    params: Path | None,
    overrides: dict[str, str],
    topics: dict[str, str],
    order: str,
    smooth: bool,
    jobs: int,
    overwrite: bool,
    strict: bool,
    as_json: bool,
) -> None:
    """Track the recording BAG offline and write the estimates to OUT_DIR.

    OUT_DIR gets the bag `estimate`, `estimate.csv` and `run.json`. The same command writes the
    same bytes in bag and CSV. Without --params the file `parameters.yaml` in the folder of BAG is
    used, if there is one. --set changes single parameters. Of several bags each gets a folder of
    its name in OUT_DIR; one that fails is named and does not stop the others.
    """
    plan = Plan(
        system=system,
        params=params,
        overrides=overrides,
        topics=topics,
        order=order,
        smooth=smooth,
        jobs=jobs if len(bags) == 1 else 1,
        overwrite=overwrite,
        strict=strict,
    )
    if len(bags) == 1:
        say_parameters(bags[0], plan, quiet=as_json)
        run = plan.track(bags[0], out_dir, quiet=as_json)
        print_json(run) if as_json else _print(run, out_dir)
        return
    runs, failures = {}, []
    for bag, folder, outcome in _of_each(plan, bags, out_dir, jobs):
        if isinstance(outcome, str):
            failures.append(outcome)
            click.echo(f'{bag}: {outcome}', err=True)
            continue
        runs[str(bag)] = outcome
        if not as_json:
            say_parameters(bag, plan)
            _print(outcome, folder)
    if as_json:
        print_json(runs)
    if failures:
        raise click.exceptions.Exit(1)


@frozen(kw_only=True)
class Plan:
    """What the options of the command ask for, for any bag."""

    system: str | None
    params: Path | None
    overrides: dict[str, str]
    topics: dict[str, str]
    order: str
    smooth: bool
    jobs: int
    overwrite: bool
    strict: bool

    @classmethod
    def of_defaults(cls) -> Plan:
        """What the command does without options."""
        return cls(
            system=None,
            params=None,
            overrides={},
            topics={},
            order='recorded',
            smooth=False,
            jobs=1,
            overwrite=False,
            strict=False,
        )

    def parameters_of(self, bag: Path) -> Path | None:
        """The parameter file for `bag`: the one that was named, else the bag's own."""
        from ..recordings.own_parameters import own_parameters

        return self.params if self.params is not None else own_parameters(bag)

    def track(self, bag: Path, out_dir: Path, *, quiet: bool) -> dict[str, Any]:
        """Track one bag; gives the content of run.json. Raises `BagError` and `ConfigError`."""
        from ..evaluation.tracking import InputOptions

        chosen = choose_system(bag, self.system, self.topics)
        params = self.parameters_of(bag)
        config, node = load_config(chosen, params, self.overrides)
        options = InputOptions(
            topics=inputs_by_topic(self.topics),
            order=self.order,
            frame_id=node.frame_id,
            world_frame=node.world_frame_convention,
            smooth=self.smooth,
            jobs=self.jobs,
            detector=load_detector(chosen, params, self.overrides),
        )
        return track_recording(
            bag,
            out_dir,
            chosen,
            config,
            options,
            overwrite=self.overwrite,
            strict=self.strict,
            quiet=quiet,
        )


def say_parameters(bag: Path, plan: Plan, *, quiet: bool = False) -> None:
    """Say where the parameters of `bag` come from, when that was not asked for."""
    if plan.params is None and (own := plan.parameters_of(bag)):
        say(f'using the parameters of the recording, {own}', quiet=quiet)


Outcome = dict[str, Any] | str
"""The content of run.json, or the sentence why there is none."""


def _of_each(
    plan: Plan, bags: Sequence[Path], out_dir: Path, jobs: int
) -> Iterator[tuple[Path, Path, Outcome]]:
    """Every bag with its folder and outcome, in the order of `bags`."""
    from ..evaluation.jobs import processes

    folders = [out_dir / bag.name.removesuffix('.bag').removesuffix('.mcap') for bag in bags]
    for folder in folders:
        if folders.count(folder) > 1:
            raise click.UsageError(f'two bags would be tracked into {folder}')
    if jobs == 1:
        for bag, folder in zip(bags, folders):
            yield bag, folder, _outcome(plan, bag, folder)
        return
    with processes(min(jobs, len(bags))) as pool:
        coming = [pool.submit(_outcome, plan, bag, folder) for bag, folder in zip(bags, folders)]
        for bag, folder, one in zip(bags, folders, coming):
            yield bag, folder, one.result()


def _outcome(plan: Plan, bag: Path, folder: Path) -> Outcome:
    from ..parameters import ConfigError
    from ..recordings.reader import BagError

    try:
        return plan.track(bag, folder, quiet=True)
    except (BagError, ConfigError) as error:
        return str(error)


def inputs_by_topic(topics: dict[str, str]) -> dict[str, str] | None:
    """``--topic`` as `recordings` takes it: input by topic name, None to choose by name."""
    return {topic: name for name, topic in topics.items()} or None


def choose_system(bag: Path, name: str | None, topics: dict[str, str]) -> System:
    """The tracker called `name`, or else the first one that finds its inputs in `bag`."""
    from ..recordings.measurements import fitting_topics
    from ..recordings.reader import BagError, BagReader

    if name is not None:
        return SYSTEMS[name]
    failures = []
    with BagReader(bag) as reader:
        for system in SYSTEMS.values():
            try:
                fitting_topics(reader, system.name, inputs_by_topic(topics))
                return system
            except BagError as error:
                failures.append(error)
    raise failures[0]


def track_recording(
    bag: Path,
    out_dir: Path,
    system: System,
    config: Any,
    options: Any,
    *,
    overwrite: bool = False,
    strict: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Track `bag` into `out_dir`; gives the content of run.json. Raises `BagError`."""
    from ..evaluation.run_folder import RunFolder
    from ..evaluation.tracking import OfflineRun, write_run
    from ..recordings.reader import BagReader

    with BagReader(bag, strict=strict) as reader:
        offline = OfflineRun(reader, system, config, options)
        folder = RunFolder(out_dir)
        folder.prepare(overwrite=overwrite)
        with progress('tracking', offline.total, quiet=quiet) as advance:
            return write_run(folder, offline, advance)


def _print(run: dict[str, Any], out_dir: Path) -> None:
    say(
        f'{run["messages"]} messages read, {run["estimates"]} estimates with {run["rows"]} rows '
        f'written to {out_dir}'
    )
    say('  ' + ', '.join(f'{name} {count}' for name, count in run['counts'].items()))
    for sentence in run['warnings']:
        say(f'  warning: {sentence}')
    for reason, entry in run['refused'].items():
        say(f'  refused ({reason}) {entry["count"]}: {entry["example"]}')
    for problem in run['problems']:
        say(f'  problem: {problem}')
    if run['rows'] == 0:
        say('  no track was made; sonar-imm info may show why')
