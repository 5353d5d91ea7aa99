"""Recorded messages as rows of joint values or tool positions with their stamps.

Understood are the message of the data set's authors, JointState, JointTrajectory, PointStamped
and PoseStamped; each is known by its fields, whatever its package is called. A message counts at
its header's stamp: the authors stamp a command before they send it and publish it two seconds
later. Where the stamp is zero, the time at which the message was received stands in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, get_args

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.runs import AXES
from failuretwin.core.types import MS_PER_S, FloatArray, IntArray, as_floats

NS_PER_S = 1_000_000_000
HEADER = {"header": "std_msgs/msg/Header"}
AUTHORS_LABELS = ("joint1", "joint2", "joint3", "joint4", "joint5", "r_joint")
"""Labels of the authors' readings. Their values are those of servos 1 to 6 in this order, counted
from the gripper, so ``joint1`` is not the robot's joint1."""


class Kind(Enum):
    """A kind of message; the value says what it is called."""

    MONITORING = "messages with header, name, position, temperature and voltage"
    JOINT_STATE = "sensor_msgs/msg/JointState"
    TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
    POINT = "geometry_msgs/msg/PointStamped"
    POSE = "geometry_msgs/msg/PoseStamped"


Role = Literal["command", "tool", "position", "goal"]
ROLES: tuple[Role, ...] = get_args(Role)

KINDS: dict[Role, tuple[Kind, ...]] = {
    "command": (Kind.TRAJECTORY, Kind.MONITORING, Kind.JOINT_STATE),
    "tool": (Kind.POINT, Kind.POSE),
    "position": (Kind.MONITORING, Kind.JOINT_STATE),
    "goal": (Kind.MONITORING, Kind.JOINT_STATE),
}
"""Kinds of messages that can play each role."""
FIELDS: dict[Kind, dict[str, str]] = {
    Kind.MONITORING: {
        "name": "string[]",
        "position": "float[]",
        "temperature": "float[]",
        "voltage": "float[]",
    },
    Kind.JOINT_STATE: {
        "name": "string[]",
        "position": "float[]",
        "velocity": "float[]",
        "effort": "float[]",
    },
    Kind.TRAJECTORY: {
        "joint_names": "string[]",
        "points": "trajectory_msgs/msg/JointTrajectoryPoint[]",
    },
    Kind.POINT: {"point": "geometry_msgs/msg/Point"},
    Kind.POSE: {"pose": "geometry_msgs/msg/Pose"},
}
"""Fields beside the header that each kind is known by; all kinds but the first have no others."""
MONITORING = Kind.MONITORING
STANDARD_TYPES = {kind.value.replace("/msg/", "/"): kind for kind in Kind if kind is not MONITORING}
"""Kinds of the standard types by their ROS 1 names."""


GOAL_TOPIC = "/joint_goals"
"""Topic of the goals that motors report, in our recordings."""


@dataclass(frozen=True)
class BagTopics:
    """Which topics to read, where types and names of topics leave a choice.

    Attributes:
        command: Topic of the commands; None: the one that fits.
        tool: Topic of the tool's position; None: the one that fits, if any.
        position: Topic of the motor readings; None: the one that fits, if any.
        goal: Topic of the goals that the motors report to have received; None: `GOAL_TOPIC`, if
            there is one.
    """

    command: str | None = None
    tool: str | None = None
    position: str | None = None
    goal: str | None = None


def kind_of(fields: Mapping[str, str]) -> Kind | None:
    """Return the kind of a message with these fields, None if it is none that is understood."""
    for kind, own in FIELDS.items():
        wanted = HEADER | own
        if dict(fields) == wanted or (kind is Kind.MONITORING and wanted.items() <= fields.items()):
            return kind
    return None


def kind_of_type(type_: str) -> Kind:
    """Return the kind of a message type; one that is not standard has the authors' fields."""
    return STANDARD_TYPES.get(type_.replace("/msg/", "/"), MONITORING)


