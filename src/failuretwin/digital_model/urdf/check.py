"""Check of a URDF before use: its chain, its motors, and findings of three severities.

An error prevents the use of the file; a warning says what is missing or assumed; a note states a
choice.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.digital_model.kinematics import CANNOT_MOVE, farthest_reach, has_range, levers
from failuretwin.digital_model.urdf.file import (
    HELD_TYPES,
    MOVING_TYPES,
    LinkFacts,
    Urdf,
    UrdfJoint,
    read_root,
    read_urdf,
)
from failuretwin.digital_model.urdf.tool import ToolChoice, choose_tool

Severity = Literal["error", "warning", "note"]
SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One finding for the user.

    Attributes:
        severity: ``error``, ``warning`` or ``note``.
        message: The finding and its fix.
    """

    severity: Severity
    message: str


@dataclass(frozen=True)
class JointReport:
    """One joint of the file and its role.

    Attributes:
        joint: The joint as the file states it.
        motor: Name of its motor, if it can move the tool point.
        reason: Why it has no motor, else empty.
        mass: Mass of the link that it carries [kg]; None where the file states none.
    """

    joint: UrdfJoint
    motor: str | None
    reason: str
    mass: float | None


@dataclass(frozen=True)
class UrdfReport:
    """Contents of a URDF; base, tool and joints are empty where an error hides them.

    Attributes:
        source: The file.
        findings: Findings, errors first.
        name: Name of the robot in the file.
        base_link: Link that carries the base frame.
        tool_link: Link whose origin is the tool point.
        joints: Joints from base to tool, then all others.
        reach: Largest distance of the tool from the base's origin found [m].
        moving_mass: Mass carried by the first motor [kg].
    """

    source: Path
    findings: tuple[Finding, ...] = ()
    name: str = ""
    base_link: str = ""
    tool_link: str = ""
    joints: tuple[JointReport, ...] = ()
    reach: float = 0.0
    moving_mass: float = 0.0

    @property
    def motors(self) -> list[JointReport]:
        """Joints that can move the tool point, in chain order."""
        return [joint for joint in self.joints if joint.motor is not None]

    @property
    def others(self) -> list[JointReport]:
        """Joints that cannot move the tool point."""
        return [joint for joint in self.joints if joint.motor is None]

    def with_findings(self, more: Iterable[Finding]) -> UrdfReport:
        """Return the report with more findings, sorted by severity."""
        known = [*self.findings, *more]
        known.sort(key=lambda finding: SEVERITIES.index(finding.severity))
        return replace(self, findings=tuple(known))

    def having(self, severity: Severity) -> list[str]:
        """Return the messages of one severity."""
        return [finding.message for finding in self.findings if finding.severity == severity]

    def raise_errors(self) -> None:
        """Raise InputError with all errors among the findings, if there are any."""
        errors = self.having("error")
        if errors:
            raise InputError(f"{self.source}: " + "\n  also: ".join(errors))


SHORT_LEVER_M = 0.01
"""Lever below which a motor's faults are hardly visible [m/rad]."""

MOST_MOTORS = 64
"""Largest number of motors of an arm: the longest snakes have half as many."""
NAMES_SHOWN = 4
PICTURE = "Only the picture is missing; kinematics works."

FRAME_MASS_KG = 1e-6
"""Largest mass that exporters give to frames without a body [kg]."""


NOISE_M = 0.0005
"""Assumed noise of an unknown tool sensor on each axis [m]: a fair camera."""


def check_urdf(
    path: Path, base: str | None = None, tool: str | None = None, noise_m: float = NOISE_M
) -> UrdfReport:
    """Return the report on a URDF; its kinematics need no meshes, inertias or mimic joints.

    Without a base the root carries the base frame. Without a tool it is found by its name, else it
    is the end of the branch with the most moving joints. A joint whose lever is below the noise of
    the tool sensor, `noise_m` [m], has no motor.
    """
    report = UrdfReport(path).with_findings(_file_findings(path))
    if report.having("error"):
        return report
    urdf = read_urdf(path)
    report = replace(report, name=urdf.name)
    report = report.with_findings([*_name_findings(urdf), *_root_findings(urdf, base)])
    return report if report.having("error") else _with_chain(report, urdf, base, tool, noise_m)


