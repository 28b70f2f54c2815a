# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A detector of images by a test of goodness of fit, as the obstacle paper has one, beside ours.

    python -m benchmarks.goodness_of_fit --out docs/results/goodness_of_fit.json

The paper's detections come from "a goodness-of-fit test", described in an earlier paper that we do
not have; which test it is, is not said. Here are the two usual ones. Both ask whether the cells of
a window as large as the echo of a point are a sample of the noise around it, whose power is
exponentially distributed (Rayleigh amplitudes) with the level that our detector finds. Under that
hypothesis u = exp(-power / level) is uniform, and small where it is loud:

    Kolmogorov-Smirnov    D = max over q of (share of u < q) - q
    Pearson               X = sum over classes of (share - expected)^2 / expected, where more
                          than expected is loud

Cells of an image are not independent, so that tables of these tests do not hold. The thresholds
are the greatest D and X in `images` images of Rayleigh noise (seeds from 201); what is above them
in other images, joined where it touches, are detections.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import label, uniform_filter

from benchmarks.image_detector import FLOORS, image, LEVELS, place, scene
from benchmarks.study import Parts, study
from sonar_imm.acoustics.cfar import quiet_level
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import SonarImage
from sonar_imm.trackers.obstacle.detector import DetectorConfig
from sonar_imm_tools.simulation.obstacle.images import ImageSonar

WINDOW = (3, 7)
"""Rows and beams: the -3 dB widths of the echo of a point are 1.8 and 5.7."""
TAILS = np.geomspace(1e-4, 0.5, 16)
CLASSES = (0.0, 1e-6, 1e-4, 0.01, 0.1, 0.3, 1.0)
"""Were all as probable, a whole window of noise would be in the loudest class now and then, and
nothing could be above that."""
FIRST, OTHERS = 201, 301
NEAR = 2.0


def uniform(picture: SonarImage) -> FloatArray:
    """u (R, B); 1 where no level of the noise is known."""
    rules, power = DetectorConfig().rules(), np.square(picture.amplitude)
    level, *_ = quiet_level(power, beams=rules.beams, training=rules.training, guard=rules.guard)
    known = np.isfinite(level) & (level > 0.0)
    return np.where(known, np.exp(-power / np.where(known, level, 1.0)), 1.0)


def share(inside: BoolArray) -> FloatArray:
    """Of the cells of the window around each, (R, B)."""
    return np.asarray(uniform_filter(inside.astype(np.float64), WINDOW, mode='nearest'))


def kolmogorov_smirnov(u: FloatArray) -> FloatArray:
    """D (R, B)."""
    return np.asarray(np.max([share(u < tail) - tail for tail in TAILS], axis=0))


def pearson(u: FloatArray) -> FloatArray:
    """X (R, B)."""
    total = np.zeros(u.shape)
    for low, high in zip(CLASSES, CLASSES[1:]):
        over = share((u >= low) & (u < high)) - (high - low)
        total += np.square(over) / (high - low)
    louder = share(u < CLASSES[-2]) > CLASSES[-2]
    return np.where(louder, total, 0.0)


TESTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    'Kolmogorov-Smirnov': kolmogorov_smirnov,
    'Pearson': pearson,
}


def empty(floor: str, seed: int) -> FloatArray:
    """u of an image without a target."""
    shape, patch = FLOORS[floor]
    sonar = ImageSonar(
        scene(seabed_shape=shape, seabed_patch=patch), np.random.default_rng([seed, 0])
    )
    return uniform(image(sonar, []))


def found(thresholds: dict[str, float], fading: str, snr_db: float, runs: int) -> dict[str, float]:
    """Share of images in which a point is found, before the onset of the sea floor."""
    rng = np.random.default_rng(2)
    sonar = ImageSonar(scene(target_fading=fading, target_snr_db=snr_db, altitude=5000.0), rng)
    hits = dict.fromkeys(TESTS, 0)
    for _ in range(runs):
        r, b = rng.uniform(25.0, 90.0), rng.uniform(-0.3, 0.3)
        u = uniform(image(sonar, [place(r, b)]))
        near = np.hypot(sonar.range[:, None] - r, (sonar.bearing - b) * r) < NEAR
        for name, test in TESTS.items():
            hits[name] += bool((test(u)[near] > thresholds[name]).any())
    return {name: count / runs for name, count in hits.items()}


def main(images: int = 24, runs: int = 40) -> Parts:
    yield {'images': images, 'runs': runs}
    noise = [empty('Rayleigh', FIRST + number) for number in range(images)]
    thresholds = {name: float(max(test(u).max() for u in noise)) for name, test in TESTS.items()}
    yield {'thresholds': thresholds}
    for floor in FLOORS:
        counts: dict[str, list[int]] = {name: [] for name in TESTS}
        for number in range(images):
            u = empty(floor, OTHERS + number)
            for name, test in TESTS.items():
                counts[name].append(label(test(u) > thresholds[name], np.ones((3, 3)))[1])
        false = {name: {floor: float(np.mean(each))} for name, each in counts.items()}
        yield {'false detections per image': false}
    for fading in ('steady', 'rayleigh'):
        for snr_db in LEVELS:
            for name, often in found(thresholds, fading, snr_db, runs).items():
                yield {'found': {f'{name}, {fading}': {f'{snr_db:g} dB': often}}}


if __name__ == '__main__':
    study(main, runs={'help': 'images for each SNR'}, images={'help': 'images without a target'})
