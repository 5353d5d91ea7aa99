"""What `bridge` and `fleet status` do, and what they share with `worker`."""

from __future__ import annotations

import asyncio
import json
import math
import signal
import time
import tomllib
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live

from failuretwin.app.arms import connect, emulation_with
from failuretwin.app.commands.options import LiveOptions, RobotOptions
from failuretwin.app.terminal import Table, drawn, tell
from failuretwin.connection.fleet import broker as names
from failuretwin.connection.fleet.bridge import Publisher, bridge_fleet, bridge_source
from failuretwin.connection.fleet.broker import Access, Broker, entries, open_broker
from failuretwin.connection.fleet.messages import ROBOT_NAME, ProfileMessage
from failuretwin.core.errors import InputError, counted
from failuretwin.core.foreign import read_text, reading
from failuretwin.decision.fleet.metrics import left_out
from failuretwin.decision.fleet.partition import Resolve
from failuretwin.digital_model.calibrated_robot import calibration_from_table, load_calibration
from failuretwin.digital_model.robot import bundled_robots, load_robot
from failuretwin.inference.diagnoser import BayesDiagnoser

REFRESH_S = 1.0
"""Time between two drawings of the status [s]."""
SHOWN = 20
"""Robots that are listed by name at most."""


def run_until_stopped(work: Callable[[asyncio.Event], Awaitable[None]]) -> None:
    """Run work that ends soon after its event is set, by Ctrl-C or SIGTERM."""

    async def main() -> None:
        stop, loop = asyncio.Event(), asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, stop.set)
        await work(stop)

    asyncio.run(main())


def resolver(folder: Path | None) -> Resolve:
    """Return what finds the method for a profile: a bundled robot, or one in a folder.

    Messages name profiles and never paths.
    """

    @cache
    def resolve(message: ProfileMessage) -> BayesDiagnoser:
        own = None if folder is None else folder / f"{message.profile}.toml"
        if own is not None and own.is_file():
            robot = load_robot(own)
        elif message.profile in bundled_robots():
            robot = load_robot(message.profile)
        else:
            raise InputError(
                f"unknown profile {message.profile!r}, expected a bundled one, or "
                f"{message.profile}.toml in the folder of worker --profiles."
            )
        known = load_calibration(None, robot)
        if message.calibration:
            fix = "Expected the text of a file that `calibrate` wrote."
            with reading("calibration in a profile", "TOML", fix):
                table = tomllib.loads(message.calibration)
            known = calibration_from_table(table, robot, "calibration in a profile")
        return BayesDiagnoser(known.twin, known.imperfections, whole_run=False)

    return resolve


# What `bridge` does: a robot, or a fleet of emulated ones, onto the broker.


def bridge_one(
    access: Access, source: str, name: str, live: LiveOptions, robot: RobotOptions
) -> None:
    """Put one robot on the broker until its source ends, or until stopped."""
    profile = _profile(name, robot)

    async def main(stop: asyncio.Event) -> None:
        with ExitStack() as stack:
            link, _ = connect(source, robot.model, live, robot.seed, stack)
            async with await open_broker(access, f"bridge-{name}") as broker:
                publisher = Publisher(broker, tell, stop, len(robot.model.motors))
                await publisher.announce([name], profile)
                tell(f"{name}: {link.name} to {access.shown}; stop with Ctrl-C")
                await bridge_source(link, name, publisher, stop)
            tell(f"{counted(publisher.sent, 'message')} sent, {link.counts.dropped} events dropped")

    run_until_stopped(main)