def _with_chain(
    report: UrdfReport, urdf: Urdf, base: str | None, tool: str | None, noise_m: float
) -> UrdfReport:
    base_link = urdf.roots[0] if base is None else base
    choice = choose_tool(urdf, base_link) if tool is None else ToolChoice(tool, {})
    tool_link = choice.link
    path = urdf.path(base_link, tool_link)
    report = replace(report, base_link=base_link, tool_link=tool_link).with_findings(
        [
            *_base_findings(urdf, base_link),
            *_loop_findings(urdf, path),
            *_tool_findings(choice),
            *_joint_findings(urdf, path),
            *_mass_findings(urdf, path),
            *_mesh_findings(urdf.facts.values(), report.source.parent),
        ]
    )
    return report if report.having("error") else _with_motors(report, urdf, path, noise_m)


def _with_motors(
    report: UrdfReport, urdf: Urdf, path: Sequence[UrdfJoint], noise_m: float
) -> UrdfReport:
    motors = [joint for joint in path if joint.has_motor]
    names = [joint.name for joint in motors]
    chain = urdf.chain(report.base_link, report.tool_link, names)
    moves = dict(zip(names, levers(chain).tolist(), strict=True))
    seen = {name: lever for name, lever in moves.items() if lever >= max(noise_m, CANNOT_MOVE)}
    short = {name: lever for name, lever in moves.items() if CANNOT_MOVE <= lever < noise_m}
    moving = urdf.steps(motors[0].child)
    return replace(
        report,
        joints=_joint_reports(urdf, path, list(seen), short),
        reach=farthest_reach(chain),
        moving_mass=sum(urdf.facts[n].mass or 0.0 for n in moving if n in urdf.facts),
    ).with_findings(_lever_findings(seen, short, report.tool_link, noise_m))


def _joint_reports(
    urdf: Urdf, path: Sequence[UrdfJoint], movers: Sequence[str], short: Collection[str]
) -> tuple[JointReport, ...]:
    on_path = {joint.name for joint in path}
    ordered = [*path, *(joint for joint in urdf.joints if joint.name not in on_path)]
    motors = {name: f"motor_{k}" for k, name in enumerate(movers, start=1)}
    reports = []
    for joint in ordered:
        motor, fact = motors.get(joint.name), urdf.facts.get(joint.child)
        reason = "" if motor else _reason(joint, joint.name in on_path, joint.name in short)
        reports.append(JointReport(joint, motor, reason, None if fact is None else fact.mass))
    return tuple(reports)


def _reason(joint: UrdfJoint, on_path: bool, short: bool) -> str:
    if joint.type == "fixed":
        return "fixed"
    if not on_path:
        return "not on the way to the tool"
    if joint.mimic is not None:
        return f"follows {joint.mimic}, held at zero"
    if not joint.has_motor:
        return f"{joint.type}, held at zero"
    if short:
        return "its axis runs too near to the tool point"
    return "its axis runs through the tool point"


