# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of numbers as CSV: the same bytes whatever writes them."""

import csv
import io
import sys

import numpy as np
import pytest

from sonar_imm_tools.recordings import csv_writer
from sonar_imm_tools.recordings.csv_writer import CsvWriter, FEW_ROWS, ROWS_IN_A_BLOCK

RNG = np.random.default_rng(3)
POWERS = 10.0 ** np.arange(-320, 309)
NEAR = [np.nextafter(POWERS, way) for way in (-np.inf, np.inf)]
SPREAD = np.exp(RNG.uniform(-40.0, 45.0, 50_000)) * RNG.choice([-1.0, 1.0], 50_000)
HOSTILE = {
    'any bits': RNG.integers(0, 2**64, 50_000, dtype=np.uint64).view(np.float64),
    'powers of ten': np.concatenate([POWERS, -POWERS, *NEAR, POWERS / 3.0, -1.25 * POWERS]),
    'spread': SPREAD,
    'rounded': np.round(SPREAD, 6),
    'float32': SPREAD.astype(np.float32),
    'whole': RNG.integers(-(10**17), 10**17, 5000).astype(float),
    'no numbers': np.tile([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-5, 1e16], 200),
    'int64': RNG.integers(-(2**63), 2**63 - 1, 2000),
    'uint8': RNG.integers(0, 256, 2000).astype(np.uint8),
    'flags': RNG.random(2000) < 0.5,
}


def written(columns):
    file = io.StringIO()
    CsvWriter(file).write_columns(columns)
    return file.getvalue()


def plain(columns):
    file = io.StringIO()
    rows = zip(*(column.tolist() for column in columns))
    csv.writer(file, lineterminator='\n').writerows(rows)
    return file.getvalue()


@pytest.fixture
def without_pyarrow(monkeypatch):
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    csv_writer._arrow.cache_clear()
    yield
    csv_writer._arrow.cache_clear()


@pytest.mark.filterwarnings('ignore:overflow encountered')
@pytest.mark.parametrize('name', HOSTILE)
def test_numbers_have_the_digits_of_python(name):
    column = HOSTILE[name]
    assert len(column) >= FEW_ROWS
    assert written([column, column[::-1]]) == plain([column, column[::-1]])


@pytest.mark.parametrize('rows', [0, 1, FEW_ROWS - 1, ROWS_IN_A_BLOCK, ROWS_IN_A_BLOCK + 1])
def test_blocks_follow_one_another(rows):
    columns = [np.arange(rows), SPREAD[:rows]]
    assert written(columns) == plain(columns)


def test_pyarrow_writes_them_where_it_is_there():
    pytest.importorskip('pyarrow')
    assert csv_writer._arrow() is not None


def test_the_same_bytes_without_pyarrow(without_pyarrow):
    assert csv_writer._arrow() is None
    assert written([SPREAD, SPREAD]) == plain([SPREAD, SPREAD])


def test_a_pyarrow_with_other_digits_is_not_used(monkeypatch):
    pytest.importorskip('pyarrow')
    monkeypatch.setattr(
        csv_writer, '_texts', lambda column, arrow: arrow.array(['1'] * len(column))
    )
    csv_writer._arrow.cache_clear()
    assert csv_writer._arrow() is None
    assert written([SPREAD]) == plain([SPREAD])
    csv_writer._arrow.cache_clear()
