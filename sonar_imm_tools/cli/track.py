# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm track``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
import contextlib
from pathlib import Path
from typing import Any, TYPE_CHECKING

from attrs import evolve, field, frozen
import click

from sonar_imm.trackers import System, SYSTEMS

from . import options as opt
from .common import load_config, load_detector, parameters_taken, print_json, progress, say, warn

if TYPE_CHECKING:
    from sonar_imm.acoustics.geodesy import Origin

    from ..offline.batch import Job, Outcome
    from ..offline.initial import Initial
    from ..recordings.own_files import OwnParameters
    from ..recordings.reader import BagReader


def _shard(_ctx: Any, _param: Any, value: str | None) -> tuple[int, int] | None:
    if value is None:
        return None
    numbers = value.split('/')
    if len(numbers) == 2 and all(number.isdecimal() for number in numbers):
        share, count = map(int, numbers)
        if 1 <= share <= count:
            return share, count
    raise click.BadParameter(f"'{value}' is not of the form I/N with 1 <= I <= N")


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm track dive.bag out',
        'sonar-imm track dive.bag out --set model_set=heading_speed',
        'sonar-imm track dive.bag out --topic fix=/usbl/pose --params my_diver.yaml',
        'sonar-imm track line1.bag line2.bag line3.bag out --jobs 3 --parquet',
        'sonar-imm track /survey/*.bag /survey/out --scheduler tcp://10.0.0.5:8786',
        'sonar-imm track /survey/*.bag /survey/out --shard '
        '$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT'))
@click.argument('bags', metavar='BAG...', nargs=-1, type=opt.PATH)
@click.argument('out_dir', metavar='OUT_DIR', required=False, type=opt.PATH)
@opt.system
@opt.params(help='Parameter file: ROS 2 form or a plain mapping.')
@opt.overrides
@opt.topics
@click.option('--order', type=click.Choice(['recorded', 'stamp']), default='recorded',
    show_default=True, help='Messages in the order of arrival, or sorted by their stamps.')
@click.option('--sound-speed', type=opt.PATH, metavar='FILE',
    help='Profile of sound speed (CARIS .svp, Kongsberg .asvp, Sea-Bird .cnv, CSV): rays of '
    'bathymetry bend by it, other systems take its mean.')
@click.option('--initial', metavar='FILE', type=opt.PATH,
    help='Where divers are at first, as the topic initial says it: YAML or JSON with position and '
    'covariance, and if wanted name, time, frame_id.')
@click.option('--smooth', is_flag=True, help='Condition each estimate on later measurements too.')
@opt.jobs(
    help='Processes: for several runs, or for the pings of one where no ping needs another '
    '(bathymetry). The estimates do not depend on it.')
@click.option('--scheduler', metavar='ADDRESS',
    help='Do the runs on the cluster of this dask scheduler instead; its workers need the same '
    'sonar_imm, and reach BAG and OUT_DIR by the same paths.')
@click.option('--shard', metavar='I/N', callback=_shard,
    help='Only the I-th share of N of the bags, in the order of their paths: every N-th from the '
    'I-th, as one of N commands that know nothing of each other, such as a Slurm array.')
@click.option('--parquet', is_flag=True,
    help='Write the tables as Parquet in place of CSV, a fifth of the bytes, and bins that have '
    'soundings into the table alone; needs pyarrow.')
