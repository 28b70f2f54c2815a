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

"""What a run leaves behind, byte for byte."""

import csv
import json

from helpers.dive_scenes import single_run, START_NS
import numpy as np
import pytest

from sonar_imm_tools.offline.run_folder import fingerprint, finite, RunFolder
from sonar_imm_tools.recordings.reader import BagError

ESTIMATES = single_run(count=20)[0]


@pytest.fixture
def folder(tmp_path):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    return folder


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob('*')
        if path.is_file()
    }


def test_estimates_come_back_bit_for_bit(folder):
    assert folder.write_estimates(ESTIMATES, 'diver') == {'estimates': 20, 'rows': 20}
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
    folder.write_json('run.json', {})
    (folder.path / 'notes.txt').write_text('mine')
    with pytest.raises(BagError, match='--overwrite'), folder.fresh():
        pytest.fail('the folder was given out')
    with pytest.raises(KeyError), folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        raise KeyError
    assert contents(folder.path) == {'notes.txt': b'mine', 'run.json': b'{}\n'}
    with folder.fresh(overwrite=True) as unfinished:
        unfinished.write_json('run.json', {'new': 1})
        assert contents(folder.path)['run.json'] == b'{}\n'
    assert json.loads((folder.path / 'run.json').read_text()) == {'new': 1}
    assert sorted(contents(folder.path)) == ['notes.txt', 'run.json']


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
