# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The records of an MCAP file, their checksums, and reading it without its index.

A file is a sequence of records, each with a one-byte operation code and a length. Messages lie in
chunks, which may be compressed. There is room for three kinds of CRC-32, zero for none: of what
each chunk unpacks to, of everything before the record that ends the data, and of the summary with
the index. rosbags writes none and checks those of chunks only. With all three no bit of the file
can turn without being noticed.

The index is written last. Without it (a crashed recorder, a full disk, a broken copy) the records
are read from the front up to the first damaged one, whole ones inside a cut-off chunk too, which
can be most of a recording. Where the index is sound it says where the chunks lie, so that a
damaged one costs no more than itself. Only the position of each message is kept in memory, about
30 bytes for each. Writing and reading of checksums need the same walk, and so stand in one place.

Source: the MCAP format, https://mcap.dev/spec (Chunk, Data End, Footer).
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
import struct
import sys
from typing import BinaryIO, NamedTuple
from zlib import crc32

import lz4.frame
import numpy as np

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 0x02, 0x03, 0x04, 0x05, 0x06, 0x08
STATISTICS, DATA_END = 0x0B, 0x0F
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
    compressed, and the packed bytes."""

    size: int
    checksum: int
    compression: str
    packed: bytes


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
    return ChunkHead(size, checksum, compression, content[at + 8 :])


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
        framed: int | None = head.size
        if head.compression == 'zstd':
            framed = zstd.get_frame_info(head.packed).decompressed_size
        elif head.compression == 'lz4':
            framed = lz4.frame.get_frame_info(head.packed)['content_size'] or None
        if framed is None:
            framed = len(unpack(head.packed, head.compression))
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
                head = chunk_head(file.read(length))
                _put(file, position + _CHUNK_SUM, crc32(unpack(head.packed, head.compression)))
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
        data = [] if _data_is_right(file, footer.summary) else ['data']
        return data if summary_is_right(file, size, footer) else [*data, 'index']


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
    is_end = (code, length) == (DATA_END, _SUM.size)
    return is_end and (not stated or stated == _crc(file, 0, end))


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


_MESSAGE_HEAD = struct.Struct('<HIQQ')
_UNCHUNKED = -1


class Channel(NamedTuple):
    """One channel of the file; `definition` is the text of its message definition."""

    topic: str
    type_name: str
    definition: str
    definition_encoding: str


class McapScan:
    """The messages of an MCAP file found by walking its records.

    channels and counts are by channel number; stated: how many messages the index speaks of, None
    without one. Raises ValueError for a file that is not MCAP.
    """

    def __init__(self, path: Path):
        self._file = path.open('rb')
        self._size = path.stat().st_size
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.stated: int | None = None
        self._lost: dict[str, None] = {}
        self._lengths: dict[int, int] = {}
        self._schemas: dict[int, tuple[str, str, str]] = {}
        # Log time, channel, block, start and length of each message.
        self._messages: tuple[array[int], ...] = tuple(array(code) for code in 'QHqQQ')
        self._chunk = lru_cache(maxsize=2)(self._read_chunk)
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise ValueError('it does not start like an MCAP file')
            self._read_summary()
            self._walk_chunks() if self._lengths else self._walk_file()
        except BaseException:
            self._file.close()
            raise

    @property
    def lost(self) -> str:
        """What could not be read, empty when the whole file was."""
        return ' and '.join(self._lost)

    def messages(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (channel, log time in ns, data) by log time; equal times keep the file's order."""
        for i in np.argsort(np.array(self._messages[0]), kind='stable'):
            log_ns, channel, block, start, length = (column[i] for column in self._messages)
            if channel not in channels:
                continue
            if block == _UNCHUNKED:
                self._file.seek(start)
                yield channel, log_ns, self._file.read(length)
            else:
                yield channel, log_ns, self._chunk(block)[start : start + length]

    def close(self) -> None:
        self._chunk.cache_clear()
        self._file.close()

    def _read_summary(self) -> None:
        """Learn topics, chunks and the number of messages from a sound summary."""
        footer = footer_of(self._file, self._size)
        if footer is None or not summary_is_right(self._file, self._size, footer):
            return
        for position, code, length in records(self._file, footer.summary, self._size):
            self._file.seek(position + RECORD.size)
            content = self._file.read(min(length, self._size))
            if code in (SCHEMA, CHANNEL):
                self._take(code, content, _UNCHUNKED, position)
            elif code == CHUNK_INDEX and len(content) >= 32:
                start, length = struct.unpack_from('<QQ', content, 16)
                self._lengths[start] = length - RECORD.size
            elif code == STATISTICS and len(content) >= 8:
                (self.stated,) = struct.unpack_from('<Q', content)

    def _walk_chunks(self) -> None:
        for position, length in sorted(self._lengths.items()):
            self._file.seek(position)
            if self._file.read(RECORD.size) != RECORD.pack(CHUNK, length):
                self._lose(f'is damaged at byte {position}')
            self._walk_chunk(position)

    def _walk_file(self) -> None:
        """Walk the records of the file up to the summary or the first damage."""
        position = len(MAGIC)
        while True:
            self._file.seek(position)
            head = self._file.read(RECORD.size)
            if len(head) < RECORD.size:
                self._lose('is cut off')
                return
            code, length = RECORD.unpack(head)
            if code in (DATA_END, FOOTER):
                return
            end = position + RECORD.size + length
            whole = end <= self._size
            if code == 0 or (not whole and code != CHUNK):
                self._lose(f'is {"cut off" if code else "damaged"} at byte {position}')
                return
            if code == CHUNK:
                self._walk_chunk(position)
            elif code in (SCHEMA, CHANNEL, MESSAGE):
                self._take(code, self._file.read(length), _UNCHUNKED, position + RECORD.size)
            if not whole:
                self._lose(f'is cut off in a chunk of {length} bytes')
                return
            position = end

    def _walk_chunk(self, position: int) -> None:
        """Walk the whole records of one chunk."""
        content = self._chunk(position)
        at = 0
        while at + RECORD.size <= len(content):
            code, length = RECORD.unpack_from(content, at)
            at += RECORD.size
            if at + length > len(content):
                return
            if code in (SCHEMA, CHANNEL, MESSAGE):
                self._take(code, content[at : at + length], position, at)
            at += length

    def _read_chunk(self, position: int) -> bytes:
        """Give the decompressed records of the chunk at `position`; empty when it is damaged."""
        self._file.seek(position)
        _, length = RECORD.unpack(self._file.read(RECORD.size))
        length = self._lengths.get(position, length)
        packed = self._file.read(min(length, self._size))
        try:
            head = chunk_head(packed)
            content = unpack(head.packed, head.compression)
        except TooLargeError:
            self._lose(f'has a chunk at byte {position} that {TOO_LARGE}')
            return b''
        except (struct.error, UnicodeDecodeError, KeyError, RuntimeError, zstd.ZstdError):
            self._lose(f'has a damaged chunk at byte {position}')
            return b''
        if len(packed) == length and head.checksum and crc32(content) != head.checksum:
            self._lose(f'has a chunk at byte {position} whose checksum is wrong')
            return b''
        return content

    def _take(self, code: int, content: bytes, block: int, start: int) -> None:
        try:
            if code == MESSAGE:
                channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content)
                if channel in self.channels:
                    begin, length = start + _MESSAGE_HEAD.size, len(content) - _MESSAGE_HEAD.size
                    row = (log_ns, channel, block, begin, length)
                    for column, value in zip(self._messages, row):
                        column.append(value)
                    self.counts[channel] += 1
                return
            (number,) = struct.unpack_from('<H', content)
            if code == SCHEMA:
                name, at = text(content, 2)
                encoding, at = text(content, at)
                self._schemas[number] = (name, text(content, at)[0], encoding)
            else:
                (schema,) = struct.unpack_from('<H', content, 2)
                topic = text(content, 4)[0]
                self.channels[number] = Channel(topic, *self._schemas.get(schema, ('', '', '')))
        except (struct.error, UnicodeDecodeError):
            self._lose(f'has a damaged record near byte {start if block < 0 else block}')

    def _lose(self, what: str) -> None:
        """Keep the first three descriptions of what is lost."""
        if len(self._lost) < 3:
            self._lost[what] = None
