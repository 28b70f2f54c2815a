# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a run leaves behind, byte for byte."""

import csv
import json
import re

from helpers.commands import contents
from helpers.dive_bags import write_dive
from helpers.dive_scenes import single_run, START_NS
from helpers.estimates import same
import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import (
    CsvTable,
    fingerprint,
    finite,
    ParquetTable,
    RunFolder,
)
from sonar_imm_tools.recordings.reader import BagError

ESTIMATES = single_run(count=20)[0]


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    return folder


def test_estimates_come_back_bit_for_bit(folder):
    assert folder.write_estimates(ESTIMATES, 'diver') == {
        'first_stamp_ns': ESTIMATES[0].stamp_ns,
        'estimates': 20,
        'rows': 20,
    }
    for read, written in zip(folder.read_estimates(), ESTIMATES, strict=True):
        np.testing.assert_array_equal(read.state, written.state)
        np.testing.assert_array_equal(read.covariance, written.covariance)
        np.testing.assert_array_equal(read.extras['nis'], written.extras['nis'])


def test_the_csv_has_the_columns_of_the_contract_and_exact_numbers(folder):
    folder.write_estimates(ESTIMATES, 'diver')
    with (folder.path / 'estimate.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ['stamp_ns', *ESTIMATES[0].columns()]
    assert int(rows[0]['stamp_ns']) == START_NS
    assert [float(row['px']) for row in rows] == [estimate.state[0, 0] for estimate in ESTIMATES]
    assert rows[0]['track_id'] == '7'


def test_the_same_estimates_make_the_same_bytes(tmp_path):
    contents = []
    for name in ('a', 'b'):
        folder = RunFolder(tmp_path / name)
        folder.path.mkdir()
        folder.write_estimates(ESTIMATES, 'diver')
        contents.append(
            {path.name: path.read_bytes() for path in folder.path.rglob('*') if path.is_file()}
        )
    assert contents[0] == contents[1] and len(contents[0]) == 3


def test_no_estimates_leave_a_readable_run(folder):
    folder.write_estimates([], 'diver')
    assert folder.read_estimates() == []


def test_an_earlier_run_is_kept_unless_told_otherwise(folder):
    folder.path.rmdir()
    with folder.fresh() as unfinished:
        unfinished.write_json('run.json', {})
    (folder.path / 'notes.txt').write_text('mine')
    marker = (folder.path / '.sonar_imm').read_bytes()
    with pytest.raises(BagError, match='--overwrite'), folder.fresh():
        pytest.fail('the folder was given out')
    with pytest.raises(KeyError), folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        raise KeyError
    assert contents(folder.path) == {
        '.sonar_imm': marker,
        'notes.txt': b'mine',
        'run.json': b'{}\n',
    }
    with folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        assert contents(folder.path)['run.json'] == b'{}\n'
    assert json.loads((folder.path / 'run.json').read_text()) == {'new': 1}
    assert sorted(contents(folder.path)) == ['.sonar_imm', 'notes.txt', 'run.json']


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match='is a file'):
        RunFolder(tmp_path / 'file').fresh().__enter__()


@pytest.mark.parametrize(
    'text',
    [
        '',
        '{',
        '[]',
        '{"system": "diver"}',
        '3',
        '{"system": "whale", "bag": "", "topics": {}, "parameters": 0}',
        '{"system": [], "bag": "", "topics": {}, "parameters": 0}',
    ],
)
def test_a_broken_run_json_is_one_sentence(folder, text):
    (folder.path / 'run.json').write_text(text)
    with pytest.raises(BagError, match='cannot be understood'):
        folder.read_run()


GOOD_RUN = {
    'system': 'diver',
    'bag': '',
    'topics': {'/fix': 'fix'},
    'parameters': {},
    'counts': {'used': 1},
    'refused': {'nan': {'count': 1, 'example': 'it is not a number'}},
    'versions': {},
    'world_frame': 'enu',
}


@pytest.mark.parametrize('name', GOOD_RUN)
@pytest.mark.parametrize('value', [None, 5, True, [], ['a'], {'a': []}])
def test_entries_of_a_wrong_kind_are_one_sentence(folder, name, value):
    folder.write_json('run.json', GOOD_RUN)
    assert folder.read_run() == GOOD_RUN
    folder.write_json('run.json', {**GOOD_RUN, name: value})
    if isinstance(value, dict) and name in ('parameters', 'counts', 'versions'):
        folder.read_run()  # what is in them is judged where it is used
        return
    with pytest.raises(BagError, match='cannot be understood'):
        folder.read_run()


def test_an_unfinished_run_is_told(tmp_path):
    with pytest.raises(BagError, match='no finished run'):
        RunFolder(tmp_path).read_run()


