"""From sources of robots to the broker: a message a robot and second, stored before the next.

A server that is away or full is waited for, and the source says what it then drops.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from failuretwin.connection.fleet.broker import EVENTS_STREAM, IN, Broker
from failuretwin.connection.fleet.messages import (
    MOST_EVENTS,
    ProfileMessage,
    events_binary,
    profile_json,
)
from failuretwin.connection.links.base import Event, Source

PACK_S = 0.5
"""Time of events in a message of one live robot [s]."""
TOGETHER = 500
"""Messages that are on their way at once, of as many robots."""
RETRY_S = 0.5
"""Time between two tries of a message [s]."""


class Publisher:
    """Puts messages of robots on the broker, each stored once and in order.

    Args:
        broker: The server.
        tell: Takes a line for the user.
        stop: Ends the wait for a server that takes no messages.
        motors: Number of motors of each robot.

    Attributes:
        sent: Messages that the server has stored.
    """

    def __init__(
        self,
        broker: Broker,
        tell: Callable[[str], None],
        stop: asyncio.Event,
        motors: int,
    ) -> None:
        self.sent = self._made = 0
        self._stop = stop
        self._broker, self._tell, self._motors = broker, tell, motors
        self._own = uuid.uuid4().hex[:8]
        self._waits = False

    async def announce(self, robots: Iterable[str], profile: ProfileMessage) -> None:
        """Say what some robots are."""
        data = profile_json(profile)
        await self._send([(f"{IN}.{robot}.profile", data) for robot in robots])

    async def send(self, events: Iterable[tuple[str, Sequence[Event]]]) -> None:
        """Send events of robots, one item of each robot; empty ones are left out."""
        await self._send(
            [
                (f"{IN}.{robot}.events", events_binary(some, self._motors))
                for robot, some in events
                if some
            ]
        )

    async def _send(self, messages: Sequence[tuple[str, bytes]]) -> None:
        for first in range(0, len(messages), TOGETHER):
            some = messages[first : first + TOGETHER]
            await asyncio.gather(*(self._store(subject, data) for subject, data in some))

    async def _store(self, subject: str, data: bytes) -> None:
        from nats.errors import Error

        self._made += 1
        headers = {"Nats-Msg-Id": f"{self._own}-{self._made}"}
        while not self._stop.is_set():
            try:
                await self._broker.stream.publish(
                    subject, data, stream=EVENTS_STREAM, headers=headers
                )
            except (Error, OSError, TimeoutError) as error:
                if not self._waits:
                    self._waits = True
                    self._tell(f"the server takes no messages ({_reason(error)}); waiting")
                await asyncio.sleep(RETRY_S)
                continue
            self.sent += 1
            if self._waits:
                self._waits = False
                self._tell("the server takes messages again")
            return


def _reason(error: Exception) -> str:
    from nats.js.errors import NoStreamResponseError

    if isinstance(error, NoStreamResponseError):
        return "no stream keeps them; start one: failuretwin worker"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


async def bridge_source(
    source: Source, robot: str, publisher: Publisher, stop: asyncio.Event
) -> None:
    """Put the events of one robot on the broker until its source ends, or `stop` is set."""
    loop = asyncio.get_running_loop()
    while not (stop.is_set() or source.ended):
        await publisher.send([(robot, await loop.run_in_executor(None, _packet, source))])


def _packet(source: Source) -> list[Event]:
    """Return the events of a little time."""
    found, end_s = list[Event](), time.monotonic() + PACK_S
    while not source.ended and len(found) < MOST_EVENTS and (left := end_s - time.monotonic()) > 0:
        event = source.poll(left)
        if event is not None:
            found.append(event)
    return found


async def bridge_fleet(
    seconds: Callable[[], Sequence[tuple[str, Sequence[Event]]] | None],
    publisher: Publisher,
    stop: asyncio.Event,
    speed: float = 1.0,
) -> None:
    """Put a fleet on the broker that gives its events second by second; None: it has ended.

    `speed` are seconds of the robots in one of ours; 0: as fast as possible.
    """
    loop, due_s = asyncio.get_running_loop(), time.monotonic()
    while not stop.is_set():
        events = await loop.run_in_executor(None, seconds)
        if events is None:
            return
        await publisher.send(events)
        if speed > 0.0:
            due_s += 1.0 / speed
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), max(0.0, due_s - time.monotonic()))
