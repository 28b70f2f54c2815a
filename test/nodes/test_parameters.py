# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""ROS parameters: declared from config classes, explained when wrong, changed while running; what
`ros2 param dump` writes of a live node loads again, in the node and in ``track``; and the policies
of SROS 2."""

import contextlib
import math
from pathlib import Path
from xml.etree import ElementTree

import pytest
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import Parameter, parameter_value_to_python
import yaml

from sonar_imm.gone import GONE
from sonar_imm.node_config import chosen_types, NodeConfig
from sonar_imm.nodes.base import TrackerNode
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

pytestmark = pytest.mark.usefixtures('walker')


@pytest.fixture
def start(make_bench):
    """Start the walker's node with parameters as on the command line."""

    def start(*parameters):
        bench = make_bench(p=parameters)
        node = bench.start(TrackerNode, 'walker')
        bench.spin_until(lambda: node.get_subscriptions_info_by_topic('/fix'))
        return node

    return start


def changed(node, name, value):
    """The result of a change."""
    return node.set_parameters([Parameter(name, value=value)])[0]


def test_defaults_and_descriptors(start):
    node = start()
    assert node.get_parameter('sound_speed').value == 1500.0
    assert node.get_parameter('max_revisions').value == 100
    assert node.get_parameter('input_types').value == []
    made = node.describe_parameter('sound_speed')
    assert made.description == 'speed of sound [m/s]'
    (limits,) = made.floating_point_range
    assert (limits.from_value, limits.to_value) == (1300.0, 1700.0)
    assert made.additional_constraints == 'between 1300 and 1700'
    assert not made.read_only
    assert node.describe_parameter('steps').read_only
    assert node.describe_parameter('steps').integer_range[0].to_value == 9
    assert node.describe_parameter('mood').additional_constraints == 'calm, hasty'
    assert node.describe_parameter('weights').type == ParameterType.PARAMETER_DOUBLE_ARRAY


def test_start_values_reach_the_tracker(start):
    given = 'sound_speed:=1400.5', 'steps:=5', 'weights:=[0.5, 1.0]', 'mood:=hasty'
    node = start(*given, 'offsets:=[]')
    config = node.tracker.config
    assert (config.sound_speed, config.steps, config.mood) == (1400.5, 5, 'hasty')
    assert (config.weights, config.offsets) == ((0.5, 1.0), ())
    assert list(node.get_parameter('weights').value) == [0.5, 1.0]


@pytest.mark.parametrize(
    'parameter, sentence',
    [
        ('sound_speed:=1500', "parameter 'sound_speed' is a double: write 1500.0 instead of 1500"),
        ('offsets:=[1, 2]',
         "parameter 'offsets' is a list of doubles: write [1.0, 2.0] instead of [1, 2]"),
        ('sound_speed:=fast', "parameter 'sound_speed' must be of type double, got string 'fast'"),
        ('steps:=2.5', "parameter 'steps' must be of type integer, got double 2.5"),
        ('mood:=hastey',
         "parameter 'mood' must be one of calm, hasty, got 'hastey' (did you mean 'hasty'?)"),
        ('steps:=[]', "parameter 'steps' is given without a value"),
        ('fast_share:=0.5', 'fast_share and slow_share must sum to 1'),
        ('max_revisions:=-1', "parameter 'max_revisions' must be between 0 and 1e+06, got -1"),
        ('qos_overrides./fix.subscription.reliability:=often', None),
        ('qos_overrides./fix.subscription.depth:=deep', None),
    ],
)  # fmt: skip
def test_bad_start_values_are_explained(start, parameter, sentence):
    with pytest.raises(ConfigError) as caught:
        start(parameter)
    assert sentence is None or caught.value.problems == (sentence,)


def test_all_mistakes_are_told_at_once(start):
    with pytest.raises(ConfigError) as caught:
        start('sound_speed:=1500', 'steps:=2.5', 'max_revisions:=1.0')
    assert len(caught.value.problems) == 3


def test_what_a_sensor_has_of_its_own_is_declared_where_it_is_given(make_bench):
    node = make_bench(p=['sensors:=[radar, b]', 'radar.fix_std:=4.0']).start(DiverNode)
    assert node.tracker.config.of_sensor('radar').fix_std == 4.0
    assert node.get_parameter('radar.fix_std').value == 4.0 and not node.has_parameter('b.fix_std')
    assert changed(node, 'radar.fix_std', 2.0).successful
    assert node.tracker.config.of_sensor('radar').fix_std == 2.0
    result = changed(node, 'radar.fix_std', -2.0)
    assert not result.successful and 'radar.fix_std' in result.reason


