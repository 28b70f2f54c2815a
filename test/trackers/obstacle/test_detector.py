"""Echoes in images: where they are, the strongest first, and none where the vehicle is."""

import numpy as np
import pytest

from sonar_imm.measurements import SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig

BEARINGS = np.radians(np.linspace(20.0, -20.0, 41))  # port first
RANGES = 2.0 + 0.25 * np.arange(120)
ECHOES = {(40, 5): 200.0, (90, 33): 120.0}


def image(**changes):
    rng = np.random.default_rng(5)
    amplitude = np.round(4.0 * np.sqrt(rng.exponential(size=(len(RANGES), len(BEARINGS)))))
    for place, strength in ECHOES.items():
        amplitude[place] = strength
    values = {'range': RANGES, 'bearing': BEARINGS, 'amplitude': amplitude, **changes}
    return SonarImage(stamp_ns=5, frame_id='sonar', **values)


def test_echoes_are_found_where_they_are():
    found = detect(image(), DetectorConfig())
    assert (found.stamp_ns, found.frame_id) == (5, 'sonar')
    assert found.range.tolist() == [RANGES[40], RANGES[90]]
    assert found.bearing.tolist() == [BEARINGS[5], BEARINGS[33]]
    assert found.intensity.tolist() == [200.0, 120.0]


def test_the_vehicle_is_no_obstacle_and_the_strongest_come_first():
    assert detect(image(), DetectorConfig(min_range=15.0)).range.tolist() == [RANGES[90]]
    assert detect(image(), DetectorConfig(max_detections=1)).intensity.tolist() == [200.0]


@pytest.mark.parametrize('name, place', [('range', 40), ('bearing', 5)])
def test_an_echo_without_a_place_is_left_out(name, place):
    axis = (RANGES if name == 'range' else BEARINGS).copy()
    axis[place] = np.nan
    assert detect(image(**{name: axis}), DetectorConfig()).intensity.tolist() == [120.0]


def test_an_image_of_noise_alone_is_a_ping_without_echoes():
    noise = np.random.default_rng(6).exponential(size=(len(RANGES), len(BEARINGS)))
    assert len(detect(image(amplitude=np.sqrt(noise)), DetectorConfig())) == 0


def test_what_the_reader_is_told_are_parameters_of_the_detector():
    config = DetectorConfig(image_order='beam_major', beam_axes='marine', sound_speed=1480.0)
    assert config.reading() == {
        'image_order': 'beam_major',
        'beam_axes': 'marine',
        'sound_speed': 1480.0,
    }
