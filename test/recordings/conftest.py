# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import os
from pathlib import Path

import pytest

from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm_tools.recordings.convert import KINDS
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.table_files import CsvTable
from sonar_imm_tools.recordings.tables import CsvOptions
from sonar_imm_tools.recordings.writer import BagWriter

START = 1_700_000_000 * 10**9


@pytest.fixture
def real_data():
    """The folder of real recordings, or a skip."""
    default = Path(__file__).resolve().parents[2].parent / 'shared' / 'data'
    folder = Path(os.environ.get('SONAR_IMM_DATA', default))
    if not folder.is_dir():
        pytest.skip('no real recordings here; SONAR_IMM_DATA names their folder')
    return folder


@pytest.fixture
def table(tmp_path):
    """A table of text or bytes."""

    def make(text, **options):
        (tmp_path / 'a.csv').write_bytes(text if isinstance(text, bytes) else text.encode())
        return CsvTable(tmp_path / 'a.csv', CsvOptions(**options))

    return make


@pytest.fixture
def convert(tmp_path):
    """Write a table and make a recording of it; gives the report."""

    def run(text, kind='fixes', out='out', **options):
        (tmp_path / 'in.csv').write_text(text, encoding='utf-8')
        return KINDS[kind](tmp_path / 'in.csv', tmp_path / out, **options)

    return run


@pytest.fixture
def fix_message():
    """Make the message of the i-th fix, one a second."""

    def make(i, **changes):
        usual = {'covariance': [[4.0, 0.5], [0.5, 9.0]], 'frame_id': 'map'}
        place = {'stamp_ns': START + i * 10**9, 'position': (i, 2.0, 0.0)}
        return write_fix(Fix(**{**usual, **place, **changes}), ros_message)

    return make


@pytest.fixture
def write_fixes(tmp_path, fix_message):
    """Write a bag of n fixes and give its path."""

    def write(n=50, name='bag', **options):
        with BagWriter(tmp_path / name, **options) as bag:
            for i in range(n):
                bag.write('/fix', fix_message(i), START + i * 10**9)
        return tmp_path / name

    return write
