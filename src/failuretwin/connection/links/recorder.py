"""Recorder: the default sink, which writes all items to MCAP and moves nothing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from failuretwin import __version__
from failuretwin.connection.links.base import Answer, CommandSent, Item, Sink
from failuretwin.connection.links.ros_messages import DiagnosticsWriter, RosTopics, RosWriter
from failuretwin.connection.links.ros_transport import Outgoing, RosCodec
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
"""Time between two attempts to write when the disk is full [s]."""
MOST_WAITING_BYTES = 10_000_000
"""Most memory for diagnoses while the disk is full: about three hours at one a second."""
SPARE_BYTES = 1_000_000
"""Memory beyond that for the chunk and the index that are written last."""


def _check_new(path: Path) -> None:
    if path.exists():
        raise InputError(f"{path}: exists already. Choose another name, or remove it.")


def _unwritten(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written ({error.strerror}).")


def write_bag(path: Path, robot: Robot, commands: Sequence[CommandSent]) -> None:
    """Write commands, in order of time, as a ROS 1 bag, with topic and type of recordings.

    Raises:
        InputError: If it exists, or rosbags is missing.
        OutputError: If it cannot be written.
    """
    with needs_extra("bags need rosbags", "files"):
        from rosbags.rosbag1 import Writer
    _check_new(path)
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
        raise _unwritten(path, error) from error


class Recorder(Sink):
    """Sink that records readings, commands and answers as MCAP.

    If the disk is full or gone, diagnoses wait in memory, readings and commands are dropped, and
    the recorder tries every few seconds to write again.

    Raises:
        InputError: If it exists, does not end in .mcap, or an extra is missing.
        OutputError: If it cannot be written.
    """

    trouble = ""

    def __init__(self, path: Path, robot: Robot) -> None:
        with needs_extra("recording needs mcap and rosbags", "live"):
            from mcap.writer import Writer
        if path.suffix != ".mcap":
            raise InputError(f"{path}: recordings are MCAP. Give a name that ends in .mcap.")
        _check_new(path)
        self._path = path
        self._codec = RosCodec(2)
        self._robot_writer = RosWriter(robot, RECORDED)
        self._diagnostics = DiagnosticsWriter(robot, RECORDED)
        self._channels: dict[str, int] = {}
        self._saved, self._retry_s = 0, 0.0
        try:  # a buffer keeps what the disk does not take, until `_save` succeeds
            self._file = path.open("xb", buffering=MOST_WAITING_BYTES + SPARE_BYTES)
        except OSError as error:
            raise _unwritten(path, error) from error
        self._mcap = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._mcap.start(profile="ros2", library=f"failuretwin {__version__}")
        self._save()
        if self.trouble:
            self._close()
            path.unlink()
            raise OutputError(f"{self.trouble}.")

    def put(self, item: Item) -> None:
        """Record an item, if the disk allows it."""
        messages = self._diagnostics.messages(item)
        if not self.trouble:
            messages += [*self._robot_writer.messages(item), *_probabilities(item)]
        if self._file.tell() - self._saved < MOST_WAITING_BYTES:
            for message in messages:
                self._write(message, round(item.time * NS_PER_S))
        if time.monotonic() >= self._retry_s:
            self._save()

    def __exit__(self, *_: object) -> None:
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._save()
        self._close()

    def _save(self) -> None:
        try:
            self._file.flush()
        except OSError as error:
            self.trouble = str(_unwritten(self._path, error)).removesuffix(".")
            self._retry_s = time.monotonic() + RETRY_S
        else:
            self.trouble, self._saved = "", self._file.tell()

    def _close(self) -> None:
        with suppress(OSError):  # the user knows from `trouble` that the disk is full
            self._file.close()

    def _write(self, message: Outgoing, time_ns: int) -> None:
        if message.topic not in self._channels:
            self._channels[message.topic] = self._register(message)
        content = self._codec.encode(message)
        self._mcap.add_message(self._channels[message.topic], time_ns, content, time_ns)

    def _register(self, message: Outgoing) -> int:
        name = self._codec.full_name(message.type)
        definition, _ = self._codec.definition(message.type)
        schema = self._mcap.register_schema(name, "ros2msg", definition.encode())
        return self._mcap.register_channel(message.topic, "cdr", schema)


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
