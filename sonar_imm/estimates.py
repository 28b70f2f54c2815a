# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a tracker gives out: one shape for all four systems, a table with one row a target, range
bin or reflector."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import dropwhile, takewhile
from typing import Any

from attrs import field, frozen
import numpy as np
from numpy.typing import NDArray

PLACES = ('px', 'py', 'pz')
"""The columns of places in float64, m; millimetres at any map coordinates."""


def places(xyz: NDArray[np.floating[Any]]) -> dict[str, NDArray[np.float64]]:
    """The columns `PLACES` of places (n, 3)."""
    return dict(zip(PLACES, np.asarray(xyz, np.float64).T))


def model_columns(names: Iterable[str]) -> tuple[str, ...]:
    """Of the columns of an estimate those of its models: the first that begin with ``prob_`` and
    stand side by side. Later ones are further columns, of probabilities of something else."""
    from_first = dropwhile(lambda name: not name.startswith('prob_'), names)
    return tuple(takewhile(lambda name: name.startswith('prob_'), from_first))


def _exact(columns: Mapping[str, NDArray]) -> tuple[str, ...]:
    """The names of the columns that say best where something is."""
    return PLACES if all(name in columns for name in PLACES) else tuple('xyz')


@frozen(eq=False, kw_only=True)
class Estimate:
    """Everything known at one stamp.

    xyz: (rows, 3) where it is. Published as ``x y z`` in float32, which displays draw and which at
    a northing of 9e6 m is half a metre coarse, and, by systems that state places, as ``px py pz``
    in float64: see `places`.
    state: (rows, n) in the order of `state_names`; covariance: (rows, n, n).
    probabilities: (rows, models) in the order of `model_names`, each row sums to one.
    extras: further columns, each (rows,), dtypes as published.
    """

    stamp_ns: int
    frame_id: str
    xyz: NDArray[np.floating[Any]]
    state_names: tuple[str, ...]
    state: NDArray[np.float64]
    covariance: NDArray[np.float64]
    model_names: tuple[str, ...] = ()
    probabilities: NDArray[np.float64] = field(factory=lambda: np.empty((0, 0)))
    extras: Mapping[str, NDArray] = field(factory=dict)

    @property
    def source(self) -> int:
        """Which of several instruments it comes from, by the column ``side``; 0 for the only one.
        Estimates of one stamp and several sources stand side by side."""
        side = self.extras.get('side')
        return int(side[0]) if side is not None and len(side) else 0

    def __len__(self) -> int:
        return len(self.state)

    def columns(self) -> dict[str, NDArray]:
        """The columns of ``~/estimate`` in the order of the contract: x y z, states, cov_<a>_<b>,
        prob_<model>, extras."""
        table: dict[str, NDArray] = dict(
            zip('xyz', np.asarray(self.xyz, np.float32).reshape(-1, 3).T)
        )
        table.update(zip(self.state_names, self.state.T))
        for i, a in enumerate(self.state_names):
            for j, b in enumerate(self.state_names[i:], start=i):
                table[f'cov_{a}_{b}'] = self.covariance[:, i, j]
        table.update(
            (f'prob_{name}', column)
            for name, column in zip(self.model_names, self.probabilities.T)
        )
        table.update(self.extras)
        return table

    @classmethod
    def from_columns(
        cls, columns: Mapping[str, NDArray], *, stamp_ns: int, frame_id: str = ''
    ) -> Estimate:
        """Inverse of `columns`. Raises ValueError when x, y, z or a covariance column is
        missing."""
        names = list(columns)
        if names[:3] != ['x', 'y', 'z']:
            raise ValueError('an estimate table starts with the columns x, y, z')
        states = tuple(
            name[4 : 4 + (len(name) - 5) // 2]
            for name in names
            if name.startswith('cov_')
            and name[4 : 4 + (len(name) - 5) // 2] == name[5 + (len(name) - 5) // 2 :]
        )
        models = tuple(name[5:] for name in model_columns(names))
        rows, n = len(columns['x']), len(states)
        covariance = np.empty((rows, n, n))
        for i, a in enumerate(states):
            for j, b in enumerate(states[i:], start=i):
                if f'cov_{a}_{b}' not in columns:
                    raise ValueError(f'an estimate table needs the column cov_{a}_{b}')
                covariance[:, i, j] = covariance[:, j, i] = columns[f'cov_{a}_{b}']
        used = {'x', 'y', 'z', *states, *(f'prob_{model}' for model in models)}
        return cls(
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            xyz=np.column_stack([columns[name] for name in _exact(columns)]),
            state_names=states,
            state=np.column_stack([columns[s] for s in states]) if n else np.empty((rows, 0)),
            covariance=covariance,
            model_names=models,
            probabilities=np.column_stack([columns[f'prob_{m}'] for m in models])
            if models
            else np.empty((rows, 0)),
            extras={
                name: np.asarray(columns[name])
                for name in names
                if name not in used and not name.startswith('cov_')
            },
        )
