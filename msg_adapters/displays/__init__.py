# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a node draws of an estimate besides its table. One module per system, as for the inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, Protocol

from sonar_imm.estimates import Estimate

from ..headers import Make
from .tracks import Drawn

__all__ = ['Displays', 'displays_of', 'Drawn']


class Displays(Protocol):
    """The drawings of one system. topics: their message types by name.

    Messages are made by `make`, and only for names that `is_wanted` somebody asks for.
    """

    topics: Mapping[str, str]

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        """Draw the newest estimate."""

    def forget(self, make: Make) -> Drawn:
        """Take away what is drawn: all tracks are forgotten."""


def displays_of(system: str) -> Displays:
    """New displays of a system, with nothing drawn yet."""
    displays: Displays = import_module(f'{__name__}.{system}').Displays()
    return displays
