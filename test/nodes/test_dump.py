# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What `ros2 param dump` writes of a live node loads again, in the node and in ``track``."""

import contextlib
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
import yaml

from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.fathometer import FathometerNode
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.running import warn_of_foreign_files
from sonar_imm.parameters import ConfigError, sections_of
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.own_files import own_parameters

NODES = {
    'bathymetry': BathymetryNode, 'diver': DiverNode, 'fathometer': FathometerNode,
    'fls_detector': FlsDetectorNode, 'obstacle': ObstacleNode,
}  # fmt: skip
# So that the node starts where messages of others are not installed.
EXTRA = ["input_types:=['image=sensor_msgs/msg/Image']"]


def dumped(bench, name):
    """The text that the real command writes, by the two services that it asks."""
    listed = bench.call(ListParameters, f'{name}/list_parameters', ListParameters.Request())
    names = sorted(listed.result.names)
    asked = GetParameters.Request(names=names)
    values = bench.call(GetParameters, f'{name}/get_parameters', asked).values
    assert len(values) == len(names) > 5
    unset = [name for name, v in zip(names, values) if v.type == ParameterType.PARAMETER_NOT_SET]
    assert not unset
    tree = {}
    for item, value in zip(names, values):
        *folders, last = item.split('.')
        inside = tree
        for folder in folders:
            inside = inside.setdefault(folder, {})
        plain = parameter_value_to_python(value)
        inside[last] = plain if isinstance(plain, (bool, int, float, str)) else list(plain)
    return yaml.safe_dump({name: {'ros__parameters': tree}})


@pytest.mark.parametrize('name', NODES)
def test_a_dump_of_every_node_holds_all_and_loads_again(make_bench, tmp_path, name, capfd):
    """Real trackers start here twice: that takes some seconds."""
    given, file = ['stale_after:=7.5', 'frame_id:=harbour'], tmp_path / 'live.yaml'
    bench = make_bench(p=EXTRA if name == 'fls_detector' else given)
    node = bench.start(NODES[name])
    bench.spin_until(lambda: node.state == 'active')  # inputs have parameters from then on
    file.write_text(dumped(bench, f'/{name}'))
    again = make_bench('--params-file', str(file))
    second = again.start(NODES[name])
    again.spin_until(lambda: second.state == 'active')
    assert dumped(again, f'/{name}') == file.read_text()
    if name in SYSTEMS:
        config, node_config = load_config(SYSTEMS[name], file, {})
        assert node.tracker.config == second.tracker.config == config
        assert (node_config.stale_after, node_config.frame_id) == (7.5, 'harbour')
    words, other = ['--params-file', str(file)], 'another_node: {ros__parameters: {a: 1.0}}\n'
    file.write_text(file.read_text() + other)
    warn_of_foreign_files(second, words)
    assert 'has no effect' not in capfd.readouterr().err
    file.write_text(other)
    warn_of_foreign_files(second, words)
    assert 'has no effect: it is for another_node' in capfd.readouterr().err


def test_a_file_for_another_node_is_named(tmp_path):
    file = tmp_path / 'live.yaml'
    file.write_text('/obstacle:\n  ros__parameters:\n    frame_id: odom\n')
    with pytest.raises(ConfigError, match="is for /obstacle, and not for 'diver'"):
        load_config(SYSTEMS['diver'], file, {})
    file.rename(tmp_path / 'parameters.yaml')  # of a recording that another tracker looks at
    beside = own_parameters(tmp_path)
    assert load_config(SYSTEMS['diver'], beside, {})[1].frame_id == ''
    assert load_config(SYSTEMS['obstacle'], beside, {})[1].frame_id == 'odom'


def test_sections_are_found_in_namespaces():
    text = (
        '/**:\n  ros__parameters: {}\n/auv1:\n  bow:\n    ros__parameters: {}\n'
        'diver:\n  ros__parameters:\n    a: 1\n'
    )
    assert sections_of(text) == ['/**', '/auv1/bow', 'diver']
    assert sections_of('a: 1') == sections_of('{[') == sections_of('5') == []


# -- The policies of SROS 2 allow what the nodes do, and nothing else --


FOLDER = Path(__file__).resolve().parents[2] / 'config' / 'sros2'


# So that the node starts where messages of others are not installed.
def allowed(name, node):
    """Absolute names by what is allowed, from the file."""
    policy = ElementTree.parse(FOLDER / f'{name}.xml').getroot()
    assert (policy.tag, policy.get('version')) == ('policy', '0.2.0')
    (enclave,) = policy.findall('enclaves/enclave')
    assert enclave.get('path') == f'/sonar_imm/{name}'
    (profile,) = enclave.findall('profiles/profile')
    assert (profile.get('ns'), profile.get('node')) == ('/', name)
    rules = {}
    for group in profile:
        ((rule, word),) = group.attrib.items()
        assert word == 'ALLOW'
        names = [item.text.replace('~', f'/{node.get_name()}') for item in group]
        assert not any('*' in name for name in names)  # nothing wholesale
        rules[group.tag, rule] = set(names)
    return rules


@pytest.mark.parametrize('name', NODES)
def test_a_policy_allows_what_its_node_does_and_nothing_else(name, make_bench):
    extra = EXTRA if name == 'fls_detector' else []
    bench = make_bench(p=['use_sim_time:=true', *extra])
    node = bench.start(NODES[name])
    given = allowed(name, node)
    who = node.get_name(), node.get_namespace()
    graph = {
        ('topics', 'publish'): node.get_publisher_names_and_types_by_node,
        ('topics', 'subscribe'): node.get_subscriber_names_and_types_by_node,
        ('services', 'reply'): node.get_service_names_and_types_by_node,
        ('services', 'request'): node.get_client_names_and_types_by_node,
    }
    for rule, ask in graph.items():
        # The graph hears of a node's own endpoints a little later.
        with contextlib.suppress(AssertionError):
            bench.spin_until(
                lambda rule=rule, ask=ask: given.get(rule, set()) == {n for n, _ in ask(*who)}, 5.0
            )
        assert given.get(rule, set()) == {item for item, _ in ask(*who)}, rule
    assert {'/rosout', '/parameter_events'} <= given['topics', 'publish']
    assert '/clock' in given['topics', 'subscribe']
    assert f'/{name}/get_type_description' in given['services', 'reply']


def test_every_node_has_a_policy():
    assert {path.stem for path in FOLDER.iterdir()} == NODES.keys()
