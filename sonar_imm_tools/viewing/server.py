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

"""Topics on a WebSocket, as Foxglove reads them: CDR messages with their ``ros2msg`` definitions.

Needs the package ``foxglove-sdk`` (extra ``[view]``), which is imported here only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import logging
import threading
from typing import Any

import foxglove
from foxglove.websocket import (
    Capability,
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    ServerListener,
)

from .material import Channel, Shown
from .playback import Playback, State, Status

_STATUS = {
    Status.PLAYING: PlaybackStatus.Playing,
    Status.PAUSED: PlaybackStatus.Paused,
    Status.ENDED: PlaybackStatus.Ended,
}
SETTLE = 0.3
"""Seconds from the first subscription to the start of playing: a viewer subscribes to its topics
one after another."""


class ViewServer:
    """A server of topics; use it in a ``with`` statement.

    host: who may connect, 127.0.0.1 for this machine only; port 0 takes a free one. playback: what
    the controls of the viewer act on, None for live topics; it starts when the first viewer is
    there, with `autostart`. Raises OSError when the address cannot
    be used.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int,
        playback: Playback | None = None,
        *,
        autostart: bool = True,
    ):
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._listener = _Listener(playback, autostart)
        logging.getLogger('foxglove').setLevel(logging.WARNING)
        try:
            self._server = foxglove.start_server(
                name=name,
                host=host,
                port=port,
                context=self._context,
                server_listener=self._listener,
                capabilities=[Capability.PlaybackControl, Capability.Time] if playback else [],
                playback_time_range=playback.span if playback else None,
                supported_encodings=['cdr'],
            )
        except (RuntimeError, ValueError) as error:
            raise OSError(f'{host}:{port} cannot be listened on: {error}') from None
        self._listener.tell = self.tell_state
        self.url = f'ws://{host}:{self._server.port}'

    def __enter__(self) -> ViewServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()
        self._server.stop()

    @property
    def app_url(self) -> str:
        """Address that opens Foxglove in a browser with this server as its source."""
        return self._server.app_url() or ''

    def advertise(self, channels: Iterable[Channel]) -> None:
        """Offer topics; one that is offered already is left as it is."""
        for channel in channels:
            if channel.topic not in self._channels:
                self._channels[channel.topic] = foxglove.Channel(
                    channel.topic,
                    message_encoding='cdr',
                    schema=foxglove.Schema(
                        name=channel.type_name,
                        encoding='ros2msg',
                        data=channel.definition.encode(),
                    ),
                    context=self._context,
                )

    def withdraw(self, topic: str) -> None:
        """Offer a topic no longer."""
        self._channels.pop(topic).close()

    def watched(self, topic: str) -> bool:
        """Whether a viewer has subscribed to a topic that is offered."""
        return self._channels[topic].has_sinks()

    def publish(self, shown: Shown) -> None:
        """Send a message to those who have subscribed to its topic."""
        self._channels[shown.topic].log(shown.raw, log_time=shown.log_ns)

    def tell_time(self, now_ns: int) -> None:
        """Say what time it is in the recording."""
        self._server.broadcast_time(now_ns)

    def tell_state(self, state: State) -> None:
        """Say that playing has changed without a request."""
        self._server.broadcast_playback_state(_playback_state(state, None))


class _Listener(ServerListener):
    """What viewers ask for; called from the threads of the server."""

    def __init__(self, playback: Playback | None, autostart: bool):
        self._playback = playback
        self._waiting = autostart and playback is not None
        self._timer: threading.Timer | None = None
        self._lock = threading.Lock()
        self.tell: Callable[[State], None] | None = None

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Start playing when the first viewer is there, unless it uses the controls first."""
        with self._lock:
            if self._waiting and self._timer is None:
                self._timer = threading.Timer(SETTLE, self._begin)
                self._timer.daemon = True
                self._timer.start()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Nothing: playing goes on."""

    def on_playback_control_request(
        self, playback_control_request: PlaybackControlRequest
    ) -> PlaybackState | None:
        """Play, pause, jump or change the rate, as the viewer says."""
        if self._playback is None:
            return None
        self.close()
        state = self._playback.change(
            play=playback_control_request.playback_command == PlaybackCommand.Play,
            rate=playback_control_request.playback_speed,
            seek_ns=playback_control_request.seek_time,
        )
        return _playback_state(state, playback_control_request.request_id)

    def close(self) -> None:
        """Start nothing by itself any more."""
        with self._lock:
            self._waiting = False

    def _begin(self) -> None:
        with self._lock:
            if not self._waiting or self._playback is None:
                return
        state = self._playback.change(play=True)
        if self.tell:
            self.tell(state)


def _playback_state(state: State, request_id: str | None) -> PlaybackState:
    return PlaybackState(_STATUS[state.status], state.now_ns, state.rate, state.jumped, request_id)