@click.option('--no-table', is_flag=True, help='Write no tables: the bag has all of it.')
@click.option('--overwrite', is_flag=True, help='Replace an earlier run in OUT_DIR.')
@click.option('--strict', is_flag=True, help='Stop at the first damage in BAG.')
@opt.json
def command(
    bags: tuple[Path, ...], out_dir: Path | None, jobs: int, scheduler: str | None,
    shard: tuple[int, int] | None, parquet: bool, no_table: bool, as_json: bool, **options: Any,
) -> None:
    """Track the recording BAG offline and write the estimates to OUT_DIR.

    OUT_DIR gets the bag `estimate`, `estimate.csv` and `run.json`; the exit code is 1 if no
    measurement was used. The same command writes the same bytes in bag and tables. Without
    --params the file `parameters.yaml` in the folder of BAG is used, if there is one. --set
    changes single parameters.

    Several sonars in one BAG that each need a tracker (two topics `snapshot`, say) are all
    tracked, each into a folder of OUT_DIR named after its namespace; --topic chooses one. Of
    several bags each gets a folder of its name. Then OUT_DIR also gets `summary.json`; a run that
    fails is named and does not stop the others, and the same command again makes only what is
    missing. With --shard I/N the list is `summary-I-of-N.json`.
    """
    if out_dir is None:
        raise click.UsageError("Missing argument 'BAG...'")
    if not bags:  # of one word only click takes it for the last argument
        raise click.UsageError(f"Missing argument 'OUT_DIR': where the estimates of {out_dir} go")
    if scheduler is not None and jobs > 1:
        raise click.UsageError('--jobs and --scheduler exclude each other')
    if parquet and no_table:
        raise click.UsageError('--parquet and --no-table exclude each other')
    from ..offline import run_folder as results

    if parquet:
        results.require_parquet()
    tables = results.NO_TABLE if no_table else results.AS_CSV
    tables = results.AS_PARQUET if parquet else tables
    plan = Plan(tables=tables, **options)
    if len(bags) == 1 and shard is None:
        runs = plan.jobs(bags[0], out_dir, lambda sentence: say(sentence, quiet=as_json))
        say_parameters(bags[0], plan, quiet=as_json)
        if len(runs) == 1 and scheduler is None:
            run = track_one(evolve(runs[0], options=evolve(runs[0].options, jobs=jobs)), as_json)
            useless = not run['estimates'] and not run['counts'].get('used', 0)
            print_json(run) if as_json else _print(run, out_dir, useless)
            if useless:
                raise click.exceptions.Exit(1)
            return
        failures: list[Outcome] = []
    else:
        runs, failures = _of_all(plan, bags, out_dir, shard or (1, 1))
    summary = results.SUMMARY if shard is None else results.SHARD_SUMMARY.format(*shard)
    _track_all(runs, failures, out_dir, summary, jobs, scheduler, as_json)
# fmt: on


