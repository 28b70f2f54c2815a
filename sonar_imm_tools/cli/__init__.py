# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The ``sonar-imm`` command: one small module per subcommand, loaded only when it is called.

Exit codes: 0 done, 1 failed or a check fell short, 2 bad usage or input, 130 interrupted, 141 the
reader of the output went away, 129 and 143 ended by SIGHUP and SIGTERM. A mistake of the user
gives one line on standard error; a traceback is a bug.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import functools
from importlib import import_module
import io
import os
import signal
import sys
import threading
from typing import Any, NoReturn

import click

from sonar_imm import __version__
from sonar_imm.gone import GONE
from sonar_imm.parameters import did_you_mean
from sonar_imm.texts import visible
from sonar_imm.threads import one_blas_thread

__all__ = ['COMMANDS', 'main']

PROGRAM = 'sonar-imm'

COMMANDS = {
    'simulate': 'Write a bag of simulated measurements with truth.',
    'convert': 'Turn other formats (CSV, JSON, ...) into a bag.',
    'info': 'Show what is in a bag, which tracker fits, what is wrong with it.',
    'track': 'Track a recorded bag offline: estimates as bag and table.',
    'evaluate': 'Score a tracked bag: metrics.json and one HTML report.',
    'export': 'Write soundings, horizons, tracks or obstacles for other programs.',
    'survey': 'Make one chart of many survey lines, adjusted where they cross.',
    'view': 'Open the HTML report of a run; a bag is tracked and scored first.',
    'play': 'Publish a bag to live nodes.',
    'echo': 'Show the estimates of running nodes as a live table.',
    'check': 'Start the real nodes, play the bags, compare with track and truth.',
    'tune': 'Fit parameters to your recordings, list the undetermined ones.',
    'bench': 'Measure speed against other libraries, in one run.',
    'warm': 'Compile the kernels of the trackers now, not at the first start.',
    'demo': 'Play the shipped bags to live nodes, track, score, write a report.',
}


ENDING = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, 'SIGHUP') else [])]
"""Signals that end a program; Windows has no SIGHUP."""
READER_GONE = 141
"""Exit code when the reader of the output went away: that of SIGPIPE in a shell."""


