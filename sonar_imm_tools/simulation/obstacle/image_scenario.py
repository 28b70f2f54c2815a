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

"""Parameters of the images of a simulated forward-looking sonar."""

from __future__ import annotations

from typing import Any

from attrs import frozen

from sonar_imm.parameters import parameter

from ..scenario import Scenario

TARGETS = ('point', 'chain', 'float', 'wreck')
FADINGS = ('steady', 'rayleigh')


@frozen(kw_only=True, slots=False)
class ImageScenario(Scenario):
    """What images show besides where obstacles are; the defaults are those of a Blueview P450 that
    looks at moored spheres."""

    # fmt: off
    images: bool = parameter(False, '',
        'whether the sonar sends images, in which a detector has to find the obstacles')
    image_beams: int = parameter(256, '', 'number of beams of an image', range=(2, 4096))
    image_bins: int = parameter(600, '', 'number of ranges of an image', range=(2, 10_000))
    image_gain: float = parameter(4.0, '',
        'counts of an image for the amplitude of the noise; images hold 0 to 255',
        range=(0.01, 255.0))
    beam_width_deg: float = parameter(1.0, 'deg',
        '-3 dB width of a beam, of the power received', range=(0.01, 30.0))
    sidelobe_db: float = parameter(20.0, 'dB',
        'level of the sidelobes of a beam below its maximum', range=(14.0, 80.0))
    pulse_length: float = parameter(0.3, 'm',
        '-3 dB width of the echo of a point in range', range=(0.001, 10.0))
    target: str = parameter('point', '',
        'what obstacles are: a point, a chain of 60 glints along a level line, a float of 10 '
        'glints, or the outline of a wreck of 80 glints', choices=TARGETS)
    target_size: float = parameter(6.0, 'm',
        'length of a chain or wreck, or diameter of a float', range=(0.0, 100.0))
    target_snr_db: float = parameter(18.0, 'dB',
        'peak power of an echo on the axis of the sonar over the mean power around it',
        range=(-20.0, 80.0))
    target_fading: str = parameter('steady', '',
        'target point: whether the echo is as strong in every ping (steady) or fades (rayleigh); '
        'glints always fade', choices=FADINGS)
    reverberation: float = parameter(30.0, '',
        'power scattered back by the water at 10 m, relative to the noise; falls with the square '
        'of the range', range=(0.0, 1e6))
    seabed_power_db: float = parameter(10.0, 'dB',
        'mean power of the sea floor where the edge of the beam meets it, relative to the noise',
        range=(-100.0, 60.0))
    seabed_shape: float = parameter(4.0, '',
        'shape of the gamma distribution of the power of the patches of the sea floor: the '
        'smaller, the rougher', range=(0.1, 1000.0))
    seabed_patch: float = parameter(1.0, 'm',
        'side of a patch of the sea floor', range=(0.01, 1000.0))
    # fmt: on

    def feeder_instruments(self) -> dict[str, Any]:
        """What `fls_detector_node` has to know of the images. The scene that is built on this
        class has the range and the sector."""
        if not self.images:
            return {}
        return {
            'image_near_range': 0.0,
            'image_far_range': self.max_range,  # type: ignore[attr-defined]
            'image_fov_deg': self.horizontal_fov_deg,  # type: ignore[attr-defined]
            'beam_width_deg': self.beam_width_deg,
            'range_resolution': self.pulse_length,
        }
