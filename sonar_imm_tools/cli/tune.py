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

"""``sonar-imm tune``."""

from __future__ import annotations

import os
from pathlib import Path
import time
from typing import Any

from attrs import asdict
import click

from .common import (
    BAG,
    example,
    json_option,
    params_option,
    print_json,
    progress,
    say,
    set_option,
    system_option,
    topic_option,
)
from .track import Plan, say_parameters


@click.command(
    epilog=example(
        'sonar-imm tune dive.bag --system diver',
        'sonar-imm tune dive1.bag dive2.bag --out tuned.yaml --jobs 2',
        'sonar-imm tune survey.bag --parameters range_std,detection_probability --json',
        'sonar-imm track dive.bag out --params tuned.yaml',
    )
)
@click.argument('bags', metavar='BAG...', nargs=-1, required=True, type=BAG)
@system_option
@click.option(
    '--parameters',
    metavar='NAME,...',
    help='What to fit; by default what recordings of the system can tell.',
)
@click.option(
    '--out',
    type=click.Path(path_type=Path, dir_okay=False),
    help='Write the parameters here, for `track --params` and the nodes.',
)
@params_option('Parameter file to begin with: ROS 2 form or a plain mapping.')
@set_option
@topic_option
@click.option(
    '--jobs',
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help='Processes that share the fits. The result does not depend on it.',
)
@json_option
def command(
    bags: tuple[Path, ...],
    parameters: str | None,
    out: Path | None,
    jobs: int,
    as_json: bool,
    **options: Any,
) -> None:
    """Fit parameters to your own recordings, by how well the tracker predicts each measurement
    from those before it. No truth is needed.

    Says of each parameter what it is, between which bounds, or that the recording cannot tell it
    (flat): then it stays as it is. What the fit is worth is measured on the half of each recording
    that it has not seen, both ways round. Where nothing is gained, nothing is written.

    The file of --out has what was told, and the parameters that the fit began with (of --params,
    --set or the recording's own parameters.yaml), so that `track --params` needs no other.
    """
    from ..evaluation.tuning import most_evaluations, prepared, tune
    from ..recordings.own_files import PARAMETERS, write_ros_parameters

    plan = Plan(**options)
    for bag in bags:
        place = Path(os.path.realpath(out)) if out is not None and out.exists() else None
        if place and place.is_relative_to(os.path.realpath(bag)) and place.name != PARAMETERS:
            raise click.UsageError(f'{out} is in the recording {bag}, which stays as it is')
        say_parameters(bag, plan, quiet=as_json)
    runs = [job for bag in sorted(bags) for job in plan.jobs(bag, Path())]
    if len({job.system for job in runs}) > 1:
        raise click.UsageError('the recordings fit different trackers: say --system')
    names = [name.strip() for name in (parameters or '').split(',') if name.strip()]
    fitting, measurements = prepared(runs, names)
    begin = time.perf_counter()
    fitting.scores(None)
    most = most_evaluations(len(fitting.tunables))
    say(
        f'{measurements} measurements; at most {most} runs of some '
        f'{time.perf_counter() - begin:.2g} s each, shared by {jobs}',
        quiet=as_json,
    )
    with progress('tuning', most, quiet=as_json) as advance:
        found = tune(fitting, measurements, processes_used=jobs, advance=advance)
    if out is not None and found.values:
        stated = _begun_with(plan, bags[0], runs[0].system)
        head = f'# Fitted by sonar-imm tune: {", ".join(found.values)}.\n'
        write_ros_parameters(out, {'/**': {**stated, **found.values}}, head)
    if as_json:
        content = asdict(found)
        del content['values'], content['measurements']
        print_json(content)
        return
    width = max(len(row.name) for row in found.parameters)
    say(f'{"parameter":<{width}} {"before":>10} {"after":>10} {"low":>10} {"high":>10}  verdict')
    for row in found.parameters:
        numbers = (row.before, row.after, row.low, row.high)
        cells = ' '.join(f'{"-" if v is None else f"{v:.4g}":>10}' for v in numbers)
        say(f'{row.name:<{width}} {cells}  {row.verdict}')
    say(
        f'log likelihood {found.log_likelihood_before:.1f} before, '
        f'{found.log_likelihood_after:.1f} after; held out {found.held_out_gain:+.4f} per '
        f'measurement; {found.evaluations} evaluations'
    )
    for row in found.parameters:
        if row.verdict == 'flat':
            say(f'{row.name}: flat, {row.reason}')
    if not any(row.verdict == 'told' for row in found.parameters):
        say('nothing is told: the parameters stay as they are, and nothing is written')
    elif not found.values:
        say('held out, the fit predicts no better: keep the parameters; nothing is written')
    elif out is not None:
        say(f'written to {out}')


def _begun_with(plan: Plan, bag: Path, system: str) -> dict[str, Any]:
    """What --params, --set and the recording's own file state."""
    from sonar_imm.trackers import SYSTEMS

    from .common import parameters_taken, typed_overrides

    stated = parameters_taken(SYSTEMS[system], plan.parameters_of(bag))
    return {**stated, **typed_overrides(SYSTEMS[system].config_type(), plan.overrides)}
