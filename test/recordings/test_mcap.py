# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from collections import Counter
import contextlib
import os
from pathlib import Path
import shutil
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
from sonar_imm_tools.recordings.mcap_records import MAGIC, McapScan, RECORD, seal, wrong_sums, zstd
from sonar_imm_tools.recordings.messages import cdr_of, ros_message, typestore
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.sources import RosbagsSource
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.resources import share_folder

TEXT = 'std_msgs/msg/String'


def text_of(data):
    return ros_message(TEXT, data=data)


def write(path, texts, mode=CompressionMode.NONE):
    """An MCAP of texts on two topics with unsorted log times; give (file, messages)."""
    writer, expected = Writer(path, version=8, storage_plugin=StoragePlugin.MCAP), []
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        links = [writer.add_connection(name, TEXT, typestore=typestore()) for name in ('/a', '/b')]
        for i, text in enumerate(texts):
            log_ns, raw = 1000 + (i * 7) % 5, cdr_of(text_of(text))
            writer.write(links[i % 3 == 0], log_ns, raw)
            expected.append((log_ns, raw))
    return path / f'{path.name}.mcap', expected


def in_order(messages):
    return sorted(messages, key=lambda item: item[0])


def rescued(messages, whole):
    """Some are found, and nothing that was not there."""
    return 0 < len(messages) < len(whole) and set(messages) < set(whole)


def scanned(path, data):
    """The messages that a scan finds in a file of `data`, and what is lost."""
    path.write_bytes(data)
    scan = McapScan(path)
    found = [(log_ns, raw) for _, log_ns, raw in scan.messages(scan.channels)]
    scan.close()
    return found, scan.lost


@pytest.fixture(scope='module', params=[CompressionMode.NONE, CompressionMode.STORAGE])
def recording(request, tmp_path_factory):
    rng = np.random.default_rng(3)  # bytes that zstd cannot reduce to nothing
    texts = [rng.bytes(30_000).hex() for _ in range(40)]
    return write(tmp_path_factory.mktemp('scan') / 'bag', texts, request.param)


def test_a_scan_of_a_whole_file_equals_the_indexed_reading(recording):
    file, expected = recording
    found, lost = scanned(file, file.read_bytes())
    assert found == in_order(expected) and not lost
    with BagReader(file) as bag:
        assert [(item.log_ns, item.raw) for item in bag.messages()] == found
    with contextlib.closing(McapScan(file)) as scan:
        assert scan.counts == Counter({1: 26, 2: 14})
        assert {channel.topic for channel in scan.channels.values()} == {'/a', '/b'}


@pytest.mark.skipif(sys.platform != 'linux', reason='asks Linux for open files')
def test_a_bag_without_chunks_is_read_by_scan_and_closed(recording, monkeypatch):
    file, expected = recording
    monkeypatch.setattr(RosbagsSource, 'unordered', True)
    with BagReader(file.parent) as bag:
        assert [(item.log_ns, item.raw) for item in bag.messages()] == in_order(expected)
    assert str(file) not in map(os.path.realpath, Path('/proc/self/fd').iterdir())


