# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Receivers with clocks of their own, compared by tags that lie at known places."""

import csv
from datetime import datetime, timezone

import numpy as np
import pytest

from sonar_imm_tools.recordings.convert import convert_detections, CsvOptions
from sonar_imm_tools.recordings.convert.detections import compare_clocks, gather, Received
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sniffing import sniff
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


STATIONS = {'VR2-101': (0, 0), 'VR2-102': (240, 0), 'VR2-103': (240, 240), 'VR2-104': (0, 240)}
START = 1_748_941_200.0


def heard(period=30.0, pings=20):
    """(seconds since 1970, receiver) of a tag at rest at 100, 60."""
    return sorted(
        (START + 5.0 + period * k + np.hypot(x - 100, y - 60) / 1500.0, name)
        for k in range(pings)
        for name, (x, y) in STATIONS.items()
    )


def text_of(t, digits=6, form='%Y-%m-%d %H:%M:%S'):
    moment = datetime.fromtimestamp(int(t), timezone.utc).strftime(form)
    return moment + (f'.{int(t % 1 * 10**digits):0{digits}d}' if digits else '')


def exported(folder, head, line, rows=None, **options):
    lines = [line(t, name) for t, name in rows or heard()]
    (folder / 'export.csv').write_text('\n'.join([head, *lines]) + '\n')
    places = [f'{name},{x},{y},-3' for name, (x, y) in STATIONS.items()]
    (folder / 'stations.csv').write_text('receiver,x,y,z\n' + '\n'.join(places) + '\n')
    table = CsvOptions(time_zone='UTC', columns=options.pop('columns', {}))
    return convert_detections(
        folder / 'export.csv',
        folder / 'out',
        receivers=folder / 'stations.csv',
        options=table,
        **options,
    )


VDAT = (
    'VEMCO DATA LOG,2.0.0,vdat\nRECORD TYPE,FIELD\nDIAG_DESC,Device Time (UTC),Model\n'
    'DET_DESC,Device Time (UTC),Time,Model,Serial Number,Channel,Full ID,ID'
)


@pytest.mark.parametrize(
    'head, line',
    [
        ('station,receiver,tagName,codeSpace,dateCollectedUTC',
         lambda t, r: f'S1,{r},A69-1602-7001,A69-1602,{text_of(t)}'),
        ('animal_id,detection_timestamp_utc,transmitter_codespace,transmitter_id,receiver_sn',
         lambda t, r: f'9,{text_of(t)},A69-1602,7001,{r}'),
        ('date_time,tag_serial_number,acoustic_tag_id,receiver_id,station_name',
         lambda t, r: f'{text_of(t)},1187,A69-1602-7001,{r},bh'),
        ('Timestamp,Receiver,CodeSpace,Signal,Valid',
         lambda t, r: f'{text_of(t)},{r},A69-1602,7001,TRUE'),
        ('Date,Time,TOA,Tag ID,Receiver,Power',
         lambda t, r: f'{text_of(t, 0, "%m/%d/%y")},{text_of(t, 0, "%H:%M:%S")},{t % 1:.6f},'
                      f'A69-1602-7001,{r},147'),
        ('Date and Time (UTC),ID,Data,Protocol,Receiver,Microsecond',
         lambda t, r: f'{text_of(t, 0)},A69-1602-7001,0,S256,{r},{int(t % 1 * 1e6)}'),
        (VDAT,
         lambda t, r: f'DIAG,{text_of(t)},{r[:3]}\nDET,{text_of(t)},{text_of(t)},VR2,{r[4:]},69,'
                      'A69-1602-7001,7001'),
        ('Date and Time (UTC),Receiver,Transmitter',
         lambda t, r: f'{text_of(t)},{r[4:]},A69-1602-7001'),
    ],
    ids='otn glatos etn actel lotek thelma vdat serial_number'.split(),
)  # fmt: skip
def test_exports_of_makers_and_networks(tmp_path, head, line):
    report = exported(tmp_path, head, line)
    assert (report.bad_rows, report.messages) == (0, {'/arrivals': 20})
    assert 'A69-1602-7001 is 1' in report.notes['tag']
    first = arrivals_of(report.path)[0]
    assert sorted(first.rx_id) == [1, 2, 3, 4]
    wanted = [t for t, _ in heard()[:4]]
    assert first.stamp_ns * 1e-9 == pytest.approx(wanted[0], abs=2e-6)
    assert sorted(first.toa) == pytest.approx([t - wanted[0] for t in wanted], abs=2e-6)
    assert sniff(tmp_path / 'export.csv').kind == 'detections'


def test_detections_that_are_marked_as_invalid_are_left_out(tmp_path):
    head = 'Timestamp,Receiver,Transmitter,Valid'
    report = exported(
        tmp_path, head, lambda t, r: f'{text_of(t)},{r},7,{str(r != "VR2-101").upper()}'
    )
    assert report.bad_rows == 20 and set(arrivals_of(report.path)[0].rx_id) == {2, 3, 4}


@pytest.mark.parametrize(
    'digits, std, words',
    [(0, None, '1 s, 1.5e+03 m'), (1, 0.1, '0.1 s, 150 m'), (2, 0.01, '0.01 s'), (6, None, '')],
)
def test_the_resolution_of_stamps_is_said_and_heeded(tmp_path, digits, std, words):
    head = 'Date and Time (UTC),Receiver,Transmitter'
    args = tmp_path, head, lambda t, r: f'{text_of(t, digits)},{r},7'
    if digits == 0:
        with pytest.raises(BagError) as caught:
            exported(*args)
        assert words in caught.value.sentence and '--toa-std 0.29' in caught.value.sentence
        assert exported(*args, toa_std=0.29).messages == {'/arrivals': 20}
        return
    report = exported(*args)
    assert words in report.notes.get('resolution', '')
    var = arrivals_of(report.path)[0].var_toa
    assert var == pytest.approx(std**2 / 12) if std else np.isnan(var).all()


def test_days_of_five_digits_have_a_resolution_too(tmp_path):
    head = 'excel_time,Receiver,Transmitter'
    line = lambda t, r: f'{t / 86400 + 25569:.5f},{r},7'  # noqa: E731
    with pytest.raises(BagError, match='a resolution of 0.864 s'):
        exported(tmp_path, head, line)


@pytest.mark.parametrize('period, words', [(0.7, '0.35 s'), (1.0, '0.5 s'), (30.0, '')])
def test_pings_within_a_second_are_not_joined(tmp_path, period, words):
    head = 'Date and Time (UTC),Receiver,Transmitter'
    line = lambda t, r: f'{text_of(t)},{r},7'  # noqa: E731
    report = exported(tmp_path, head, line, heard(period))
    assert report.messages == {'/arrivals': 20} and words in report.notes.get('window', '')


def test_pings_faster_than_sound_crosses_the_array_are_a_question(tmp_path):
    head = 'Date and Time (UTC),Receiver,Transmitter'
    line = lambda t, r: f'{text_of(t)},{r},7'  # noqa: E731
    with pytest.raises(BagError, match='each 0.2 s, and sound takes 0.226 s.*--window 0.23'):
        exported(tmp_path, head, line, heard(0.2))
    assert exported(tmp_path, head, line, heard(0.2), window=0.23).messages


def test_one_receiver_alone_is_said(tmp_path):
    rows = [row for row in heard() if row[1] == 'VR2-101']
    report = exported(
        tmp_path, 'Time (UTC),Receiver,Tag', lambda t, r: f'{text_of(t)},{r},7', rows
    )
    assert 'all detections are of VR2-101' in report.questions[0]
