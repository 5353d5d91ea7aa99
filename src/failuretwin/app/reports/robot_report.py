"""URDFs and fitted profiles in words and tables, for `robot check` and `robot fit`."""

from __future__ import annotations

import math

from failuretwin.app.reports.calibration_report import parameter_table
from failuretwin.app.terminal import SHOWN, Part, Table
from failuretwin.connection.registration.fit import Registration
from failuretwin.core.errors import counted
from failuretwin.digital_model.kinematics import has_range
from failuretwin.digital_model.urdf.check import JointReport, UrdfReport
from failuretwin.digital_model.urdf.file import UrdfJoint


def registration_parts(found: Registration) -> list[Part]:
    """Return the fitted parameters and their accuracy."""
    parts: list[Part] = [
        f"{found.profile.name}: {found.poses} settled poses, the tool path alone\n",
        parameter_table(found.parameters, None),
        "\nthe tool is off at the median: "
        f"{found.before_mm:.3g} mm with the profile as it was, {found.frames_mm:.3g} mm with "
        f"frame, tool point and zeros fitted, {found.after_mm:.3g} mm with the geometry too, in "
        "poses that the fit had not seen",
        f"the sensor and what no geometry explains: {1e3 * found.noise_m:.2g} mm on each axis",
    ]
    if found.not_told:
        parts.append("\nthe poses do not tell, and what the profile or the URDF says stands:")
        parts += [f"  {line}" for line in found.not_told]
    return [*parts, *(f"note: {line}" for line in found.remarks)]


# Joints and findings of a URDF.


def urdf_parts(report: UrdfReport) -> list[Part]:
    """Return the chain, its joints and all findings that are no errors."""
    parts: list[Part] = []
    if report.joints:
        headings = ("joint", "type", "limits", "speed", "effort", "link mass", "motor")
        parts = [_summary(report), Table(headings, [_joint_row(joint) for joint in report.joints])]
    for severity in ("warning", "note"):
        parts += [f"\n{severity}: {message}" for message in report.having(severity)]
    return parts


def _summary(report: UrdfReport) -> str:
    count = len(report.motors)
    return (
        f"{report.name or report.source.name}: from {report.base_link} to {report.tool_link}, "
        f"{counted(count, 'motor')} can move the tool point\n"
        f"the tool gets {report.reach:.3f} m away from the base's origin; "
        f"what moves weighs {report.moving_mass:.3f} kg\n"
    )


def _joint_row(report: JointReport) -> tuple[str, ...]:
    joint = report.joint
    moving = joint.type not in ("fixed", "floating", "planar")
    slides = joint.type == "prismatic"
    scale, unit = SHOWN["m" if slides else "rad"]
    return (
        joint.name,
        joint.type,
        _limits(joint, scale, unit) if moving else "",
        _with_unit(joint.velocity, scale, f"{unit}/s") if moving else "",
        _with_unit(joint.effort, 1.0, "N" if slides else "N m") if moving else "",
        _with_unit(report.mass, 1.0, "kg") if moving or report.mass is not None else "",
        report.motor or f"- ({report.reason})",
    )


def _limits(joint: UrdfJoint, scale: float, unit: str) -> str:
    if joint.type == "continuous":
        return "endless"
    if not has_range(joint.low, joint.high):
        return "?"
    return f"{scale * joint.low:.4g} to {scale * joint.high:.4g} {unit}"


def _with_unit(value: float | None, scale: float, unit: str) -> str:
    return "?" if value is None or math.isnan(value) else f"{scale * value:.4g} {unit}"
