# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""Recordings of every system as measurements, with what an uninterrupted run makes of them."""

import functools
from pathlib import Path

from msg_adapters.estimates import write_estimate
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.trackers import state_file, SYSTEMS
from sonar_imm.trackers.state_file import intake_from, read_state, Saved, write_state
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).resolve().parents[2] / 'bags'
MOST = {'bathymetry': 120, 'diver': 80, 'fathometer': 68, 'obstacle': 80}
"""Measurements of a recording; of a ship most are navigation."""
RUNS = {
    'diver_table1': {},
    'diver_multistatic': {},
    'obstacle_tethers': {},
    'bathymetry_ship': {'ping_coupling': '1.0'},
    'fathometer_drift': {'smoothing_lag': '2', 'particles': '300'},
    'fathometer_pressure': {
        'preview_seconds': '5.0', 'frequency_max': '1500.0', 'processor': 'mvdr',
        'pulse': 'processor', 'particles': '300',
    },
}  # fmt: skip
"""Recording: parameters that make its tracker quick, and use what else would not be used."""


class Tracked:
    """A shipped recording, the parameters for it, and what an uninterrupted run makes of it."""

    def __init__(self, name):
        self.system = SYSTEMS[name.split('_')[0]]
        bag = BAGS / name
        self.config = load_config(self.system, own_parameters(bag), RUNS[name])[0]
        with BagReader(bag) as reader:
            read = measurements_of(reader, self.system.name, settings=self.config.as_dict())
            found = [item.measurement for item in read]
        good = [m for m in found if m is not None and not isinstance(m, Rejection)]
        self.input = good[: MOST[self.system.name]]
        tracker = self.build()
        self.whole = published(tracker, self.input)
        self.counts = tracker.counts

    def build(self):
        return self.system.build(self.config)

    def until(self, cut):
        """A tracker that has processed the first `cut` measurements."""
        tracker = self.build()
        for measurement in self.input[:cut]:
            tracker.process(measurement)
        return tracker

    def saved(self, tracker):
        return saved(Intake(tracker), self.system)


def saved(intake, system):
    """The state of a tracker of a system, and of the intake before it."""
    return Saved(
        system=system.name, parameters=state_file.json_parameters(intake.tracker.config),
        saved_ns=5, newest_ns=7, state=state_file.state_of(intake),
    )  # fmt: skip


def tracker_from(saved, system, config):
    """The tracker that goes on from a state as it was read."""
    return intake_from(saved, system, config).tracker


def resumed(path, tracker, name):
    """The tracker that goes on from the file to which a tracker of a system is saved."""
    write_state(path, saved(Intake(tracker), SYSTEMS[name]))
    return tracker_from(read_state(path), SYSTEMS[name], tracker.config)


def published(tracker, measurements):
    """What a tracker publishes of each measurement, as bytes."""
    return [as_bytes(tracker.process(measurement)) for measurement in measurements]


def as_bytes(estimates):
    messages = [write_estimate(estimate, ros_message) for estimate in estimates]
    return [(m.header.stamp.sec, m.header.stamp.nanosec, bytes(m.data)) for m in messages]


tracked = functools.cache(Tracked)
