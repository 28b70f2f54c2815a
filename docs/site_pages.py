# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pages of the site that are made when it is built, because something else holds their text.

mkdocs calls `on_files` (see mkdocs.yml). The home page is README.md; the pages of the API list the
modules of each package, which mkdocstrings then describes; the pages of options and of inputs come
from the command and from the trackers.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
import contextlib
import io
import json
import os
from pathlib import Path
import re
import tempfile
from typing import Any

import plotly.graph_objects
import plotly.offline

ROOT = Path(__file__).resolve().parents[1]

OUTSIDE = {
    'README.md': 'index.md',
    'CONTRIBUTING.md': 'contributing.md',
    'CHANGELOG.rst': 'changelog.md',
}
"""Pages that lie in the root of the project, where people and tools look for them."""

PLOTLYJS = 'javascripts/plotly.js'
"""Once for all notebooks."""

API = {
    'estimation': (
        'sonar_imm.estimation',
        'Multiple-model estimation: no sonar, no ROS, no clock',
    ),
    'acoustics': ('sonar_imm.acoustics', 'Physics of arrays and sound'),
    'measurements': ('sonar_imm.measurements', 'What a tracker takes in'),
    'core': ('sonar_imm', 'What a tracker gives out, and its parameters'),
    'intake': ('sonar_imm.intake', 'What every measurement passes before its tracker'),
    'trackers': ('sonar_imm.trackers', 'The trackers'),
    'recordings': ('sonar_imm_tools.recordings', 'Bags in and out, other formats'),
    'offline': ('sonar_imm_tools.offline', 'Trackers on recordings'),
    'evaluation': ('sonar_imm_tools.evaluation', 'Scores and reports'),
    'simulation': ('sonar_imm_tools.simulation', 'Scenes'),
    'msg_adapters': ('msg_adapters', 'ROS messages to measurements and estimates, and back'),
}
"""Packages whose modules are described, by the name of their page."""


TYPICAL = """\
Recordings in `bags/` are simulated. These are typical: of 31 seeds the one in the middle.
`sonar-imm check` plays them to the live nodes and allows the error in the last column, which nine
in ten of those seeds stay below."""


def on_config(config: Any) -> Any:
    """Called by mkdocs first: only a site among versions asks for their list, which a page that
    is opened as a file may not."""
    if 'SITE_VERSIONS' not in os.environ:
        config.extra.pop('version', None)
    return config


