"""The default sink: it records everything and moves nothing."""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Iterator, Sequence
from io import FileIO
from itertools import count
from pathlib import Path
from typing import Self

import numpy as np

from failuretwin import __version__
from failuretwin.connection.links.base import (
    Answer,
    CommandSent,
    Event,
    Item,
    Pace,
    PacedSource,
    Reading,
)
from failuretwin.connection.links.live_events import (
    SampledCommands,
    goal_reading,
    motor_reading,
)
from failuretwin.connection.links.ros2_messages import ros2_object
from failuretwin.connection.links.ros_messages import (
    DiagnosticsPublisher,
    Outgoing,
    RosTopics,
    RosWriter,
)
from failuretwin.core.errors import InputError, OutputError, needs_extra
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.bag_messages import GOAL_TOPIC, NS_PER_S
from failuretwin.data_knowledge.bags import BagTopics, is_bag, read_bag
from failuretwin.data_knowledge.raw_sessions import RawSession, find_sessions, read_session
from failuretwin.data_knowledge.timed_log import Samples, Targets, TimedLog
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

# MCAP files that grow while they can be read, in ROS 2's encoding.

CHUNK_BYTES = 16_384
"""Size from which messages go to the disk: a few seconds of a robot."""
_MAGIC = b"\x89MCAP0\r\n"
_END = (
    struct.pack("<BQI", 0x0F, 4, 0)  # end of the data, without a checksum
    + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0)  # footer: no summary
    + _MAGIC
)
"""What makes a file whole whose data end early, see https://mcap.dev/spec."""


class _Unbuffered:
    """A file of which all that was written is on its way to the disk."""

    def __init__(self, file: FileIO) -> None:
        self._file = file

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        return len(data)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        """Nothing waits here."""


class McapFile:
    """A recording that is being written.

    Args:
        path: The file; it must not exist.

    Raises:
        InputError: If mcap or rosbags is not installed, or the file exists.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        with needs_extra("recording needs mcap and rosbags", "live"):
            from mcap.writer import Writer
            from rosbags.typesys import Stores, get_typestore
        self.path = path
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        try:
            self._file = FileIO(path, "x")
        except FileExistsError as error:
            raise InputError(
                f"{path}: exists already. Choose another name, or remove it."
            ) from error
        self._channels: dict[str, int] = {}
        self._saved = 0
        self._stream = _Unbuffered(self._file)
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]
        try:
            self._writer.start(profile="ros2", library=f"failuretwin {__version__}")
        except OSError:
            self._file.close()
            path.unlink()
            raise
        self._saved = self._stream.tell()

    def write(self, message: Outgoing, time_ns: int) -> bool:
        """Write a message and return whether all messages so far are on the disk.

        Args:
            message: The message.
            time_ns: Its time [ns].

        Raises:
            OSError: If the disk is full or gone; `abandon` the file then.
        """
        type_ = message.type.replace("/", "/msg/")
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message.topic, type_)
        content = self._store.serialize_cdr(ros2_object(self._store, type_, message.content), type_)
        self._writer.add_message(
            self._channels[message.topic], time_ns, bytes(content), time_ns, sequence=0
        )
        before, self._saved = self._saved, self._stream.tell()
        return self._saved > before

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: If the disk is full or gone.
        """
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def abandon(self) -> None:
        """Cut off what is half-written and finish the file; may be tried again.

        Raises:
            OSError: If the disk has no room even for that; `mcap recover` would repair the file.
        """
        self._file.close()
        with FileIO(self.path, "r+") as file:
            file.truncate(self._saved)
            file.seek(self._saved)
            _Unbuffered(file).write(_END)

    def _register(self, topic: str, type_: str) -> int:
        text, _ = self._store.generate_msgdef(type_, ros_version=2)
        schema = self._writer.register_schema(type_, "ros2msg", text.encode())
        return self._writer.register_channel(topic, "cdr", schema)


RECORDED = RosTopics(
    command="/command",
    command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states",
    position_type="sensor_msgs/JointState",
    tool="/tool_point",
    goal=GOAL_TOPIC,
)
"""Topics in a recording: standard types, whatever the robot itself speaks."""
PROBABILITY_TOPIC = "/failuretwin/probability"
"""Under it the probability of each hypothesis has a topic of its own, to be plotted."""
RETRY_S = 5.0
"""Time between two attempts to go on when the disk is full [s]."""
KEPT = 10_000
"""Diagnoses that are kept for a disk that is full; at one a second nearly three hours."""


