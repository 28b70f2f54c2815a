"""What the tracker has to be told of envelopes, such as sub-bottom profilers record.

An envelope has the pulse of an envelope, is never negative, and stands in the volume scatter of the
floor. How wide the pulse is and what noise there is depend on the instrument; the rest is common.
"""

from __future__ import annotations

from typing import Any

DECAYS = (2.0, 4.0, 8.0, 16.0)
"""Depths, m, over which the scatter may fall to 1/e: silt with gas to sand."""


def envelope_parameters(pulse_width: float, noise_sigma: float) -> dict[str, Any]:
    """Parameters of the tracker by name, for a pulse of standard deviation `pulse_width`, m, and
    noise of `noise_sigma`, in the units of the record."""
    return {
        'pulse': 'gaussian',
        'pulse_width': pulse_width,
        'noise_sigma': noise_sigma,
        'scatter_decay': DECAYS,
        # Two pulses nearer than that make one hump.
        'min_separation': 3.0 * pulse_width,
        # Records come several a second and the floor slopes; 1.4 m a record can be followed.
        'depth_std': 0.35,
        'order_max': 6,
    }
