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

"""Reading an MCAP file without its index: a crashed recorder, a full disk, a broken copy.

An MCAP file is a sequence of records, each with a one-byte operation code and a length. Messages
lie in chunks, and the index that readers rely on is written last. Without it the records can still
be read from the front up to the first damaged one. Whole records inside a cut-off chunk are read
too: a recorder fills a chunk for minutes, so with small messages the last chunk can be most of the
recording.

Only the position of each message is kept in memory (about 30 bytes per message), not its content.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
import struct
from typing import NamedTuple
from zlib import crc32

from backports import zstd
import lz4.frame
import numpy as np

MAGIC = b'\x89MCAP0\r\n'
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_RECORD = struct.Struct('<BQ')
_CHUNK_HEAD = struct.Struct('<QQQI')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_UNCHUNKED = -1
MAX_UNPACKED = 1 << 27
"""Most bytes that a chunk or a message may unpack to: a few hundred bytes can claim gigabytes."""


_TOO_LARGE = f'unpacks to more than {MAX_UNPACKED >> 20} MiB'


class TooLargeError(ValueError):
    """Packed bytes that would unpack to more than `MAX_UNPACKED`."""


class Channel(NamedTuple):
    """One channel of the file; `definition` is the text of its message definition."""

    topic: str
    type_name: str
    definition: str
    definition_encoding: str


class McapScan:
    """The messages of an MCAP file found by walking its records.

    channels and counts are by channel number; `lost` says what could not be read, empty when the
    whole file was read. Raises ValueError for a file that is not MCAP.
    """

    def __init__(self, path: Path):
        self._file = path.open('rb')
        self._size = path.stat().st_size
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.lost = ''
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._log, self._channel = array('Q'), array('H')
        self._block, self._start, self._length = array('q'), array('Q'), array('Q')
        self._chunk = lru_cache(maxsize=2)(self._read_chunk)
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise ValueError('it does not start like an MCAP file')
            self._walk_file()
        except BaseException:
            self._file.close()
            raise

    def messages(self, channels: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield (channel, log time in ns, data) by log time; equal times keep the file's order."""
        log = np.frombuffer(self._log, np.uint64) if self._log else np.empty(0, np.uint64)
        for i in np.argsort(log, kind='stable'):
            if self._channel[i] not in channels:
                continue
            start, length = self._start[i], self._length[i]
            if self._block[i] == _UNCHUNKED:
                self._file.seek(start)
                data = self._file.read(length)
            else:
                data = self._chunk(self._block[i])[start : start + length]
            yield self._channel[i], self._log[i], data

    def close(self) -> None:
        """Close the file."""
        self._chunk.cache_clear()
        self._file.close()

    def _walk_file(self) -> None:
        """Walk the records of the file up to the summary or the first damage."""
        position = len(MAGIC)
        while True:
            self._file.seek(position)
            head = self._file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                self._lose('is cut off')
                return
            code, length = _RECORD.unpack(head)
            if code in (_DATA_END, _FOOTER):
                return
            end = position + _RECORD.size + length
            whole = end <= self._size
            if code == 0 or (not whole and code != _CHUNK):
                self._lose(f'is {"cut off" if code else "damaged"} at byte {position}')
                return
            if code == _CHUNK:
                self._walk_chunk(position)
            elif code in (_SCHEMA, _CHANNEL, _MESSAGE):
                self._take(code, self._file.read(length), _UNCHUNKED, position + _RECORD.size)
            if not whole:
                self._lose(f'is cut off in a chunk of {length} bytes')
                return
            position = end

    def _walk_chunk(self, position: int) -> None:
        """Walk the whole records of one chunk."""
        records = self._chunk(position)
        at = 0
        while at + _RECORD.size <= len(records):
            code, length = _RECORD.unpack_from(records, at)
            at += _RECORD.size
            if at + length > len(records):
                return
            if code in (_SCHEMA, _CHANNEL, _MESSAGE):
                self._take(code, records[at : at + length], position, at)
            at += length

    def _read_chunk(self, position: int) -> bytes:
        """Give the decompressed records of the chunk at `position`; empty when it is damaged."""
        self._file.seek(position)
        _, length = _RECORD.unpack(self._file.read(_RECORD.size))
        content = self._file.read(min(length, self._size))
        try:
            _, _, size, checksum = _CHUNK_HEAD.unpack_from(content)
            compression, at = _text(content, _CHUNK_HEAD.size)
            packed = content[at + 8 :]
            records = unpack(packed, compression)
        except TooLargeError:
            self._lose(f'has a chunk at byte {position} that {_TOO_LARGE}')
            return b''
        except (struct.error, UnicodeDecodeError, KeyError, RuntimeError, zstd.ZstdError):
            self._lose(f'has a damaged chunk at byte {position}')
            return b''
        if len(records) >= size and checksum and crc32(records) != checksum:
            self._lose(f'has a chunk at byte {position} whose checksum is wrong')
            return b''
        return records

    def _take(self, code: int, content: bytes, block: int, start: int) -> None:
        """Note one schema, channel or message."""
        try:
            if code == _MESSAGE:
                channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content)
                if channel in self.channels:
                    self._log.append(log_ns)
                    self._channel.append(channel)
                    self._block.append(block)
                    self._start.append(start + _MESSAGE_HEAD.size)
                    self._length.append(len(content) - _MESSAGE_HEAD.size)
                    self.counts[channel] += 1
                return
            (number,) = struct.unpack_from('<H', content)
            if code == _SCHEMA:
                name, at = _text(content, 2)
                encoding, at = _text(content, at)
                self._schemas[number] = (name, _text(content, at)[0], encoding)
            else:
                (schema,) = struct.unpack_from('<H', content, 2)
                topic = _text(content, 4)[0]
                self.channels[number] = Channel(topic, *self._schemas.get(schema, ('', '', '')))
        except (struct.error, UnicodeDecodeError):
            self._lose(f'has a damaged record near byte {start if block < 0 else block}')

    def _lose(self, what: str) -> None:
        """Keep the first description of a loss."""
        self.lost = self.lost or what


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
        raise TooLargeError(f'it {_TOO_LARGE}')
    return content


