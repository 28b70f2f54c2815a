# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is kept of all lines together: their misties, and the adjustment round by round.

Each is one file below ``.work`` with the signature of all that it was made from in it, so that no
interruption can part the two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
import zipfile

from attrs import asdict, astuple, fields
import numpy as np

from sonar_imm import __version__
from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray

from .adjustment import adjust, Adjustment, Crossing, Mistie, misties, Rounds
from .jobs import kept, save_arrays, signed, Unit, write_json
from .looks import Looks

Misties = dict[tuple[int, int], Mistie]


def find_misties(
    looks: Sequence[Looks], made_of: Sequence[Any], place: Path, rms: bool = False
) -> tuple[Misties, int, float]:
    """Return the misties of each pair of lines, how many cells two lines or more see, and, if
    `rms`, the robust rms of looks there, m.

    made_of: what the looks were made from; place: of the file that keeps the result.
    """
    signature = signed(__version__, *made_of)
    known = kept(place)
    if not isinstance(known, dict) or known.get('signature') != signature:
        pairs, cells = misties(looks)
        known = {
            'signature': signature,
            'pairs': [[*pair, *astuple(mistie)] for pair, mistie in pairs.items()],
            'cells': cells,
            'rms': Crossing.of(looks).rms() if cells and rms else 0.0,
        }
        write_json(place, known)
    found: Misties = {(a, b): Mistie(*values) for a, b, *values in known['pairs']}
    return found, known['cells'], known['rms']


def adjust_lines(
    statistics: Callable[[FloatArray], Sequence[Looks]],
    units: Sequence[Unit],
    budget: ErrorBudget,
    fixed: Sequence[int],
    cell: float,
    place: Path,
    note: Callable[[int, float], None],
) -> Adjustment:
    """Return the adjustment of all lines, and go on after the last round that was solved.

    place: of the file that keeps it; else as `adjust`. Raises ValueError where no two lines see
    the same cell.
    """
    made_of = [unit.signature for unit in units], cell, asdict(budget), list(fixed)
    signature = signed(__version__, *made_of)
    known = _load(place, signature)
    if known.keys() == {field.name for field in fields(Adjustment)}:
        return Adjustment(**{**known, 'rms': tuple(known['rms'].tolist())})

    def keep(result: Adjustment | Rounds) -> None:
        columns = asdict(result, recurse=False)
        save_arrays(place, {**columns, 'signature': np.array(signature)})

    solved = Rounds(**known) if known else None
    made = adjust(statistics, len(units), budget, fixed=fixed, note=note, solved=solved, keep=keep)
    keep(made)
    return made


def _load(place: Path, signature: str) -> Mapping[str, Any]:
    """Return the arrays that a file keeps, none where it was made from something else."""
    try:
        with np.load(place, allow_pickle=False) as file:
            known = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return {}
    names = [{field.name for field in fields(kind)} for kind in (Adjustment, Rounds)]
    return known if str(known.pop('signature', '')) == signature and known.keys() in names else {}