def _of_names(severity: Severity, names: Collection[str], text: str) -> list[Finding]:
    """Return a finding with names in place of NAMES in `text`; none without names."""
    quoted = [repr(name) for name in names]
    more = len(quoted) - NAMES_SHOWN
    listed = ", ".join(quoted[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
    return [Finding(severity, text.replace("NAMES", listed))] if quoted else []


def _file_findings(path: Path) -> Iterator[Finding]:
    valid = MOVING_TYPES + HELD_TYPES
    for joint in read_root(path).findall("joint"):
        name, type_ = joint.get("name", ""), joint.get("type", "")
        if type_ not in valid:
            error = unknown_name("joint type", type_, valid)
            yield Finding("error", f"joint {name!r}: {error}")
    if path.suffix == ".xacro":
        message = "the name ends in .xacro but the file holds no xacro tags. Taken as a URDF."
        yield Finding("note", message)


def _name_findings(urdf: Urdf) -> Iterator[Finding]:
    text = " NAMES stands in the file twice. Give each its own name."
    yield from _of_names("error", _repeated(urdf.links), "link" + text)
    yield from _of_names("error", _repeated(joint.name for joint in urdf.joints), "joint" + text)
    ends = (link for joint in urdf.joints for link in (joint.parent, joint.child))
    there = set(urdf.links)
    absent = [link for link in dict.fromkeys(ends) if link not in there]
    text = "link NAMES is named by a joint but has no <link> element. Add it."
    yield from _of_names("warning", absent, text)


def _repeated(names: Iterable[str]) -> list[str]:
    return [name for name, count in Counter(names).items() if count > 1]


def _base_findings(urdf: Urdf, base_link: str) -> Iterator[Finding]:
    if base_link in urdf.roots or not urdf.roots:
        return
    moving = [joint.name for joint in urdf.path(urdf.roots[0], base_link) if joint.type != "fixed"]
    if moving:
        text = f"the base {base_link!r} moves with {', '.join(moving)}, which are then no motors. "
        yield Finding("warning", text + "Name a link that is fixed to the foot.")


def _root_findings(urdf: Urdf, base: str | None) -> Iterator[Finding]:
    if not urdf.roots and base is None:
        yield Finding(
            "error",
            "no link is a root: every link is the child of a joint, so the joints close a loop. "
            "Name the base with --base LINK, or remove the joint that closes the loop.",
        )
    if len(urdf.roots) > 1:
        text = f"{len(urdf.roots)} links hang from no joint: NAMES. A URDF has one root. "
        fix = "Name the base with --base LINK." if base is None else f"The base is {base!r}."
        yield from _of_names("error" if base is None else "warning", urdf.roots, text + fix)


def _loop_findings(urdf: Urdf, path: Sequence[UrdfJoint]) -> Iterator[Finding]:
    twice = _repeated(joint.child for joint in urdf.joints)
    again = set(twice)
    on_path = [joint.child for joint in path if joint.child in again]
    text = (
        "link NAMES is the child of several joints, which closes a loop on the way to the tool; "
        "only serial chains can be used. Remove all but one of them."
    )
    yield from _of_names("error", on_path, text)
    elsewhere = [link for link in twice if link not in on_path]
    text = "link NAMES is the child of several joints; not on the way to the tool, so it "
    yield from _of_names("warning", elsewhere, text + "changes nothing.")


def _tool_findings(choice: ToolChoice) -> Iterator[Finding]:
    listed = ", ".join(f"{link} ({moving} moving)" for link, moving in choice.candidates.items())
    if choice.unclear:
        yield Finding(
            "error",
            f"several arms could carry the tool: {listed}. Say which is meant with --tool LINK.",
        )
    elif len(choice.candidates) > 1:
        yield Finding(
            "note",
            f"several links could be the tool: {listed}. Took {choice.link!r}; choose another with "
            "--tool LINK.",
        )


def _joint_findings(urdf: Urdf, path: Sequence[UrdfJoint]) -> Iterator[Finding]:
    if not any(joint.has_motor for joint in path):
        yield Finding(
            "error",
            "no joint on the way to the tool moves, so there is no motor to watch. Name another "
            "tool with --tool LINK, or check the joint types.",
        )
    motors = sum(joint.has_motor for joint in path)
    if motors > MOST_MOTORS:
        yield Finding(
            "error",
            f"{motors} joints on the way to the tool move, expected {MOST_MOTORS} at most: a tool "
            "path cannot tell so many motors apart. Name a tool nearer to the base with --tool "
            "LINK.",
        )
    for joint in path:
        for severity, text in _oddities(joint):
            yield Finding(severity, f"joint {joint.name!r} {text}")
    known = {joint.name for joint in path}
    followers = [joint.name for joint in urdf.joints if joint.mimic is not None]
    elsewhere = [name for name in followers if name not in known]
    text = "joint NAMES follows another joint (mimic), so it is no motor."
    yield from _of_names("note", elsewhere, text)


def _oddities(joint: UrdfJoint) -> Iterator[tuple[Severity, str]]:
    if joint.type in ("floating", "planar"):
        yield "warning", f"is {joint.type} and is held at zero: no single motor can move it."
    elif joint.type != "fixed" and joint.mimic is not None:
        yield (
            "warning",
            f"follows joint {joint.mimic!r} (mimic), so it is no motor. It lies on the way to the "
            "tool and is held at zero: the tool path is right only where it is zero. Choose a tool "
            "before it with --tool LINK.",
        )
    elif joint.has_motor:
        if joint.type == "prismatic":
            yield "warning", "slides: its angles and faults are in m where others are in rad."
        if joint.type == "continuous":
            yield "note", "turns without end, so a range will be assumed."
        elif not has_range(joint.low, joint.high):
            stated = "has no limits" if joint.low == -float("inf") else "has no room in its limits"
            limit = "<limit lower=... upper=... velocity=... effort=.../>"
            yield "warning", f"{stated}: a range will be assumed. Add {limit} to it."


def _lever_findings(
    seen: Mapping[str, float], short: Mapping[str, float], tool_link: str, noise_m: float
) -> Iterator[Finding]:
    """Yield findings on the levers of joints above and below the sensor's noise [m/rad or m/m]."""
    if not seen:
        yield Finding(
            "error",
            f"no motor can move the tool point, the origin of link {tool_link!r}: the axes of all "
            "of them run through it. Name a link farther out with --tool LINK.",
        )
    slight = {name: lever for name, lever in seen.items() if lever < SHORT_LEVER_M}
    for name, lever in (slight | dict(short)).items():
        text = f"joint {name!r} moves the tool by {1e3 * lever:.2g} mm for each rad at most, "
        if name in short:
            text += (
                f"less than the sensor's noise of {1e3 * noise_m:.2g} mm, so it has no motor to "
                "watch. A marker off its axis would show it."
            )
        else:
            text += (
                "so faults of its motor will hardly show. A tool point farther from its axis "
                "would help."
            )
        yield Finding("note", text)


def _mass_findings(urdf: Urdf, path: Sequence[UrdfJoint]) -> Iterator[Finding]:
    """Yield links for which gravity or inertia cannot be computed.

    Links held together by fixed joints are one body, so a frame without mass on a heavy link is
    valid; the body on a moving joint needs a mass.
    """
    bodies = _bodies(urdf, path)
    facts = {n: urdf.facts[n] for body in bodies for n in body if n in urdf.facts}
    mass = {name: fact.mass for name, fact in facts.items() if fact.mass is not None}
    not_positive = [name for name in mass if mass[name] <= 0.0]
    weightless = [body[0] for body in bodies if not any(mass.get(n, 0.0) > 0.0 for n in body)]
    text = "the mass of link NAMES is not above zero: gravity cannot be computed for it. "
    yield from _of_names("warning", not_positive, text + "Kinematics works.")
    weightless = [name for name in weightless if name not in not_positive]
    text = "link NAMES has no <inertial> mass: gravity cannot be computed for it. "
    yield from _of_names("warning", weightless, text + "Kinematics works.")
    heavy = [name for name in mass if mass[name] > FRAME_MASS_KG]
    text = "link NAMES has a mass but no moments of inertia above zero: fast motion cannot be "
    no_inertia = [name for name in heavy if not facts[name].has_inertia]
    yield from _of_names("warning", no_inertia, text + "computed for it.")


def _bodies(urdf: Urdf, path: Sequence[UrdfJoint]) -> list[list[str]]:
    """Return the links of each body on a moving joint of the path, the joint's own link first."""
    onward: dict[str, list[str]] = {}
    for joint in urdf.joints:
        if joint.type == "fixed":
            onward.setdefault(joint.parent, []).append(joint.child)
            onward.setdefault(joint.child, []).append(joint.parent)
    bodies, seen = [], set[str]()
    for joint in path:
        if joint.type == "fixed" or joint.child in seen:
            continue
        body = [joint.child]
        seen.add(joint.child)
        for link in body:
            attached = [name for name in onward.get(link, ()) if name not in seen]
            seen.update(attached)
            body += dict.fromkeys(attached)
        bodies.append(body)
    return bodies


def _mesh_findings(links: Iterable[LinkFacts], folder: Path) -> Iterator[Finding]:
    """Yield meshes that cannot be shown; they change no number."""
    meshes = dict.fromkeys(mesh for link in links for mesh in link.meshes)
    remote = [mesh for mesh in meshes if "://" in mesh and not mesh.startswith("file://")]
    elsewhere = set(remote)
    text = " named by a package address that only ROS can resolve (NAMES). "
    yield from _of_names("note", remote, _counted(remote) + text + PICTURE)
    local = [mesh for mesh in meshes if mesh not in elsewhere]
    missing = [m for m in local if not _is_file(folder / m.removeprefix("file://"))]
    text = f" not found (NAMES), looked for from {folder}. "
    yield from _of_names("warning", missing, _counted(missing) + text + PICTURE)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # no name that a file can have
        return False


def _counted(meshes: Sequence[str]) -> str:
    return "1 mesh is" if len(meshes) == 1 else f"{len(meshes)} meshes are"
