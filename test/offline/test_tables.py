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

"""The tables of a run as CSV and as Parquet say the same."""

import csv
import json

from helpers.dive_bags import write_dive
from helpers.dive_scenes import single_run
import numpy as np
import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import CsvTable, ParquetTable, ROWS_IN_A_GROUP

ESTIMATES = single_run(count=20)[0]


def test_columns_may_not_change(tmp_path):
    with CsvTable(tmp_path / 'table.csv') as table:
        table.write(1, {'a': np.zeros(2)})
        with pytest.raises(ValueError, match='columns change'):
            table.write(2, {'b': np.zeros(2)})


def test_parquet_has_the_columns_types_and_numbers_of_the_csv(tmp_path):
    parquet = pytest.importorskip('pyarrow.parquet')
    with (
        CsvTable(tmp_path / 'table.csv') as text,
        ParquetTable(tmp_path / 'table.parquet', {'system': 'diver'}) as table,
    ):
        for estimate in ESTIMATES:
            for each in (text, table):
                each.write(estimate.stamp_ns, estimate.columns())
        with pytest.raises(ValueError, match='columns change'):
            table.write(2, {'b': np.zeros(2)})
    read = parquet.read_table(tmp_path / 'table.parquet')
    with (tmp_path / 'table.csv').open(newline='') as file:
        names, *rows = csv.reader(file)
    assert read.column_names == names == ['stamp_ns', *ESTIMATES[0].columns()]
    kinds = {name: read[name].to_numpy().dtype.type for name in names}
    assert kinds.pop('stamp_ns') is np.int64
    assert kinds == {name: value.dtype.type for name, value in ESTIMATES[0].columns().items()}
    for k, name in enumerate(names):
        as_text = np.array([float(row[k]) for row in rows])
        np.testing.assert_array_equal(read[name].to_numpy().astype(float), as_text)
    assert read.schema.metadata[b'system'] == b'diver'


@pytest.mark.parametrize('rows, count', [(0, 0), (0, 3), (1, 5), (ROWS_IN_A_GROUP - 1, 3)])
def test_parquet_of_few_and_of_many_rows(tmp_path, rows, count):
    parquet = pytest.importorskip('pyarrow.parquet')
    with ParquetTable(tmp_path / 'table.parquet') as table:
        for k in range(count):
            table.write(k, {'x': np.full(rows, k, np.float32), 'n': np.arange(rows, dtype='u1')})
    read = parquet.read_table(tmp_path / 'table.parquet')
    assert read.num_rows == rows * count
    assert read.column_names == (['stamp_ns', 'x', 'n'] if count else ['stamp_ns'])
    if read.num_rows:
        np.testing.assert_array_equal(read['x'].to_numpy(), np.repeat(np.arange(count), rows))
        groups = parquet.ParquetFile(tmp_path / 'table.parquet').num_row_groups
        assert groups == (1 if rows == 1 else 2)


def test_track_writes_parquet_beside_csv(tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    bags = [str(write_dive(tmp_path / name, count=30)) for name in 'ab']
    out = tmp_path / 'out'
    assert main(['track', *bags, str(out)]) == 0
    assert main(['track', *bags, str(out), '--parquet']) == 0  # the same runs lack the files
    assert ' 2 tracked, 0 kept' in capsys.readouterr().out
    assert main(['track', *bags, str(out), '--parquet']) == 0
    assert ' 0 tracked, 2 kept' in capsys.readouterr().out
    first, second = (out / name / 'estimate.parquet' for name in 'ab')
    assert first.read_bytes() == second.read_bytes()
    read = parquet.read_table(first)
    with (out / 'a' / 'estimate.csv').open(newline='') as file:
        assert [float(row['px']) for row in csv.DictReader(file)] == read['px'].to_pylist()
    run = json.loads((out / 'a' / 'run.json').read_text())
    assert json.loads(read.schema.metadata[b'parameters']) == run['parameters']
    assert read.schema.metadata[b'sonar_imm'].decode() == run['versions']['sonar_imm']


def test_without_pyarrow_it_is_said_at_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__('sys').modules, 'pyarrow', None)
    assert main(['track', str(write_dive(tmp_path / 'a')), str(tmp_path / 'o'), '--parquet']) == 2
    assert "pip install 'sonar_imm[parquet]'" in capsys.readouterr().err
    assert not (tmp_path / 'o').exists()
