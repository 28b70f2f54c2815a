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