@frozen(kw_only=True)
class Plan:
    """What the options of the command ask for, for any bag."""

    system: str | None = None
    params: Path | None = None
    overrides: dict[str, str] = field(factory=dict)
    topics: dict[str, str] = field(factory=dict)
    order: str = 'recorded'
    smooth: bool = False
    initial: Path | None = None
    overwrite: bool = False
    strict: bool = False
    tables: str = 'csv'
    sound_speed: Path | None = None

    def _overrides(self, system: System) -> dict[str, str]:
        """Return the parameters that the options of the command set. Raises `BagError`."""
        if self.sound_speed is None:
            return self.overrides
        from ..recordings.sound_speed import mean_speed, read_profile

        profile = read_profile(self.sound_speed)
        pairs = [f'{value:.3f}' for pair in zip(*profile) for value in pair]
        water = {'sound_speed': f'{mean_speed(profile):.3f}'}
        if any(spec.name == 'sound_speed_profile' for spec in system.config_type().specs()):
            water = {'sound_speed_profile': f'[{", ".join(pairs)}]'}
        return {**water, **self.overrides}

    def parameters_of(self, bag: Path) -> Path | OwnParameters | None:
        """The parameter file for `bag`: the one that was named, else the bag's own."""
        from ..recordings.own_files import own_parameters

        return self.params if self.params is not None else own_parameters(bag)

    def _origin(self, bag: Path, system: System) -> Origin | None:
        """Where the frame of a recording lies on Earth by its own file, which counts beside
        --params where it is only exported."""
        from sonar_imm.node_config import node_config_type

        from ..recordings.own_files import own_parameters

        node = node_config_type(system)
        if all(spec.name != 'origin' for spec in node.specs()):  # a parameter of the tracker
            return None
        taken = parameters_taken(system, own_parameters(bag))
        return node.from_mapping({k: taken[k] for k in ('origin',) if k in taken}).stated_origin()

    def jobs(
        self, bag: Path, folder: Path, note: Callable[[str], object] = lambda sentence: None
    ) -> list[Job]:
        """The runs that one bag takes: one into `folder`, or, of several instruments, one each
        into a folder below it. note: is told which topics are taken for what. Raises `BagError`
        and `ConfigError`."""
        from ..offline.batch import Job
        from ..offline.tracking import InputOptions
        from ..recordings.measurements import instruments, remarks_on_topics
        from ..recordings.reader import BagReader

        # Input by topic name; None to choose by name.
        wanted = {topic: name for name, topic in self.topics.items()} or None
        with BagReader(bag, strict=self.strict) as reader:
            system = choose_system(reader, self.system, wanted)
            found = instruments(reader, system.name, wanted)
            for sentence in remarks_on_topics(reader, system.name, found):
                note(sentence)
        params = self.parameters_of(bag)
        overrides = self._overrides(system)
        config, node = load_config(system, params, overrides)
        origin = node.stated_origin() or self._origin(bag, system)
        places = self._initial(system)
        detector = load_detector(system, params, overrides)
        several = len(found) > 1
        return [
            Job(
                bag=bag,
                folder=folder / name,
                instrument=name,
                system=system.name,
                config=config,
                options=InputOptions(
                    topics={t: entry.name for t, entry in inputs.items()} if several else wanted,
                    order=self.order,
                    frame_id=node.frame_id,
                    world_frame=node.world_frame_convention,
                    origin=origin,
                    smooth=self.smooth,
                    initial=places,
                    detector=detector,
                ),
                overwrite=self.overwrite,
                strict=self.strict,
                tables=self.tables,
            )
            for name, inputs in found.items()
        ]

    def _initial(self, system: System) -> tuple[Initial, ...]:
        """The places of `--initial`. Raises `ConfigError`."""
        if self.initial is None:
            return ()
        from sonar_imm.parameters import ConfigError

        from ..offline.initial import read_initial

        if system.name != 'diver':
            raise ConfigError(f'--initial is for divers; this is tracked by {system.name}')
        return read_initial(self.initial)


def say_parameters(bag: Path, plan: Plan, *, quiet: bool = False) -> None:
    """Say whether the parameters beside `bag`, for which nobody asked, are used."""
    if own := evolve(plan, params=None).parameters_of(bag):
        used = 'using' if plan.params is None else '--params is used in place of'
        say(f'{used} the parameters of the recording, {own}', quiet=quiet)


def _of_all(
    plan: Plan, bags: Sequence[Path], out_dir: Path, shard: tuple[int, int]
) -> tuple[list[Job], list[Outcome]]:
    """The runs of a share of `bags`, in the order of their paths, and what cannot be a run."""
    from sonar_imm.parameters import ConfigError

    from ..offline.batch import Outcome
    from ..recordings.reader import BagError

    bags = sorted(bags)
    folders = [out_dir / bag.name.removesuffix('.bag').removesuffix('.mcap') for bag in bags]
    for folder in folders:
        if folders.count(folder) > 1:
            raise click.UsageError(f'two bags would be tracked into {folder}')
    runs: list[Job] = []
    failures = []
    share, count = shard
    for bag, folder in list(zip(bags, folders))[share - 1 :: count]:
        try:
            runs += plan.jobs(bag, folder)
        except (BagError, ConfigError) as error:
            failures.append(Outcome(bag=bag, folder=folder, failure=str(error)))
    return runs, failures