def check_role(role: Role, kind: Kind | None, what: str) -> None:
    """Raise InputError unless messages of a kind can play a role.

    Args:
        role: The role.
        kind: The kind; None: one that is not understood.
        what: The topic or type, with its verb, for the error text.
    """
    if kind not in KINDS[role]:
        expected = ", ".join(kind.value for kind in KINDS[role])
        raise InputError(f"{what} cannot be the {role}. Expected {expected}.")


@dataclass(frozen=True)
class BagTopic:
    """A topic of a recording.

    Attributes:
        name: Its name.
        type: Its message type, such as ``sensor_msgs/msg/JointState``.
        count: Number of its messages.
        kind: Kind of its messages; None if they are not understood.
    """

    name: str
    type: str
    count: int
    kind: Kind | None

    def __str__(self) -> str:
        """Return name, type and number of messages."""
        return f"{self.name} ({self.type}, {self.count} messages)"


@dataclass(frozen=True)
class BagMessage:
    """A message of a recording.

    Attributes:
        received_ns: Time at which the recorder received it [ns].
        content: The message: an object with the fields of its type.
    """

    received_ns: int
    content: Any


@dataclass(frozen=True)
class Rows:
    """Values of one topic, sorted by time, no time twice.

    Attributes:
        where: File and topic, for error texts.
        stamp_ns: (row,) [ns].
        value: Joints by name (row, name) [counts or rad], motors (row, motor) [rad], or tool
            positions (row, axis) [m]; NaN where unknown.
        names: Names of the columns.
        duration: For targets: the time to get there, like `value` [s]; None for samples.
        in_counts: Whether values are servo counts.
    """

    where: str
    stamp_ns: IntArray
    value: FloatArray
    names: tuple[str, ...] = ()
    duration: FloatArray | None = None
    in_counts: bool = False


@dataclass(frozen=True)
class _Row:
    """Values of some joints at one time; `duration` [s] for targets."""

    stamp_ns: int
    names: Sequence[str]
    value: FloatArray
    duration: FloatArray | None = None


def topic_rows(messages: Sequence[BagMessage], kind: Kind, role: Role, where: str) -> Rows:
    """Return the values in the messages of one topic; tool positions without a value are left out.

    Args:
        messages: The messages.
        kind: Their kind.
        role: Their role; the authors' message carries durations if it is ``command``.
        where: File and topic for error texts.

    Raises:
        InputError: If names and values do not fit together or a time makes no sense.
    """
    if kind in KINDS["tool"]:
        rows = [_tool_row(message, kind) for message in messages]
        rows = [row for row in rows if np.isfinite(row.value).all()]
        return _joined(rows, where, AXES)
    if kind is Kind.TRAJECTORY:
        rows = _trajectory_rows(messages, where)
    elif kind is Kind.MONITORING:
        rows = [_monitoring_row(m, where, command=role == "command") for m in messages]
    else:
        rows = [_state_row(m, where) for m in messages if len(m.content.position)]
    return _joined(rows, where, in_counts=kind is Kind.MONITORING)


def _tool_row(message: BagMessage, kind: Kind) -> _Row:
    content = message.content
    point = content.point if kind is Kind.POINT else content.pose.position
    return _Row(_stamp_ns(message), AXES, as_floats([point.x, point.y, point.z]))


def _stamp_ns(message: BagMessage) -> int:
    return _nanoseconds(message.content.header.stamp) or message.received_ns


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def _state_row(message: BagMessage, where: str) -> _Row:
    names, value = message.content.name, as_floats(message.content.position)
    _check_lengths(names, value, "position", where)
    return _Row(_stamp_ns(message), names, value)


def _monitoring_row(message: BagMessage, where: str, *, command: bool) -> _Row:
    content = message.content
    value = as_floats(content.position)
    names = _servo_names(content.name, len(value))
    _check_lengths(names, value, "position", where)
    if not command:
        return _Row(_stamp_ns(message), names, value)
    duration_ms = as_floats(content.temperature)
    _check_lengths(names, duration_ms, "temperature", where)
    if not np.all(duration_ms >= 0):
        raise InputError(
            f"{where}: the durations of a command (its field `temperature`) are "
            f"{duration_ms.tolist()} ms, expected 0 or more."
        )
    return _Row(_stamp_ns(message), names, value, duration_ms / MS_PER_S)


