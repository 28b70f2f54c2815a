from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from sonar_imm.recordings import mcap_scan
from sonar_imm.recordings.mcap_scan import McapScan
from sonar_imm.recordings.messages import ros_message, typestore
from sonar_imm.recordings.reader import BagReader

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


def test_a_cut_keeps_whole_messages_of_the_last_chunk(recording, tmp_path):
    file, expected = recording
    data = file.read_bytes()
    chunks = []  # bytes where chunks begin
    position = len(mcap_scan.MAGIC)
    while data[position] != mcap_scan._DATA_END:
        if data[position] == mcap_scan._CHUNK:
            chunks.append(position)
        position += 9 + int.from_bytes(data[position + 1 : position + 9], 'little')
    assert len(chunks) > 1
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(data[: chunks[1] - 1])
    scan = McapScan(cut)
    first_chunk = sum(scan.counts.values())
    scan.close()
    assert 0 < first_chunk < 40
    end = [*chunks, position][2]
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
    at = data.index(b'\x06', len(mcap_scan.MAGIC) + 30)
    data[at + 9 + 28 : at + 9 + 32] = b'\x04\x00\x00\x00'
    data[at + 9 + 32 : at + 9 + 36] = b'zstf'  # a compression nobody knows
    broken = tmp_path / 'broken.mcap'
    broken.write_bytes(data)
    scan = McapScan(broken)
    assert 'damaged chunk' in scan.lost and set(messages(scan)) <= set(expected)
    scan.close()


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
        assert bytes(damaged[:8]) != mcap_scan.MAGIC
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