def _track_all(
    runs: Sequence[Job],
    failures: Sequence[Outcome],
    out_dir: Path,
    summary: str,
    jobs: int,
    scheduler: str | None,
    as_json: bool,
) -> None:
    """Do all runs, write and print their summary; ends with 1 when one failed."""
    from ..offline.batch import check_summary, run_jobs, summary_of
    from ..offline.run_folder import RUN, RunFolder
    from ..recordings.reader import BagError

    if (out_dir / RUN).exists() and runs and runs[0].folder != out_dir:
        raise BagError(f'{out_dir} holds a run itself; choose another folder for several')
    check_summary(out_dir, summary)
    outcomes = list(failures)
    for outcome in failures:
        warn(f'{outcome.bag}: {outcome.failure}')
    todo = [evolve(job, resume=True) for job in runs]
    if scheduler is not None:
        todo = [evolve(job, bag=job.bag.resolve(), folder=job.folder.resolve()) for job in todo]
    with progress('runs', len(runs), quiet=as_json) as advance:
        for outcome in run_jobs(todo, count=jobs, address=scheduler, note=warn):
            if outcome.failure:
                name = ' '.join(filter(None, (str(outcome.bag), outcome.instrument)))
                warn(f'{name}: {outcome.failure}')
            outcomes.append(outcome)
            advance(1)
    outcomes.sort(key=lambda item: (str(item.bag), item.instrument))
    content = summary_of(out_dir, outcomes, summary)
    RunFolder(out_dir).write_json(summary, content)
    print_json(content) if as_json else _print_summary(content, out_dir)
    if any(outcome.failure for outcome in outcomes):
        raise click.exceptions.Exit(1)


def choose_system(
    reader: BagReader, name: str | None, topics: Mapping[str, str] | None = None
) -> System:
    """The tracker called `name`, or else the one that fits an open recording best. Raises
    `BagError` when none does."""
    from ..recordings.measurements import (
        fitting_systems,
        instruments,
        knows_inputs,
        system_in_mind,
    )

    if name is not None:
        return SYSTEMS[name]
    found = fitting_systems(reader, topics)
    if not found:
        # Whose inputs were named, or whose recording it is, says what is there.
        inputs = {*(topics or {}).values()}
        meant = [system for system in SYSTEMS if inputs and knows_inputs(system, inputs)]
        fits = fitting_systems(reader)
        both = [system for system in fits if system in meant]
        best = both or meant or fits or [system_in_mind(reader)]
        instruments(reader, best[0], topics)
    return SYSTEMS[found[0]]


def track_one(job: Job, quiet: bool = False) -> dict[str, Any]:
    """Do one run with a progress bar; gives the content of run.json. Raises `BagError`."""
    from ..offline.batch import track

    with contextlib.ExitStack() as stack:

        def begin(total: int) -> Callable[[int], None]:
            bar = progress('tracking', total, quiet=quiet, first='loading kernels')
            return stack.enter_context(bar)

        outcome = track(job, begin)
    return dict(outcome.run or {})


def _print(run: Mapping[str, Any], out_dir: Path, useless: bool) -> None:
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
    say(
        f'  {run["bag_bytes"] * 1e-6:.3g} MB read at {run["timings"]["mb_per_s"]:.3g} MB/s, '
        f'{run["written_bytes"] * 1e-6:.3g} MB written'
    )
    if useless:
        say('  no measurement was used')
    if run['rows'] == 0:
        say('  no track was made; sonar-imm info may show why')


def _print_summary(content: Mapping[str, Any], out_dir: Path) -> None:
    """One line for each run, then what deserves a look."""
    runs = content['runs']
    width = max((len(run['folder']) for run in runs), default=0)
    width = max(width, len('run'))
    heads = ('messages', 'refused', 'estimates', 'rows')
    say(f'{"run":<{width}} {"state":<8} {"system":<11}' + ''.join(f'{n:>10}' for n in heads))
    for run in runs:
        numbers = ''.join(f'{run[name]:>10}' for name in heads)
        say(f'{run["folder"]:<{width}} {run["state"]:<8} {run["system"]:<11}{numbers}')
    for run in runs:
        for kind in ('warning', 'problem'):
            for sentence in run[f'{kind}s']:
                say(f'{run["folder"]}: {kind}: {sentence}')
        if run['state'] != 'failed' and run['rows'] == 0:
            say(f'{run["folder"]}: no track was made; sonar-imm info may show why')
    counts = Counter(run['state'] for run in runs)
    summary = ', '.join(f'{counts[state]} {state}' for state in ('tracked', 'kept', 'failed'))
    say(f'{len(runs)} runs in {out_dir}: {summary}')
