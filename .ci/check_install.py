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

"""Check a colcon install of sonar_imm: what `ros2 run` needs is there and works.

Usage: python check_install.py PREFIX, after sourcing the workspace's local_setup.bash.
"""

from __future__ import annotations

from pathlib import Path
import queue
import signal
import subprocess
import sys
import threading
import time

START_LIMIT = 120.0  # an empty kernel cache makes the first start slow on a small machine
STOP_LIMIT = 20.0


def main(prefix: Path) -> None:
    from ament_index_python.packages import get_package_prefix

    import sonar_imm
    from sonar_imm.resources import shared_file
    from sonar_imm.trackers import SYSTEMS

    expect(Path(get_package_prefix('sonar_imm')) == prefix, 'the ament index knows the package')
    expect(prefix in Path(sonar_imm.__file__).parents, 'Python imports the installed package')
    for system in SYSTEMS:
        expect(
            prefix in shared_file(f'config/{system}.yaml').parents,
            f'the shared files of {system} are installed',
        )
    command = prefix / 'lib' / 'sonar_imm' / 'sonar-imm'
    said = subprocess.run([command, '--version'], capture_output=True, text=True, check=True)
    expect(sonar_imm.__version__ in said.stdout, f'sonar-imm says {said.stdout.strip()!r}')
    # It needs marine_acoustic_msgs, which are not on PyPI, so it is not started.
    expect(
        (prefix / 'lib' / 'sonar_imm' / 'fls_detector_node').is_file(),
        'fls_detector_node is installed',
    )
    for system in SYSTEMS:
        start_and_interrupt(prefix / 'lib' / 'sonar_imm' / f'{system}_node')


def start_and_interrupt(executable: Path) -> None:
    """Start the node, wait until it says it is ready, press Ctrl-C: it has to leave with 0."""
    node = subprocess.Popen(
        [executable], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    lines: queue.Queue[str] = queue.Queue()
    reader = threading.Thread(target=forward, args=(node, lines), daemon=True)
    reader.start()
    said = wait_for('ready', lines, node, executable)
    node.send_signal(signal.SIGINT)
    try:
        status = node.wait(STOP_LIMIT)
    except subprocess.TimeoutExpired:
        node.kill()
        raise SystemExit(
            f'{executable.name} did not stop on SIGINT within {STOP_LIMIT} s'
        ) from None
    reader.join(STOP_LIMIT)
    while not lines.empty():
        said += lines.get()
    expect(
        status == 0 and 'Traceback' not in said, f'{executable.name} stops on SIGINT with {status}'
    )


def forward(node: subprocess.Popen[str], lines: queue.Queue[str]) -> None:
    for line in node.stdout:
        lines.put(line)


def wait_for(
    word: str, lines: queue.Queue[str], node: subprocess.Popen[str], executable: Path
) -> str:
    """Collect what the node says until a line holds `word`; fail when it does not come."""
    said, end = '', time.monotonic() + START_LIMIT
    while time.monotonic() < end:
        try:
            line = lines.get(timeout=0.5)
        except queue.Empty:
            if node.poll() is not None:
                break
            continue
        print(f'  {line}', end='')
        said += line
        if word in line:
            return said
    node.kill()
    raise SystemExit(f"{executable.name} never said '{word}'")


def expect(fact: bool, what: str) -> None:
    print(f'{"ok" if fact else "FAILED"}: {what}')
    if not fact:
        raise SystemExit(1)


if __name__ == '__main__':
    main(Path(sys.argv[1]).resolve())
