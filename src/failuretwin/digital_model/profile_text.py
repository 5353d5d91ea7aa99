"""Robot profiles as text: written for a URDF, or changed without loss of the user's comments.

Keys are set in their lines and the geometry tables are rewritten at the end; the result is read
again and compared.
"""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from string import Template
from typing import TypeVar

from failuretwin.core.config import from_table
from failuretwin.core.errors import InputError
from failuretwin.digital_model.geometry import Geometry, JointCorrection
from failuretwin.digital_model.kinematics import has_range
from failuretwin.digital_model.profile import Profile
from failuretwin.digital_model.robot import bundled_folder
from failuretwin.digital_model.urdf.check import JointReport, UrdfReport
from failuretwin.digital_model.urdf.file import UrdfJoint

Numbers = TypeVar("Numbers", bound=tuple[float, ...])

HEADER = re.compile(r"\s*\[")
OWN_TABLE = re.compile(r"\s*\[\[?\s*geometry\b")
DIGITS = 9
"""Decimals of lengths and angles: a nanometre."""

GEOMETRY_NOTE = """\
# Written by `failuretwin robot fit`; see the page "Use another arm" of the documentation.
# zero: angle of the URDF at command 0 [rad]; xyz [m] and rpy [rad]: displacement of the joint's
# frame, in the URDF's frame of the joint."""


def fitted_text(text: str, old: Path, new: Path, profile: Profile) -> str:
    """Return the text of a profile with the frames, senses and geometry of another.

    Args:
        text: The present profile.
        old: Its path.
        new: Path of the result; files are named relative to it.
        profile: Contents of the result, with files as `old` names them.
    """
    moved = _moved(rounded(profile), old.parent, new.parent)
    lines = _without_own_tables(text.splitlines())
    before = from_table(Profile, tomllib.loads(text), str(old))
    head: dict[str, object] = {"urdf": moved.urdf}
    head |= {"tool_xyz": moved.tool_xyz, "base_xyz_rpy": moved.base_xyz_rpy}
    if moved.sensor_pose != before.sensor_pose:
        head["sensor_pose"] = moved.sensor_pose
    if moved.physics is not None:
        head["physics"] = moved.physics
    if before.imperfections is not None:
        head["imperfections"] = moved.imperfections
    lines = _set(lines, 0, head)
    for k, motor in enumerate(moved.motors):
        if motor.sense != before.motors[k].sense:
            starts = [i for i, line in enumerate(lines) if re.match(r"\s*\[\[\s*motors\b", line)]
            lines = _set(lines, starts[k] + 1, {"sense": motor.sense})
    result = "\n".join([*lines, "", *_geometry_lines(moved.geometry), ""])
    _check(result, new, moved)
    return result


def rounded(profile: Profile) -> Profile:
    """Return a profile with its geometry rounded to `DIGITS`."""
    geometry = profile.geometry
    joints = tuple(
        JointCorrection(c.joint, round(c.zero, DIGITS), _round(c.xyz), _round(c.rpy))
        for c in geometry.joints
    )
    geometry = Geometry(
        joints,
        round(geometry.sensor_scale, DIGITS),
        round(geometry.sensor_noise_m, DIGITS),
        geometry.source,
    )
    return replace(
        profile,
        tool_xyz=_round(profile.tool_xyz),
        base_xyz_rpy=_round(profile.base_xyz_rpy),
        geometry=geometry,
    )


def _round(values: Numbers) -> Numbers:
    return type(values)(round(value, DIGITS) + 0.0 for value in values)


def _moved(profile: Profile, old: Path, new: Path) -> Profile:
    def moved(name: str | None) -> str | None:
        return None if name is None else relative_to(old / name, new)

    return replace(
        profile,
        urdf=relative_to(old / profile.urdf, new),
        imperfections=moved(profile.imperfections),
        physics=moved(profile.physics),
    )


def _without_own_tables(lines: Sequence[str]) -> list[str]:
    """Return the lines without the geometry tables and the comments above them."""
    kept: list[str] = []
    own = False
    for line in lines:
        if HEADER.match(line):
            own = bool(OWN_TABLE.match(line))
        if not own and line not in GEOMETRY_NOTE.splitlines():
            kept.append(line)
    while kept and not kept[-1].strip():
        kept.pop()
    return kept


def _set(lines: Sequence[str], start: int, values: Mapping[str, object]) -> list[str]:
    """Return lines with keys of the table that begins at `start` set; None removes a key."""
    headers = [i for i in range(start, len(lines)) if HEADER.match(lines[i])]
    stop = headers[0] if headers else len(lines)
    own, missing = list(lines[start:stop]), dict(values)
    for i, line in enumerate(own):
        key = line.partition("=")[0].strip()
        if key in missing:
            own[i] = _line(key, missing.pop(key), _comment(line))
    stated = [i for i, line in enumerate(own) if re.match(r"\s*[\w\"-]+\s*=", line)]
    at = stated[-1] + 1 if stated else 0
    own[at:at] = [_line(key, value, "") for key, value in missing.items() if value is not None]
    return [*lines[:start], *own, *lines[stop:]]


def _line(key: str, value: object, comment: str) -> str:
    if value is None:
        return f"# {key}: taken out, it was learned with another geometry"
    return f"{key} = {_toml(value)}{comment}"


def _comment(line: str) -> str:
    """Return the comment at the end of a line with the space before it, or an empty string."""
    found = re.search(r"\s+#[^\"'\]]*$", line)
    return found.group() if found else ""


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _geometry_lines(geometry: Geometry) -> list[str]:
    plain = [f for f in fields(Geometry) if f.name != "joints"]
    lines = [*GEOMETRY_NOTE.splitlines(), "[geometry]"]
    lines += [f"{f.name} = {_toml(getattr(geometry, f.name))}" for f in plain]
    for joint in geometry.joints:
        lines += ["", "[[geometry.joints]]"]
        lines += [f"{f.name} = {_toml(getattr(joint, f.name))}" for f in fields(JointCorrection)]
    return lines


