"""A commented robot profile, written from what a URDF states and plain assumptions elsewhere."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path

from failuretwin.digital_model.mobility import has_range
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.urdf import UrdfJoint
from failuretwin.digital_model.urdf_check import JointReport, UrdfReport

TYPICAL_LOOP = ServoLoop(P=0.3, I=40.0, filter_s=0.01)
"""Gains near those published for the bus servos of the ArmPi FPV."""

ASSUMED_SPEED = math.pi
"""Speed limit where the URDF states none [rad/s or m/s]."""

WIDEST_RAD = math.pi / 2
"""Farthest target of random movements from the middle of the range [rad]."""

WIDEST_M = 0.1
"""The same for a joint that slides [m]."""

LONGEST_RAMP_S = 1.0
"""Time in which the speed limit must allow the longest travel: half of a movement [s]."""


def profile_text(report: UrdfReport, profile: Path) -> str:
    """Return a TOML profile for the robot of a URDF.

    Args:
        report: The URDF, looked over without errors.
        profile: Where the profile will lie; it names the URDF relative to its own folder.

    Raises:
        InputError: If the report holds an error.
    """
    report.raise_errors()
    blocks = [
        _head(report, profile),
        _sources(report.motors),
        *(_motor(motor) for motor in report.motors),
    ]
    return "\n".join(blocks)


def _head(report: UrdfReport, profile: Path) -> str:
    tool, base = _quote(report.tool_link), _quote(report.base_link)
    return f"""\
# Robot profile for failuretwin, made from the URDF by `failuretwin robot init`.
# Angles in rad, lengths in m, times in s. Go through the lines that say "assumed" and put in
# what you know of your robot; everything else was read from the URDF.

# What the robot is called in results.
name = {_quote(report.name or report.source.stem)}

# Kinematics: a URDF file, relative to this profile.
urdf = {_quote(relative(report.source, profile.parent))}

# Link that carries the base frame, in which tool positions are measured.
base_link = {base}

# Link whose origin is the tool point, the point that your sensor watches. Another tool point may
# be moved by other motors: run `failuretwin robot init` again with --tool LINK to change it.
tool_link = {tool}

# Which angles belong to the tool path: "physical" when a sensor watches the real tool, "log" when
# the path was computed from the angles in the log.
sensor_pose = "physical"
{_unmoved(report.others)}
# Raw logs in servo counts need a table such as this; delete it if your logs are in rad.
# Angle in degrees = zero_deg - deg_per_count * counts, for counts from low to high.
# [servo_units]
# zero_deg = 120.0
# deg_per_count = 0.24
# low = 0.0
# high = 1000.0
"""


def _unmoved(others: Sequence[JointReport]) -> str:
    if not others:
        return "\n# Every joint of the file can move the tool point, so each has a motor below.\n"
    lines = [f"#   {_quote(other.joint.name)}: {_plain(other.reason)}" for other in others]
    head = "# Joints without a motor below, since they cannot move the tool point:"
    return "\n".join(["", head, *lines, ""])


def _sources(motors: Sequence[JointReport]) -> str:
    speeds = [m.motor or "" for m in motors if m.joint.velocity is None]
    ranges = [m.motor or "" for m in motors if not has_range(m.joint.low, m.joint.high)]
    return f"""\
# Where each group of numbers comes from.
[sources]
kinematics = "URDF"
loop = "assumed: typical position servo"
speed_limit = {_quote(_origin("URDF", speeds))}
movement_range = {_quote(_origin("URDF limits, narrowed to keep plateaus", ranges))}
sense = "assumed: commands and logs turn the way the URDF turns"
"""


def _origin(stated: str, assumed: Sequence[str]) -> str:
    return f"{stated}; assumed for {', '.join(assumed)}" if assumed else stated


def _motor(report: JointReport) -> str:
    joint = report.joint
    low, high, range_note = movement_range(joint)
    speed = speed_limit(joint)
    loop = TYPICAL_LOOP
    return f"""\
[[motors]]
# Name in run sets and diagnoses.
name = {_quote(report.motor or "")}
# Joint of the URDF that it turns.
joint = {_quote(joint.name)}
# +1, or -1 if commands and logs turn against the URDF. Assumed.
sense = 1.0
# How the motor follows its command: gains P [-] and I [1/s], time constant of the input filter
# [s]. Assumed: typical position servo.
loop = {{ P = {loop.P}, I = {loop.I}, filter_s = {loop.filter_s} }}
# Largest speed [{_unit(joint)}/s]. {"Assumed." if joint.velocity is None else "From the URDF."}
speed_limit = {speed!r}
# Lowest and highest target of random movements [{_unit(joint)}].
# {range_note}
# Nothing here knows of tables and cables: narrow it to what is safe on your robot.
movement_range = [{low!r}, {high!r}]
"""


def speed_limit(joint: UrdfJoint) -> float:
    """Return the speed limit of the URDF [rad/s or m/s], an assumed one where it has none."""
    return ASSUMED_SPEED if joint.velocity is None else joint.velocity


def movement_range(joint: UrdfJoint) -> tuple[float, float, str]:
    """Return the lowest and the highest target [rad or m] and a sentence on where they are from.

    Targets far apart leave no time at rest within a movement, so the limits are narrowed about
    their middle.
    """
    widest = WIDEST_M if joint.type == "prismatic" else WIDEST_RAD
    half = min(widest, speed_limit(joint) * LONGEST_RAMP_S / 2.0)
    if not has_range(joint.low, joint.high):
        return -half, half, "Assumed: the URDF has no limits."
    if joint.high - joint.low <= 2.0 * half:
        return joint.low, joint.high, "The limits of the URDF."
    middle = (joint.low + joint.high) / 2.0
    limits = f"{joint.low:.6g} to {joint.high:.6g}"
    note = f"Limits of the URDF ({limits}) narrowed so that a movement keeps time at rest."
    return middle - half, middle + half, note


def relative(target: Path, folder: Path) -> str:
    """Return the way from `folder` to the file `target` with forward slashes."""
    try:
        way = os.path.relpath(target.resolve(), folder.resolve())
    except ValueError:  # another drive
        way = str(target.resolve())
    return Path(way).as_posix()


def _unit(joint: UrdfJoint) -> str:
    return "m" if joint.type == "prismatic" else "rad"


def _quote(text: str) -> str:
    """Return `text` as a TOML string; its escapes are those of JSON."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(text: str) -> str:
    """Return `text` on one line, fit for a comment."""
    return " ".join(text.split())
