"""From what stands on the command line to sources and sinks."""

from __future__ import annotations

import math
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from failuretwin.app.commands.options import LiveOptions
from failuretwin.app.shadow import SILENCE_S, Change, Changes, Shadow, Snapshot
from failuretwin.app.terminal import tell
from failuretwin.connection.links.base import LinkCounts, Pace, Sink, Source, source_from_text
from failuretwin.connection.links.ros_messages import RosTopics, load_topics
from failuretwin.connection.links.statuses import (
    LEVEL_ERROR,
    LEVEL_NAMES,
    LEVEL_OK,
    LEVEL_STALE,
    LEVEL_WARN,
    statuses,
)
from failuretwin.core.errors import InputError, counted
from failuretwin.core.foreign import printable
from failuretwin.data_knowledge.bag_messages import BagTopics
from failuretwin.decision.streaming.monitor import FaultMonitor, Fit
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.injection import ScheduledFault
from failuretwin.inference.calibration_fit import MISFIT
from failuretwin.inference.explanation import percent

EMULATED, ROS1, ROS2, ROSBRIDGE = "emulated", "ros1", "ros2", "rosbridge"
NETWORKS = (ROS1, ROS2)
"""Networks on which an emulated robot may speak."""
ROSBRIDGE_PORT = 9090
"""Where rosbridge servers listen unless told otherwise."""
SOURCES = (
    f"{EMULATED}, {ROS1}, {ROS2}[://HOST[:PORT]], {ROSBRIDGE}://HOST[:PORT], a log (raw session, "
    "bag, .mcap), or a source of your own, MODULE:CLASS"
)
OWN_CLASS = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*(:.*)?")
"""How the class of a source of one's own is named, see `source_from_text`."""


def emulated_robot(
    robot: Robot, live: LiveOptions, seed: int, pace: Pace, duration_s: float, zero_s: float = 0.0
) -> Source:
    """Return an emulated robot; it works for `duration_s` and its clock starts at `zero_s` [s]."""
    from failuretwin.connection.emulated_arm import Emulation, emulated

    own = "none" if robot.imperfections_file is None else robot.name
    known = load_calibration(live.imperfections or own, robot)
    emulation = Emulation(
        robot=known.robot,
        imperfections=known.imperfections,
        schedule=schedule_of(live, robot),
        seed=seed,
    )
    return emulated(emulation, pace, duration_s, zero_s)


def schedule_of(live: LiveOptions, robot: Robot) -> tuple[ScheduledFault, ...]:
    """Return the faults of an emulated robot."""
    return tuple(ScheduledFault.parse(text, robot.motor_names) for text in live.faults)


def topics_of(path: Path | None) -> RosTopics:
    """Return the topics in a file; without one, those of the data set's authors."""
    return RosTopics() if path is None else load_topics(path)


def connect(
    text: str, robot: Robot, live: LiveOptions, seed: int, stack: ExitStack
) -> tuple[Source, list[Sink]]:
    """Return what a SOURCE on the command line stands for, and where its network publishes.

    The text is one of `SOURCES`; the stack closes everything in the end.

    Raises:
        InputError: If it does not exist, cannot be reached, is none of these, or is told what only
            an emulated robot does.
    """
    topics, pace = topics_of(live.topics), Pace(live.speed)
    if text == EMULATED:
        source = emulated_robot(robot, live, seed, pace, live.duration or math.inf)
        return stack.enter_context(source), []
    if live.faults or live.imperfections:
        raise InputError(
            f"--fault and --imperfections are of an emulated robot, but the source is {text!r}. "
            f"Leave them out, or watch {EMULATED!r}."
        )
    if text == ROS1:
        return _ros1(robot, topics, stack)
    if text == ROS2 or text.startswith(f"{ROS2}://"):
        return _ros2(text, robot, topics, stack)
    if text.startswith(f"{ROSBRIDGE}://"):
        return _rosbridge(text, robot, topics, stack)
    from failuretwin.connection.links.recording import replay

    path = Path(text)
    if OWN_CLASS.fullmatch(text) and not path.exists():
        sys.path.insert(0, "")  # the user's module may lie in the folder that the user is in
        return stack.enter_context(source_from_text(text, robot)), []
    if not path.exists():
        raise InputError(f"source {text!r} does not exist. Expected {SOURCES}.")
    recorded = BagTopics(topics.command, topics.tool or None, topics.position or None)
    named = None if topics == RosTopics() else recorded
    return stack.enter_context(replay(path, robot, pace, named)), []


