# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``python -m helpers.hostile``: hostile messages, extreme parameters and damaged files, many, and
what they did.

Run by ``make fuzz``; prints one line per system and writes the numbers as JSON. Exit code 1 when
something got through.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
import itertools
import json
from pathlib import Path
import resource
import sys
from time import process_time
import traceback
import warnings

from hypothesis import given, HealthCheck, Phase, seed, settings
import numpy as np

from sonar_imm.trackers import SYSTEMS

from .files import file_results, FILES, RECORDED, state_results
from .runs import BATCH, batches, run, run_extreme, Tally

ROOT = Path(__file__).parents[3]
AT_ONCE = 1000
"""Damaged states that one process tries before another one may."""
MOST_EXAMPLES = 500
"""Batches of one search of hypothesis, which remembers those it has tried."""


def messages(system, cases):
    """Send `cases` hostile messages or more; what happened, as plain values."""
    tally, failures, start, grown = Tally(), [], process_time(), 0.0
    for number in itertools.count():
        wanted = min(MOST_EXAMPLES, -(-(cases - tally.cases) // BATCH))

        @seed(number)
        @settings(
            max_examples=wanted, deadline=None, database=None,
            phases=[Phase.generate, Phase.shrink], suppress_health_check=[*HealthCheck],
        )  # fmt: skip
        @given(batch=batches(system))
        def search(batch):
            run(system, batch, tally)

        try:
            search()
        except BaseException as error:  # groups of several failures too
            failures.append(_text_of(error))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        grown = grown or peak
        if tally.cases >= cases or len(failures) == 5:
            break
    slow = 1e3 * np.sort(tally.seconds)
    return {
        'cases': tally.cases, 'read': tally.read, 'refused': dict(tally.refused.most_common()),
        'refused_by_the_tracker': dict(tally.counted.most_common()), 'estimates': tally.estimates,
        'failures': failures, 'ms_median': round(float(np.median(slow)), 3),
        'ms_p999': round(float(slow[int(0.999 * len(slow))]), 1),
        'ms_most': round(float(slow[-1]), 1), 'memory_grown_mb': round(peak - grown, 1),
        'cpu_seconds': round(process_time() - start, 1),
    }  # fmt: skip


def parameters(system, draws):
    """Run `draws` extreme configurations."""
    failures, start, found = [], process_time(), []
    for number in range(draws):
        try:
            found.append(run_extreme(system, number))
        except Exception as error:
            failures.append(_text_of(error))
    ran = [count for count in found if count is not None]
    return {
        'draws': draws, 'ran': len(ran), 'estimates': sum(ran), 'failures': failures,
        'cpu_seconds': round(process_time() - start, 1),
    }  # fmt: skip


def _text_of(error):
    lines = traceback.format_exception(type(error), error, error.__traceback__)
    return ''.join(lines).replace(f'{ROOT}/', '')[-3000:]


def _all(system, cases, draws):
    warnings.simplefilter('error')
    return {'messages': messages(system, cases), 'parameters': parameters(system, draws)}


def main():
    parser = argparse.ArgumentParser(prog='python -m helpers.hostile', description=__doc__)
    parser.add_argument('--cases', type=int, default=100_000, help='messages for each system')
    parser.add_argument('--draws', type=int, default=300, help='configurations for each system')
    parser.add_argument('--files', type=int, default=0, help='damaged files of each kind')
    parser.add_argument('--states', type=int, default=0, help='damaged states of each system')
    parser.add_argument('--systems', nargs='*', default=list(SYSTEMS), choices=list(SYSTEMS))
    parser.add_argument('--jobs', type=int, default=2)
    parser.add_argument('--json', type=Path, help='write the numbers here')
    given = parser.parse_args()
    with ProcessPoolExecutor(given.jobs) as pool:
        coming = {
            system: pool.submit(_all, system, given.cases, given.draws) for system in given.systems
        }
        files = [pool.submit(file_results, name, given.files) for name in FILES if given.files]
        for first, name in itertools.product(range(0, given.states, AT_ONCE), RECORDED):
            share = min(AT_ONCE, given.states - first)
            files.append(pool.submit(state_results, name, share, first))
        results = {system: item.result() for system, item in coming.items()}
        damaged = [item.result() for item in files]
    failures = []
    for system, result in results.items():
        hostile, extreme = result['messages'], result['parameters']
        sent = '{cases} messages, {read} read, {estimates} estimates, slowest {ms_most} ms'
        print(f'{system}: {sent.format(**hostile)}; {extreme["ran"]} configurations')
        failures += hostile['failures'] + extreme['failures']
    for tried in damaged:
        print('{name}: {draws} damaged, {used} used, {cpu_seconds} s'.format(**tried))
        failures += tried['failures']
    print(*failures, sep='\n')
    if given.json:
        given.json.write_text(json.dumps(results, indent=1) + '\n')
    return int(bool(failures))


if __name__ == '__main__':
    sys.exit(main())
