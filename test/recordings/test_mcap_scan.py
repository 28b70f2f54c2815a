# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from collections import Counter
import os
from pathlib import Path
import struct
import subprocess
import sys
import zlib

from hypothesis import given, settings
from hypothesis import strategies as st
import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sonar_imm_tools.recordings import mcap_records
from sonar_imm_tools.recordings.mcap_records import McapScan, zstd
from sonar_imm_tools.recordings.messages import ros_message, typestore
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.sources import RosbagsSource

TEXT = 'std_msgs/msg/String'


def write(path, mode, n=40):
    """Write an MCAP of texts on two topics with unsorted log times; give (file, messages)."""
    rng = np.random.default_rng(3)  # bytes that zstd cannot reduce to nothing
    expected = []
    writer = Writer(path, version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        links = [writer.add_connection(name, TEXT, typestore=typestore()) for name in ('/a', '/b')]
        for i in range(n):
            raw = bytes(
                typestore().serialize_cdr(ros_message(TEXT, data=rng.bytes(30_000).hex()), TEXT)
            )
            log_ns = 1000 + (i * 7) % 5
            writer.write(links[i % 3 == 0], log_ns, raw)
            expected.append((log_ns, raw))
    return path / f'{path.name}.mcap', expected


def messages(scan):
    return [(log_ns, raw) for _, log_ns, raw in scan.messages(scan.channels)]


@pytest.fixture(scope='module', params=[CompressionMode.NONE, CompressionMode.STORAGE])
def recording(request, tmp_path_factory):
    return write(tmp_path_factory.mktemp('scan') / 'bag', request.param)


def test_a_scan_of_a_whole_file_equals_the_indexed_reading(recording):
    file, expected = recording
    scan = McapScan(file)
    assert messages(scan) == sorted(expected, key=lambda item: item[0])
    with BagReader(file) as bag:
        assert [(item.log_ns, item.raw) for item in bag.messages()] == messages(scan)
    assert not scan.lost and scan.counts == Counter({1: 26, 2: 14})
    assert {channel.topic for channel in scan.channels.values()} == {'/a', '/b'}
    scan.close()


@pytest.mark.skipif(sys.platform != 'linux', reason='asks Linux for open files')
def test_a_bag_without_chunks_is_read_by_scan_and_closed(recording, monkeypatch):
    file, expected = recording
    monkeypatch.setattr(RosbagsSource, 'unordered', True)
    with BagReader(file.parent) as bag:
        found = [(item.log_ns, item.raw) for item in bag.messages()]
    assert found == sorted(expected, key=lambda item: item[0])
    assert str(file) not in map(os.path.realpath, Path('/proc/self/fd').iterdir())


def test_a_cut_keeps_whole_messages_of_the_last_chunk(recording, tmp_path):
    file, expected = recording
    data = file.read_bytes()
    chunks = chunks_of(data)
    assert len(chunks) > 1
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(data[: chunks[1] - 1])
    scan = McapScan(cut)
    first_chunk = sum(scan.counts.values())
    scan.close()
    assert 0 < first_chunk < 40
    end = [*chunks, data.index(bytes([mcap_records.DATA_END]), chunks[-1])][2]
    cut.write_bytes(data[: (chunks[1] + 3 * end) // 4])
    scan = McapScan(cut)
    found = messages(scan)
    scan.close()
    assert scan.lost.startswith('is cut off')
    assert len(found) > first_chunk
    kept = expected[: len(found)]
    assert found == sorted(kept, key=lambda item: item[0])


def test_a_damaged_chunk_costs_only_itself(recording, tmp_path):
    file, expected = recording
    data = bytearray(file.read_bytes())
    at = data.index(b'\x06', len(mcap_records.MAGIC) + 30)
    data[at + 9 + 28 : at + 9 + 32] = b'\x04\x00\x00\x00'
    data[at + 9 + 32 : at + 9 + 36] = b'zstf'  # a compression nobody knows
    broken = tmp_path / 'broken.mcap'
    broken.write_bytes(data)
    scan = McapScan(broken)
    assert 'damaged chunk' in scan.lost and set(messages(scan)) <= set(expected)
    scan.close()


def chunks_of(data):
    """The bytes at which chunks begin."""
    found, position = [], len(mcap_records.MAGIC)
    while data[position] != mcap_records.DATA_END:
        if data[position] == mcap_records.CHUNK:
            found.append(position)
        position += 9 + int.from_bytes(data[position + 1 : position + 9], 'little')
    return found


def test_a_chunk_whose_checksum_is_wrong_is_not_believed(recording, tmp_path):
    """A wrong checksum, or, where nothing is compressed, one wrong bit in the text of a message:
    what is in the chunk is left out. A checksum of zero means that there is none."""
    file, expected = recording
    data = bytearray(file.read_bytes())
    first = chunks_of(data)[1]  # the channels stand in the one before
    where = slice(first + 9 + 24, first + 9 + 28)
    name_end = where.stop + 4 + int.from_bytes(data[where.stop : where.stop + 4], 'little')
    size = int.from_bytes(data[name_end : name_end + 8], 'little')
    packed = bytes(data[name_end + 8 : name_end + 8 + size])
    compressed = data[where.stop : where.stop + 4] != bytes(4)
    content = zstd.decompress(packed) if compressed else packed
    right = zlib.crc32(content).to_bytes(4, 'little')

    def scanned(checksum, content=packed):
        data[where] = checksum
        data[name_end + 8 : name_end + 8 + size] = content
        (tmp_path / 'spoilt.mcap').write_bytes(data)
        scan = McapScan(tmp_path / 'spoilt.mcap')
        found, lost = messages(scan), scan.lost
        scan.close()
        return found, lost

    whole = sorted(expected, key=lambda item: item[0])
    assert scanned(right) == (whole, '')
    assert scanned(bytes(4)) == (whole, '')
    found, lost = scanned((int.from_bytes(right, 'little') ^ 1).to_bytes(4, 'little'))
    assert lost == f'has a chunk at byte {first} whose checksum is wrong'
    assert 0 < len(found) < len(whole) and set(found) < set(whole)
    if not compressed:
        flipped = bytearray(packed)
        flipped[-1000] ^= 1
        assert scanned(right, flipped) == (found, lost)
        spoilt, lost = scanned(bytes(4), flipped)
        assert len(spoilt) == len(whole) and spoilt != whole and not lost


def test_zeros_after_a_power_loss_end_the_walk(recording, tmp_path):
    file, expected = recording
    data = file.read_bytes()
    broken = tmp_path / 'zeros.mcap'
    broken.write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))
    scan = McapScan(broken)
    assert 0 <= len(messages(scan)) < len(expected) and scan.lost
    scan.close()


def test_what_is_no_mcap_is_refused(tmp_path):
    (tmp_path / 'x.mcap').write_bytes(b'something else')
    with pytest.raises(ValueError, match='MCAP'):
        McapScan(tmp_path / 'x.mcap')


@given(cut=st.floats(0.0, 1.0), place=st.floats(0.0, 1.0), junk=st.binary(max_size=8))
@settings(max_examples=150, deadline=None)
def test_no_damage_raises_or_invents_messages(small, cut, place, junk):
    data, folder = small
    damaged = bytearray(data[: int(len(data) * cut)])
    at = int(len(damaged) * place)
    damaged[at : at + len(junk)] = junk
    file = folder / 'damaged.mcap'
    file.write_bytes(damaged)
    try:
        scan = McapScan(file)
    except ValueError:
        assert bytes(damaged[:8]) != mcap_records.MAGIC
        return
    assert len(messages(scan)) <= 5
    scan.close()


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp('small')
    path = folder / 'bag'
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection('/a', TEXT, typestore=typestore())
        for i in range(5):
            writer.write(link, i, typestore().serialize_cdr(ros_message(TEXT, data=str(i)), TEXT))
    return (path / 'bag.mcap').read_bytes(), folder


def bomb(path, compression, packed, stated):
    """An MCAP file with one chunk of `packed` bytes that states to hold `stated` bytes."""

    def text(value):
        return struct.pack('<I', len(value)) + value

    def framed(code, content):
        return struct.pack('<BQ', code, len(content)) + content

    head = framed(0x01, text(b'ros2') + text(b''))
    chunk = framed(
        0x06,
        struct.pack('<QQQI', 0, 0, stated, 0)
        + text(compression)
        + struct.pack('<Q', len(packed))
        + packed,
    )
    footer = framed(0x02, struct.pack('<QQI', 0, 0, 0))
    path.write_bytes(mcap_records.MAGIC + head + chunk + footer + mcap_records.MAGIC)
    return path


def zeros(compression, size, *, with_size):
    if compression == b'lz4':
        return lz4.frame.compress(bytes(size), store_size=with_size)
    stream = zstd.ZstdCompressor(options={zstd.CompressionParameter.content_size_flag: 1})
    if with_size:
        return zstd.compress(bytes(size))
    block = bytes(1 << 20)
    return b''.join(stream.compress(block) for _ in range(size >> 20)) + stream.flush()


@pytest.mark.parametrize(
    'compression, with_size, stated',
    [
        (b'zstd', True, 10),
        (b'zstd', False, 600 << 20),
        (b'lz4', True, 600 << 20),
        (b'lz4', False, 10),
    ],
)
def test_a_chunk_of_a_great_many_zeros_costs_no_memory(tmp_path, compression, with_size, stated):
    packed = zeros(compression, 600 << 20, with_size=with_size)
    file = bomb(tmp_path / 'bomb.mcap', compression, packed, stated)
    code = (
        'import sys; from sonar_imm_tools.cli import main; status = main(["info", sys.argv[1]]); '
        'print(*(line for line in open("/proc/self/status") if line.startswith("VmHWM"))); '
        'sys.exit(status)'
    )
    done = subprocess.run(
        [sys.executable, '-c', code, str(file)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert 'unpacks to more than 128 MiB' in done.stdout + done.stderr
    peak_kb = int(done.stdout.split()[-2])
    assert peak_kb < 600_000  # the 600 MiB of zeros would not fit


def test_an_honest_size_below_the_limit_is_unpacked():
    assert mcap_records.unpack(zstd.compress(bytes(1000)), 'zstd') == bytes(1000)
    assert mcap_records.unpack(lz4.frame.compress(bytes(1000)), 'lz4') == bytes(1000)
    with pytest.raises(mcap_records.TooLargeError):
        mcap_records.unpack(zstd.compress(bytes(mcap_records.MAX_UNPACKED + 1)), 'zstd')


@pytest.mark.parametrize('with_size', [True, False])
def test_a_packed_file_of_zeros_is_not_written_to_disk(tmp_path, with_size, monkeypatch):
    """rosbags unpacks a bag that is packed as a whole into a folder, without a limit."""
    monkeypatch.setattr(mcap_records, 'MAX_UNPACKED', 1 << 20)
    path = tmp_path / 'bag'
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        link = writer.add_connection('/a', TEXT, typestore=typestore())
        writer.write(link, 1, typestore().serialize_cdr(ros_message(TEXT, data='x'), TEXT))
    metadata = path / 'metadata.yaml'
    given = metadata.read_text().replace("compression_mode: ''", 'compression_mode: file')
    given = given.replace("compression_format: ''", 'compression_format: zstd')
    metadata.write_text(given.replace('bag.mcap', 'bag.mcap.zstd'))
    plain = (path / 'bag.mcap').read_bytes()
    (path / 'bag.mcap').unlink()
    packed = path / 'bag.mcap.zstd'
    packed.write_bytes(zstd.compress(plain))
    with BagReader(path) as bag:
        assert len(list(bag.messages())) == 1 and not bag.problems
    packed.write_bytes(zeros(b'zstd', 40 << 20, with_size=with_size))
    with pytest.raises(BagError, match='unpacks to more than 1 MiB'), BagReader(path):
        pass


def test_a_packed_message_of_zeros_costs_itself(tmp_path, monkeypatch):
    path = tmp_path / 'bag'
    monkeypatch.setattr(mcap_records, 'MAX_UNPACKED', 1 << 20)
    writer = Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        link = writer.add_connection('/a', TEXT, typestore=typestore())
        raw = bytes(typestore().serialize_cdr(ros_message(TEXT, data='x'), TEXT))
        for i, data in enumerate([raw, bytes(4 << 20), raw]):
            writer.write(link, i, data)
    with BagReader(path) as bag:
        assert [item.log_ns for item in bag.messages()] == [0, 2]
        assert 'message 1, it unpacks to more than' in bag.problems[0]
