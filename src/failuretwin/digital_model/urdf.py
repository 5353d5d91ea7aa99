"""URDF files: their links and joints, how these hang together, and serial chains out of them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.kinematics import Joint, Loads, SerialChain, rotation_to_z

MOVING_TYPES = ("revolute", "continuous", "prismatic")
HELD_TYPES = ("fixed", "floating", "planar")

Triple = tuple[float, float, float]

_XML_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_XACRO = re.compile(rb"<xacro:|\$\{|\$\((?:find|arg|eval|env|optenv)\b")
"""What only a template holds; an expanded file may still declare the namespace."""


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
        """Whether a motor of its own can move it."""
        return self.type in MOVING_TYPES and self.mimic is None

    @property
    def reversed(self) -> UrdfJoint:
        """A fixed joint, from its child to its parent."""
        return replace(
            self, parent=self.child, child=self.parent, T_pc=as_floats(np.linalg.inv(self.T_pc))
        )


@dataclass(frozen=True)
class LinkFacts:
    """What a file says of one link.

    Attributes:
        mass: Its mass [kg]; None where the file states none that can be read.
        centre: Centre of the mass in the link's frame [m]; the frame's origin where none is stated.
        has_inertia: Whether all three moments of inertia are stated and above zero.
        meshes: Mesh files as the file names them.
    """

    mass: float | None
    centre: Triple
    has_inertia: bool
    meshes: tuple[str, ...]


@dataclass(frozen=True)
class Urdf:
    """The joints and links of a URDF file.

    Attributes:
        source: The file.
        links: Names of the links, as often as the file has them.
        joints: Its joints.
        name: Name of the robot.
        facts: What it says of each link, by name.
    """

    source: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]
    name: str
    facts: Mapping[str, LinkFacts]

    @property
    def roots(self) -> list[str]:
        """Links that hang from no other."""
        children = {joint.child for joint in self.joints}
        return [link for link in dict.fromkeys(self.links) if link not in children]

    def ways(self, base: str) -> dict[str, tuple[UrdfJoint, ...]]:
        """Return the joints from `base` to each link that hangs from it, `base` itself first.

        What `base` is fixed to hangs from it too: a fixed joint leads either way.
        """
        ways: dict[str, tuple[UrdfJoint, ...]] = {base: ()}
        waiting = [base]
        for link in waiting:
            onward = [j for j in self.joints if j.parent == link and j.child not in ways]
            back = [j for j in self.joints if j.child == link and j.parent not in ways]
            onward += [joint.reversed for joint in back if joint.type == "fixed"]
            ways |= {joint.child: (*ways[link], joint) for joint in onward}
            waiting += dict.fromkeys(joint.child for joint in onward)
        return ways

    def tools(self, base: str) -> dict[str, int]:
        """Return the ends of all branches above `base` and how many motors are on the way there.

        The best candidate for the tool, that with the most motors, comes first and, among equals,
        the one with the longest way along the joint frames.
        """
        ends = set(self.links) - {joint.parent for joint in self.joints}
        rank = {}
        for link, way in self.ways(base).items():
            length = sum(float(np.linalg.norm(joint.T_pc[:3, 3])) for joint in way)
            if link in ends:
                rank[link] = -sum(joint.has_motor for joint in way), -round(length, 9), link
        return {link: -rank[link][0] for link in sorted(rank, key=rank.__getitem__)}

    def path(self, base_link: str, tool_link: str) -> tuple[UrdfJoint, ...]:
        """Return the joints from `base_link` to `tool_link`, in that order.

        Raises:
            InputError: If a link does not exist or the tool does not hang from the base.
        """
        for link in (base_link, tool_link):
            if link not in self.links:
                raise InputError(f"{self.source}: {unknown_name('link', link, self.links)}")
        way = self.ways(base_link).get(tool_link)
        if way is None:
            raise InputError(
                f"{self.source}: no chain of joints leads from {base_link!r} to {tool_link!r}. "
                "Name a base link that carries the tool."
            )
        return way

    def chain(self, base_link: str, tool_link: str, moving: Collection[str]) -> SerialChain:
        """Return the chain to the tool link in which the joints `moving` move.

        Joints of the path that are not named stay at zero.

        Raises:
            InputError: If a named joint is not on the path or of a type that cannot move.
        """
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
                joints.append(Joint(joint.name, slides, T_pj, joint.low, joint.high))
                T = turn.T
        return SerialChain(tuple(joints), _snap(T))

    def with_joints(self, changes: Mapping[str, Callable[[UrdfJoint], UrdfJoint]]) -> Urdf:
        """Return the same with some joints changed, by name.

        Raises:
            InputError: If there is no such joint.
        """
        names = [joint.name for joint in self.joints]
        for name in changes:
            if name not in names:
                raise InputError(f"{self.source}: {unknown_name('joint', name, names)}")
        joints = (changes[j.name](j) if j.name in changes else j for j in self.joints)
        return replace(self, joints=tuple(joints))

    def loads(self, base_link: str, chain: SerialChain) -> Loads:
        """Return what each joint of the `chain` from `base_link` carries; others are at zero.

        Links without a mass weigh nothing.
        """
        names = [joint.name for joint in chain.joints]
        mass, moment = np.zeros(len(names)), np.zeros((len(names), 3))
        for link, way in self.ways(base_link).items():
            carriers = [k for k, joint in enumerate(way) if joint.name in names]
            fact = self.facts.get(link)
            if not carriers or fact is None or fact.mass is None:
                continue
            first = carriers[-1]
            at = np.array(fact.centre)
            for joint in reversed(way[first + 1 :]):
                at = joint.T_pc[:3, :3] @ at + joint.T_pc[:3, 3]
            segment = names.index(way[first].name)
            mass[segment] += fact.mass
            moment[segment] += fact.mass * (at @ rotation_to_z(way[first].axis))
        weighs = mass[:, None] > 0
        centre = np.divide(moment, mass[:, None], out=np.zeros_like(moment), where=weighs)
        return Loads(chain, mass, centre)


def _snap(T: FloatArray) -> FloatArray:
    """Return `T` with rotation entries within rounding of 0, 1 or -1 put exactly there."""
    T = T.copy()
    near = np.abs(T[:3, :3] - np.round(T[:3, :3])) < 1e-15
    T[:3, :3][near] = np.round(T[:3, :3][near])
    T.setflags(write=False)
    return T


def read_urdf(path: Path) -> Urdf:
    """Read links and joints of a URDF file.

    Raises:
        InputError: If the file is missing, not XML, not a URDF, or a joint is malformed.
    """
    root = read_root(path)
    facts = {link.get("name", ""): _read_link(link) for link in root.findall("link")}
    links = tuple(link.get("name", "") for link in root.findall("link"))
    joints = tuple(_read_joint(joint, path) for joint in root.findall("joint"))
    return Urdf(str(path), links, joints, root.get("name", ""), facts)


def read_root(path: Path) -> ElementTree.Element:
    """Return the <robot> element of a URDF file.

    Raises:
        InputError: If the file is missing, a profile, not XML, a xacro template or not a URDF.
    """
    if path.suffix == ".toml":
        raise InputError(
            f"{path}: is the profile of a robot, expected its URDF. A profile is checked wherever "
            "it is used as --robot; make one of a URDF by: failuretwin robot init URDF --out FILE."
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    if _XACRO.search(_XML_COMMENT.sub(b"", data)):
        stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
        out = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_expanded.urdf"
        raise InputError(
            f"{path}: contains xacro tags, so it is the template of a URDF. Expand it with "
            f"`xacro {path.name} > {out}` and give that file."
        )
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
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
        raise InputError(f"{where}: {key}={text!r}, expected three finite numbers.")
    return values


def _three_numbers(text: str) -> Triple | None:
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError:
        return None
    return (x, y, z) if math.isfinite(x + y + z) else None


def _number(element: ElementTree.Element | None, key: str, where: str) -> float:
    text = "0" if element is None else element.get(key, "0")
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{where}: {key}={text!r}, expected a number.") from None


def _above_zero(element: ElementTree.Element | None, key: str, where: str) -> float | None:
    """Return a limit; exporters write 0 for one that they do not know."""
    value = _number(element, key, where)
    return value if 0.0 < value < math.inf else None


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
    """Return what is said of a link; figures that cannot be read are as good as none."""
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
    return value if math.isfinite(value) else None
