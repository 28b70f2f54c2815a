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


"""The limit that a recording states of its own."""

import pytest

from sonar_imm_tools.recordings.own_limit import own_limit, write_own_limit
from sonar_imm_tools.recordings.sources import BagError


def test_what_is_written_is_read_and_without_a_file_there_is_none(tmp_path):
    assert own_limit(tmp_path) is None
    write_own_limit(tmp_path, 0.88)
    assert own_limit(tmp_path) == 0.88


@pytest.mark.parametrize(
    'text, sentence',
    [
        ('limit: ten', 'states no number'),
        ('limit: true', 'states no number'),
        ('[1, 2]', 'states no number'),
        ('', 'states no number'),
        ('limit: .nan', 'finite'),
        ('limit: .inf', 'finite'),
        ('limit: -1', 'not negative'),
        ('limit: [', 'not YAML'),
    ],
)
def test_anything_else_is_one_sentence(tmp_path, text, sentence):
    (tmp_path / 'check.yaml').write_text(text)
    with pytest.raises(BagError, match=sentence):
        own_limit(tmp_path)


def test_a_file_of_bytes_is_one_sentence(tmp_path):
    (tmp_path / 'check.yaml').write_bytes(b'\xff\xfe\x00limit')
    with pytest.raises(BagError, match='not YAML'):
        own_limit(tmp_path)
