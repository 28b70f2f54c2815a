"""Benches: what ``sonar-imm bench`` measures, each system its own.

A module named in `BENCHES` provides ``BENCHES``, a tuple of `Bench`. How long a live node takes is
measured for every system alike, by the command.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from attrs import frozen

BENCHES = {
    'bathymetry': 'sonar_imm.evaluation.bathymetry.bench',
    'diver': 'sonar_imm.evaluation.diver.bench',
    'fathometer': 'sonar_imm.evaluation.fathometer.bench',
    'obstacle': 'sonar_imm.evaluation.obstacle.bench',
}
"""Module by system. A new system adds its line here."""


@frozen
class Bench:
    """One measurement of speed.

    name: its key in the JSON. measure: takes the number of rounds, for what is measured in turn
    with another program, and gives plain numbers, with ``good`` where there is a goal; raises
    ModuleNotFoundError when that program is not installed. sentence: the numbers for people.
    """

    name: str
    measure: Callable[[int], dict[str, Any]]
    sentence: Callable[[dict[str, Any]], str]


def benches_of(system: str) -> tuple[Bench, ...]:
    """What is measured of one system."""
    return import_module(BENCHES[system]).BENCHES
