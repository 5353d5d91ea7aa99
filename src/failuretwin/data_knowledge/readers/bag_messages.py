"""Recorded messages as rows of joint values or tool positions with their stamps.

Understood are the message of the data set's authors, JointState, JointTrajectory, PointStamped,
PoseStamped and TFMessage; each is known by its fields, whatever its package is called. A message
counts at its header's stamp: the authors stamp a command before they send it and publish it two
seconds later. Where the stamp is zero, the time at which the message was received stands in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal, get_args

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.runs import AXES
from failuretwin.core.types import MS_PER_S, BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot

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
    TRANSFORMS = "tf2_msgs/msg/TFMessage"


Role = Literal["command", "tool", "position", "goal"]
ROLES: tuple[Role, ...] = get_args(Role)

KINDS: dict[Role, tuple[Kind, ...]] = {
    "command": (Kind.TRAJECTORY, Kind.MONITORING, Kind.JOINT_STATE),
    "tool": (Kind.POINT, Kind.POSE, Kind.TRANSFORMS),
    "position": (Kind.MONITORING, Kind.JOINT_STATE),
    "goal": (Kind.MONITORING, Kind.JOINT_STATE),
}
"""Kinds of messages that can play each role."""
NAMED = HEADER | {"name": "string[]", "position": "float[]"}
FIELDS: dict[Kind, dict[str, str]] = {
    Kind.MONITORING: NAMED | {"temperature": "float[]", "voltage": "float[]"},
    Kind.JOINT_STATE: NAMED | {"velocity": "float[]", "effort": "float[]"},
    Kind.TRAJECTORY: HEADER
    | {"joint_names": "string[]", "points": "trajectory_msgs/msg/JointTrajectoryPoint[]"},
    Kind.POINT: HEADER | {"point": "geometry_msgs/msg/Point"},
    Kind.POSE: HEADER | {"pose": "geometry_msgs/msg/Pose"},
    Kind.TRANSFORMS: {"transforms": "geometry_msgs/msg/TransformStamped[]"},
}
"""Fields that each kind is known by; all kinds but the first have no others."""
STANDARD_TYPES = {kind.value.replace("/msg/", "/"): kind for kind in Kind}
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
    for kind, wanted in FIELDS.items():
        if fields == wanted or (kind is Kind.MONITORING and wanted.items() <= fields.items()):
            return kind
    return None


def kind_of_type(type_: str) -> Kind:
    """Return the kind of a message type; one that is not standard has the authors' fields."""
    return STANDARD_TYPES.get(type_.replace("/msg/", "/"), Kind.MONITORING)


def check_role(role: Role, kind: Kind | None, what: str) -> None:
    """Raise InputError unless messages of a kind can play a role; the text begins with `what`."""
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
    """Values of one topic, or of one message.

    Attributes:
        where: File and topic, for error texts.
        stamp_ns: (row,) [ns]; increasing.
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

    def take(self, rows: BoolArray | slice) -> Rows:
        """Return some of the rows."""
        duration = None if self.duration is None else self.duration[rows]
        return replace(
            self, stamp_ns=self.stamp_ns[rows], value=self.value[rows], duration=duration
        )


def topic_rows(
    messages: Sequence[BagMessage], kind: Kind, role: Role, where: str, robot: Robot
) -> Rows:
    """Return the values in the messages of one topic; tool positions without a value are left out.

    The authors' message carries durations if its role is ``command``. Of transforms only one that
    leads straight from base to tool counts: what joint states alone tell is no tool sensor.

    Raises:
        InputError: If names and values do not fit together or a time makes no sense.
    """
    if kind is Kind.TRAJECTORY:
        parts = _trajectories(messages, where)
    elif kind is Kind.MONITORING:
        parts = [_servo_row(m, where, command=role == "command") for m in messages]
    elif kind is Kind.JOINT_STATE:
        parts = [_state_row(m, where) for m in messages if len(m.content.position)]
    elif kind is Kind.TRANSFORMS:
        parts = _transforms(messages, where, robot)
    else:
        rows = [_tool_row(m, kind, where) for m in messages]
        parts = [row for row in rows if np.isfinite(row.value).all()]
    first = AXES if kind in KINDS["tool"] else ()
    return _joined(parts, where, first, in_counts=kind is Kind.MONITORING)


def _tool_row(message: BagMessage, kind: Kind, where: str) -> Rows:
    content = message.content
    point = content.point if kind is Kind.POINT else content.pose.position
    return Rows(where, _stamp(message), as_floats([[point.x, point.y, point.z]]), AXES)


def _transforms(messages: Sequence[BagMessage], where: str, robot: Robot) -> list[Rows]:
    """Return where the tool is by the transforms from the base to the first of its frames.

    These are the frame of the profile, and those that drivers of industrial arms publish.
    """
    base = robot.profile.base_link
    tools = ("tool0_controller", robot.profile.tool_link, "tool0")
    found: dict[str, list[Rows]] = {name: [] for name in tools}
    for message in messages:
        for one in message.content.transforms:
            child = one.child_frame_id.strip("/")
            if one.header.frame_id.strip("/") == base and child in found:
                at, stamp = one.transform.translation, _stamp(BagMessage(message.received_ns, one))
                found[child].append(Rows(where, stamp, as_floats([[at.x, at.y, at.z]]), AXES))
    return next((rows for rows in found.values() if rows), [])


def _stamp(message: BagMessage) -> IntArray:
    stamp_ns = _nanoseconds(message.content.header.stamp) or message.received_ns
    return np.array([stamp_ns], dtype=np.int64)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NS_PER_S + int(time.nanosec)


def _state_row(message: BagMessage, where: str) -> Rows:
    names = tuple(message.content.name)
    value = _values(message.content.position, names, "position", where)
    return Rows(where, _stamp(message), value, names)


def _values(values: Sequence[float], names: Sequence[str], field: str, where: str) -> FloatArray:
    """Return the values in a field of a message, (1, name)."""
    if len(names) != len(values):
        raise InputError(
            f"{where}: a message names {len(names)} joints ({', '.join(names)}) but its field "
            f"`{field}` holds {len(values)} values. Expected one for each."
        )
    return as_floats(values)[None]


def _servo_row(message: BagMessage, where: str, *, command: bool) -> Rows:
    """Return the values of the authors' message; in a command, temperatures are durations."""
    content = message.content
    names = _servo_names(tuple(content.name), len(content.position))
    value = _values(content.position, names, "position", where)
    if not command:
        return Rows(where, _stamp(message), value, names)
    duration_ms = _values(content.temperature, names, "temperature", where)
    if not np.all(duration_ms >= 0):
        raise InputError(
            f"{where}: the durations of a command (its field `temperature`) are "
            f"{duration_ms[0].tolist()} ms, expected 0 or more."
        )
    return Rows(where, _stamp(message), value, names, duration_ms / MS_PER_S)