@pytest.mark.parametrize(
    'given, words',
    [
        (('sound_sped:=1500.0', 'qos_overrides./fix.subscription.depth:=7'),
         "'sound_sped' is not known and has no effect (did you mean 'sound_speed'?)"),
        (('targets_to:=127.0.0.1:4001',),
         f"parameter 'targets_to' {GONE['parameter targets_to']}"),
    ],
)  # fmt: skip
def test_misspelt_and_removed_names_are_warned_of(start, capfd, given, words):
    start(*given)
    (warning,) = [line for line in capfd.readouterr().err.splitlines() if '[WARN]' in line]
    assert words in warning


def test_changes_while_running_and_bad_ones_that_change_nothing(start):
    node = start()
    assert changed(node, 'sound_speed', 1450.0).successful
    assert node.tracker.config.sound_speed == 1450.0
    assert changed(node, 'stale_after', 3.0).successful
    assert node._settings[NodeConfig].stale_after == 3.0
    before = node.tracker.config
    for name, value, word in (
        ('sound_speed', 1500, 'DOUBLE'), ('sound_speed', 9.0, ''), ('sound_speed', math.nan, ''),
        ('steps', 4, 'read-only'), ('weights', [0.5, 7.0], 'between 0 and 1'),
        ('mood', 'sad', 'one of calm, hasty'), ('fast_share', 0.5, 'sum to 1'),
    ):  # fmt: skip
        result = changed(node, name, value)
        assert not result.successful and word in result.reason, name
        assert node.tracker.config is before
    both = [Parameter('fast_share', value=0.5), Parameter('slow_share', value=0.5)]
    assert node.set_parameters_atomically(both).successful  # these only fit together
    assert node.tracker.config.fast_share == 0.5


@pytest.mark.parametrize(
    'entry, sentence',
    [
        ('fxi=geometry_msgs/msg/PointStamped', "did you mean 'fix'"),
        ('nav=nav_msgs/msg/Odometry', "'nav=nav_msgs/msg/Odometry' is not <input>=<type> of one"),
        ('fix=geometry_msgs/msg/PointStampd', "did you mean 'geometry_msgs/msg/PointStamped'"),
        ('fix', "fix must be one of .*, got ''"),
    ],
)
def test_a_type_is_one_that_the_input_can_have_by_default_its_first_one(entry, sentence):
    with pytest.raises(ConfigError, match=sentence):
        chosen_types('diver', [entry])
    chosen = chosen_types('diver', ['fixes=geometry_msgs/msg/PoseArray'])
    assert chosen['fixes'] == 'geometry_msgs/msg/PoseArray'
    assert chosen['fix'] == 'geometry_msgs/msg/PoseWithCovarianceStamped'


@pytest.mark.parametrize('system', SYSTEMS)
def test_what_node_and_tracker_both_take_is_one_parameter(system):
    own = {spec.name: spec for spec in SYSTEMS[system].config_type().specs()}
    for spec in NodeConfig.specs():
        if (twin := own.get(spec.name)) is not None:
            for name in ('kind', 'default', 'choices', 'read_only'):
                assert getattr(twin, name) == getattr(spec, name), (spec.name, name)


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
    # Sections are found in namespaces.
    text = (
        '/**:\n  ros__parameters: {}\n/auv1:\n  bow:\n    ros__parameters: {}\n'
        'diver:\n  ros__parameters:\n    a: 1\n'
    )
    assert sections_of(text) == ['/**', '/auv1/bow', 'diver']
    assert sections_of('a: 1') == sections_of('{[') == sections_of('5') == []


# -- The policies of SROS 2 allow what the nodes do, and nothing else --


FOLDER = Path(__file__).resolve().parents[2] / 'config' / 'sros2'


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
        names = {item.text.replace('~', f'/{node.get_name()}') for item in group}
        assert word == 'ALLOW' and not any('*' in name for name in names)  # nothing wholesale
        rules[group.tag, rule] = names
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

        def seen(ask=ask):
            return {item for item, _ in ask(*who)}

        due = given.get(rule, set())
        with contextlib.suppress(AssertionError):  # the graph hears of it a little later
            bench.spin_until(lambda due=due, seen=seen: due == seen(), 5.0)
        assert due == seen(), rule
    assert {'/rosout', '/parameter_events'} <= given['topics', 'publish']
    assert '/clock' in given['topics', 'subscribe']
    assert f'/{name}/get_type_description' in given['services', 'reply']
    assert {path.stem for path in FOLDER.iterdir()} == NODES.keys()
