"""What the server keeps of one partition: the stream of its messages, and its last snapshot."""

from __future__ import annotations

import json
import math
import time
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING

from failuretwin.connection.fleet import broker as names
from failuretwin.decision.fleet.partition import Envelope

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js.client import JetStreamContext
    from nats.js.kv import KeyValue
    from nats.js.object_store import ObjectStore

FETCH_S = 1.0
"""Longest wait for the first message [s]."""
TOKENS = 9
"""Parts of the reply address of a delivered message, where it names no domain."""


class MessageSource:
    """Messages of one partition, in their order.

    Attributes:
        subject: Their subjects.
        pending: Messages that waited in the server when it was last asked.
        heard_to_s: Time up to which all messages are known, by the clock of the server
            [s since 1970]; 0: it has not answered yet.
    """

    def __init__(self, stream: JetStreamContext, number: int) -> None:
        self.subject = f"{names.BY_PARTITION}.{number}.>"
        self.pending, self.heard_to_s = 0, 0.0
        self._stream, self._key = stream, f"p{number}"
        self._subscription: JetStreamContext.PullSubscription | None = None
        self._expected = 0
        self._last: Msg | None = None
        self._skew_s = math.inf

    def server_now(self) -> float:
        """Return the time by the clock of the server [s since 1970]."""
        return time.time() - (self._skew_s if math.isfinite(self._skew_s) else 0.0)

    async def fetch(self, after: int, most: int) -> list[Envelope]:
        """Return messages that came after a number; none also where the server does not answer."""
        from nats.errors import Error

        try:
            self._subscription = self._subscription or await self._open(after)
            messages = await self._subscription.fetch(most, timeout=FETCH_S)
        except TimeoutError:
            self.pending, self.heard_to_s = 0, self.server_now()
            return []
        except (Error, OSError):
            await self.close()
            return []
        found = self._envelopes(messages)
        if found:
            self.heard_to_s = self.server_now() if self.pending == 0 else found[-1].server_s
        if len(found) < len(messages):  # some were lost on the way: ask for them again
            await self.close()
        return found

    async def acknowledge(self) -> None:
        """Acknowledge all that was fetched."""
        message, self._last = self._last, None
        if message is not None:
            await message.ack()

    async def close(self) -> None:
        """Leave; the server forgets this consumer, and the next `fetch` opens another."""
        old, self._subscription = self._subscription, None
        if old is not None:
            with suppress(Exception):
                await old.unsubscribe()

    async def _open(self, after: int) -> JetStreamContext.PullSubscription:
        from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy

        name = f"{self._key}_{uuid.uuid4().hex[:8]}"
        await self._stream.add_consumer(
            names.EVENTS_STREAM,
            ConsumerConfig(
                durable_name=name,
                deliver_policy=DeliverPolicy.BY_START_SEQUENCE,
                opt_start_seq=after + 1,
                ack_policy=AckPolicy.ALL,
                ack_wait=3600.0,
                max_ack_pending=-1,
                filter_subject=self.subject,
                inactive_threshold=60.0,
            ),
        )
        self._expected = 1
        return await self._stream.pull_subscribe_bind(consumer=name, stream=names.EVENTS_STREAM)

    def _envelopes(self, messages: list[Msg]) -> list[Envelope]:
        """Return messages in their order, up to the first gap."""
        found, now = list[Envelope](), time.time()
        for one in messages:
            tokens = one.reply.split(".")
            at = 5 if len(tokens) == TOKENS else 7
            number, delivery, stamp, pending = map(int, tokens[at : at + 4])
            if delivery != self._expected:
                break
            self._expected += 1
            self.pending, self._last = pending, one
            server_s = 1e-9 * stamp
            self._skew_s = min(self._skew_s, now - server_s)
            robot, kind = one.subject.split(".", 4)[3:]
            found.append(Envelope(number, server_s, robot, kind, one.data))
        return found


# The last snapshot, which only the holder of the partition can replace.


class LeaseLostError(Exception):
    """Somebody else holds the partition by now."""


class Snapshots:
    """Snapshots of one partition: a pointer in a bucket, to an object with the state.

    Who has written the last pointer, or has read it when taking over, may replace it.

    Args:
        pointers: Bucket of the pointers.
        states: Store of the objects.
        key: Key of the partition.
    """

    def __init__(self, pointers: KeyValue, states: ObjectStore, key: str) -> None:
        self._pointers, self._states, self._key = pointers, states, key
        self._revision, self._object = 0, ""

    async def load(self) -> tuple[bytes, int] | None:
        """Return the last snapshot and the last message it covers; None: there is none."""
        from nats.js.errors import KeyNotFoundError

        try:
            entry = await self._pointers.get(self._key)
        except KeyNotFoundError:
            return None
        self._revision = entry.revision or 0
        pointer = json.loads(entry.value or b"{}")
        self._object = pointer["object"]
        return (await self._states.get(self._object)).data or b"", pointer["last"]

    async def store(self, data: bytes, last: int) -> None:
        """Store a snapshot that covers the messages up to a number.

        Raises:
            LeaseLostError: If somebody has stored a later one.
        """
        from nats.js.errors import KeyWrongLastSequenceError, NotFoundError

        name, old = f"{self._key}-{last}-{uuid.uuid4().hex[:8]}", self._object
        await self._states.put(name, data)
        pointer = json.dumps({"object": name, "last": last}).encode()
        try:
            self._revision = await self._pointers.update(self._key, pointer, last=self._revision)
        except KeyWrongLastSequenceError:
            await self._states.delete(name)
            entry = await self._pointers.get(self._key)
            if json.loads(entry.value or b"{}")["last"] > last:  # we were paused for long
                raise LeaseLostError(f"{self._key} has gone on without us") from None
            self._revision = entry.revision or 0  # the other was
            raise
        self._object = name
        if old:
            with suppress(NotFoundError):
                await self._states.delete(old)
