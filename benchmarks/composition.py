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

"""Memory and latency of two robots' trackers, in processes of their own and in one process.

    python -m benchmarks.composition --messages 200 --rate 10

Each robot has a diver and an obstacle node. All four get a message at the same moment, `rate`
times a second, which is the worst case for one thread. Memory: PSS, in which what processes share
counts once; RSS, in which it counts in each. Needs ROS 2; compile first (`sonar-imm warm`).
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from functools import partial
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

import numpy as np

from benchmarks.node_latency import _passed, Case, case_of, LIMIT, Peer, SETTLED
from benchmarks.study import Parts, study
from sonar_imm_tools.replay.harness import reserved_domain_id
from sonar_imm_tools.replay.link import Link, LinkError

ROBOTS, SYSTEMS = ('auv1', 'auv2'), ('diver', 'obstacle')


def megabytes(pids: Sequence[int], kind: str) -> float:
    """What these processes have in memory, ``Pss`` or ``Rss``."""
    total = 0
    for pid in pids:
        text = Path(f'/proc/{pid}/smaps_rollup').read_text()
        total += int(re.findall(rf'^{kind}:\s+(\d+)', text, re.MULTILINE)[0])
    return total / 1024


def sent(cases: Sequence[Case], peers: Sequence[Peer], link: Link, rate: float) -> np.ndarray:
    """(K, N) milliseconds from sending to each answer."""
    streams = [iter(case.messages) for case in cases]
    spent: list[list[float]] = []
    due = time.perf_counter()
    while True:
        timed = []
        for case, peer, stream in zip(cases, peers, streams):
            for key, message in stream:
                if key == case.timed:
                    timed.append((peer, key, message))
                    break
                peer.out[key].publish(message)
        if len(timed) < len(peers):
            return np.array(spent[SETTLED:])
        due += 1.0 / rate
        link.wait_for(partial(_passed, due), LIMIT)
        begins = []
        for peer, key, message in timed:
            peer.answered = 0.0
            begins.append(time.perf_counter())
            peer.out[key].publish(message)
        if not link.wait_for(lambda: all(peer.answered for peer in peers), LIMIT):
            raise LinkError('a node did not answer')
        spent.append([1e3 * (peer.answered - begin) for peer, begin in zip(peers, begins)])


def main(messages: int = 200, rate: float = 10.0) -> Parts:
    made = {system: case_of(system, messages) for system in SYSTEMS}
    names = [f'{robot}/{system}' for robot in ROBOTS for system in SYSTEMS]
    cases = [made[name.rpartition('/')[2]] for name in names]
    for label, groups in (('own processes', [[name] for name in names]), ('one process', [names])):
        with reserved_domain_id() as domain, contextlib.ExitStack() as stack:
            os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
            processes = []
            for group in groups:
                command = [sys.executable, '-m', 'sonar_imm.nodes.composed']
                command += [f'/{name}' for name in group]
                if len(group) == 1:  # as a user starts it
                    module = group[0].rpartition('/')[2]
                    command[2:] = [f'sonar_imm.nodes.{module}', '--ros-args', '-r']
                    command.append(f'__ns:=/{group[0].rpartition("/")[0]}')
                else:
                    command.append('--ros-args')
                command += ['-p', 'model_set:=heading_speed'] if 'diver' in command[2] else []
                process = subprocess.Popen(
                    command, env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}
                )
                stack.callback(process.wait, 60.0)
                stack.callback(process.send_signal, signal.SIGINT)
                processes.append(process)
            link = stack.enter_context(Link('bench', domain_id=domain))
            peers: list[Peer] = []
            for name, case in zip(names, cases):
                robot = name.partition('/')[0]
                kinds = {key: type(message) for key, message in case.messages}
                topics = {key: (f'/{robot}/{key}', kind) for key, kind in kinds.items()}
                peers.append(Peer(link, name, topics))
            if not all(link.wait_for(peer.ready, LIMIT) for peer in peers):
                raise LinkError('the nodes did not appear')
            time.sleep(3.0)  # the rest of the kernels is loaded after a node is ready
            spent = sent(cases, peers, link, rate)
            pids = [process.pid for process in processes]
            row = {kind.upper() + ' MB': megabytes(pids, kind) for kind in ('Pss', 'Rss')}
        for k, system in enumerate(SYSTEMS):
            both = spent[:, k :: len(SYSTEMS)].ravel()
            row |= {f'{system} p{q} ms': float(np.percentile(both, q)) for q in (50, 99)}
        row['load'] = os.getloadavg()[0]
        yield {f'two robots, {rate:g} Hz': {label: row}}


if __name__ == '__main__':
    study(main, digits=1)
