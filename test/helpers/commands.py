# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The command in this process, what it leaves, and processes that are begun; what stands in a
report, whose figures are packed, and drawn when they come into view."""

import base64
import gzip
import json
from pathlib import Path
import re

from sonar_imm_tools.cli import main


def run(*arguments):
    """The exit code of `sonar-imm` with these words."""
    return main([str(argument) for argument in arguments])


def contents(folder, *passed_over):
    """Bytes of files by path; links and files of the names `passed_over` are left out."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in Path(folder).rglob('*')
        if path.is_file() and not path.is_symlink() and path.name not in passed_over
    }


def children(pid):
    """The processes that a process has begun."""
    return [int(word) for word in Path(f'/proc/{pid}/task/{pid}/children').read_text().split()]


def unpacked(text):
    """What was packed into a page, as text."""
    return gzip.decompress(base64.b64decode(text)).decode()


def figures(page):
    """The plotly figures of a page, in its order."""
    return [json.loads(unpacked(text)) for text in re.findall(r'data-figure="([^"]+)"', page)]
