# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import os
from pathlib import Path
import site
import subprocess
import sys
from typing import get_args

import attrs
from helpers.hostile.runs import check_refusal, mutated, MUTATIONS
from helpers.hostile.streams import templates
from helpers.marine import driver_message, OTHERS
import numpy as np
import pytest

import msg_adapters
from msg_adapters.inputs import inputs_of, made_inputs
from msg_adapters.inputs.topic import Labels, tag_numbers
import sonar_imm
from sonar_imm import measurements
from sonar_imm.measurements import Arrivals, Fix, Fixes, NOBODY, Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.messages import ros_message, typestore

FOREIGN = ('marine_acoustic_msgs/', 'stonefish_ros2/', 'dave_interfaces/')


def test_every_tracker_has_inputs_whose_readers_say_no_politely():
    topics = [topic for system in SYSTEMS for topic in inputs_of(system)]
    assert all(topic.description and not topic.name.startswith('/') for topic in topics)
    for topic, (name, read) in ((each, item) for each in topics for item in each.readers.items()):
        if name.startswith(FOREIGN):  # see test_detections.py, test_navigation.py
            continue
        assert name in OTHERS or name in typestore().types
        empty = driver_message(name) if name in OTHERS else ros_message(name)
        with pytest.raises(Rejection):  # an empty message has no stamp
            read(empty)
        assert topic.doubt(empty, ()) in (None, 'zero_covariance', 'no_frame')


FINITE = (
    'altitude frequency iq latitude longitude offset orientation position range rx toa'.split()
)
"""What is known where there is a measurement at all."""


def check_measurement(item):
    """Numbers that are finite, variances above zero or unknown, blocks of them that are some."""
    values = attrs.asdict(item, recurse=False)
    if isinstance(item, measurements.Snapshot):
        values['iq'] = item.iq[item.usable]
    if isinstance(item, measurements.Start):
        values['position'] = item.position[:2]
    for name, value in values.items():
        known = np.ravel(value)
        assert name not in FINITE or value is None or np.isfinite(known).all(), name
        if name.startswith('var_') or name.endswith('_variance'):
            assert value is None or (known[~np.isnan(known)] > 0.0).all(), name
    if isinstance(item, measurements.Detections):
        assert np.isfinite(item.bearing).all() and (item.range > 0.0).all()
    if isinstance(item, Arrivals):
        bearing = item.bearing[~np.isnan(item.bearing)]
        assert len(item) and (np.abs(bearing) <= np.pi).all()
        assert item.passive or np.isfinite(item.tx).all()
    if isinstance(item, (Fix, Fixes)) and item.covariance is not None:
        whole = item.covariance.reshape(-1, 3, 3)
        for C in (*whole, *whole[:, :2, :2]):
            known = C[~np.isnan(np.diag(C))][:, ~np.isnan(np.diag(C))]
            assert np.isnan(C).sum() == C.size - known.size and np.isfinite(known).all()
            assert not known.size or np.linalg.eigvalsh(known / known.max()).min() > 0.0


@pytest.mark.parametrize('system', SYSTEMS)
def test_hostile_messages_are_refused_or_sound(system):
    entries = {entry.name: entry for entry in (*inputs_of(system), *made_inputs(system))}
    rng, given, read = np.random.default_rng(7), templates(system), 0
    for k in range(120 * len(given)):
        name, type_name, message = given[k % len(given)]
        message = mutated(message, MUTATIONS[rng.integers(len(MUTATIONS))], rng)
        try:
            item = entries[name].reader(type_name, ('enu', 'ned')[k % 2], {})(message)
        except Rejection as rejection:
            check_refusal(rejection)
            continue
        check_measurement(item)
        read += 1
    assert read > 48 * len(given)


def test_the_adapters_load_neither_rclpy_nor_rosbags():
    code = (
        'import sys, msg_adapters.estimates; from msg_adapters.inputs import inputs_of; '
        f'assert all(map(inputs_of, {list(SYSTEMS)})); '
        'sys.exit(any(name in sys.modules for name in ("rclpy", "rosbags")))'
    )
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0


def test_each_class_of_measurements_is_heard_under_one_name():
    """`write_scene` finds the topic of a measurement by its class."""
    entries = [entry for system in SYSTEMS for entry in inputs_of(system)]
    names: dict[type, str] = {}
    for entry in entries:
        # Several trackers take navigation; a sonar with two sides has a namespace for each.
        first = names.setdefault(entry.measurement, entry.name)
        assert '/' not in first and entry.name.split('/')[-1] == first
    received = {item for entry in entries for item in entry.measurements}
    assert received == set(get_args(measurements.Measurement))


