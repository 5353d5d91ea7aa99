"""The default sink: it records everything and moves nothing."""

from __future__ import annotations

import time
from collections import deque
from itertools import count
from pathlib import Path
from typing import Self

from failuretwin.connection.links.bulletin import Bulletin
from failuretwin.connection.links.mcap_file import McapFile
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.ros_writer import Outgoing, RosWriter
from failuretwin.connection.links.values import Answer, CommandSent, Item, Reading
from failuretwin.core.errors import InputError, OutputError
from failuretwin.data_knowledge.bags.messages import NS_PER_S
from failuretwin.digital_model.robot import Robot

RECORDED = RosTopics(
    command="/command",
    command_type="trajectory_msgs/JointTrajectory",
    position="/joint_states",
    position_type="sensor_msgs/JointState",
    tool="/tool_point",
)
"""Topics in a recording: standard types, whatever the robot itself speaks."""
PROBABILITY_TOPIC = "/failuretwin/probability"
"""Under it the probability of each hypothesis has a topic of its own, to be plotted."""
RETRY_S = 5.0
"""Time between two attempts to go on when the disk is full [s]."""
KEPT = 10_000
"""Diagnoses that are kept for a disk that is full; at one a second nearly three hours."""


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
        self._bulletin = Bulletin(robot, RECORDED)
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
