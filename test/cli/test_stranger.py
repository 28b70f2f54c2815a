# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A recording of a stranger: its parameters are data, and name no file but those beside it."""

import os
from pathlib import Path
import shutil

import pytest

from sonar_imm.node_config import node_config_type
from sonar_imm.parameters import ConfigError, parameters_from_yaml
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config, node_file
from sonar_imm_tools.recordings.own_files import MOST_BYTES, OF_FRAMES, own_parameters
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

BAGS = Path(__file__).resolve().parents[2] / 'bags'
TABLE = 'range,probability\n0,0.9\n100,0.5\n'


@pytest.fixture
def bag(tmp_path):
    """A recording of divers, with a file of parameters by `state`."""
    shutil.copytree(BAGS / 'diver_table1', tmp_path / 'bag')
    return tmp_path / 'bag'


def state(bag, *lines, node='diver'):
    text = ''.join(f'    {line}\n' for line in lines)
    (bag / 'parameters.yaml').write_text(f'{node}:\n  ros__parameters:\n{text}')
    return own_parameters(bag)


def config_of(own):
    return load_config(SYSTEMS['diver'], own, {})


@pytest.mark.parametrize('node', ['diver', '/**', '/auv/diver'])
def test_a_recording_keeps_no_files_and_changes_no_node(bag, node, capsys):
    own = state(
        bag, 'state_file: /etc/passwd', 'stale_after: 1.0', 'fix_std: 2.5', 'frame_id: sea',
        node=node,
    )  # fmt: skip
    tracker, settings = config_of(own)
    assert (tracker.fix_std, settings.frame_id) == (2.5, 'sea')
    assert settings.state_file == '' and settings.stale_after != 1.0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and "'state_file' is not used" in lines[0]


@pytest.mark.parametrize('system', SYSTEMS)
def test_only_parameters_of_the_tracker_and_of_frames_are_taken(bag, system):
    """Whatever parameters a node will get one day: a recording sets none of them."""
    config, node = SYSTEMS[system].config_type(), node_config_type(SYSTEMS[system])
    tracker = {spec.name for spec in config.specs()}
    for spec in node.specs():
        value = list(spec.default) if isinstance(spec.default, tuple) else spec.default
        own = state(
            bag, f'{spec.name}: {value!r}'.replace("'", '"').replace('True', 'true'), node=system
        )
        with node_file(SYSTEMS[system], own) as path:
            given = parameters_from_yaml(path.read_text(), node_name=system)
        assert set(given) <= tracker | {*OF_FRAMES}, spec.name
    files = {s.name for s in (*config.specs(), *node.specs()) if 'file' in s.name.split('_')}
    assert all(name.endswith('_file') for name in files)
    assert not any('_file' in spec.name for spec in DetectorConfig.specs())


def outside(bag, tmp_path):
    (tmp_path / 'secret.csv').write_text(TABLE)
    return str(tmp_path / 'secret.csv')


def link(bag, tmp_path):
    outside(bag, tmp_path)
    (bag / 'link.csv').symlink_to('../secret.csv')
    return 'link.csv'


def linked_folder(bag, tmp_path):
    outside(bag, tmp_path)
    (bag / 'there').symlink_to(tmp_path)
    return 'there/secret.csv'


def large(bag, tmp_path):
    (bag / 'large.csv').write_bytes(b'0' * (MOST_BYTES + 1))
    return 'large.csv'


def pipe(bag, tmp_path):
    os.mkfifo(bag / 'pipe.csv')
    return 'pipe.csv'


def device(bag, tmp_path):
    (bag / 'zero.csv').symlink_to('/dev/zero')
    return 'zero.csv'


HOSTILE = [outside, link, linked_folder, large, pipe, device]
HOSTILE += ['../secret.csv', '/dev/zero', '~/.bashrc', '.', 'nothing.csv', 'a\\0b', 'x' * 5000]


@pytest.mark.parametrize('where', HOSTILE)
def test_a_file_that_a_recording_names_lies_beside_it(bag, tmp_path, where, capsys):
    outside(bag, tmp_path)
    name = where if isinstance(where, str) else where(bag, tmp_path)
    tracker, _ = config_of(state(bag, f'coverage_file: "{name}"', 'fix_std: 2.5'))
    assert (tracker.coverage_file, tracker.fix_std) == ('', 2.5)
    assert capsys.readouterr().err.count("'coverage_file' is not used: ") == 1


def test_a_file_beside_the_recording_is_used(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (bag / 'beam.csv').write_text(TABLE)
    (bag / 'other.csv').symlink_to('beam.csv')
    own = state(bag, 'coverage_file: beam.csv', 'sensors: [a, b]', 'b: {coverage_file: other.csv}')
    tracker, _ = config_of(own)
    assert tracker.coverage_file == str(bag.resolve() / 'beam.csv')
    assert tracker.own == (('b.coverage_file', str(bag.resolve() / 'beam.csv')),)
    SYSTEMS['diver'].build(tracker)


def test_what_the_user_names_is_trusted(bag, tmp_path, capsys):
    (tmp_path / 'beam.csv').write_text(TABLE)
    file = tmp_path / 'mine.yaml'
    file.write_text(
        f'diver:\n  ros__parameters:\n    coverage_file: {tmp_path}/beam.csv\n    state_file: s\n'
    )
    tracker, node = load_config(SYSTEMS['diver'], file, {'stale_after': '7.0'})
    assert tracker.coverage_file == f'{tmp_path}/beam.csv'
    assert (node.state_file, node.stale_after) == ('s', 7.0)
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize('kind', ['link', 'large', 'misspelt'])
def test_a_parameter_file_that_is_none_is_refused(bag, tmp_path, kind):
    own = state(bag, 'fix_stdd: 2.5')
    if kind == 'link':
        shutil.move(own.path, tmp_path / 'elsewhere.yaml')
        own.path.symlink_to(tmp_path / 'elsewhere.yaml')
    elif kind == 'large':
        own.path.write_text('#' * (MOST_BYTES + 1))
    with pytest.raises(ConfigError, match='outside of the folder|has more than|did you mean'):
        config_of(own)


@pytest.mark.parametrize('name', ['metadata.yaml', 'more.mcap', 'more.db3', 'more.mcap.zstd'])
def test_a_pipe_in_a_recording_is_not_opened(bag, name):
    """What is beside it is read."""
    (bag / name).unlink(missing_ok=True)
    os.mkfifo(bag / name)
    with BagReader(bag) as reader:
        assert sum(1 for _ in reader.messages()) > 100
        assert any('is no regular file' in sentence for sentence in reader.problems)
    with pytest.raises(BagError, match='is no regular file'), BagReader(bag, strict=True):
        pass


def test_a_recording_that_is_a_pipe_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / 'bag.mcap')
    with pytest.raises(BagError), BagReader(tmp_path / 'bag.mcap'):
        pass


def test_track_says_what_it_does_not_use(bag, tmp_path, capsys):
    state(bag, 'state_file: /etc/passwd', 'model_set: heading_speed')
    assert main(['track', str(bag), str(tmp_path / 'run')]) == 0
    assert capsys.readouterr().err.count("'state_file' is not used") == 1


def test_metadata_name_no_file_outside_of_the_folder(bag, tmp_path):
    (bag / 'diver_table1.mcap').rename(tmp_path / 'elsewhere.mcap')
    metadata = bag / 'metadata.yaml'
    text = metadata.read_text()
    for name in ('../elsewhere.mcap', str(tmp_path / 'elsewhere.mcap')):
        metadata.write_text(text.replace('diver_table1.mcap', name))
        with pytest.raises(BagError), BagReader(bag):
            pass
