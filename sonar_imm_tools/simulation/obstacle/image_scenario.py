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

TARGETS = ('point', 'chain', 'float')
FADINGS = ('steady', 'rayleigh')


@frozen(kw_only=True, slots=False)
class ImageScenario(Scenario):
    """What images show besides where obstacles are; the defaults are those of a Blueview P450 that
    looks at moored spheres."""

    images: bool = parameter(
        False, 'the sonar sends images, in which a detector has to find the obstacles'
    )
    image_beams: int = parameter(256, 'beams of an image', low=2, high=4096)
    image_bins: int = parameter(600, 'ranges of an image', low=2, high=10_000)
    image_gain: float = parameter(
        4.0, 'counts for the amplitude of the noise; images hold 0 to 255', low=0.01, high=255.0
    )
    beam_width_deg: float = parameter(
        1.0, '-3 dB width of a beam, of the power received', unit='deg', low=0.01, high=30.0
    )
    sidelobe_db: float = parameter(
        20.0, 'how far the sidelobes of a beam lie below it', unit='dB', low=14.0, high=80.0
    )
    pulse_length: float = parameter(
        0.3, '-3 dB width of the echo of a point in range', unit='m', low=0.001, high=10.0
    )
    target: str = parameter(
        'point',
        'what obstacles are: a point, a chain of 60 glints along a level line, a float of 10',
        choices=TARGETS,
    )
    target_size: float = parameter(
        6.0, 'length of a chain or diameter of a float', unit='m', low=0.0, high=100.0
    )
    target_snr_db: float = parameter(
        18.0,
        'peak power of an echo on the axis of the sonar over the mean power around it',
        unit='dB',
        low=-20.0,
        high=80.0,
    )
    target_fading: str = parameter(
        'steady', 'whether a point is as strong in every ping; glints never are', choices=FADINGS
    )
    reverberation: float = parameter(
        30.0,
        'power scattered back by the water at 10 m, over that of the noise; falls with the square '
        'of the range',
        low=0.0,
        high=1e6,
    )
    seabed_power_db: float = parameter(
        10.0,
        'mean power of the sea floor where the edge of the beam meets it, over that of the noise',
        unit='dB',
        low=-100.0,
        high=60.0,
    )
    seabed_shape: float = parameter(
        4.0,
        'shape of the gamma distribution of the power of its patches: the smaller, the rougher',
        low=0.1,
        high=1000.0,
    )
    seabed_patch: float = parameter(
        1.0, 'side of a patch of the sea floor', unit='m', low=0.01, high=1000.0
    )

    def told_feeder(self) -> dict[str, Any]:
        """What `fls_detector_node` has to be told of the images. The scene that is built on this
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
