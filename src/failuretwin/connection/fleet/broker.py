"""The broker of a fleet: NATS with JetStream, its subjects, streams and buckets.

| subject | content |
|---|---|
| ``fleet.in.ROBOT.profile``, ``fleet.in.ROBOT.events`` | what robots say (MQTT: ``fleet/in/...``) |
| ``fleet.p.N.ROBOT.KIND`` | the same, by partition: the server maps it (`server_config`) |
| ``fleet.alarm.ROBOT.LIFE.EPISODE.STATE`` | an alarm that was raised or cleared, stored once |
| ``fleet.health.ROBOT`` | state of a robot, when it changes |

What a snapshot covers is removed from the stream of events. A stream that is full refuses what
comes: publishers are told, and nothing that was accepted is dropped.

Section: docs/fleet.md
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

from failuretwin.core.errors import InputError, needs_extra

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.js.client import JetStreamContext
    from nats.js.kv import KeyValue
    from nats.js.object_store import ObjectStore

PARTITIONS = 8
"""Partitions of a fleet by default; the mapping of the server must say the same."""
IN, BY_PARTITION, ALARM, HEALTH = "fleet.in", "fleet.p", "fleet.alarm", "fleet.health"
EVENTS_STREAM, ALARM_STREAM = "FLEET_EVENTS", "FLEET_ALARMS"
LEASES, WORKERS, SNAPSHOTS, HEALTH_BUCKET, PROFILES = (
    "fleet_leases",
    "fleet_workers",
    "fleet_snapshots",
    "fleet_health",
    "fleet_profiles",
)
"""Buckets: who holds a partition, who works, the last snapshots, health by partition, profiles."""
STATES = "fleet_states"
"""Object store of the snapshots themselves."""
LARGEST_STREAM = 2 * 1024**3
"""Room for events that no snapshot covers [bytes]."""
ALARMS_KEPT_S = 90 * 86_400.0
"""Time for which alarms are kept [s]."""
ANSWER_S = 5.0
"""Longest wait for the entries of a bucket [s]."""
TRIES_S = 2.0
"""Time between two tries to reach a server that is gone [s]."""
PROBES, PROBED_S = 16, 2.0
"""Robots whose partitions are probed, and the longest wait for one of them [s]."""
GOODBYE_S = 1.0
"""Longest wait for the end of a connection that was refused [s]."""


@dataclass(frozen=True)
class Access:
    """How to reach a server.

    Attributes:
        url: ``nats://[USER:PASSWORD@]HOST[:PORT]``, or ``tls://...``.
        ca: File of the authority that signs the server's certificate; None: those of the system.
        certificate: Our certificate and key in one file; None: the server asks for none.
        nkey: File with the seed of an NKey; None: none.
    """

    url: str
    ca: Path | None = None
    certificate: Path | None = None
    nkey: Path | None = None

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("nats", "tls") or not parts.hostname:
            raise InputError(
                f"fleet server {self.url!r}: expected nats://HOST[:PORT] or tls://HOST[:PORT]."
            )

    @property
    def shown(self) -> str:
        """The address without a password."""
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.hostname}:{parts.port or 4222}"

    @property
    def context(self) -> ssl.SSLContext | None:
        """TLS settings; None: not encrypted."""
        if urlsplit(self.url).scheme != "tls" and self.ca is None:
            return None
        with _read("--tls-ca", self.ca, "certificates (PEM)"):
            found = ssl.create_default_context(cafile=self.ca)
        if self.certificate is not None:
            with _read("--tls-cert", self.certificate, "a certificate and its key (PEM)"):
                found.load_cert_chain(self.certificate)
        return found

    @property
    def seed(self) -> str | None:
        """Seed of the NKey; None: there is none."""
        if self.nkey is None:
            return None
        with needs_extra("an NKey needs nkeys", "fleet"):
            from nkeys import NkeysError, from_seed
        with _read("--nkey", self.nkey, "the seed of a user (SU...)", NkeysError):
            found = self.nkey.read_text().strip()
            from_seed(found.encode())
        return found


@contextmanager
def _read(
    option: str, path: Path | None, expected: str, refusal: type[Exception] = ValueError
) -> Iterator[None]:
    """Say which file of an option cannot be read, and what it should hold."""
    try:
        yield
    except (OSError, refusal) as error:
        raise InputError(f"{option} {path}: {error}. Expected {expected}.") from error


class Broker:
    """A connection to the server; `open_broker` returns one.

    Attributes:
        client: The connection.
        stream: Its JetStream.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        self.stream: JetStreamContext = client.jetstream(timeout=5.0)

    async def bucket(self, name: str) -> KeyValue:
        """Return a bucket, made if it is new."""
        from nats.js.errors import BucketNotFoundError

        try:
            return await self.stream.key_value(name)
        except BucketNotFoundError:
            return await self.stream.create_key_value(bucket=name, history=1)

    async def states(self) -> ObjectStore:
        """Return the store of snapshots, made if it is new."""
        from nats.js.errors import BucketNotFoundError, NotFoundError

        try:
            return await self.stream.object_store(STATES)
        except (BucketNotFoundError, NotFoundError):
            return await self.stream.create_object_store(STATES)

    async def set_up(self) -> None:
        """Make the streams that are missing."""
        from nats.js.api import DiscardPolicy, StreamConfig

        once = StreamConfig(
            name=ALARM_STREAM,
            subjects=[f"{ALARM}.*.*.*.*"],  # not those of retained MQTT messages
            max_msgs_per_subject=1,
            discard=DiscardPolicy.NEW,
            discard_new_per_subject=True,
            max_age=ALARMS_KEPT_S,
        )
        events = StreamConfig(
            name=EVENTS_STREAM,
            subjects=[f"{BY_PARTITION}.>"],
            discard=DiscardPolicy.NEW,
            max_bytes=LARGEST_STREAM,
        )
        for wanted in (events, once):
            if await self.messages(str(wanted.name)) is None:
                await self.stream.add_stream(wanted)

    async def messages(self, stream: str) -> int | None:
        """Return the number of messages in a stream; None: nobody has made it yet.

        Raises:
            InputError: If the server has no JetStream.
        """
        from nats.js.errors import NotFoundError, ServiceUnavailableError

        try:
            return (await self.stream.stream_info(stream)).state.messages
        except NotFoundError:
            return None
        except ServiceUnavailableError as error:
            raise InputError(
                "the fleet server has no JetStream. Expected one that was started with the "
                "configuration of `failuretwin fleet config`: nats-server -c nats.conf."
            ) from error

    async def check_mapping(self, partitions: int) -> None:
        """Check that the server spreads robots over so many partitions; no probe is stored.

        Raises:
            InputError: If it does not.
        """
        robots = {f"probe_{number}" for number in range(PROBES)}
        seen = await self.client.subscribe(f"{BY_PARTITION}.*.*.probe")
        for robot in robots:
            header = {"Nats-Expected-Stream": "none"}
            await self.client.publish(f"{IN}.{robot}.probe", headers=header)
        found = set[tuple[str, int]]()
        with suppress(TimeoutError):
            while len(found) < PROBES:
                number, robot = (await seen.next_msg(timeout=PROBED_S)).subject.split(".")[2:4]
                found.add((robot, int(number)))
        await seen.unsubscribe()
        if found != {(robot, partition_of(robot, partitions)) for robot in robots}:
            got = "another number of partitions" if found else "no partitions"
            raise InputError(
                f"the fleet server spreads robots over {got}. Expected {partitions}: its "
                f"configuration needs mappings = {{ {mapping(partitions)} }}, and each worker the "
                "same number by --partitions."
            )

    async def close(self) -> None:
        """Send what waits, then leave."""
        from nats.errors import Error

        with suppress(Error, OSError, TimeoutError):
            await self.client.flush(timeout=2)
        with suppress(Error, OSError, TimeoutError):  # the server is gone
            await self.client.close()

    async def __aenter__(self) -> Self:
        """Return the broker, which is closed at the end of the block."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection."""
        await self.close()

    async def publish_once(self, subject: str, data: bytes) -> bool:
        """Store a message unless its subject has one, and return whether it is new."""
        from nats.js.errors import APIError

        try:
            await self.stream.publish(subject, data)
        except APIError as error:
            if error.err_code == PER_SUBJECT:
                return False
            raise
        return True


