# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import contextlib
import shutil
import sqlite3
import struct
import time

from helpers.refusals import multiplying
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings import mcap_records
from sonar_imm_tools.recordings.messages import cdr_of, ros_message, typestore
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.writer import BagWriter

FIX = 'geometry_msgs/msg/PoseWithCovarianceStamped'
CUSTOM = 'my_msgs/msg/Custom'
TOPICS = 'topics_with_message_count'
KINDS = [
    (plugin, mode)
    for plugin in StoragePlugin
    for mode in CompressionMode
    if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)
]


def storage_file(path):
    return next(file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))


def read(path, **options):
    with BagReader(path, **options) as bag:
        return list(bag.messages()), bag.problems


def seen(items):
    return [item.message.pose.pose.position.x for item in items]


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def fixes(path, messages, plugin=StoragePlugin.MCAP, mode=CompressionMode.NONE, version=8):
    """A recording of these fixes by rosbags, one each nanosecond from 10 on."""
    writer = Writer(path, version=version, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        link = writer.add_connection('/fix', FIX, typestore=typestore())
        for log_ns, message in enumerate(messages, start=10):
            writer.write(link, log_ns, cdr_of(message))
    return path


def defined_as(path, definition):
    """A recording of one message, whose type is stated like that."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        link = bag.add_connection('/t', CUSTOM, msgdef=definition, rihs01=f'RIHS01_{"0" * 64}')
        bag.write(link, 1, b'\0\1\0\0' + bytes(64))
    return path


def a_part(name, body):
    return f'\n{"=" * 80}\nMSG: my_msgs/{name}\n{body}'


def nested(depth, width):
    """Types within types, each with so many of the next one."""
    parts = [
        a_part(f'A{k}', '\n'.join(f'my_msgs/A{k + 1} a{j}' for j in range(width)))
        for k in range(depth)
    ]
    return ''.join(['my_msgs/A0 a', *parts, a_part(f'A{depth}', 'int32 z')])


DEFINITIONS = {
    'circular': 'my_msgs/A a' + a_part('A', 'my_msgs/B b') + a_part('B', 'my_msgs/A a'),
    'deep': nested(1100, 1),
    'wide': nested(20, 10),
    'huge array': 'float64[2000000000] x',
    'many fields': '\n'.join(f'float64 f{k}' for k in range(30_000)),
    'many constants': '\n'.join(f'int32 C{k}={k}' for k in range(30_000)) + '\nint32 a',
    'long line': f'int32[] a [{"1, " * 500_000}1]',
    'long number': f'int32[{"9" * 10_000}] a',
}


class TestDefinitions:
    """What rosbags would parse or unpack for minutes, or for ever."""

    @pytest.mark.parametrize('kind', DEFINITIONS)
    def test_that_multiply_cost_a_sentence(self, tmp_path, kind):
        path = defined_as(tmp_path / 'bag', DEFINITIONS[kind])
        before = time.process_time()
        try:
            items, problems = read(path)
        except BagError as error:
            items, problems = [], [error.sentence]
        assert time.process_time() - before < 10.0
        assert not items and problems
        assert all(len(problem) < 2000 and '\n' not in problem for problem in problems)

    def test_large_ones_that_are_in_use_are_read(self, tmp_path):
        fields = '\n'.join(f'# What field {k} is.\nfloat64 f{k}' for k in range(400))
        path = defined_as(tmp_path / 'bag', fields + '\n#' * 10_000)
        with BagReader(path) as bag:
            assert bag.topics[0].decodable

    def test_metadata_whose_anchors_multiply_are_left_unread(self, write_fixes):
        for value in ('[{}]', '{{<<: [{}]}}'):
            path = write_fixes(5, name=f'bag{len(value)}')
            metadata = path / 'metadata.yaml'
            metadata.write_text(multiplying(value) + '\n' + metadata.read_text())
            before = time.process_time()
            items, problems = read(path)
            assert time.process_time() - before < 5.0
            assert len(items) == 5 and 'its anchors multiply' in problems[0]


class TestWhole:
    @pytest.mark.parametrize('plugin, mode', KINDS)
    def test_every_kind_of_rosbag2(self, tmp_path, fix_message, plugin, mode):
        """In folders of any name."""
        for version, name in ((8, 'dive.bag'), (9, 'dive.v2')):
            path = fixes(tmp_path / name, map(fix_message, range(5)), plugin, mode, version)
            items, problems = read(path)
            assert [item.log_ns for item in items] == [10, 11, 12, 13, 14] and not problems
            assert seen(items) == [item.index for item in items] == [0, 1, 2, 3, 4]

    @pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
    def test_a_bare_file_and_a_directory_without_metadata(self, write_fixes, storage):
        path = write_fixes(storage=storage)
        file = storage_file(path)
        assert len(read(file)[0]) == 50 and not read(file)[1]
        assert len(read(path / 'metadata.yaml')[0]) == 50
        file.rename(path / f'other{file.suffix}')
        items, problems = read(path)
        assert len(items) == 50 and 'missing' in problems[0]
        (path / 'metadata.yaml').unlink()
        items, problems = read(path)
        assert len(items) == 50 and len(problems) == 1 and 'no metadata.yaml' in problems[0]

    def test_compressed_ones_without_the_metadata_that_tell_of_it(
        self, tmp_path, fix_message, write_fixes
    ):
        for plugin in StoragePlugin:
            path = fixes(tmp_path / plugin.name, [fix_message(7)], plugin, CompressionMode.MESSAGE)
            (path / 'metadata.yaml').unlink()
            assert seen(read(path)[0]) == [7]
        path = write_fixes()
        storage_file(path).rename(path / 'bag.mcap.zstd')
        (path / 'metadata.yaml').unlink()
        with pytest.raises(BagError, match='bag.mcap.zstd.*unpack'):
            read(path)

    def test_a_ros_1_bag(self, tmp_path):
        store, kind = get_typestore(Stores.ROS1_NOETIC), 'geometry_msgs/msg/PointStamped'
        types = store.types
        with Writer1(tmp_path / 'old.bag') as writer:
            link = writer.add_connection('/fix', kind, typestore=store)
            stamp = types['builtin_interfaces/msg/Time'](sec=5, nanosec=7)
            header = types['std_msgs/msg/Header'](seq=1, stamp=stamp, frame_id='map')
            point = types['geometry_msgs/msg/Point'](x=1.0, y=2.0, z=3.0)
            writer.write(link, 9, store.serialize_ros1(types[kind](header, point), kind))
        items, problems = read(tmp_path / 'old.bag')
        assert items[0].message.point.y == 2.0 and items[0].type_name == kind and not problems

    def test_files_of_a_split_bag_are_merged_by_log_time(self, tmp_path, fix_message):
        split = tmp_path / 'split'
        split.mkdir()
        for number, logs in (('2', [30, 50]), ('10', [40, 50])):
            with BagWriter(tmp_path / f's_{number}') as bag:
                for log in logs:
                    bag.write('/fix', fix_message(int(number)), log)
            shutil.copy(tmp_path / f's_{number}' / f's_{number}.mcap', split)
        items, _ = read(split)
        assert [item.log_ns for item in items] == [30, 40, 50, 50]
        assert seen(items) == [2, 10, 2, 10]
        with BagReader(split) as bag:
            assert [(topic.name, topic.count) for topic in bag.topics] == [('/fix', 4)]


def test_recorded_order_is_log_time_and_stamp_order_undoes_lateness(tmp_path, fix_message):
    with BagWriter(tmp_path / 'bag') as bag:
        for i, log in ((2, 10), (0, 20), (1, 20), (3, 5)):
            bag.write('/fix', fix_message(i), log)
        bag.write('/note', ros_message('std_msgs/msg/String', data='no stamp'), 7)
    with BagReader(tmp_path / 'bag') as bag:
        assert seen(bag.messages(['/fix'])) == [3, 2, 0, 1]  # then the order of the file
        items = list(bag.messages(order='stamp'))
        assert items[0].topic == '/note' and seen(items[1:]) == [0, 1, 2, 3]
        assert [item.index for item in items] == [1, 3, 4, 2, 0]
        with pytest.raises(ValueError, match='recorded, stamp'):
            next(bag.messages(order='random'))
        # Without decoding the bytes remain, and an unknown topic gives nothing.
        item = next(bag.messages(['/note'], decode=False))
        assert item.message is None
        assert typestore().deserialize_cdr(item.raw, item.type_name).data == 'no stamp'
        assert list(bag.messages(['/other'])) == [] and list(bag.messages([])) == []


class TestDamage:
    @pytest.mark.parametrize('share', [0.3, 0.9, 0.999])
    def test_a_truncated_mcap_gives_what_is_before_the_damage(self, write_fixes, share):
        path = write_fixes()
        whole = read(path)[0]
        file = storage_file(path)
        cut(file, share)
        for target in (path, file):
            items, problems = read(target)
            assert 50 * share * 0.7 < len(items) <= 50
            assert [item.raw for item in items] == [item.raw for item in whole[: len(items)]]
            assert f'{len(items)} messages' in problems[-1] and 'recovered' in problems[-1]
            with pytest.raises(BagError), BagReader(target, strict=True):
                pass

    def test_a_truncated_db3_is_one_sentence_and_one_without_its_end_a_problem(self, write_fixes):
        for share in (0.0, 0.2, 0.9):
            path = write_fixes(500, name=f'bag{share}', storage='sqlite3')
            data = storage_file(path).read_bytes()
            cut(storage_file(path), share)
            with pytest.raises(BagError, match=r'sqlite3 bag.*db3 .recover') as caught:
                read(path)
            assert '\n' not in caught.value.sentence
        storage_file(path).write_bytes(data[: len(data) - 1000])
        items, problems = read(path)
        if len(items) == 500:
            pytest.skip('this SQLite writes the index last, of which no message has need')
        assert 0 < len(items) < 500 and 'damaged' in problems[0] and 'lost' in problems[0]
        with pytest.raises(BagError, match='damaged'):
            read(path, strict=True)

    def test_rows_in_a_write_ahead_log_are_told(self, write_fixes):
        path = write_fixes(3, storage='sqlite3')
        log = path / 'bag.db3-wal'
        log.touch()
        assert not read(path)[1]
        log.write_bytes(bytes(100))
        for target in (path, path / 'bag.db3'):
            items, problems = read(target)
            assert len(items) == 3 and 'bag.db3-wal holds 100 bytes' in problems[0]
        log.unlink()
        recorder = sqlite3.connect(path / 'bag.db3')
        recorder.execute('pragma journal_mode=wal')
        recorder.execute("insert into messages (topic_id, timestamp, data) values (1, 9, x'00')")
        recorder.commit()
        copy = shutil.copytree(path, path.parent / 'crashed')
        recorder.close()
        items, problems = read(copy)
        assert len(items) == 3 and 'not read' in problems[0]

    def test_a_flipped_bit_costs_one_message_not_the_bag(self, tmp_path, fix_message):
        with BagWriter(tmp_path / 'bag') as bag:
            for i in range(5):
                raw = bytearray(cdr_of(fix_message(i)))
                if i in (1, 3, 4):
                    raw[12:16] = struct.pack('<I', 2**31)  # length of frame_id
                bag.write_raw('/other' if i == 4 else '/fix', FIX, bytes(raw), i)
        items, problems = read(tmp_path / 'bag')
        assert [item.index for item in items] == [0, 2]
        given = '/fix: 2 messages could not be decoded (the first: message 1,'
        assert problems[0].startswith(f'topic {given}')
        assert problems[1].startswith('topic /other: 1 message could not be decoded')
        with pytest.raises(BagError, match='message 1'):
            read(tmp_path / 'bag', strict=True)

    def test_what_is_no_recording_is_one_sentence(self, tmp_path):
        for k, (name, content) in enumerate((
            ('no', None), ('x.mcap', b''), ('x.mcap', b'nonsense'), ('x.db3', b'nonsense' * 100),
            ('x.bag', b'nonsense'), ('x.txt', b''), ('x.mcap.zstd', b''), ('dir', 'dir'),
            ('x.mcap', b'\x89MCAP0\r\n'), ('x.bag', b''),
        )):  # fmt: skip
            path = tmp_path / f'{k}_{name}'
            if content == 'dir':
                path.mkdir()
            elif content is not None:
                path.write_bytes(content)
            try:
                items, problems = read(path)
            except BagError as error:
                assert str(path) in error.sentence and '\n' not in error.sentence
            else:
                assert not items and 'cut off' in problems[0]


def custom(path, gone=''):
    """A recording by sqlite3 of /custom of a type nobody knows, and /text; gone: which definitions
    it lacks, in SQL."""
    store, text = get_typestore(Stores.ROS2_JAZZY), 'std_msgs/msg/String'
    store.register(get_types_from_msg('float64 value', CUSTOM))
    known = ('/custom', CUSTOM, {'value': 2.5}), ('/text', text, {'data': 'hello'})
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for log_ns, (topic, kind, values) in enumerate(known, start=1):
            link = writer.add_connection(topic, kind, typestore=store)
            writer.write(link, log_ns, store.serialize_cdr(store.types[kind](**values), kind))
    if gone:
        with contextlib.closing(sqlite3.connect(storage_file(path))) as database, database:
            database.execute(f'delete from message_definitions where topic_type {gone}')
    return path


def test_a_type_defined_in_the_bag_is_read_and_a_known_one_needs_no_definition(tmp_path):
    """Where none is in the bag, and where only those of other types are."""
    both = ['/custom', '/text']
    for gone, topics in (('', both), ("like '%'", both[1:]), ("like 'std_msgs%'", both)):
        items, problems = read(custom(tmp_path / f'bag{len(gone)}', gone))
        assert [item.topic for item in items] == topics
        if topics == both:
            assert items[0].message.value == 2.5 and not problems
        else:
            assert CUSTOM in problems[0]
    # An undefined type is told and the rest is read.
    with BagReader(custom(tmp_path / 'bag', f"= '{CUSTOM}'")) as bag:
        known = [(topic.name, topic.decodable) for topic in bag.topics]
        assert known == [('/custom', False), ('/text', True)]
        assert CUSTOM in bag.problems[0]
        assert [item.message.data for item in bag.messages(['/text'])] == ['hello']
        assert [item.topic for item in bag.messages()] == ['/text']
        assert 'could not be decoded' in bag.problems[1]


COUNT, NAME = (TOPICS, 0, 'message_count'), (TOPICS, 0, 'topic_metadata', 'name')


def test_metadata_of_a_wrong_kind_are_told_and_the_files_are_read(write_fixes):
    path = write_fixes(3)
    text = (path / 'metadata.yaml').read_text()
    wrong = ('many', -5, 10**20, 1e20)
    for place, value, sentence in (
        *((COUNT, value, f'message count of {value}') for value in wrong),
        (NAME, [5], 'is no text'), (NAME, 5, 'is no text'),
        (('files',), 'none', 'a list of files that is none'), ((), '{[', ''),
    ):  # fmt: skip
        metadata = yaml.safe_load(text)
        inside = metadata['rosbag2_bagfile_information']
        for key in place[:-1]:
            inside = inside[key]
        if place:
            inside[place[-1]] = value
        (path / 'metadata.yaml').write_text(yaml.safe_dump(metadata) if place else value)
        items, problems = read(path)
        assert len(items) == 3 and '\n' not in problems[0]
        assert sentence in problems[0]


@pytest.mark.parametrize('storage, held', [('MCAP', 0), ('MCAP', 4), ('SQLITE3', 4)])
def test_an_index_that_speaks_of_more_messages_is_told(
    tmp_path, fix_message, storage, held, capsys
):
    path = fixes(tmp_path / 'bag', map(fix_message, range(held)), StoragePlugin[storage])
    text = (path / 'metadata.yaml').read_text().replace(f'count: {held}', 'count: 101')
    (path / 'metadata.yaml').write_text(text)
    sentence = f'topic /fix holds {held} messages; the index of {path} says 101'
    assert sentence in read(path)[1]
    with pytest.raises(BagError, match='says 101'):
        read(path, strict=True)
    for words in (['info', str(path)], ['track', str(path), str(tmp_path / 'out')]):
        assert main(words) == (0 if held else 1)
        assert f'problem: {sentence}' in capsys.readouterr().out


def test_statistics_of_a_file_that_speak_of_more_messages_are_told(tmp_path):
    file = storage_file(fixes(tmp_path / 'none', []))
    content = bytearray(file.read_bytes())
    with file.open('rb') as opened:
        summary = mcap_records.footer_of(opened, len(content)).summary
        for at, code, length in mcap_records.records(opened, summary, len(content)):
            if code == mcap_records.STATISTICS:  # of the file, then of its channel
                begin = at + mcap_records.RECORD.size
                struct.pack_into('<Q', content, begin, 101)
                struct.pack_into('<Q', content, begin + length - 8, 101)
    file.write_bytes(content)
    items, (problem,) = read(file)
    assert not items and 'holds 0 messages' in problem and 'says 101' in problem
