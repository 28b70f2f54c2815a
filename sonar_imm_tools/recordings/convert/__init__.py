# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Conversion of other people's recordings into bags.

Every converter takes the file, the path of the new bag and options, and gives a
`ConversionReport`. Rows that cannot be used are counted and listed by line. Only a file without a
usable row raises `BagError`. Records are written in the order of their stamps.
"""

from __future__ import annotations

from collections.abc import Callable

from ..conversion import ConversionReport
from ..convert_options import OPTIONS
from ..tables import CsvOptions
from ..truth import convert_truth
from .archives import convert_snapshots, convert_traces
from .arrivals import convert_arrivals
from .bag_images import convert_images, convert_interferometer
from .detections import convert_detections
from .fixes import convert_fixes
from .hydrophones import convert_hydrophones
from .nmea import convert_nmea
from .relative import convert_relative
from .segy import convert_segy
from .side_scan import convert_pictures, convert_xtf

__all__ = [
    'convert_arrivals',
    'convert_detections',
    'convert_fixes',
    'convert_hydrophones',
    'convert_images',
    'convert_interferometer',
    'convert_nmea',
    'convert_pictures',
    'convert_relative',
    'convert_segy',
    'convert_snapshots',
    'convert_traces',
    'convert_truth',
    'convert_xtf',
    'ConversionReport',
    'CsvOptions',
    'KINDS',
]

KINDS: dict[str, Callable[..., ConversionReport]] = {
    kind: globals()[f'convert_{kind}'] for kind in OPTIONS
}
"""The converters by the name that the command gives them."""
