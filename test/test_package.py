# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The package keeps its promises: one version, one list of dependencies, floors, fresh docs."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

from helpers.source import COME_WITH_RCLPY, COMMON_INTERFACES, imports, module_name, MODULES, ROOT
import pytest
import yaml

import msg_adapters
from msg_adapters.inputs import inputs_of
import sonar_imm
from sonar_imm.node_config import node_config_type, NodeConfig
from sonar_imm.parameters import parameters_from_yaml
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import COMMANDS

if not (ROOT / 'setup.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

# rosdep keys (package.xml) and PyPI names (setup.py) of the same thing.
PYPI_OF_KEY = {
    'python3-attrs': 'attrs', 'python3-click': 'click', 'python3-filterpy-pip': 'filterpy',
    'python3-hypothesis': 'hypothesis', 'python3-jinja2': 'jinja2', 'python3-numba': 'numba',
    'python3-numpy': 'numpy', 'python3-pymap3d': 'pymap3d', 'python3-pytest': 'pytest',
    'python3-pytest-benchmark': 'pytest-benchmark', 'python3-pytest-xdist': 'pytest-xdist',
    'python3-pil': 'pillow', 'python3-rasterio': 'rasterio', 'python3-rich': 'rich',
    'python3-rosbags-pip': 'rosbags', 'python3-scipy': 'scipy',
    'python3-stonesoup-pip': 'stonesoup', 'python3-yaml': 'PyYAML',
}  # fmt: skip
"""All keys are in rosdep/python.yaml of ros/rosdistro, as of 2026-08-22, with Ubuntu 24.04."""
RELEASED = {'ament_copyright', 'ament_flake8', 'ament_pep257', 'rclpy'}
"""Packages of Jazzy besides messages that are named in package.xml."""
WITHOUT_KEY = {'backports.zstd', 'lz4', 'plotly', 'tzdata'}
IMPORT_OF_PYPI = {'PyYAML': 'yaml', 'backports.zstd': 'backports'}
# Libraries that some commands need, each with an extra of its own.
PEERS = {
    'sonar_imm_tools.offline.jobs': {'distributed'},
    'sonar_imm_tools.offline.run_folder': {'pyarrow'},
    'sonar_imm_tools.evaluation.rerun_file': {'rerun'},
    'sonar_imm_tools.recordings.convert.fathometer': {'soundfile'},
    'sonar_imm_tools.recordings.convert.nmea': {'pyais', 'pynmea2'},
    'sonar_imm_tools.recordings.segy_lines': {'segyio'},
    'sonar_imm_tools.recordings.convert.images': {'PIL'},
    'sonar_imm_tools.recordings.export.horizons': {'segyio'},
    'sonar_imm_tools.recordings.export': {'pyarrow'},
    'sonar_imm_tools.recordings.export.points': {'laspy', 'pyarrow', 'rasterio'},
    'sonar_imm_tools.recordings.export.tracks': {'pyarrow'},
    'sonar_imm_tools.recordings.convert.xtf': {'pyxtf'},
    'sonar_imm_tools.survey.chart': {'rasterio'},
    'sonar_imm_tools.survey.products': {'pyarrow', 'rasterio'},
}

HEADER = ''.join((ROOT / 'setup.py').read_text(encoding='utf-8').splitlines(keepends=True)[:7])
LONGEST = 600
"""Lines of a file that is one idea, the licence not counted."""


@pytest.fixture(scope='module')
def manifest():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


@pytest.fixture(scope='module')
def setup_lists():
    """The literals assigned at the top of setup.py."""
    tree = ast.parse((ROOT / 'setup.py').read_text(encoding='utf-8'))
    return {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, (ast.List, ast.Dict))
    }


