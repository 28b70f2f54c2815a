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

"""Receivers with clocks of their own, compared by tags that lie at known places."""

import csv

import numpy as np
import pytest

from sonar_imm_tools.recordings.convert import convert_detections
from sonar_imm_tools.recordings.convert.detections import compare_clocks, gather, Received
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError

SECOND, SPEED, BEGIN = 10**9, 1480.0, 1_717_149_600 * 10**9
RECEIVERS = np.array(
    [[0.0, 0.0, -5.0], [300.0, 20.0, -6.0], [310.0, 280.0, -4.0], [-10.0, 300.0, -5.0]]
)
SYNC = np.array([[20.0, 30.0, -8.0], [280.0, 250.0, -8.0]])
ERROR = 3e-4


def offsets(seconds):
    """How far the clocks (receivers, n) are ahead: 6 s at most, the first is right."""
    hours = np.asarray(seconds) / 3600.0
    return np.array([0.0 * hours, 2.0 + 1e-3 * hours, -6.0 - 0.02 * hours, 0.5 - 2e-3 * hours])


def recorded(seed, echoes=0.0, deaf=()):
    """Rows (receiver, tag, stamp_ns): two fixed tags and a fish, over a day; and where the fish is
    at its pings. deaf: receivers that never hear the fixed tags."""
    rng = np.random.default_rng(seed)
    rows, fish = [], []
    for tag, place in enumerate(SYNC):
        for T in np.arange(100.0 + 37.0 * tag, 86_400.0, 600.0):
            rows += detect(rng, tag, T, place, echoes, set(range(4)) - set(deaf))
    for T in np.arange(50.0, 86_400.0, 300.0):
        place = np.array([150.0 + 80.0 * np.cos(T / 9e3), 150.0 + 80.0 * np.sin(T / 9e3), -5.0])
        fish.append((T, place))
        rows += detect(rng, 2, T, place, 0.0, range(4))
    rows.sort(key=lambda row: row[2])
    return rows, fish


def detect(rng, tag, T, place, echoes, receivers):
    found = []
    for receiver in receivers:
        if rng.random() < 0.15:
            continue
        true = T + np.linalg.norm(RECEIVERS[receiver] - place) / SPEED
        late = rng.exponential(0.05) if rng.random() < echoes else 0.0
        local = true + late + offsets(true)[receiver] + ERROR * rng.standard_normal()
        found.append((receiver, tag, BEGIN + round(local * SECOND)))
    return found


def received_of(rows):
    return Received(*(np.array(column, np.int64) for column in zip(*rows)))


def compared(rows):
    places = np.vstack([SYNC, np.full((1, 3), np.nan)])
    return compare_clocks(received_of(rows), RECEIVERS, places, SPEED, 6 * 3600.0)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('echoes', [0.0, 0.05])
def test_offsets_and_drifts_are_found_within_their_error(seed, echoes):
    clocks = compared(recorded(seed, echoes)[0])
    seconds = (clocks.begin_ns - BEGIN) / SECOND + clocks.knots
    error = clocks.offset - offsets(seconds) + offsets(seconds)[:1]
    # Least squares of some 70 detections a knot, against the clock of another receiver: .24 to .33
    # of the error of one detection.
    assert np.sqrt((error[1:] ** 2).mean()) < 0.7 * ERROR
    assert np.abs(error).max() < 2.0 * ERROR
    # Echoes that are not seen as such are as long as few errors, and count as errors.
    assert 0.9 * ERROR < clocks.std < (1.1 if echoes == 0.0 else 1.6) * ERROR


def test_a_receiver_that_hears_no_fixed_tag_is_left_out_and_named(tmp_path):
    rows, _ = recorded(1, deaf=(3,))
    clocks = compared(rows)
    assert np.isnan(clocks.offset[3]).all() and np.isfinite(clocks.offset[:3]).all()
    report = converted(tmp_path, rows)
    assert 'r3: it shares no ping' in report.problems[0]
    assert {rx for ping in arrivals_of(report.path) for rx in ping.rx_id} == {1, 2, 3}


