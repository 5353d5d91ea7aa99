"""A URDF looked over before use: its chain, its motors, and what may be wrong with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

from failuretwin.core.errors import InputError
from failuretwin.digital_model import urdf_findings as look
from failuretwin.digital_model.urdf import (
    LinkFacts,
    Urdf,
    UrdfJoint,
    is_motor_joint,
    leaves,
    links_beyond,
    read_links,
    read_root,
    read_urdf,
    roots,
)
from failuretwin.digital_model.urdf_findings import Finding, Mobility, Severity, mobility


@dataclass(frozen=True)
class JointReport:
    """One joint of the file and what it is to the tool.

    Attributes:
        joint: The joint as the file states it.
        motor: Name of the motor that turns it, if one can move the tool point by it.
        reason: Why no motor can, else empty.
        mass: Mass of the link that it carries [kg]; None where the file states none.
    """

    joint: UrdfJoint
    motor: str | None
    reason: str
    mass: float | None


@dataclass(frozen=True)
class UrdfReport:
    """What a URDF holds.

    Attributes:
        source: The file.
        findings: What the user should know, errors first.
        name: Name of the robot in the file.
        base_link: Link that carries the base frame; empty where an error hides it.
        tool_link: Link whose origin is the tool point; empty where an error hides it.
        joints: Joints from base to tool, then all others; empty where an error hides them.
        reach: Farthest distance of the tool from the base's origin that was found [m].
        moving_mass: Mass of everything that the first motor carries [kg].
    """

    source: Path
    findings: tuple[Finding, ...]
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

    def having(self, severity: Severity) -> list[str]:
        """Return the messages of one severity."""
        return [finding.message for finding in self.findings if finding.severity == severity]

    def raise_errors(self) -> None:
        """Raise what keeps the file from being used.

        Raises:
            InputError: If there is any error among the findings.
        """
        errors = self.having("error")
        if errors:
            raise InputError(f"{self.source}: " + "\n  also: ".join(errors))


def check_urdf(path: Path, base: str | None = None, tool: str | None = None) -> UrdfReport:
    """Look a URDF over; meshes, inertias and mimic joints are never needed for its kinematics.

    Args:
        path: The file.
        base: Link that carries the base frame; None: the root.
        tool: Link whose origin is the tool point; None: the end of the branch with the most
            moving joints.

    Raises:
        InputError: If the file cannot be read, is not XML, is a xacro template or not a URDF, or
            there is no chain from `base` to `tool`. All else becomes findings.
    """
    root = read_root(path)
    findings = _file_findings(path, root)
    if any(finding.severity == "error" for finding in findings):
        return UrdfReport(path, _sorted(findings))
    urdf = read_urdf(path)
    findings += look.name_findings(urdf) + look.root_findings(urdf, base)
    report = UrdfReport(path, _sorted(findings), urdf.name)
    if report.having("error"):
        return report
    return _with_chain(report, urdf, read_links(root), base, tool)


def _file_findings(path: Path, root: ElementTree.Element) -> list[Finding]:
    findings = look.joint_type_findings(root)
    if path.suffix == ".xacro":
        message = "the name ends in .xacro but the file holds no xacro tags. Taken as a URDF."
        findings.append(Finding("note", message))
    return findings


def _with_chain(
    report: UrdfReport,
    urdf: Urdf,
    links: Mapping[str, LinkFacts],
    base: str | None,
    tool: str | None,
) -> UrdfReport:
    base_link = base if base is not None else roots(urdf)[0]
    candidates = leaves(urdf, base_link) if base_link in urdf.links else []
    tool_link = tool if tool is not None else next((leaf.link for leaf in candidates), base_link)
    path = urdf.path(base_link, tool_link)
    findings = [
        *report.findings,
        *look.loop_findings(urdf, path),
        *look.tool_findings(candidates, tool_link, tool is not None),
        *look.joint_findings(path),
        *look.mimic_findings(urdf, path),
        *look.mass_findings(urdf, path, links),
        *look.mesh_findings(links, report.source.parent),
    ]
    report = replace(report, base_link=base_link, tool_link=tool_link, findings=_sorted(findings))
    if report.having("error"):
        return report
    names = [joint.name for joint in path if is_motor_joint(joint)]
    chain = urdf.chain(base_link, tool_link, names)
    motion = mobility(chain)
    levers = dict(zip(names, motion.lever.tolist(), strict=True))
    movers = {name: levers[name] for name in _movers(names, motion)}
    if not movers:
        message = (
            f"no motor can move the tool point, the origin of link {tool_link!r}: the axes of all "
            "of them run through it. Name a link farther out with --tool LINK."
        )
        findings.append(Finding("error", message))
    return replace(
        report,
        findings=_sorted([*findings, *look.lever_findings(movers)]),
        joints=_joint_reports(urdf, path, list(movers), links),
        reach=motion.reach,
        moving_mass=sum(links[n].mass or 0.0 for n in links_beyond(urdf, path) if n in links),
    )


def _movers(names: Sequence[str], motion: Mobility) -> list[str]:
    return [name for name, moves in zip(names, motion.moves, strict=True) if moves]


def _joint_reports(
    urdf: Urdf,
    path: Sequence[UrdfJoint],
    movers: Sequence[str],
    links: Mapping[str, LinkFacts],
) -> tuple[JointReport, ...]:
    on_path = {joint.name for joint in path}
    ordered = [*path, *(joint for joint in urdf.joints if joint.name not in on_path)]
    return tuple(
        JointReport(
            joint=joint,
            motor=f"motor_{movers.index(joint.name) + 1}" if joint.name in movers else None,
            reason="" if joint.name in movers else _reason(joint, joint.name in on_path),
            mass=links[joint.child].mass if joint.child in links else None,
        )
        for joint in ordered
    )


def _reason(joint: UrdfJoint, on_path: bool) -> str:
    if joint.type == "fixed":
        return "fixed"
    if not on_path:
        return "not on the way to the tool"
    if joint.mimic is not None:
        return f"follows {joint.mimic}, held at zero"
    if not is_motor_joint(joint):
        return f"{joint.type}, held at zero"
    return "its axis runs through the tool point"


def _sorted(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    order = ("error", "warning", "note")
    return tuple(sorted(findings, key=lambda finding: order.index(finding.severity)))
