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

"""What helps where a file is no recording, or a damaged one: parts of sentences."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def leftovers(path: Path) -> list[str]:
    """Sentences about write-ahead logs that a crashed recorder left, whose rows are not read."""
    logs = path.glob('*.db3-wal') if path.is_dir() else [path.with_name(path.name + '-wal')]
    return [
        f'{log} holds {log.stat().st_size} bytes that the recorder did not finish writing; '
        f"the messages in it are not read (sqlite3 {log.name[:-4]} 'pragma wal_checkpoint' "
        'merges them)'
        for log in logs
        if log.exists() and log.stat().st_size
    ]


def advice(file: Path) -> str:
    return f' (sqlite3 {file.name} .recover may save some of it)' if file.suffix == '.db3' else ''


def convert_hint(path: Path) -> str:
    """Which conversion makes a recording of a file of another kind."""
    kinds = {'fixes': ('.csv', '.txt'), 'snapshots': ('.npz',), 'segy': ('.sgy', '.segy', '.seg')}
    found = [kind for kind, suffixes in kinds.items() if path.suffix.lower() in suffixes]
    if not found:
        return ''
    return f'; sonar-imm convert makes one, e.g. sonar-imm convert {found[0]} {path} OUT_BAG'


def packed_hint(files: Iterable[Path]) -> str:
    packed = [file.name for file in files if file.suffix in ('.zstd', '.zst')]
    return f'; {packed[0]} is compressed, unpack it with zstd first' if packed else ''