PER_SUBJECT = 10077
"""Error code of a stream whose subject holds a message already."""


async def entries(bucket: KeyValue) -> dict[str, KeyValue.Entry]:
    """Return all entries of a bucket by key."""
    watcher, found = await bucket.watchall(ignore_deletes=True), dict[str, Any]()
    try:
        while (entry := await watcher.updates(timeout=ANSWER_S)) is not None:
            found[entry.key] = entry
    finally:
        await watcher.stop()
    return found


async def open_broker(access: Access, name: str) -> Broker:
    """Return a connection that comes back by itself when the server was away.

    Args:
        access: The server.
        name: Our name there.

    Raises:
        InputError: If the server does not answer, or refuses us.
    """
    with needs_extra("a fleet needs nats-py", "fleet"):
        from nats.aio.client import Client
        from nats.errors import Error
    options: dict[str, Any] = {}
    if access.nkey is not None:
        options["nkeys_seed_str"] = access.seed
    if access.context is not None:
        options["tls"] = access.context
    seen: list[Exception] = []

    async def note(error: Exception) -> None:
        seen.append(error)

    client = Client()
    try:
        await client.connect(
            access.url,
            name=name,
            error_cb=note,
            connect_timeout=5,
            max_reconnect_attempts=1,
            allow_reconnect=False,
            **options,
        )
    except (Error, OSError, TimeoutError) as error:
        with suppress(TimeoutError):  # nats-py waits for ever where TLS has failed
            await asyncio.wait_for(client.close(), GOODBYE_S)
        got = str(seen[-1] if seen else error)
        fix = next((fix for sign, fix in FIXES.items() if sign in got), FIX)
        raise InputError(f"fleet server {access.shown}: {got}. {fix}") from error
    # It has let us in once: from now on it is waited for.
    client.options |= {
        "allow_reconnect": True,
        "max_reconnect_attempts": -1,
        "reconnect_time_wait": TRIES_S,
    }
    return Broker(client)


