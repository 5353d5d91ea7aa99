"""What is said on a network, whatever kind it is: a robot that is played, and the diagnosis."""

from __future__ import annotations

from typing import Protocol, Self

from failuretwin.connection.links.base import Answer, CommandSent, Item, Reading
from failuretwin.connection.links.ros_messages import DiagnosticsPublisher, Outgoing, RosWriter


class Publishers(Protocol):
    """Publishers of some topics."""

    @property
    def trouble(self) -> str:
        """What keeps messages from arriving just now; empty if nothing does."""
        ...

    def send(self, message: Outgoing) -> None:
        """Publish a message on its topic."""
        ...

    def close(self) -> None:
        """Stop publishing."""
        ...


class _NetworkSink:
    """A sink that publishes.

    Args:
        name: What to call it.
        publishers: Its publishers.
    """

    def __init__(self, name: str, publishers: Publishers) -> None:
        self.name = name
        self._publishers = publishers

    @property
    def trouble(self) -> str:
        """What keeps items from arriving just now."""
        return self._publishers.trouble

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.close()


class RobotSink(_NetworkSink):
    """Plays a robot: publishes readings and commands as the robot itself would.

    Whoever listens to the commands will move. Nothing but `emulate` makes use of it.

    Args:
        name: What to call it.
        writer: What writes the messages.
        publishers: Publishers of its topics.
    """

    def __init__(self, name: str, writer: RosWriter, publishers: Publishers) -> None:
        super().__init__(name, publishers)
        self._writer = writer

    def put(self, item: Item) -> None:
        """Publish a reading or a command."""
        if isinstance(item, Reading):
            messages = self._writer.reading(item)
        elif isinstance(item, CommandSent):
            messages = self._writer.command(item)
        else:
            return
        for message in messages:
            self._publishers.send(message)


class DiagnosticsSink(_NetworkSink):
    """Publishes answers as diagnostics: every second, and at once when a status gets worse.

    Args:
        name: What to call it.
        bulletin: What writes the messages.
        publishers: Publishers of its topic.
    """

    def __init__(self, name: str, bulletin: DiagnosticsPublisher, publishers: Publishers) -> None:
        super().__init__(name, publishers)
        self._bulletin = bulletin

    def put(self, item: Item) -> None:
        """Publish an answer if it is time to."""
        message = self._bulletin.message(item) if isinstance(item, Answer) else None
        if message is not None:
            self._publishers.send(message)
