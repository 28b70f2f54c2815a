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

"""Processes that share work, where they cannot."""

from multiprocessing import synchronize

import pytest

from sonar_imm_tools.offline.jobs import processes


@pytest.mark.parametrize('error', [FileNotFoundError(2, 'No such file'), OSError(38, 'Not there')])
def test_without_shared_memory_there_is_a_sentence_that_helps(monkeypatch, error):
    """What a semaphore costs in a container without /dev/shm."""

    def refused(*args, **options):
        raise error

    monkeypatch.setattr(synchronize.SemLock, '__init__', refused)
    with pytest.raises(OSError, match='--jobs 1'), processes(2):
        pass
