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

"""``sonar-imm view``."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from pathlib import Path
import tempfile
import threading
from typing import Any

import click

from .common import BAG, example, say


@click.command(
    epilog=example(
        'sonar-imm view out',
        'sonar-imm view dive.bag --rate 4 --loop',
        'sonar-imm view --live',
        'sonar-imm view out --browser',
        'sonar-imm view out --rerun out.rrd',
    )
)
@click.argument('source', metavar='[BAG|RUN]', required=False, type=BAG)
@click.option('--live', is_flag=True, help='Show the topics of the nodes that run.')
@click.option(
    '--browser',
    is_flag=True,
    help='Open the HTML report instead; a BAG is tracked and scored for it. Needs no viewer.',
)
@click.option(
    '--rerun',
    'rerun_file',
    metavar='FILE.rrd',
    type=click.Path(path_type=Path, dir_okay=False),
    help='Write the estimates of RUN for the Rerun viewer instead.',
)
@click.option('--topics', metavar='TOPIC', multiple=True, help='Show only this topic; repeat it.')
@click.option(
    '--rate', type=click.FloatRange(min=0.0, min_open=True), default=1.0, show_default=True
)
@click.option('--loop', is_flag=True, help='Start over at the end.')
@click.option('--start-paused', is_flag=True, help='Wait for the play button of the viewer.')
@click.option(
    '--host',
    default='127.0.0.1',
    show_default=True,
    help='Who may connect: 127.0.0.1 this machine only, 0.0.0.0 the whole network.',
)
@click.option(
    '--port',
    type=click.IntRange(0, 65535),
    default=8765,
    show_default=True,
    help='Port of the WebSocket; 0 takes a free one.',
)
@click.option(
    '--layout',
    'layout_file',
    metavar='FILE.json',
    type=click.Path(path_type=Path, dir_okay=False),
    help='Write the Foxglove layout for what is shown to FILE.json, with its topic names.',
)
def command(
    source: Path | None,
    live: bool,
    browser: bool,
    rerun_file: Path | None,
    topics: tuple[str, ...],
    rate: float,
    loop: bool,
    start_paused: bool,
    host: str,
    port: int,
    layout_file: Path | None,
) -> None:
    """Show a recording, a run of `sonar-imm track`, or running nodes in Foxglove.

    Serves the topics on a WebSocket that Foxglove (desktop or web) connects to, with its own play,
    pause and jump for what is recorded; Ctrl-C ends it. A run is shown with the recording it was
    made of. Needs foxglove-sdk (pip install 'sonar_imm[view]') and, for Foxglove, an account
    there; its page in the browser needs the network too. --browser and --rerun need neither.
    """
    if live == (source is not None):
        raise click.UsageError('say either a BAG or RUN, or --live')
    if live and (browser or rerun_file):
        raise click.UsageError('--browser and --rerun show what is recorded, not --live')
    if browser and source:
        _open_report(source)
        return
    if rerun_file and source:
        _write_rerun(source, rerun_file)
        return
    with contextlib.suppress(KeyboardInterrupt):  # the way to end it, so no failure
        if source:
            playing = {'rate': rate, 'loop': loop, 'autostart': not start_paused}
            _show_recorded(source, topics, host, port, layout_file, playing)
        else:
            _show_live(topics, host, port, layout_file)


def _show_recorded(
    source: Path,
    topics: Sequence[str],
    host: str,
    port: int,
    layout_file: Path | None,
    playing: dict[str, Any],
) -> None:
    from ..viewing.material import opened
    from ..viewing.playback import Playback
    from ..viewing.server import ViewServer

    with opened(source, topics) as (material, problems):
        for sentence in problems:
            say(f'  problem: {sentence}')
        playback = Playback(
            material.first_ns, material.last_ns, rate=playing['rate'], loop=playing['loop']
        )
        with ViewServer(
            source.name, host, port, playback, autostart=playing['autostart']
        ) as server:
            server.advertise(material.channels.values())
            _announce(server, list(material.channels), layout_file)
            player = threading.Thread(
                target=playback.run,
                args=(material.messages, server.publish, server.tell_time, server.tell_state),
                name='player',
            )
            player.start()
            try:
                while player.is_alive():
                    player.join(0.5)  # a join without limit would not hear Ctrl-C
            finally:
                playback.stop()
                player.join()


def _show_live(topics: Sequence[str], host: str, port: int, layout_file: Path | None) -> None:
    from ..replay.link import Link
    from ..replay.listening import Relay
    from ..viewing.material import Channel, Shown
    from ..viewing.server import ViewServer

    with Link('sonar_imm_view') as link, ViewServer('sonar_imm live', host, port) as server:
        relay = Relay(
            link,
            topics,
            appeared=lambda *channel: server.advertise([Channel(*channel)]),
            vanished=server.withdraw,
            received=lambda *message: server.publish(Shown(*message)),
            watched=server.watched,
        )
        relay.step(0.5)
        relay.step(0.5)
        _announce(server, relay.topics, layout_file)
        shown: set[str] = set()
        while True:
            relay.step(0.1)
            for name in relay.problems.keys() - shown:
                say(f'  problem: {relay.problems[name]}')
                shown.add(name)


def _announce(server: Any, topics: Sequence[str], layout_file: Path | None) -> None:
    """Say where to connect, and with which layout."""
    from ..viewing.layouts import fitting_layouts, write_layout

    say(f'{len(topics)} topics on {server.url}')
    say(f'open it in Foxglove: {server.app_url} (network and an account; --browser needs neither)')
    layouts = fitting_layouts(topics)
    for system in layouts:
        say(f'layout of {system} (Foxglove: Layouts, Import from file): {layouts[system]}')
    if layout_file is not None:
        if not layouts:
            raise click.UsageError('there is no layout for these topics')
        write_layout(layout_file, next(iter(layouts)), topics)
        say(f'layout with the names of these topics: {layout_file}')
    say('Ctrl-C ends it')


def _open_report(source: Path) -> None:
    import webbrowser

    from ..offline.batch import run_folders
    from ..offline.run_folder import REPORT, RUN, summaries
    from .evaluate import evaluate_run
    from .track import Plan, track_one

    run = source
    if (source / RUN).is_file() or summaries(source):
        folders = run_folders(source)
    else:
        run = Path(tempfile.mkdtemp(prefix='sonar_imm_')) / 'run'
        say(f'tracking {source} into {run}')
        jobs = Plan().jobs(source, run)
        for job in jobs:
            track_one(job)
        folders = [job.folder for job in jobs]
    report = run / REPORT
    if not report.is_file():
        from ..evaluation.report import write_report

        write_report(report, [evaluate_run(folder).part([]) for folder in folders])
    say(f'report: {report.resolve()}')
    with contextlib.suppress(webbrowser.Error):
        webbrowser.open(report.resolve().as_uri())


def _write_rerun(run: Path, file: Path) -> None:
    from ..viewing.rerun_file import write_rerun

    count = write_rerun(run, file)
    say(f'{count} estimates written to {file}; show them with: rerun {file}')
