"""What a tracker takes in: frozen values in SI units and radians, stamps in integer nanoseconds.

A measurement that cannot be used is never built: its class raises `Rejection`, which carries a
reason code to count and one sentence to show. The classes know nothing of ROS; `msg_adapters`
makes them from messages.
"""

from __future__ import annotations

from typing import Any

from attrs import field, frozen
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Rejection(ValueError):
    """Input that cannot be used: `reason` is a short code for counters (``'nan'``), `sentence`
    tells the user."""

    def __init__(self, reason: str, sentence: str):
        self.reason = reason
        self.sentence = sentence
        super().__init__(sentence)


def _floats(*shape: int | None) -> Any:
    """Converter to a read-only float64 array; a None in `shape` matches any length."""

    def convert(value: Any) -> FloatArray:
        array = np.array(value, dtype=np.float64)
        if len(shape) != array.ndim or any(
            want not in (None, got) for want, got in zip(shape, array.shape)
        ):
            raise Rejection('bad_shape', f'an array of shape {shape} is needed, got {array.shape}')
        array.flags.writeable = False
        return array

    return convert


def _ids(value: Any) -> NDArray[np.uint16]:
    array = np.array(value, dtype=np.uint16)
    array.flags.writeable = False
    return array


def check_stamp(stamp_ns: int) -> None:
    """Raise `Rejection` for a stamp that is zero (never filled in), negative, or beyond the year
    2262."""
    if not 0 < stamp_ns < 2**63:
        raise Rejection(
            'bad_stamp', f'the header stamp is {stamp_ns} ns; the sensor driver has to fill it in'
        )


def check_covariance(covariance: FloatArray, what: str) -> None:
    """Raise `Rejection` unless `covariance` (n, n) is finite, symmetric and positive definite."""
    if not np.isfinite(covariance).all():
        raise Rejection('nan', f'the covariance of {what} is not finite')
    scale = float(np.abs(covariance).max())
    if not np.allclose(covariance, covariance.T, rtol=0.0, atol=1e-6 * scale):
        raise Rejection('bad_covariance', f'the covariance of {what} is not symmetric')
    if scale <= 0.0 or np.linalg.eigvalsh(covariance)[0] <= 1e-12 * scale:
        raise Rejection('bad_covariance', f'the covariance of {what} is not positive definite')


@frozen(eq=False, kw_only=True)
class Fix:
    """A position found elsewhere: multistatic fusion, USBL, GPS.

    position: (3,) x, y, z in `frame_id`, metres (ENU by default; z may be 0).
    covariance: (2, 2) of x and y in m^2, or None when the sender does not know it.
    """

    stamp_ns: int
    position: FloatArray = field(converter=_floats(3))
    covariance: FloatArray | None = None
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.position[:2]).all():
            raise Rejection('nan', 'the fix has a position that is not finite')
        if np.abs(self.position[:2]).max() > 1e8:
            raise Rejection(
                'out_of_range',
                f'the fix lies at {self.position[:2]}, further than 100,000 km from the origin',
            )
        if self.covariance is not None:
            covariance = _floats(2, 2)(self.covariance)
            check_covariance(covariance, 'a fix')
            object.__setattr__(self, 'covariance', covariance)


@frozen(eq=False, kw_only=True)
class Arrivals:
    """Arrival times of one ping, one row a transmitter-receiver pair.

    toa: (n,) seconds after the stamp. With a known transmitter (`tx` finite) the stamp is the
    transmission and the path is transmitter - target - receiver. With `tx` NaN the target itself
    emits at an unknown time near the stamp (an acoustic tag) and only differences between
    receivers carry information. tx, rx: (n, 3) metres in `frame_id`; var_toa: (n,) s^2, NaN where
    unknown; bearing: (n,) rad at the receiver, counter-clockwise from +x, NaN where not measured;
    var_bearing: (n,) rad^2.
    """

    stamp_ns: int
    tx_id: NDArray[np.uint16] = field(converter=_ids)
    rx_id: NDArray[np.uint16] = field(converter=_ids)
    tx: FloatArray = field(converter=_floats(None, 3))
    rx: FloatArray = field(converter=_floats(None, 3))
    toa: FloatArray = field(converter=_floats(None))
    var_toa: FloatArray = field(converter=_floats(None))
    bearing: FloatArray = field(converter=_floats(None))
    var_bearing: FloatArray = field(converter=_floats(None))
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        n = len(self.toa)
        for name in ('tx_id', 'rx_id', 'tx', 'rx', 'var_toa', 'bearing', 'var_bearing'):
            if len(getattr(self, name)) != n:
                raise Rejection(
                    'bad_shape',
                    f'arrivals: {name} has {len(getattr(self, name))} rows, toa has {n}',
                )
        if not np.isfinite(self.rx).all():
            raise Rejection('nan', 'arrivals: a receiver position is not finite')

    def __len__(self) -> int:
        return len(self.toa)

    @property
    def passive(self) -> bool:
        """True when the target itself emits, at an unknown time."""
        return len(self) > 0 and bool(np.isnan(self.tx).all())


