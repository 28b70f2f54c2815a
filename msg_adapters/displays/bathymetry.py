# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Displays of the sea floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sonar_imm.estimates import Estimate

from ..estimates import write_model_shares
from ..headers import Make
from .tracks import Drawn, MODELS, NAMED_SCALARS


class Displays:
    """The share of the bins that each terrain model holds."""

    topics: Mapping[str, str] = {MODELS: NAMED_SCALARS}

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        if is_wanted(MODELS):
            yield MODELS, write_model_shares(estimate, make)

    def forget(self, make: Make) -> Drawn:
        return iter(())
