"""``sonar-imm track``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    )
)
@click.argument('bag', type=BAG)
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
@click.option('--overwrite', is_flag=True, help='Replace an earlier run in OUT_DIR.')
@click.option('--strict', is_flag=True, help='Stop at the first damage in BAG.')
@json_option
def command(
    bag: Path,
    out_dir: Path,
    system: str | None,
    params: Path | None,
    overrides: dict[str, str],
    topics: dict[str, str],
    order: str,
    smooth: bool,
    overwrite: bool,
    strict: bool,
    as_json: bool,
) -> None:
    """Track the recording BAG offline and write the estimates to OUT_DIR.

    OUT_DIR gets the bag `estimate`, `estimate.csv` and `run.json`. The same command writes the
    same bytes in bag and CSV. Without --params the file `parameters.yaml` in the folder of BAG is
    used, if there is one. --set changes single parameters.
    """
    from ..evaluation.tracking import InputOptions
    from ..recordings.own_parameters import own_parameters

    if params is None and (params := own_parameters(bag)) and not as_json:
        say(f'using the parameters of the recording, {params}')
    chosen = choose_system(bag, system, topics)
    config, node = load_config(chosen, params, overrides)
    options = InputOptions(
        topics=inputs_by_topic(topics),
        order=order,
        frame_id=node.frame_id,
        world_frame=node.world_frame_convention,
        smooth=smooth,
        detector=load_detector(chosen, params, overrides),
    )
    run = track_recording(
        bag, out_dir, chosen, config, options, overwrite=overwrite, strict=strict, quiet=as_json
    )
    print_json(run) if as_json else _print(run, out_dir)


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
