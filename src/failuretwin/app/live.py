"""From what stands on the command line to sources and sinks."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live

from failuretwin.app.commands.options import LiveOptions
from failuretwin.app.emulation import emulation_of
from failuretwin.app.live_view import View
from failuretwin.app.shadow import SILENCE_S, Changes, Shadow
from failuretwin.app.terminal import tell
from failuretwin.connection.links.base import Event, LinkCounts, Sink, Source, source_from_text
from failuretwin.connection.links.networks import NETWORKS, is_network, open_transport
from failuretwin.connection.links.replay import Pace
from failuretwin.connection.links.ros_link import (
    RosCommander,
    RosSource,
    diagnostics_sink,
    robot_sink,
)
from failuretwin.connection.links.ros_topics import RosTopics, load_topics
from failuretwin.core.errors import InputError, counted
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.decision.streaming.monitor import FaultMonitor, Fit
from failuretwin.decision.test_motions.probing import Prober
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.calibration_fit import MISFIT
from failuretwin.inference.explanation import percent

if TYPE_CHECKING:
    from failuretwin.connection.emulated_arm import Emulation

EMULATED = "emulated"
SOURCES = (
    f"{EMULATED}, {NETWORKS}, a log (raw session, bag, .mcap), or a source of your own, "
    "MODULE:CLASS"
)
OWN_CLASS = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(:.*)?")
"""How the class of a source of one's own is named, see `source_from_text`."""


def emulated_robot(
    emulation: Emulation, pace: Pace, duration_s: float, zero_s: float = 0.0
) -> Source:
    """Return an emulated robot; it works for `duration_s` and its clock starts at `zero_s` [s]."""
    from failuretwin.connection.emulated_arm import emulated

    return emulated(emulation, pace, duration_s, zero_s)


def topics_of(path: Path | None) -> RosTopics:
    """Return the topics in a file; without one, those of the data set's authors."""
    return RosTopics() if path is None else load_topics(path)


def connect(
    text: str, robot: Robot, live: LiveOptions, seed: int, stack: ExitStack, commands: bool = False
) -> tuple[Source, list[Sink]]:
    """Return what a SOURCE on the command line stands for, and where its network publishes.

    The text is one of `SOURCES`; the stack closes everything in the end. With `commands` a source
    on a network takes orders too: it is a `Commander`.

    Raises:
        InputError: If it does not exist, cannot be reached, is none of these, or is told what only
            an emulated robot does.
    """
    topics, pace = topics_of(live.topics), Pace(live.speed)
    if text == EMULATED:
        emulation = emulation_of(robot, live, seed)
        source = emulated_robot(emulation, pace, live.seconds or math.inf)
        return stack.enter_context(source), []
    if live.faults:
        raise InputError(
            f"--fault is of an emulated robot, but the source is {text!r}. Leave it out, or watch "
            f"{EMULATED!r}."
        )
    if is_network(text):
        transport = stack.enter_context(open_transport(text))
        link = (RosCommander if commands else RosSource)(robot, topics, transport)
        return link, [diagnostics_sink(robot, topics, transport)]
    from failuretwin.connection.links.replay import replay

    path = Path(text)
    if OWN_CLASS.fullmatch(text) and not path.exists():
        sys.path.insert(0, "")  # the user's module may lie in the folder that the user is in
        return stack.enter_context(source_from_text(text, robot)), []
    if not path.exists():
        raise missing(text)
    recorded = BagTopics(topics.command, topics.tool or None, topics.position or None)
    named = None if topics == RosTopics() else recorded
    return stack.enter_context(replay(path, robot, pace, named)), []


def missing(text: str) -> InputError:
    """Return the error of a SOURCE that is no link and no file."""
    return InputError(f"source {text!r} does not exist. Expected {SOURCES}.")


def emulated_sink(target: str, robot: Robot, live: LiveOptions, stack: ExitStack) -> Sink:
    """Return where an emulated robot speaks: a network, or a recording.

    The stack closes it in the end.

    Raises:
        InputError: If it cannot be reached or written.
    """
    if is_network(target):
        transport = stack.enter_context(open_transport(target))
        return robot_sink(robot, topics_of(live.topics), transport)
    from failuretwin.connection.links.recorder import Recorder

    return stack.enter_context(Recorder(Path(target), robot))


# Watching until the source ends or the user has seen enough.

REFRESH_S = 0.25
"""Time between two drawings [s]."""
POLL_S = 0.1
"""Longest wait for an event [s]."""
LATE_S = 0.3
"""A command that comes later than this spoils the diagnosis, and the user is told [s]."""


