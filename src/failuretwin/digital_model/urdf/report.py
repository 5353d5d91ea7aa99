"""Report on a URDF: its chain, its motors, and findings of three severities.

An error prevents the use of the file; a warning says what is missing or assumed; a note states a
choice.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from failuretwin.core.errors import InputError
from failuretwin.digital_model.urdf.file import UrdfJoint

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
