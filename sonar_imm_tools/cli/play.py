# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm play``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .common import progress, say


class ManyWords(click.Command):
    """Lets options that may be repeated take several words at once, as ``ros2 bag play`` does."""

    GREEDY = ('--topics', '--exclude-topics', '--remap', '-m')

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat such an option before each of its words; an existing file is not one of them."""
        words: list[str] = []
        option, first = '', False
        for word in args:
            if word.startswith('-'):
                option, first = word if word in self.GREEDY else '', True
            elif option and not first and not Path(word).exists():
                words.append(option)
            else:
                first = False
            words.append(word)
        return super().parse_args(ctx, words)


# fmt: off
@click.command(cls=ManyWords,
    epilog=opt.example('sonar-imm play dive.bag --clock',
        'sonar-imm play dive.bag --lockstep /diver',
        'sonar-imm play dive.bag --remap /usbl/pose:=/fix --rate 5'))
@click.argument('bag', type=opt.PATH)
@click.option('-r', '--rate', type=opt.POSITIVE, default=1.0,
    show_default=True, help='Speed: 2 is twice as fast.')
@click.option('-l', '--loop', is_flag=True, help='Start over at the end, until Ctrl-C.')
@click.option('--start-offset', type=opt.NOT_NEGATIVE, default=0.0, metavar='SECONDS',
    help='Skip so much of the recording.')
@click.option('--playback-duration', type=float, default=-1.0, metavar='SECONDS',
    help='Play so much of the recording; negative, the default: to its end.')
@click.option('-d', '--delay', type=opt.NOT_NEGATIVE, default=0.0, metavar='SECONDS',
    help='Wait before the first message.')
@click.option('-p', '--start-paused', is_flag=True,
    help='Wait for the service /sonar_imm_player/resume.')
@click.option('--clock', type=opt.POSITIVE, is_flag=False,
    flag_value=40.0, default=None, metavar='[HZ]', help='Publish /clock, at 40 Hz by default.')
@click.option('--topics', multiple=True, metavar='TOPIC...', help='Only these topics.')
@click.option('--exclude-topics', multiple=True, metavar='TOPIC...', help='Not these topics.')
@click.option('--qos-profile-overrides-path', 'qos_file',
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help='YAML file with history, depth, reliability and durability by topic.')
@click.option('-m', '--remap', 'remaps', multiple=True, metavar='OLD:=NEW...',
    help='Publish under other names.')
@click.option('--lockstep', is_flag=False, flag_value='auto', default='', metavar='[NODE]',
    help='Send the next message only when NODE, by default the only one, has answered.')
def command(bag: Path, remaps: tuple[str, ...], qos_file: Path | None, **options: Any) -> None:
    """Publish the recording BAG to live nodes, byte for byte, stamps included.

    These options are those of `ros2 bag play`, with its names and words; others of it are not
    there, and --lockstep is ours. In lock-step no message is lost: each
    one waits until NODE (a node of this package, e.g. /diver) has processed the one before.
    """
    from sonar_imm.nodes.qos import profiles_of
    from sonar_imm.parameters import ConfigError, small_text

    from ..recordings.reader import BagReader
    from ..replay.player import play, PlayOptions

    qos = {}
    if qos_file is not None:
        try:
            qos = profiles_of(small_text(qos_file))
        except (ConfigError, UnicodeDecodeError) as error:
            raise ConfigError(f'{qos_file}: {error}') from None
    settings = PlayOptions(remap=dict(_old_and_new(remap) for remap in remaps), qos=qos, **options)
    with BagReader(bag) as reader:
        chosen = settings.topics or [topic.name for topic in reader.topics]
        chosen = [name for name in chosen if name not in settings.exclude_topics]
        total = sum(topic.count for topic in reader.topics if topic.name in chosen)
    with progress('playing', None if settings.loop else total) as advance:
        result = play(bag, settings, progress=advance)
    say(f'{result.published} messages published')
    for problem in result.problems:
        say(f'  problem: {problem}')
# fmt: on


def _old_and_new(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise click.BadParameter(f"'{text}' is not of the form OLD:=NEW", param_hint='--remap')
    return old, new
