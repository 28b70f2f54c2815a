# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tables of estimates as text: what ``echo`` shows."""

import json

from helpers.dive_scenes import single_run
import numpy as np
import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.cli.echo import json_line, readable, text_lines  # noqa: E402
from sonar_imm_tools.replay.listening import ReceivedTable  # noqa: E402

ESTIMATE = single_run(count=20)[0][-1]


def table(columns, **more):
    given = {'stamp_ns': 1_700_000_000_250_000_000, 'frame_id': 'map', **more}
    return ReceivedTable(topic='/diver/estimate', columns=columns, **given)


def test_a_state_stands_with_its_deviation_and_the_models_as_the_most_probable_one():
    names, (row,) = readable(ESTIMATE.columns(), 5)
    assert names[:5] == ['track_id', 'px', 'py', 'vx', 'vy'] and names[5] == 'model'
    assert not [name for name in names if 'cov_' in name or name in 'xyz']
    value, deviation = (float(part) for part in row['px'].split(' ± '))
    assert value == pytest.approx(ESTIMATE.state[0, 0], abs=0.51 * deviation)
    assert deviation == pytest.approx(np.sqrt(ESTIMATE.covariance[0, 0, 0]), rel=0.05)
    best = int(np.argmax(ESTIMATE.probabilities[0]))
    model, share = row['model'].split()
    assert model == ESTIMATE.model_names[best]
    assert float(share[:-1]) == pytest.approx(100 * ESTIMATE.probabilities[0, best], abs=0.51)


def test_any_table_is_shown_with_its_first_rows():
    columns = {
        'range': np.arange(30, dtype='f4'), 'iq': np.zeros((30, 16), 'f4'),
        'valid': np.ones(30, 'u1'), 'level': np.full(30, np.nan), 'tiny': np.full(30, 1.5e-7),
    }  # fmt: skip
    lines = text_lines(table(columns), 3)
    assert lines[0] == '/diver/estimate  2023-11-14 22:13:20.250 UTC  frame map  30 rows'
    assert lines[1].split() == list(columns)
    assert lines[-2].split() == ['2', '16', 'values', '1', '-', '1.5e-07']
    assert lines[-1] == '... 27 more rows (--rows)' and len(lines) == 6
    # Without rows, and of a message that is no table.
    assert len(text_lines(table({'x': np.zeros(0)}), 3)) == 2
    assert len(text_lines(table({}), 3)) == 1
    assert text_lines(ReceivedTable(topic='/a', problem='it is broken'), 3) == ['/a: it is broken']
    none = json.loads(json_line(ReceivedTable(topic='/a', problem='no')))
    assert (none['problem'], none['stamp_ns'], none['columns']) == ('no', 0, {})


def test_json_has_all_columns_with_their_types():
    content = json.loads(json_line(table({**ESTIMATE.columns(), 'bad': np.array([np.nan])})))
    columns, types = content['columns'], content['types']
    assert (columns['px'], columns['bad']) == ([ESTIMATE.state[0, 0]], [None])
    assert [types[name] for name in ('px', 'x', 'track_id')] == ['f8', 'f4', 'u4']
    assert content['stamp_ns'] == 1_700_000_000_250_000_000