def test_there_is_one_version(manifest):
    assert sonar_imm.__version__ == msg_adapters.__version__ == manifest.findtext('version')
    changelog = (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')
    version = re.escape(sonar_imm.__version__)
    dated = re.search(rf'^{version} \(([\d-]+)\)$', changelog, re.MULTILINE)
    cited = yaml.safe_load((ROOT / 'CITATION.cff').read_text())
    assert cited['version'] == sonar_imm.__version__ and len(cited['references']) == 4
    assert dated and cited.get('date-released', dated[1]) == dated[1]


def test_every_key_of_package_xml_is_one_of_rosdep_or_a_package_of_jazzy(manifest):
    keys = {each.text for each in manifest if each.tag.endswith('depend')}
    assert keys <= {*PYPI_OF_KEY, *RELEASED, *COMMON_INTERFACES, *COME_WITH_RCLPY}
    # Messages that are declared come with the extra `ros`.
    assert texts(manifest, 'depend') <= COMMON_INTERFACES | COME_WITH_RCLPY


def test_catkin_reads_the_package_and_its_changelog():
    """As bloom, colcon and rosdoc2 do."""
    package = pytest.importorskip('catkin_pkg.package')
    from catkin_pkg.changelog import get_changelog_from_path

    warned, read = [], package.parse_package(str(ROOT))
    read.validate(warnings=warned)
    assert not warned
    assert (read.name, read.get_build_type()) == ('sonar_imm', 'ament_python')
    ((version, _, _),) = get_changelog_from_path(str(ROOT)).foreach_version()
    assert version == read.version


def test_package_xml_and_setup_name_the_same_dependencies_and_versions(manifest, setup_lists):
    requires, tests = setup_lists['REQUIRES'], setup_lists['EXTRAS']['test']
    wanted = {PYPI_OF_KEY[key] for key in texts(manifest, 'exec_depend') if key != 'rclpy'}
    assert wanted | WITHOUT_KEY == {*map(distribution, requires)}
    # The linters of ament come with ROS 2, not from PyPI.
    keys = {key for key in texts(manifest, 'test_depend') if not key.startswith('ament_')}
    without_key = 'laspy obspy pyais pyarrow pynmea2 pyogrio pyxtf segyio soundfile'.split()
    assert {PYPI_OF_KEY[key] for key in keys}.union(without_key) == {*map(distribution, tests)}
    pins = {
        distribution(line): set(re.findall(r'[<>]=?[0-9.]+', line)) for line in (*requires, *tests)
    }
    signs = {'version_gte': '>=', 'version_lt': '<'}
    for element in (*manifest.findall('exec_depend'), *manifest.findall('test_depend')):
        if (name := PYPI_OF_KEY.get(str(element.text))) is not None:
            given = {signs[key] + value for key, value in element.attrib.items()}
            assert given == pins[name], name


def test_every_import_is_declared(manifest, setup_lists):
    named = map(distribution, setup_lists['REQUIRES'])
    declared = {IMPORT_OF_PYPI.get(name, name) for name in named}
    declared |= texts(manifest, 'depend') | texts(manifest, 'exec_depend')
    declared |= {'msg_adapters', 'sonar_imm', 'sonar_imm_tools', *sys.stdlib_module_names}
    declared.add('compression')  # of the library of Python 3.14
    for path in MODULES:
        used = {name.split('.')[0] for name in imports(path)}
        assert used - declared <= PEERS.get(module_name(path), set()), path


def test_the_conda_recipe_has_the_version_and_the_requirements_of_setup(setup_lists):
    recipe = yaml.safe_load((ROOT / 'conda' / 'recipe.yaml').read_text(encoding='utf-8'))
    assert recipe['package']['version'] == sonar_imm.__version__
    wanted = {line.replace(' ', '').lower() for line in recipe['requirements']['run']}
    ros = {line for line in wanted if line.startswith('ros')}
    here = [line for line in setup_lists['REQUIRES'] if 'win32' not in line]
    named = {line.partition(';')[0].lower() for line in here}
    assert wanted - named == ros - named | {'python>=3.10,<3.14'}
    assert named <= wanted
    jazzy = {line for line in ros if line.startswith('ros-')}
    assert jazzy == {'ros-jazzy-rclpy', 'ros-jazzy-common-interfaces'}


def test_tests_that_start_processes_lie_where_make_looks_for_them():
    """Collecting all the others takes longer than many of them."""
    marked = [
        path for path in (ROOT / 'test').rglob('*.py') if f'mark.{"system"}' in path.read_text()
    ]
    assert {path.relative_to(ROOT / 'test').parts[0] for path in marked} == {'system'}


def test_files_begin_with_the_licence_and_are_not_too_long():
    files = [
        path
        for room in ('sonar_imm', 'sonar_imm_tools', 'msg_adapters', 'test', 'benchmarks', 'docs')
        for path in (ROOT / room).rglob('*.py')
    ]
    texts_of = {
        str(path.relative_to(ROOT)): path.read_text(encoding='utf-8')
        for path in (*files, ROOT / 'setup.py')
    }
    bare = [name for name, text in texts_of.items() if text and not text.startswith(HEADER)]
    assert 'Copyright' in HEADER and not bare, 'the licence is missing at the top'
    bodies = {name: text.removeprefix(HEADER).strip() for name, text in texts_of.items()}
    assert not {name for name, text in bodies.items() if len(text.splitlines()) > LONGEST}


def test_generated_files_are_up_to_date():
    spec = importlib.util.spec_from_file_location('generate', ROOT / 'docs' / 'generate.py')
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    files = generate.generated()
    assert files
    for name, text in files.items():
        found = (ROOT / name).read_text(encoding='utf-8') if (ROOT / name).exists() else ''
        assert found == text, f'{name} is out of date: run `make generate`'


def test_every_system_is_found_by_its_name():
    """The record of a system names modules; each has to be there with what it is to provide."""
    for name, system in SYSTEMS.items():
        assert name == system.name and inputs_of(name)
        assert issubclass(node_config_type(system), NodeConfig)
        scenes = importlib.import_module(system.scenes)
        assert scenes.SCENARIOS and callable(scenes.scenario) and callable(scenes.simulate)
        assert callable(importlib.import_module(system.judge).scored)
        node = ROOT.joinpath(*system.node.split('.')).with_suffix('.py')  # importing needs rclpy
        assert '\ndef main(' in node.read_text(encoding='utf-8')
        assert list((ROOT / 'bags').glob(f'{name}_*')), f'no recording of {name} is shipped'
        assert f'## {name}_node' in (ROOT / 'docs' / 'topics.md').read_text(encoding='utf-8')


def test_every_folder_of_a_system_is_listed_and_built():
    """A folder that `SYSTEMS` does not know would never be used; setup.py goes by the folders."""
    rooms = 'sonar_imm/trackers', 'sonar_imm_tools/simulation', 'sonar_imm_tools/evaluation'
    folders = {
        room: {path.parent.name for path in (ROOT / room).glob('*/__init__.py')} for room in rooms
    }
    inputs = {path.stem for path in (ROOT / 'msg_adapters' / 'inputs').glob('*.py')}
    folders['msg_adapters/inputs'] = inputs - {'__init__', 'topic'}
    assert set(map(frozenset, folders.values())) == {frozenset(SYSTEMS)}, folders
    text = (ROOT / 'setup.py').read_text(encoding='utf-8')
    (line,) = re.findall(r'^SYSTEMS = (.+)$', text, re.MULTILINE)
    found = eval(line, {'ROOT': ROOT, 'PACKAGE': 'sonar_imm', 'sorted': sorted})
    assert found == list(SYSTEMS)


def test_default_parameter_file_holds_the_defaults():
    for system in SYSTEMS.values():
        text = (ROOT / 'config' / f'{system.name}.yaml').read_text(encoding='utf-8')
        values = parameters_from_yaml(text, node_name=system.name)
        config = system.config_type()
        for key, value in config().as_dict().items():
            # ROS 2 refuses a whole number for a double.
            pairs = zip(values[key], value) if isinstance(value, list) else [(values[key], value)]
            assert all(type(given) is type(due) for given, due in pairs), key
        assert config.from_mapping(values, ignore_unknown=True) == config()


NO_ROS = "ROS 2 is not found: source a Jazzy workspace, or pip install 'sonar_imm[ros]'"


@pytest.mark.parametrize(
    'missing, advice',
    [('rclpy', NO_ROS), ('lifecycle_msgs', NO_ROS), ('numpy', 'pip install sonar_imm brings it.')],
)
def test_a_node_says_what_is_missing(missing, advice):
    program = """
import sys
from sonar_imm.nodes.commands import main

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            raise ModuleNotFoundError(name=name)

sys.meta_path.insert(0, NoRos())
sys.argv[0] = '/opt/lib/sonar_imm/diver_node'
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, '-c', program, missing], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.splitlines() == [f'diver_node: {missing} is not here. {advice}']


def test_the_page_of_commands_names_every_subcommand():
    page = (ROOT / 'docs' / 'reference' / 'commands.md').read_text(encoding='utf-8')
    table = page.partition('| subcommand |')[2].partition('\n\n')[0]
    assert set(re.findall(r'^\| `([a-z]+)', table, re.MULTILINE)) == set(COMMANDS)


def test_the_examples_of_the_library_run(capsys):
    page = (ROOT / 'docs' / 'howto' / 'library.md').read_text(encoding='utf-8')
    table = page.partition('| name | use |')[2].partition('\n\n')[0]
    assert sorted(re.findall(r'`(\w+)`', table)) == sorted(sonar_imm.__all__)
    examples = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    for example in examples:
        exec(compile(example, 'library.md', 'exec'), {})
        assert capsys.readouterr().out
    lines = [line for line in examples[0].splitlines() if line.strip()]
    assert len(examples) == 4 and len(lines) <= 10


def texts(manifest, tag):
    return {element.text for element in manifest.iter(tag)}


def distribution(requirement):
    return re.match(r'[A-Za-z0-9_.-]+', requirement).group()


# -- the linters of ament, where they are installed (a ROS 2 machine: `rosdep install -t test`);
# elsewhere ruff and the tests above check the same things --

NAMES = 'benchmarks docs examples msg_adapters sonar_imm sonar_imm_tools test setup.py'
SOURCES = [str(ROOT / name) for name in NAMES.split()]


# The form of a summary is the project's own, as in setup.cfg.
OURS = 'D205 D209 D213 D400 D401 D402 D403 D415'.split()
LINTERS = {
    'copyright': [], 'flake8': ['--config', str(ROOT / 'setup.cfg')],
    'pep257': ['--add-ignore', *OURS, '--'],
}  # fmt: skip


@pytest.mark.linter
@pytest.mark.parametrize(
    'name', [pytest.param(name, marks=getattr(pytest.mark, name)) for name in LINTERS]
)
def test_a_linter_of_ament_finds_nothing(name):
    main = pytest.importorskip(f'ament_{name}.main')
    assert main.main(argv=[*LINTERS[name], *SOURCES]) == 0
