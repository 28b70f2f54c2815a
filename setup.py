# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Build description of sonar_imm, for colcon (ament_python) and pip alike."""

from pathlib import Path
import re
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'sonar_imm'
# What runs on the boat, the workbench on the desk, and what both read messages with.
PACKAGES = (PACKAGE, f'{PACKAGE}_tools', 'msg_adapters')
# Resolved, because `colcon build --symlink-install` runs a link to this file.
ROOT = Path(__file__).resolve().parent
# Bytes. What is larger stays in the repository, and the demo of an installation simulates it.
LARGEST_RECORDING = 850_000

# By their folders, because sonar_imm.trackers cannot be imported before its dependencies are here.
SYSTEMS = sorted(path.parent.name for path in (ROOT / PACKAGE / 'trackers').glob('*/tracker.py'))

REQUIRES = [
    'attrs>=23.1',
    'backports.zstd; python_version < "3.14"',  # later ones have it themselves
    'click>=8.1',
    'jinja2>=3.0',
    'lz4>=4.0',
    'numba>=0.58',
    'numpy>=1.26',
    'plotly>=5.15',
    'pymap3d>=3.0',
    'PyYAML>=6.0',
    'rich>=13.0',
    'rosbags>=0.11,<0.12',
    'scipy>=1.11',
    'tzdata; sys_platform == "win32"',  # zones by name, which other systems have
]
EXTRAS = {
    'chart': ['laspy[lazrs]>=2.5', 'rasterio>=1.3'],
    'cluster': ['dask[distributed]>=2024.1'],
    'docs': [
        'mkdocs>=1.6,<2',
        'mkdocs-material>=9.5',
        'mkdocstrings[python]>=0.26',
    ],
    'nmea': ['pyais>=2.7', 'pynmea2>=1.18'],
    'parquet': ['pyarrow>=14'],
    'pictures': ['pillow>=9.1'],
    'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
    'test': [
        'filterpy',
        'hypothesis',
        'laspy[lazrs]>=2.5',
        'obspy>=1.4.1',
        'pillow>=9.1',
        'pyais>=2.7',
        'pyarrow>=14',
        'pynmea2>=1.18',
        'pyogrio>=0.8',
        'pytest>=7.4',
        'pytest-benchmark',
        'pytest-xdist',
        'pyxtf>=1.4',
        'rasterio>=1.3',
        'segyio>=1.9',
        'soundfile>=0.12',
        'stonesoup',
    ],
    'lint': ['mypy', 'pre-commit', 'ruff'],
    'rerun': ['rerun-sdk>=0.24'],
    'segy': ['segyio>=1.9'],
    'sound': ['soundfile>=0.12'],
    'sweep': ['dask[distributed]>=2024.1'],  # the former name of 'cluster', for one version
    'xtf': ['pyxtf>=1.4'],
}


def version() -> str:
    """Read `__version__` without importing the package, whose dependencies may be missing yet."""
    text = (ROOT / PACKAGE / '__init__.py').read_text(encoding='utf-8')
    return re.search(r"^__version__ = '([^']+)'$", text, re.MULTILINE).group(1)


def shared_files() -> list[tuple[str, list[str]]]:
    """What goes below `share/`: the ament index marker, package.xml and whole folders."""
    files = {
        'share/ament_index/resource_index/packages': [f'resource/{PACKAGE}'],
        f'share/{PACKAGE}': ['package.xml'],
    }
    for room in ('bags', 'config', 'launch'):
        for path in sorted((ROOT / room).rglob('*')):
            if path.is_file() and (room != 'bags' or path.stat().st_size <= LARGEST_RECORDING):
                name = path.relative_to(ROOT)
                folder = f'share/{PACKAGE}/{name.parent.as_posix()}'
                files.setdefault(folder, []).append(name.as_posix())
    return list(files.items())


# Who maintains the package, and where it lives, is stated in package.xml only.
MANIFEST = ElementTree.parse(ROOT / 'package.xml').getroot()
MAINTAINER = MANIFEST.find('maintainer')

setup(
    name=PACKAGE,
    version=version(),
    description=MANIFEST.findtext('description'),
    long_description=(ROOT / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    project_urls={url.get('type', 'website'): url.text for url in MANIFEST.iter('url')},
    license='Apache-2.0',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 15)),
        'Topic :: Scientific/Engineering :: GIS',
        'Topic :: Scientific/Engineering',
    ],
    python_requires='>=3.10',
    packages=find_packages(include=[f'{top}{rest}' for top in PACKAGES for rest in ('', '.*')]),
    package_data={
        **dict.fromkeys(PACKAGES, ['py.typed']),
        f'{PACKAGE}.acoustics': ['*.npz'],
        f'{PACKAGE}_tools.evaluation': ['templates/*'],
    },
    data_files=shared_files(),
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'sonar-imm = sonar_imm_tools.cli:main',
            'fls_detector_node = sonar_imm.nodes.commands:main',
            'composed_node = sonar_imm.nodes.commands:main',  # only says that it was removed
            *(f'{system}_node = sonar_imm.nodes.commands:main' for system in SYSTEMS),
        ],
    },
)
