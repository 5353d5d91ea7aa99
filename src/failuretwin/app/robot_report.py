"""What `robot check` prints: the joints of a URDF and what was found."""

from __future__ import annotations

import math

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from failuretwin.app.tables import PIPE_WIDTH
from failuretwin.digital_model.mobility import has_range
from failuretwin.digital_model.urdf import UrdfJoint
from failuretwin.digital_model.urdf_check import JointReport, UrdfReport


def print_report(report: UrdfReport) -> None:
    """Print the chain, its joints and all findings that are no errors."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=PIPE_WIDTH)
    if report.joints:
        console.print(_summary(report))
        console.print(_joint_table(report))
    for severity in ("warning", "note"):
        for message in report.having(severity):
            console.print(f"\n{severity}: {escape(message)}")


def _summary(report: UrdfReport) -> str:
    count = len(report.motors)
    return escape(
        f"{report.name or report.source.name}: from {report.base_link} to {report.tool_link}, "
        f"{count} motor{'s' * (count != 1)} can move the tool point\n"
        f"the tool gets {report.reach:.3f} m away from the base's origin; "
        f"what moves weighs {report.moving_mass:.3f} kg\n"
    )


def _joint_table(report: UrdfReport) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("joint", "type", "limits", "speed", "effort", "link mass", "motor"):
        table.add_column(column, overflow="fold")
    for joint in report.joints:
        table.add_row(*(escape(cell) for cell in _row(joint)))
    return table


def _row(report: JointReport) -> tuple[str, ...]:
    joint = report.joint
    moving = joint.type not in ("fixed", "floating", "planar")
    return (
        joint.name,
        joint.type,
        _limits(joint) if moving else "",
        _with_unit(_shown(joint, joint.velocity), _unit(joint) + "/s") if moving else "",
        _with_unit(joint.effort, "N" if joint.type == "prismatic" else "N m") if moving else "",
        _with_unit(report.mass, "kg") if moving or report.mass is not None else "",
        report.motor or f"- ({report.reason})",
    )


def _limits(joint: UrdfJoint) -> str:
    if joint.type == "continuous":
        return "endless"
    if not has_range(joint.low, joint.high):
        return "?"
    return f"{_shown(joint, joint.low):.4g} to {_shown(joint, joint.high):.4g} {_unit(joint)}"


def _shown(joint: UrdfJoint, value: float | None) -> float:
    """Return what is printed of an angle [rad] or a length [m]: degrees or millimetres."""
    if value is None:
        return math.nan
    return 1e3 * value if joint.type == "prismatic" else math.degrees(value)


def _unit(joint: UrdfJoint) -> str:
    return "mm" if joint.type == "prismatic" else "deg"


def _with_unit(value: float | None, unit: str) -> str:
    return "?" if value is None or math.isnan(value) else f"{value:.4g} {unit}"
