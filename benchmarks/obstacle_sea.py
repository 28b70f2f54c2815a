"""Obstacles that stay, sway, move or lie on the sea floor: accuracy with and without behaviours.

    python -m benchmarks.obstacle_sea --runs 25 --out docs/results/obstacle_sea.json

Each run is the whole tracker: gating, confirmation, track logic. `fixed` holds every obstacle for
fixed, `all` has the default behaviours; both see the same measurements. Errors are those of the
vertical offset when the range first falls to 50, 30 and 20 m, of the track that is confirmed and
nearest, at most 5 m off; `lost` counts the runs without one. P is the mean probability of each
behaviour at 30 m, v the RMSE of the velocity of each axis there.
`calibration` compares stated probabilities of a collision with what happened: twice the runs for
each of a fixed, a swaying and a moving obstacle, the vertical offset uniform within 5 m.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.obstacle_accuracy import (
    config_of,
    level,
    LEVER,
    NEAR,
    offset_at,
    RANGES,
    summary,
    track,
    true_level,
)
from benchmarks.tables import markdown, write_json
from sonar_imm.estimates import Estimate
from sonar_imm.simulation.obstacle.simulator import scenario, simulate, TrueObstacle
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, ObstacleConfig

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    'fixed': ('approach', {}),
    'fixed, roll 4 deg': ('rolling', {}),
    'swaying': ('swaying', {}),
    'swaying, roll 4 deg': ('swaying', {'roll_rms_deg': 4.0}),
    'moving .3-1.5 m/s': ('mover', {}),
    'moving .1-.3 m/s': ('mover', {'obstacle_speed': [0.1, 0.3]}),
    'on the sea floor': ('approach', {'placement': 'seabed', 'altitude': 6.0}),
}
METHODS: dict[str, dict[str, Any]] = {
    'fixed': {'behaviours': ('fixed',)},
    'all': {'behaviours': BEHAVIOURS},
}
AT = 30.0
BINS = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.0)


def behaviour_at(truth: TrueObstacle, final: dict[int, Estimate]) -> list[float] | None:
    """Probability of each behaviour and the error of vx and vy when the range falls to `AT`."""
    for ping in np.flatnonzero(truth.range <= AT)[:6]:
        estimate = final.get(int(truth.stamp_ns[ping]))
        if estimate is None:
            continue
        points, confirmed = level(estimate)
        distance = np.linalg.norm(points - true_level(truth, ping), axis=1)
        distance[~confirmed] = np.inf
        if len(distance) and distance.min() <= NEAR:
            row = int(np.argmin(distance))
            extras = estimate.extras
            return [float(extras[f'prob_{name}'][row]) for name in BEHAVIOURS] + [
                float(extras[name][row] - truth.velocity[ping, i])
                for i, name in enumerate(('vx', 'vy'))
            ]
    return None


def case(name: str, runs: int) -> dict[str, dict[str, float]]:
    kind, changes = CASES[name]
    setting = scenario(kind, {**LEVER, **changes})
    offsets: dict[str, list[list[list[float] | None]]] = {method: [] for method in METHODS}
    told, tracks = [], dict.fromkeys(METHODS, 0)
    for seed in range(runs):
        scene = simulate(setting, seed)
        for method, values in METHODS.items():
            final = track(scene, config_of(setting, **values))
            offsets[method].append([offset_at(scene.truth[0], final, at) for at in RANGES])
            tracks[method] += len(
                {
                    int(number)
                    for one in final.values()
                    for number in one.extras['track_id'][one.extras['track_state'] > 0]
                }
            )
            if method == 'all':
                told.append(behaviour_at(scene.truth[0], final))
    table = {}
    for method, rows in offsets.items():
        table[f'{name}, {method}'] = {
            **{key: value for key, value in guarded(rows).items() if 'bias' not in key},
            'tracks per obstacle': tracks[method] / runs,
        }
    known = np.array([one for one in told if one is not None])
    if len(known):
        mean = known.mean(axis=0)
        table[f'{name}, all'] |= {f'P {b}': float(mean[i]) for i, b in enumerate(BEHAVIOURS)}
        table[f'{name}, all']['v'] = float(np.sqrt(np.mean(known[:, 4:] ** 2)))
    return table


def happened(truth: TrueObstacle, ping: int, radius: float, height: float) -> bool:
    """Whether the obstacle is ever within the radius and the half height at once from a ping on;
    what the scene does not reach has passed."""
    offset = truth.vertical_offset[ping:]
    level_distance = np.sqrt(np.maximum(truth.range[ping:] ** 2 - offset**2, 0.0))
    return bool(np.any((level_distance <= radius) & (np.abs(offset) <= height)))


def calibration(runs: int) -> dict[str, dict[str, float]]:
    """Stated probabilities of a collision at 60, 40 and 25 m, by bin, beside what happened."""
    forecasts: list[tuple[str, float, float, float]] = []
    config = ObstacleConfig()
    for kind in ('approach', 'swaying', 'mover'):
        setting = scenario(
            kind,
            {**LEVER, 'vertical_offset': 0.0, 'offset_spread': 5.0, 'last_range': -30.0},
        )
        for seed in range(runs):
            scene = simulate(setting, 1000 + seed)
            truth = scene.truth[0]
            final = track(scene, config_of(setting, behaviours=BEHAVIOURS))
            for at in (60.0, 40.0, 25.0):
                stated = risk_at(truth, final, at)
                if stated is not None:
                    hit = happened(truth, stated[0], config.safety_radius, config.safety_height)
                    forecasts.append((kind, at, stated[1], float(hit)))
    table: dict[str, dict[str, float]] = {}
    p = np.array([one[2] for one in forecasts])
    hit = np.array([one[3] for one in forecasts])
    for low, high in zip(BINS, BINS[1:]):
        rows = (p >= low) & ((p < high) | (high == 1.0))
        if rows.any():
            table[f'stated {low:g} to {high:g}'] = {
                'forecasts': float(rows.sum()),
                'stated': float(p[rows].mean()),
                'happened': float(hit[rows].mean()),
            }
    for kind in ('approach', 'swaying', 'mover'):
        table[f'Brier, {kind}'] = {}
        for at in (60.0, 40.0, 25.0):
            rows = np.array([one[0] == kind and one[1] == at for one in forecasts])
            table[f'Brier, {kind}'][f'{at:.0f} m'] = float(np.mean((p[rows] - hit[rows]) ** 2))
    return table


def risk_at(
    truth: TrueObstacle, final: dict[int, Estimate], at: float
) -> tuple[int, float] | None:
    """The ping at which the range first falls to `at`, and the probability stated there."""
    for ping in np.flatnonzero(truth.range <= at)[:6]:
        estimate = final.get(int(truth.stamp_ns[ping]))
        if estimate is None:
            continue
        points, confirmed = level(estimate)
        distance = np.linalg.norm(points - true_level(truth, ping), axis=1)
        distance[~confirmed] = np.inf
        if len(distance) and distance.min() <= NEAR:
            risk = float(estimate.extras['collision_probability'][int(np.argmin(distance))])
            return (int(ping), risk) if np.isfinite(risk) else None
    return None


def guarded(rows: list[list[list[float] | None]]) -> dict[str, float]:
    """`summary`, also where every run lost the obstacle at some range."""
    filled = [[one or [np.nan] * 3 for one in row] for row in rows]
    found = [[one is not None for one in row] for row in rows]
    if all(any(column) for column in zip(*found)):
        return summary(rows)
    lost = 1.0 - np.mean(found, axis=0)
    table = {}
    for k, at in enumerate(RANGES):
        error = np.array([row[k][0] for row in filled])
        error = error[np.isfinite(error)]
        table[f'RMSE {at:.0f} m'] = float(np.sqrt(np.mean(error**2))) if len(error) else np.nan
        table[f'lost {at:.0f} m'] = float(lost[k])
    return table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--runs', type=int, default=25)
    parser.add_argument(
        '--cases', nargs='*', choices=[*CASES, 'calibration'], default=[*CASES, 'calibration']
    )
    parser.add_argument('--out', type=Path, help='write the numbers as JSON')
    options = parser.parse_args()
    tables: dict[str, Any] = {}
    for name in options.cases:
        if name == 'calibration':
            tables[name] = calibration(2 * options.runs)
            parts = [
                {row: values for row, values in tables[name].items() if row.startswith(word)}
                for word in ('stated', 'Brier')
            ]
        else:
            tables[name] = case(name, options.runs)
            both = f'{name}, all'
            told = {key: v for key, v in tables[name][both].items() if key[0] in 'Pv'}
            errors = {
                row: {key: v for key, v in values.items() if key not in told}
                for row, values in tables[name].items()
            }
            parts = [errors, {both: told}]
        for part in parts:
            print(f'\n{markdown(part, 3)}', flush=True)
    write_json(options.out, {'runs': options.runs, **tables})


if __name__ == '__main__':
    main()
