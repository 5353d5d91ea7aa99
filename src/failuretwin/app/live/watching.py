"""Watching until the source ends or the user has seen enough."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import nullcontext

import click
from rich.console import Console
from rich.live import Live

from failuretwin.app.live.changes import Change, Changes
from failuretwin.app.live.shadow import SILENCE_S, Shadow
from failuretwin.app.live.view import View
from failuretwin.connection.links.values import Sink, Source

REFRESH_S = 0.25
"""Time between two drawings [s]."""
POLL_S = 0.1
"""Longest wait for an event [s]."""
LATE_S = 0.3
"""A command that comes later than this spoils the diagnosis, and the user is told [s]."""


def watch_until_end(
    shadow: Shadow,
    source: Source,
    sinks: Sequence[Sink],
    motors: list[str],
    console: Console,
    until_s: float,
) -> Changes:
    """Watch a robot; on a terminal with a live view, else with a line for each change.

    Args:
        shadow: The shadow of the robot.
        source: The robot.
        sinks: Where the shadow tells what it knows.
        motors: Names of the robot's motors in chain order.
        console: Where to draw.
        until_s: When to stop, by our own monotonic clock [s].

    Returns:
        All that has changed.
    """
    changes, view = Changes(motors), View(motors, source.name)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext()
    begun_s, drawn_s = time.monotonic(), 0.0
    with live as shown:
        going = True
        while going:
            going = shadow.step(POLL_S) and time.monotonic() < until_s
            troubles = _troubles(shadow, source, sinks, time.monotonic() - begun_s)
            found = changes.notice(shadow.moment, source.counts, shadow.clock_jumps, troubles)
            if shown is None:
                _print(found)
                continue
            view.remember(shadow.moment)
            if not going or time.monotonic() >= drawn_s + REFRESH_S:
                drawn_s = time.monotonic()
                picture = view.draw(shadow.moment, source.counts, changes.lines)
                shown.update(picture, refresh=True)
    return changes


def _troubles(
    shadow: Shadow, source: Source, sinks: Sequence[Sink], since_s: float
) -> tuple[str, ...]:
    """Return what keeps the diagnosis from being made or told.

    Args:
        shadow: The shadow of the robot.
        source: The robot.
        sinks: Where the shadow tells what it knows.
        since_s: For how long the robot has been listened to [s].
    """
    found = [sink.trouble for sink in sinks if sink.trouble]
    if source.counts.received == 0 and since_s > SILENCE_S:
        found.append(f"nothing comes from {source.name}")
    if shadow.late_s >= LATE_S:
        wait = math.ceil(2.0 * shadow.late_s) / 2.0
        found.append(f"commands come late: put commands_late_s = {wait} into the --topics file")
    return tuple(found)


def _print(found: Sequence[Change]) -> None:
    for change in found:
        click.echo(str(change))