def _check(text: str, path: Path, expected: Profile) -> None:
    try:
        same = from_table(Profile, tomllib.loads(text), str(path)) == expected
    except tomllib.TOMLDecodeError:
        same = False
    if not same:
        raise InputError(
            f"{path}: the old profile is written in a way that cannot be changed line by line. "
            "Give each of urdf, tool_xyz, base_xyz_rpy, sensor_pose, imperfections, physics and "
            "sense a line of its own."
        )


# A commented robot profile, written from what a URDF states and plain assumptions elsewhere.

PROFILE_TEMPLATE = "profile.template"
"""A profile with $placeholders; its last table is that of one motor. Its gains are near those
published for the bus servos of the ArmPi FPV."""

ASSUMED_SPEED = math.pi
"""Speed limit where the URDF states none [rad/s or m/s]."""

WIDEST_RAD = math.pi / 2
"""Largest distance of random targets from the middle of the range [rad]."""

WIDEST_M = 0.1
"""The same for a sliding joint [m]."""

LONGEST_RAMP_S = 1.0
"""Time for the longest travel at the speed limit: half of a movement [s]."""


def profile_text(report: UrdfReport, profile: Path, home: Sequence[float] = ()) -> str:
    """Return a TOML profile for the robot of a URDF.

    The profile names the URDF relative to its own folder. Without rest angles `home` [rad or m],
    motors rest in the middle of their limits.
    """
    report.raise_errors()
    if home and len(home) != len(report.motors):
        raise InputError(
            f"home has {len(home)} values, expected {len(report.motors)}, one for each motor: "
            f"{', '.join(motor.joint.name for motor in report.motors)}."
        )
    homes = list(home) if home else [None] * len(report.motors)
    template = (bundled_folder() / PROFILE_TEMPLATE).read_text(encoding="utf-8")
    head, start, motor = template.partition("[[motors]]")
    speeds = [m.motor or "" for m in report.motors if m.joint.velocity is None]
    ranges = [m.motor or "" for m in report.motors if not has_range(m.joint.low, m.joint.high)]
    common = Template(head).substitute(
        name=_quote(report.name or report.source.stem),
        urdf=_quote(relative_to(report.source, profile.parent)),
        base=_quote(report.base_link),
        tool=_quote(report.tool_link),
        unmoved=_unmoved(report.others),
        speeds=_quote(_origin("URDF", speeds)),
        ranges=_quote(_origin("URDF limits, narrowed to keep plateaus", ranges)),
    )
    motors = zip(report.motors, homes, strict=True)
    return common + "\n".join(_motor(start + motor, one, at) for one, at in motors)


def _motor(template: str, report: JointReport, home: float | None) -> str:
    joint = report.joint
    low, high, range_note = movement_range(joint, home)
    return Template(template).substitute(
        name=_quote(report.motor or ""),
        joint=_quote(joint.name),
        unit="m" if joint.type == "prismatic" else "rad",
        speed=speed_limit(joint),
        speed_note="Assumed." if joint.velocity is None else "From the URDF.",
        low=low,
        high=high,
        range_note=range_note,
        home="" if home is None else f"home = {home!r}\n",
    )


def _unmoved(others: Sequence[JointReport]) -> str:
    if not others:
        return "\n# Every joint of the file can move the tool point, so each has a motor below.\n"
    reasons = ((_quote(other.joint.name), " ".join(other.reason.split())) for other in others)
    lines = [f"#   {name}: {reason}" for name, reason in reasons]
    head = "# Joints without a motor below, since they cannot move the tool point:"
    return "\n".join(["", head, *lines, ""])


def _origin(stated: str, assumed: Sequence[str]) -> str:
    return f"{stated}; assumed for {', '.join(assumed)}" if assumed else stated


def speed_limit(joint: UrdfJoint) -> float:
    """Return the speed limit of the URDF, or the assumed one [rad/s or m/s]."""
    return ASSUMED_SPEED if joint.velocity is None else joint.velocity


def movement_range(joint: UrdfJoint, home: float | None = None) -> tuple[float, float, str]:
    """Return the lowest and the highest target [rad or m] and a sentence on their source.

    The limits are narrowed about their middle or the rest angle, so that movements keep time at
    rest.
    """
    widest = WIDEST_M if joint.type == "prismatic" else WIDEST_RAD
    half = min(widest, speed_limit(joint) * LONGEST_RAMP_S / 2.0)
    if not has_range(joint.low, joint.high):
        middle = home or 0.0
        return middle - half, middle + half, "Assumed: the URDF has no limits."
    if joint.high - joint.low <= 2.0 * half:
        return joint.low, joint.high, "The limits of the URDF."
    middle = (joint.low + joint.high) / 2.0 if home is None else home
    middle = min(max(middle, joint.low + half), joint.high - half)
    limits = f"{joint.low:.6g} to {joint.high:.6g}"
    note = f"Limits of the URDF ({limits}) narrowed so that a movement keeps time at rest."
    return middle - half, middle + half, note


def relative_to(target: Path, folder: Path) -> str:
    """Return the path from `folder` to the file `target` with forward slashes."""
    try:
        way = os.path.relpath(target.resolve(), folder.resolve())
    except ValueError:  # another drive
        way = str(target.resolve())
    return Path(way).as_posix()


def _quote(text: str) -> str:
    """Return `text` as a TOML string; its escapes are those of JSON."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
