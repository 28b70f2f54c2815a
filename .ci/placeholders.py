# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Say what only the owner of a release can fill in: an address, a repository, a date.

python .ci/placeholders.py            one line each, exit code 0
python .ci/placeholders.py --strict   the same; exit code 1 when there are any
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]


def placeholders(root: Path = ROOT) -> Iterator[str]:
    """What is missing in the files below `root`, a sentence each."""
    manifest = ElementTree.parse(root / 'package.xml').getroot()
    for maintainer in manifest.iter('maintainer'):
        if re.search(r'@example\.(org|com|net)$', maintainer.get('email', '')):
            yield f'package.xml: {maintainer.get("email")} reaches nobody'
    if not any(url.get('type') == 'repository' for url in manifest.iter('url')):
        yield 'package.xml: no <url type="repository">'
    citation = (root / 'CITATION.cff').read_text(encoding='utf-8')
    for name in ('repository-code', 'date-released'):
        if not re.search(f'^{name}:', citation, re.MULTILINE):
            yield f'CITATION.cff: no {name}'
    if re.search('^Forthcoming$', (root / 'CHANGELOG.rst').read_text('utf-8'), re.MULTILINE):
        yield 'CHANGELOG.rst: the newest entries have no version and no date (Forthcoming)'


if __name__ == '__main__':
    missing = list(placeholders())
    print('\n'.join(missing) or 'nothing is left to fill in')
    sys.exit('--strict' in sys.argv[1:] and bool(missing))
