# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Displays of reflectors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimates import Estimate

from ..estimates import write_model_probabilities
from ..headers import Make
from .tracks import Drawn, MODELS, NAMED_SCALARS


class Displays:
    """How probable each number of reflectors is, the same in all rows; and that a reflector is
    still, or dipping, in the mean of them."""

    topics: Mapping[str, str] = {MODELS: NAMED_SCALARS}

    def of(self, estimate: Estimate, make: Make, is_wanted: Callable[[str], Any]) -> Drawn:
        if is_wanted(MODELS) and len(estimate):
            # Recordings of earlier versions have no slopes.
            dipping = float(np.mean(estimate.extras.get('dipping', 0.0)))
            extras = {'still': np.array([1.0 - dipping]), 'dipping': np.array([dipping])}
            shown = evolve(estimate, extras=extras)
            yield MODELS, write_model_probabilities(shown, 0, make, tuple(extras))

    def forget(self, make: Make) -> Drawn:
        return iter(())