def test_pings_hold_each_receiver_once_and_are_no_longer_than_the_window():
    rng = np.random.default_rng(4)
    stamps = np.sort(rng.uniform(0.0, 100.0, 400) * SECOND).astype(np.int64)
    receivers = rng.integers(0, 5, 400)
    found = gather(receivers, stamps, 0.7)
    for members in found:
        assert np.ptp(stamps[members]) <= 0.7 * SECOND
        assert len(set(receivers[members])) == len(members)
    begins = [stamps[members].min() for members in found]
    assert (np.diff(begins) > 0.7 * SECOND).all()  # nothing of a ping begins the next one


def converted(folder, rows, **options):
    names = ('S1', 'S2', 'A69-1601-7')
    with (folder / 'vue.csv').open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(['Date and Time (UTC)', 'Receiver', 'Transmitter', 'Sensor Value'])
        for receiver, tag, stamp in rows:
            time = np.datetime64(stamp, 'ns').astype('datetime64[us]')
            writer.writerow([str(time).replace('T', ' '), f'r{receiver}', names[tag], ''])
    for name, head, places in (
        ('stations', 'receiver', {f'r{k}': place for k, place in enumerate(RECEIVERS)}),
        ('sync', 'tag', dict(zip(names, SYNC))),
    ):
        lines = [f'{label},{x},{y},{z}' for label, (x, y, z) in places.items()]
        (folder / f'{name}.csv').write_text(f'{head},x,y,z\n' + '\n'.join(lines) + '\n')
    options = {'sync': folder / 'sync.csv', 'sound_speed': SPEED, **options}
    return convert_detections(
        folder / 'vue.csv', folder / 'out', receivers=folder / 'stations.csv', **options
    )


def arrivals_of(path):
    with BagReader(path) as bag:
        return [item.measurement for item in measurements_of(bag, 'diver')]


def test_arrivals_of_a_tag_fit_the_place_it_had(tmp_path):
    rows, fish = recorded(2)
    report = converted(tmp_path, rows)
    assert 'r1 +' in report.notes['clocks'] and 'agree to 0.3' in report.notes['clocks']
    pings = arrivals_of(report.path)
    assert len(pings) == len(fish)
    error = []
    for ping, (_, place) in zip(pings, fish):
        travel = np.linalg.norm(RECEIVERS[np.asarray(ping.rx_id) - 1] - place, axis=1) / SPEED
        rest = np.asarray(ping.toa) - travel
        error += (rest - rest.mean()).tolist() if len(rest) > 1 else []
        assert np.sqrt(ping.var_toa) == pytest.approx(ERROR, rel=0.1)
    assert np.std(error) < 1.1 * ERROR


def test_without_fixed_tags_the_clocks_are_believed(tmp_path):
    rows, _ = recorded(3)
    report = converted(tmp_path, rows, sync=None, window=0.5)
    assert 'clocks' not in report.notes
    # Clocks that are seconds apart: nobody hears a ping together.
    assert max(len(ping.toa) for ping in arrivals_of(report.path)) < 3


def test_only_fixed_tags_is_one_sentence(tmp_path):
    rows = [row for row in recorded(5)[0] if row[1] < 2]
    with pytest.raises(BagError, match='no tag beside the fixed ones'):
        converted(tmp_path, rows)


@pytest.mark.parametrize(
    'row', ['x,r1,T', '2024-05-31 10:00:00,nobody,T', '2024-05-31,r1,T', '2024-05-31 10:00:00,r1,']
)
def test_bad_rows_are_counted(tmp_path, row):
    (tmp_path / 'stations.csv').write_text('receiver,x,y\nr1,0,0\nr2,9,0\n')
    (tmp_path / 'd.csv').write_text(
        f'time_utc,receiver,tag\n2024-05-31 10:00:00,r1,T\n{row}\n2024-05-31 10:00:01,r2,T\n'
    )
    report = convert_detections(
        tmp_path / 'd.csv', tmp_path / 'out', receivers=tmp_path / 'stations.csv'
    )
    assert report.bad_rows == 1 and report.messages == {'/arrivals': 1}