def test_a_cut_keeps_whole_messages_of_the_last_chunk(recording, tmp_path):
    file, expected = recording
    data, cut = file.read_bytes(), tmp_path / 'cut.mcap'
    chunks, end = chunks_of(file)
    assert len(chunks) > 1
    before, _ = scanned(cut, data[: chunks[1] - 1])
    assert 0 < len(before) < 40
    end = [*chunks, end][2]
    found, lost = scanned(cut, data[: (chunks[1] + 3 * end) // 4])
    assert lost.startswith('is cut off') and len(found) > len(before)
    assert found == in_order(expected[: len(found)])
    # Zeros after a power loss end the walk.
    found, lost = scanned(cut, data[: len(data) // 2] + bytes(len(data) // 2))
    assert 0 <= len(found) < len(expected) and lost
    with pytest.raises(ValueError, match='MCAP'):
        scanned(cut, b'something else')
    # A chunk of a compression that nobody knows costs only itself.
    data = bytearray(data)
    at = data.index(b'\x06', len(MAGIC) + 30)
    data[at + 9 + 28 : at + 9 + 36] = b'\x04\x00\x00\x00zstf'
    found, lost = scanned(cut, data)
    assert 'damaged chunk' in lost and set(found) <= set(expected)


@given(cut=st.floats(0.0, 1.0), place=st.floats(0.0, 1.0), junk=st.binary(max_size=8))
@settings(max_examples=150)
def test_no_damage_raises_or_invents_messages(small, cut, place, junk):
    data, folder = small
    damaged = bytearray(data[: int(len(data) * cut)])
    at = int(len(damaged) * place)
    damaged[at : at + len(junk)] = junk
    try:
        assert len(scanned(folder / 'damaged.mcap', damaged)[0]) <= 5
    except ValueError:
        assert bytes(damaged[:8]) != MAGIC


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp('small')
    return write(folder / 'bag', '01234')[0].read_bytes(), folder


def bomb(path, compression, packed, stated):
    """An MCAP file with one chunk of `packed` bytes that states to hold `stated` bytes."""

    def text(value):
        return struct.pack('<I', len(value)) + value

    def framed(code, content):
        return struct.pack('<BQ', code, len(content)) + content

    head, size = struct.pack('<QQQI', 0, 0, stated, 0), struct.pack('<Q', len(packed))
    chunk = framed(0x06, head + text(compression) + size + packed)
    begin = MAGIC + framed(0x01, text(b'ros2') + text(b''))
    path.write_bytes(begin + chunk + framed(0x02, bytes(20)) + MAGIC)
    return path


def zeros(compression, size, *, with_size):
    if compression == b'lz4':
        return lz4.frame.compress(bytes(size), store_size=with_size)
    stream = zstd.ZstdCompressor(options={zstd.CompressionParameter.content_size_flag: 1})
    if with_size:
        return zstd.compress(bytes(size))
    block = bytes(1 << 20)
    return b''.join(stream.compress(block) for _ in range(size >> 20)) + stream.flush()


def test_chunks_of_a_great_many_zeros_cost_no_memory(tmp_path):
    files = []
    for compression, with_size, stated in (
        (b'zstd', True, 10), (b'zstd', False, 600 << 20), (b'lz4', True, 600 << 20),
        (b'lz4', False, 10),
    ):  # fmt: skip
        packed = zeros(compression, 600 << 20, with_size=with_size)
        files.append(bomb(tmp_path / f'{len(files)}.mcap', compression, packed, stated))
    code = (
        'import sys; from sonar_imm_tools.cli import main; '
        'assert [main(["info", each]) for each in sys.argv[1:]] == [1, 1, 1, 1]; '
        'print(*(line for line in open("/proc/self/status") if line.startswith("VmHWM")))'
    )
    words = [sys.executable, '-c', code, *files]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and 'Traceback' not in done.stderr
    assert (done.stdout + done.stderr).count('unpacks to more than 128 MiB') == 4
    assert int(done.stdout.split()[-2]) < 600_000  # kB: the 600 MiB of zeros would not fit


def test_an_honest_size_below_the_limit_is_unpacked():
    assert mcap_records.unpack(zstd.compress(bytes(1000)), 'zstd') == bytes(1000)
    assert mcap_records.unpack(lz4.frame.compress(bytes(1000)), 'lz4') == bytes(1000)
    with pytest.raises(mcap_records.TooLargeError):
        mcap_records.unpack(zstd.compress(bytes(mcap_records.MAX_UNPACKED + 1)), 'zstd')


def test_a_packed_file_of_zeros_is_not_written_to_disk(tmp_path, monkeypatch):
    """rosbags unpacks a bag that is packed as a whole into a folder, without a limit."""
    monkeypatch.setattr(mcap_records, 'MAX_UNPACKED', 1 << 20)
    path = write(tmp_path / 'bag', 'x')[0].parent
    text = (path / 'metadata.yaml').read_text().replace('bag.mcap', 'bag.mcap.zstd')
    text = text.replace("compression_mode: ''", 'compression_mode: file')
    text = text.replace("compression_format: ''", 'compression_format: zstd')
    (path / 'metadata.yaml').write_text(text)
    packed = (path / 'bag.mcap').rename(path / 'bag.mcap.zstd')
    packed.write_bytes(zstd.compress(packed.read_bytes()))
    with BagReader(path) as bag:
        assert len(list(bag.messages())) == 1 and not bag.problems
    for with_size in (True, False):
        packed.write_bytes(zeros(b'zstd', 40 << 20, with_size=with_size))
        with pytest.raises(BagError, match='unpacks to more than 1 MiB'), BagReader(path):
            pass


def test_a_packed_message_of_zeros_costs_itself(tmp_path, monkeypatch):
    path, raw = tmp_path / 'bag', cdr_of(text_of('x'))
    monkeypatch.setattr(mcap_records, 'MAX_UNPACKED', 1 << 20)
    writer = Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        link = writer.add_connection('/a', TEXT, typestore=typestore())
        for i, data in enumerate([raw, bytes(4 << 20), raw]):
            writer.write(link, i, data)
    with BagReader(path) as bag:
        assert [item.log_ns for item in bag.messages()] == [0, 2]
        assert 'message 1, it unpacks to more than' in bag.problems[0]


# -- checksums: no bit of a file that we wrote turns without being said


SHIPPED = sorted((share_folder() / 'bags').glob('*/*.mcap'))


def content(path):
    """What is read of a recording, and what is said of it."""
    with BagReader(path) as bag:
        topics = [(topic.name, topic.type_name, topic.count) for topic in bag.topics]
        found = [(item.topic, item.log_ns, bytes(item.raw)) for item in bag.messages(decode=False)]
        return (topics, found), bag.problems


def summary_of(data):
    """Where the summary begins."""
    return struct.unpack('<Q', data[-28:-20])[0]


def flipped(data, bit):
    spoilt = bytearray(data)
    spoilt[bit // 8] ^= 1 << bit % 8
    return spoilt


def chunks_of(path):
    """Where the chunks begin, and what follows the last."""
    with path.open('rb') as file:
        found = list(mcap_records.records(file, len(MAGIC), path.stat().st_size))
    starts = [position for position, code, _ in found if code == mcap_records.CHUNK]
    return starts, [position for position, _, _ in found if position > starts[-1]][0]


def of_length(path, count, size, step_ns, compressed):
    rng = np.random.default_rng(1)
    with BagWriter(path, compressed=compressed) as bag:
        for i in range(count):
            bag.write('/a', text_of(rng.bytes(size).hex()), i * step_ns)
    return path / 'bag.mcap'


@pytest.fixture(scope='module', params=[False, True], ids=['plain', 'compressed'])
def long(request, tmp_path_factory):
    """A recording of several chunks, its messages in order."""
    return of_length(tmp_path_factory.mktemp('long') / 'bag', 150, 15_000, 1, request.param)


@pytest.fixture
def spoilt(tmp_path):
    """What is read of a file of these bytes."""

    def run(data):
        (tmp_path / 'spoilt.mcap').write_bytes(data)
        return content(tmp_path / 'spoilt.mcap')

    return run


def test_the_shipped_recordings_have_all_checksums():
    for path in SHIPPED:
        data = path.read_bytes()
        end = summary_of(data)
        assert struct.unpack('<I', data[-12:-8]) == (zlib.crc32(data[end:-12]),)
        assert struct.unpack('<I', data[end - 4 : end]) == (zlib.crc32(data[: end - 13]),)
        starts, _ = chunks_of(path)
        assert all(data[start + 9 + 24 : start + 9 + 28] != bytes(4) for start in starts)
        assert not wrong_sums(path)


def test_no_bit_turns_in_a_shipped_recording_without_being_said(spoilt):
    """Bits anywhere; then one of each byte at the ends, where a reader finds its way."""
    data = (share_folder() / 'bags' / 'diver_table1' / 'diver_table1.mcap').read_bytes()
    whole, problems = spoilt(data)
    assert not problems
    rng = np.random.default_rng(5)
    ends = [*range(0, 40, 2), *range(len(data) - 40, len(data), 2)]
    bits = [*rng.integers(0, 8 * len(data), 60), *(8 * byte + rng.integers(8) for byte in ends)]
    for bit in bits:
        try:
            found, problems = spoilt(flipped(data, int(bit)))
        except BagError as refused:
            assert '\n' not in refused.sentence
            continue
        assert problems and set(found[1]) <= set(whole[1]), bit


def test_a_damaged_chunk_is_named_and_costs_only_itself(long, spoilt):
    """Also the first one, which holds the topics, and with a byte of its head."""
    data = long.read_bytes()
    (_, whole), _ = content(long)
    starts, end = chunks_of(long)
    assert len(starts) > 3
    for start, after in [(starts[0], starts[1]), (starts[-1], end)]:
        for at in (0, 1, 9 + 16, 9 + 24, 9 + 28, (after - start) // 2):
            (_, found), (message,) = spoilt(flipped(data, 8 * (start + at)))
            assert 0.5 * len(whole) < len(found) <= len(whole)
            assert [item for item in whole if item in set(found)] == found
            assert f'at byte {start}' in message or len(found) == len(whole), message
            if len(found) < len(whole):
                assert f'{len(found)} of {len(whole)} messages were recovered' in message


def test_damage_beside_the_messages_costs_none(long, spoilt):
    data = long.read_bytes()
    whole, _ = content(long)
    summary = summary_of(data)
    for at in (12, 30, summary - 30, summary - 2, summary + 20, len(data) - 15, len(data) - 3):
        found, (message,) = spoilt(flipped(data, 8 * at))
        assert found[1] == whole[1], at
        assert f'beside its messages; all {len(whole[1])} messages were recovered' in message


def test_a_chunk_is_checked_where_the_file_as_a_whole_has_no_checksum(long, tmp_path, spoilt):
    """As ros2 bag record writes it: the damage is met on the way, and the rest still read."""
    data = bytearray(long.read_bytes())
    summary = summary_of(data)
    data[summary - 4 : summary] = bytes(4)
    starts, _ = chunks_of(long)
    (_, whole), _ = content(long)
    (_, found), (message,) = spoilt(flipped(data, 8 * (starts[1] + 5000)))
    file = tmp_path / 'spoilt.mcap'
    RosbagsSource(file).close()  # nothing is noticed at the start
    assert 0.5 * len(whole) < len(found) and rescued(found, whole)
    assert found == sorted(found, key=lambda item: item[1])
    assert f'at byte {starts[1]}' in message
    with pytest.raises(BagError, match='checksum|damaged'), BagReader(file, strict=True) as bag:
        list(bag.messages())


def test_a_file_without_checksums_is_read_as_it_is(long, tmp_path, spoilt):
    """As rosbags writes it by itself."""
    data, file = bytearray(long.read_bytes()), tmp_path / 'spoilt.mcap'
    summary = summary_of(data)
    starts, _ = chunks_of(long)
    for at in (summary - 4, len(data) - 12, *(start + RECORD.size + 24 for start in starts)):
        data[at : at + 4] = bytes(4)
    assert spoilt(data) == content(long)
    seal(file)
    assert file.read_bytes() == long.read_bytes()
    # What has no summary cannot be sealed.
    file.write_bytes(MAGIC * 10)
    with pytest.raises(ValueError, match='summary'):
        seal(file)
    assert not wrong_sums(file)


@pytest.mark.parametrize('how, chunks', [((500, 10**9, False), 4), ((20_000, 10**6, True), 5)])
def test_a_bit_costs_one_chunk_of_a_short_recording(tmp_path, spoilt, how, chunks):
    """Less than a megabyte, and less than a minute: chunks end by time, or by size."""
    path = of_length(tmp_path / 'bag', 40, *how)
    (_, whole), problems = content(path)
    starts, _ = chunks_of(path)
    assert len(whole) == 40 and not problems and chunks <= len(starts) <= 2 * chunks
    for start in starts:
        (_, found), problems = spoilt(flipped(path.read_bytes(), 8 * (start + 100) + 3))
        assert problems and rescued(found, whole)
        assert len(whole) - len(found) <= 40 // chunks + 1


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
