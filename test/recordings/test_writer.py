# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Writing recordings, and the messages of rosbags."""

import csv
import filecmp
import io
import sys

from attrs import frozen
import numpy as np
import pytest

from msg_adapters.estimates import read_estimate
from sonar_imm.measurements import Fix
from sonar_imm.truth import Received, Scene, TrueReflectors, TrueTrack, TruthTable
from sonar_imm_tools.recordings import export
from sonar_imm_tools.recordings.export import CsvWriter, FEW_ROWS, ROWS_IN_A_BLOCK
from sonar_imm_tools.recordings.messages import cdr_of, decode_cdr, ros_message, typestore
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError
from sonar_imm_tools.recordings.truth import records_of, write_scene
from sonar_imm_tools.recordings.writer import BagWriter


def content(path):
    with BagReader(path) as bag:
        assert not bag.problems
        return [(item.topic, item.log_ns, bytes(item.raw)) for item in bag.messages()]


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_same_input_gives_the_same_bytes_of_every_file(write_fixes, storage):
    first = write_fixes(name='one/bag', storage=storage, custom_data={'b': '2', 'a': '1'})
    second = write_fixes(name='two/bag', storage=storage, custom_data={'a': '1', 'b': '2'})
    names = sorted(file.name for file in first.iterdir())
    assert 'metadata.yaml' in names and len(names) == 2
    assert filecmp.cmpfiles(first, second, names, shallow=False) == (names, [], [])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('n', [0, 7])
def test_what_is_written_is_read(write_fixes, n, storage):
    with BagReader(write_fixes(n, storage=storage, custom_data={'source': 'x.csv'})) as bag:
        assert [(topic.name, topic.count) for topic in bag.topics] == ([('/fix', n)] if n else [])
        assert bag.custom_data == {'source': 'x.csv'} and not bag.problems
        assert [item.message.pose.pose.position.x for item in bag.messages()] == list(range(n))


def test_a_compressed_bag_is_smaller_and_says_the_same(write_fixes):
    paths = [write_fixes(200, name=name, compressed=name == 'packed') for name in ('a', 'packed')]
    plain, packed = map(content, paths)
    assert plain == packed and len(plain) == 200
    sizes = [(path / f'{path.name}.mcap').stat().st_size for path in paths]
    assert sizes[1] < 0.6 * sizes[0]
    # Metadata are of version 8 with the offered QoS.
    assert 'version: 8' in (paths[0] / 'metadata.yaml').read_text()
    with BagReader(paths[0]) as bag:
        (profile,) = bag.topics[0].offered_qos
        assert profile.reliability.name == 'RELIABLE' and profile.depth == 10


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_is_there_as_a_whole_or_not_at_all(tmp_path, fix_message, storage):
    values, path = {'diver': {'detection_probability': 0.8}}, tmp_path / 'bag'
    with pytest.raises(KeyboardInterrupt), BagWriter(path, storage=storage) as bag:
        bag.write('/fix', fix_message(0), 5)
        raise KeyboardInterrupt
    assert not any(tmp_path.iterdir())
    with BagWriter(path, storage=storage, parameters=values) as bag:
        bag.write('/fix', fix_message(0), 5)
        assert not path.exists()
        with pytest.raises(ValueError, match='log time'):
            bag.write('/fix', fix_message(0), -1)
    assert (path / 'parameters.yaml').is_file() and list(tmp_path.iterdir()) == [path]
    assert len(content(path)) == 1
    # What is there is left alone.
    with pytest.raises(BagError, match='exists already'):
        BagWriter(path)
    assert len(content(path)) == 1
    (tmp_path / 'file').write_text('x')
    with pytest.raises(BagError, match='cannot be written|exists'):
        BagWriter(tmp_path / 'file' / 'bag')
    with pytest.raises(ValueError, match='mcap, sqlite3'):
        BagWriter(tmp_path / 'other', storage='zip')


def test_every_common_message_can_be_made_empty_and_survives_cdr():
    for name in (name for name in typestore().types if '/msg/' in name):
        raw = cdr_of(ros_message(name))
        assert cdr_of(decode_cdr(typestore(), name, raw)) == raw, name


def test_fields_are_cast_strictly():
    fields = {'name': ('a',), 'position': [1, 2], 'velocity': np.float32([0.5])}
    message = ros_message('sensor_msgs/msg/JointState', **fields)
    assert message.position.dtype == np.float64 and message.velocity.dtype == np.float64
    cloud = ros_message('sensor_msgs/msg/PointCloud2', data=b'\x01\x02', height=np.int64(3))
    assert cloud.data.tolist() == [1, 2] and type(cloud.height) is int
    pose = ros_message('geometry_msgs/msg/PoseWithCovariance', covariance=np.eye(6))
    assert pose.covariance.shape == (36,)
    with pytest.raises(TypeError, match='sek'):
        ros_message('builtin_interfaces/msg/Time', sek=1)


def test_spare_alignment_bytes_are_no_damage_but_damage_is():
    name = 'sensor_msgs/msg/JointState'
    raw = cdr_of(ros_message(name, position=[2.5]))
    for spare in (0, 4, 8, 12):
        assert decode_cdr(typestore(), name, raw + bytes(spare)).position.tolist() == [2.5]
    for damaged, words in ((raw + bytes(100), 'size mismatch'), (raw[:20], 'JointState')):
        with pytest.raises(Exception, match=words):
            decode_cdr(typestore(), name, damaged)


# -- tables of numbers as CSV: the same bytes whatever writes them


