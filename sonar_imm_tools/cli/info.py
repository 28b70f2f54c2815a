# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm info``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from sonar_imm.trackers import SYSTEMS

from . import options as opt
from .common import load_detector, print_json, progress, say


# fmt: off
@click.command(epilog=opt.example('sonar-imm info dive.bag', 'sonar-imm info --json dive.mcap'))
@click.argument('bag', type=opt.PATH)
@click.option('--strict', is_flag=True, help='Stop at the first damage instead of reading on.')
@opt.json
def command(bag: Path, strict: bool, as_json: bool) -> None:
    """Show what is in BAG, which tracker fits it and what is wrong with it.

    BAG is a rosbag2 folder, a bare .mcap or .db3 file, or a ROS 1 .bag file. Exit code 1 when
    no tracker can use it.
    """
    from ..offline.inspection import inspect
    from ..recordings.measurements import system_in_mind, types_heard
    from ..recordings.own_files import own_parameters
    from ..recordings.reader import BagReader

    # What the parameter file beside a recording says of its images.
    detector = load_detector(SYSTEMS['obstacle'], own_parameters(bag), {})
    with BagReader(bag, strict=strict) as reader:
        total = sum(topic.count for topic in reader.topics)
        with progress('reading', total, quiet=as_json) as advance:
            found = inspect(reader, advance, detector)
        suits = any(topic['suits'] for topic in found['topics'])
        heard = '' if suits or not total else types_heard(system_in_mind(reader))
    print_json(found) if as_json else _print(found, heard)
    if not found['systems']:
        raise click.exceptions.Exit(1)
# fmt: on


def _print(found: dict[str, Any], heard: str) -> None:
    say(f'{found["bag"]}: {found["messages"]} messages in {found["duration_s"]:.1f} s')
    for topic in found['topics']:
        rate = f', {topic["rate_hz"]:.3g} Hz' if topic['rate_hz'] else ''
        scans = topic['scans'] or {'most': 0, 'count': 0}
        several = f', {scans["count"]} scans, up to {scans["most"]} per scan'
        frames = f', frame {", ".join(topic["frames"])}' if any(topic['frames']) else ''
        say(
            f'  {topic["name"]}  {topic["type"]}  {topic["count"]} messages{rate}'
            f'{several if scans["most"] > 1 else ""}{frames}'
        )
        for suited in topic['suits']:
            say(f'      fits {suited}')
        for problem in topic['problems']:
            say(f'      problem: {problem}')
    for problem in found['problems']:
        say(f'problem: {problem}')
    for number, (system, named) in enumerate(found['topic_options'].items()):
        purpose = 'or as something else' if number else 'to track it'
        line = track_line(found['bag'], system, named, found['missing'][system])
        say(f'{purpose}: {line}')
    if not found['systems']:
        images = any(topic['type'].endswith('SonarImage') for topic in found['topics'])
        hint = '; of amplitude and phase sonar-imm convert interferometer makes snapshots'
        say('no tracker can use it' + (hint if images else heard))


def track_line(bag: str, system: str, named: dict[str, str], missing: Sequence[str] = ()) -> str:
    """The command that tracks the recording, with --topic where the names do not fit, and with
    --set for `missing` parameters, whose values only the user knows."""
    from ..recordings.sources import quoted

    words = [f'--topic {quoted(f"{name}={topic}")}' for name, topic in named.items()]
    for name in missing:
        unit = 'DEGREES' if name.endswith('_deg') else 'METRES'
        words.append(f'--set {name}={"ned" if name == "world_frame_convention" else unit}')
    path = f'./{bag}' if bag.startswith('-') else bag
    return ' '.join([f'sonar-imm track {quoted(path)} OUT_DIR --system {system}', *words])
