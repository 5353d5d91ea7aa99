"""Replay: recorded logs as if the robot were there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from failuretwin.connection.links.commands import SampledCommands
from failuretwin.connection.links.pace import Pace
from failuretwin.connection.links.paced import PacedSource
from failuretwin.connection.links.values import CommandSent, Event, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.bags.reading import BagTopics, is_bag, read_bag
from failuretwin.data_knowledge.raw_session import RawSession, find_sessions, read_session
from failuretwin.data_knowledge.timed_log import Samples, Targets, TimedLog
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin


def replay(path: Path, robot: Robot, pace: Pace, topics: BagTopics | None = None) -> PacedSource:
    """Return a log as a source.

    Args:
        path: Folder of one raw session, ROS 1 bag, ROS 2 bag or MCAP file.
        robot: The robot it is of.
        pace: How fast time passes.
        topics: Which topics of a bag are what, where their types do not tell.

    Raises:
        InputError: If it does not exist, cannot be read, or holds several sessions.
    """
    if not path.exists():
        raise InputError(f"{path}: does not exist. Expected a raw session or a bag.")
    if is_bag(path):
        (log,) = read_bag(path, robot, topics)
        return PacedSource(path.name, log_events(log, robot), pace)
    folders = find_sessions(path) if path.is_dir() else []
    if len(folders) != 1:
        raise InputError(
            f"{path}: expected one raw session or a bag (.bag, .mcap, a folder of ROS 2), found "
            f"{len(folders)} sessions. Name one of them."
        )
    session = read_session(folders[0], robot)
    return PacedSource(session.name, session_events(session, robot), pace)


def session_events(session: RawSession, robot: Robot) -> Iterator[Event]:
    """Give the commands and readings of a raw session in the order of their stamps."""
    units, twin = robot.servo_units, DigitalTwin(robot)
    counts = session.reading_counts
    angle = np.where(units.valid(counts), units.to_rad(counts), np.nan)
    target = units.to_rad(session.target_counts)
    commands = [
        CommandSent(float(time), target[i], session.ramp_s[i])
        for i, time in enumerate(session.command_time)
    ]
    return _in_order(commands, _motor_readings(session.reading_time, angle, twin))


def log_events(log: TimedLog, robot: Robot) -> Iterator[Event]:
    """Give the commands and readings of a log in the order of their times."""
    commands = _commands(log.command)
    if log.tool is not None:
        readings = [
            Reading(float(time), point)
            for time, point in zip(log.tool.time, log.tool.value, strict=True)
        ]
        return _in_order(commands, readings)
    if log.position is None:
        raise InputError(f"{log.name}: holds neither a tool path nor motor readings.")
    twin = DigitalTwin(robot)
    return _in_order(commands, _motor_readings(log.position.time, log.position.value, twin))


def _motor_readings(time: FloatArray, angle: FloatArray, twin: DigitalTwin) -> list[Reading]:
    return [motor_reading(float(t), angle[i], twin) for i, t in enumerate(time)]


def motor_reading(time: float, angle: FloatArray, twin: DigitalTwin) -> Reading:
    """Return motor readings as the reading of a virtual tool sensor, as published.

    Args:
        time: By the robot's clock [s].
        angle: (motor,) [rad], NaN where one is missing; then there is no tool position.
        twin: Kinematics of the robot.
    """
    sound = bool(np.isfinite(angle).all())
    return Reading(time, twin.path(angle) if sound else np.full(3, np.nan), angle)


def _commands(command: Samples | Targets) -> list[CommandSent]:
    if isinstance(command, Targets):
        rows = zip(command.time, command.target, command.duration, strict=True)
        return [CommandSent(float(time), target, duration) for time, target, duration in rows]
    samples = SampledCommands()
    rows_of = zip(command.time, command.value, strict=True)
    sent = [samples.add(float(time), value) for time, value in rows_of if np.isfinite(value).all()]
    return [one for one in sent if one is not None]


def _in_order(commands: list[CommandSent], readings: list[Reading]) -> Iterator[Event]:
    """Give events in the order of their times, a command before a reading of the same time."""
    events: list[Event] = [*commands, *readings]
    return iter(sorted(events, key=lambda event: (event.time, isinstance(event, Reading))))
