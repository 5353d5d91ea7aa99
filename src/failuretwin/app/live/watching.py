"""Watching until the source ends or the user has seen enough."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import click
from rich.console import Console, RenderableType
from rich.live import Live

from failuretwin.app.live.changes import Change, Changes
from failuretwin.app.live.shadow import Shadow
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
    with live as shown:
        draw = _drawer(shown)
        while shadow.step(POLL_S) and time.monotonic() < until_s:
            troubles = _troubles(shadow, sinks)
            found = changes.notice(shadow.moment, source.counts, shadow.clock_jumps, troubles)
            if shown is None:
                _print(found)
            else:
                draw(lambda: view.draw(shadow.moment, source.counts, changes.lines))
    if shown is None:
        _print(changes.notice(shadow.moment, source.counts, shadow.clock_jumps, ()))
    return changes


def _troubles(shadow: Shadow, sinks: Sequence[Sink]) -> tuple[str, ...]:
    found = tuple(sink.trouble for sink in sinks if sink.trouble)
    if shadow.late_s < LATE_S:
        return found
    wait = math.ceil(2.0 * shadow.late_s) / 2.0
    return (*found, f"commands come late: put commands_late_s = {wait} into the --topics file")


def _drawer(live: Live | None) -> Callable[[Callable[[], RenderableType]], None]:
    """Return what draws a view, but not more often than eyes can follow."""
    due_s = 0.0

    def draw(view: Callable[[], RenderableType]) -> None:
        nonlocal due_s
        if live is not None and time.monotonic() >= due_s:
            due_s = time.monotonic() + REFRESH_S
            live.update(view(), refresh=True)

    return draw


def _print(found: Sequence[Change]) -> None:
    for change in found:
        click.echo(str(change))
