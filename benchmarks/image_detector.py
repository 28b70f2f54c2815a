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
detector. `margins` are false detections by `threshold_margin_db` on images of other seeds than
those that are scored, so that the margin can be chosen on images it is not scored on.
`--parts` makes some of the tables only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections, SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig
from sonar_imm_tools.simulation.obstacle.images import ImageSonar
from sonar_imm_tools.simulation.obstacle.scenario import ObstacleScenario

DEPTH = 20.0
LEVEL = Pose(np.array([0.0, 0.0, DEPTH]), np.eye(3))
DETECTORS = {
    'as it is': DetectorConfig(),
    'without the margin': DetectorConfig(threshold_margin_db=0.0),
}
FLOORS = {
    'Rayleigh': (1000.0, 1.0),
    'K 4': (4.0, 1.0),
    'K 1.5': (1.5, 1.0),
    'K 1.5, patches of 5 m': (1.5, 5.0),
}
"""Shape of the power of patches of the sea floor, and their side in metres."""
MARGINS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
CHOSEN_ON, SCORED_ON = 101, 1
"""Seeds of the images without a target."""
LEVELS = (12.0, 15.0, 18.0, 21.0)
FADINGS = ('steady', 'rayleigh')
NEAR = 2.0
PARTS = (
    'several targets',
    'margins',
    'false detections per image',
    'found',
)


def image(sonar: ImageSonar, places: list[np.ndarray]) -> SonarImage:
    return SonarImage(
        stamp_ns=1,
        range=sonar.range,
        bearing=sonar.bearing,
        amplitude=sonar.image(LEVEL, places, 1.0).astype(float),
    )


def scene(**values: Any) -> ObstacleScenario:
    return ObstacleScenario(**{'images': True, 'altitude': 6.0, 'depth': DEPTH, **values})


def false_alarms(
    images: int, detectors: dict[str, DetectorConfig], seed: int
) -> dict[str, dict[str, float]]:
    """Detections per image without a target."""
    table: dict[str, dict[str, float]] = {}
    for floor, (shape, patch) in FLOORS.items():
        counts: dict[str, list[int]] = {}
        for number in range(images):
            # The rough spots of the sea floor are others in every image.
            rng = np.random.default_rng([seed, number])
            sonar = ImageSonar(scene(seabed_shape=shape, seabed_patch=patch), rng)
            picture = image(sonar, [])
            for name, detector in detectors.items():
                counts.setdefault(name, []).append(len(detect(picture, detector)))
        for name, each in counts.items():
            table.setdefault(name, {})[floor] = float(np.mean(each))
    return table


def found(runs: int) -> dict[str, dict[str, list[float]]]:
    """Share of images in which a point is found; it lies before the onset of the sea floor."""
    table: dict[str, dict[str, list[float]]] = {}
    for fading in FADINGS:
        for level in LEVELS:
            values = {'target_fading': fading, 'target_snr_db': level, 'altitude': 5000.0}
            rng = np.random.default_rng(2)
            sonar = ImageSonar(scene(**values), rng)
            hits = dict.fromkeys(DETECTORS, 0)
            for _ in range(runs):
                r, b = rng.uniform(25.0, 90.0), rng.uniform(-0.3, 0.3)
                picture = image(sonar, [place(r, b)])
                for name, config in DETECTORS.items():
                    hits[name] += bool(near(detect(picture, config), r, b).any())
            for name in DETECTORS:
                table.setdefault(name, {}).setdefault(fading, []).append(hits[name] / runs)
    return table


def place(r: float, b: float) -> np.ndarray:
    """NED of a point level with the sonar."""
    return np.array([r * np.cos(b), -r * np.sin(b), DEPTH])


def near(ping: Detections, r: float, b: float, reach: float = NEAR) -> np.ndarray:
    return np.hypot(ping.range - r, (ping.bearing - b) * r) < reach


def several_targets(scenes: int) -> dict[str, Any]:
    """Points, chains across and along the line of sight and a float over a K sea floor: detections
    of each, and false ones."""
    kinds = (
        ('point', 20.0),
        ('point', 19.0),
        ('point', 35.0),
        ('chain across', 20.0),
        ('float', 21.0),
        ('chain along', 20.0),
    )
    sizes = {'point': 0.0, 'chain': 6.0, 'float': 1.0}
    counts: dict[str, list[int]] = {}
    false = 0
    for seed in range(scenes):
        rng = np.random.default_rng([4, seed])
        base = ImageSonar(scene(), rng)
        total = image(base, []).amplitude * np.exp(
            2j * np.pi * rng.uniform(size=(len(base.range), len(base.bearing)))
        )
        spots = []
        for k, (kind, level) in enumerate(kinds):
            r, b = rng.uniform(26.0, 34.0) + 11.0 * k, rng.uniform(-0.3, 0.3)
            target = kind.split()[0]
            values = {'target': target, 'target_snr_db': level, 'target_size': sizes[target]}
            config = scene(**values)
            sonar = ImageSonar(config, rng)
            sonar.heading = (0.5 * np.pi if kind.endswith('across') else 0.0) - b
            mean = base.mean_power(LEVEL)
            echo = sonar.echo(LEVEL, place(r, b), 1.0, mean)
            if target != 'point':  # as in the study, the level is that of the loudest glint
                around = mean[np.argmin(np.abs(base.range - r))].mean()
                echo = echo * np.sqrt(10.0 ** (0.1 * level) * around) / np.abs(echo).max()
            total = total + config.image_gain * echo
            spots.append((f'{kind} {level:g} dB', r, b, NEAR + 0.5 * sizes[target]))
        picture = np.minimum(np.round(np.abs(total)), 255.0)
        ping = detect(
            SonarImage(stamp_ns=1, range=base.range, bearing=base.bearing, amplitude=picture),
            DetectorConfig(),
        )
        hit = np.zeros(len(ping), bool)
        for name, r, b, reach in spots:
            own = near(ping, r, b, reach)
            counts.setdefault(name, []).append(int(own.sum()))
            hit |= own
        false += int((~hit).sum())
    return {
        'scenes': scenes,
        'found': {name: float(np.mean(np.array(each) > 0)) for name, each in counts.items()},
        'detections': {name: float(np.mean(each)) for name, each in counts.items()},
        'false per image': false / scenes,
    }


def main(
    runs: int = 120, images: int = 24, scenes: int = 20, parts: Sequence[str] = PARTS
) -> Parts:
    yield {'images': images, 'runs': runs, 'snr_db': LEVELS}
    margins = {f'{margin:g} dB': DetectorConfig(threshold_margin_db=margin) for margin in MARGINS}
    made: tuple[Callable[[], Any], ...] = (
        lambda: several_targets(scenes),
        lambda: false_alarms(images, margins, CHOSEN_ON),
        lambda: false_alarms(images, DETECTORS, SCORED_ON),
        lambda: found(runs),
    )
    for name, make in zip(PARTS, made):
        if name in parts:
            yield {name: make()}


if __name__ == '__main__':
    study(
        main,
        runs={'help': 'images for each SNR'},
        images={'help': 'images for false alarms'},
        scenes={'help': 'scenes of several targets'},
        parts={'choices': PARTS},
    )
