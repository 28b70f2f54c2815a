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

"""The offset between members and the shift they share, drawn anew."""

import math

import numpy as np
import pytest

from sonar_imm.estimation.set_shifts import Shift, ShiftPath


@pytest.mark.parametrize('step', [1, 4])
def test_an_offset_drawn_anew_leaves_its_distribution(step):
    """Paths of shifts and how likely they are with each offset, by the sum over the grid; drawn
    from that, offsets drawn anew are distributed as before, also where they are less than a
    step."""
    shift, N, rng = Shift(std=3.0, memory=0.6, step=step), 40_000, np.random.default_rng(3)
    innovation = math.sqrt(1.0 - 0.6**2) * 3.0
    grid = shift.places
    for records in (1, 4, 60):
        shape = rng.integers(-1, 2, records).cumsum()
        paths = shape[None] + grid[:, None]
        log_p = -0.5 * np.square(paths[:, 0] / 3.0)
        log_p -= 0.5 * np.square((paths[:, 1:] - 0.6 * paths[:, :-1]) / innovation).sum(axis=1)
        p = np.exp(log_p - log_p.max())
        p[(paths[:, -1] < grid[0]) | (paths[:, -1] > grid[-1])] = 0.0
        p /= p.sum()
        which = rng.choice(len(grid), N, p=p)
        place = (paths[which] + shift.pad).astype(np.int64)
        path = ShiftPath.begin(shift, place[:, 0])
        for k in range(1, records):
            path = path.then(shift, place[:, k - 1], place[:, k])
        free = np.full(N, -1000), np.full(N, 1000)
        d, after = path.draw(shift, place[:, -1], free, rng.random((N, 2)))
        assert (d % step == 0).all()
        now = which + d // step
        # The first shift may lie beyond the grid, which costs four standard deviations.
        assert ((now < 0) | (now >= len(grid))).mean() < 1e-3
        drawn = np.bincount(now.clip(0, len(grid) - 1), minlength=len(grid)) / N
        assert 0.5 * np.abs(drawn - p).sum() < 0.02
        assert records > 30 or (d != 0).mean() > 0.3
        # The path is that of the shifts it has come to.
        moved = ShiftPath.begin(shift, place[:, 0] + d)
        for k in range(1, records):
            moved = moved.then(shift, place[:, k - 1] + d, place[:, k] + d)
        assert after.pull == pytest.approx(moved.pull)
        assert after.precision == pytest.approx(moved.precision)
        held = path.draw(
            shift, place[:, -1], (np.full(N, 0), np.full(N, step)), rng.random((N, 2))
        )
        assert set(np.unique(held[0])) <= {0, step}