@dataclass
class _Screen:
    """Tells what changes: a view on a terminal, else a line for each change."""

    shadow: Shadow
    source: Source
    sinks: Sequence[Sink]
    monitor: FaultMonitor | None
    changes: Changes
    view: View
    live: Live | None

    def __post_init__(self) -> None:
        self._begun_s, self._drawn_s, self._looked = time.monotonic(), 0.0, False

    def look(self, last: bool = False) -> None:
        """Tell what has changed since the last call."""
        shadow, changes, monitor = self.shadow, self.changes, self.monitor
        troubles = _troubles(shadow, self.source, self.sinks, time.monotonic() - self._begun_s)
        if monitor is not None:
            troubles += monitor.rounding
            troubles += () if monitor.set_up else _misfit(monitor.fit)
        counts = _with_stamps(self.source.counts, shadow.senseless_stamps)
        found = changes.notice(shadow.snapshot, counts, shadow.clock_jumps, troubles)
        if monitor is not None and monitor.set_up is not None and not self._looked:
            self._looked = True
            found.append(changes.add(shadow.snapshot.stream_time, fit_of(monitor)))
        if self.live is None:
            for change in found:
                tell(str(change))
            return
        self.view.remember(shadow.snapshot)
        if last or time.monotonic() >= self._drawn_s + REFRESH_S:
            self._drawn_s = time.monotonic()
            picture = self.view.draw(shadow.snapshot, self.source.counts, changes.lines)
            self.live.update(picture, refresh=True)

    def hear(self, event: Event | None) -> None:
        """Take an event that was polled elsewhere."""
        self.shadow.hear(event)
        self.look()

    def say(self, text: str) -> None:
        """Tell something else."""
        change = self.changes.add(self.shadow.snapshot.stream_time, text)
        if self.live is None:
            tell(str(change))


def watch_until_end(
    shadow: Shadow,
    source: Source,
    sinks: Sequence[Sink],
    motors: list[str],
    console: Console,
    until_s: float,
    monitor: FaultMonitor | None = None,
    prober: Prober | None = None,
) -> Changes:
    """Watch a robot until `until_s` of our monotonic clock [s], and return all that has changed.

    With a monitor it is told how well its calibration and the profile fit, once it has seen enough.
    With a prober, one of the sinks, the robot is asked by movements when it is time to.
    On a terminal there is a live view, else a line for each change.
    """
    live = Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext()
    with live as shown:
        told = Changes(motors), View(motors, source.name), shown
        screen, going = _Screen(shadow, source, sinks, monitor, *told), True
        while going:
            going = shadow.step(POLL_S) and time.monotonic() < until_s
            screen.look(last=not going)
            if going and prober is not None and prober.due:
                prober.ask(screen.hear, screen.say)
    return screen.changes


def _with_stamps(counts: LinkCounts, senseless: int) -> LinkCounts:
    """Return what a link has seen, with stamps that make no sense among what makes none."""
    if not senseless:
        return counts
    last = counts.last_garbage or "stamps that leap; such events count when they come"
    return replace(counts, garbage=counts.garbage + senseless, last_garbage=last)


def _misfit(fit: Fit) -> tuple[str, ...]:
    """Return that the calibration is not this robot's, if that is so."""
    if not fit.given or fit.fits >= MISFIT:
        return ()
    return (
        f"this robot does not do what calibration {fit.given!r} says: it is judged by what arms of "
        "its kind do and by what it teaches itself",
    )


def fit_of(monitor: FaultMonitor) -> str:
    """Return how well calibration and profile have fitted this robot, in one sentence."""
    fit = monitor.fit
    taught = f"{fit.learned} movements taught how this robot is"
    if fit.given:
        own = f"; {taught}" if fit.learned else ""
        said = f"calibration {fit.given!r} is this robot's: {percent(fit.fits)} sure{own}"
    else:
        said = f"no calibration was given; {taught}"
    if monitor.set_up is None:
        return said
    profile = monitor.set_up or "the log fits the profile"
    return f"{said}; after {counted(fit.seen, 'movement')} {profile}"


def _troubles(
    shadow: Shadow, source: Source, sinks: Sequence[Sink], since_s: float
) -> tuple[str, ...]:
    """Return what keeps the diagnosis from being made or told, after listening for so long [s]."""
    found = [sink.trouble for sink in sinks if sink.trouble]
    if source.counts.received == 0 and since_s > SILENCE_S:
        found.append(f"nothing comes from {source.name}")
    if shadow.late_s >= LATE_S:
        wait = math.ceil(2.0 * shadow.late_s) / 2.0
        found.append(f"commands come late: put commands_late_s = {wait} into the --topics file")
    return tuple(found)
