# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Speed: what ``sonar-imm bench`` measures, beside other programs in the same run.

    sonar-imm bench diver --rounds 5

Each system has a module here with ``BENCHES``, a tuple of `Bench`. Times depend on the machine and
its load; the ratio of two programs measured in turn hardly does. How long a live node takes is
measured for every system alike, by the command.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
import time
from typing import Any

from attrs import frozen

from sonar_imm.threads import one_blas_thread

one_blas_thread()  # before numpy is imported, as nodes and commands do

from sonar_imm_tools.evaluation.numbers import flatten  # noqa: E402

PEERS = ('filterpy',)
"""Libraries that a bench may need to compare with."""


@frozen
class Bench:
    """One measurement of speed.

    name: its key in the JSON. measure: takes the number of rounds, for what is measured in turn
    with another program, and gives plain numbers, with ``good`` where there is a goal; raises
    ModuleNotFoundError when that program is not installed.
    """

    name: str
    measure: Callable[[int], dict[str, Any]]


def sentence(bench: Bench, result: dict[str, Any]) -> str:
    """The numbers of a bench in one line."""
    numbers = (
        f'{name} {value:.4g}' if isinstance(value, float) else f'{name} {value}'
        for name, value in flatten(result).items()
    )
    return f'{bench.name}: {", ".join(numbers)}'


def seconds_of(function: Callable[..., Any], *arguments: Any) -> float:
    """Seconds that one call takes."""
    begin = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - begin


def benches_of(system: str) -> tuple[Bench, ...]:
    """What is measured of one system."""
    found: tuple[Bench, ...] = import_module(f'{__name__}.{system}').BENCHES
    return found
