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

Where the index is there and sound, and only a chunk is not, it says which topics there are and
where the chunks lie, so that a damaged one costs no more than itself.

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

import numpy as np

from .mcap_records import (
    CHANNEL,
    CHUNK,
    chunk_head,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    footer_of,
    MAGIC,
    MESSAGE,
    RECORD,
    records,
    SCHEMA,
    STATISTICS,
    summary_is_right,
    text,
    TOO_LARGE,
    TooLargeError,
    unpack,
    zstd,
)

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
        self._log, self._channel = array('Q'), array('H')
        self._block, self._start, self._length = array('q'), array('Q'), array('Q')
        self._chunk = lru_cache(maxsize=2)(self._read_chunk)
        try:
            if self._file.read(len(MAGIC)) != MAGIC:
                raise ValueError('it does not start like an MCAP file')
            self._read_summary()
            if self._lengths:
                self._walk_chunks()
            else:
                self._walk_file()
        except BaseException:
            self._file.close()
            raise

    @property
    def lost(self) -> str:
        """What could not be read, empty when the whole file was."""
        return ' and '.join(self._lost)

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
        """Walk the chunks of the index."""
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
            content = unpack(packed[head.start :], head.compression)
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
        """Note one schema, channel or message."""
        try:
            if code == MESSAGE:
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
