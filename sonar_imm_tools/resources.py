# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The files that travel with the package: `config/` and the bags of the demo.

They lie in `<prefix>/share/sonar_imm` after pip or colcon, where `<prefix>` is somewhere above
this module, and in the source tree itself for an editable or `--symlink-install` build. Looking
upwards from this module covers all of them, and never finds the files of another installation.
"""

from __future__ import annotations

from pathlib import Path

_PACKAGE = 'sonar_imm'


def share_folder(start: Path | None = None) -> Path:
    """Find the folder that holds `package.xml`, `config/` and `bags/`.

    `start` is a path inside the installation, by default this module.
    Raises FileNotFoundError when the installation lacks its shared files.
    """
    start = (start or Path(__file__)).resolve()
    for above in start.parents:
        if (above / 'setup.py').is_file() and (above / 'resource' / _PACKAGE).is_file():
            return above
        if (above / 'share' / _PACKAGE / 'package.xml').is_file():
            return above / 'share' / _PACKAGE
    raise FileNotFoundError(
        f'the shared files of {_PACKAGE} (config, bags) were not installed beside {start}; '
        'install the package with pip or colcon instead of copying its modules'
    )


def shared_file(name: str) -> Path:
    """Give the path of a shared file or bag, e.g. ``shared_file('config/diver.yaml')``.

    Raises FileNotFoundError with one clear sentence when there is none of that name.
    """
    path = share_folder() / name
    if not path.exists():
        raise FileNotFoundError(f"{_PACKAGE} has no shared file '{name}' in {share_folder()}")
    return path