def _servo_names(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return names, or the numbers of the servos where names do not tell which value is whose.

    Of the authors' programs some put one label on all values (``Target value``), some the labels
    of `AUTHORS_LABELS`; all fill in the values of servos 1, 2, ... in this order.
    """
    if len(names) < count or names == AUTHORS_LABELS:
        return tuple(str(servo) for servo in range(1, count + 1))
    return names


def _trajectories(messages: Sequence[BagMessage], where: str) -> list[Rows]:
    """Return the targets of each trajectory, but for those that a later one replaces."""
    messages = sorted((m for m in messages if len(m.content.points)), key=_stamp)
    plans = [_targets(message, where) for message in messages]
    plans = plans[:1] + [_without_start(plan) for plan in plans[1:]]
    for i, plan in enumerate(plans):
        later = (m for m in messages[i + 1 :] if set(plan.names) & set(m.content.joint_names))
        end_ns = next((_stamp(message)[0] for message in later), np.inf)
        plans[i] = plan.take(plan.stamp_ns < end_ns)
    return plans


def _targets(message: BagMessage, where: str) -> Rows:
    """Return the points of a trajectory, each sent when the one before it was due.

    One due at once is sent a nanosecond early, so that two never share a stamp.
    """
    names, points = tuple(message.content.joint_names), message.content.points
    due_ns = np.array([_nanoseconds(point.time_from_start) for point in points])
    before_ns = np.append(0, due_ns[:-1])
    wrong = np.diff(due_ns, prepend=-1) <= 0
    if wrong.any():
        due, before = (float(ns[wrong][0]) / NS_PER_S for ns in (due_ns, before_ns))
        raise InputError(
            f"{where}: a point of a trajectory is due after {due:g} s, the one before it after "
            f"{before:g} s. Expected times that increase from 0."
        )
    value = np.concatenate([_values(p.positions, names, "positions", where) for p in points])
    duration = np.broadcast_to((due_ns - before_ns)[:, None] / NS_PER_S, value.shape)
    return Rows(where, _stamp(message) + before_ns - (due_ns == 0), value, names, duration)


def _without_start(plan: Rows) -> Rows:
    """Return a later trajectory without the point that it starts from: that is no news."""
    at_once = plan.duration is not None and not np.any(plan.duration[0] > 0.0)
    return plan.take(slice(1, None)) if at_once and len(plan.value) > 1 else plan


def _joined(parts: Sequence[Rows], where: str, first: Sequence[str], *, in_counts: bool) -> Rows:
    """Return the rows of all messages by time; of those with the same stamp, the last counts.

    The columns `first` exist in any case.
    """
    names = list(dict.fromkeys([*first, *(name for part in parts for name in part.names)]))
    column = {name: index for index, name in enumerate(names)}
    every = np.concatenate([np.empty(0, dtype=np.int64), *(part.stamp_ns for part in parts)])
    stamps, place = np.unique(every, return_inverse=True)
    value, duration = np.full((2, len(stamps), len(names)), np.nan)
    starts = np.cumsum([0, *(len(part.stamp_ns) for part in parts)])
    for part, start, end in zip(parts, starts[:-1], starts[1:], strict=True):
        columns = np.array([column[name] for name in part.names], dtype=np.int64)
        cells = np.ix_(place[start:end], columns)
        value[cells] = part.value
        duration[cells] = np.nan if part.duration is None else part.duration
    timed = any(part.duration is not None for part in parts)
    return Rows(where, stamps, value, tuple(names), duration if timed else None, in_counts)
