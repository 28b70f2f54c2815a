# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What others have named is text, whatever they named it."""

from sonar_imm.measurements import Rejection
from sonar_imm.texts import in_one_line, visible


def test_what_would_steer_a_terminal_is_shown():
    assert visible('a\x1b[2Jb\x07\x9b\u202ec\r') == 'a\\x1b[2Jb\\x07\\x9b\\u202ec\\r'
    assert visible('Zoë, 5 m²\n\tend') == 'Zoë, 5 m²\n\tend'


def test_a_sentence_is_one_line_and_has_an_end():
    assert in_one_line('a\nb\r\nc\td') == 'a b c d'
    assert len(in_one_line('x' * 10**6)) < 1100
    rejection = Rejection('frame', "the frame 'a\n\x1b[31mb'")
    assert rejection.sentence == str(rejection) == "the frame 'a \\x1b[31mb'"
