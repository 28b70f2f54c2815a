# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recordings: bags in and out, in replay order; `convert` reads other formats.

The road of a bag: `mcap_records` and `sources` open its files, `reader` gives messages, and
`measurements` what trackers take in. The road of another file: `columns` and `times` know words,
`tables` and `table_files` give rows, `places` positions; `convert` takes whole files, as
`convert_options` has it, and `conversion` and `writer` make a bag of them. `export` leads out.
"""

__all__ = [
    'conversion', 'convert', 'convert_options', 'export', 'mcap_records', 'measurements',
    'messages', 'own_files', 'places', 'positions', 'reader', 'sources', 'table_files', 'truth',
    'writer',
]  # fmt: skip
