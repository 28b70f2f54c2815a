# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Draw docs/images/sonar_frames.svg: run it with ``python docs/draw_sonar_frames.py``.

Side view and view from behind of a forward-looking sonar: what is measured and what is not.
"""

from __future__ import annotations

import math
from pathlib import Path

OUT = Path(__file__).parent / 'images' / 'sonar_frames.svg'
INK, BLUE, ORANGE, GREY = '#1b2733', '#0072B2', '#D55E00', '#8593a1'


def line(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    colour: str,
    *,
    dash: str = '',
    arrow: bool = False,
    width: float = 1.6,
) -> str:
    end = f' marker-end="url(#{colour[1:]})"' if arrow else ''
    return (
        f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" '
        f'stroke-width="{width}" stroke-dasharray="{dash}"{end}/>'
    )


def text(
    x: float,
    y: float,
    words: str,
    colour: str = INK,
    *,
    size: int = 14,
    anchor: str = 'start',
    bold: bool = False,
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="{size}" '
        f'text-anchor="{anchor}" font-weight="{600 if bold else 400}">{words}</text>'
    )


def side_view() -> list[str]:
    """From starboard: the arc on which all points give the same range."""
    x, y, d = 90.0, 190.0, 330.0
    edge, eps = math.radians(16.0), math.radians(10.0)
    arc = (
        f'<path d="M {x + d * math.cos(edge):.1f} {y - d * math.sin(edge):.1f} A {d} {d} 0 0 1 '
        f'{x + d * math.cos(edge):.1f} {y + d * math.sin(edge):.1f}" fill="none" '
        f'stroke="{ORANGE}" stroke-width="3"/>'
    )
    px, py = x + d * math.cos(eps), y + d * math.sin(eps)
    parts = [
        text(40, 30, 'From the side', size=16, bold=True),
        line(x, y, x + 400 * math.cos(edge), y - 400 * math.sin(edge), GREY, dash='5 4'),
        line(x, y, x + 400 * math.cos(edge), y + 400 * math.sin(edge), GREY, dash='5 4'),
        line(x, y, x + 400, y, BLUE, arrow=True),
        text(x + 402, y + 18, 'x forward', BLUE),
        line(x, y, x, y + 70, BLUE, arrow=True),
        text(x - 10, y + 92, 'z down (FRD)', BLUE),
        line(x, y, x, y - 70, BLUE, dash='2 3', arrow=True),
        text(x - 10, y - 78, 'z up (FLU, ROS)', BLUE),
        arc,
        f'<circle cx="{px:.1f}" cy="{py:.1f}" r="7" fill="{ORANGE}"/>',
        line(x, y, px, py, INK),
        text(x + 105, y - 10, 'range d: measured'),
        line(px + 14, y, px + 14, py, INK, arrow=True),
        text(px + 24, (y + py) / 2 + 14, 'd_st: not measured', ORANGE, bold=True),
        text(x + 240, y - 112, 'the whole arc gives the same echo', ORANGE),
        text(x + 300, y + 118, 'edge of the beam', GREY),
    ]
    return [*parts, f'<circle cx="{x}" cy="{y}" r="9" fill="{BLUE}"/>']


def from_behind() -> list[str]:
    """Looking forward: rolling moves what lies above to one side, what lies below to the other."""
    x, y, roll = 760.0, 190.0, math.radians(25.0)
    right, down = (math.cos(roll), math.sin(roll)), (-math.sin(roll), math.cos(roll))
    parts = [
        text(620, 30, 'From behind, rolled to starboard', size=16, bold=True),
        line(x, y - 120, x, y + 120, GREY, dash='5 4'),
        text(x + 6, y + 134, "the world's vertical", GREY),
        line(x, y, x + 110 * right[0], y + 110 * right[1], BLUE, arrow=True),
        text(x + 114 * right[0], y + 114 * right[1] + 18, 'y starboard (FRD)', BLUE),
        line(x, y, x + 110 * down[0], y + 110 * down[1], BLUE, arrow=True),
        text(x + 118 * down[0] - 20, y + 120 * down[1] + 18, 'z down', BLUE, anchor='end'),
    ]
    for side, words in ((-1.0, 'above: azimuth to port'), (1.0, 'below: azimuth to starboard')):
        py = y + 85.0 * side
        shift = 85.0 * side * right[1]
        parts += [
            f'<circle cx="{x}" cy="{py:.1f}" r="7" fill="{ORANGE}"/>',
            line(x, y, x + shift * right[0], y + shift * right[1], ORANGE, width=4.0),
            text(x + 16, py + 5, words, ORANGE),
        ]
    return parts


def drawing() -> str:
    """The whole picture."""
    heads = ''.join(
        f'<marker id="{colour[1:]}" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
        f'markerHeight="7" orient="auto"><path d="M0 0 L10 5 L0 10 z" fill="{colour}"/></marker>'
        for colour in (INK, BLUE)
    )
    body = '\n'.join([*side_view(), *from_behind()])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 360" '
        f'font-family="Inter, Helvetica, Arial, sans-serif"><rect width="1000" height="360" '
        f'fill="white"/><defs>{heads}</defs>\n{body}\n</svg>\n'
    )


if __name__ == '__main__':
    OUT.write_text(drawing(), encoding='utf-8')
