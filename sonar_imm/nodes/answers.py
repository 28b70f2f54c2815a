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

"""The row on ``~/processed`` with which a node answers every message it takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from msg_adapters.table import encode_table

from .messages import make


def answer(counts: Mapping[str, int], stamp: Any = None) -> Any:
    """A table of one row with `counts` since the start of the node; `stamp` is that of the message
    that is answered, None for the first word of a node."""
    message = encode_table(
        {name: np.array([n], np.uint32) for name, n in counts.items()},
        stamp_ns=0,
        frame_id='',
        make=make,
    )
    if stamp is not None:
        message.header.stamp = stamp
    return message
