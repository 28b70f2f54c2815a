# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that is started again goes on where it was: its state in a file.

The file belongs to one node: a second one that was given the same says so, and neither reads nor
writes it while the first one runs.

The state is taken between two messages, which takes a moment, and written by a thread of its own.
A file that cannot be used is said in one sentence and not lost: it gets another name when the
first state of this run is saved.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import threading
import time

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from ..files import hold
from ..intake import Intake
from ..node_config import NodeConfig
from ..parameters import Config, ConfigError
from ..trackers import SYSTEMS
from ..trackers.state_file import (
    intake_from,
    json_parameters,
    read_state,
    Saved,
    state_of,
    StateError,
    write_state,
)

PROOF = 100
"""Measurements after which a state that was loaded is taken for sound."""
_ENOUGH = 3
"""First measurements that have to be far from a state before it is given up; one may be wrong."""
STATE_INTERVAL = 10.0
"""Seconds between saves; the last state is saved in any case."""


class SavedState:
    """Loads and saves the state of one tracker and of the `Intake` before it.

    trouble: why states are not saved, in a sentence; empty while they are. intake: with the
    tracker.
    """

    def __init__(self, node: Node, system: str, settings: NodeConfig):
        """Raises `ConfigError` when the folder of the file is not there, or a user without a home
        says ``~``."""
        self.trouble = ''
        self._node, self._system = node, SYSTEMS[system]
        self._frame_id = settings.frame_id
        self._max_age = settings.state_max_age
        self._conventions = {
            'frame_id': settings.frame_id,
            'world_frame_convention': settings.world_frame_convention,
        }
        try:
            self._path = Path(settings.state_file).expanduser() if settings.state_file else None
        except RuntimeError as error:
            raise ConfigError(f"state_file: '~' stands for no folder ({error})") from None
        self._refused = self._others = False
        self._loaded_ns: int | None = None
        self._newest_ns: int | None = None
        self._taken = self._saved = self._far = 0
        self._unproven = 0
        self._thread: threading.Thread | None = None
        self._release: Callable[[], None] | None = None
        if self._path and not self._path.parent.is_dir():
            raise ConfigError(f"state_file: there is no folder '{self._path.parent}'")

    def load(self, config: Config) -> Intake:
        """The intake of a tracker that goes on from the file, or of a new one."""
        self.intake = self._from_file(config) or Intake(self._system.build(config), self._frame_id)
        return self.intake

    def _from_file(self, config: Config) -> Intake | None:
        if self._path and self._hold(self._path):
            try:
                return self._read(self._path, config)
            except FileNotFoundError:
                pass
            except StateError as error:
                self._refused = True
                self._node.get_logger().warning(
                    f"the state in '{self._path}' is not used: {error}; it is kept as "
                    f"'{_refused(self._path).name}' when the next one is saved"
                )
        return None

    def save_periodically(self, given: Callable[[], Config]) -> None:
        """`save` with the parameters `given()`, each time something new came."""
        if self._path:
            self._node.create_timer(
                STATE_INTERVAL,
                lambda: self.save(given()),
                clock=Clock(clock_type=ClockType.STEADY_TIME),
            )

    def still_fits(self, stamp_ns: int) -> bool:
        """Note a measurement; False when it shows that the loaded state is of another time."""
        self._taken += 1
        self._unproven = max(0, self._unproven - 1)
        self._newest_ns = stamp_ns
        loaded = self._loaded_ns
        if loaded is None:
            return True
        self._far = self._far + 1 if abs(stamp_ns - loaded) > self._max_age * 1e9 else 0
        if 0 < self._far < _ENOUGH:
            return True
        self._loaded_ns = None
        if self._far:
            self._node.get_logger().warning(
                f'the first measurements are {(stamp_ns - loaded) * 1e-9:+.0f} s from the last '
                'one of the state that was loaded: the tracker starts afresh'
            )
        return not self._far

    def gave_up(self, config: Config, error: BaseException | None) -> bool:
        """Whether the state that was loaded is to blame for an error, and is given up: say so, and
        replace the tracker of `intake` by a new one. What was measured since it was loaded has to
        go with it for a while before an error is taken for one of this program."""
        if not self._unproven or self._path is None:
            return False
        self._unproven = 0
        self._refused = True
        self._loaded_ns = None
        self._node.get_logger().warning(
            f"the state in '{self._path}' does not go with what is measured "
            f'({type(error).__name__}): the tracker starts afresh; it is kept as '
            f"'{_refused(self._path).name}' when the next one is saved"
        )
        fresh = Intake(self._system.build(config), self._frame_id)
        fresh.transforms = self.intake.transforms
        fresh.restored()
        self.intake = fresh
        return True

    def save(self, given: Config, *, wait: bool = False) -> None:
        """Write the state of now, if there is something new; `wait` until it is on the disk.
        given: the parameters of the tracker without what /tf_static says."""
        if self._thread is not None and (wait or not self._thread.is_alive()):
            self._thread.join()
            self._thread = None
        if self._path is None or self._taken == self._saved or self._thread is not None:
            return
        if not self._hold(self._path):
            return
        self._saved = self._taken
        saved = Saved(
            system=self._system.name,
            parameters=json_parameters(given),
            saved_ns=time.time_ns(),
            newest_ns=self._newest_ns,
            state=state_of(self.intake),
            extras=self._conventions,
        )
        if wait:
            self._write(self._path, saved)
            return
        self._thread = threading.Thread(target=self._write, args=(self._path, saved), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the file to others."""
        if self._release:
            self._release()
            self._release = None

    def _hold(self, path: Path) -> bool:
        """Whether the file is ours, or becomes so now."""
        if self._release:
            return True
        try:
            self._release = hold(path)
        except OSError:
            return True  # nothing can be written there, which `_write` says
        if self._release is None and not self._others:
            self._others = True
            self.trouble = f"another node has the state_file '{path}': no state is read or saved"
            self._node.get_logger().warning(f'{self.trouble}; give each node a file of its own')
        elif self._release and self._others:
            self._others, self._refused = False, True  # the state of the other is kept
        return self._release is not None

    def _read(self, path: Path, config: Config) -> Intake:
        saved = read_state(path)
        age = 1e-9 * (time.time_ns() - saved.saved_ns)
        if abs(age) > self._max_age:
            when = f'{age:.0f} s ago' if age > 0 else f'{-age:.0f} s ahead of the clock'
            raise StateError(f'it was saved {when}, state_max_age is {self._max_age:g} s')
        if saved.extras != self._conventions:
            raise StateError('it was saved with another frame_id or world_frame_convention')
        intake = intake_from(saved, self._system, config, self._frame_id)
        self._loaded_ns = self._newest_ns = saved.newest_ns
        self._unproven = PROOF
        self._node.get_logger().info(f"goes on from the state in '{path}', {age:.1f} s old")
        return intake

    def _write(self, path: Path, saved: Saved) -> None:
        try:
            if self._refused and path.exists():
                path.replace(_refused(path))
            self._refused = False
            write_state(path, saved)
        except OSError as error:
            if not self.trouble:
                self._node.get_logger().warning(
                    f"the state cannot be saved in '{path}' ({error.strerror}): said once"
                )
            self.trouble = f"the state cannot be saved in '{path}': {error.strerror}"
        else:
            self.trouble = ''


def _refused(path: Path) -> Path:
    return path.with_name(f'{path.name}.refused')
