"""Sources whose events are known in advance or made here: recorded logs and emulated robots."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, LinkCounts, Reading, Source
from failuretwin.connection.links.ros_messages import SampledCommands, motor_reading
from failuretwin.connection.links.stream_time import order
from failuretwin.core.errors import InputError
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.data_knowledge.readers.bag_file import is_bag
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.bags import read_bag
from failuretwin.data_knowledge.readers.raw_sessions import RawSession, find_sessions, read_session
from failuretwin.data_knowledge.readers.read import is_text_log, text_logs
from failuretwin.data_knowledge.readers.timed_log import Samples, Targets, TimedLog
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

AS_FAST_AS_POSSIBLE = 0.0
"""Speed at which events are given without waiting."""


@dataclass
class Pace:
    """Clock that waits until events are due.

    Attributes:
        speed: Seconds of the robot's time per second of ours; 0: as fast as possible.

    Raises:
        InputError: If the speed is negative or not finite.
    """

    speed: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.speed < float("inf"):
            raise InputError(
                f"speed is {self.speed:g}, expected a factor above 0, such as 1 (as recorded) or "
                "10; 0 means as fast as possible."
            )
        self._zero: tuple[float, float] | None = None

    def due(self, event_time: float, timeout_s: float) -> bool:
        """Wait `timeout_s` [s] at most for an event and return whether it is due.

        Times are by the robot's clock [s]; the first event is due at once.
        """
        if self.speed == AS_FAST_AS_POSSIBLE:
            return True
        now = time.monotonic()
        if self._zero is None:
            self._zero = event_time, now
        first, start = self._zero
        left = start + (event_time - first) / self.speed - now
        if left > 0.0:
            time.sleep(min(left, timeout_s))
        return left <= timeout_s


@dataclass(frozen=True)
class Wait:
    """A time [s] until which the event after it is not asked for."""

    time: float


class PacedSource(Source):
    """Source that gives events, in the order of their times, when they are due, and drops none."""

    name, ended, counts = "", False, LinkCounts()

    def __init__(self, name: str, events: Iterator[Event | Wait], pace: Pace) -> None:
        self.name = name
        self._events = events
        self._pace = pace
        self._next: Event | Wait | None = None

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if it is not due within `timeout_s` [s] or there is none."""
        while (item := self._next or next(self._events, None)) is not None:
            self._next = item
            if not self._pace.due(item.time, timeout_s):
                return None
            self._next = None
            if not isinstance(item, Wait):
                self.counts = LinkCounts(received=self.counts.received + 1)
                return item
        self.ended = True
        return None


FOR_RUN_SETS = (
    "Run sets are for `diagnose`. To watch one, write an ft.Source that feeds its samples "
    "(docs/tutorials/live.md shows one)."
)
"""What to do with a log that cannot be watched."""
WATCHED = "a raw session, a CSV file of one run, or a bag (.bag, .mcap, a folder of ROS 2)"
"""What can be."""


def replay(path: Path, robot: Robot, pace: Pace, topics: BagTopics | None = None) -> PacedSource:
    """Return a log as a source: a raw session (a folder), CSV file, ROS 1 or 2 bag or MCAP file.

    `topics` are the roles of a bag's topics, where types do not settle them.

    Raises:
        InputError: If it does not exist, cannot be read, or holds several sessions or runs.
    """
    if not path.exists():
        raise InputError(f"{path}: does not exist. Expected {WATCHED}.")
    if is_bag(path):
        return PacedSource(path.name, log_events(read_bag(path, robot, topics), robot), pace)
    if is_text_log(path):
        logs = text_logs(path, robot)
        if len(logs) != 1:
            raise InputError(f"{path}: holds {len(logs)} runs, expected one. Cut it into files.")
        return PacedSource(path.name, log_events(logs[0], robot), pace)
    folders = find_sessions(path) if path.is_dir() else []
    if len(folders) != 1:
        found = f"holds {len(folders)} raw sessions" if folders else "is none of these"
        fix = "Name one of them." if folders else FOR_RUN_SETS
        raise InputError(f"{path}: expected {WATCHED}, but it {found}. {fix}")
    session = read_session(folders[0], robot)
    return PacedSource(session.name, session_events(session, robot), pace)


def session_events(session: RawSession, robot: Robot) -> Iterator[Event]:
    """Yield the commands and readings of a raw session in the order of their stamps."""
    units, counts = robot.servo_units, session.reading_counts
    angle = np.where(units.valid(counts), units.to_rad(counts), np.nan)
    command = Targets(session.command_time, units.to_rad(session.target_counts), session.ramp_s)
    position = Samples(session.reading_time, angle)
    return log_events(TimedLog(session.name, command, position=position), robot)


def log_events(log: TimedLog, robot: Robot) -> Iterator[Event]:
    """Yield the commands and readings of a log in the order of their times."""
    events: list[Event] = list(_commands(log.command))
    goals, twin = log.sensors.get(GOAL_VARIABLE), DigitalTwin(robot)
    if log.tool is not None:
        events += map(Reading, log.tool.time.tolist(), log.tool.value)
    elif log.position is not None:
        rows = zip(log.position.time.tolist(), log.position.value, strict=True)
        events += [motor_reading(time, angle, twin) for time, angle in rows]
    else:
        raise InputError(f"{log.name}: holds neither a tool path nor motor readings.")
    if goals is not None:
        reported = zip(goals.time.tolist(), goals.value, strict=True)
        events += [Reading(time, goal=goal) for time, goal in reported]
    return iter(sorted(events, key=order))


def _commands(command: Samples | Targets) -> Iterator[CommandSent]:
    if isinstance(command, Targets):
        yield from map(CommandSent, command.time.tolist(), command.target, command.duration)
        return
    samples = SampledCommands()
    for stamp, value in zip(command.time.tolist(), command.value, strict=True):
        sent = samples.add(stamp, value) if np.isfinite(value).all() else None
        if sent is not None:
            yield sent
