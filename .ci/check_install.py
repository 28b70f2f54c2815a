# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

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

START_LIMIT = 300.0  # an empty kernel cache makes the first start slow on a small machine
STOP_LIMIT = 20.0


def main(prefix: Path) -> None:
    from ament_index_python.packages import get_package_prefix

    import sonar_imm
    from sonar_imm.trackers import SYSTEMS
    from sonar_imm_tools.resources import shared_file

    expect(Path(get_package_prefix('sonar_imm')) == prefix, 'the ament index knows the package')
    expect(prefix in Path(sonar_imm.__file__).parents, 'Python imports the installed package')
    for system in SYSTEMS:
        expect(
            prefix in shared_file(f'config/{system}.yaml').parents,
            f'the shared files of {system} are installed',
        )
    command = prefix / 'lib' / 'sonar_imm' / 'sonar-imm'
    printed = subprocess.run([command, '--version'], capture_output=True, text=True, check=True)
    expect(sonar_imm.__version__ in printed.stdout, f'sonar-imm says {printed.stdout.strip()!r}')
    # It needs marine_acoustic_msgs, which are not on PyPI, so it is not started.
    expect(
        (prefix / 'lib' / 'sonar_imm' / 'fls_detector_node').is_file(),
        'fls_detector_node is installed',
    )
    nodes = [Started(prefix / 'lib' / 'sonar_imm' / f'{system}_node') for system in SYSTEMS]
    try:
        for node in nodes:
            node.wait_for('ready')
        for node in nodes:
            node.interrupt()
    finally:
        for node in nodes:
            node.kill()


class Started:
    """A node that was started, and what it says. All start at once, since each compiles its
    kernels first."""

    def __init__(self, executable: Path):
        self._name, self._printed = executable.name, ''
        self._process = subprocess.Popen(
            [executable], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._forward, daemon=True)
        self._reader.start()

    def wait_for(self, word: str) -> None:
        """Wait until a line holds `word`; fail when it does not come."""
        end = time.monotonic() + START_LIMIT
        while time.monotonic() < end:
            try:
                line = self._lines.get(timeout=0.5)
            except queue.Empty:
                if self._process.poll() is not None:
                    break
                continue
            print(f'  {line}', end='')
            self._printed += line
            if word in line:
                return
        raise SystemExit(f"{self._name} never said '{word}'")

    def interrupt(self) -> None:
        """Press Ctrl-C: the node has to leave with 0."""
        self._process.send_signal(signal.SIGINT)
        try:
            status = self._process.wait(STOP_LIMIT)
        except subprocess.TimeoutExpired:
            raise SystemExit(
                f'{self._name} did not stop on SIGINT within {STOP_LIMIT} s'
            ) from None
        self._reader.join(STOP_LIMIT)
        while not self._lines.empty():
            self._printed += self._lines.get()
        clean = status == 0 and 'Traceback' not in self._printed
        expect(clean, f'{self._name} stops on SIGINT with {status}')

    def kill(self) -> None:
        """Leave nothing behind."""
        self._process.kill()

    def _forward(self) -> None:
        for line in self._process.stdout:
            self._lines.put(line)


def expect(fact: bool, what: str) -> None:
    print(f'{"ok" if fact else "FAILED"}: {what}')
    if not fact:
        raise SystemExit(1)


if __name__ == '__main__':
    main(Path(sys.argv[1]).resolve())
