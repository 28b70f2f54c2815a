# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Checksums of MCAP files: no bit of a file that we wrote turns without being said."""

import contextlib
import shutil
import struct
import zlib

import numpy as np
import pytest

from sonar_imm_tools.recordings.mcap_records import CHUNK, MAGIC, RECORD, records, seal, wrong_sums
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.sources import RosbagsSource
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.resources import share_folder

TEXT = 'std_msgs/msg/String'
SHIPPED = sorted((share_folder() / 'bags').glob('*/*.mcap'))


def content(path):
    """What is read of a recording, and what is said of it."""
    with BagReader(path) as bag:
        topics = [(topic.name, topic.type_name, topic.count) for topic in bag.topics]
        found = [(item.topic, item.log_ns, bytes(item.raw)) for item in bag.messages(decode=False)]
        return (topics, found), bag.problems


def flipped(data, bit):
    spoilt = bytearray(data)
    spoilt[bit // 8] ^= 1 << bit % 8
    return spoilt


def chunks_of(path):
    """Where the chunks begin, and what follows the last."""
    with path.open('rb') as file:
        found = list(records(file, len(MAGIC), path.stat().st_size))
    starts = [position for position, code, _ in found if code == CHUNK]
    return starts, [position for position, _, _ in found if position > starts[-1]][0]


@pytest.fixture(scope='module', params=[False, True], ids=['plain', 'compressed'])
def long(request, tmp_path_factory):
    """A recording of several chunks, its messages in order."""
    folder = tmp_path_factory.mktemp('long')
    rng = np.random.default_rng(1)
    with BagWriter(folder / 'bag', compressed=request.param) as bag:
        for i in range(150):
            bag.write('/a', ros_message(TEXT, data=rng.bytes(15_000).hex()), i)
    return folder / 'bag' / 'bag.mcap'


@pytest.mark.parametrize('path', SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_recordings_have_all_checksums(path):
    data = path.read_bytes()
    (summary,) = struct.unpack('<Q', data[-28:-20])
    assert struct.unpack('<I', data[-12:-8]) == (zlib.crc32(data[summary:-12]),)
    assert struct.unpack('<I', data[summary - 4 : summary]) == (zlib.crc32(data[: summary - 13]),)
    starts, _ = chunks_of(path)
    assert all(data[start + 9 + 24 : start + 9 + 28] != bytes(4) for start in starts)
    assert not wrong_sums(path)


def test_no_bit_turns_in_a_shipped_recording_without_being_said(tmp_path):
    """Bits anywhere; then one of each byte at the ends, where a reader finds its way."""
    data = (share_folder() / 'bags' / 'diver_table1' / 'diver_table1.mcap').read_bytes()
    file = tmp_path / 'spoilt.mcap'
    file.write_bytes(data)
    whole, problems = content(file)
    assert not problems
    rng = np.random.default_rng(5)
    ends = [*range(0, 40, 2), *range(len(data) - 40, len(data))]
    bits = [*rng.integers(0, 8 * len(data), 100), *(8 * byte + rng.integers(8) for byte in ends)]
    for bit in bits:
        file.write_bytes(flipped(data, int(bit)))
        try:
            found, problems = content(file)
        except BagError as refused:
            assert '\n' not in refused.sentence
            continue
        assert problems and set(found[1]) <= set(whole[1]), bit


def test_a_damaged_chunk_is_named_and_costs_only_itself(long, tmp_path):
    """Also the first one, which holds the topics, and with a byte of its head."""
    data = long.read_bytes()
    (_, whole), _ = content(long)
    starts, end = chunks_of(long)
    assert len(starts) > 3
    file = tmp_path / 'spoilt.mcap'
    for start, after in [(starts[0], starts[1]), (starts[-1], end)]:
        for at in (0, 1, 9 + 16, 9 + 24, 9 + 28, (after - start) // 2):
            file.write_bytes(flipped(data, 8 * (start + at)))
            (_, found), (message,) = content(file)
            assert 0.5 * len(whole) < len(found) <= len(whole)
            assert [item for item in whole if item in set(found)] == found
            assert f'at byte {start}' in message or len(found) == len(whole), message
            if len(found) < len(whole):
                assert f'{len(found)} of {len(whole)} messages were recovered' in message


def test_damage_beside_the_messages_costs_none(long, tmp_path):
    data = long.read_bytes()
    whole, _ = content(long)
    (summary,) = struct.unpack('<Q', data[-28:-20])
    file = tmp_path / 'spoilt.mcap'
    for at in (12, 30, summary - 30, summary - 2, summary + 20, len(data) - 15, len(data) - 3):
        file.write_bytes(flipped(data, 8 * at))
        found, (message,) = content(file)
        assert found[1] == whole[1], at
        assert f'beside its messages; all {len(whole[1])} messages were recovered' in message


def test_a_chunk_is_checked_where_the_file_as_a_whole_has_no_checksum(long, tmp_path):
    """As ros2 bag record writes it: the damage is met on the way, and the rest still read."""
    data = bytearray(long.read_bytes())
    (summary,) = struct.unpack('<Q', data[-28:-20])
    data[summary - 4 : summary] = bytes(4)
    starts, _ = chunks_of(long)
    (_, whole), _ = content(long)
    file = tmp_path / 'spoilt.mcap'
    file.write_bytes(flipped(data, 8 * (starts[1] + 5000)))
    RosbagsSource(file).close()  # nothing is noticed at the start
    (_, found), (message,) = content(file)
    assert 0.5 * len(whole) < len(found) < len(whole) and set(found) < set(whole)
    assert found == sorted(found, key=lambda item: item[1])
    assert f'at byte {starts[1]}' in message
    with pytest.raises(BagError, match='checksum|damaged'), BagReader(file, strict=True) as bag:
        list(bag.messages())


def test_a_file_without_checksums_is_read_as_it_is(long, tmp_path):
    """As rosbags writes it by itself."""
    data = bytearray(long.read_bytes())
    (summary,) = struct.unpack('<Q', data[-28:-20])
    starts, _ = chunks_of(long)
    for at in (summary - 4, len(data) - 12, *(start + RECORD.size + 24 for start in starts)):
        data[at : at + 4] = bytes(4)
    file = tmp_path / 'bare.mcap'
    file.write_bytes(data)
    assert content(file) == content(long)
    seal(file)
    assert file.read_bytes() == long.read_bytes()


def test_what_has_no_summary_cannot_be_sealed(tmp_path):
    (tmp_path / 'x.mcap').write_bytes(MAGIC * 10)
    with pytest.raises(ValueError, match='summary'):
        seal(tmp_path / 'x.mcap')
    assert not wrong_sums(tmp_path / 'x.mcap')


@pytest.mark.parametrize('compressed', [False, True])
@pytest.mark.parametrize('size, step_ns, chunks', [(1000, 10**9, 4), (40_000, 10**6, 5)])
def test_a_bit_costs_one_chunk_of_a_short_recording(tmp_path, compressed, size, step_ns, chunks):
    """Less than a megabyte, and less than a minute: chunks end by time, or by size."""
    rng = np.random.default_rng(2)
    with BagWriter(tmp_path / 'bag', compressed=compressed) as bag:
        for i in range(40):
            bag.write('/a', ros_message(TEXT, data=rng.bytes(size // 2).hex()), i * step_ns)
    path = tmp_path / 'bag' / 'bag.mcap'
    (_, whole), problems = content(path)
    starts, _ = chunks_of(path)
    assert len(whole) == 40 and not problems and chunks <= len(starts) <= 2 * chunks
    for start in starts:
        (tmp_path / 'one.mcap').write_bytes(flipped(path.read_bytes(), 8 * (start + 100) + 3))
        (_, found), problems = content(tmp_path / 'one.mcap')
        assert problems and 0 < len(whole) - len(found) <= 40 // chunks + 1
        assert set(found) < set(whole)


def test_past_damage_is_read_where_the_recording_is_a_single_file(long, tmp_path):
    """The messages of several files are merged: which of them have been given is not known."""
    folder = shutil.copytree(long.parent, tmp_path / 'bag')
    for files, read_on in ((1, True), (2, False)):
        with contextlib.closing(RosbagsSource(folder)) as source:
            rest = source.rescue()
            assert (rest is not None) == read_on, files
            if rest:
                rest.close()
        shutil.copy(long, folder / 'bag_1.mcap')
