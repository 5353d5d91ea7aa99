"""What `bridge`, `worker` and `fleet status` do."""

from __future__ import annotations

import asyncio
import json
import signal
import time
import tomllib
from collections import Counter
from collections.abc import Awaitable, Callable
from functools import cache
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table

from failuretwin.connection.fleet import broker as names
from failuretwin.connection.fleet.broker import Access, Broker, entries, open_broker
from failuretwin.connection.fleet.messages import ProfileMessage
from failuretwin.core.errors import InputError, counted
from failuretwin.core.foreign import printable
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
            try:
                table = tomllib.loads(message.calibration)
            except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
                raise InputError(
                    f"calibration in a profile: {error}. Expected the text of a file that "
                    "`calibrate` wrote."
                ) from error
            known = calibration_from_table(table, robot, "calibration in a profile")
        return BayesDiagnoser(known.twin, known.imperfections, whole_run=False)

    return resolve


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
    health = _table("robots", "state")
    for state, count in states.most_common():
        health.add_row(str(count), state)
    looks = _table("robot", "state", "cause")
    needy = [name for name, one in robots.items() if one["state"] in LOOK]
    needy.sort(key=lambda name: (LOOK.index(robots[name]["state"]), name))
    for name in needy[:SHOWN]:
        looks.add_row(name, robots[name]["state"], printable(robots[name]["cause"]))
    more = f"and {len(needy) - SHOWN} more" if len(needy) > SHOWN else ""
    kept = (
        f"{counted(len(robots), 'robot')}, {status['alarms'] or 0} alarms and ends of alarms kept, "
        f"{status['waiting'] or 0} messages no snapshot covers yet"
    )
    return Group(kept, health, looks, more, *_left_out(status), _workers(status, now))


def _left_out(status: dict[str, Any]) -> list[RenderableType]:
    """Return what was left out by reason, and of some robots why."""
    parts = status["partitions"].values()
    counts: Counter[str] = sum(map(left_out, parts), Counter())
    words = ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
    remarks = sorted(one for part in parts for one in part.get("remarks", {}).items())
    table = _table("robot", "last message left out")
    for name, text in remarks[:SHOWN]:
        table.add_row(name, printable(text))
    return [f"left out so far: {words or 'nothing'}", *([table] if remarks else [])]


LOOK = ("alarm", "undecided", "stale", "suspected")
"""States that need a look, the most urgent first."""


def _workers(status: dict[str, Any], now: float) -> Table:
    table = _table("worker", "partitions", "robots", "messages/s", "lag [s]", "waiting", "reported")
    held: dict[str, list[str]] = {name: [] for name in status["workers"]}
    for key, name in status["leases"].items():
        held.setdefault(name, []).append(key)
    for name, keys in sorted(held.items()):
        parts = [status["partitions"][key] for key in keys if key in status["partitions"]]
        at = status["workers"].get(name, {}).get("at")
        table.add_row(
            name,
            ", ".join(sorted(keys)),
            str(sum(len(part["robots"]) for part in parts)),
            f"{sum(part['messages_per_s'] for part in parts):.0f}",
            f"{max((part['lag_s'] for part in parts), default=0.0):.1f}",
            str(sum(part["pending"] for part in parts)),
            "no longer" if at is None else f"{now - at:.0f} s ago",
        )
    free = sorted(set(status["partitions"]) - set(status["leases"]))
    if free:
        table.add_row("nobody", ", ".join(free), "", "", "", "", "")
    return table


def _table(*headings: str) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in headings:
        table.add_column(heading)
    return table


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
