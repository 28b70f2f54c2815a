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

"""The diver tracker on real recordings: a towed acoustic tag (yaps) and boats (Autoferry).

    SONAR_IMM_DATA=../shared/data python -m benchmarks.real_recordings

Prints docs/results/real_recordings.md, from which docs/real_recordings.md quotes. Truth of the tag
is a hand-held GPS, itself good to a few metres and ahead of the tag, which is towed: errors are
given against GPS as it is and against GPS 3.4 s later.
"""

from __future__ import annotations

import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from benchmarks.study import final_estimates
from msg_adapters.estimates import read_estimate
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Arrivals, Fix, Rejection
from sonar_imm.trackers.diver.births import locate
from sonar_imm.trackers.diver.smoothing import SmoothingDiverTracker
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.convert import convert_arrivals, convert_autoferry, convert_fixes
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader

DATA = Path(os.environ.get('SONAR_IMM_DATA', '../shared/data'))
LAG = 3.4

TAG: dict[str, Any] = {
    'max_tracks': 1,
    'confirm_hits': 1,
    'max_coast': 600.0,
    'sound_speed': 1545.0,
    'target_z': -1.0,
    'toa_std': 0.0009,
}
"""What a user knows: one tag, silent for half a minute at a time, a metre deep, in water of this
sound speed, with receivers of this accuracy. Everything else is at its default."""

BOATS: dict[str, Any] = {'speed_mean': 2.0, 'speed_std': 1.5, 'speed_noise': 0.1}
HEADINGS: dict[str, Any] = {'model_set': 'heading_speed'}
PACE: dict[str, Any] = {**HEADINGS, 'speed_noise': 0.07}
"""A swimmer whose speed, spread by `speed_std` = .4 m/s, is another one after a minute: a random
walk of sqrt(2 / 60 s) .4 m/s over a second, as that of a process that forgets within a minute."""
COLUMNS = ('tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing')
SETS: dict[str, dict[str, Any]] = {
    'CV Kalman': {'model_set': 'cv', 'acceleration_noise': (0.1,)},
    'IMM CV+CV': {'model_set': 'cv_cv', 'acceleration_noise': (0.01, 0.12)},
    'families (default)': {},
    'heading_speed': HEADINGS,
    'heading_speed, pace kept a minute': PACE,
    'heading_speed_lateral': {'model_set': 'heading_speed_lateral'},
}
OF_BOATS: dict[str, dict[str, Any]] = {
    'CV Kalman': {'model_set': 'cv', 'acceleration_noise': (0.3,)},
    'IMM CV+CV': {'model_set': 'cv_cv', 'acceleration_noise': (0.05, 0.6)},
    'families (default)': {},
    'families, gnn': {'association': 'gnn'},
    'heading_speed': {**HEADINGS, **BOATS},
    'heading_speed, jipda': {**HEADINGS, **BOATS, 'association': 'jipda'},
}


def load(bag: Path) -> tuple[list, np.ndarray]:
    """Measurements of a bag, and truth as rows (stamp s, id, x, y)."""
    with BagReader(bag) as reader:
        found = [item.measurement for item in measurements_of(reader, 'diver')]
    truth = []
    with BagReader(bag) as reader:
        for item in reader.messages(['/truth/estimate']):
            table = read_estimate(item.message)
            truth += [
                (table.stamp_ns * 1e-9, int(i), x, y)
                for i, x, y in zip(
                    table.extras['track_id'], table.extras['px'], table.extras['py']
                )
            ]
    return [each for each in found if not isinstance(each, Rejection)], np.array(truth)


def follow(config: DiverConfig, items: list) -> tuple[list, list]:
    """Estimates of the filter and of the smoother, the last word on each stamp."""
    tracker = SmoothingDiverTracker(config)
    final = final_estimates(tracker, items)
    return [final[stamp] for stamp in sorted(final)], tracker.smoothed()


def against_gps(
    stamps: np.ndarray, places: np.ndarray, truth: np.ndarray, lag: float
) -> tuple[np.ndarray, np.ndarray]:
    """Error (k, 2) at the stamps inside the GPS recording and not inside one of its gaps, and
    which stamps those are."""
    t = stamps + lag
    after = np.clip(np.searchsorted(truth[:, 0], t), 1, len(truth) - 1)
    good = (
        (t >= truth[0, 0]) & (t <= truth[-1, 0]) & (truth[after, 0] - truth[after - 1, 0] < 60.0)
    )
    there = np.column_stack([np.interp(t, truth[:, 0], truth[:, c]) for c in (2, 3)])
    return (places - there)[good], good


