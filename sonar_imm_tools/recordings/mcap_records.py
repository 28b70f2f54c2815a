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

"""The records of an MCAP file and their checksums.

A file is a sequence of records, each with a one-byte operation code and a length. Messages lie in
chunks, which may be compressed. There is room for three kinds of CRC-32, and a zero means that
there is none: of what each chunk unpacks to, of everything before the record that ends the data,
and of the summary with the index. rosbags writes none and checks those of chunks only. With all
three no bit of the file can turn without being noticed.

Source: the MCAP format, https://mcap.dev/spec (Chunk, Data End, Footer).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import struct
import sys
from typing import BinaryIO, NamedTuple

import lz4.frame

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd
from zlib import crc32

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x08
STATISTICS, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0E, 0x0F
RECORD = struct.Struct('<BQ')
_CHUNK_HEAD = struct.Struct('<QQQI')
_FOOTER = struct.Struct('<BQQQI')
END = _FOOTER.size + len(MAGIC)
"""Bytes of the footer and what follows it."""
MAX_UNPACKED = 1 << 27
"""Most bytes that a chunk or a message may unpack to: a few hundred bytes can claim gigabytes."""
MAX_RATIO = 1000
"""Most that a whole packed file may grow, once beyond that."""
TOO_LARGE = f'unpacks to more than {MAX_UNPACKED >> 20} MiB'


class TooLargeError(ValueError):
    """Packed bytes that would unpack to more than `MAX_UNPACKED`."""


class ChunkHead(NamedTuple):
    """What a chunk says of itself: bytes that it unpacks to, their CRC-32 or 0, how it is
    compressed, and where in the chunk the packed bytes start."""

    size: int
    checksum: int
    compression: str
    start: int


class Footer(NamedTuple):
    """Where the summary starts, and its CRC-32 or 0."""

    summary: int
    checksum: int


def records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Position, code and length of each record from `start` up to that which ends the data or the
    file; stops at what is no record."""
    while start + RECORD.size <= end:
        file.seek(start)
        code, length = RECORD.unpack(file.read(RECORD.size))
        if not code:
            return
        yield start, code, length
        if code in (DATA_END, FOOTER):
            return
        start += RECORD.size + length


def footer_of(file: BinaryIO, size: int) -> Footer | None:
    """The footer of a file of `size` bytes; None when the file has none, or no summary."""
    if size < END + len(MAGIC):
        return None
    file.seek(size - END)
    code, length, start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    whole = (code, length) == (FOOTER, _FOOTER.size - RECORD.size) and file.read() == MAGIC
    return Footer(start, checksum) if whole and len(MAGIC) <= start <= size - END else None


def chunk_head(content: bytes) -> ChunkHead:
    """Read the head of a chunk. Raises struct.error or UnicodeDecodeError where there is none."""
    _, _, size, checksum = _CHUNK_HEAD.unpack_from(content)
    compression, at = text(content, _CHUNK_HEAD.size)
    return ChunkHead(size, checksum, compression, at + 8)


def text(content: bytes, at: int) -> tuple[str, int]:
    """Read a length-prefixed text: (text, position after it)."""
    (length,) = struct.unpack_from('<I', content, at)
    if at + 4 + length > len(content):
        raise struct.error('text beyond the record')
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length


def unpack(packed: bytes, compression: str) -> bytes:
    """Decompress. A streaming decompressor returns what it has when its input ends early.

    Raises `TooLargeError` as soon as more than `MAX_UNPACKED` bytes come out, KeyError for an
    unknown compression.
    """
    if compression == 'zstd':
        stream = zstd.ZstdDecompressor()
    elif compression == 'lz4':
        stream = lz4.frame.LZ4FrameDecompressor()
    elif compression:
        raise KeyError(compression)
    else:
        return packed
    content = stream.decompress(packed, MAX_UNPACKED + 1)
    if len(content) > MAX_UNPACKED:
        raise TooLargeError(f'it {TOO_LARGE}')
    return content


def oversized_chunk(path: Path) -> str:
    """A sentence about the first chunk that unpacks to more than `MAX_UNPACKED` bytes, empty when
    there is none. The sizes are in the chunk heads, so usually no chunk is unpacked."""
    with path.open('rb') as file:
        size = path.stat().st_size
        for position, code, length in records(file, len(MAGIC), size):
            file.seek(position + RECORD.size)
            if code == CHUNK and _unpacks_to_too_much(file.read(min(length, size))):
                return f'a chunk at byte {position} {TOO_LARGE}'
    return ''


def oversized_file(path: Path) -> str:
    """A sentence about a whole file, packed with zstd, that unpacks to more than `MAX_RATIO` times
    its size; empty when it does not. What it says of its own size is looked at first."""
    limit = max(MAX_UNPACKED, MAX_RATIO * path.stat().st_size)
    with path.open('rb') as file:
        try:
            stated = zstd.get_frame_info(file.read(64)).decompressed_size
        except zstd.ZstdError:
            return ''  # left to the reader
    size = stated or 0
    if stated is None:
        with zstd.open(path) as unpacked:
            while size <= limit and (block := unpacked.read(1 << 20)):
                size += len(block)
    return f'it unpacks to more than {limit >> 20} MiB' if size > limit else ''


def _unpacks_to_too_much(chunk: bytes) -> bool:
    """Whether a chunk is too large. Other damage is left to the reader."""
    try:
        head = chunk_head(chunk)
        packed = chunk[head.start :]
        framed: int | None = head.size
        if head.compression == 'zstd':
            framed = zstd.get_frame_info(packed).decompressed_size
        elif head.compression == 'lz4':
            framed = lz4.frame.get_frame_info(packed)['content_size'] or None
        if framed is None:
            framed = len(unpack(packed, head.compression))
    except TooLargeError:
        return True
    except (struct.error, UnicodeDecodeError, RuntimeError, zstd.ZstdError):
        return False
    return max(head.size, framed) > MAX_UNPACKED


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
