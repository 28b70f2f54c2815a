# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Processes that share work: of this machine, or of a dask cluster."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import contextlib
import multiprocessing
import signal
import sys
from typing import Any

from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError

from ..recordings.sources import BagError

LIBRARIES = ['sonar_imm_tools.offline.tracking']
"""Modules that most of the work needs, and that take seconds to load."""
CONNECT_SECONDS = 10.0
"""How long a scheduler may take to answer."""


@contextlib.contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """So many fresh processes. What has not begun when the context is left by an error is not
    begun any more.

    Raises OSError when one of them dies, or where there is no shared memory (/dev/shm).
    """
    pool = _fresh(count)
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


def _fresh(count: int) -> ProcessPoolExecutor:
    """Processes that are no forks of this one: a fork copies the threads of a library half. On
    Linux they are forks of one that only loaded libraries; on macOS a fork does not live."""
    context = multiprocessing.get_context('forkserver' if sys.platform == 'linux' else 'spawn')
    if sys.platform == 'linux':
        context.set_forkserver_preload(LIBRARIES)
    try:
        return ProcessPoolExecutor(count, mp_context=context, initializer=ignore_interrupt)
    except (OSError, ImportError, NotImplementedError) as error:  # Python has three ways to say it
        raise OSError(
            f'processes cannot share work here ({error}): is there a /dev/shm? with --jobs 1 '
            'there is only one'
        ) from None


Work = Callable[..., Any]
Calls = Sequence[tuple[Any, ...]]
Ended = Iterator[tuple[int, Any, str]]
Run = Callable[[Work, Calls], Ended]
"""``run(work, calls)``: as they end, the number of each call, what came of it, or why nothing."""


@contextlib.contextmanager
def workers(
    count: int = 1, address: str | None = None, note: Callable[[str], None] = lambda sentence: None
) -> Iterator[Run]:
    """What runs calls in this process, in `count` processes, or on a dask cluster.

    A process that dies costs what it was doing: the rest is done by others, and so is that, a
    second time by itself. Raises as `cluster` does.
    """
    if address is not None:
        with cluster(address, note) as client:
            yield lambda work, calls: as_they_end(client, work, calls)
    elif count == 1:
        yield _in_turn
    else:
        with _Pool(count) as pool:
            yield pool.run


def _in_turn(work: Work, calls: Calls) -> Ended:
    for k, call in enumerate(calls):
        try:
            result = work(*call)
        except Exception as error:
            yield k, None, sentence_of(error)
        else:
            yield k, result, ''


class _Pool:
    """Processes that are started again when one of them dies."""

    def __init__(self, count: int):
        self._count = count
        self._executor: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *error: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=error[0] is None, cancel_futures=True)

    def run(self, work: Work, calls: Calls) -> Ended:
        left = dict(enumerate(calls))
        yield from self._some(work, left)
        for k in list(left):  # those that were under way or not begun when a process died
            alone = {k: left.pop(k)}
            yield from self._some(work, alone)
            if alone:
                yield k, None, 'the process that did it was ended, perhaps for lack of memory'

    def _some(self, work: Work, left: dict[int, tuple[Any, ...]]) -> Ended:
        """Do what is `left`, and take away what was done, until a process dies."""
        if self._executor is None:
            self._executor = _fresh(self._count)
        try:
            futures = {self._executor.submit(work, *call): k for k, call in left.items()}
            for future in as_completed(futures):
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    raise error
                del left[futures[future]]
                result = None if error else future.result()
                yield futures[future], result, sentence_of(error) if error else ''
        except BrokenProcessPool:
            self._executor.shutdown(wait=False, cancel_futures=True)
            self._executor = None


def ignore_interrupt() -> None:
    """Ctrl-C reaches all processes of a terminal; the first one ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def sentence_of(error: BaseException) -> str:
    """One line; what is not a mistake of the user keeps the name of its class."""
    text = ' '.join(str(error).split())
    if isinstance(error, OSError) and error.filename and error.strerror:
        text = f'{error.filename}: {error.strerror}'
    expected = isinstance(error, (ConfigError, Rejection, BagError, OSError))
    return text if expected and text else f'{type(error).__name__}: {text}'


@contextlib.contextmanager
def cluster(address: str, note: Callable[[str], None] = lambda sentence: None) -> Iterator[Any]:
    """A client of the dask scheduler at `address`; `note` hears of troubles that may pass.

    Raises `ConfigError` when no scheduler answers there, ModuleNotFoundError without dask.
    """
    from distributed import Client

    try:
        identity = asyncio.run(asyncio.wait_for(_identity(address), CONNECT_SECONDS))
    except asyncio.TimeoutError:
        within = f'within {CONNECT_SECONDS:g} s'
        raise ConfigError(f'no dask scheduler answers at {address} {within}') from None
    except Exception as error:  # whatever a program says that is no scheduler
        raise ConfigError(f'no dask scheduler at {address}: {sentence_of(error)}') from None
    if not identity.get('workers'):
        note(f'the scheduler at {address} has no workers yet; the runs wait for one')
    with Client(address, timeout=CONNECT_SECONDS) as client:
        yield client


async def _identity(address: str) -> dict[str, Any]:
    """What a scheduler says of itself. `Client` would wait for ever on a port that is silent."""
    from distributed import rpc
    from distributed.security import Security

    async with rpc(address, connection_args=Security().get_connection_args('client')) as remote:
        return await remote.identity()


def as_they_end(client: Any, work: Work, calls: Calls) -> Ended:
    """``work(*call)`` for each of `calls` on the workers of a dask client, as `Run` has it. A
    worker may have died, or the scheduler be gone."""
    from distributed import as_completed as ended

    futures = {client.submit(work, *call, pure=False): k for k, call in enumerate(calls)}
    for future in ended(futures):
        if future.cancelled():
            yield futures[future], None, 'the connection to the scheduler was lost'
        elif (error := future.exception()) is not None:
            yield futures[future], None, sentence_of(error)
        else:
            yield futures[future], future.result(), ''
        future.release()