def tag_scores(estimates: list, truth: np.ndarray) -> list[float]:
    """RMSE as it is and with the lag, median, NEES with the lag."""
    rows = [
        (e.stamp_ns * 1e-9, e.state[0, :2], e.covariance[0, :2, :2]) for e in estimates if len(e)
    ]
    stamps, places, covariances = (np.array(column) for column in zip(*rows))
    plain, _ = against_gps(stamps, places, truth, 0.0)
    lagged, good = against_gps(stamps, places, truth, LAG)
    squared = np.einsum(
        'ki,ki->k', lagged, np.linalg.solve(covariances[good], lagged[..., None])[..., 0]
    )
    distance = np.hypot(*lagged.T)
    return [
        np.sqrt(np.mean(np.sum(plain**2, 1))),
        np.sqrt(np.mean(distance**2)),
        np.median(distance),
        squared.mean(),
        len(distance),
    ]


def raw_fixes(items: list, config: DiverConfig) -> list[Estimate]:
    """The fixes themselves, or those that each ping gives by itself, as tracks without a past."""
    rows = []
    for item in items:
        if isinstance(item, Fix):
            assert item.covariance is not None
            covariance = config.covariance_scale * item.covariance[:2, :2]
            rows.append((item.stamp_ns, item.position[:2], covariance))
        elif isinstance(item, Arrivals):
            fix = locate(item, np.arange(len(item)), config, config.covariance_scale)
            rows += [(item.stamp_ns, fix.position, fix.covariance)] if fix else []
    alone = {'track_state': np.ones(1, np.uint8)}
    return [
        Estimate(
            stamp_ns=stamp_ns,
            frame_id='map',
            xyz=np.zeros((1, 3), np.float32),
            state_names=('px', 'py'),
            state=place[None, :2],
            covariance=np.asarray(covariance)[None],
            extras={**alone, 'track_id': np.array([number])},
        )
        for number, (stamp_ns, place, covariance) in enumerate(rows)
    ]


def thinned(items: list, receivers: int, keep: float, seed: int = 1) -> list:
    """Fewer receivers per ping, and fewer pings."""
    rng = np.random.default_rng(seed)
    out = []
    for ping in items:
        rows = np.sort(rng.permutation(len(ping))[:receivers])
        if rng.uniform() < keep and len(rows) > 1:
            columns = {name: getattr(ping, name)[rows] for name in COLUMNS}
            out.append(Arrivals(stamp_ns=ping.stamp_ns, frame_id=ping.frame_id, **columns))
    return out


def tag_table(title: str, items: list, truth: np.ndarray, **extra: Any) -> None:
    print(f'\n### {title} ({len(items)} messages)\n')
    header('RMSE m', 'RMSE, GPS 3.4 s later', 'median', 'NEES (2)', 'compared')
    config = DiverConfig(**{**TAG, **extra})
    # Three arrivals give a fix. Of a tag two give a hyperbola and one nothing: what is said then
    # is the prediction.
    least = {'pings of 3 or more': 3, 'pings of 2 or more': 2, '': 0}
    sizes = {item.stamp_ns: len(item) if isinstance(item, Arrivals) else 3 for item in items}
    row('each ping or fix by itself', tag_scores(raw_fixes(items, config), truth))
    for name, values in SETS.items():
        filtered, smooth = follow(DiverConfig(**{**TAG, **extra, **values}), items)
        kinds = {name: filtered}
        if not all(np.array_equal(a.state, b.state) for a, b in zip(filtered, smooth)):
            kinds[f'{name}, smoothed'] = smooth
        for label, estimates in kinds.items():
            last: list[float] = []
            for which, size in least.items():
                shared = [each for each in estimates if sizes.get(each.stamp_ns, 0) >= size]
                scores = tag_scores(shared, truth)
                if not which or last != scores and len(shared) < len(estimates):
                    row(', '.join(filter(None, (label, which))), scores)
                last = scores


