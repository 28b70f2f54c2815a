# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A viewer: a WebSocket client that speaks the protocol of Foxglove (foxglove.sdk.v1)."""

import json
import struct
import time

from websockets.sync.client import connect


class Viewer:
    """Connected to `url` while in a ``with`` statement.

    info: what the server says of itself; channels: those offered now, by topic; messages: (topic,
    log_ns, bytes) received; states: (status, now_ns, rate, jumped, request) received; times: ns.
    """

    def __init__(self, url):
        self._connection = connect(url, subprotocols=['foxglove.sdk.v1'], proxy=None)
        self.info, self.channels = {}, {}
        self.messages, self.states, self.times = [], [], []
        self._subscribed, self._wanted = {}, set()

    def __enter__(self):
        self._socket = self._connection.__enter__()
        return self

    def __exit__(self, *error):
        self._connection.__exit__(*error)

    def wait(self, predicate, limit=120.0):
        """Read until `predicate()` holds; AssertionError after `limit` seconds."""
        end = time.monotonic() + limit
        while not predicate():
            left = end - time.monotonic()
            assert left > 0, (
                f'nothing came of it: {[*self.channels]}, {len(self.messages)} messages'
            )
            try:
                self._take(self._socket.recv(timeout=min(left, 0.2)))
            except TimeoutError:
                continue

    def subscribe(self, *topics):
        """Ask for the messages of `topics`, which are offered."""
        self._wanted.update(topics)
        asked = []
        for topic in topics:
            number = len(self._subscribed) + 1
            self._subscribed[number] = topic
            asked.append({'id': number, 'channelId': self.channels[topic]['id']})
        self._socket.send(json.dumps({'op': 'subscribe', 'subscriptions': asked}))

    def control(self, *, play, rate=1.0, seek_ns=None, request='r'):
        """Ask for playing or a pause, at a rate, from a time."""
        name = request.encode()
        fields = (not play, rate, seek_ns is not None, seek_ns or 0, len(name))
        self._socket.send(struct.pack('<BBfBQI', 3, *fields) + name)

    def _take(self, data):
        if isinstance(data, str):
            message = json.loads(data)
            if message['op'] == 'serverInfo':
                self.info = message
            elif message['op'] == 'advertise':
                offered = {channel['topic']: channel for channel in message['channels']}
                self.channels.update(offered)
                if again := self._wanted & offered.keys():  # withdrawn and offered anew
                    self.subscribe(*again)
            elif message['op'] == 'unadvertise':
                gone = set(message['channelIds'])
                self.channels = {
                    name: channel
                    for name, channel in self.channels.items()
                    if channel['id'] not in gone
                }
        elif data[0] == 1:
            number, log_ns = struct.unpack_from('<IQ', data, 1)
            self.messages.append((self._subscribed[number], log_ns, data[13:]))
        elif data[0] == 2:
            self.times.append(struct.unpack_from('<Q', data, 1)[0])
        elif data[0] == 5:
            *state, size = struct.unpack_from('<BQfBI', data, 1)
            self.states.append((*state, data[19 : 19 + size].decode()))
