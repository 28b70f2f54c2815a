"""From images of a forward-looking sonar to detections for the obstacle tracker, bag to bag.

Every image gives one message on ``/detections``, also when nothing is found in it. Navigation and
altitudes, which the tracker needs too, are copied to ``/nav`` and ``/altitude``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msg_adapters.detections import write_detections
from msg_adapters.inputs import inputs_of
from msg_adapters.sonar_images import IMAGE_TYPES, read_sonar_image

from ...measurements import Rejection
from ...trackers.obstacle.detector import detect, DetectorConfig
from ..conversion import ConversionReport, provenance
from ..messages import ros_message
from ..reader import BagReader
from ..sources import BagError
from ..writer import BagWriter
from .companions import companion_topics, copied

FURTHER = {entry.name: entry for entry in inputs_of('obstacle') if entry.name != 'detections'}


def convert_images(
    path: str | Path,
    out: str | Path,
    *,
    parameters: Mapping[str, Any] | None = None,
    storage: str = 'mcap',
) -> ConversionReport:
    """Find the echoes in all images of the bag at `path`.

    parameters: of `DetectorConfig` by name. Messages that cannot be used are counted and named.
    Raises `ConfigError`, and `BagError` when the bag has no images.
    """
    config = DetectorConfig.from_mapping(parameters or {})
    report = ConversionReport(Path(out))
    report.notes['detector'] = ', '.join(f'{k} {v}' for k, v in config.as_dict().items())
    with BagReader(path) as bag:
        topics = _topics(bag)
        with BagWriter(
            out, storage=storage, custom_data=provenance(Path(path).name, report.notes)
        ) as made:
            for item in bag.messages(list(topics)):
                report.rows += 1
                name = topics[item.topic]
                try:
                    message = _converted(name, item, config)
                except Rejection as rejection:
                    report.bad_row(Path(path), f'{item.topic} #{item.index}', rejection)
                    continue
                made.write(f'/{name}', message, item.log_ns)
                report.messages[f'/{name}'] = report.messages.get(f'/{name}', 0) + 1
        report.problems += bag.problems
    return report


def _topics(bag: BagReader) -> dict[str, str]:
    """Input name by topic: images, and the first topic of each further kind."""
    images = [topic.name for topic in bag.topics if topic.type_name in IMAGE_TYPES]
    if not images:
        raise BagError(f'{bag.path} has no topic with {" or ".join(IMAGE_TYPES)}')
    chosen = {images[0]: 'detections'}
    return chosen | companion_topics(bag, FURTHER)


def _converted(name: str, item: Any, config: DetectorConfig) -> Any:
    if name == 'detections':
        image = read_sonar_image(item.message, **config.reading())
        return write_detections(detect(image, config), ros_message)
    return copied(FURTHER[name], item)