def test_json_never_holds_nan():
    text = json.dumps(
        finite({'a': [float('nan'), 1.0, (float('inf'),)], 'b': {'c': 'x'}}), allow_nan=False
    )
    assert json.loads(text) == {'a': [None, 1.0, [None]], 'b': {'c': 'x'}}


def test_a_fingerprint_notices_one_changed_byte(tmp_path):
    (tmp_path / 'a.mcap').write_bytes(b'12345')
    before = fingerprint(tmp_path)
    assert before['bag_bytes'] == 5
    (tmp_path / 'a.mcap').write_bytes(b'12346')
    assert fingerprint(tmp_path)['bag_sha256'] != before['bag_sha256']


# The tables of a run as CSV and as Parquet say the same.


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


def test_bins_of_one_stamp_and_side_are_one_estimate(tmp_path, monkeypatch):
    pytest.importorskip('pyarrow.parquet')
    columns = {name: np.repeat(column, 2) for name, column in ESTIMATES[0].columns().items()}
    made = [
        Estimate.from_columns(
            {**columns, 'side': np.full(2, side)}, stamp_ns=stamp, frame_id='map'
        )
        for stamp, side in ((5, 0), (5, 1), (6, 1), (7, 0))
    ]
    with ParquetTable(tmp_path / 'bins.parquet', {'frame_id': 'map'}) as table:
        for estimate in made:
            table.write(estimate.stamp_ns, estimate.columns())
    monkeypatch.setattr(RunFolder, 'bins', lambda self: self.path / 'bins.parquet')
    for read, estimate in zip(RunFolder(tmp_path).read_estimates(), made, strict=True):
        assert same(read, estimate)


@pytest.mark.parametrize('rows, count', [(0, 0), (0, 3), (1, 5), (65535, 3)])
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


def test_track_writes_the_table_that_is_asked_for(tmp_path, capsys):
    parquet = pytest.importorskip('pyarrow.parquet')
    bags = [str(write_dive(tmp_path / name, count=30)) for name in 'ab']
    out = tmp_path / 'out'
    assert main(['track', *bags, str(out)]) == 0
    with (out / 'a' / 'estimate.csv').open(newline='') as file:
        positions = [float(row['px']) for row in csv.DictReader(file)]
    assert main(['track', *bags, str(out), '--parquet']) == 0  # the same runs lack the files
    assert ' 2 tracked, 0 kept' in capsys.readouterr().out
    assert main(['track', *bags, str(out), '--parquet']) == 0
    assert ' 0 tracked, 2 kept' in capsys.readouterr().out
    first, second = (out / name / 'estimate.parquet' for name in 'ab')
    assert first.read_bytes() == second.read_bytes()
    assert not (out / 'a' / 'estimate.csv').exists()
    read = parquet.read_table(first)
    assert positions == read['px'].to_pylist()
    run = json.loads((out / 'a' / 'run.json').read_text())
    assert json.loads(read.schema.metadata[b'parameters']) == run['parameters']
    assert read.schema.metadata[b'sonar_imm'].decode() == run['versions']['sonar_imm']
    assert main(['track', *bags, str(out), '--no-table']) == 0
    assert ' 0 tracked, 2 kept' in capsys.readouterr().out
    assert main(['track', bags[0], str(out / 'c'), '--no-table']) == 0
    assert {path.name for path in (out / 'c').iterdir()} == {'.sonar_imm', 'estimate', 'run.json'}
    assert main(['track', bags[0], str(out / 'd'), '--no-table', '--parquet']) == 2
    assert 'exclude each other' in capsys.readouterr().err


def test_a_run_says_how_large_it_is_and_how_fast_it_was(tmp_path, capsys):
    bag, out = write_dive(tmp_path / 'a', count=30), tmp_path / 'out'
    assert main(['track', str(bag), str(out)]) == 0
    run = json.loads((out / 'run.json').read_text())
    there = sum(path.stat().st_size for path in out.rglob('*') if path.is_file())
    own = sum((out / name).stat().st_size for name in ('run.json', '.sonar_imm'))
    assert there - own <= run['written_bytes'] <= there
    read = run['timings']['mb_per_s'] * run['timings']['wall_s']
    assert read == pytest.approx(run['bag_bytes'] * 1e-6)
    p50, p99, total = (run['timings'][f'tracker_{name}_ms'] for name in ('p50', 'p99', 'total'))
    assert 0.0 < p50 <= p99 <= total < 1e3 * run['timings']['wall_s']
    assert re.search(
        r'^  0\.\d+ MB read at \S+ MB/s, 0\.\d+ MB written$', capsys.readouterr().out, re.M
    )


def test_without_pyarrow_it_is_said_at_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__('sys').modules, 'pyarrow', None)
    assert main(['track', str(write_dive(tmp_path / 'a')), str(tmp_path / 'o'), '--parquet']) == 2
    assert "pip install 'sonar_imm[parquet]'" in capsys.readouterr().err
    assert not (tmp_path / 'o').exists()
