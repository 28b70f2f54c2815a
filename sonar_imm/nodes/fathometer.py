# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer node: ``ros2 run sonar_imm fathometer_node``, or
``python -m sonar_imm.nodes.fathometer``.

Hears ``csdm``, ``pressure`` or ``trace``, and ``array_depth`` beside them. One ``~/estimate`` per
record; with `preview_seconds` also one at each sliding update between records, marked `preview`.
Besides, for the newest record or preview:

- ``~/response``: its depth response, as a table like that of ``trace`` with ``x y z`` before it;
- ``~/model_probabilities``: how probable each number of reflectors is, by name, then that a
  reflector is still, or dipping, in the mean of them.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

from msg_adapters.array_records import write_response

from ..estimates import Estimate
from .base import TABLE, TrackerNode
from .messages import make
from .running import run


class FathometerNode(TrackerNode):
    """Tracks reflectors below the sea floor from array noise or traces."""

    def __init__(self, **options: Any):
        super().__init__('fathometer', **options)

    def advertise_more(self) -> None:
        self._response = self.advertise(TABLE, '~/response')

    def show(self, estimates: list[Estimate]) -> None:
        super().show(estimates)
        if self._response.get_subscription_count() and self.tracker.response is not None:
            self._response.publish(write_response(self.tracker.response, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(FathometerNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
