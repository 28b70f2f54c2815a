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

"""What a path that is to be shown stands for: a run with its recording, or a recording."""

from __future__ import annotations

from pathlib import Path

from ..evaluation.run_folder import BAG, RUN, RunFolder


def paths_of(source: Path) -> tuple[list[Path], list[str]]:
    """The recordings to show for `source`, and sentences about what is missing.

    Of a run: its estimates, and the recording they were made of when that is still there. Raises
    `BagError` when the run cannot be understood.
    """
    if not (source / RUN).is_file():
        return [source], []
    recording = Path(RunFolder(source).read_run()['bag'])
    if not recording.exists():
        return [source / BAG], [f'{recording} is gone: only the estimates are shown']
    return [source / BAG, recording], []
