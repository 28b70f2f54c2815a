# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Check a wheel and an sdist: their size, and that what belongs into them is there.

Usage: python .ci/check_dist.py FOLDER
"""

from __future__ import annotations

from pathlib import Path
import sys
import tarfile
import zipfile

LARGEST = 2_000_000
"""Bytes of a wheel, and of an sdist."""
LARGEST_RECORDING = 1_000_000
NEEDED = (
    'sonar_imm/py.typed',
    'share/sonar_imm/package.xml',
    'share/sonar_imm/config/diver.yaml',
    'share/sonar_imm/bags/diver_table1/diver_table1.mcap',
    'share/sonar_imm/bags/fathometer_array/check.yaml',
)


def problems(folder: Path) -> list[str]:
    """What is wrong with the distributions in `folder`, a sentence each."""
    found = []
    (wheel,), (sdist,) = folder.glob('*.whl'), folder.glob('*.tar.gz')
    with zipfile.ZipFile(wheel) as file:
        sizes = {item.filename: item.file_size for item in file.infolist()}
    found += [
        f'{wheel.name} lacks {name}'
        for name in NEEDED
        if not any(f'/{path}'.endswith(f'/{name}') for path in sizes)
    ]
    with tarfile.open(sdist) as file:
        sizes |= {item.name: item.size for item in file.getmembers()}
    found += [
        f'{name}: a recording of {size} bytes'
        for name, size in sizes.items()
        if name.endswith('.mcap') and size > LARGEST_RECORDING
    ]
    for path in (wheel, sdist):
        if (size := path.stat().st_size) > LARGEST:
            found.append(f'{path.name} has {size} bytes, more than {LARGEST}')
        print(f'{path.name}: {size / 1e6:.2f} MB')
    return found


if __name__ == '__main__':
    wrong = problems(Path(sys.argv[1]))
    print('\n'.join(wrong))
    sys.exit(bool(wrong))
