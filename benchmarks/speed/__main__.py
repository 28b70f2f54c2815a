# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The cost of a step of each tracker, as a file of results: what `sonar-imm bench` measures.

python -m benchmarks.speed --out docs/results/speed.json
"""

from __future__ import annotations

import os

from benchmarks.speed import benches_of
from benchmarks.study import Parts, study

STEPS = ('diver step', 'diver clutter', 'obstacle ping', 'bathymetry numpy', 'fathometer record')
"""System and name of the benches that the page on speed shows."""


def main(rounds: int = 7, steps: tuple[str, ...] = STEPS) -> Parts:
    yield {'rounds': rounds, 'load': os.getloadavg()[0], 'processors': os.cpu_count()}
    for step in steps:
        system, name = step.split()
        (bench,) = (bench for bench in benches_of(system) if bench.name == name)
        yield {'steps': {step: bench.measure(rounds)}}


if __name__ == '__main__':
    study(main)