FIX = "Expected a NATS server with JetStream that lets us in; see docs/fleet.md."
FIXES = {
    "CERTIFICATE_VERIFY_FAILED": "Expected a certificate of an authority that is known: --tls-ca.",
    "Authorization Violation": "Expected a user and password that it knows in the URL, or --nkey.",
}
"""What to do where the server refuses us, by a part of its reason."""


def server_config(port: int, mqtt_port: int, folder: Path, partitions: int = PARTITIONS) -> str:
    """Return the configuration of a server on this computer alone, without users."""
    return f"""\
host: 127.0.0.1
port: {port}
server_name: fleet
jetstream {{ store_dir: "{folder}" }}
mqtt {{ host: 127.0.0.1, port: {mqtt_port} }}
mappings = {{ {mapping(partitions)} }}
"""


def partition_of(robot: str, partitions: int) -> int:
    """Return the partition of a robot, as the server computes it: FNV-1a of its name, modulo."""
    found = 0x811C9DC5
    for byte in robot.encode():
        found = ((found ^ byte) * 0x01000193) & 0xFFFFFFFF
    return found % partitions


def mapping(partitions: int = PARTITIONS) -> str:
    """Return the line of a server's `mappings` that spreads robots over partitions by name."""
    to = f"{BY_PARTITION}.{{{{partition({partitions},1)}}}}.{{{{wildcard(1)}}}}.{{{{wildcard(2)}}}}"
    return f'"{IN}.*.*": "{to}"'