def _ros1(robot: Robot, topics: RosTopics, stack: ExitStack) -> tuple[Source, list[Sink]]:
    from failuretwin.connection.links.ros1 import Ros1Diagnostics, Ros1Source

    source = stack.enter_context(Ros1Source(robot, topics))
    return source, [stack.enter_context(Ros1Diagnostics(robot, topics))]


def _ros2(
    text: str, robot: Robot, topics: RosTopics, stack: ExitStack
) -> tuple[Source, list[Sink]]:
    from failuretwin.connection.links import ros2

    session = ros2_session(text)
    stack.callback(session.close)
    source = stack.enter_context(ros2.Ros2Source(robot, topics, session))
    return source, [stack.enter_context(ros2.Ros2Diagnostics(robot, topics, session))]


def robot_sink(target: str, robot: Robot, live: LiveOptions, stack: ExitStack) -> Sink:
    """Return where an emulated robot speaks: a network, or a recording.

    The stack closes it in the end.

    Raises:
        InputError: If it cannot be reached or written.
    """
    if target == ROS1:
        from failuretwin.connection.links.ros1 import Ros1Robot

        return stack.enter_context(Ros1Robot(robot, topics_of(live.topics)))
    if target.partition("://")[0] == ROS2:
        from failuretwin.connection.links.ros2 import Ros2Robot

        session = ros2_session(target)
        stack.callback(session.close)
        return stack.enter_context(Ros2Robot(robot, topics_of(live.topics), session))
    from failuretwin.connection.links.recording import Recorder

    return stack.enter_context(Recorder(Path(target), robot))


def ros2_session(text: str) -> Any:
    """Return a session with the router that ``ros2`` or ``ros2://HOST[:PORT]`` stands for.

    Raises:
        InputError: If it is no such address, or no router answers there.
    """
    from failuretwin.connection.links import ros2

    return ros2.connect() if text == ROS2 else ros2.connect(*address_of(text, ros2.ROUTER_PORT))


def address_of(text: str, usual_port: int = ROSBRIDGE_PORT) -> tuple[str, int]:
    """Return host and port of a server, such as ``rosbridge://HOST[:PORT]``.

    Raises:
        InputError: If it is no such address.
    """
    try:
        address = urlsplit(text)
        host, port = address.hostname, address.port or usual_port
    except ValueError:
        host, port = None, 0
    if not host:
        kind = text.partition("://")[0]
        raise InputError(f"{text!r} is no address. Expected {kind}://HOST[:PORT].")
    return host, port


def _rosbridge(
    text: str, robot: Robot, topics: RosTopics, stack: ExitStack
) -> tuple[Source, list[Sink]]:
    from failuretwin.connection.links import rosbridge

    ros = rosbridge.connect(*address_of(text))
    stack.callback(rosbridge.disconnect, ros)
    source = stack.enter_context(rosbridge.RosbridgeSource(robot, topics, ros))
    sink = stack.enter_context(rosbridge.RosbridgeDiagnostics(robot, topics, ros))
    return source, [sink]


# The live view on a terminal: motors, residual, posterior over time, what changed.

STYLES = {
    LEVEL_OK: "green",
    LEVEL_WARN: "yellow",
    LEVEL_ERROR: "bold red",
    LEVEL_STALE: "magenta",
}
BLOCKS = " ▁▂▃▄▅▆▇█"
COLUMNS = 60
"""Width of the posterior over time."""
COLUMN_S = 1.0
"""Time of the stream that one column stands for [s]."""
RESIDUAL_MM = 50.0
"""Residual that fills its bar [mm]."""
BAR = 20
SHOWN_HYPOTHESES = 6
SHOWN_CHANGES = 8


