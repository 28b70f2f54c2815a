"""``sonar-imm bench``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .common import BAG, example, json_option, print_json, say


@click.command(epilog=example('sonar-imm bench', 'sonar-imm bench --json --skip-node'))
@click.option('--rounds', type=click.IntRange(min=1), default=7, show_default=True,
              help='Paired rounds against FilterPy.')
@click.option('--bag', type=BAG, help='What the node is timed with; by default a shipped bag.')
@click.option('--skip-node', is_flag=True, help='Leave out the live node (needs ROS 2).')
@click.option('--strict', is_flag=True, help='Exit with 1 when a figure misses its goal.')
@json_option
def command(rounds: int, bag: Path | None, skip_node: bool, strict: bool, as_json: bool) -> None:
    """Measure the filter against FilterPy in one run, a scan of 1000 targets, and the live node.

    Times depend on the machine and on what else it does; the ratio to FilterPy hardly does.
    """
    from ..evaluation.bench import bench_scan, bench_step
    result: dict[str, Any] = {}
    try:
        result['step'] = bench_step(rounds)
        _say_step(result['step'], as_json)
    except ModuleNotFoundError as error:
        if error.name != 'filterpy':
            raise
        say("FilterPy is not here, nothing to compare with: pip install 'sonar_imm[test]'",
            quiet=as_json)
    result['scan'] = bench_scan()
    _say_scan(result['scan'], as_json)
    if not skip_node:
        result['node_ms'] = _node_latency(bag)
        say('live node, message to estimate: p50 {p50:.2f} ms, p99 {p99:.2f} ms'.format(
            **result['node_ms']), quiet=as_json)
    if as_json:
        print_json(result)
    if strict and not all(part.get('good', True) for part in result.values()):
        raise click.exceptions.Exit(1)


def _node_latency(bag: Path | None) -> dict[str, float]:
    from ..nodes.harness import run_lockstep
    from .checking import shipped_bags
    return run_lockstep(bag or shipped_bags('diver')[0], 'diver').latency_ms()


def _say_step(step: dict[str, Any], quiet: bool) -> None:
    say(f'IMM step, {step["models"]} models, {step["states"]} states, {step["measurements"]} '
        f'measurements: {step["ours_us"]:.1f} us, FilterPy {step["filterpy_us"]:.0f} us: '
        f'{step["ratio"]:.0f} times as fast (wanted {step["ratio_wanted"]:.0f}; lowest of '
        f'{step["rounds"]} paired rounds {step["ratio_lowest"]:.0f}); the estimates agree to '
        f'{step["largest_difference_m"]:.0e} m', quiet=quiet)


def _say_scan(scan: dict[str, Any], quiet: bool) -> None:
    say(f'scan of {scan["targets"]} targets with gating and assignment: median '
        f'{scan["median_ms"]:.1f} ms (wanted {scan["wanted_ms"]:.0f}), worst of {scan["scans"]} '
        f'{scan["worst_ms"]:.1f} ms', quiet=quiet)
