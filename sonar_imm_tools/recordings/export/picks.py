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

"""Horizons as SEG-Y: the file that was converted, with picks in place of its samples.

All headers stay as they were, so that the picks lie over the line in any program that shows it.
Each trace is zero but at its picks, where it has the number of the horizon. In the trace header

    bytes 233-236   the sample of the bottom, in thousandths, from 0 at the first; -1 without one
    bytes 237-240   the number of its horizon, 0 without one

Both words are unassigned in revision 1 of SEG-Y.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import shutil

import numpy as np

from ..convert.segy import read_segy
from ..sources import BagError
from .horizons import Picks

_LARGEST = {2: 2**31 - 1, 3: 2**15 - 1, 8: 2**7 - 1, 10: 2**32 - 1, 11: 2**16 - 1, 16: 2**8 - 1}
"""By the format of the samples; other formats are floats."""


def write_picks(out: Path, picks: Picks, original: Path, notes: Mapping[str, str]) -> int:
    """Write `out` from the SEG-Y file `original`; notes: what its conversion kept in the bag.
    Gives how many picks lie outside of the traces. Raises `BagError`, and ModuleNotFoundError
    without segyio."""
    import segyio

    try:
        spacing = float(notes['sample_spacing'].split()[0])
        first, stack = float(notes['depth_of_sample_0'].split()[0]), int(notes['stack'])
    except (KeyError, ValueError, IndexError):
        raise BagError(
            'the recording does not say how it was made of SEG-Y; convert it again with '
            'sonar-imm convert segy'
        ) from None
    if not spacing > 0.0 or stack < 1:
        raise BagError('the recording states an impossible sample spacing or stack')
    line = read_segy(original)
    rows = {stamp: k for k, stamp in enumerate(line.stamps)}
    ends = np.array([rows.get(int(stamp), -1) for stamp in picks.stamp_ns])
    if (ends < 0).any():
        raise BagError(f'{original} is not the file that was tracked: its times are others')
    T, n = line.amplitude.shape
    sample = (picks.depth - first) / spacing
    nearest = np.round(sample).astype(np.int64)
    inside = (nearest >= 0) & (nearest < n)
    grid = np.zeros((T, n), np.float32)
    bottom, number = np.full(T, -1, np.int64), np.zeros(T, np.int64)
    for k in np.flatnonzero(inside):
        traces = slice(max(0, ends[k] - stack + 1), ends[k] + 1)
        grid[traces, nearest[k]] = picks.horizon[k]
        if picks.columns['is_bottom'][k] > 0.5:
            bottom[traces] = round(1e3 * float(sample[k]))
            number[traces] = picks.horizon[k]
    shutil.copyfile(original, out)
    out.chmod(0o644)
    try:
        with segyio.open(str(out), 'r+', ignore_geometry=True) as file:
            largest = _LARGEST.get(int(file.format), 2**24)
            if picks.horizon.max() > largest:
                raise BagError(
                    f'horizons have numbers up to {picks.horizon.max()}, more than samples of '
                    f'{original} hold ({largest})'
                )
            fields = segyio.TraceField
            for trace in range(T):
                file.trace[trace] = grid[trace].astype(file.dtype)
                file.header[trace].update(
                    {
                        fields.UnassignedInt1: int(bottom[trace]),
                        fields.UnassignedInt2: int(number[trace]),
                    }
                )
    except BaseException:
        out.unlink(missing_ok=True)
        raise
    return int((~inside).sum())
