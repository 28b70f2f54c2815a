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

"""How old a result is: commits since that change what it depends on.

A result depends on the script of its command and on all modules of ours that this imports. It is
as old as the number of commits that changed one of these files, and are no forebears of the commit
that changed the result last; for numbers that were read by hand, of the commit that first named
their day and command. Files that were only renamed do not count.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
import re
import subprocess

from attrs import frozen

ROOT = Path(__file__).resolve().parents[1]
SYSTEMS = ('bathymetry', 'diver', 'fathometer', 'obstacle')
LOADED = {
    'scenes': 'sonar_imm_tools.simulation',
    'judge': 'sonar_imm_tools.evaluation',
}
"""The packages that properties of `System` lead to; its trackers are loaded with `SYSTEMS`."""
MOVED = 90
"""Per cent: a file that was renamed and is alike by as much was only moved."""


def script_of(command: str) -> str:
    """The benchmark that a command runs, '' for another command."""
    found = re.search(r'python -m (benchmarks(?:\.\w+)+)', command)
    return found.group(1) if found else ''


def module_file(module: str) -> Path | None:
    stem = ROOT.joinpath(*module.split('.'))
    found = (path for path in (stem.with_suffix('.py'), stem / '__init__.py') if path.is_file())
    return next(found, None)


@cache
def imported(module: str, path: Path) -> frozenset[str]:
    """Those of our modules that a module imports, anywhere in it.

    One that it loads by the name of a system ends in `{system}`."""
    found = set(_imported(module, path))
    return frozenset(name for name in found if '{' in name or module_file(name))


def _imported(module: str, path: Path) -> Iterator[str]:
    package = module.split('.')[: None if path.name == '__init__.py' else -1]
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding='utf-8'))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING':
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else []
            origin = '.'.join([*above, *filter(None, [node.module])])
            yield from (origin, *(f'{origin}.{alias.name}' for alias in node.names))
        elif isinstance(node, ast.Attribute) and node.attr in LOADED:
            if ast.unparse(node).startswith('SYSTEMS['):
                yield LOADED[node.attr] + '.{system}'


@cache
def paths_of(result: str, command: str) -> frozenset[str]:
    """Files that a result depends on: its script, and all of ours that this imports.

    Of what is loaded by the name of a system, that of the result's system, or of all systems when
    its name, or that of the script, has none. All of the packages for a command that is no
    benchmark."""
    script = script_of(command)
    if not script:
        ours = (path.parent for path in ROOT.glob('*/__init__.py'))
        return frozenset(name_of(path) for folder in ours for path in folder.rglob('*.py'))
    title = result or script.rpartition('.')[2]
    systems = [name for name in SYSTEMS if title.startswith(name)] or SYSTEMS
    found: dict[str, Path] = {}
    waiting = [script]
    while waiting:
        module = waiting.pop()
        if module == 'sonar_imm.trackers':
            waiting += [f'{module}.{system}.*' for system in systems]
        if '{system}' in module:
            waiting += [module.format(system=system) for system in systems]
        elif module.endswith('.*'):
            folder = ROOT.joinpath(*module.split('.')[:-1])
            waiting += [f'{module[:-2]}.{path.stem}' for path in folder.glob('[a-z]*.py')]
        elif module not in found and (path := module_file(module)):
            found[module] = path
            waiting += imported(module, path)
    return frozenset(map(name_of, found.values()))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@frozen
class Commit:
    """A commit: its parents, and for each file it changed the name before and a share kept."""

    name: str
    parents: tuple[str, ...]
    changes: tuple[tuple[str, str, int], ...]
    """Name before, name after, per cent alike."""


def git(*words: str) -> str:
    try:
        done = subprocess.run(['git', *words], cwd=ROOT, capture_output=True, text=True)
    except OSError:
        return ''
    return done.stdout if done.returncode == 0 else ''


@cache
def history() -> tuple[Commit, ...]:
    """All commits, newest first; none without git, or where the clone is shallow."""
    if git('rev-parse', '--is-shallow-repository').strip() != 'false':
        return ()
    log = git('log', '-M', '--topo-order', '--name-status', '--no-relative', '--format=%x00%H %P')
    return tuple(map(commit_of, log.split('\0')[1:]))


def commit_of(text: str) -> Commit:
    (name, *parents), *lines = (line.split() for line in text.splitlines() if line)
    changes = tuple(
        (words[1], words[-1], int(words[0][1:] or 0) if words[0][0] == 'R' else 0)
        for words in lines
    )
    return Commit(name, tuple(parents), changes)


@cache
def readings() -> tuple[tuple[str, str, str], ...]:
    """Numbers read by hand that a commit brought, newest first: commit, day, begin of command."""
    log = git('log', '--topo-order', '-p', '-U0', '-G^<!-- numbers: read', '--format=%x00%H')
    line = re.compile(r'^\+<!-- numbers: read (\S+?)(?: \w+)?; *(.*?)(?: *-->)?$', re.MULTILINE)
    return tuple(
        (commit.partition('\n')[0], day, command)
        for commit in log.split('\0')[1:]
        for day, command in line.findall(commit)
    )


def commit_of_result(commits: tuple[Commit, ...], result: str) -> str:
    """The commit that changed a file last, '' for none."""
    found = (c.name for c in commits if any(result == new for _, new, _ in c.changes))
    return next(found, '')


def commit_of_reading(day: str, command: str) -> str:
    """The first commit with numbers that a command printed on that day, '' for none."""
    found = [c for c, that, begin in readings() if that == day and command.startswith(begin)]
    return found[-1] if found else ''


def age_since(commits: tuple[Commit, ...], made: str, paths: frozenset[str]) -> int | None:
    """Of all `commits`, newest first, those that changed `paths` and are no forebears of the one
    named `made`; None where that is not known."""
    if not any(commit.name == made for commit in commits):
        return None
    names, old, count = set(paths), {made}, 0
    for commit in commits:
        if commit.name in old:
            old |= set(commit.parents)
            continue
        mine = [change for change in commit.changes if change[1] in names]
        count += any(alike < MOVED for _, _, alike in mine)
        names |= {before for before, _, _ in mine}
    return count
