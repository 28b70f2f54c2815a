"""The trackers: one folder per system. `SYSTEMS` says what exists; importing it does not load a
tracker."""

from __future__ import annotations

from collections import Counter
from importlib import import_module
from typing import Any, Protocol

from attrs import frozen

from ..estimates import Estimate
from ..parameters import Config, ConfigError


class Tracker(Protocol):
    """The only door to a tracker. `process` has no side effect outside the tracker: no log, no
    clock, no global state.

    counts: what happened to the input, by reason code (``used``, ``gated``, ``duplicate``,
    ``too_late``, ...).
    """

    config: Any
    counts: Counter[str]

    def process(self, measurement: Any) -> list[Estimate]:
        """Take one measurement in. Gives the estimates it made or revised, oldest first; the last
        is the newest state.

        Never raises for bad data: what cannot be used is counted in `counts`."""
        ...

    def reset(self) -> None:
        """Forget everything: equals a fresh tracker."""
        ...

    def reconfigure(self, config: Any) -> None:
        """Take over the parameters that may change while running; keeps the tracks."""
        ...

    def warm(self) -> None:
        """Compile or load every kernel the first measurement would need."""
        ...

    def health(self) -> dict[str, float]:
        """Numbers for diagnostics: NIS, effective sample size, covariance repairs, tracks, ..."""
        ...


class SmoothingTracker(Tracker, Protocol):
    """A tracker that remembers a whole recording."""

    def smoothed(self) -> list[Estimate]:
        """The estimates of all stamps, oldest first, each given all measurements."""
        ...


@frozen
class System:
    """A tracker by name. Strings name the modules so that listing systems stays fast."""

    name: str
    module: str
    config_class: str
    tracker_class: str
    summary: str
    smoother: str = ''

    def config_type(self) -> type[Config]:
        return getattr(import_module(self.module), self.config_class)

    def build(self, config: Config) -> Tracker:
        return getattr(import_module(self.module), self.tracker_class)(config)

    def build_smoother(self, config: Config) -> SmoothingTracker:
        """The tracker that can look back at the end of a recording.

        Raises `ConfigError` when the system has none."""
        if not self.smoother:
            raise ConfigError(f'the {self.name} tracker has no smoother')
        module, _, name = self.smoother.rpartition('.')
        return getattr(import_module(module), name)(config)


SYSTEMS = {
    'bathymetry': System(
        'bathymetry',
        'sonar_imm.trackers.bathymetry.tracker',
        'BathymetryConfig',
        'BathymetryTracker',
        'sea floor from side-scan array snapshots, IMM particle filter along each ping',
    ),
    'diver': System(
        'diver',
        'sonar_imm.trackers.diver.tracker',
        'DiverConfig',
        'DiverTracker',
        'divers from multistatic fixes or raw arrival times, 16-direction IMM',
        smoother='sonar_imm.trackers.diver.smoothing.SmoothingDiverTracker',
    ),
    'fathometer': System(
        'fathometer',
        'sonar_imm.trackers.fathometer.tracker',
        'FathometerConfig',
        'FathometerTracker',
        'sub-bottom reflectors from array noise or traces, multiple-model particle filter',
    ),
    'obstacle': System(
        'obstacle',
        'sonar_imm.trackers.obstacle.tracker',
        'ObstacleConfig',
        'ObstacleTracker',
        'obstacles ahead of a vehicle with their height, from a forward-looking sonar and '
        'navigation, Gaussian sum over depth',
    ),
}