def seeds_table(pings: list, truth: np.ndarray) -> None:
    print('\n### yaps, raw arrivals thinned in eight ways: RMSE, GPS 3.4 s later\n')
    header('5 receivers', '4 receivers', '3 receivers')
    for name, values in {
        'families (default)': {},
        'heading_speed': HEADINGS,
        'heading_speed, pace kept a minute': PACE,
        'heading_speed, receivers known to 1.4 m': {**HEADINGS, 'receiver_position_std': 1.4},
    }.items():
        cells = []
        for receivers in (5, 4, 3):
            scores = []
            for seed in range(1, 9):
                tracker = DiverTracker(DiverConfig(**{**TAG, **values}))
                final = final_estimates(tracker, thinned(pings, receivers, 1.0, seed))
                scores.append(tag_scores([final[stamp] for stamp in sorted(final)], truth)[1])
            cells.append(' '.join(f'{score:.1f}' for score in scores))
        print(f'| {name} | {" | ".join(cells)} |')


def header(*columns: str) -> None:
    print(f'| | {" | ".join(columns)} |\n{"|---" * (len(columns) + 1)}|')


def row(name: str, values: list[float]) -> None:
    print(f'| {name} | {" | ".join(f"{v:.2f}".removesuffix(".00") for v in values)} |')


def autoferry(sensor: str, time_offset_ns: int = 0) -> tuple[list, np.ndarray]:
    """The scans of radar or lidar in Autoferry scenario 13, and the truth, as `load` has them."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / sensor
        convert_autoferry(
            DATA / 'autoferry/scenario13_detections.json',
            out,
            sensors=(sensor,),
            truth=DATA / 'autoferry/scenario13_groundTruth.json',
            time_offset_ns=time_offset_ns,
        )
        return load(out)


def boats() -> None:
    for sensor in ('radar', 'lidar'):
        items, truth = autoferry(sensor)
        print(
            f'\n### Autoferry scenario 13, {sensor}: {len(items)} scans, '
            f'{sum(map(len, items))} fixes\n'
        )
        header('GOSPA (20 m, 2)', 'missed', 'false', 'tracks', 'position RMSE m')
        for name, values in OF_BOATS.items():
            config = DiverConfig(
                fix_std=4.0 if sensor == 'radar' else 2.0,
                clutter_density=1e-5,
                confirm_hits=4,
                confirm_window=6,
                **values,
            )
            row(name, boat_scores(final_estimates(DiverTracker(config), items), truth))


def boat_scores(final: dict, truth: np.ndarray) -> list[float]:
    distance, missed, false, ids, squared = [], 0, 0, set(), []
    for stamp in sorted(final):
        estimate = final[stamp]
        rows = estimate.extras['track_state'] > 0
        present = []
        for number in np.unique(truth[:, 1]):
            path = truth[truth[:, 1] == number]
            if path[0, 0] <= stamp * 1e-9 <= path[-1, 0]:
                present.append([np.interp(stamp * 1e-9, path[:, 0], path[:, c]) for c in (2, 3)])
        result = gospa(np.reshape(present, (-1, 2)), estimate.state[rows, :2], 20.0, 2)
        distance.append(result.distance)
        pairs = [(i, j) for i, j in enumerate(result.estimate_of) if j >= 0]
        missed += len(present) - len(pairs)
        false += int(rows.sum()) - len(pairs)
        squared += [
            np.sum((np.array(present[i]) - estimate.state[rows, :2][j]) ** 2) for i, j in pairs
        ]
        ids.update(estimate.extras['track_id'][rows].tolist())
    n = len(final)
    return [np.mean(distance), missed / n, false / n, len(ids), np.sqrt(np.mean(squared))]


def main() -> None:
    folder = DATA / 'yaps_ssu1'
    if not folder.is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    with tempfile.TemporaryDirectory() as scratch:
        fixes, arrivals = Path(scratch) / 'fixes', Path(scratch) / 'arrivals'
        convert_fixes(folder / 'fixes.csv', fixes, truth=folder / 'gps_truth.csv')
        convert_arrivals(
            folder / 'arrivals.csv',
            arrivals,
            receivers=folder / 'receivers.csv',
            truth=folder / 'gps_truth.csv',
        )
        items, truth = load(fixes)
        tag_table('yaps, fixes as they are', items, truth)
        tag_table('yaps, fixes, covariances times 6', items, truth, covariance_scale=6.0)
        tag_table(
            'yaps, fixes, covariance scale learnt', items, truth, estimate_covariance_scale=True
        )
        pings, truth = load(arrivals)
        tag_table('yaps, raw arrivals, all receivers', pings, truth)
        for receivers in (5, 4, 3):
            tag_table(
                f'yaps, raw arrivals, {receivers} receivers per ping',
                thinned(pings, receivers, 1.0),
                truth,
            )
        seeds_table(pings, truth)
    boats()


if __name__ == '__main__':
    main()
