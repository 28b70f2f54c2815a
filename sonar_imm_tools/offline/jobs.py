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

"""Processes that share work: of this machine, or of a dask cluster."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import contextlib
import multiprocessing
import signal
from typing import Any

from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError

from ..recordings.sources import BagError

CONNECT_SECONDS = 10.0
"""How long a scheduler may take to answer."""


@contextlib.contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """So many fresh processes. What has not begun when the context is left by an error is not
    begun any more.

    Raises OSError when one of them dies, or where there is no shared memory (/dev/shm). They are
    started anew and not forked: a fork copies the threads of a library half.
    """
    try:
        pool = ProcessPoolExecutor(
            count,
            mp_context=multiprocessing.get_context('spawn'),
            initializer=ignore_interrupt,
        )
    except (OSError, ImportError, NotImplementedError) as error:  # Python has three ways to say it
        raise OSError(
            f'processes cannot share work here ({error}): is there a /dev/shm? with --jobs 1 '
            'there is only one'
        ) from None
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


def sentence_of(error: BaseException) -> str:
    """One line; what is not a mistake of the user keeps the name of its class."""
    text = ' '.join(str(error).split())
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
        raise ConfigError(
            f'no dask scheduler answers at {address} within {CONNECT_SECONDS:g} s'
        ) from None
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


def as_they_end(
    client: Any, work: Callable[..., Any], calls: Sequence[tuple[Any, ...]]
) -> Iterator[tuple[int, Any, str]]:
    """``work(*call)`` for each of `calls` on the workers of a dask client: the number of the call,
    what came of it, and the sentence why nothing did. A worker may have died, or the scheduler be
    gone."""
    from distributed import as_completed

    futures = {client.submit(work, *call, pure=False): k for k, call in enumerate(calls)}
    for future in as_completed(futures):
        if future.cancelled():
            yield futures[future], None, 'the connection to the scheduler was lost'
        elif (error := future.exception()) is not None:
            yield futures[future], None, sentence_of(error)
        else:
            yield futures[future], future.result(), ''
        future.release()
