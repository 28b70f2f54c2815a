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

"""A real WebSocket client: every channel with its schema, every message, the controls."""

import contextlib
import json
import threading
import time
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip('foxglove')
pytest.importorskip('websockets')

from helpers.foxglove_client import Viewer  # noqa: E402

from sonar_imm_tools.recordings.messages import message_definition  # noqa: E402
from sonar_imm_tools.recordings.reader import BagReader  # noqa: E402
from sonar_imm_tools.resources import shared_file  # noqa: E402
from sonar_imm_tools.viewing.material import Channel, opened  # noqa: E402
from sonar_imm_tools.viewing.playback import Playback  # noqa: E402
from sonar_imm_tools.viewing.server import SETTLE, ViewServer  # noqa: E402

BAG = 'bags/obstacle_movers'
PLAYING, PAUSED, ENDED = 0, 1, 3


@contextlib.contextmanager
def served(**options):
    """The server of a shipped bag, and what plays it."""
    with opened(shared_file(BAG)) as (material, _):
        playback = Playback(material.first_ns, material.last_ns, rate=1e4)
        with ViewServer('test', '127.0.0.1', 0, playback, **options) as server:
            server.advertise(material.channels.values())
            player = threading.Thread(
                target=playback.run,
                args=(material.messages, server.publish, server.tell_time, server.tell_state),
            )
            player.start()
            try:
                yield server, material
            finally:
                playback.stop()
                player.join()


def test_every_channel_comes_with_its_schema_and_every_message_arrives():
    with served() as (server, material), Viewer(server.url) as viewer:
        viewer.wait(lambda: len(viewer.channels) == len(material.channels))
        for topic, channel in material.channels.items():
            offered = viewer.channels[topic]
            assert offered['encoding'] == 'cdr' and offered['schemaEncoding'] == 'ros2msg'
            assert offered['schemaName'] == channel.type_name
            assert offered['schema'] == channel.definition
        viewer.subscribe(*viewer.channels)
        expected = {}
        with BagReader(shared_file(BAG)) as bag:
            for item in bag.messages(decode=False):
                expected.setdefault(item.topic, []).append((item.log_ns, item.raw))
        count = sum(map(len, expected.values()))
        # The states have a queue of their own and may overtake the messages.
        viewer.wait(lambda: len(viewer.messages) == count)
        viewer.wait(lambda: viewer.states and viewer.states[-1][0] == ENDED)
        for topic, sent in expected.items():
            got = [(log_ns, raw) for name, log_ns, raw in viewer.messages if name == topic]
            assert got == sent


def test_the_viewer_drives_the_playing():
    with served(autostart=False) as (server, material), Viewer(server.url) as viewer:
        viewer.wait(lambda: viewer.channels and viewer.info)
        assert {'playbackControl', 'time'} <= set(viewer.info['capabilities'])
        viewer.subscribe('/nav')
        middle = (material.first_ns + material.last_ns) // 2
        viewer.control(play=False, rate=1.0, seek_ns=middle, request='jump')
        viewer.wait(lambda: viewer.states and viewer.messages)
        assert viewer.states == [(PAUSED, middle, 1.0, 1, 'jump')]
        assert [log_ns < middle for _, log_ns, _ in viewer.messages] == [True]
        viewer.control(play=True, rate=1e4, request='on')
        viewer.wait(lambda: viewer.states[-1][0] == ENDED and len(viewer.messages) > 100)
        assert viewer.states[1][0] == PLAYING and viewer.states[1][4] == 'on'
        assert all(log_ns > middle for _, log_ns, _ in viewer.messages[2:])


class Asked(Playback):
    """A playback that notes what it was asked for."""

    def change(self, **wishes):
        self.wishes = [*getattr(self, 'wishes', ()), wishes]
        return super().change(**wishes)


@pytest.mark.parametrize('autostart, leaves', [(True, False), (True, True), (False, False)])
def test_it_plays_by_itself_for_who_stays_and_where_that_was_wanted(autostart, leaves):
    with opened(shared_file(BAG)) as (material, _), contextlib.ExitStack() as stack:
        playback = Asked(material.first_ns, material.last_ns)
        server = ViewServer('test', '127.0.0.1', 0, playback, autostart=autostart)
        viewer = stack.enter_context(Viewer(stack.enter_context(server).url))
        server.advertise(material.channels.values())
        viewer.wait(lambda: len(viewer.channels) == len(material.channels))
        viewer.subscribe('/nav', '/detections')  # a viewer asks for one after another
        viewer.wait(lambda: server.watched('/nav') and server.watched('/detections'))
        if leaves:
            stack.close()
        time.sleep(1.5 * SETTLE)
        assert getattr(playback, 'wishes', []) == [{'play': True}] * (autostart and not leaves)


def test_live_channels_come_and_go():
    definition = message_definition('std_msgs/msg/String')
    channel = Channel('/talk', 'std_msgs/msg/String', definition)
    with ViewServer('live', '127.0.0.1', 0) as server, Viewer(server.url) as viewer:
        server.advertise([channel])
        viewer.wait(lambda: '/talk' in viewer.channels)
        assert 'playbackControl' not in json.dumps(viewer.info)
        assert not server.watched('/talk')
        viewer.subscribe('/talk')
        viewer.wait(lambda: server.watched('/talk'))
        server.withdraw('/talk')
        viewer.wait(lambda: '/talk' not in viewer.channels)


def test_a_browser_is_sent_to_this_server():
    with ViewServer('test', '127.0.0.1', 0) as server:
        asked = parse_qs(urlsplit(server.app_url).query)
        assert asked['ds.url'] == [server.url]


def test_a_taken_port_is_one_sentence():
    with ViewServer('first', '127.0.0.1', 0) as server:
        port = int(server.url.rsplit(':', 1)[1])
        with pytest.raises(OSError, match=f'127.0.0.1:{port} cannot be listened on'):
            ViewServer('second', '127.0.0.1', port)
