"""The scores of a run of divers in words and lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..numbers import belief_sentence, chi2_line, error_line


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in plain words."""
    position = metrics.get('position', {})
    if not position.get('n'):
        known = 'scored_stamps' in metrics
        return f'{metrics["tracks_confirmed"]} confirmed tracks in {metrics["span_s"]:.0f} s. ' + (
            'None of them met the truth.'
            if known
            else 'There is no truth to compare '
            'with, so this page shows what the tracker says of itself.'
        )
    words = [f'On average the track lies {position["rmse_m"]:.2f} m from the truth (RMS).']
    raw = metrics.get('raw_fix', {})
    if raw.get('n'):
        change = 1.0 - position['rmse_m'] / raw['rmse_m']
        words.append(
            f'The raw fixes lie {raw["rmse_m"]:.2f} m away: tracking '
            + (
                f'removes {100 * change:.0f} % of the error.'
                if change >= 0.0
                else f'adds {-100 * change:.0f} % to it.'
            )
        )
    words.append(belief_sentence(metrics['consistency']['coverage']['95']))
    return ' '.join(words)


def lines(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and value of the numbers a person wants to see first."""
    consistency = metrics['consistency']
    result = [
        *error_line('position error', metrics.get('position', {}), 'm'),
        *error_line('raw fixes', metrics.get('raw_fix', {}), 'm'),
        *error_line('velocity error', metrics.get('velocity', {}), 'mps', 'm/s'),
        *chi2_line('NEES, position', consistency.get('nees_position', {})),
        *chi2_line('NEES, whole state', consistency.get('nees_state', {})),
        *chi2_line('NIS', consistency['nis']),
    ]
    if metrics.get('position', {}).get('n'):
        result.append(
            (
                'truth inside 50 / 90 / 95 % ellipse',
                ' / '.join(f'{100 * share:.0f} %' for share in consistency['coverage'].values()),
            )
        )
    if metrics.get('lag'):
        result.append(
            (
                'best lag of the estimates',
                f'{metrics["lag"]["best_s"]:.2f} s, then RMSE '
                f'{metrics["lag"]["rmse_at_best_m"]:.3f} m',
            )
        )
    result += [
        (name.replace('_', ' '), f'{value:.3g}')
        for name, value in metrics.get('tracks', {}).items()
    ]
    return result