def oversized_chunk(path: Path) -> str:
    """A sentence about the first chunk that unpacks to more than `MAX_UNPACKED` bytes, empty when
    there is none. The sizes are in the chunk heads, so usually no chunk is unpacked."""
    with path.open('rb') as file:
        size = path.stat().st_size
        position = len(MAGIC)
        while position + _RECORD.size <= size:
            file.seek(position)
            code, length = _RECORD.unpack(file.read(_RECORD.size))
            if code in (0, _DATA_END, _FOOTER):
                break
            if code == _CHUNK and _unpacks_to_too_much(file.read(min(length, size))):
                return f'a chunk at byte {position} {_TOO_LARGE}'
            position += _RECORD.size + length
    return ''


def _unpacks_to_too_much(chunk: bytes) -> bool:
    """Whether a chunk is too large. Other damage is left to the reader."""
    try:
        stated = _CHUNK_HEAD.unpack_from(chunk)[2]
        compression, at = _text(chunk, _CHUNK_HEAD.size)
        packed = chunk[at + 8 :]
        framed = stated
        if compression == 'zstd':
            framed = zstd.get_frame_info(packed).decompressed_size
        elif compression == 'lz4':
            framed = lz4.frame.get_frame_info(packed)['content_size'] or None
        if framed is None:
            framed = len(unpack(packed, compression))
    except TooLargeError:
        return True
    except (struct.error, UnicodeDecodeError, RuntimeError, zstd.ZstdError):
        return False
    return max(stated, framed) > MAX_UNPACKED


def _text(content: bytes, at: int) -> tuple[str, int]:
    """Read a length-prefixed text: (text, position after it)."""
    (length,) = struct.unpack_from('<I', content, at)
    if at + 4 + length > len(content):
        raise struct.error('text beyond the record')
    return content[at + 4 : at + 4 + length].decode(), at + 4 + length
