# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""`sonar-imm` for the shells of a test. Most of what a command takes is loading libraries and
kernels: here it is a copy of a process that has them.

``python -m helpers.forked ADDRESS`` is that process, `commands` starts it.
"""

import contextlib
import importlib
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys

COPIED = ('convert', 'evaluate', 'info', 'simulate', 'track')
"""The others, which wait for signals or begin processes of their own, are the real command."""
COMMAND = """#!{python} -IS
import json, os, socket, sys
if sys.argv[1:2] and sys.argv[1] in {copied}:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        server.connect({address!r})
        asked = json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)])
        socket.send_fds(server, [asked.encode()], [0, 1, 2])
        sys.exit(int(server.recv(9)))
os.execv({real!r}, [{real!r}, *sys.argv[1:]])
"""


@contextlib.contextmanager
def commands(folder):
    """A folder for the head of PATH, as long as the process lives."""
    address, command = str(folder / 'socket'), folder / 'sonar-imm'
    python = sys.executable
    real = str(Path(python).with_name('sonar-imm'))
    words = {'python': python, 'copied': COPIED, 'address': address, 'real': real}
    command.write_text(COMMAND.format(**words))
    command.chmod(0o755)
    search = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
    with subprocess.Popen(
        [python, '-m', 'helpers.forked', address],
        env={**os.environ, 'PYTHONPATH': search},
        stdout=subprocess.PIPE,
        start_new_session=True,
    ) as server:
        try:
            assert server.stdout.readline() == b'ready\n'
            yield folder
        finally:
            os.killpg(server.pid, signal.SIGKILL)  # with what a page has left running


def serve(address):
    from sonar_imm.trackers import SYSTEMS
    from sonar_imm_tools.cli import main

    for name in COPIED:
        importlib.import_module(f'sonar_imm_tools.cli.{name}')
    for system in SYSTEMS.values():
        importlib.import_module(system.judge)
        system.build(system.config_type()()).warm()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        listening.bind(address)
        listening.listen()
        print('ready', flush=True)
        while True:
            asking, _ = listening.accept()
            with asking, contextlib.suppress(ChildProcessError):
                if not os.fork():
                    _answer(asking, main)
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass


def _answer(asking, main):
    """Run the command that was asked for, with its files, folder and environment."""
    code = 1
    try:
        asked, handles, _, _ = socket.recv_fds(asking, 1 << 20, 3)
        words, folder, environment = json.loads(asked)
        for number, handle in enumerate(handles):
            os.dup2(handle, number)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        code = main(words)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        asking.send(str(code).encode())
        os._exit(0)


if __name__ == '__main__':
    serve(sys.argv[1])
