# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The reference vectors of a diver at sea, group by group."""

from functools import cache

from helpers.vector_files import load_vectors


@cache
def _all():
    return load_vectors('diver_sea/diver_sea')


def vectors(group):
    """The arrays of a group by their names in it."""
    return {
        name.split('/')[1]: value for name, value in _all().items() if name.split('/')[0] == group
    }