def _servo_names(names: Sequence[str], count: int) -> Sequence[str]:
    """Return names, or the numbers of the servos where names do not tell which value is whose.

    Of the authors' programs some put one label on all values (``Target value``), some the labels
    of `AUTHORS_LABELS`; all fill in the values of servos 1, 2, ... in this order.
    """
    if len(names) < count or tuple(names) == AUTHORS_LABELS:
        return [str(servo) for servo in range(1, count + 1)]
    return names


def _trajectory_rows(messages: Sequence[BagMessage], where: str) -> list[_Row]:
    """Return a target for each point, sent when the point before it was due."""
    plans = sorted((m for m in messages if len(m.content.points)), key=_stamp_ns)
    rows: list[_Row] = []
    for index, plan in enumerate(plans):
        segments = _segments(plan, where)
        # A point due at once with others to follow is where the plan starts. That is news only
        # at the first one; later plans start where those before them went.
        news = segments[1:] if index and len(segments) > 1 and not _lasts(segments[0]) else segments
        replaced_ns = _replaced_ns(plans, index)
        rows += [segment for segment in news if segment.stamp_ns < replaced_ns]
    return rows


def _replaced_ns(plans: Sequence[BagMessage], index: int) -> float:
    """Return when a later plan takes over a joint of this one [ns], infinity if none does."""
    joints = set(plans[index].content.joint_names)
    later = (plans[k] for k in range(index + 1, len(plans)))
    starts = (_stamp_ns(plan) for plan in later if joints & set(plan.content.joint_names))
    return next(starts, float("inf"))


def _segments(plan: BagMessage, where: str) -> list[_Row]:
    """Return the points of a plan as targets; one due at once is sent a nanosecond early.

    Two points of a plan so never share a stamp.
    """
    names, start_ns = plan.content.joint_names, _stamp_ns(plan)
    rows: list[_Row] = []
    before_ns = 0
    for point in plan.content.points:
        due_ns = _nanoseconds(point.time_from_start)
        if due_ns < 0 or (rows and due_ns <= before_ns):
            raise InputError(
                f"{where}: a point of a trajectory is due after {due_ns / NS_PER_S:g} s, the one "
                f"before it after {before_ns / NS_PER_S:g} s. Expected times that increase from 0."
            )
        value = as_floats(point.positions)
        _check_lengths(names, value, "positions", where)
        duration = np.full(len(value), (due_ns - before_ns) / NS_PER_S)
        rows.append(_Row(start_ns + before_ns - (due_ns == 0), names, value, duration))
        before_ns = due_ns
    return rows


def _lasts(row: _Row) -> bool:
    return row.duration is not None and bool(np.any(row.duration > 0.0))


def _check_lengths(names: Sequence[str], values: FloatArray, field: str, where: str) -> None:
    if len(names) != len(values):
        raise InputError(
            f"{where}: a message names {len(names)} joints ({', '.join(names)}) but its field "
            f"`{field}` holds {len(values)} values. Expected one for each."
        )


def _joined(
    rows: Sequence[_Row], where: str, first: Sequence[str] = (), *, in_counts: bool = False
) -> Rows:
    """Return rows as one table; of values with the same stamp, the last received counts.

    The columns `first` exist in any case.
    """
    names = list(dict.fromkeys([*first, *(name for row in rows for name in row.names)]))
    column = {name: index for index, name in enumerate(names)}
    stamps, place = np.unique(
        np.array([row.stamp_ns for row in rows], dtype=np.int64), return_inverse=True
    )
    value, duration = np.full((2, len(stamps), len(names)), np.nan)
    for row, at in zip(rows, place, strict=True):
        columns = [column[name] for name in row.names]
        value[at, columns] = row.value
        duration[at, columns] = np.nan if row.duration is None else row.duration
    timed = any(row.duration is not None for row in rows)
    return Rows(where, stamps, value, tuple(names), duration if timed else None, in_counts)
