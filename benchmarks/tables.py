"""How benchmarks tell their numbers: a table to read, and a file."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any


def markdown(table: Mapping[str, Mapping[str, float]], digits: int = 3) -> str:
    """A row for each entry, a column for each number of the first one."""
    columns = list(next(iter(table.values())))
    lines = ['| | ' + ' | '.join(columns) + ' |', '|---' * (len(columns) + 1) + '|']
    lines += [
        f'| {row} | ' + ' | '.join(f'{values[column]:.{digits}f}' for column in columns) + ' |'
        for row, values in table.items()
    ]
    return '\n'.join(lines)


def write_json(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write `content`, and the folders to it; nothing without a path."""
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1) + '\n')
