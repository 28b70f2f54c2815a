# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How a node is told to stop: SIGINT, SIGTERM and SIGHUP all mean a clean end with exit code 0.

Python runs signal handlers in the main thread between two of its instructions. While a node waits
in the middleware there are none, and while it starts an exception from a handler appears in the
middle of an import or of a constructor of somebody else. So no handler here raises. A thread reads
which signals came, and stops: before there is ROS, by ending the process, later by shutting ROS
down, on which `spin` returns.

A signal that is ignored when the node starts stays ignored: that is how ``nohup`` works.
"""

from __future__ import annotations

from collections.abc import Callable
import os
import signal
import sys
import threading
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

PATIENCE = 5.0
"""Seconds after which a node that was told to stop, and is still busy, ends as it is."""
START_PATIENCE = 0.5
"""The same while it starts: nothing depends on it yet, and kernels may take long to compile."""


class Stopper:
    """Takes the signals of this process from `listen` to `ignore` or `release`; main thread only.

    asked: whether a signal came.
    """

    def __init__(self) -> None:
        self.asked = False
        self._lock = threading.Lock()
        self._stop: Callable[[], Any] = _end_process
        self._patience = START_PATIENCE
        self._before: dict[int, Any] = {}
        self._wakeup, self._pipe = -1, -1

    @property
    def listening(self) -> bool:
        """Whether signals come here."""
        return bool(self._before)

    def listen(self) -> bool:
        """Take the signals, until ROS is there by ending the process. False when that is so
        already, or where no signal can be taken: in another thread."""
        if self.listening or threading.current_thread() is not threading.main_thread():
            return False
        reading, self._pipe = os.pipe()
        os.set_blocking(self._pipe, False)
        self.asked, self._stop = False, _end_process
        thread = threading.Thread(target=self._read, args=(reading,), name='signals', daemon=True)
        thread.start()
        self._wakeup = signal.set_wakeup_fd(self._pipe, warn_on_full_buffer=False)
        for number in ENDING:
            before = signal.getsignal(number)
            if before is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, _nothing)
        # Who starts a node may hold signals back until it has the process in hand.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
        return True

    def on_stop(self, stop: Callable[[], Any], patience: float = PATIENCE) -> None:
        """Stop by `stop` from now on, and `patience` seconds later anyhow; at once when a signal
        came meanwhile."""
        with self._lock:
            self._stop, self._patience = stop, patience
            asked = self.asked
        if asked:
            stop()

    def ignore(self) -> None:
        """Nothing can be stopped any more: let no late signal disturb the end of the process."""
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def release(self) -> None:
        """Give the signals back to whoever had them."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup)
        self._before = {}
        os.close(self._pipe)

    def end(self, code: int) -> int:
        """End the process now when a signal asked for it: taking all modules down takes seconds on
        a busy machine, and the watchdog does not live then. Gives `code` otherwise."""
        if self.asked:
            _end_process(code)
        return code

    def _read(self, reading: int) -> None:
        with os.fdopen(reading, 'rb', buffering=0) as pipe:
            while signals := pipe.read(1):
                if signals[0] in ENDING:
                    self._on_signal()

    def _on_signal(self) -> None:
        with self._lock:
            first, self.asked = not self.asked, True
            stop, patience = self._stop, self._patience
        if first:
            watchdog = threading.Timer(patience, _end_process)
            watchdog.daemon = True
            watchdog.start()
            stop()


def _nothing(number: int, frame: object) -> None:
    """A handler has to be there for Python to tell the thread."""


def _end_process(code: int = 0) -> None:
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError, AttributeError):
            pass  # nobody reads it any more
    os._exit(code)


stopper = Stopper()
"""That of this process."""
