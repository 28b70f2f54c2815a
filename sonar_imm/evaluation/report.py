"""The report of a tracked recording: one HTML file that a reader who knows no filter can follow.

`write_report` joins the numbers of `scoring`, the figures of `figures` and the page of `page`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from attrs import frozen
import numpy as np

from . import figures
from .matching import match
from .page import Card, folded, mapping_table, Part, render, Section, table
from .series import Series
from .truth import Truth


@frozen(eq=False, kw_only=True)
class ReportInput:
    """What a report is made from. run: content of ``run.json``; metrics: of ``metrics.json``.

    checks: what was compared with a live node: mappings with name, result, wanted and good.
    """

    run: Mapping[str, Any]
    metrics: Mapping[str, Any]
    series: Series
    truth: Truth | None = None
    fixes: Series | None = None
    checks: tuple[Mapping[str, Any], ...] = ()


def write_report(path: Path, *materials: ReportInput) -> None:
    """Write one report of one or several runs to `path`."""
    path.write_text(report_html(*materials), encoding='utf-8')


def report_html(*materials: ReportInput) -> str:
    """The report as text; the same material gives the same bytes."""
    parts = [Part(f'sonar_imm · {one.run["system"]} tracker', Path(one.run['bag']).name,
                  summary_sentence(one.metrics), tuple(_cards(one.metrics)),
                  tuple(_sections(one))) for one in materials]
    version = materials[0].run.get('versions', {}).get('sonar_imm', '')
    return render(', '.join(part.title for part in parts), parts,
                  footer=f'Made by sonar_imm {version}. Times are seconds since the first '
                         'estimate of a run.')


def summary_sentence(metrics: Mapping[str, Any]) -> str:
    """The result in plain words."""
    position = metrics.get('position', {})
    if not position.get('n'):
        known = 'scored_stamps' in metrics
        return (f'{metrics["tracks_confirmed"]} confirmed tracks in {metrics["span_s"]:.0f} s. '
                + ('None of them met the truth.' if known else 'There is no truth to compare '
                   'with, so this page shows what the tracker says of itself.'))
    words = [f'On average the track lies {position["rmse_m"]:.2f} m from the truth (RMS).']
    raw = metrics.get('raw_fix', {})
    if raw.get('n'):
        change = 1.0 - position['rmse_m'] / raw['rmse_m']
        words.append(f'The raw fixes lie {raw["rmse_m"]:.2f} m away: tracking '
                     + (f'removes {100 * change:.0f} % of the error.' if change >= 0.0
                        else f'adds {-100 * change:.0f} % to it.'))
    words.append(belief_sentence(metrics['consistency']['coverage']['95']))
    return ' '.join(words)


def belief_sentence(coverage: float) -> str:
    """What the share of truth inside the stated 95 % ellipses says of them."""
    held = f'its 95 % ellipses hold the truth {100 * coverage:.0f} % of the time'
    if coverage < 0.90:
        return f'It is more sure of itself than it should be: {held}.'
    if coverage > 0.99:
        return f'It is more careful than it needs to be: {held}.'
    return f'Its stated uncertainty can be believed: {held}.'


def _cards(metrics: Mapping[str, Any]) -> list[Card]:
    position, raw = metrics.get('position', {}), metrics.get('raw_fix', {})
    cards = []
    if position.get('n'):
        cards.append(Card(f'{position["rmse_m"]:.2f} m', 'Position error, RMS',
                          f'median {position["median_m"]:.2f} m, 95 % {position["p95_m"]:.2f} m'))
        if raw.get('n'):
            cards.append(Card(f'{raw["rmse_m"]:.2f} m', 'Raw fixes, RMS', f'{raw["n"]} fixes'))
        if metrics['velocity']['n']:
            cards.append(Card(f'{metrics["velocity"]["rmse_mps"]:.2f} m/s', 'Velocity error, RMS'))
        consistency = metrics['consistency']
        cards.append(Card(f'{100 * consistency["coverage"]["95"]:.0f} %',
                          'Truth inside the 95 % ellipse', '95 % would be perfect'))
        cards.append(Card(f'{consistency["nees_position"]["mean"]:.2f}', 'NEES of the position',
                          _bounds(consistency['nees_position'])))
        if metrics['tracks']['true_targets'] > 1 or metrics['tracks']['tracks'] > 1:
            cards.append(_tracks_card(metrics['tracks']))
    nis = metrics['consistency']['nis']
    if nis['n']:
        cards.append(Card(f'{nis["mean"]:.2f}', 'NIS of the hits', _bounds(nis)))
    if not position.get('n'):
        cards.insert(0, Card(str(metrics['tracks_confirmed']), 'Confirmed tracks',
                             f'{metrics["stamps"]} stamps in {metrics["span_s"]:.0f} s'))
    return cards


def _tracks_card(tracks: Mapping[str, Any]) -> Card:
    return Card(f'{tracks["tracks"]} / {tracks["true_targets"]}', 'Tracks / true targets',
                f'{tracks["identity_switches"]} identity switches, '
                f'{tracks["false_tracks"]} false, '
                f'{100 * tracks["completeness"]:.0f} % complete')


def _bounds(summary: Mapping[str, Any]) -> str:
    if 'low' not in summary:
        return f'{summary["n"]} values'
    if summary.get('divided_by_dof'):
        return (f'per degree of freedom: 1 expected, {summary["low"]:.2f} to '
                f'{summary["high"]:.2f} believable')
    return f'{summary["dof"]} expected, {summary["low"]:.2f} to {summary["high"]:.2f} believable'


def _sections(material: ReportInput) -> list[Section]:
    series = material.series.confirmed()
    track_id = series.longest_track()
    sections = [Section(
        'Map', 'Seen from above. Dotted: truth. Crosses: raw fixes. Shaded: the ellipses that '
        'should hold the target 95 times in a hundred.',
        figures.map_figure(series, material.truth, material.fixes))]
    if material.checks:
        rows = [(check['name'], check['result'], check['wanted'], 'yes' if check['good'] else 'NO')
                for check in material.checks]
        sections.insert(0, Section(
            'Live node against offline tracker', 'The recording was played to a real ROS 2 node, '
            'message by message, and what the node published was compared with the offline run.',
            html=table(('check', 'result', 'wanted', 'good'), rows)))
    if track_id is not None:
        sections += _track_sections(material, series, track_id)
    return [*sections, _numbers(material.metrics), *_about(material.run)]


def _track_sections(material: ReportInput, series: Series, track_id: int) -> list[Section]:
    count = len(np.unique(series.track_id))
    which = '' if count == 1 else f' Track {track_id}, the longest of {count}.'
    sections = []
    if material.truth is not None and material.metrics.get('position', {}).get('n'):
        matching = match(series, material.truth, cutoff=material.metrics['cutoff_m'])
        sections.append(Section(
            'Error, and the error it predicted', 'A tracker that knows its limits keeps its error '
            f'inside the band 95 % of the time.{which}', figures.error_figure(matching, track_id)))
    else:
        sections.append(Section('Stated uncertainty', f'One sigma on each axis.{which}',
                                figures.sigma_figure(series, track_id)))
    if series.model_names:
        course = _true_course(material, series, track_id)
        sections.append(Section(
            'Which motion model held', 'Dark: the model is probable. Headings are counter-'
            f'clockwise from +x.{which}', figures.models_figure(series, track_id, course)))
    if (series.nis_dof > 0).any():
        sections.append(Section(
            'Surprise of each measurement (NIS)', 'How far each measurement fell from where it '
            'was expected, in units of the stated uncertainty. Amber: where the mean should stay.',
            figures.nis_figure(series)))
    return sections


def _true_course(material: ReportInput, series: Series,
                 track_id: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Seconds and degrees of the true course of the target a track followed; None if unknown."""
    relative = material.run.get('parameters', {}).get('model_set') == 'relative_headings'
    if material.truth is None or relative or 'position' not in material.metrics:
        return None
    matching = match(series, material.truth, cutoff=material.metrics['cutoff_m'])
    rows = series.track_id[matching.row] == track_id
    velocity = matching.truth[rows, 2:]
    moving = np.hypot(*velocity.T) > 0.05
    stamps = series.stamp_ns[matching.row[rows]][moving]
    if not len(stamps):
        return None
    return (figures.seconds(stamps, series.scan_ns),
            np.degrees(np.arctan2(velocity[moving, 1], velocity[moving, 0])))


