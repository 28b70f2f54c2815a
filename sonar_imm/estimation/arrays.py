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

"""Names for arrays by the kind of number they hold; the shapes stand in the docstrings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
IndexArray = NDArray[np.intp]


def with_rows(array: NDArray[Any], count: int, value: Any) -> NDArray[Any]:
    """`array` (n, ...) and behind it `count` rows with a value for all or one for each. For a few
    rows this is quicker than to make an array of the value first."""
    n = len(array)
    out = np.empty((n + count, *array.shape[1:]), array.dtype)
    out[:n], out[n:] = array, value
    return out