def write_bag(path: Path, robot: Robot, commands: Sequence[CommandSent]) -> None:
    """Write commands as a ROS 1 bag, with the topic and type of recordings.

    Args:
        path: The file; it must not exist.
        robot: The robot.
        commands: In order of time.

    Raises:
        InputError: If it exists, or rosbags is missing.
        OutputError: If it cannot be written.
    """
    with needs_extra("bags need rosbags", "files"):
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore
    if path.exists():
        raise InputError(f"{path}: exists already. Choose another name, or remove it.")
    store, writer = get_typestore(Stores.ROS1_NOETIC), RosWriter(robot, RECORDED)
    type_ = RECORDED.command_type.replace("/", "/msg/")
    try:
        with Writer(path) as bag:
            connection = bag.add_connection(RECORDED.command, type_, typestore=store)
            for command in commands:
                for message in writer.command(command):
                    content = ros2_object(store, type_, message.content)
                    data = store.serialize_ros1(content, type_)
                    bag.write(connection, round(command.time * NS_PER_S), data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error


class Recorder:
    """Records readings, commands and answers as MCAP.

    If the disk is full or gone, the file so far is closed without an index, and every few seconds a
    new part is begun: ``live.mcap``, ``live-2.mcap`` and so on. Diagnoses that could not be saved
    go first.

    Args:
        path: The file; it must not exist.
        robot: The robot.

    Raises:
        InputError: If it exists, does not end in .mcap, or an extra is missing.
        OutputError: If it cannot be written.
    """

    def __init__(self, path: Path, robot: Robot) -> None:
        if path.suffix != ".mcap":
            raise InputError(f"{path}: recordings are MCAP. Give a name that ends in .mcap.")
        self.name = str(path)
        self._path = path
        self._writer = RosWriter(robot, RECORDED)
        self._bulletin = DiagnosticsPublisher(robot, RECORDED)
        self._unsaved: deque[tuple[Outgoing, int]] = deque(maxlen=KEPT)
        self._trouble = ""
        self._retry_s = 0.0
        self._broken: McapFile | None = None
        try:
            self._file: McapFile | None = McapFile(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error

    @property
    def trouble(self) -> str:
        """What keeps items from being recorded just now."""
        return self._trouble

    def put(self, item: Item) -> None:
        """Record an item, if the disk allows it."""
        messages = self._messages(item)
        time_ns = round(item.time * NS_PER_S)
        self._unsaved.extend((m, time_ns) for m in messages if _is_diagnosis(m))
        if self._file is None:
            self._go_on()
        else:
            self._write([(m, time_ns) for m in messages])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is None:
            self._retry_s = 0.0
            self._go_on()
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self._give_up(error)

    def _messages(self, item: Item) -> list[Outgoing]:
        if isinstance(item, Reading):
            return self._writer.reading(item)
        if isinstance(item, CommandSent):
            return self._writer.command(item)
        return self._answer(item)

    def _answer(self, answer: Answer) -> list[Outgoing]:
        bulletin = self._bulletin.message(answer)
        messages = [] if bulletin is None else [bulletin]
        if answer.diagnosis is not None:
            messages += [
                Outgoing(_topic_of(name), "std_msgs/Float64", {"data": probability})
                for name, probability in answer.diagnosis.posterior.items()
            ]
        return messages

    def _write(self, messages: list[tuple[Outgoing, int]]) -> None:
        try:
            for message, time_ns in messages:
                if self._file is not None and self._file.write(message, time_ns):
                    self._unsaved.clear()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._broken, self._file = self._file, None
        self._trouble = f"{self._path}: cannot be written ({error.strerror})"
        self._retry_s = time.monotonic() + RETRY_S

    def _go_on(self) -> None:
        """Begin a new part if it is time to, with the diagnoses that are not saved yet."""
        if time.monotonic() < self._retry_s:
            return
        path = self._next_part()
        try:
            if self._broken is not None:
                self._broken.abandon()
                self._broken = None
            self._file = McapFile(path)
        except OSError as error:
            self._trouble = f"{path}: cannot be written ({error.strerror})"
            self._retry_s = time.monotonic() + RETRY_S
            return
        self._trouble = ""
        self._write(list(self._unsaved))

    def _next_part(self) -> Path:
        """Return the first name of a part that is free."""
        parts = (self._path.with_stem(f"{self._path.stem}-{number}") for number in count(2))
        return next(part for part in parts if not part.exists())


def _is_diagnosis(message: Outgoing) -> bool:
    return message.topic == RECORDED.diagnostics


def _topic_of(hypothesis: str) -> str:
    return f"{PROBABILITY_TOPIC}/{hypothesis.replace(':', '/').replace('+', '_and_')}"


# Replay: recorded logs as if the robot were there.


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
    commands, told = _commands(log.command), log.sensors.get(GOAL_VARIABLE)
    rows = [] if told is None else zip(told.time.tolist(), told.value, strict=True)
    goals = [goal_reading(time, goal) for time, goal in rows]
    if log.tool is not None:
        readings = [
            Reading(float(time), point)
            for time, point in zip(log.tool.time, log.tool.value, strict=True)
        ]
        return _in_order(commands, [*readings, *goals])
    if log.position is None:
        raise InputError(f"{log.name}: holds neither a tool path nor motor readings.")
    twin = DigitalTwin(robot)
    readings = _motor_readings(log.position.time, log.position.value, twin)
    return _in_order(commands, [*readings, *goals])


def _motor_readings(time: FloatArray, angle: FloatArray, twin: DigitalTwin) -> list[Reading]:
    return [motor_reading(float(t), angle[i], twin) for i, t in enumerate(time)]


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
