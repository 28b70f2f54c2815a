# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Hostile input: messages as a wire could bring them, and what must hold whatever they are.

`streams`: good messages of every input and type of each system. `runs`: what is done to them, and
a tracker under a stream of good and bad ones, or with extreme parameters. `properties`: what must
hold. `files`, `states`: damaged files and states.
"""
