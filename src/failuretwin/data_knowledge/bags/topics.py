"""Which topic of a recording is what: commands, the tool's position, motor readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.data_knowledge.bags.file import BagTopic
from failuretwin.data_knowledge.bags.messages import Kind, kind_of

Role = Literal["command", "tool", "position"]
ROLES: tuple[Role, ...] = get_args(Role)

KINDS: dict[Role, tuple[Kind, ...]] = {
    "command": (Kind.TRAJECTORY, Kind.MONITORING, Kind.JOINT_STATE),
    "tool": (Kind.POINT, Kind.POSE),
    "position": (Kind.MONITORING, Kind.JOINT_STATE),
}
"""Kinds of messages that can play each role."""
EXPECTED: dict[Role, str] = {
    "command": "no commands. Expected a JointTrajectory, or joint values on a topic that has "
    "`command` or `position_monitoring` in its name",
    "tool": "neither tool positions nor motor readings. Expected a PointStamped, PoseStamped or "
    "JointState, or a topic `condition_monitoring`",
    "position": "no motor readings. Expected a JointState or a topic `condition_monitoring`",
}
"""What a recording lacks where no topic fits a role."""
COMMAND_WORDS = ("command", "cmd", "position_monitoring")
"""A topic of joint values with one of these in its name holds commands."""
WISH_WORDS = (*COMMAND_WORDS, "desired", "goal", "reference", "setpoint", "target")
"""A topic with one of these in its name holds no readings."""
LISTED_TOPICS = 20
"""Topics that an error text lists at most."""


@dataclass(frozen=True)
class BagTopics:
    """Which topics to read, where types and names of topics leave a choice.

    Attributes:
        command: Topic of the commands; None: the one that fits.
        tool: Topic of the tool's position; None: the one that fits, if any.
        position: Topic of the motor readings; None: the one that fits, if any.
    """

    command: str | None = None
    tool: str | None = None
    position: str | None = None


def fitting_topics(
    role: Role, name: str | None, found: Sequence[BagTopic], path: Path
) -> list[BagTopic]:
    """Return the topics that can play a role: the one named, or all that type and name allow.

    Raises:
        InputError: If the topic named does not exist, is empty or cannot play the role.
    """
    if name is None:
        return [topic for topic in found if topic.count and _suits(role, topic)]
    same = [topic for topic in found if topic.name.strip("/") == name.strip("/")]
    if not same:
        raise InputError(f"{path}: {unknown_name('topic', name, [t.name for t in found])}")
    (topic,) = same
    if kind_of(topic.fields) not in KINDS[role]:
        kinds = ", ".join(kind.value for kind in KINDS[role])
        raise InputError(f"{path}: topic {topic} cannot be the {role}. Expected {kinds}.")
    if topic.count == 0:
        raise InputError(f"{path}: topic {topic} is empty. Name another one as the {role}.")
    return same


def _suits(role: Role, topic: BagTopic) -> bool:
    kind, name = kind_of(topic.fields), topic.name.lower()
    if kind is None or kind not in KINDS[role]:
        return False
    if role == "command":
        return kind is Kind.TRAJECTORY or any(word in name for word in COMMAND_WORDS)
    return not any(word in name for word in WISH_WORDS)


def only_topic(role: Role, topics: Sequence[BagTopic], path: Path) -> BagTopic | None:
    """Return the one topic for a role, None if there is none.

    Raises:
        InputError: If there are several.
    """
    if len(topics) > 1:
        example = f'{role} = "{topics[0].name}"'
        raise InputError(
            f"{path}: several topics could be the {role}: {_listed(topics)}. Name one, such as "
            f"{example}, under [topics] in a TOML file for --columns or in BagTopics in Python."
        )
    return topics[0] if topics else None


def check_understood(found: Sequence[BagTopic], path: Path) -> None:
    """Raise an InputError if no topic holds messages that are understood."""
    if not any(topic.count and kind_of(topic.fields) for topic in found):
        kinds = ", ".join(kind.value for kind in Kind)
        raise InputError(
            f"{path}: holds no messages that are understood. Expected {kinds}. "
            f"Found: {_listed(found)}."
        )


def nothing_for(role: Role, found: Sequence[BagTopic], path: Path) -> InputError:
    """Return the error for a role that no topic fits."""
    return InputError(
        f"{path}: holds {EXPECTED[role]}; if another topic holds them, name it under [topics] in a "
        f"TOML file for --columns or in BagTopics in Python. Found: {_listed(found)}."
    )


def _listed(topics: Sequence[BagTopic]) -> str:
    shown = [str(topic) for topic in topics[:LISTED_TOPICS]]
    if len(topics) > LISTED_TOPICS:
        shown.append(f"and {len(topics) - LISTED_TOPICS} more")
    return ", ".join(shown) or "no topics"
