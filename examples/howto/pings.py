# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pings of eight staves over a flat floor with a rough stretch, as pings.npz."""

import numpy as np

rng = np.random.default_rng(3)
pings, staves, tilt, height = 12, 8, np.radians(30.0), 15.0
slant = np.arange(17.0, 60.0, 0.1)  # slant range of each bin, m
rough = (slant > 35.0) & (slant < 45.0)
iq = np.empty((pings, len(slant), staves), complex)
for ping in range(pings):
    floor = np.where(rough, rng.normal(scale=0.5, size=len(slant)), 0.0)
    u = np.sin(np.arcsin((height - floor) / slant) - tilt)
    echo = np.exp(1j * np.pi * np.outer(u, np.arange(staves)))  # half a wavelength apart
    fade = rng.normal(size=(2, len(slant)))
    noise = rng.normal(size=(2, *echo.shape))
    snr = 10 ** np.interp(slant, slant[[0, -1]], (1.5, 0.75))  # 30 to 15 dB
    iq[ping] = np.sqrt(snr / 2)[:, None] * (fade[0] + 1j * fade[1])[:, None] * echo
    iq[ping] += (noise[0] + 1j * noise[1]) / np.sqrt(2)
np.savez('pings.npz', iq=iq, range=slant, noise_variance=1.0, spacing_wavelengths=0.5)
