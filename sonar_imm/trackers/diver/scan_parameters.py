"""Parameters of scans of fixes: how fixes and tracks are paired."""

from __future__ import annotations

from attrs import frozen

from ...parameters import Config, parameter

ASSOCIATIONS = ('gnn', 'jipda')


@frozen(kw_only=True, slots=False)
class ScanParameters(Config):
    """How the fixes of a scan and the tracks find each other."""

    association: str = parameter(
        'gnn',
        'gnn: the one most likely pairing, tracks confirmed by hits; jipda: all pairings weighed, '
        'tracks confirmed by their probability of existence, for divers that cross in clutter',
        choices=ASSOCIATIONS,
    )
    birth_density: float = parameter(
        1.2e-5,
        'jipda: new divers expected in a scan, for each square metre',
        unit='1/m^2',
        low=1e-12,
        high=1.0,
        read_only=False,
    )
    survival_time: float = parameter(
        500.0,
        'jipda: time for which a diver is expected to stay',
        unit='s',
        low=1.0,
        high=1e7,
        read_only=False,
    )