def _numbers(metrics: Mapping[str, Any]) -> Section:
    return Section('All numbers', 'The content of metrics.json. Bounds take successive errors as '
                   'independent, which those of one track are not quite.',
                   html=folded('Show them', mapping_table(('metric', 'value'), flat(metrics))))


def _about(run: Mapping[str, Any]) -> list[Section]:
    counts = run.get('counts', {})
    refused = run.get('refused', {})
    sections = [Section('What happened to the input', 'Every message is accounted for.',
                        html=table(('outcome', 'messages'), counts.items()))]
    if refused:
        rows = [(reason, entry['count'], entry['example']) for reason, entry in refused.items()]
        sections.append(Section('Refused input', 'Messages that could not be used, with the first '
                                'of each kind.', html=table(('reason', 'messages', 'why'), rows)))
    parameters = folded('Show them', mapping_table(('parameter', 'value'),
                                                   run.get('parameters', {})))
    about = {key: run[key] for key in ('bag', 'bag_sha256', 'bag_bytes', 'order', 'smoothed',
                                     'topics')
             if key in run} | dict(run.get('versions', {}))
    about['topics'] = [f'{topic} as {name}' for topic, name in run['topics'].items()]
    return [*sections, Section('Parameters', 'What the tracker was told.', html=parameters),
            Section('Where this comes from', 'Input and versions, to do it again.',
                    html=mapping_table(('what', 'value'), about))]


def flat(values: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested keys joined by dots."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result.update(flat(value, f'{prefix}{key}.'))
        else:
            result[f'{prefix}{key}'] = value
    return result