def on_files(files: Any, config: Any) -> Any:
    """Called by mkdocs with what it found in docs/: add the pages that are made."""
    from mkdocs.structure.files import File

    for name, text in made_pages().items():
        files.append(File.generated(config, name, content=text))
    files.append(File.generated(config, PLOTLYJS, content=plotly.offline.get_plotlyjs()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Called by mkdocs with each page: links to notebooks, which lie beside docs/, lead to their
    pages."""
    return re.sub(r'\]\(\.\./((?:\.\./)*examples/\w+)\.ipynb\)', r'](\1.md)', markdown)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Called by mkdocs with each page as HTML: cells know the head of their column."""
    return re.sub(r'<table>.*?</table>', labelled, html, flags=re.DOTALL)


def labelled(found: re.Match[str]) -> str:
    """A table for a phone, where each cell is a line: all but the first of a row have a label."""
    head, _, body = found.group().partition('</thead>')
    labels = [re.sub(r'<[^>]+>|"', '', text) for text in re.findall(r'<th[ >].*?</th>', head)]

    def cells(row: re.Match[str]) -> str:
        named = iter(labels)
        return re.sub(r'<td', lambda _: f'<td data-label="{next(named, "")}"', row.group())

    return f'{head}</thead>' + re.sub(r'<tr>.*?</tr>', cells, body, flags=re.DOTALL)


def on_post_build(config: Any) -> None:
    """Called by mkdocs at the end. Raises RuntimeError when a page loads from another server."""
    found = {
        f'{path.relative_to(config.site_dir)}: {address}'
        for path in Path(config.site_dir).rglob('*.html')
        for address in loaded_from_afar(path.read_text(encoding='utf-8'))
    }
    if found:
        raise RuntimeError('pages load from other servers: ' + ', '.join(sorted(found)))


def loaded_from_afar(page: str) -> list[str]:
    """Addresses on other servers that a browser asks for when it shows `page`; links are none."""
    tags = re.findall(r'<(?:script|link|img|iframe|source|video|audio)\b[^>]*>', page)
    kept = (tag for tag in tags if not re.search(r'\brel="?(?:canonical|next|prev)\b', tag))
    return re.findall(r'\b(?:src|href)="?((?:https?:)?//[^"\s>]+)', ' '.join(kept))


def made_pages() -> dict[str, str]:
    """The text of each page that is made, by its path in the site."""
    pages = {page: at_the_root(name) for name, page in OUTSIDE.items()}
    pages |= {
        f'reference/api/{page}.md': api_page(package, title)
        for page, (package, title) in API.items()
    }
    pages |= {
        f'examples/{path.stem}.md': notebook(path)
        for path in sorted((ROOT / 'examples').glob('*.ipynb'))
    }
    pages['reference/interfaces.md'] = interfaces()
    pages['reference/options.md'] = options()
    pages['reference/bags.md'] = recordings()
    return pages


def notebook(path: Path) -> str:
    """The cells of a notebook as a page, with what they give when they are run."""
    space: dict[str, Any] = {}
    parts = []
    for number, cell in enumerate(json.loads(path.read_text(encoding='utf-8'))['cells']):
        text = ''.join(cell['source'])
        if cell['cell_type'] == 'markdown':
            parts.append(text)
            continue
        parts.append(f'```python\n{text}\n```')
        value = last_value(text, f'{path.name}, cell {number}', space)
        if isinstance(value, plotly.graph_objects.Figure):
            drawn = value.to_html(full_html=False, include_plotlyjs=False, default_height=360)
            parts += [f'<script src="../{PLOTLYJS}"></script>', drawn]
        elif value is not None:
            parts.append(f'```text\n{value!r}\n```')
    return '\n\n'.join([*parts, f'The notebook is `examples/{path.name}`.']) + '\n'


def last_value(code: str, name: str, space: dict[str, Any]) -> Any:
    """Run a cell in `space`; gives the value of its last line, or None when that has none."""
    tree = ast.parse(code, name)
    last = tree.body[-1]
    if not isinstance(last, ast.Expr):
        exec(compile(tree, name, 'exec'), space)
        return None
    del tree.body[-1]
    exec(compile(tree, name, 'exec'), space)
    return eval(compile(ast.Expression(last.value), name, 'eval'), space)


def at_the_root(name: str) -> str:
    """A page of the root as one of docs/, with links that lead to the same places."""
    text = (ROOT / name).read_text(encoding='utf-8')
    if name.endswith('.rst'):  # headings and lists as Markdown has them, but for the title
        text = re.sub(r'\A\^+\n(.+)\n\^+\n', r'# \1\n', text).replace('``', '`')

    def link(found: re.Match[str]) -> str:
        target, anchor = found['target'], found['anchor'] or ''
        if target in OUTSIDE:
            return f'({OUTSIDE[target]}{anchor})'
        if target.startswith('docs/'):
            return f'({target.removeprefix("docs/")}{anchor})'
        raise ValueError(f'{name} links to {target}, which is no page of the site')

    text = re.sub(r'\[[^\]]*\]\((?!\w+:)LICENSE\)', 'LICENSE', text)
    return re.sub(r'(?<=\])\((?!\w+:)(?P<target>[^)#]+)(?P<anchor>#[^)]*)?\)', link, text)


def api_page(package: str, title: str) -> str:
    """One page for a package: every public module, compiled kernels left out."""
    names = [name for name in modules(package) if not name.endswith('_kernels')]
    return '\n\n'.join([f'# {title}', *(f'::: {name}' for name in names)]) + '\n'


def modules(package: str) -> list[str]:
    """Public modules of `package` with those of its packages, but of `sonar_imm` only its own."""
    folder = ROOT.joinpath(*package.split('.'))
    found = sorted(folder.glob('*.py') if package == 'sonar_imm' else folder.rglob('*.py'))
    names = ('.'.join(path.relative_to(ROOT).with_suffix('').parts) for path in found)
    return [
        name.removesuffix('.__init__')
        for name in names
        if not any(part.startswith('_') for part in name.removesuffix('.__init__').split('.'))
    ]


def recordings() -> str:
    """What the recordings that are shipped say of themselves: their README.md."""
    texts = {path.parent.name: path.read_text() for path in (ROOT / 'bags').glob('*/README.md')}
    rows = []
    for name, text in sorted(texts.items()):
        # The table of benchmarks.typical_seed: a row for each metric, the first has the limit.
        lines = [line for line in text.splitlines() if line.startswith('|')]
        (seed,) = re.findall(r'--seed (\d+)', text)[:1]
        if not lines:  # one that is not typical says so in words
            rows.append(f'| [{name}](#{name}) | {seed} | | | | |')
            continue
        head, _, first = ([cell.strip() for cell in line.split('|')[1:-1]] for line in lines[:3])
        found = dict(zip(head[1:], first[1:]))
        (limit,) = re.findall(r'allows (\S+ \w+)', text)[:1]
        rows.append(
            f'| [{name}](#{name}) | {seed} | `{first[0]}` | {found["of the seed"]} | '
            f'{found["5 %"]} to {found["95 %"]} | {limit} |'
        )
    return (
        '\n\n'.join(
            [
                '# Shipped recordings',
                TYPICAL,
                '\n'.join(
                    [
                        '| recording | seed | error | of this seed | 5 to 95 % | allowed |',
                        '|---|---|---|---|---|---|',
                        *rows,
                    ]
                ),
                *(f'#{text.strip()}' for _, text in sorted(texts.items())),
            ]
        )
        + '\n'
    )


def options() -> str:
    """What `--help` of every command and of every kind of conversion says."""
    import click

    from sonar_imm_tools.cli import command, PROGRAM

    def helps(shown: click.Command | None, name: str, parent: Any) -> list[str]:
        assert shown is not None
        context = click.Context(shown, parent, info_name=name, max_content_width=100)
        parts = [f'## {context.command_path}', f'```text\n{shown.get_help(context)}\n```']
        if isinstance(shown, click.Group):
            for sub in shown.list_commands(context):
                parts += helps(shown.get_command(context, sub), sub, context)
        return parts

    return '\n\n'.join(['# Options of every command', *helps(command, PROGRAM, None)]) + '\n'


def interfaces() -> str:
    """Inputs of each tracker with their types, and the columns of its estimates, from the code.

    The columns are those of the first shipped recording, tracked with its parameters.
    """
    from msg_adapters.inputs import inputs_of
    from sonar_imm.trackers import SYSTEMS

    parts = [
        '# Inputs and columns',
        'Written from the code when the site is built: the inputs that a tracker subscribes to '
        'and finds in recordings, and the columns of `~/estimate` and `estimate.csv`. What they '
        'mean is in [Columns](columns.md).',
    ]
    for name in SYSTEMS:
        inputs = [
            f'| `{topic.name}` | {topic.description} | {types(topic.readers)} |'
            for topic in inputs_of(name)
        ]
        bag = min((ROOT / 'bags').glob(f'{name}_*'))
        columns = [f'| `{column}` | {kind} |' for column, kind in estimated_columns(bag).items()]
        parts += [
            f'## {name}_node',
            '\n'.join(['| input | what | message types |', '|---|---|---|', *inputs]),
            f'Estimates, as for `bags/{bag.name}`; models and states follow the parameters:',
            '\n'.join(['| column | type |', '|---|---|', *columns]),
        ]
    return '\n\n'.join(parts) + '\n'


def types(readers: Iterable[str]) -> str:
    return ', '.join(f'`{name.replace("/msg/", "/")}`' for name in readers)


def estimated_columns(bag: Path) -> dict[str, str]:
    """Name and type of each column that the tracker gives for `bag`; runs of models in one row."""
    from sonar_imm_tools.cli import main
    from sonar_imm_tools.offline.run_folder import RunFolder

    with tempfile.TemporaryDirectory(prefix='sonar_imm_docs_') as scratch:
        out = Path(scratch) / 'out'
        with contextlib.redirect_stdout(io.StringIO()):
            if status := main(['track', str(bag), str(out)]):
                raise RuntimeError(f'`sonar-imm track {bag}` ended with {status}')
        estimate = next(table for table in RunFolder(out).read_estimates() if len(table.xyz))
    return {
        name: f'{column.dtype.kind}{column.dtype.itemsize}'
        for name, column in estimate.columns().items()
    }
