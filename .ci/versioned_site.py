# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Put a built site beside those of earlier versions, in a folder PAGES.

Usage: python .ci/versioned_site.py SITE PAGES VERSION

The pages of each version offer the others (material for mkdocs reads `../versions.json`); whoever
opens PAGES comes to the newest.
"""

from __future__ import annotations

import json
from pathlib import Path
import re
import shutil
import sys


def publish(site: Path, pages: Path, version: str) -> list[str]:
    """Copy `site` to its version, in place of an earlier copy; gives all, newest first."""
    shutil.rmtree(pages / version, ignore_errors=True)
    shutil.copytree(site, pages / version)
    found = [path.parent.name for path in pages.glob('*/index.html')]
    found.sort(key=lambda name: [int(number) for number in re.findall(r'\d+', name)], reverse=True)
    listed = [
        {'version': name, 'title': name, 'aliases': ['latest'] if name == found[0] else []}
        for name in found
    ]
    (pages / 'versions.json').write_text(json.dumps(listed, indent=1), encoding='utf-8')
    page = f'<!doctype html><meta http-equiv="refresh" content="0; url={found[0]}/index.html">\n'
    (pages / 'index.html').write_text(page, encoding='utf-8')
    return found


if __name__ == '__main__':
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    print(f'{folder}: {", ".join(publish(Path(sys.argv[1]), folder, sys.argv[3]))}')
