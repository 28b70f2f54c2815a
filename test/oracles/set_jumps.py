# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter for sets whose members jump together, by sums over all sets of a small lattice."""

from __future__ import annotations

from itertools import combinations, product
import math
from typing import NamedTuple

import numpy as np

from oracles.set_particles import weigh
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.set_model import SetModel, Sets

State = tuple[tuple[int, int], ...]
"""Cells and signs of the members of a set, ascending."""


class Exact(NamedTuple):
    """pmf (T, orders), intensity (T, n), log_evidence (T,); jump (T, 2): probability that members
    jumped, and mean jump."""

    pmf: FloatArray
    intensity: FloatArray
    log_evidence: FloatArray
    jump: FloatArray


def every_set(model: SetModel) -> list[State]:
    found: list[State] = []
    for order in range(model.order_min, model.order_max + 1):
        for cells in combinations(range(model.cells), order):
            if all(b - a >= model.separation for a, b in zip(cells, cells[1:])):
                found += [tuple(zip(cells, s)) for s in product(model.signs, repeat=order)]
    return found


def jumps(model: SetModel) -> dict[int, float]:
    """Probability of each jump, in cells."""
    if model.jump is None:
        return {0: 1.0}
    places = model.jump.step * np.arange(-model.jump.reach, model.jump.reach + 1)
    density = np.exp(-0.5 * np.square(places / model.jump.std))
    chance = model.jump.probability * density / density.sum()
    chance[model.jump.reach] += 1.0 - model.jump.probability
    return dict(zip(places.tolist(), chance.tolist()))


def transitions(model: SetModel, states: list[State]) -> dict[int, FloatArray]:
    """For each jump, the probabilities (K, K) of the ways from set to set, with it. Those that
    lead to no possible set are missing."""
    number = {state: k for k, state in enumerate(states)}
    found = {d: np.zeros((len(states), len(states))) for d in jumps(model)}
    radius = len(model.walk) // 2
    for i, state in enumerate(states):
        for order, p in enumerate(
            model.transition[len(state) - model.order_min], start=model.order_min
        ):
            stay = min(order, len(state))
            for left in combinations(state, stay):
                chance = p / math.comb(len(state), stay)
                for d, q in jumps(model).items():
                    if not all(0 <= z + d < model.cells for z, _ in left):
                        continue
                    for steps in product(range(2 * radius + 1), repeat=stay):
                        walked = [(z + d + w - radius, s) for (z, s), w in zip(left, steps)]
                        paid = chance * q * math.prod(float(model.walk[w]) for w in steps)
                        _born(model, walked, order, paid, found[d][i], number)
    return found


def _born(
    model: SetModel,
    members: list[tuple[int, int]],
    order: int,
    chance: float,
    row: FloatArray,
    number: dict[State, int],
) -> None:
    if len(members) == order:
        k = number.get(tuple(sorted(members)))
        if k is not None:
            row[k] += chance
        return
    for z, (sign, p) in product(range(model.cells), model.signs.items()):
        _born(model, [*members, (z, sign)], order, chance * p / model.cells, row, number)


def exact(model: SetModel, records: FloatArray) -> Exact:
    states = every_set(model)
    orders = np.array([len(state) - model.order_min for state in states])
    sets = Sets.empty(model, len(states))
    there = np.zeros((len(states), model.cells))
    p = np.zeros(len(states))
    for k, state in enumerate(states):
        sets.order[k] = len(state)
        p[k] = model.start[orders[k]] / model.room(len(state))
        for j, (z, sign) in enumerate(state):
            sets.cell[k, j], sets.sign[k, j] = z, sign
            there[k, z] = 1.0
            p[k] *= model.signs[sign]
    ways, rows = transitions(model, states), []
    for b in records:
        likelihood = np.exp(weigh(model, b, sets)[0])
        by_jump = {d: (p @ way) * likelihood for d, way in ways.items()}
        p = np.sum(list(by_jump.values()), axis=0)
        total = float(p.sum())
        p /= total
        mass = {d: float(each.sum()) / total for d, each in by_jump.items()}
        rows.append(
            (
                np.bincount(orders, p, len(model.transition)),
                p @ there,
                math.log(total),
                (1.0 - mass[0], sum(d * each for d, each in mass.items())),
            )
        )
    return Exact(*(np.array(column) for column in zip(*rows)))
