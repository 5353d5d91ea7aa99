"""The last snapshot of a partition, which only its holder can replace."""

from __future__ import annotations

import json
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nats.js.kv import KeyValue
    from nats.js.object_store import ObjectStore


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
