# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Shared files are found after every kind of installation, and only those of this installation."""

from __future__ import annotations

from pathlib import Path

import pytest

from sonar_imm_tools.resources import share_folder, shared_file


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


@pytest.mark.parametrize(
    'place',
    [
        'lib/python3.12/site-packages',  # pip in a venv, colcon
        'lib/python3.12/dist-packages',  # Debian's Python
        'local/lib/python3.12/dist-packages',  # the same, colcon on Ubuntu
        '.',  # pip install --target
    ],
)
def test_installed_files_lie_in_share_of_the_prefix(tmp_path: Path, place: str) -> None:
    module = touch(tmp_path / place / 'sonar_imm' / 'resources.py')
    touch(tmp_path / 'share' / 'sonar_imm' / 'package.xml')
    assert share_folder(module) == tmp_path / 'share' / 'sonar_imm'


def test_source_tree_is_its_own_share(tmp_path: Path) -> None:
    module = touch(tmp_path / 'ws' / 'src' / 'sonar_imm' / 'sonar_imm' / 'resources.py')
    root = module.parents[1]
    touch(root / 'setup.py')
    touch(root / 'resource' / 'sonar_imm')
    # An older version installed above the workspace does not matter.
    touch(tmp_path / 'share' / 'sonar_imm' / 'package.xml')
    assert share_folder(module) == root


def test_links_of_a_symlink_install_lead_to_the_source(tmp_path: Path) -> None:
    module = touch(tmp_path / 'src' / 'sonar_imm' / 'resources.py')
    touch(tmp_path / 'src' / 'setup.py')
    touch(tmp_path / 'src' / 'resource' / 'sonar_imm')
    link = tmp_path / 'build' / 'sonar_imm'
    link.parent.mkdir()
    link.symlink_to(module.parent, target_is_directory=True)
    assert share_folder(link / 'resources.py') == tmp_path / 'src'


def test_a_copied_module_says_what_is_missing(tmp_path: Path) -> None:
    module = touch(tmp_path / 'sonar_imm' / 'resources.py')
    with pytest.raises(FileNotFoundError, match='install the package with pip or colcon'):
        share_folder(module)


def test_the_default_parameters_are_shared() -> None:
    assert 'ros__parameters' in shared_file('config/diver.yaml').read_text(encoding='utf-8')


def test_an_unknown_shared_file_is_named() -> None:
    with pytest.raises(FileNotFoundError, match="no shared file 'bags/nothing'"):
        shared_file('bags/nothing')
