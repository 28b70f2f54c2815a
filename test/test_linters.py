# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The linters of ament, where they are installed (a ROS 2 machine: `rosdep install -t test`).

PyPI does not have all of them, so elsewhere these are skipped; ruff and the tests of the house
check the same things there.
"""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = 'benchmarks docs examples msg_adapters sonar_imm sonar_imm_tools test setup.py'
SOURCES = [str(ROOT / name) for name in NAMES.split()]


@pytest.mark.linter
@pytest.mark.copyright
def test_every_file_has_its_copyright_and_licence():
    main = pytest.importorskip('ament_copyright.main')
    assert main.main(argv=SOURCES) == 0


@pytest.mark.linter
@pytest.mark.flake8
def test_the_style_is_what_setup_cfg_says():
    main = pytest.importorskip('ament_flake8.main')
    assert main.main(argv=['--config', str(ROOT / 'setup.cfg'), *SOURCES]) == 0


@pytest.mark.linter
@pytest.mark.pep257
def test_docstrings_are_well_formed():
    main = pytest.importorskip('ament_pep257.main')
    # The form of a summary is the project's own, as in setup.cfg.
    ours = 'D205 D209 D213 D400 D401 D402 D403 D415'.split()
    assert main.main(argv=['--add-ignore', *ours, '--', *SOURCES]) == 0
