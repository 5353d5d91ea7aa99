"""Recorder: the default sink, which writes all items to MCAP and moves nothing."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO, Self

from failuretwin import __version__
from failuretwin.connection.links.base import Answer, CommandSent, Item
from failuretwin.connection.links.ros_codec import Outgoing, RosCodec
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.ros_writer import DiagnosticsWriter, RosWriter
from failuretwin.core.errors import InputError, OutputError, needs_extra
from failuretwin.data_knowledge.readers.bag_messages import GOAL_TOPIC, NS_PER_S
from failuretwin.digital_model.robot import Robot

RECORDED = RosTopics(
    command="/command",
    command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states",
    position_type="sensor_msgs/JointState",
    tool="/tool_point",
    goal=GOAL_TOPIC,
)
"""Topics in a recording: standard types, whatever the robot itself uses."""
PROBABILITY_TOPIC = "/failuretwin/probability"
"""Prefix of the topics that hold the probability of one hypothesis each, to be plotted."""
CHUNK_BYTES = 16_384
"""Size at which messages go to the disk: a few seconds of a robot."""
RETRY_S = 5.0
"""Time between two attempts to continue when the disk is full [s]."""
KEPT = 10_000
"""Maximum number of diagnoses kept while the disk is full; nearly three hours at one a second."""


class McapFile:
    """MCAP file of ROS 2 messages that is being written.

    Args:
        path: The file; it must not exist.

    Raises:
        InputError: If mcap or rosbags is not installed, or the file exists.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        with needs_extra("recording needs mcap and rosbags", "live"):
            from mcap.writer import Writer
        self.path = path
        self._codec = RosCodec(2)
        self._channels: dict[str, int] = {}
        self._file = _create(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._saved = 0
        try:
            self._writer.start(profile="ros2", library=f"failuretwin {__version__}")
            self._save()
        except OSError:
            with suppress(OSError):
                self._file.close()
            path.unlink()
            raise

    def write(self, message: Outgoing, time_ns: int) -> bool:
        """Write a message and return whether all messages so far are on the disk.

        Raises:
            OSError: If the disk is full or gone; `abandon` the file then.
        """
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message)
        channel, content = self._channels[message.topic], self._codec.encode(message)
        self._writer.add_message(channel, time_ns, content, time_ns)
        return self._file.tell() > self._saved and self._save()

    def close(self) -> None:
        """Finish the file; raises OSError if the disk is full or gone."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def abandon(self) -> None:
        """Cut off a half-written chunk and finish the file without an index.

        Raises:
            OSError: If the disk has no room even for that; may be tried again.
        """
        from mcap.writer import IndexType, Writer

        with suppress(OSError):
            self._file.close()
        os.truncate(self.path, self._saved)
        bare = {"index_types": IndexType.NONE, "use_statistics": False}
        with self.path.open("ab") as file:
            Writer(file, **bare).finish()  # type: ignore[arg-type, no-untyped-call]

    def _save(self) -> bool:
        self._file.flush()
        self._saved = self._file.tell()
        return True

    def _register(self, message: Outgoing) -> int:
        name = self._codec.full_name(message.type)
        definition, _ = self._codec.definition(message.type)
        schema = self._writer.register_schema(name, "ros2msg", definition.encode())
        return self._writer.register_channel(message.topic, "cdr", schema)


def _create(path: Path) -> BinaryIO:
    try:
        return path.open("xb")
    except FileExistsError as error:
        raise _exists(path) from error


def _exists(path: Path) -> InputError:
    return InputError(f"{path}: exists already. Choose another name, or remove it.")


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
    if path.exists():
        raise _exists(path)
    codec, writer = RosCodec(1), RosWriter(robot, RECORDED)
    definition, md5 = codec.definition(RECORDED.command_type)
    type_ = codec.full_name(RECORDED.command_type)
    try:
        with Writer(path) as bag:
            topic = bag.add_connection(RECORDED.command, type_, msgdef=definition, md5sum=md5)
            for command in commands:
                data = codec.encode(writer.command(command))
                bag.write(topic, round(command.time * NS_PER_S), data)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error


class Recorder:
    """Sink that records readings, commands and answers as MCAP.

    If the disk is full or gone, the recorder finishes the file without an index and tries every
    few seconds to start a new part: ``live.mcap``, ``live-2.mcap`` and so on. The new part begins
    with the diagnoses that could not be saved.

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
        self.trouble = ""
        self._path = path
        self._writer = RosWriter(robot, RECORDED)
        self._diagnostics = DiagnosticsWriter(robot, RECORDED.diagnostics)
        self._unsaved: deque[tuple[Outgoing, int]] = deque(maxlen=KEPT)
        self._retry_s = 0.0
        self._broken: McapFile | None = None
        try:
            self._file: McapFile | None = McapFile(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror}).") from error

    def put(self, item: Item) -> None:
        """Record an item, if the disk allows it."""
        time_ns = round(item.time * NS_PER_S)
        diagnostics = [(message, time_ns) for message in self._diagnostics.messages(item)]
        self._unsaved.extend(diagnostics)
        if self._file is None:
            self._start_part()
            return
        others = [*self._writer.messages(item), *_probabilities(item)]
        self._write([*diagnostics, *((message, time_ns) for message in others)])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is None:
            self._retry_s = 0.0
            self._start_part()
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self._give_up(error)

    def _write(self, messages: list[tuple[Outgoing, int]]) -> None:
        try:
            for message, time_ns in messages:
                if self._file is not None and self._file.write(message, time_ns):
                    self._unsaved.clear()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._broken, self._file = self._file, None
        self._wait(self._path, error)

    def _wait(self, path: Path, error: OSError) -> None:
        self.trouble = f"{path}: cannot be written ({error.strerror})"
        self._retry_s = time.monotonic() + RETRY_S

    def _start_part(self) -> None:
        """Start a new part if an attempt is due, with the diagnoses that are not saved yet."""
        if time.monotonic() < self._retry_s:
            return
        parts = (self._path.with_stem(f"{self._path.stem}-{number}") for number in count(2))
        path = next(part for part in parts if not part.exists())
        try:
            if self._broken is not None:
                self._broken.abandon()
                self._broken = None
            self._file = McapFile(path)
        except OSError as error:
            self._wait(path, error)
            return
        self.trouble = ""
        self._write(list(self._unsaved))


def _probabilities(item: Item) -> list[Outgoing]:
    """Return the probability of each hypothesis in an answer, each for a topic of its own."""
    if not isinstance(item, Answer) or item.diagnosis is None:
        return []
    return [
        Outgoing(
            f"{PROBABILITY_TOPIC}/{name.replace(':', '/').replace('+', '_and_')}",
            "std_msgs/Float64",
            {"data": probability},
        )
        for name, probability in item.diagnosis.posterior.items()
    ]
