"""URDF files: their links and joints, and the serial chains in them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.foreign import TEXT_BYTES, check_is_file, reading
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.kinematics import Joint, Loads, SerialChain, rotation_to_z

MOVING_TYPES = ("revolute", "continuous", "prismatic")
HELD_TYPES = ("fixed", "floating", "planar")

Triple = tuple[float, float, float]
FARTHEST = 1e3
"""Largest accepted length or angle [m or rad]."""
LARGEST_NUMBER = 1e9
"""Largest accepted mass, moment, speed or limit, in SI units; a larger one counts as missing."""

_XML_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_XACRO = re.compile(rb"<xacro:|\$\{|\$\((?:find|arg|eval|env|optenv)\b")
"""Found only in a template; an expanded file may still declare the namespace."""


@dataclass(frozen=True)
class UrdfJoint:
    """One joint as the file states it.

    Attributes:
        name: Name of the joint.
        type: URDF joint type.
        parent: Link nearer to the base.
        child: Link nearer to the tool.
        T_pc: Pose of the joint frame in the parent link, (4, 4).
        axis: Unit vector in the joint frame.
        low: Lower limit [rad or m].
        high: Upper limit [rad or m].
        velocity: Largest speed [rad/s or m/s]; None where the file states none above zero.
        effort: Largest torque or force [N m or N]; None where the file states none above zero.
        mimic: Name of the joint that it follows; None for a joint of its own.
    """

    name: str
    type: str
    parent: str
    child: str
    T_pc: FloatArray
    axis: Triple
    low: float
    high: float
    velocity: float | None = None
    effort: float | None = None
    mimic: str | None = None

    @property
    def has_motor(self) -> bool:
        """Whether it can have a motor of its own."""
        return self.type in MOVING_TYPES and self.mimic is None

    @property
    def reversed(self) -> UrdfJoint:
        """A fixed joint, from its child to its parent."""
        return replace(
            self, parent=self.child, child=self.parent, T_pc=as_floats(np.linalg.inv(self.T_pc))
        )


@dataclass(frozen=True)
class LinkFacts:
    """Contents of one link.

    Attributes:
        mass: Its mass [kg]; None where the file states none that can be read.
        centre: Centre of mass in the link's frame [m]; default: the frame's origin.
        has_inertia: Whether all three moments of inertia are stated and above zero.
        meshes: Mesh files by their names in the file.
    """

    mass: float | None
    centre: Triple
    has_inertia: bool
    meshes: tuple[str, ...]


@dataclass(frozen=True)
class Urdf:
    """Joints and links of a URDF file.

    Attributes:
        source: The file.
        links: Names of the links, with repetitions.
        joints: Its joints.
        name: Name of the robot.
        facts: Contents of each link, by name.
    """

    source: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    name: str
    facts: Mapping[str, LinkFacts]

    @property
    def roots(self) -> list[str]:
        """Links that are no joint's child."""
        children = {joint.child for joint in self.joints}
        return [link for link in dict.fromkeys(self.links) if link not in children]

    @cached_property
    def _next(self) -> Mapping[str, Sequence[UrdfJoint]]:
        """Joints that lead on from each link: to its children, then back over fixed joints."""
        onward: dict[str, list[UrdfJoint]] = {}
        for joint in self.joints:
            onward.setdefault(joint.parent, []).append(joint)
        for joint in self.joints:
            if joint.type == "fixed":
                onward.setdefault(joint.child, []).append(joint.reversed)
        return onward

    def steps(self, base: str) -> dict[str, UrdfJoint | None]:
        """Return the joint before each link on the way from `base`, nearer links first.

        `base` has None; a fixed joint leads in both directions.
        """
        steps: dict[str, UrdfJoint | None] = {base: None}
        waiting = [base]
        for link in waiting:
            for joint in self._next.get(link, ()):
                if joint.child not in steps:
                    steps[joint.child] = joint
                    waiting.append(joint.child)
        return steps

    def path(self, base_link: str, tool_link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from `base_link` to `tool_link`, in that order."""
        for link in (base_link, tool_link):
            if link not in self.links:
                raise InputError(f"{self.source}: {unknown_name('link', link, self.links)}")
        steps = self.steps(base_link)
        if tool_link not in steps:
            raise InputError(
                f"{self.source}: no chain of joints leads from {base_link!r} to {tool_link!r}. "
                "Name a base link that carries the tool."
            )
        way, link = [], tool_link
        while (joint := steps[link]) is not None:
            way.append(joint)
            link = joint.parent
        return tuple(reversed(way))

    def chain(self, base_link: str, tool_link: str, moving: Collection[str]) -> SerialChain:
        """Return the chain to the tool link with the joints `moving`; other joints stay at zero."""
        path = self.path(base_link, tool_link)
        types = {joint.name: joint.type for joint in path}
        for name in moving:
            if name not in types:
                error = unknown_name("joint on the way to the tool", name, types)
                raise InputError(f"{self.source}: {error}")
            if types[name] not in MOVING_TYPES:
                raise InputError(
                    f"{self.source}: joint {name!r} is {types[name]}, so no motor can move it. "
                    f"Expected one of {', '.join(MOVING_TYPES)}."
                )
        T = np.eye(4)
        joints = []
        for joint in path:
            T = T @ joint.T_pc
            if joint.name in moving:
                turn = np.eye(4)
                turn[:3, :3] = rotation_to_z(joint.axis)
                slides, T_pj = joint.type == "prismatic", _snap(T @ turn)
                joints.append(Joint(joint.name, slides, T_pj, joint.low, joint.high, joint.axis))
                T = turn.T
        return SerialChain(tuple(joints), _snap(T))

    def with_joints(self, changes: Mapping[str, Callable[[UrdfJoint], UrdfJoint]]) -> Urdf:
        """Return a copy with some joints changed, by name."""
        names = {joint.name for joint in self.joints}
        for name in changes:
            if name not in names:
                raise InputError(f"{self.source}: {unknown_name('joint', name, names)}")
        joints = (changes[j.name](j) if j.name in changes else j for j in self.joints)
        return replace(self, joints=tuple(joints))

    def loads(self, base_link: str, chain: SerialChain) -> Loads:
        """Return the masses on each joint of the `chain` from `base_link`; others stay at zero.

        Links without a mass weigh nothing.
        """
        names = {joint.name: k for k, joint in enumerate(chain.joints)}
        mass, moment = np.zeros(len(names)), np.zeros((len(names), 3))
        carried: dict[str, tuple[UrdfJoint, FloatArray]] = {}  # by whom, and the pose behind it
        for link, joint in self.steps(base_link).items():
            if joint is None:
                continue
            if joint.name in names:
                carried[link] = joint, np.eye(4)
            elif joint.parent in carried:
                carrier, T = carried[joint.parent]
                carried[link] = carrier, T @ joint.T_pc
            fact = self.facts.get(link)
            if link not in carried or fact is None or fact.mass is None:
                continue
            carrier, T = carried[link]
            at = T[:3, :3] @ np.array(fact.centre) + T[:3, 3]
            segment = names[carrier.name]
            mass[segment] += fact.mass
            moment[segment] += fact.mass * (at @ rotation_to_z(carrier.axis))
        weighs = mass[:, None] > 0
        centre = np.divide(moment, mass[:, None], out=np.zeros_like(moment), where=weighs)
        return Loads(chain, mass, centre)


def _snap(T: FloatArray) -> FloatArray:
    """Return `T` with rotation entries within rounding of 0, 1 or -1 set to these values."""
    T = T.copy()
    near = np.abs(T[:3, :3] - np.round(T[:3, :3])) < 1e-15
    T[:3, :3][near] = np.round(T[:3, :3][near])
    T.setflags(write=False)
    return T


def read_urdf(path: Path) -> Urdf:
    """Read links and joints of a URDF file."""
    root = read_root(path)
    facts = {link.get("name", ""): _read_link(link) for link in root.findall("link")}
    links = tuple(link.get("name", "") for link in root.findall("link"))
    joints = tuple(_read_joint(joint, path) for joint in root.findall("joint"))
    return Urdf(str(path), links, joints, root.get("name", ""), facts)


def read_root(path: Path) -> ElementTree.Element:
    """Return the <robot> element of a URDF file."""
    if path.suffix == ".toml":
        raise InputError(
            f"{path}: is the profile of a robot, expected its URDF. A profile is checked wherever "
            "it is used as --robot; make one of a URDF by: failuretwin robot init URDF --out FILE."
        )
    with reading(path, "a URDF"):
        check_is_file(path, "a URDF")
        if path.stat().st_size > TEXT_BYTES:
            raise InputError(f"{path}: is larger than a URDF can be. Check the name of the file.")
        data = path.read_bytes()
    if _XACRO.search(_XML_COMMENT.sub(b"", data)):
        stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
        out = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_expanded.urdf"
        raise InputError(
            f"{path}: contains xacro tags, so it is the template of a URDF. Expand it with "
            f"`xacro {path.name} > {out}` and give that file."
        )
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise InputError(f"{path}: not an XML file ({error}). Expected a URDF.") from error
    if root.tag != "robot":
        raise InputError(f"{path}: the top element is <{root.tag}>, a URDF has <robot>.")
    return root


def _read_joint(element: ElementTree.Element, path: Path) -> UrdfJoint:
    name = element.get("name", "")
    where = f"{path}: joint {name!r}"
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise InputError(f"{where} has no <parent> or no <child>. Add the missing link.")
    type_ = element.get("type", "")
    if type_ not in MOVING_TYPES + HELD_TYPES:
        raise InputError(f"{where}: {unknown_name('joint type', type_, MOVING_TYPES + HELD_TYPES)}")
    origin, limit = element.find("origin"), element.find("limit")
    axis = _triple(element.find("axis"), "xyz", where, "1 0 0")
    length = math.hypot(*axis)
    if type_ in HELD_TYPES:
        axis, length = (1.0, 0.0, 0.0), 1.0  # exporters write zeros where no axis is needed
    if length == 0.0:
        raise InputError(f"{where} has a zero axis. Expected a direction such as '0 0 1'.")
    mimic = element.find("mimic")
    unlimited = limit is None or type_ == "continuous"
    return UrdfJoint(
        name=name,
        type=type_,
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        T_pc=transform(_triple(origin, "xyz", where), _triple(origin, "rpy", where)),
        axis=(axis[0] / length, axis[1] / length, axis[2] / length),
        low=-np.inf if unlimited else _number(limit, "lower", where),
        high=np.inf if unlimited else _number(limit, "upper", where),
        velocity=_above_zero(limit, "velocity", where),
        effort=_above_zero(limit, "effort", where),
        mimic=None if mimic is None else mimic.get("joint", ""),
    )


def _triple(
    element: ElementTree.Element | None, key: str, where: str, default: str = "0 0 0"
) -> Triple:
    text = default if element is None else element.get(key, default)
    values = _three_numbers(text)
    if values is None:
        raise InputError(
            f"{where}: {key}={text[:40]!r}, expected three finite numbers within +-{FARTHEST:g}."
        )
    return values


def _three_numbers(text: str) -> Triple | None:
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError:
        return None
    return (
        (x, y, z) if max(abs(x), abs(y), abs(z)) <= FARTHEST and not math.isnan(x + y + z) else None
    )


def _number(element: ElementTree.Element | None, key: str, where: str) -> float:
    text = "0" if element is None else element.get(key, "0")
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{where}: {key}={text!r}, expected a number.") from None


def _above_zero(element: ElementTree.Element | None, key: str, where: str) -> float | None:
    """Return a limit; None for 0, which exporters write for unknown ones."""
    value = _number(element, key, where)
    return value if 0.0 < value <= LARGEST_NUMBER else None


def transform(xyz: Triple, rpy: Triple) -> FloatArray:
    """Return the pose (4, 4) at `xyz` [m], turned by roll, pitch and yaw `rpy` [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    T = np.eye(4)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, 3] = xyz
    return T


def _read_link(link: ElementTree.Element) -> LinkFacts:
    """Return the contents of a link; unreadable numbers count as missing."""
    inertia, origin = link.find("inertial/inertia"), link.find("inertial/origin")
    moments = [_stated(inertia, key) for key in ("ixx", "iyy", "izz")]
    at = "" if origin is None else origin.get("xyz", "")
    return LinkFacts(
        mass=_stated(link.find("inertial/mass"), "value"),
        centre=_three_numbers(at) or (0.0, 0.0, 0.0),
        has_inertia=all(moment is not None and moment > 0.0 for moment in moments),
        meshes=tuple(mesh.get("filename", "") for mesh in link.iter("mesh")),
    )


def _stated(element: ElementTree.Element | None, key: str) -> float | None:
    try:
        value = float("nan" if element is None else element.get(key, "nan"))
    except ValueError:
        return None
    return value if abs(value) <= LARGEST_NUMBER else None
