"""Processes of this machine that share work."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import contextlib
import multiprocessing
import signal


@contextlib.contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """So many fresh processes. What has not begun when the context is left by an error is not
    begun any more.

    Raises OSError when one of them dies. They are started anew and not forked: a fork copies the
    threads of a library half.
    """
    pool = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context('spawn'),
        initializer=ignore_interrupt,
    )
    try:
        yield pool
    except BrokenProcessPool:
        raise OSError(
            'a process that shared the work was ended, perhaps for lack of memory; with --jobs 1 '
            'there is only one'
        ) from None
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def ignore_interrupt() -> None:
    """Ctrl-C reaches all processes of a terminal; the first one ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
