"""From what stands on the command line to sources and sinks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from failuretwin.connection.links.pace import Pace
from failuretwin.connection.links.ros_topics import RosTopics, load_topics
from failuretwin.connection.links.values import Sink, Source
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bags.topics import BagTopics
from failuretwin.digital_model.imperfections import load_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.schedule import ScheduledFault

EMULATED, ROS1, ROSBRIDGE = "emulated", "ros1", "rosbridge"
ROSBRIDGE_PORT = 9090
"""Where rosbridge servers listen unless told otherwise."""
SOURCES = f"{EMULATED}, {ROS1}, {ROSBRIDGE}://HOST[:PORT], or a log (raw session, bag, .mcap)"


@dataclass(frozen=True)
class EmulationOptions:
    """What the command line says of an emulated robot.

    Attributes:
        faults: Faults in text form, such as ``motor_3:stuck@40-80``.
        imperfections: Name or file; None: those of the robot's profile, if any.
        duration_s: How long it works [s]; infinity: until it is interrupted.
        seed: Seed of all chance.
    """

    faults: Sequence[str] = ()
    imperfections: str | None = None
    duration_s: float = math.inf
    seed: int = 0


def emulated_robot(
    robot: Robot, options: EmulationOptions, pace: Pace, zero_s: float = 0.0
) -> Source:
    """Return an emulated robot as a source.

    Args:
        robot: The robot.
        options: What the command line says of it.
        pace: How fast its time passes.
        zero_s: What its clock says at the start [s].
    """
    from failuretwin.connection.emulation.emulated_arm import Emulation
    from failuretwin.connection.links.emulated import emulated

    own = "none" if robot.imperfections_file is None else robot.name
    emulation = Emulation(
        robot=robot,
        imperfections=load_imperfections(options.imperfections or own, robot),
        schedule=tuple(ScheduledFault.parse(text, robot.motor_names) for text in options.faults),
        seed=options.seed,
    )
    return emulated(emulation, pace, options.duration_s, zero_s)


def topics_of(path: Path | None) -> RosTopics:
    """Return the topics in a file; without one, those of the data set's authors."""
    return RosTopics() if path is None else load_topics(path)


@dataclass(frozen=True)
class Connections:
    """A robot to be watched, and where its diagnosis is published.

    Attributes:
        source: The robot.
        sinks: Its network, where it has one.
    """

    source: Source
    sinks: tuple[Sink, ...] = ()


def connect(
    text: str,
    robot: Robot,
    topics: RosTopics,
    emulation: EmulationOptions,
    pace: Pace,
    stack: ExitStack,
) -> Connections:
    """Return what a SOURCE on the command line stands for.

    Args:
        text: One of `SOURCES`.
        robot: The robot.
        topics: Its topics on a network.
        emulation: What an emulated robot is like.
        pace: How fast time passes in logs and emulation.
        stack: Closes everything in the end.

    Raises:
        InputError: If it does not exist, cannot be reached, is none of these, or is told what only
            an emulated robot does.
    """
    if text == EMULATED:
        return Connections(stack.enter_context(emulated_robot(robot, emulation, pace)))
    if emulation.faults or emulation.imperfections:
        raise InputError(
            f"--fault and --imperfections are of an emulated robot, but the source is {text!r}. "
            f"Leave them out, or watch {EMULATED!r}."
        )
    if text == ROS1:
        return _ros1(robot, topics, stack)
    if text.startswith(f"{ROSBRIDGE}://"):
        return _rosbridge(text, robot, topics, stack)
    from failuretwin.connection.links.replay import replay

    path = Path(text)
    if not path.exists():
        raise InputError(f"source {text!r} does not exist. Expected {SOURCES}.")
    named = None if topics == RosTopics() else _bag_topics(topics)
    return Connections(stack.enter_context(replay(path, robot, pace, named)))


def _bag_topics(topics: RosTopics) -> BagTopics:
    """Return the topics of a network as those of a recording of it."""
    return BagTopics(topics.command, topics.tool or None, topics.position or None)


def _ros1(robot: Robot, topics: RosTopics, stack: ExitStack) -> Connections:
    from failuretwin.connection.ros1.sinks import Ros1Diagnostics
    from failuretwin.connection.ros1.source import Ros1Source

    source = stack.enter_context(Ros1Source(robot, topics))
    return Connections(source, (stack.enter_context(Ros1Diagnostics(robot, topics)),))


def _rosbridge(text: str, robot: Robot, topics: RosTopics, stack: ExitStack) -> Connections:
    from failuretwin.connection.links import rosbridge

    try:
        address = urlsplit(text)
        host, port = address.hostname, address.port or ROSBRIDGE_PORT
    except ValueError:
        host, port = None, 0
    if not host:
        raise InputError(f"{text!r} is no address. Expected {ROSBRIDGE}://HOST[:PORT].")
    ros = rosbridge.connect(host, port)
    stack.callback(rosbridge.disconnect, ros)
    source = stack.enter_context(rosbridge.RosbridgeSource(robot, topics, ros))
    sink = stack.enter_context(rosbridge.RosbridgeDiagnostics(robot, topics, ros))
    return Connections(source, (sink,))
