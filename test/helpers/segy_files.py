# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""SEG-Y files as segyio writes them."""

import numpy as np
import pytest


def write_segy(path, amplitude, fmt=1, **fields):
    """Traces (T, n) in the sample format `fmt`; fields: of their headers by the names of segyio,
    one value for all or (T,)."""
    segyio = pytest.importorskip('segyio')
    spec = segyio.spec()
    spec.format, spec.tracecount = fmt, len(amplitude)
    spec.samples = np.arange(amplitude.shape[1], dtype=float)
    fields = {'TRACE_SAMPLE_COUNT': amplitude.shape[1], **fields}
    columns = {
        getattr(segyio.TraceField, name): np.broadcast_to(value, len(amplitude)).tolist()
        for name, value in fields.items()
    }
    with segyio.create(str(path), spec) as file:
        for k, trace in enumerate(amplitude):
            file.trace[k] = trace.astype(file.dtype)
            file.header[k] = {field: values[k] for field, values in columns.items()}
    return path