# -- Names of tags and sensors, from topics and frames --


BOTH = ('tags', 'sensors')


def fix(frame_id='map', **values):
    return Fix(stamp_ns=5, position=(1.0, 2.0, 0.0), frame_id=frame_id, **values)


def label(topic, measurement, **settings):
    labels = Labels.of(topic, settings, BOTH)
    return measurement if labels is None else labels(measurement)


def test_tags_are_numbers_or_their_place_in_the_list():
    for tags, numbers in (
        (['12', '7'], {'12': 12, '7': 7}), (['amy', '7'], {'amy': 1, '7': 2}),
        (['amy', 'bob', 'amy'], {'amy': 1, 'bob': 2}), ([], {}),
    ):  # fmt: skip
        assert tag_numbers(tags) == numbers
    # A part of the topic or a frame is a name.
    for topic, number in (('/divers/bob/fix', 2), ('/divers/bobby/fix', NOBODY), ('bob/fix', 2)):
        assert label(topic, fix(), tags=['amy', 'bob']).target_id == number
    named = label('/fix', fix('amy'), tags=['amy'], frame_id='odom')
    assert (named.target_id, named.frame_id) == (1, 'odom')
    other = label('/fix', fix('map'), tags=['amy'])
    assert (other.target_id, other.frame_id) == (NOBODY, 'map')
    assert label('/bob/fix', fix(target_id=40), tags=['bob']).target_id == 40
    assert label('/fix', fix('bob', target_id=40), tags=['bob']).frame_id == 'bob'


def test_sensors_are_labelled_and_scans_are_no_tags():
    scan = Fixes(stamp_ns=5, position=np.empty((0, 3)))
    labels = Labels.of('/radar/fixes', {'sensors': ['radar'], 'tags': ['amy']}, ('sensors',))
    assert labels(scan).sensor == 'radar'
    assert label('/radar/fix', fix(), sensors=['radar']).sensor == 'radar'
    assert Labels.of('/bob/fix', {'tags': [], 'sensors': []}, BOTH) is None
    # Each name has a topic of its own.
    by_name = {entry.name: entry for entry in inputs_of('diver')}
    settings = {'tags': ['amy'], 'sensors': ['radar']}
    assert by_name['fix'].instances(settings) == ('fix', 'amy/fix', 'radar/fix')
    assert by_name['fixes'].instances(settings) == ('fixes', 'radar/fixes')
    assert by_name['nav'].instances(settings) == ('nav',)


# -- the owner of the module --


ROOT = str(Path(sonar_imm.__file__).parent.parent)


def import_with(*path):
    return subprocess.run(
        [sys.executable, '-c', 'import sonar_imm'], capture_output=True, text=True, cwd='/',
        check=False, env={**os.environ, 'PYTHONPATH': os.pathsep.join(path)},
    )  # fmt: skip


def test_our_own_adapters_are_ours():
    assert msg_adapters.__owner__ == 'sonar_imm'
    assert msg_adapters.__version__ == sonar_imm.__version__
    assert import_with(ROOT).returncode == 0


@pytest.mark.parametrize('content', ['', "'someone'", "'sonar_imm'", None])
def test_foreign_adapters_are_refused_and_both_places_named(tmp_path, content):
    foreign = tmp_path / 'msg_adapters'
    foreign.mkdir()
    if content is not None:
        text = f"__owner__ = {content}\n__version__ = '0.0.0'\n" if content else ''
        (foreign / '__init__.py').write_text(text)
        path = [str(tmp_path), ROOT]
    else:  # a folder without __init__.py is a module too when nothing better is found
        if any((Path(folder) / 'msg_adapters').is_dir() for folder in site.getsitepackages()):
            pytest.skip('ours is installed here, and a bare folder never comes before it')
        house = tmp_path / 'house'
        house.mkdir()
        (house / 'sonar_imm').symlink_to(Path(ROOT) / 'sonar_imm')
        path = [str(tmp_path), str(house)]
    result = import_with(*path)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith('ImportError') and str(foreign) in last
    assert os.path.join('sonar_imm', '__init__.py') in last