def bridge_emulated(
    access: Access, name: str, robots: int, live: LiveOptions, robot: RobotOptions
) -> None:
    """Put emulated robots on the broker; each fault is that of one of them, spread evenly."""
    from failuretwin.connection.emulated_arm import EmulatedFleet

    profile, known = _profile(name, robot), robot.known
    own: dict[int, list[str]] = {}
    for k, fault in enumerate(live.faults):
        own.setdefault(k * robots // len(live.faults), []).append(fault)
    arms = [
        (
            f"{name}_{k}" if robots > 1 else name,
            replace(emulation_with(own.get(k, ()), known, robot.seed + k), seed=robot.seed + k),
        )
        for k in range(robots)
    ]

    async def main(stop: asyncio.Event) -> None:
        async with await open_broker(access, f"bridge-{name}") as broker:
            publisher = Publisher(broker, tell, stop, len(robot.model.motors))
            fleet = EmulatedFleet(arms, time.time(), live.seconds or math.inf)
            await publisher.announce(fleet.names, profile)
            tell(f"{counted(robots, 'emulated robot')} to {access.shown}; stop with Ctrl-C")
            await bridge_fleet(fleet.second, publisher, stop, live.speed)
        tell(f"{counted(publisher.sent, 'message')} sent")

    run_until_stopped(main)


def _profile(name: str, robot: RobotOptions) -> ProfileMessage:
    if not ROBOT_NAME.fullmatch(name):
        raise InputError(f"robot name {name!r}: expected letters, digits, - and _, 64 at most.")
    if robot.calibration is None:
        return ProfileMessage(robot.model.name)
    if not robot.calibration.is_file():
        raise InputError(f"--calibration {robot.calibration}: expected a file, to be sent along.")
    return ProfileMessage(robot.model.name, read_text(robot.calibration, "a calibration"))


# The status of a fleet.


async def read_status(broker: Broker) -> dict[str, Any]:
    """Return what workers have reported, and what the streams hold."""
    from nats.errors import Error

    found: dict[str, Any] = {"workers": {}, "partitions": {}, "leases": {}}
    buckets = (
        ("workers", names.WORKERS),
        ("partitions", names.HEALTH_BUCKET),
        ("leases", names.LEASES),
    )
    for key, name in buckets:
        try:
            stored = await entries(await broker.bucket(name))
        except (Error, TimeoutError):  # nobody has reported yet
            continue
        for one, entry in stored.items():
            value = entry.value or b"{}"
            found[key][one] = value.decode() if key == "leases" else json.loads(value)
    for key, stream in (("waiting", names.EVENTS_STREAM), ("alarms", names.ALARM_STREAM)):
        try:
            found[key] = await broker.messages(stream)
        except (Error, TimeoutError):
            found[key] = None
    return found


def status_page(status: dict[str, Any], now: float) -> Group:
    """Return the status as tables: robots by health, those that need a look, workers."""
    robots = {
        name: table
        for part in status["partitions"].values()
        for name, table in part["robots"].items()
    }
    states = Counter(one["state"] for one in robots.values())
    health = [(str(count), state) for state, count in states.most_common()]
    needy = [name for name, one in robots.items() if one["state"] in LOOK]
    needy.sort(key=lambda name: (LOOK.index(robots[name]["state"]), name))
    looks = [(name, robots[name]["state"], robots[name]["cause"]) for name in needy[:SHOWN]]
    more = f"and {len(needy) - SHOWN} more" if len(needy) > SHOWN else ""
    kept = (
        f"{counted(len(robots), 'robot')}, {status['alarms'] or 0} alarms and ends of alarms kept, "
        f"{status['waiting'] or 0} messages no snapshot covers yet"
    )
    return Group(
        kept,
        drawn(Table(("robots", "state"), health)),
        drawn(Table(("robot", "state", "cause"), looks)),
        more,
        *_left_out(status),
        drawn(_workers(status, now)),
    )


def _left_out(status: dict[str, Any]) -> list[RenderableType]:
    """Return what was left out by reason, and of some robots why."""
    parts = status["partitions"].values()
    counts: Counter[str] = sum(map(left_out, parts), Counter())
    words = ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
    remarks = sorted(one for part in parts for one in part.get("remarks", {}).items())
    tables = [drawn(Table(("robot", "last message left out"), remarks[:SHOWN]))] if remarks else []
    return [f"left out so far: {words or 'nothing'}", *tables]


LOOK = ("alarm", "undecided", "stale", "suspected")
"""States that need a look, the most urgent first."""


def _workers(status: dict[str, Any], now: float) -> Table:
    rows = list[tuple[str, ...]]()
    held: dict[str, list[str]] = {name: [] for name in status["workers"]}
    for key, name in status["leases"].items():
        held.setdefault(name, []).append(key)
    for name, keys in sorted(held.items()):
        parts = [status["partitions"][key] for key in keys if key in status["partitions"]]
        at = status["workers"].get(name, {}).get("at")
        rows.append((
            name,
            ", ".join(sorted(keys)),
            str(sum(len(part["robots"]) for part in parts)),
            f"{sum(part['messages_per_s'] for part in parts):.0f}",
            f"{max((part['lag_s'] for part in parts), default=0.0):.1f}",
            str(sum(part["pending"] for part in parts)),
            "no longer" if at is None else f"{now - at:.0f} s ago",
        ))  # fmt: skip
    free = sorted(set(status["partitions"]) - set(status["leases"]))
    if free:
        rows.append(("nobody", ", ".join(free), *[""] * 5))
    headings = ("worker", "partitions", "robots", "messages/s", "lag [s]", "waiting", "reported")
    return Table(headings, rows)


def show_status(access: Access, console: Console, watch: bool) -> None:
    """Print the status of a fleet once, or again and again until stopped."""

    async def main(stop: asyncio.Event) -> None:
        async with await open_broker(access, "status") as broker:
            if not watch:
                console.print(status_page(await read_status(broker), time.time()))
                return
            with Live(console=console, auto_refresh=False) as live:
                while not stop.is_set():
                    live.update(status_page(await read_status(broker), time.time()), refresh=True)
                    await asyncio.sleep(REFRESH_S)

    run_until_stopped(main)
