"""A worker: holds partitions by leases, filters their robots, and keeps snapshots of them.

Whoever holds the lease of a partition goes on from its last snapshot and replays what came after
it. Its alarms are the same again, and the server stores each once. A lease that has not been
renewed while somebody looked at it several times is free: whoever replaces that very revision of
it has it. So no clock matters. A worker that was paused finds that its lease is another's when it
goes on; what it still says is known already.

Section: docs/fleet.md#workers
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from failuretwin.connection.fleet import broker as names
from failuretwin.connection.fleet.broker import Broker, entries
from failuretwin.connection.fleet.messages import ProfileMessage, parse_profile
from failuretwin.core.errors import InputError, counted
from failuretwin.decision.fleet.metrics import Metrics
from failuretwin.decision.fleet.partition import PROFILE, AlarmChange, Envelope, Partition, Resolve
from failuretwin.decision.fleet.source import LeaseLostError, MessageSource, Snapshots

if TYPE_CHECKING:
    from nats.js.kv import KeyValue
    from nats.js.object_store import ObjectStore

T = TypeVar("T")
RENEW_S = 1.5
"""Time between two looks at the leases [s]; own ones are renewed then."""
UNCHANGED, FORGOTTEN = 4, 40
"""Looks in a row at which a lease or a worker has not changed, from which it is dead, and from
which the name of a worker is deleted."""
CYCLE_S = 0.5
"""Least time between two fetches [s], so that many robots are judged together."""
FETCH = 4000
"""Messages that are fetched at once at most."""
HEALTH_S = 2.0
"""Time between two reports of health [s]."""
SILENCE_S = 10.0
"""Time without a message after which a robot is stale [s]."""
BEHIND_S = 10.0
"""Delay from which a worker says that it cannot follow [s]."""
STALE = "stale"
ABANDON_S = 5.0
"""Longest wait for work that is abandoned [s]."""


@dataclass(frozen=True)
class Settings:
    """How a worker works.

    Attributes:
        name: Its name, one of its own.
        partitions: Partitions of the fleet, as the mapping of the server says.
        snapshot_s: Time between two snapshots of a partition [s].
        budget: False alarms in 100 hours that are allowed of each robot.
    """

    name: str
    partitions: int = names.PARTITIONS
    snapshot_s: float = 30.0
    budget: float = 1.0


@dataclass
class Outlets:
    """Where a worker says what it finds, besides the server.

    Attributes:
        tell: Takes a line for the user.
        retain: Takes a topic and a message that MQTT clients get when they come; None: nobody.
        metrics: Figures of the worker.
    """

    tell: Callable[[str], None]
    metrics: Metrics
    retain: Callable[[str, bytes], None] | None = None


@dataclass
class Buckets:
    """Buckets of the fleet."""

    leases: KeyValue
    workers: KeyValue
    snapshots: KeyValue
    health: KeyValue
    profiles: KeyValue
    states: ObjectStore

    @classmethod
    async def of(cls, broker: Broker) -> Buckets:
        """Return the buckets of a server, made where they are missing."""
        return cls(
            await broker.bucket(names.LEASES),
            await broker.bucket(names.WORKERS),
            await broker.bucket(names.SNAPSHOTS),
            await broker.bucket(names.HEALTH_BUCKET),
            await broker.bucket(names.PROFILES),
            await broker.states(),
        )


class Worker:
    """One worker; `run` works until it is stopped.

    Args:
        broker: The server.
        settings: How it works.
        resolve: Finds the method for a profile.
        outlets: Where it says what it finds.
    """

    def __init__(
        self, broker: Broker, settings: Settings, resolve: Resolve, outlets: Outlets
    ) -> None:
        self.broker, self.settings, self.resolve = broker, settings, resolve
        self.outlets = outlets
        self.buckets: Buckets
        self._held: dict[int, _Holder] = {}
        self._leases, self._workers = _Watched(), _Watched()
        self._computer = ThreadPoolExecutor(1, "filter")
        self._trouble = ""

    async def run(self, stop: asyncio.Event) -> None:
        """Work until `stop` is set, then hand everything over."""
        await self.broker.set_up()
        self.buckets = await Buckets.of(self.broker)
        while not stop.is_set():
            await self._look()
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), RENEW_S)
        await asyncio.gather(*map(self._release, list(self._held.values())))
        with suppress(Exception):
            await self.buckets.workers.delete(self.settings.name)
        self._computer.shutdown()

    async def compute(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of work in the one thread for it."""
        return await asyncio.get_running_loop().run_in_executor(self._computer, work, *values)

    async def _look(self) -> None:
        """Renew what is held, take what is free and due to us, give what is too much."""
        from nats.errors import Error

        try:
            await self._renew()
            await self._balance()
        except (Error, OSError, TimeoutError) as error:
            if not self._trouble:
                self._trouble = f"the server does not answer ({type(error).__name__}); trying again"
                self.outlets.tell(self._trouble)
            return
        if self._trouble:
            self._trouble = ""
            self.outlets.tell("the server answers again")

    async def _renew(self) -> None:
        from nats.js.errors import KeyWrongLastSequenceError

        for holder in list(self._held.values()):
            asked_s = time.monotonic()
            try:
                holder.lease = await self.buckets.leases.update(
                    holder.key, self.settings.name.encode(), last=holder.lease
                )
            except KeyWrongLastSequenceError:
                await self._drop(holder, "another worker has it")
                continue
            holder.renewed_s = asked_s
            if holder.task.done():
                await self._drop(holder, "its work failed")

    async def _balance(self) -> None:
        table = {"partitions": sorted(self._held), "at": time.time()}
        await self.buckets.workers.put(self.settings.name, json.dumps(table).encode())
        await self._workers.look(self.buckets.workers)
        await self._leases.look(self.buckets.leases)
        for name in self._workers.unchanged(FORGOTTEN):
            await self.buckets.workers.delete(name)
        alive = len(self._workers.revisions) - len(self._workers.unchanged(UNCHANGED))
        due = math.ceil(self.settings.partitions / max(alive, 1))
        self.outlets.metrics.workers.set(alive)
        if len(self._held) > due:
            await self._release(max(self._held.values(), key=lambda one: one.number))
        elif len(self._held) < due:
            await self._take(due - len(self._held))

    async def _take(self, most: int) -> None:
        """Take partitions that nobody holds, or whose holders have died."""
        from nats.js.errors import KeyWrongLastSequenceError

        known, dead = self._leases.revisions, self._leases.unchanged(UNCHANGED)
        keys = {f"p{number}": number for number in range(self.settings.partitions)}
        free = [key for key in keys if key not in known or key in dead]
        own, leases = self.settings.name.encode(), self.buckets.leases
        for key in free[:most]:
            try:
                if key in known:
                    lease = await leases.update(key, own, last=known[key])
                else:
                    lease = await leases.create(key, own)
            except KeyWrongLastSequenceError:  # somebody was faster
                continue
            self._held[keys[key]] = _Holder(self, keys[key], lease)
            self.outlets.metrics.partitions.set(len(self._held))

    async def _release(self, holder: _Holder) -> None:
        """Hand a partition over with a snapshot of it."""
        with suppress(Exception):
            await asyncio.wait_for(holder.finish(), 60.0)
        with suppress(Exception):
            await self.buckets.leases.delete(holder.key, last=holder.lease)
        await self._drop(holder, "")

    async def _drop(self, holder: _Holder, why: str) -> None:
        self._held.pop(holder.number, None)
        self.outlets.metrics.partitions.set(len(self._held))
        await holder.abandon()
        self.outlets.metrics.forget(holder.key)
        if why:
            self.outlets.tell(f"partition {holder.number} is given up: {why}")


