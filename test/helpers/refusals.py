# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Why a message is refused, and YAML of a few lines that stands for a billion values."""

import pytest

from sonar_imm.measurements import Rejection


def reason(read, *message, **options):
    """The code of the refusal, which has to have a sentence of one line without a full stop."""
    with pytest.raises(Rejection) as caught:
        read(*message, **options)
    assert caught.value.sentence[-1] != '.' and '\n' not in caught.value.sentence
    return caught.value.reason


def multiplying(form):
    """Ten values in ten in ten: `form` has a place for the references, ``'[{}]'`` say."""
    lines = ['a0: &a0 {x: 1}']
    for k in range(1, 10):
        references = form.format(', '.join([f'*a{k - 1}'] * 10))
        lines.append(f'a{k}: &a{k} {references}')
    return '\n'.join(lines)
