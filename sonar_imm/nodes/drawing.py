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

"""Publishing what is drawn of estimates, to those who listen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msg_adapters.displays import displays_of, Drawn

from ..estimates import Estimate
from .messages import make


class Drawing:
    """The displays of `system`; `advertise` offers a topic of a type and gives its publisher."""

    def __init__(self, system: str, advertise: Callable[[str, str], Any]):
        self._displays = displays_of(system)
        self._publishers = {
            name: advertise(type_name, f'~/{name}')
            for name, type_name in self._displays.topics.items()
        }

    def show(self, newest: Estimate) -> None:
        """Draw the newest estimate."""
        self._publish(self._displays.of(newest, make, self._heard))

    def forget(self) -> None:
        """Take away what is drawn."""
        self._publish(self._displays.forget(make))

    def _heard(self, name: str) -> int:
        return self._publishers[name].get_subscription_count()

    def _publish(self, drawn: Drawn) -> None:
        for name, message in drawn:
            self._publishers[name].publish(message)
