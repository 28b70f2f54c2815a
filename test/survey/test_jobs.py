# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the jobs of a survey keep on the disk."""

import errno
import resource

import numpy as np
import pytest

from sonar_imm_tools.offline.jobs import sentence_of
from sonar_imm_tools.survey import jobs


@pytest.fixture
def small_files():
    """No file may be larger than a kilobyte: a write fails as on a full disk."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, usual[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@pytest.mark.usefixtures('small_files')
def test_a_table_for_which_there_is_no_room_says_so(tmp_path):
    """numpy says "1630 requested and 448 written"."""
    path = tmp_path / 'looks.npy'
    with pytest.raises(OSError, match='too large') as caught:
        jobs._save_table(path, {'z': np.zeros(1000)})
    assert caught.value.errno == errno.EFBIG
    assert sentence_of(caught.value) == f'{path}: File too large'
    assert not list(tmp_path.iterdir())


def test_no_signature_stands_beside_a_table_that_could_not_be_made(tmp_path):
    path = tmp_path / 'looks.npy'
    path.with_suffix('.json').write_text('{}')
    with pytest.raises(ValueError, match='shape'):
        jobs._save_table(path, {'a': np.zeros(2), 'b': np.zeros(3)})
    assert not list(tmp_path.iterdir())


def test_a_table_is_read_as_it_was_kept(tmp_path):
    columns = {'stamp_ns': np.arange(3), 'xy': np.arange(6.0).reshape(3, 2)}
    jobs._save_table(tmp_path / 'looks.npy', columns)
    table = np.load(tmp_path / 'looks.npy')
    for name, column in columns.items():
        np.testing.assert_array_equal(table[name], column)
