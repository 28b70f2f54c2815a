# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The parameters of a simulated scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

from attrs import frozen

from sonar_imm.parameters import Config, ConfigError, did_you_mean

S = TypeVar('S', bound='Scenario')


@frozen(kw_only=True)
class Scenario(Config):
    """Base class of the parameters of a scene.

    INSTRUMENT: names of parameters of the instrument that the tracker has under the same name.
    """

    INSTRUMENT: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def named(
        cls: type[S],
        name: str,
        scenarios: Mapping[str, tuple[str, dict[str, Any]]],
        overrides: Mapping[str, Any] | None,
    ) -> S:
        """The scenario `name` out of `scenarios` (name: description, values), with some values
        replaced. Raises `ConfigError` naming mistakes."""
        if name not in scenarios:
            raise ConfigError(
                f"unknown scenario '{name}'{did_you_mean(name, scenarios)}; there are "
                f'{", ".join(scenarios)}'
            )
        return cls.from_mapping({**scenarios[name][1], **(overrides or {})})

    def instruments(self) -> dict[str, Any]:
        """What a tracker has to know of the instruments, by the names of its parameters."""
        return {name: getattr(self, name) for name in self.INSTRUMENT}

    def feeder_instruments(self) -> dict[str, Any]:
        """What a node before that of the tracker has to know of the instruments."""
        return {}
