# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What can go wrong at sea, done on purpose to a real node: cases, faults and their table.

A fault is a function of the messages before, during and after it: it gives what is sent instead,
in two lists, the disturbed part and the rest. `Rig` sends both in lock-step to a node that runs as
a process and compares what it publishes in the rest with an undisturbed run. To add a fault, write
that function and a line of the table in `table.py`.
"""