@frozen(eq=False, kw_only=True)
class Detections:
    """What a forward-looking sonar saw in one ping, one row an echo; none is a ping too.

    The stamp is the transmission. range: (n,) metres; bearing: (n,) rad, REP-103: positive to
    port; var_range: (n,) m^2 and var_bearing: (n,) rad^2, NaN where the sender does not know them;
    intensity: (n,), NaN where unknown. Columns left out are unknown. A row without a finite range
    and bearing is no echo.
    """

    stamp_ns: int
    range: FloatArray = field(converter=_floats(None))
    bearing: FloatArray = field(converter=_floats(None))
    var_range: FloatArray | None = None
    var_bearing: FloatArray | None = None
    intensity: FloatArray | None = None
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        for name in ('var_range', 'var_bearing', 'intensity'):
            given = getattr(self, name)
            column = np.full(len(self.range), np.nan) if given is None else given
            object.__setattr__(self, name, _floats(None)(column))
        for name in ('bearing', 'var_range', 'var_bearing', 'intensity'):
            rows = len(getattr(self, name))
            if rows != len(self):
                raise Rejection(
                    'bad_shape', f'detections: {name} has {rows} rows, range has {len(self)}'
                )

    def __len__(self) -> int:
        return len(self.range)


@frozen(eq=False, kw_only=True)
class Navigation:
    """Where the vehicle was: its pose in the world and its velocity in its own frame.

    position: (3,) metres and orientation: (4,) quaternion x, y, z, w, world from body; velocity:
    (3,) m/s and turn_rate: (3,) rad/s of the body, NaN where unknown. ENU and FLU unless the
    sender keeps another convention. pose_covariance, twist_covariance: (6, 6) or None when
    unknown.
    """

    stamp_ns: int
    position: FloatArray = field(converter=_floats(3))
    orientation: FloatArray = field(converter=_floats(4))
    velocity: FloatArray = field(converter=_floats(3), factory=lambda: np.full(3, np.nan))
    turn_rate: FloatArray = field(converter=_floats(3), factory=lambda: np.full(3, np.nan))
    pose_covariance: FloatArray | None = None
    twist_covariance: FloatArray | None = None
    frame_id: str = ''
    child_frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not (np.isfinite(self.position).all() and np.isfinite(self.orientation).all()):
            raise Rejection('nan', 'the navigation has a pose that is not finite')
        if np.abs(self.position).max() > 1e8:
            raise Rejection(
                'out_of_range', 'the vehicle lies further than 100,000 km from the origin'
            )
        length = float(np.linalg.norm(self.orientation))
        if abs(length - 1.0) > 0.01:
            raise Rejection(
                'bad_orientation',
                f'the orientation is a quaternion of length {length:.3g}, not 1',
            )
        for name in ('pose_covariance', 'twist_covariance'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _floats(6, 6)(getattr(self, name)))


@frozen(eq=False, kw_only=True)
class Altitude:
    """How high above the sea floor the vehicle was, metres; variance m^2, NaN when unknown."""

    stamp_ns: int
    altitude: float
    variance: float = float('nan')
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.altitude):
            raise Rejection('nan', 'the altitude is not finite')
        if self.altitude < 0.0:
            raise Rejection('out_of_range', f'the altitude is {self.altitude:g} m, below zero')


Measurement = Fix | Arrivals | Detections | Navigation | Altitude
