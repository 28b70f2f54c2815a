# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The shipped layouts of Foxglove and RViz2 name only what the nodes really have: topics with
their types, fields, columns of estimates, models in their order, states of the diagnostics."""

from importlib import import_module
import json
import re

from diagnostic_msgs.msg import DiagnosticArray
import pytest
import yaml

from msg_adapters.displays.diver import FAMILIES
from msg_adapters.displays.obstacle import BEHAVIOURS
from msg_adapters.estimates import write_model_probabilities
from sonar_imm.nodes.messages import message_class
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.offline.tracking import OfflineRun
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.resources import shared_file

BAGS = {
    'bathymetry': 'bathymetry_paper', 'fathometer': 'fathometer_drift',
    'obstacle': 'obstacle_movers', 'diver': 'diver_multistatic',
}  # fmt: skip
IN_3D = {
    'geometry_msgs/msg/PoseArray', 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'nav_msgs/msg/Odometry', 'sensor_msgs/msg/PointCloud2', 'visualization_msgs/msg/MarkerArray',
}  # fmt: skip


def topics_of(system, make_bench):
    """Every topic of the running node with its type."""
    bench, module = make_bench(), import_module(f'sonar_imm.nodes.{system}')
    node = bench.start(getattr(module, f'{system.capitalize()}Node'))
    received = bench.listen(DiagnosticArray, '/diagnostics')
    bench.spin_until(lambda: received and node._hears)  # which is once kernels are compiled
    published = node.get_publisher_names_and_types_by_node(system, '/')
    subscribed = node.get_subscriber_names_and_types_by_node(system, '/')
    found = {name: types[0] for name, types in published + subscribed}
    found['states'] = {status.name for status in received[0].status}
    return found


def estimate_of(system):
    """The first estimate with a row that the tracker makes of a shipped recording."""
    path = shared_file(f'bags/{BAGS[system]}')
    record = SYSTEMS[system]
    values = yaml.safe_load(own.path.read_text()) if (own := own_parameters(path)) else {}
    values = values.get('/**', {}).get('ros__parameters', values)
    with BagReader(path) as bag:
        config = record.config_type().from_mapping(values, ignore_unknown=True)
        return next(
            estimate for estimate in OfflineRun(bag, record, config).estimates() if len(estimate)
        )


@pytest.mark.parametrize('system', SYSTEMS)
def test_layouts_name_what_the_node_has(system, make_bench):
    topics, estimate = topics_of(system, make_bench), estimate_of(system)
    check_foxglove(system, topics, estimate)
    check_rviz(system, topics, estimate)


def check_foxglove(system, topics, estimate):
    layout = json.loads(shared_file(f'config/foxglove_{system}.json').read_text())
    panels, columns = layout['configById'], estimate.columns()
    for name, panel in panels.items():
        kind = name.partition('!')[0]
        if kind == '3D':
            for topic, look in panel['topics'].items():
                assert topics[topic] in IN_3D
                assert 'colorField' not in look or look['colorField'] in columns
        elif kind == 'Plot':
            for path in panel['paths']:
                check_path(path, topics, estimate)
        else:
            assert topics[panel['topicToRender']] == 'diagnostic_msgs/msg/DiagnosticArray'
            assert panel.get('selectedName') in {None, *topics['states']}
    assert placed(layout['layout']) == set(panels)


def check_path(path, topics, estimate):
    """One curve of a plot: its field exists, and it is the model that its label says."""
    topic, _, fields = path['value'].partition('.')
    cls = message_class(topics[topic])
    for field in fields.split('.'):
        field, index = re.fullmatch(r'(\w+)(?:\[(\d+)\])?', field).groups()
        kind = cls.get_fields_and_field_types()[field]
        assert (index is not None) == kind.startswith('sequence<')
        if '/' in kind:
            cls = message_class(kind)
    if topic.endswith('/model_probabilities'):
        drawn = write_model_probabilities(estimate, 0, ros_message, (*FAMILIES, *BEHAVIOURS))
        assert drawn.name[int(index)] == path['label']


def placed(tree):
    """The panels that are placed on the screen."""
    if isinstance(tree, str):
        return {tree}
    return placed(tree['first']) | placed(tree['second'])


def check_rviz(system, topics, estimate):
    displays = yaml.safe_load(shared_file(f'config/{system}.rviz').read_text())
    displays = displays['Visualization Manager']['Displays']
    drawn = [display for display in displays if 'Topic' in display]
    assert drawn
    for display in drawn:
        drawn_as = topics[display['Topic']['Value']].rpartition('/')[2].removesuffix('Stamped')
        assert drawn_as == display['Class'].partition('/')[2]
        if display['Class'].endswith('/PointCloud2'):
            assert display['Channel Name'] in estimate.columns()
