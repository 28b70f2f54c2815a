# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The policies of SROS 2 allow what the nodes do, and nothing else."""

import contextlib
from pathlib import Path
from xml.etree import ElementTree

import pytest

from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.fathometer import FathometerNode
from sonar_imm.nodes.fls_detector import FlsDetectorNode
from sonar_imm.nodes.obstacle import ObstacleNode

FOLDER = Path(__file__).resolve().parents[2] / 'config' / 'sros2'
# So that the nodes start, and hear the same, where messages of others are not installed.
FRAMES = ['-p', 'tf_static_type:=geometry_msgs/msg/TransformStamped']
EXTRA = {
    'fls_detector': ['-p', 'image_type:=sensor_msgs/msg/Image'],
    **dict.fromkeys(('bathymetry', 'diver', 'obstacle'), FRAMES),
}
NODES = {
    'bathymetry': BathymetryNode,
    'diver': DiverNode,
    'fathometer': FathometerNode,
    'fls_detector': FlsDetectorNode,
    'obstacle': ObstacleNode,
}


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
    bench = make_bench('-p', 'use_sim_time:=true', *EXTRA.get(name, []))
    node = bench.add(NODES[name](context=bench.context))
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
    assert '/rosout' in given['topics', 'publish']
    assert '/parameter_events' in given['topics', 'publish']
    assert '/clock' in given['topics', 'subscribe']
    assert f'/{name}/get_type_description' in given['services', 'reply']


def test_every_node_has_a_policy():
    assert {path.stem for path in FOLDER.iterdir()} == NODES.keys()
