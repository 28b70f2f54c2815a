"""Input topic of the detector that feeds the obstacle tracker."""

from __future__ import annotations

from sonar_imm.measurements import SonarImage

from ..sonar_images import read_picture, read_projected_image, read_raw_image, write_picture
from ..vendor_images import read_oculus_ping, read_ping360_echo, read_sonoptix_echo
from .topic import InputTopic

TOPICS = (
    InputTopic(
        'image',
        'images of a forward-looking sonar',
        measurement=SonarImage,
        readers={
            'marine_acoustic_msgs/msg/ProjectedSonarImage': read_projected_image,
            'marine_acoustic_msgs/msg/RawSonarImage': read_raw_image,
            'oculus_interfaces/msg/Ping': read_oculus_ping,
            'ping360_sonar_msgs/msg/SonarEcho': read_ping360_echo,
            'sensors/msg/SonoptixECHO': read_sonoptix_echo,
            'sensor_msgs/msg/Image': read_picture,
        },
        write=write_picture,
        one_topic=True,
        makes='detections',
        ambiguous=('sensor_msgs/msg/Image',),
        settings=(
            'image_order',
            'beam_axes',
            'sound_speed',
            'image_near_range',
            'image_far_range',
            'image_fov_deg',
            'image_first_beam',
            'image_first_range',
        ),
    ),
)
