# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm tune``."""

from __future__ import annotations

import os
from pathlib import Path
import time
from typing import Any

from attrs import asdict
import click

from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import parameters_taken, print_json, progress, say, typed_overrides
from .track import Plan, say_parameters


# fmt: off
@click.command(
    epilog=opt.example('sonar-imm tune dive.bag --system diver',
        'sonar-imm tune dive1.bag dive2.bag --out tuned.yaml --jobs 2',
        'sonar-imm tune survey.bag --parameters range_std,detection_probability --json',
        'sonar-imm track dive.bag out --params tuned.yaml'))
@click.argument('bags', metavar='BAG...', nargs=-1, required=True, type=opt.PATH)
@opt.system
@click.option('--parameters', metavar='NAME,...',
    help='Parameters to fit; default: those that bags of the system can determine.')
@click.option('--out', type=opt.FILE,
    help='Write the parameters here, for `track --params` and the nodes.')
@opt.params(help='Parameter file to begin with: ROS 2 form or a plain mapping.')
@opt.overrides
@opt.topics
@opt.jobs(help='Processes that share the fits. The result does not depend on it.')
@opt.json
def command(
    bags: tuple[Path, ...], parameters: str | None, out: Path | None, jobs: int, as_json: bool,
    **options: Any,
) -> None:
    """Fit parameters to your own bags, by how well the tracker predicts each measurement from the
    earlier ones. No truth is needed.

    Prints each parameter with its interval, and whether the bags determine it. A parameter is
    determined if its fitted value also predicts the half of each bag that was not fitted better.
    All others keep their values.

    The file of --out holds the determined parameters and those that the fit began with (of
    --params, --set or parameters.yaml of the bag): `track --params` needs no other file. If no
    parameter is determined, it holds them unchanged, and the exit code is 0 as well.
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
    most = most_evaluations(fitting)
    say(
        f'{measurements} measurements; at most {most} runs of some '
        f'{time.perf_counter() - begin:.2g} s each, shared by {jobs}',
        quiet=as_json,
    )
    with progress('tuning', most, quiet=as_json) as advance:
        found = tune(fitting, measurements, processes_used=jobs, advance=advance)
    if out is not None:
        # Those of --params, --set and the bag's own file, then what was fitted.
        system, values = SYSTEMS[runs[0].system], found.values
        stated = parameters_taken(system, plan.parameters_of(bags[0]))
        stated |= typed_overrides(system.config_type(), plan.overrides)
        head = f'# Fitted by sonar-imm tune: {", ".join(values) or "no parameter"}.\n'
        if not values:  # as they are configured, without empty lists
            values = {t.name: getattr(fitting.jobs[0].config, t.name) for t in fitting.tunables}
            values = {name: value for name, value in values.items() if value != ()}
        write_ros_parameters(out, {'/**': {**stated, **values}}, head)
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
        if not row.determined:
            say(f'{row.name}: {row.verdict}, {row.reason}')
    if not found.values:
        data = 'this bag does' if len(bags) == 1 else 'these bags do'
        rest = 'they stay as they are' if out is None else f'{out} holds them unchanged'
        say(f'{data} not determine any of the parameters; {rest}')
    elif out is not None:
        say(f'written to {out}')
# fmt: on