class _Watched:
    """The entries of a bucket as they were seen, look by look.

    Attributes:
        revisions: Newest revision of each key.
    """

    def __init__(self) -> None:
        self.revisions: dict[str, int] = {}
        self._looks: dict[str, int] = {}

    async def look(self, bucket: KeyValue) -> None:
        """Look at all entries."""
        found = {key: entry.revision or 0 for key, entry in (await entries(bucket)).items()}
        self._looks = {
            key: self._looks[key] + 1 if self.revisions.get(key) == revision else 0
            for key, revision in found.items()
        }
        self.revisions = found

    def unchanged(self, looks: int) -> set[str]:
        """Return the keys that have not changed for some looks."""
        return {key for key, count in self._looks.items() if count >= looks}


@dataclass
class _Reported:
    """What was last reported of a partition."""

    at_s: float = -math.inf
    states: dict[str, tuple[str, str]] = field(default_factory=dict)
    behind: bool = False
    remarks: frozenset[str] = frozenset()


class _Holder:
    """Work on one partition while its lease is held."""

    def __init__(self, worker: Worker, number: int, lease: int) -> None:
        self.number, self.key, self.lease = number, f"p{number}", lease
        self.renewed_s = time.monotonic()
        self._worker = worker
        self._stop = asyncio.Event()
        self._source = MessageSource(worker.broker.stream, number)
        self._snapshots = Snapshots(worker.buckets.snapshots, worker.buckets.states, self.key)
        self._saved_s, self._saved = time.monotonic(), 0
        self._lag_s, self._taken = 0.0, 0
        self._reported = _Reported()
        self._careful = self._abandoned = False
        self._partition: Partition
        self.task = asyncio.create_task(self._run())

    async def finish(self) -> None:
        """End the work with a snapshot."""
        self._stop.set()
        await self.task

    async def abandon(self) -> None:
        """End the work at once, without a snapshot."""
        self._abandoned = True
        self._stop.set()
        self.task.cancel()
        await asyncio.wait({self.task}, timeout=ABANDON_S)
        if self.task.done() and not self.task.cancelled():
            self.task.exception()  # was told

    async def _run(self) -> None:
        try:
            await self._begin()
            while not self._stop.is_set():
                begun_s = time.monotonic()
                full = await self._step()
                await self._report()
                if time.monotonic() - self._saved_s > self._worker.settings.snapshot_s:
                    await self._save()
                if not full:
                    await asyncio.sleep(max(0.0, CYCLE_S - (time.monotonic() - begun_s)))
            if not self._abandoned:
                await self._save()
        except Exception as error:
            self._worker.outlets.tell(f"partition {self.number}: {_short(error)}")
            raise
        finally:
            await self._source.close()

    async def _begin(self) -> None:
        """Go on from the last snapshot, or begin anew with the profiles that are known."""
        begun_s = time.monotonic()
        worker = self._worker
        await self._patiently(self._load)
        took = time.monotonic() - begun_s
        worker.outlets.metrics.taken_over.inc()
        robots = counted(len(self._partition.announced), "robot")
        worker.outlets.tell(
            f"partition {self.number}: {robots}, from message {self._partition.last}, {took:.1f} s"
        )

    async def _load(self) -> None:
        worker, budget, last = self._worker, self._worker.settings.budget, 0
        stored = await self._snapshots.load()
        if stored is not None:
            data, last = stored
            try:
                self._partition = await worker.compute(
                    Partition.restored, data, worker.resolve, budget
                )
                return
            except InputError as error:  # of another version, in an upgrade
                worker.outlets.tell(f"partition {self.number}: {error} Its robots begin anew.")
        self._partition = Partition(worker.resolve, budget, await self._announced(), last)

    async def _announced(self) -> dict[str, ProfileMessage]:
        """Return the profiles that are known of the robots of this partition."""
        found, of = {}, self._worker.settings.partitions
        for name, entry in (await entries(self._worker.buckets.profiles)).items():
            if names.partition_of(name, of) == self.number:
                with suppress(InputError):
                    found[name] = parse_profile(entry.value or b"")
        return found

    async def _step(self) -> bool:
        """Take what has come, and return whether there may be more at once."""
        most = 1 if self._careful else FETCH
        envelopes = await self._source.fetch(self._partition.last, most)
        if envelopes:
            await self._take(envelopes)
        else:
            self._lag_s = 0.0
        return len(envelopes) >= FETCH

    async def _take(self, envelopes: list[Envelope]) -> None:
        """Filter messages, then say what has changed."""
        for one in envelopes:
            if one.kind == PROFILE:
                with suppress(InputError):
                    parse_profile(one.data)
                    await self._patiently(self._worker.buckets.profiles.put, one.robot, one.data)
        try:
            changes = await self._worker.compute(self._partition.take, envelopes)
        except Exception as error:  # a message that breaks the filter must end no worker
            await self._refuse(envelopes, error)
            return
        self._lag_s = max(0.0, self._source.server_now() - envelopes[-1].server_s)
        self._taken += len(envelopes)
        self._worker.outlets.metrics.messages.inc(len(envelopes))
        for change in changes:
            await self._patiently(self._tell, change)

    async def _refuse(self, envelopes: list[Envelope], error: Exception) -> None:
        """Go back to the snapshot; message by message, until the robot behind it is known."""
        refused = set(self._partition.refused)
        if len(envelopes) == 1:
            refused.add(envelopes[0].robot)
        self._worker.outlets.tell(f"partition {self.number}: {_short(error)}; going back")
        self._careful = len(envelopes) > 1
        await self._patiently(self._load)
        self._partition.refused |= refused
        await self._source.close()

    async def _tell(self, change: AlarmChange) -> None:
        """Store a change of an alarm; one that was stored before is not new."""
        data = json.dumps(asdict(change)).encode()
        subject = f"{names.ALARM}.{change.identity}"
        if not await self._worker.broker.publish_once(subject, data):
            return
        outlets = self._worker.outlets
        outlets.metrics.alarms.labels(change.state).inc()
        outlets.tell(f"{change.robot}: {change.state}: {change.cause} (episode {change.episode})")
        if outlets.retain is not None:
            outlets.retain(f"fleet/alarm/{change.robot}", data)

    async def _patiently(self, work: Callable[..., Awaitable[T]], *values: Any) -> T:
        """Return the result of work with the server, tried until it answers.

        Raises:
            LeaseLostError: If the work is to end meanwhile.
        """
        from nats.errors import Error

        while True:
            try:
                return await work(*values)
            except (Error, OSError, TimeoutError):
                if self._stop.is_set():
                    raise LeaseLostError(f"partition {self.number}") from None
                await asyncio.sleep(0.5)

    async def _save(self) -> None:
        """Store a snapshot, and let the server forget the messages that it covers."""
        from nats.errors import Error

        begun_s, last = time.monotonic(), self._partition.last
        self._saved_s = begun_s
        if last == self._saved:
            return
        data = await self._worker.compute(self._partition.snapshot)
        try:
            await self._snapshots.store(data, last)
            await self._source.acknowledge()
            await self._worker.broker.stream.purge_stream(
                names.EVENTS_STREAM, subject=self._source.subject, seq=last + 1
            )
        except (Error, OSError, TimeoutError) as error:
            said = f"partition {self.number}: no snapshot ({_short(error)}); trying again"
            self._worker.outlets.tell(said)
            return
        self._saved = last
        metrics = self._worker.outlets.metrics
        metrics.snapshot_bytes.labels(self.key).set(len(data))
        metrics.snapshot_seconds.observe(time.monotonic() - begun_s)

    async def _report(self) -> None:
        """Publish health and lag now and then; robots whose state changes by themselves."""
        now_s, before = time.monotonic(), self._reported
        if now_s - before.at_s < HEALTH_S or not self._source.heard_to_s:
            return
        if now_s - self.renewed_s > UNCHANGED * RENEW_S:  # paused or cut off: may be another's
            return
        robots, remarks = self._partition.health(), dict(self._partition.remarks)
        for table in robots.values():
            if self._source.heard_to_s - table["heard"] > SILENCE_S:
                table["state"] = STALE
        for name in remarks.keys() - before.remarks:
            self._worker.outlets.tell(f"{name}: message left out: {remarks[name]}")
        rate = self._taken / (now_s - before.at_s) if math.isfinite(before.at_s) else 0.0
        report = {
            "worker": self._worker.settings.name,
            "at": time.time(),
            "robots": robots,
            "counts": dict(self._partition.counts),
            "remarks": remarks,
            "pending": self._source.pending,
            "lag_s": round(self._lag_s, 3),
            "messages_per_s": round(rate, 1),
        }
        self._taken = 0
        states = {name: (one["state"], one["cause"]) for name, one in robots.items()}
        changed = {
            name: robots[name] for name, now in states.items() if before.states.get(name) != now
        }
        behind = self._lag_s > BEHIND_S
        if behind != before.behind:
            waiting = f"{self._source.pending} messages, {self._lag_s:.0f} s behind"
            said = f"cannot follow: {waiting}; nothing is lost" if behind else "follows again"
            self._worker.outlets.tell(f"partition {self.number}: {said}")
        self._reported = _Reported(now_s, states, behind, frozenset(remarks))
        self._worker.outlets.metrics.report(self.key, report)
        await self._publish_health(report, changed)

    async def _publish_health(
        self, report: Mapping[str, Any], changed: Mapping[str, Mapping[str, Any]]
    ) -> None:
        from nats.errors import Error

        with suppress(Error, OSError, TimeoutError):
            await self._worker.buckets.health.put(self.key, json.dumps(report).encode())
            for name, table in changed.items():
                data = json.dumps({"robot": name, **table}).encode()
                await self._worker.broker.client.publish(f"{names.HEALTH}.{name}", data)
                if self._worker.outlets.retain is not None:
                    self._worker.outlets.retain(f"fleet/health/{name}", data)


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:LONGEST_REASON]}"


LONGEST_REASON = 200
"""Longest text of an error that is told [characters]."""