class View:
    """Draws what the shadow knows."""

    def __init__(self, motors: Sequence[str], source: str) -> None:
        self._motors = motors
        self._source = source
        self._history: deque[dict[str, float]] = deque(maxlen=COLUMNS)
        self._next_s = -np.inf

    def remember(self, snapshot: Snapshot) -> None:
        """Take a snapshot into the posterior over time; time without any is a gap."""
        now_s = snapshot.stream_time
        if now_s < self._next_s:
            return
        if np.isfinite(self._next_s):
            missing = int((now_s - self._next_s) / COLUMN_S)
            self._history.extend([{}] * min(missing, COLUMNS))
        self._next_s = now_s + COLUMN_S
        diagnosis, stale = snapshot.answer.diagnosis, snapshot.answer.state != "OK"
        known = diagnosis is not None and not stale
        self._history.append(dict(diagnosis.posterior) if known and diagnosis else {})

    def draw(
        self, snapshot: Snapshot, counts: LinkCounts, changes: Sequence[Change]
    ) -> RenderableType:
        """Return the view of what is known now; of the changes the newest is the last."""
        lines = [Text(printable(str(change))) for change in list(changes)[-SHOWN_CHANGES:]]
        return Group(
            self._head(snapshot, counts),
            self._motor_table(snapshot),
            Panel(self._posterior(), title=f"posterior, last {COLUMNS} s", title_align="left"),
            Panel(Group(*lines), title="what changed", title_align="left"),
        )

    def _head(self, snapshot: Snapshot, counts: LinkCounts) -> Text:
        arm = statuses(snapshot.answer, self._motors)[0]
        head = Text(f"{LEVEL_NAMES[arm.level]:6s}", STYLES[arm.level])
        head.append(f" {printable(arm.message)}\n", "default")
        off = float(np.linalg.norm(snapshot.residual)) * 1000.0
        share = 0.0 if np.isnan(off) else min(1.0, off / RESIDUAL_MM)
        said = "no reading" if np.isnan(off) else f"{off:5.1f} mm off the reference"
        head.append(
            f"{printable(self._source)}  {snapshot.stream_time:.1f} s  {counts.received} events, "
            f"{counts.garbage} garbage, {counts.dropped} dropped, {counts.reconnects} reconnects, "
            f"{1000 * snapshot.seconds:.1f} ms a sample\n",
            "dim",
        )
        head.append(f"tool   {_bar(share)} {said}", "default")
        return head

    def _motor_table(self, snapshot: Snapshot) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("motor", "state", "faulty", "", "how"):
            table.add_column(name)
        for status in statuses(snapshot.answer, self._motors)[1:]:
            probability = float(status.values.get("probability", 0.0))
            table.add_row(
                printable(status.name),
                Text(LEVEL_NAMES[status.level], STYLES[status.level]),
                f"{100 * probability:5.1f} %" if status.values else "",
                _bar(probability),
                printable(status.message),
            )
        return table

    def _posterior(self) -> Table:
        """Return the posterior over time, a row for each hypothesis that ever mattered."""
        weight = Counter[str]()
        for column in self._history:
            weight.update(column)
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, _ in weight.most_common(SHOWN_HYPOTHESES):
            blocks = "".join(_block(column.get(name)) for column in self._history)
            last = self._history[-1].get(name)
            table.add_row(printable(name), blocks, "" if last is None else f"{100 * last:5.1f} %")
        return table


def _bar(share: float) -> str:
    full = round(BAR * share)
    return "█" * full + "·" * (BAR - full)


def _block(probability: float | None) -> str:
    if probability is None:
        return "?"
    return BLOCKS[round(probability * (len(BLOCKS) - 1))]


# Watching until the source ends or the user has seen enough.

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
    monitor: FaultMonitor | None = None,
) -> Changes:
    """Watch a robot until `until_s` of our monotonic clock [s], and return all that has changed.

    With a monitor it is told how well its calibration and the profile fit, once it has seen enough.
    On a terminal there is a live view, else a line for each change.
    """
    changes, view = Changes(motors), View(motors, source.name)
    live = Live(console=console, auto_refresh=False) if console.is_terminal else nullcontext()
    begun_s, drawn_s, looked = time.monotonic(), 0.0, False
    with live as shown:
        going = True
        while going:
            going = shadow.step(POLL_S) and time.monotonic() < until_s
            troubles = _troubles(shadow, source, sinks, time.monotonic() - begun_s)
            troubles += () if monitor is None else _misfit(monitor.fit)
            found = changes.notice(shadow.snapshot, source.counts, shadow.clock_jumps, troubles)
            if monitor is not None and monitor.set_up is not None and not looked:
                looked = True
                found.append(changes.add(shadow.snapshot.stream_time, fit_of(monitor)))
            if shown is None:
                for change in found:
                    tell(str(change))
                continue
            view.remember(shadow.snapshot)
            if not going or time.monotonic() >= drawn_s + REFRESH_S:
                drawn_s = time.monotonic()
                picture = view.draw(shadow.snapshot, source.counts, changes.lines)
                shown.update(picture, refresh=True)
    return changes


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
