# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The launch files start what is installed, and pass arguments that exist.

They are read as XML here; `test/system/test_launch.py` runs them where ROS 2 launch is installed.
"""

from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
from numpy.testing import assert_allclose
import pytest
import yaml

from msg_adapters.estimates import write_estimate
from msg_adapters.headers import swap_axes
from msg_adapters.inputs import inputs_of
from msg_adapters.table import encode_table
from sonar_imm.acoustics.geometry import rotation
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'launch'
FILES = sorted(FOLDER.glob('*.launch.xml'))
SHARE = '$(find-pkg-share sonar_imm)/'


def tree(name):
    return ElementTree.parse(FOLDER / f'{name}.launch.xml').getroot()


def declared(root):
    return {arg.get('name') for arg in root.findall('arg')}


@pytest.mark.parametrize('system', [*SYSTEMS, 'fls_detector'])
def test_each_node_has_a_launch_file_that_starts_its_executable(system):
    (include,) = tree(system).findall('include')
    given = {arg.get('name'): arg.get('value') for arg in include.findall('arg')}
    assert include.get('file') == f'{SHARE}launch/node.launch.xml'
    assert given == {'system': system}
    (node,) = tree('node').findall('node')
    installed = {f'{system}_node' for system in SYSTEMS}
    installed.update(re.findall(r"'(\w+_node) = ", (ROOT / 'setup.py').read_text()))
    assert node.get('exec').replace('$(var system)', system) in installed
    # The name is what the parameter files and the remaps of the documentation use.
    assert node.get('name') == '$(var system)'


def test_the_file_for_all_starts_every_system_once_in_a_namespace_of_its_own():
    root = tree('all')
    started = []
    for group in root.findall('group'):
        (include,) = group.findall('include')
        given = {arg.get('name'): arg.get('value') for arg in include.findall('arg')}
        system = given['system']
        started.append(system)
        assert group.get('if') == f'$(var {system})'
        spaces = [push.get('namespace') for push in group.findall('push-ros-namespace')]
        assert spaces == ['$(var namespace)', f'$(var {system}_namespace)']
        assert given['params_file'] == f'$(var {system}_params_file)'
        # An absolute namespace given for all would otherwise win inside as well.
        assert given['namespace'] == ''
    assert sorted(started) == sorted(SYSTEMS)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_every_argument_and_file_that_is_used_is_there(path):
    text = path.read_text(encoding='utf-8')
    root = ElementTree.fromstring(text)
    from_outside = {'system'} if path.name == 'node.launch.xml' else set()
    used = set(re.findall(r'\$\(var (\w+)\)', text))
    assert used <= declared(root) | from_outside
    assert all(arg.get('description') for arg in root.findall('arg'))
    known = declared(tree('node'))
    for include in root.iter('include'):
        assert {arg.get('name') for arg in include.findall('arg')} <= known
    for name in re.findall(re.escape(SHARE) + r'([\w./]+)(?=["\'])', text):
        assert (ROOT / name).is_file(), name


# -- the launch file and the costmap of the tutorial ----------------------------------------------

TUTORIAL = ROOT / 'docs/tutorials/ros_avoidance.md'


def block(kind):
    """The only block of that kind on the page."""
    (text,) = re.findall(rf'^```{kind}\n(.*?)^```$', TUTORIAL.read_text(), re.M | re.S)
    return text


def test_the_launch_file_of_the_tutorial_uses_what_is_there():
    root = ElementTree.fromstring(block('xml'))
    (include,) = root.iter('include')
    assert include.get('file') == f'{SHARE}launch/obstacle.launch.xml'
    assert {arg.get('name') for arg in include.findall('arg')} <= declared(tree('node'))
    names = {topic.name for topic in inputs_of('obstacle')}
    assert {remap.get('from') for remap in root.iter('set_remap')} <= names


def test_the_static_transforms_of_the_tutorial_turn_axes_as_the_adapters_do():
    """A place in odom_ned, by the transform, is where the adapter of navigation puts it."""
    nodes = ElementTree.fromstring(block('xml')).findall('node')
    given = {node.get('name'): node.get('args').split() for node in nodes}
    words = {key: dict(zip(args[::2], args[1::2])) for key, args in given.items()}
    assert (words['ned']['--frame-id'], words['ned']['--child-frame-id']) == ('odom', 'odom_ned')
    angles = [float(words['ned'].get(f'--{name}', 0.0)) for name in ('roll', 'pitch', 'yaw')]
    place = np.array([3.0, -4.0, 20.0])
    assert_allclose(rotation(*angles) @ place, swap_axes(place), atol=1e-6)
    assert words['fls']['--child-frame-id'] == 'fls_link'


def test_the_costmap_of_the_tutorial_takes_what_is_sent():
    """What the obstacle layer of nav2 reads of a cloud: float32 x, y and z by name, heights
    between its limits, in a frame that the tree has."""
    settings = yaml.safe_load(block('yaml'))['local_costmap']['local_costmap']['ros__parameters']
    layer = settings['obstacle_layer']
    source = layer[layer['observation_sources']]
    assert source['data_type'] == 'PointCloud2' and source['topic'] == '/avoid/points'
    place = {name: np.array([value], 'f4') for name, value in zip('xyz', (3.0, 4.0, -20.0))}
    tracker = ObstacleTracker(ObstacleConfig())
    scene = simulate(scenario('approach', {'last_range': 60.0}), 1)
    *_, last = (each for item in scene.measurements for each in tracker.process(item.measurement))
    assert len(last)
    clouds = [
        encode_table(place, stamp_ns=1, frame_id='odom', make=ros_message),
        write_estimate(last, ros_message),
    ]
    for cloud in clouds:
        fields = {field.name: field for field in cloud.fields}
        assert [fields[name].datatype for name in 'xyz'] == [7, 7, 7]  # FLOAT32
        z = np.frombuffer(bytes(cloud.data), '<f4', 1, fields['z'].offset)[0]
        assert source['min_obstacle_height'] < z < source['max_obstacle_height']
        assert cloud.header.frame_id == settings['global_frame']
    assert settings['plugins'] == ['obstacle_layer', 'inflation_layer']
