"""``sonar-imm play``."""

from __future__ import annotations

from pathlib import Path

import click

from .common import BAG, example, progress, say


@click.command(
    epilog=example(
        'sonar-imm play dive.bag --clock',
        'sonar-imm play dive.bag --lockstep /diver',
        'sonar-imm play dive.bag --remap /usbl/pose:=/fix --rate 5',
    )
)
@click.argument('bag', type=BAG)
@click.option(
    '-r',
    '--rate',
    type=click.FloatRange(min=0.0, min_open=True),
    default=1.0,
    show_default=True,
    help='Speed: 2 is twice as fast.',
)
@click.option('-l', '--loop', is_flag=True, help='Start over at the end, until Ctrl-C.')
@click.option(
    '--start-offset',
    type=click.FloatRange(min=0.0),
    default=0.0,
    metavar='SECONDS',
    help='Skip so much of the recording.',
)
@click.option(
    '-d',
    '--delay',
    type=click.FloatRange(min=0.0),
    default=0.0,
    metavar='SECONDS',
    help='Wait before the first message.',
)
@click.option(
    '-p', '--start-paused', is_flag=True, help='Wait for the service /sonar_imm_player/resume.'
)
@click.option(
    '--clock',
    type=click.FloatRange(min=0.0, min_open=True),
    is_flag=False,
    flag_value=40.0,
    default=None,
    metavar='[HZ]',
    help='Publish /clock, at 40 Hz by default.',
)
@click.option(
    '--topics', multiple=True, metavar='TOPIC', help='Only this topic; may be given several times.'
)
@click.option(
    '-m',
    '--remap',
    'remaps',
    multiple=True,
    metavar='OLD:=NEW',
    help='Publish under another name; may be given several times.',
)
@click.option(
    '--lockstep',
    is_flag=False,
    flag_value='auto',
    default='',
    metavar='[NODE]',
    help='Send the next message only when NODE, by default the only one, has answered.',
)
def command(bag: Path, remaps: tuple[str, ...], **options: object) -> None:
    """Publish the recording BAG to live nodes, byte for byte, stamps included.

    The options have the names of those of `ros2 bag play`. In lock-step no message is lost: each
    one waits until NODE (a node of this package, e.g. /diver) has processed the one before.
    """
    from ..nodes.player import play, PlayOptions
    from ..recordings.reader import BagReader

    with BagReader(bag) as reader:
        chosen = options['topics'] or [topic.name for topic in reader.topics]
        total = sum(topic.count for topic in reader.topics if topic.name in chosen)
    settings = PlayOptions(remap=dict(_old_and_new(remap) for remap in remaps), **options)
    with progress('playing', None if settings.loop else total) as advance:
        result = play(bag, settings, progress=advance)
    say(f'{result.published} messages published')
    for problem in result.problems:
        say(f'  problem: {problem}')


def _old_and_new(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(':=')
    if not (old and separator and new):
        raise click.BadParameter(f"'{text}' is not of the form OLD:=NEW", param_hint='--remap')
    return old, new
