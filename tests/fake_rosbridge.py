"""A fake rosbridge server: it speaks the protocol's topic operations and nothing else.

There is no ROS behind it. It stands in for a real server, which no package registry offers, and
can only show that we keep the protocol as it is written down:
https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
`test_rosbridge_protocol.py` checks the messages themselves.
"""

from __future__ import annotations

import json
import threading

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve


class FakeRosbridge:
    """Takes subscriptions, keeps what is published, sends what a test wants sent."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.types: dict[str, str] = {}
        self.published: list[dict] = []
        self.calls: list[dict] = []
        self._subscribers: dict[str, set] = {}
        self._connections: set = set()
        self.start()

    def start(self):
        self._server = serve(self._serve, "127.0.0.1", self.port)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def stop(self):
        for connection in list(self._connections):
            connection.close()
        self._server.shutdown()
        self._thread.join()

    def has_subscriber(self, topic):
        return bool(self._subscribers.get(topic))

    def publish(self, topic, message):
        self.send_raw(topic, json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def send_raw(self, topic, text):
        for connection in list(self._subscribers.get(topic, ())):
            connection.send(text)

    def _serve(self, connection):
        self._connections.add(connection)
        try:
            for text in connection:
                self._take(connection, json.loads(text))
        except ConnectionClosed:
            pass
        finally:
            self._connections.discard(connection)
            for found in self._subscribers.values():
                found.discard(connection)

    def _take(self, connection, call):
        topic = call["topic"]
        self.calls.append(call)
        if call["op"] in ("subscribe", "advertise"):
            self.types[topic] = call["type"]
        if call["op"] == "subscribe":
            self._subscribers.setdefault(topic, set()).add(connection)
        elif call["op"] == "unsubscribe":
            self._subscribers.get(topic, set()).discard(connection)
        elif call["op"] == "publish":
            self.published.append(call)