class LazyGroup(click.Group):
    """Subcommand NAME is the attribute ``command`` of the module ``<package>.NAME``."""

    def __init__(self, *args: Any, package: str, summaries: Mapping[str, str], **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._package = package
        self._summaries = summaries

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._summaries)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in self._summaries:
            return None
        return import_module(f'{self._package}.{name}').command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in self._summaries and not args[0].startswith('-'):
            if gone := GONE.get(f'command {args[0]}'):
                ctx.fail(f"'{args[0]}' {gone}")
            ctx.fail(f"there is no command '{args[0]}'{did_you_mean(args[0], self._summaries)}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the subcommand. A reader that went away, as in ``... | head``, is no error."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise click.exceptions.Exit(READER_GONE) from None

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands only: the usage names both options, and the page fits one screen."""
        self.format_commands(ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands from the summaries; importing every module would take seconds."""
        with formatter.section('Commands'):
            formatter.write_dl(list(self._summaries.items()))


@click.group(
    name=PROGRAM,
    cls=LazyGroup,
    package=__name__,
    summaries=COMMANDS,
    invoke_without_command=True,
    options_metavar='[--help | --version]',
    subcommand_metavar='COMMAND [ARGS]...',
    context_settings={'help_option_names': ['-h', '--help'], 'max_content_width': 100},
    epilog=f'`{PROGRAM} COMMAND --help` shows the options of a command and an example.',
)
@click.version_option(__version__, prog_name=PROGRAM)
@click.pass_context
def command(ctx: click.Context) -> None:
    """Track targets and terrain with sonar, by several models at once."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit code. The only place that prints errors."""
    one_blas_thread()
    # What the terminal cannot show is written as an escape, instead of an error.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors='backslashreplace')
    with _signals_unwind():
        return _run(arguments)


@contextlib.contextmanager
def _signals_unwind() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind every ``with`` block, as Ctrl-C does; otherwise a node that
    was started would live on. Handlers that a program has set itself are kept."""
    ours = []
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, _leave)
                ours.append(number)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _leave(number: int, _frame: object) -> NoReturn:
    # A second signal must not interrupt the unwinding.
    for item in ENDING:
        signal.signal(item, signal.SIG_IGN)
    sys.unraisablehook = functools.partial(_quiet_on_half_made, sys.unraisablehook)
    raise SystemExit(128 + number)


def _quiet_on_half_made(others: Callable[[Any], None], problem: Any) -> None:
    """Say nothing of objects whose constructor the signal broke off: they miss their attributes
    when they are taken down."""
    taken_down = getattr(problem.object, '__name__', '') == '__del__'
    if not (taken_down and isinstance(problem.exc_value, AttributeError)):
        others(problem)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        status = command.main(args=arguments, prog_name=PROGRAM, standalone_mode=False)
        if status == READER_GONE:
            # The buffered rest cannot be written; Python would report an error at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return status if isinstance(status, int) else 0
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else PROGRAM
        return _complain(f'{error.format_message().rstrip(".")} (see {path} --help)')
    except click.ClickException as error:
        return _complain(error.format_message())
    except click.Abort:
        return _complain('interrupted', 130)
    except Exception as error:
        if _replay_failed(error):
            return _complain(str(error), 1)
        sentence = _user_error(error)
        if sentence is None:
            raise
        return _complain(sentence)


def _replay_failed(error: Exception) -> bool:
    """Whether a live node failed. Only commands that load rclpy can have this error."""
    link = sys.modules.get('sonar_imm_tools.replay.link')
    return link is not None and isinstance(error, link.LinkError)


def _user_error(error: Exception) -> str | None:
    """Sentence for an error in the input, the configuration or the machine; None for a bug."""
    from sonar_imm.measurements import Rejection
    from sonar_imm.parameters import ConfigError

    from ..recordings.sources import BagError, NoRecordingError

    if isinstance(error, NoRecordingError):
        from ..recordings.convert import hint

        return f'{error}{hint(error.path)}'
    if isinstance(error, (ConfigError, Rejection, BagError)):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and error.name:
        return missing_package(error.name.split('.')[0])
    if isinstance(error, UnicodeEncodeError) and not error.object.isascii():
        name = error.object.encode('utf-8', 'backslashreplace').decode()
        return f'{name} is not UTF-8, which a library that is needed here cannot name; rename it'
    if isinstance(error, OSError):
        known = error.filename and error.strerror
        return f'{error.filename}: {error.strerror}' if known else str(error)
    return None


def missing_package(name: str) -> str | None:
    """How to install a package that only some commands need; None for one that all need."""
    from sonar_imm.nodes import NO_ROS

    remedies = {
        'distributed': 'dask.distributed, which distributes the runs, is not installed: pip '
        "install 'sonar_imm[cluster]', or use --jobs",
        'rclpy': NO_ROS,
        'segyio': "segyio, which reads SEG-Y, is not installed: pip install 'sonar_imm[segy]'",
        'laspy': "laspy, which writes LAS and LAZ, is not here: pip install 'sonar_imm[chart]'",
        'rasterio': "rasterio, which writes GeoTIFF, is not here: pip install 'sonar_imm[chart]'",
        'pyarrow': "pyarrow, which knows Parquet, is not here: pip install 'sonar_imm[parquet]'",
        'rerun': "rerun-sdk, which writes the file, is not here: pip install 'sonar_imm[rerun]'",
    }
    return remedies.get(name)


def _complain(sentence: str, status: int = 2) -> int:
    print(f'{PROGRAM}: {visible(" ".join(sentence.split()))}', file=sys.stderr)
    return status
