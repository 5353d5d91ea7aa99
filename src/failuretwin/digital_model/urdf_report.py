"""What was found in a URDF: its chain, its motors, and what may be wrong with it.

An error keeps the file from being used; a warning tells of something that will be missing or
assumed; a note tells what was decided.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from failuretwin.core.errors import InputError
from failuretwin.digital_model.urdf import UrdfJoint

Severity = Literal["error", "warning", "note"]
SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One matter that the user should know.

    Attributes:
        severity: ``error``, ``warning`` or ``note``.
        message: What was found and what to do about it.
    """

    severity: Severity
    message: str


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
        """Raise what keeps the file from being used.

        Raises:
            InputError: If there is any error among the findings.
        """
        errors = self.having("error")
        if errors:
            raise InputError(f"{self.source}: " + "\n  also: ".join(errors))
