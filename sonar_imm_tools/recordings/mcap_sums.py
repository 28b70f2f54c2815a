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

"""Checksums of MCAP files: written into those that are made here, checked in all that have them.

An MCAP file has room for three kinds of CRC-32, and a zero means that there is none: of what each
chunk unpacks to, of everything before the record that ends the data, and of the summary with the
index. rosbags writes none and checks those of chunks only. With all three no bit of the file can
turn without being noticed.

Source: the MCAP format, https://mcap.dev/spec (Chunk, Data End, Footer).
"""

from __future__ import annotations

from pathlib import Path
import struct
from typing import BinaryIO
from zlib import crc32

from .mcap_records import (
    CHUNK,
    chunk_head,
    DATA_END,
    Footer,
    footer_of,
    MAGIC,
    RECORD,
    records,
    unpack,
)

_SUM = struct.Struct('<I')
_DATA_END = struct.Struct('<BQI')
_CHUNK_SUM = RECORD.size + 24
"""Where the checksum of a chunk lies after its first byte."""
_BLOCK = 1 << 20


def seal(path: Path) -> None:
    """Put the checksums into a whole MCAP file with a summary, as rosbags writes it."""
    with path.open('r+b') as file:
        size = path.stat().st_size
        footer = footer_of(file, size)
        if footer is None:
            raise ValueError(f'{path} has no summary')
        for position, code, length in list(records(file, len(MAGIC), size)):
            if code == CHUNK:
                file.seek(position + RECORD.size)
                content = file.read(length)
                head = chunk_head(content)
                _put(file, position + _CHUNK_SUM, crc32(unpack(content[head.start :], head[2])))
        end = footer.summary - _DATA_END.size
        _put(file, footer.summary - _SUM.size, _crc(file, 0, end))
        last = size - len(MAGIC) - _SUM.size
        _put(file, last, _crc(file, footer.summary, last))


def wrong_sums(path: Path) -> list[str]:
    """The parts of a file, ``data`` and ``index``, whose checksums are there and wrong. A file
    without an end has no place for them."""
    size = path.stat().st_size
    with path.open('rb') as file:
        footer = footer_of(file, size)
        if footer is None:
            return []
        wrong = {
            'data': not _data_is_right(file, footer.summary),
            'index': not summary_is_right(file, size, footer),
        }
        return [part for part, is_wrong in wrong.items() if is_wrong]


def summary_is_right(file: BinaryIO, size: int, footer: Footer) -> bool:
    """Whether the summary has the checksum that the footer states, if it states one."""
    last = size - len(MAGIC) - _SUM.size
    return not footer.checksum or footer.checksum == _crc(file, footer.summary, last)


def _data_is_right(file: BinaryIO, summary: int) -> bool:
    """Whether the data have the checksum that the record before the summary states, if any."""
    end = summary - _DATA_END.size
    if end < len(MAGIC):
        return True
    file.seek(end)
    code, length, stated = _DATA_END.unpack(file.read(_DATA_END.size))
    if (code, length) != (DATA_END, _SUM.size):
        return False
    return not stated or stated == _crc(file, 0, end)


def _put(file: BinaryIO, position: int, total: int) -> None:
    file.seek(position)
    file.write(_SUM.pack(total))


def _crc(file: BinaryIO, start: int, end: int) -> int:
    """The checksum of the bytes from `start` to `end`."""
    total = 0
    file.seek(start)
    while start < end and (block := file.read(min(_BLOCK, end - start))):
        total = crc32(block, total)
        start += len(block)
    return total
