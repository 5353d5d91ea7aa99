"""A fleet on a real nats-server: robots a core, latency, memory, bytes; and kills.

    python benchmarks/fleet_broker.py filter --robots 30 100 300 [--healthy]
    python benchmarks/fleet_broker.py broker --robots 50 100 --workers 1 2
    python benchmarks/fleet_broker.py transport --robots 1000 10000
    python benchmarks/fleet_broker.py kills --kills 50 --seconds 700

`filter`: processor time of the filter alone, in this process. `broker`: messages at the pace of the
robots; latency is from the time at which the server took in the message that decides an alarm to
that at which it stored the alarm. `transport`: messages of one second of each robot, stored as fast
as possible. `kills`: workers are killed, paused and cut off, and the server is killed, in turn;
alarms are compared with those of one process without a broker. Robots are emulated by physics;
more than twelve repeat the same lives under other names.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from nats.js.api import AckPolicy, ConsumerConfig

from failuretwin.app.arms import emulation_with, known_arm
from failuretwin.app.fleet import resolver
from failuretwin.connection.emulated_arm import EmulatedFleet
from failuretwin.connection.fleet.broker import (
    ALARM_STREAM,
    EVENTS_STREAM,
    IN,
    LEASES,
    Access,
    Broker,
    open_broker,
    server_config,
)
from failuretwin.connection.fleet.messages import ProfileMessage, events_binary, profile_json
from failuretwin.connection.links.base import Event
from failuretwin.decision.fleet.partition import EVENTS, PROFILE, Envelope, Partition
from failuretwin.digital_model.robot import load_robot

T = TypeVar("T")
ROBOT, LIVES, PARTITIONS = "armpi_fpv", 12, 8
Second = list[tuple[str, list[Event]]]
"""Events of each robot in one second."""
WAIT_S = 60.0
"""Longest wait for partitions to be taken [s]."""


def lives(robots: int, seconds: float, faults: Callable[[int], Sequence[str]]) -> list[Second]:
    """Return the events of some emulated robots, second by second; clocks are 1000 s apart."""
    known = known_arm(load_robot(ROBOT))
    arms = [(f"arm_{k}", emulation_with(faults(k), known, seed=k)) for k in range(robots)]
    fleet, found = EmulatedFleet(arms, 0.0, seconds), list[Second]()
    while (second := fleet.second()) is not None:
        found.append(
            [
                (name, [replace(one, time=one.time + 1000.0 * k) for one in events])
                for k, (name, events) in enumerate(second)
            ]
        )
    return found


def repeated(seconds: list[Second], robots: int) -> list[Second]:
    """Return the same for more robots, which repeat the lives under other names."""
    return [[(f"arm_{k}", second[k % len(second)][1]) for k in range(robots)] for second in seconds]


def now_and_then(number: int) -> Sequence[str]:
    """Return faults that come after 30 s, of two robots in three."""
    return ((), ("motor_3:stuck@30",), ("motor_2:stuck@25-40",))[number % 3]


def again_and_again(length_s: float) -> Callable[[int], Sequence[str]]:
    """Return faults that come and go over a length of time, of every robot at other times."""

    def faults(number: int) -> Sequence[str]:
        begins = np.arange(40.0 + 3.0 * number, length_s - 40.0, 60.0)
        return [f"motor_{2 + k % 2}:stuck@{at:g}-{at + 25:g}" for k, at in enumerate(begins)]

    return faults


def payloads(second: Second) -> list[tuple[str, bytes]]:
    """Return the messages of a second, compact."""
    return [(name, events_binary(events, 4)) for name, events in second]


def envelopes(seconds: list[Second]) -> list[Envelope]:
    """Return the messages as a server numbers them."""
    profile = profile_json(ProfileMessage(ROBOT))
    found = [Envelope(k + 1, 1e9, name, PROFILE, profile) for k, (name, _) in enumerate(seconds[0])]
    for number, second in enumerate(seconds):
        for name, data in payloads(second):
            found.append(Envelope(len(found) + 1, 1e9 + number + 1, name, EVENTS, data))
    return found


# The filter alone.


def filter_alone(robots: Sequence[int], healthy: bool) -> None:
    """Print processor time and memory of the filter; of robots that fail after 30 s, or of none."""
    seconds = lives(LIVES, 40.0, (lambda number: ()) if healthy else now_and_then)
    for count in robots:
        before = memory_mb(os.getpid())
        messages = envelopes(repeated(seconds, count))
        partition = Partition(resolver(None))
        half, took = count * (1 + len(seconds) // 2), 0.0
        partition.take(messages[:half])
        begun = time.process_time()
        for first in range(half, len(messages), count):
            partition.take(messages[first : first + count])
        took = (time.process_time() - begun) / (len(seconds) - len(seconds) // 2)
        snapshot = len(partition.snapshot()) / count / 1e3
        grown = (memory_mb(os.getpid()) - before) / count * 1e3
        print(
            f"{count} robots: {took:.2f} s of a core a second, {count / took:.0f} robots a core; "
            f"memory {grown:.0f} kB a robot with its messages, snapshot {snapshot:.0f} kB a robot",
            flush=True,
        )


def memory_mb(process: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def processor_s(process: int) -> float:
    """Return the processor time that a process has used [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# A server and workers.


def free_port() -> int:
    """Return a port that nobody uses."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


@dataclass
class Server:
    """A nats-server with its folder."""

    folder: Path
    port: int
    process: subprocess.Popen[bytes] | None = None

    @classmethod
    def started(cls) -> Server:
        """Return a new server."""
        made = cls(Path(tempfile.mkdtemp(prefix="fleet_broker_")), free_port())
        config = server_config(made.port, free_port(), made.folder / "data", PARTITIONS)
        (made.folder / "nats.conf").write_text(config)
        made.start()
        return made

    @property
    def url(self) -> str:
        """Its address."""
        return f"nats://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Start it, or start it again."""
        program = shutil.which("nats-server", path=f"{os.environ['PATH']}:/usr/sbin")
        if program is None:
            sys.exit("no nats-server here; install the package `nats-server`")
        with (self.folder / "nats.log").open("ab") as log:
            self.process = subprocess.Popen(
                [program, "-c", str(self.folder / "nats.conf")], stdout=log, stderr=log
            )
        for _ in range(200):
            with socket.socket() as one:
                if one.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)

    def kill(self) -> None:
        """End it without warning."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()


def start_worker(url: str, name: str, folder: Path, snapshot_s: float) -> subprocess.Popen[bytes]:
    """Start a worker whose output goes to a file."""
    words = ["worker", url, "--name", name, "--snapshot", f"{snapshot_s:g}"]
    with (folder / f"{name}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-u", "-m", "failuretwin", *words], stdout=log, stderr=log
        )


def ask(url: str, question: Callable[[Broker], Awaitable[T]]) -> T:
    """Return the answer of a question to the server."""

    async def main() -> T:
        broker = await open_broker(Access(url), "benchmark")
        try:
            return await question(broker)
        finally:
            await broker.close()

    return asyncio.run(main())


async def holders(broker: Broker) -> dict[str, str]:
    """Return who holds each partition."""
    bucket = await broker.bucket(LEASES)
    found = {}
    with suppress(Exception):
        for key in await bucket.keys():
            found[key] = ((await bucket.get(key)).value or b"").decode()
    return found


async def alarms(broker: Broker) -> list[tuple[dict[str, Any], float]]:
    """Return all changes of alarms, and when the server stored each [s since 1970]."""
    state = (await broker.stream.stream_info(ALARM_STREAM)).state
    found = []
    for number in range(state.first_seq, state.last_seq + 1):
        one = await broker.stream.get_msg(ALARM_STREAM, number)
        stored = np.datetime64(str(one.time).split("+")[0].rstrip("Z")).astype("datetime64[us]")
        found.append((json.loads(one.data or b"{}"), float(stored.astype(np.int64)) / 1e6))
    return found


def wait_until_held(url: str, workers: set[str]) -> float:
    """Wait until all partitions are held by some of the workers; return how long it took [s]."""
    begun = time.monotonic()
    while time.monotonic() - begun < WAIT_S:
        with suppress(Exception):
            held = ask(url, holders)
            if len(held) == PARTITIONS and set(held.values()) <= workers:
                break
        time.sleep(0.1)
    return time.monotonic() - begun


async def play(broker: Broker, seconds: list[Second], pace: float, stop: threading.Event) -> None:
    """Publish the messages of robots, a second in 1 / `pace` s, each until it is stored."""
    due = time.monotonic()
    for number, second in enumerate(seconds):
        if stop.is_set():
            return
        messages = payloads(second)
        for first in range(0, len(messages), 500):
            some = messages[first : first + 500]
            await asyncio.gather(*(stored(broker, *one, number) for one in some))
        due += 1.0 / pace
        await asyncio.sleep(max(0.0, due - time.monotonic()))


async def stored(broker: Broker, name: str, data: bytes, number: int) -> None:
    """Store a message, once, however often it must be tried."""
    headers = {"Nats-Msg-Id": f"{name}-{number}"}
    while True:
        with suppress(Exception):
            await broker.stream.publish(f"{IN}.{name}.events", data, timeout=2.0, headers=headers)
            return
        await asyncio.sleep(0.2)


async def announce(broker: Broker, robots: int) -> None:
    """Announce the profiles of robots."""
    data = profile_json(ProfileMessage(ROBOT))
    for k in range(robots):
        await broker.stream.publish(f"{IN}.arm_{k}.profile", data)


def through_broker(robots: Sequence[int], workers: Sequence[int]) -> None:
    """Print latency, processor time and memory with workers in processes of their own."""
    seconds = lives(LIVES, 60.0, now_and_then)
    for count in robots:
        played = repeated(seconds, count)
        size = sum(len(data) for second in played for _, data in payloads(second)) / len(played)
        for number in workers:
            server = Server.started()
            names = {f"w{k}" for k in range(number)}
            processes = [start_worker(server.url, name, server.folder, 20.0) for name in names]
            wait_until_held(server.url, names)
            ask(server.url, lambda broker, count=count: announce(broker, count))  # type: ignore[misc]
            used = [processor_s(one.pid) for one in processes]
            begun = time.monotonic()
            ask(
                server.url,
                lambda broker, played=played: play(broker, played, 1.0, threading.Event()),  # type: ignore[misc]
            )
            lasted = time.monotonic() - begun
            time.sleep(5.0)
            spent = [processor_s(p.pid) - u for p, u in zip(processes, used, strict=True)]
            memory = sum(memory_mb(one.pid) for one in processes)
            delays = np.array([at - change["at"] for change, at in ask(server.url, alarms)])
            left = ask(server.url, lambda b: b.stream.stream_info(EVENTS_STREAM)).state.messages
            print(
                f"{count} robots, {number} workers: {len(delays)} alarms, latency median "
                f"{np.median(delays):.2f} s, 99 % {np.quantile(delays, 0.99):.2f} s; "
                f"{sum(spent) / lasted:.2f} cores; {memory:.0f} MB; {size / 1e3:.0f} kB/s in; "
                f"played in {lasted:.0f} s of {len(played)}; {left} messages uncovered",
                flush=True,
            )
            end(processes, server)


def end(processes: Sequence[subprocess.Popen[bytes]], server: Server) -> None:
    """End workers, then the server."""
    for process in processes:
        process.terminate()
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(60)
        process.kill()
    server.kill()


def transport(robots: Sequence[int]) -> None:
    """Print how fast the messages of one second of robots are stored and fetched."""
    seconds = lives(LIVES, 4.0, lambda _: ())
    for count in robots:
        server = Server.started()
        messages = payloads(repeated(seconds, count)[2])

        async def store(
            broker: Broker, count: int = count, messages: list[tuple[str, bytes]] = messages
        ) -> tuple[float, float]:
            await broker.set_up()
            begun = time.monotonic()
            for first in range(0, count, 500):
                some = messages[first : first + 500]
                await asyncio.gather(*(stored(broker, *one, 0) for one in some))
            put = time.monotonic() - begun
            source = await broker.stream.pull_subscribe(
                "fleet.p.>",
                durable="all",
                stream=EVENTS_STREAM,
                config=ConsumerConfig(ack_policy=AckPolicy.NONE),
            )
            begun, got = time.monotonic(), 0
            while got < count:
                got += len(await source.fetch(min(4000, count - got), timeout=5))
            return put, time.monotonic() - begun

        put, got = ask(server.url, store)
        size = sum(len(data) for _, data in messages)
        print(
            f"{count} robots: {count / put:.0f} messages/s stored, {count / got:.0f} fetched, "
            f"{size / count:.0f} bytes each",
            flush=True,
        )
        server.kill()


# Kills.


class Proxy:
    """A network that can be cut: bytes are dropped and nobody is told."""

    def __init__(self, to: int) -> None:
        self.port, self.cut, self._to = free_port(), False, to
        threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True).start()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._connect, "127.0.0.1", self.port)
        await server.serve_forever()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._to)
        except OSError:
            writer.close()
            return
        await asyncio.gather(self._pump(reader, back), self._pump(there, writer))

    async def _pump(self, source: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await source.read(65536):
                if not self.cut:
                    to.write(data)
                    await to.drain()
        to.close()


def decided(changes: Sequence[Any]) -> Counter[tuple[Any, ...]]:
    """Return what was decided, whenever it came to the server."""
    keys = ("robot", "episode", "state", "cause", "before", "stream_s")
    return Counter(tuple(one[key] for key in keys) for one in changes)


class Interrupted:
    """A server and three workers that are interrupted; the last one is behind a proxy.

    Attributes:
        took: Times until others held all partitions, by kind [s].

    Args:
        pause_s: How long a worker is paused, if others have taken over by then [s].
    """

    KINDS = ("kill -9 of a worker", "SIGSTOP", "network cut", "kill -9 of the server", "upgrade")

    def __init__(self, pause_s: float) -> None:
        self.took: dict[str, list[float]] = {kind: [] for kind in self.KINDS}
        self._pause_s = pause_s
        self.server = Server.started()
        self._proxy = Proxy(self.server.port)
        self.workers: dict[str, subprocess.Popen[bytes]] = {}
        self._number = 0
        self._start()
        self._start()
        far = f"nats://127.0.0.1:{self._proxy.port}"
        self.workers["far"] = start_worker(far, "far", self.server.folder, 10.0)
        wait_until_held(self.url, set(self.workers))

    @property
    def url(self) -> str:
        """Address of the server."""
        return self.server.url

    def _start(self) -> None:
        name = f"w{self._number:03d}"
        self._number += 1
        self.workers[name] = start_worker(self.url, name, self.server.folder, 10.0)

    def _settle(self) -> None:
        """Wait until every worker holds something."""
        for _ in range(150):
            with suppress(Exception):
                held = ask(self.url, holders)
                if len(held) == PARTITIONS and set(held.values()) == set(self.workers):
                    return
            time.sleep(0.2)

    def interrupt(self, kind: str) -> None:
        """Interrupt something and wait until all partitions are held again."""
        self._settle()
        begun = time.monotonic()
        if kind == "network cut":
            self._proxy.cut = True
            wait_until_held(self.url, set(self.workers) - {"far"})
        elif kind == "kill -9 of the server":
            self.server.kill()
            time.sleep(1.0)
            self.server.start()
            wait_until_held(self.url, set(self.workers))
        else:
            self._interrupt_worker(kind)
        took = time.monotonic() - begun
        self.took[kind].append(took)
        self._proxy.cut = False
        print(f"    {kind}: {took:.1f} s", flush=True)
        if kind == "SIGSTOP":
            time.sleep(max(0.0, self._pause_s - took))
            self._paused.send_signal(signal.SIGCONT)

    def _interrupt_worker(self, kind: str) -> None:
        name = min(set(self.workers) - {"far"})
        victim, signals = self.workers.pop(name), {"SIGSTOP": signal.SIGSTOP}
        usual = signal.SIGTERM if kind == "upgrade" else signal.SIGKILL
        victim.send_signal(signals.get(kind, usual))
        wait_until_held(self.url, set(self.workers))
        if kind == "SIGSTOP":
            self.workers[name] = self._paused = victim
        else:
            victim.wait(120)  # it gives its partitions 60 s
            self._start()


def kills(count: int, length_s: float, robots: int, pause_s: float) -> None:
    """Kill, pause and cut off; print what was lost or doubled, and times to take over."""
    seconds = lives(robots, length_s, again_and_again(length_s))
    reference = Partition(resolver(None))
    expected = decided([vars(one) for one in reference.take(envelopes(seconds))])
    fleet, stop = Interrupted(pause_s), threading.Event()
    url = fleet.url
    ask(url, lambda broker: announce(broker, robots))
    playing = threading.Thread(target=lambda: ask(url, lambda b: play(b, seconds, 1.0, stop)))
    playing.start()
    for turn in range(count):
        fleet.interrupt(Interrupted.KINDS[turn % len(Interrupted.KINDS)])
    print(
        f"  {count} interruptions; {'still' if playing.is_alive() else 'not'} playing", flush=True
    )
    playing.join()
    begun, found = time.monotonic(), Counter[tuple[Any, ...]]()
    while time.monotonic() - begun < 90.0 and sum(found.values()) < sum(expected.values()):
        time.sleep(2.0)
        found = decided([change for change, _ in ask(url, alarms)])
    time.sleep(5.0)
    found = decided([change for change, _ in ask(url, alarms)])
    end(list(fleet.workers.values()), fleet.server)
    lost, more = expected - found, found - expected
    doubled = sum(value - 1 for value in found.values() if value > 1)
    print(
        f"{robots} robots, {length_s:.0f} s, {count} interruptions: "
        f"{sum(expected.values())} changes of alarms expected, {sum(lost.values())} lost, "
        f"{doubled} doubled, {sum(more.values())} others"
    )
    for kind, each in fleet.took.items():
        if each:
            print(
                f"  {kind}: {len(each)} times, taken over after {np.median(each):.1f} s "
                f"(median), {max(each):.1f} s (worst)"
            )
    print(f"  logs: {fleet.server.folder}", flush=True)


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=["filter", "broker", "transport", "kills"])
    parser.add_argument("--robots", type=int, nargs="+", default=[100])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--healthy", action="store_true", help="filter robots without faults")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=700.0)
    parser.add_argument("--pause", type=float, default=0.0)
    told = parser.parse_args()
    if told.part == "filter":
        filter_alone(told.robots, told.healthy)
    elif told.part == "broker":
        through_broker(told.robots, told.workers)
    elif told.part == "transport":
        transport(told.robots)
    else:
        kills(told.kills, told.seconds, told.robots[0], told.pause)


if __name__ == "__main__":
    main()
