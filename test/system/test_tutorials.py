# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every command of the tutorials and how-to pages, run in a real shell in the order of the page.

A fenced block `bash` is run; the lines of a block `text` have to be in what it has printed, in
order. Numbers may differ by 5 %, or by one in the last digit; `...` stands for what is not shown.
"""

import contextlib
import math
import os
from pathlib import Path
import re
import signal
import subprocess
import sys

from helpers.forked import commands
from helpers.source import commits, ROOT
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.replay.harness import reserved_domain_id

pytestmark = pytest.mark.system

TUTORIALS, HOWTO = (
    sorted(
        path
        for path in (ROOT / 'docs' / folder).glob('*.md')
        if '\n```bash\n' in path.read_text(encoding='utf-8')
    )
    for folder in ('tutorials', 'howto')
)
EVERY = os.environ.get('SONAR_IMM_PAGES') == 'all'
"""Whether all pages are run, as `.ci/run` does; else the tutorials and two of the others, which
change with each commit."""
TURN = 2 * commits() % len(HOWTO)
PAGES = [*TUTORIALS, *(HOWTO if EVERY else (2 * HOWTO)[TURN : TURN + 2])]
NUMBER = re.compile(r'-?\d+(?:\.\d+)?|-?\.\d+')
LONGEST = 600.0
"""Seconds that a page may take on a busy machine."""


def blocks(page):
    """Commands and what they print, which is '' where the page does not show it."""
    given = []
    for kind, text in re.findall(r'^```(bash|text)\n(.*?)^```$', page, re.M | re.S):
        if kind == 'bash':
            given.append((text, ''))
        else:
            assert given and not given[-1][1], 'output without the command before it'
            given[-1] = (given[-1][0], text)
    return given


def same(shown, printed):
    """Whether a line says the same: the words are equal, the numbers nearly."""
    if NUMBER.sub('#', ' '.join(shown.split())) not in NUMBER.sub('#', ' '.join(printed.split())):
        return False
    pattern = NUMBER.sub('\0', re.sub(r'\s+', ' ', shown.strip()))
    words = r'\s+'.join(map(re.escape, pattern.split(' '))).replace(re.escape('\0'), '\0')
    found = re.search(words.replace('\0', f'({NUMBER.pattern})'), printed)
    return found is not None and all(map(near, NUMBER.findall(shown), found.groups()))


def near(shown, printed):
    digits = len(shown.partition('.')[2])
    last = 1.01 * 10.0**-digits if digits else 0.0
    return math.isclose(float(shown), float(printed), rel_tol=0.05, abs_tol=last)


def missing(shown, printed):
    """The first line that was shown and not printed after those before it."""
    lines = iter(printed.splitlines())
    for line in filter(str.strip, shown.splitlines()):
        if line.strip() != '...' and not any(same(line, item) for item in lines):
            return line
    return None


@pytest.fixture(scope='module')
def command(tmp_path_factory):
    with commands(tmp_path_factory.mktemp('command')) as folder:
        yield folder


@pytest.mark.parametrize('page', PAGES, ids=lambda path: f'{path.parent.name}/{path.stem}')
def test_the_commands_of_a_page_run(page, tmp_path, command):
    pytest.importorskip('rclpy')
    given = blocks(page.read_text(encoding='utf-8'))
    mark = '=== block'
    script = '\n'.join(f'echo "{mark} {k}"\n{words}' for k, (words, _) in enumerate(given))
    places = command, Path(sys.executable).parent, os.environ['PATH']
    environment = {
        **os.environ, 'PATH': os.pathsep.join(map(str, places)),
        'PYTHONPATH': os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')]),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }  # fmt: skip
    for name in ('bags', 'examples'):
        (tmp_path / name).symlink_to(ROOT / name)
    output = tmp_path / 'output.log'
    with reserved_domain_id() as domain, output.open('w', encoding='utf-8') as log:
        environment['ROS_DOMAIN_ID'] = str(domain)
        shell = subprocess.Popen(
            ['bash', '-eu', '-o', 'pipefail', '-c', script], cwd=tmp_path, env=environment,
            stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            status = shell.wait(LONGEST)
        except subprocess.TimeoutExpired:
            status = None
        finally:  # what a page has left running, above all after a command that failed
            with contextlib.suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
    printed = output.read_text(encoding='utf-8')
    assert status == 0, printed
    for part, (_, shown) in zip(re.split(rf'^{mark} \d+\n', printed, flags=re.M)[1:], given):
        assert missing(shown, part) is None, f'not printed: {missing(shown, part)}\n{part}'


def test_all_tutorials_are_run_and_a_line_that_was_not_printed_is_found():
    assert {path.stem for path in TUTORIALS} >= set(SYSTEMS)
    printed = 'used 198\n  error 1.142 m\ndone 3\n'
    assert missing('used 198\n...\ndone 3\n', printed) is None
    assert missing('error 1.15 m\n', printed) is None
    assert missing('error 1.3 m\n', printed) == 'error 1.3 m'
    assert missing('done 3\nused 198\n', printed) == 'used 198'
    assert missing('used 198 times\n', printed) == 'used 198 times'
