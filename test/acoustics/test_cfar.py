"""CFAR: the rate of false alarms it promises, and echoes where they are."""

import numpy as np
import pytest

from sonar_imm.acoustics.cfar import cfar_peaks, noise_level


def noise(shape, seed=0, level=1.0):
    rng = np.random.default_rng(seed)
    return level * np.sqrt(rng.exponential(size=shape))


def test_the_noise_level_is_that_of_a_loop():
    power = noise((30, 3)) ** 2
    mean, count = noise_level(power, guard=1, training=4)
    for row in range(30):
        cells = [k for k in range(30) if 1 < abs(k - row) <= 5]
        assert count[row] == len(cells)
        assert mean[row] == pytest.approx(power[cells].mean(axis=0))


@pytest.mark.parametrize('level', [1e-3, 1.0, 1e5])
def test_false_alarms_come_as_often_as_promised_at_any_level(level):
    image = noise((4000, 100), level=level)
    found = cfar_peaks(image, guard=0, training=16, false_alarm=1e-3)
    inner = found[(found[:, 0] >= 16) & (found[:, 0] < 4000 - 16)]
    assert len(inner) == pytest.approx(1e-3 * 3968 * 100, rel=0.15)


def test_echoes_are_found_once_each_and_strongest_first():
    image = noise((200, 60), seed=3)
    for row, beam, strength in ((40, 10, 30.0), (120, 50, 60.0), (5, 30, 40.0)):
        image[row, beam] = strength
        image[row + 1, beam] = image[row, beam + 1] = 0.8 * strength  # wider than a cell
    assert cfar_peaks(image, false_alarm=1e-8).tolist() == [[120, 50], [5, 30], [40, 10]]


@pytest.mark.parametrize(
    'image',
    [
        np.zeros((50, 5)),
        np.full((50, 5), 7.0),
        np.empty((0, 5)),
        np.full((50, 5), np.nan),
        np.full((50, 5), np.inf),
        np.ones((1, 1)),
    ],
)
def test_nothing_is_found_where_nothing_is(image):
    assert cfar_peaks(image).shape == (0, 2)


def test_only_images_are_taken():
    with pytest.raises(ValueError, match=r'\(R, B\)'):
        cfar_peaks(np.ones(5))