RNG = np.random.default_rng(3)
POWERS = 10.0 ** np.arange(-320, 309)
NEAR = [np.nextafter(POWERS, way) for way in (-np.inf, np.inf)]
SPREAD = np.exp(RNG.uniform(-40.0, 45.0, 50_000)) * RNG.choice([-1.0, 1.0], 50_000)
HOSTILE = {
    'any bits': RNG.integers(0, 2**64, 50_000, dtype=np.uint64).view(np.float64),
    'powers of ten': np.concatenate([POWERS, -POWERS, *NEAR, POWERS / 3.0, -1.25 * POWERS]),
    'spread': SPREAD,
    'rounded': np.round(SPREAD, 6),
    'float32': SPREAD.astype(np.float32),
    'whole': RNG.integers(-(10**17), 10**17, 5000).astype(float),
    'no numbers': np.tile([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e-5, 1e16], 200),
    'int64': RNG.integers(-(2**63), 2**63 - 1, 2000),
    'uint8': RNG.integers(0, 256, 2000).astype(np.uint8),
    'flags': RNG.random(2000) < 0.5,
}


def written(columns):
    file = io.StringIO()
    CsvWriter(file).write_columns(columns)
    return file.getvalue()


def plain(columns):
    file = io.StringIO()
    rows = zip(*(column.tolist() for column in columns))
    csv.writer(file, lineterminator='\n').writerows(rows)
    return file.getvalue()


@pytest.mark.filterwarnings('ignore:overflow encountered')
@pytest.mark.parametrize('name', HOSTILE)
def test_numbers_have_the_digits_of_python(name):
    column = HOSTILE[name]
    assert len(column) >= FEW_ROWS
    assert written([column, column[::-1]]) == plain([column, column[::-1]])


def test_blocks_follow_one_another():
    for rows in (0, 1, FEW_ROWS - 1, ROWS_IN_A_BLOCK, ROWS_IN_A_BLOCK + 1):
        columns = [np.arange(rows), SPREAD[:rows]]
        assert written(columns) == plain(columns)


@pytest.fixture
def choose_again():
    export._arrow.cache_clear()
    yield
    export._arrow.cache_clear()


def of_other_digits(column, arrow):
    return arrow.array(['1'] * len(column))


@pytest.mark.usefixtures('choose_again')
def test_the_same_bytes_without_pyarrow_or_one_of_other_digits(monkeypatch):
    pytest.importorskip('pyarrow')
    assert export._arrow() is not None
    changes = (sys.modules, 'pyarrow', None), (vars(export), '_texts', of_other_digits)
    for change in changes:
        export._arrow.cache_clear()
        with monkeypatch.context() as patches:
            patches.setitem(*change)
            assert export._arrow() is None
            assert written([SPREAD, SPREAD]) == plain([SPREAD, SPREAD])


# -- scenes become bags: each class by its own writer, in the order of reception


START_NS = 1_700_000_000_000_000_000


def fix(offset_ns):
    return Fix(stamp_ns=START_NS + offset_ns, position=(1.0, 2.0, 0.0), frame_id='map')


def logged(path):
    with BagReader(path) as bag:
        return [(item.topic, item.log_ns - START_NS) for item in bag.messages()]


def test_late_measurements_are_recorded_when_they_were_received(tmp_path):
    @frozen
    class Buoy:
        """Other truth that a scene may know."""

        stamp_ns: int

        def tables(self, frame_id):
            yield TruthTable(self.stamp_ns, frame_id, {'x': np.zeros(1, np.float32)}, 'north')

    received = (9, fix(1)), (4, fix(3)), (1, fix(0), 'south')
    track = TrueTrack(7, START_NS + np.array([2, 6]), np.zeros((2, 3)), np.ones((2, 2)))
    scene = Scene(
        tuple(Received(START_NS + at, *what) for at, *what in received),
        (track, Buoy(START_NS + 2)),
    )
    report = write_scene(scene, tmp_path / 'bag', provenance={})
    truth, north = '/truth/estimate', '/truth/north/estimate'
    assert report.messages == {'/fix': 2, '/south/fix': 1, truth: 2, north: 1}
    wanted = [('/south/fix', 1), (truth, 2), (north, 2), ('/fix', 4), (truth, 6), ('/fix', 9)]
    assert logged(tmp_path / 'bag') == wanted


def test_truth_is_a_table_at_each_stamp_and_reflectors_lie_below():
    places, speeds = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], [[0.1, 0.2], [np.nan, np.nan]]
    true = TrueTrack(9, np.array([5, 8]), np.array(places), np.array(speeds))
    first, second = records_of(true, 'map')
    assert first[:2] == (5, '/truth/estimate') and second[:2] == (8, '/truth/estimate')
    names = 'x y z px py vx vy track_id'.split()
    assert [field.name for field in first[2].fields] == names
    truth = read_estimate(second[2])
    assert truth.frame_id == 'map' and truth.stamp_ns == 8
    assert truth.xyz.tolist() == [[4.0, 5.0, 6.0]]
    assert truth.extras['py'].tolist() == [5.0] and truth.extras['track_id'].tolist() == [9]
    assert read_estimate(first[2]).extras['vx'].tolist() == [0.1]
    assert np.isnan(truth.extras['vx']).all()
    for depth in ([10.0, 20.5], []):
        number = np.arange(3, 3 + len(depth))
        true = TrueReflectors(5, 'array', number, np.array(depth), np.ones(len(depth)))
        (record,) = records_of(true, 'elsewhere')
        truth = read_estimate(record[2])
        assert truth.frame_id == 'array' and truth.extras['depth'].tolist() == depth
        assert (truth.xyz[:, 2] == -np.array(depth)).all()
