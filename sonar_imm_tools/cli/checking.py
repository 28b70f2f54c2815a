# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One recording through the offline tracker and through the real node, compared and scored.

``check`` prints the result, ``demo`` makes a report of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
import shutil
from typing import Any

from attrs import asdict, frozen

from sonar_imm.trackers import SYSTEMS

from ..evaluation.judging import Check, Judgement
from ..offline.batch import Job
from ..offline.run_folder import BAG, CSV, RunFolder
from ..offline.tracking import final_estimates, InputOptions
from ..recordings.measurements import instruments
from ..recordings.own_files import LIMIT, own_limit, own_parameters, own_recipe
from ..recordings.reader import BagReader
from ..replay.harness import LockstepResult, run_lockstep
from ..resources import share_folder
from .common import load_config, load_detector, node_file, progress
from .evaluate import evaluate_run
from .track import track_one


@frozen
class CheckedRecording:
    """All checks of one recording, and the judgement of the offline run.

    `folder` holds the runs ``offline`` and ``live``, the latter where the node was there.
    """

    system: str
    bag: Path
    folder: Path
    checks: tuple[Check, ...]
    latency_ms: dict[str, float]
    judgement: Judgement

    @property
    def good(self) -> bool:
        """Whether all checks passed."""
        return all(check.good for check in self.checks)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        return {
            'system': self.system,
            'bag': str(self.bag),
            'good': self.good,
            'checks': [asdict(check) for check in self.checks],
            'latency_ms': self.latency_ms,
        }


@frozen
class PlayedRecording:
    """A recording tracked offline and, unless left out, by the node; `checks` of both against each
    other, and the largest error allowed, None for that of the system."""

    system: str
    bag: Path
    folder: Path
    limit: float | None
    checks: tuple[Check, ...]
    latency_ms: dict[str, float]

    def judged(self) -> CheckedRecording:
        """With the scores of the offline run, and a check of its error where there is a truth."""
        judgement = evaluate_run(self.folder / 'offline')
        accuracy = judgement.accuracy(self.limit)
        checks = self.checks if accuracy is None else (*self.checks, accuracy)
        where = self.system, self.bag, self.folder
        return CheckedRecording(*where, checks, self.latency_ms, judgement)


def shipped_bags(system: str, scratch: Path) -> list[Path]:
    """The recordings of `system` that come with the package.

    An installation has the small ones only (setup.py): where it has none of a system, the first
    is simulated into `scratch`. Raises FileNotFoundError for none, `BagError` without a recipe.
    """
    known = sorted(path for path in (share_folder() / 'bags').glob(f'{system}_*'))
    if not known:
        raise FileNotFoundError(f'no recordings for {system} in {share_folder() / "bags"}')
    installed = [path for path in known if any(path.glob('*.mcap'))]
    return installed or [_simulated(known[0], system, scratch / 'bags')]


def _simulated(folder: Path, system: str, scratch: Path) -> Path:
    """Make the recording that belongs into `folder`, with its limit, below `scratch`."""
    from .simulate import command

    made, recipe = scratch / folder.name, own_recipe(folder)
    command.main([system, str(made), *recipe], standalone_mode=False)
    shutil.copy(folder / LIMIT, made)
    return made


def instruments_in(bag: Path, system: str) -> dict[str, dict[str, str] | None]:
    """The inputs by topic of each instrument in a recording, by its name; None: all there are."""
    with BagReader(bag) as reader:
        found = instruments(reader, system)
    if len(found) == 1:
        return {'': None}
    return {
        instrument: {topic: entry.name for topic, entry in inputs.items()}
        for instrument, inputs in found.items()
    }


def play_recording(
    bag: Path,
    system: str,
    folder: Path,
    *,
    params: Path | None = None,
    limit: float | None = None,
    topics: Mapping[str, str] | None = None,
    quiet: bool,
    live: bool = True,
) -> PlayedRecording:
    """Track `bag` offline and, if `live`, by the node too into `folder`, and compare.

    params: parameter file; None for the one that comes with the recording, if any. limit: largest
    error allowed, in the unit of the system; None for that of the recording, if it states one, or
    else of the system. topics: input by topic name; None for those that fit.
    Raises `BagError`, `ConfigError` and `LinkError`.
    """
    used = params or own_parameters(bag)
    limit = own_limit(bag) if limit is None else limit
    config, node = load_config(SYSTEMS[system], used, {})
    options = InputOptions(
        topics=topics,
        frame_id=node.frame_id,
        world_frame=node.world_frame_convention,
        origin=node.stated_origin(),
        detector=load_detector(SYSTEMS[system], used, {}),
    )
    made_of: dict[str, Any] = {'system': system, 'config': config, 'options': options}
    run = track_one(Job(bag=bag, folder=folder / 'offline', overwrite=True, **made_of), quiet)
    if not live:
        return PlayedRecording(system, bag, folder, limit, (), {})
    with (
        progress('playing to the node', run['messages'], quiet=quiet) as advance,
        node_file(SYSTEMS[system], used) as given,
    ):
        settings: dict[str, Any] = {'settings': config.as_dict(), 'topics': topics}
        played = run_lockstep(bag, system, params_file=given, progress=advance, **settings)
    # In the same form as the offline run.
    with RunFolder(folder / 'live').fresh(overwrite=True) as live_folder:
        live_folder.write_estimates(final_estimates(played.estimates, config), system)
    checks = (_answered(played, run), _equal(folder), _ended(played))
    return PlayedRecording(system, bag, folder, limit, checks, played.latency_ms())


def _answered(live: LockstepResult, run: dict[str, Any]) -> Check:
    taken, refused = live.counts.messages, live.counts.refused
    offline_refused = sum(entry['count'] for entry in run['refused'].values())
    return Check(
        'messages taken / refused by the node',
        f'{taken} / {refused}',
        f'{run["messages"]} / {offline_refused}',
        (taken, refused) == (run['messages'], offline_refused),
    )


def _equal(folder: Path) -> Check:
    """Bag and CSV of both runs, byte for byte; tells how many rows differ when they do."""
    first, second = folder / 'offline', folder / 'live'
    names = sorted(path.name for path in (first / BAG).iterdir())
    files = [Path(CSV), *(Path(BAG) / name for name in names)]
    same = all(
        (second / file).is_file() and (first / file).read_bytes() == (second / file).read_bytes()
        for file in files
    )
    result = 'equal bytes'
    if not same:
        texts = ((path / CSV).read_text(encoding='utf-8') for path in (first, second))
        rows = (text.splitlines() for text in texts)
        result = f'{sum(a != b for a, b in zip_longest(*rows))} rows differ'
    return Check('estimates of the node against offline', result, 'equal bytes', same)


def _ended(live: LockstepResult) -> Check:
    clean = live.exit_code == 0 and 'Traceback' not in live.log
    return Check(
        'end of the node after Ctrl-C',
        f'exit code {live.exit_code}{"" if clean else ", see its log"}',
        'exit code 0',
        clean,
    )
