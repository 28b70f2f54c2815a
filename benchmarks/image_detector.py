# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the detector of images finds, misses and invents.

    python -m benchmarks.image_detector --out docs/results/image_detector.json

Images are those of the simulated sonar (256 beams, 600 ranges), which knows nothing of the
detector; its margin was chosen on images of other seeds. `found`: share of the images with a point
at 25 to 90 m in which it is found within 2 m, by its level in dB and its fading, before the onset
of the sea floor. `false detections per image`: without a target, by the shape of the power of
patches of the sea floor and their side.
"""

from __future__ import annotations

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig
from sonar_imm_tools.simulation.obstacle.images import ImageSonar
from sonar_imm_tools.simulation.obstacle.scenario import ObstacleScenario

DEPTH, NEAR = 20.0, 2.0
LEVEL = Pose(np.array([0.0, 0.0, DEPTH]), np.eye(3))
FLOORS = {
    'Rayleigh': (1000.0, 1.0),
    'K 4': (4.0, 1.0),
    'K 1.5': (1.5, 1.0),
    'K 1.5, patches of 5 m': (1.5, 5.0),
}
LEVELS, FADINGS = (12.0, 15.0, 18.0, 21.0), ('steady', 'rayleigh')


def image(sonar: ImageSonar, places: list[np.ndarray]) -> SonarImage:
    return SonarImage(
        stamp_ns=1,
        range=sonar.range,
        bearing=sonar.bearing,
        amplitude=sonar.image(LEVEL, places, 1.0).astype(float),
    )


def scene(**values: float | str) -> ObstacleScenario:
    return ObstacleScenario.from_mapping(
        {'images': True, 'altitude': 6.0, 'depth': DEPTH, **values}
    )


def false_alarms(floor: str, images: int) -> float:
    """Detections per image without a target; the rough spots are others in every image."""
    shape, patch = FLOORS[floor]
    count = 0
    for number in range(images):
        rng = np.random.default_rng([1, number])
        sonar = ImageSonar(scene(seabed_shape=shape, seabed_patch=patch), rng)
        count += len(detect(image(sonar, []), DetectorConfig()))
    return count / images


def found(fading: str, level: float, runs: int) -> float:
    rng, hits = np.random.default_rng(2), 0
    config = scene(target_fading=fading, target_snr_db=level, altitude=5000.0)
    sonar = ImageSonar(config, rng)
    for _ in range(runs):
        r, b = rng.uniform(25.0, 90.0), rng.uniform(-0.3, 0.3)
        place = np.array([r * np.cos(b), -r * np.sin(b), DEPTH])  # NED, level with the sonar
        ping = detect(image(sonar, [place]), DetectorConfig())
        hits += bool((np.hypot(ping.range - r, (ping.bearing - b) * r) < NEAR).any())
    return hits / runs


def main(runs: int = 120, images: int = 24) -> Parts:
    yield {'images': images, 'runs': runs}
    for fading in FADINGS:
        row = {f'{level:g} dB': found(fading, level, runs) for level in LEVELS}
        yield {'found': {fading: row}}
    yield {
        'false detections per image': {
            'without a target': {floor: false_alarms(floor, images) for floor in FLOORS}
        }
    }


if __name__ == '__main__':
    study(
        main,
        runs={'help': 'images for each level'},
        images={'help': 'images for false alarms'},
    )
