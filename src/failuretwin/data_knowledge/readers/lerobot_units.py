"""Units of the angles in LeRobot data sets: stated, read from a calibration file, or guessed.

LeRobot writes degrees about the middle of each joint's calibrated range, or numbers from -100 to
100 over that range; the data set states neither. Readings are whole encoder counts, so the step
between their values is one count in the unit of the data set. This step identifies the unit, and
the range of each joint:

    rad per unit = rad per count / step

Section: docs/reading_logs.md#lerobot-data-sets
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError, check_name
from failuretwin.core.foreign import read_text, reading
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.readers.column_map import ANGLE_UNITS, SERVO, check_entries
from failuretwin.digital_model.robot import Robot

NORMALISED = "normalised"
UNITS = (*ANGLE_UNITS, SERVO, NORMALISED)
FULL_SCALE = 100.0
"""Ends of a normalised joint's range: -100 and 100."""
NAME_PREFIX, NAME_SUFFIX = "main_", ".pos"
"""Text that recorders put around the name of a joint: ``main_elbow_flex``, ``elbow_flex.pos``. The
older recorder, which writes ``main_``, knows degrees only."""
GUESSED = "guessed"
"""Word in the source of runs whose unit is guessed."""
FEWEST_LEVELS = 12
"""Distinct readings of a motor from which their step is trusted."""
ON_GRID = 0.02
"""Largest distance of a reading from the grid of encoder counts [steps]."""
SAME_SCALE = 1e-3
"""Largest relative difference of two equal scales; 360/4095 and 360/4096 deg differ by 2.4e-4."""
OTHER_RANGE = 0.01
"""Relative difference of two ranges that are not of one calibration."""
SMALLEST_RANGE = 0.125
"""Smallest range that a joint is calibrated with [turns]; the largest is one turn."""


@dataclass(frozen=True)
class LeRobotAngles:
    """Numbers of a LeRobot data set, commands and readings alike.

    Attributes:
        unit: deg, rad, servo (encoder counts of the robot's profile), or normalised: -100 to 100
            over the range that the arm was calibrated with. Empty: found from the data set.
        joints: Names of the channels in chain order; empty: those called like the robot's joints.
        low: For normalised numbers: angle of each motor at -100 [deg]. Empty: from the calibration
            file, else from the encoder steps, else the limits of the URDF.
        high: Angle of each motor at 100 [deg].
        sign: 1 or -1 for each motor, where the data set turns the other way; empty: all 1.
        zero: Angle of each motor in the data set that the robot calls 0 [deg]; empty: all 0.
        calibration: LeRobot's calibration file of the arm (JSON); empty: the one in the data set's
            folder, if any.
    """

    unit: str = ""
    joints: tuple[str, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    sign: tuple[float, ...] = ()
    zero: tuple[float, ...] = ()
    calibration: str = ""

    def __post_init__(self) -> None:
        if self.unit:
            check_name("unit", self.unit, UNITS)
        if len(self.low) != len(self.high):
            raise InputError(
                f"low has {len(self.low)} entries and high {len(self.high)}. Expected both, one "
                "entry for each motor: the angles [deg] that -100 and 100 stand for."
            )

    def check_motors(self, robot: Robot, where: str) -> None:
        """Raise InputError unless every list has one entry for each motor."""
        for name in ("joints", "low", "high", "sign", "zero"):
            check_entries(name, len(getattr(self, name)) or len(robot.motors), robot, where)

    def to_rad(self, values: FloatArray, robot: Robot) -> FloatArray:
        """Return angles in the robot's sense [rad] of `values` (frame, motor)."""
        if self.unit == SERVO:
            angle = robot.servo_units.to_rad(values)
        elif self.unit == NORMALISED:
            low, high = np.deg2rad(self.low), np.deg2rad(self.high)
            angle = low + (values + FULL_SCALE) / (2.0 * FULL_SCALE) * (high - low)
        else:
            angle = values * ANGLE_UNITS[self.unit]
        return as_floats((angle - np.deg2rad(self.zero or 0.0)) * np.asarray(self.sign or 1.0))

    def per_rad(self, robot: Robot) -> FloatArray:
        """Return the change of each motor's number per angle, (motor,) [unit/rad]."""
        units = robot.profile.servo_units
        middle = (units.low + units.high) / 2.0 if units and self.unit == SERVO else 0.0
        ends = middle + np.repeat([[0.0], [1.0]], len(robot.motors), axis=1)
        return as_floats(1.0 / np.diff(self.to_rad(ends, robot), axis=0)[0])


@dataclass(frozen=True)
class _Scale:
    """Scale of a data set's numbers: unit, range of each joint [deg], and the reason."""

    unit: str
    reason: str
    half_range: FloatArray | None = None


def found_angles(
    info: Mapping[str, Any],
    names: Sequence[str],
    state: FloatArray,
    path: Path,
    robot: Robot,
    known: LeRobotAngles,
) -> tuple[LeRobotAngles, str]:
    """Return the meaning of a data set's numbers, complete, and a phrase on how it is known.

    `names` and `state` are channels (in chain order) and readings (frame, motor) as recorded,
    `known` is what the user states.

    Raises:
        InputError: If a calibration file is wrong, or several lie in the folder.
    """
    file = Path(known.calibration) if known.calibration else _calibration_in(path)
    ranges = None if file is None else _ranges(file, robot)
    scale = _Scale(known.unit, "stated") if known.unit else _stated(info, names)
    steps = _by_steps(state, robot) or _by_size(state)
    scale = scale or steps
    found = replace(known, unit=scale.unit)
    if scale.unit == SERVO and ranges is not None and not known.zero:
        zero = np.rad2deg(robot.servo_units.to_rad(ranges.mean(axis=0)))
        found = replace(found, zero=tuple(zero.tolist()))
    if scale.unit != NORMALISED or known.low:
        return found, scale.reason
    if ranges is not None:
        half = np.diff(ranges, axis=0)[0] / 2.0 * np.rad2deg(robot.servo_units.rad_per_count)
        _check_ranges(half, steps, f"{file}")
        low, high, where = -half, half, f"range of {file.name}" if file else ""
    else:
        low, high, where = _fallback_range(steps, robot)
    ends = [tuple(np.round(end, 4).tolist()) for end in (low, high)]
    return replace(found, low=ends[0], high=ends[1]), f"{scale.reason}; {where}"


def _check_ranges(half: FloatArray, steps: _Scale, file: str) -> None:
    """Raise InputError if a calibration file is not of the arm whose encoder steps are seen."""
    seen = half if steps.half_range is None else steps.half_range
    if np.any(np.abs(seen / half - 1.0) > OTHER_RANGE):
        raise InputError(
            f"{file}: its joints turn {np.round(half, 1).tolist()} deg to either side, but the "
            f"encoder steps of the readings say {np.round(seen, 1).tolist()}. Expected the "
            "calibration of the follower at the time of recording: name another, or none."
        )


def _fallback_range(steps: _Scale, robot: Robot) -> tuple[FloatArray, FloatArray, str]:
    """Return the angles at -100 and 100 [deg] and where they are from: encoder steps, or URDF."""
    limits = np.rad2deg([(joint.low, joint.high) for joint in robot.chain.joints])
    low, high = np.clip(limits, -180.0, 180.0).T
    if steps.half_range is None:
        return low, high, f"range {GUESSED} from the limits of the URDF"
    half, seen = steps.half_range, np.isfinite(steps.half_range)
    where = "range by the encoder steps" if seen.all() else f"range partly {GUESSED} from the URDF"
    return np.where(seen, -half, low), np.where(seen, half, high), where


def _stated(info: Mapping[str, Any], names: Sequence[str]) -> _Scale | None:
    """Return the unit that types and names of the channels state; None if they do not."""
    if str(info["features"]["observation.state"].get("dtype", "")).startswith(("int", "uint")):
        return _Scale(SERVO, "whole numbers by their type")
    for unit in ANGLE_UNITS:
        if all(
            name.removesuffix(NAME_SUFFIX).lower().endswith(("_" + unit, "." + unit))
            for name in names
        ):
            return _Scale(unit, "by the names of the channels")
    if all(name.startswith(NAME_PREFIX) for name in names):
        return _Scale("deg", "names of a recorder that knows degrees only")
    return None


def _by_steps(state: FloatArray, robot: Robot) -> _Scale | None:
    """Return the scale by the step of the readings; None if they show no encoder counts."""
    if robot.profile.servo_units is None:
        return None
    rad = robot.servo_units.rad_per_count
    per_unit = rad / np.array([_step(column) for column in state.T])  # rad, NaN: no grid
    seen = per_unit[np.isfinite(per_unit)]
    if len(seen) == 0:
        return None
    sizes = {**ANGLE_UNITS, SERVO: rad}
    for unit, size in sizes.items():
        if np.all(np.abs(seen / size - 1.0) < SAME_SCALE):
            return _Scale(unit, f"by the encoder steps of {rad / size:.4g}")
    differ = np.ptp(seen) > SAME_SCALE * seen.max()  # as no decimals do that a log is rounded to
    turns = 2.0 * FULL_SCALE * seen / (2.0 * np.pi)
    inside = np.nanmax(np.abs(state)) <= FULL_SCALE
    if differ and inside and np.all((turns >= SMALLEST_RANGE) & (turns <= 1.0)):
        half = np.rad2deg(FULL_SCALE * per_unit)
        return _Scale(NORMALISED, "by the encoder steps, which differ from joint to joint", half)
    return None


def _step(values: FloatArray) -> float:
    """Return the step of the even grid that all values lie on; NaN if there is none."""
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < FEWEST_LEVELS:
        return np.nan
    step, start = float(np.diff(levels).min()), float(levels[0])
    for _ in range(2):
        step, start = np.polyfit(np.rint((levels - start) / step), levels, 1)
    off = (levels - start) / step
    return float(step) if np.abs(off - np.rint(off)).max() < ON_GRID else np.nan


def _by_size(state: FloatArray) -> _Scale:
    """Return the unit guessed from the size of the numbers."""
    size = float(np.nanmax(np.abs(state)))
    if size == FULL_SCALE:
        return _Scale(NORMALISED, f"{GUESSED}: the largest is exactly 100")
    if size <= 2.0 * np.pi:
        return _Scale("rad", f"{GUESSED}: none is larger than {size:.2f}")
    if size > 360.0 and np.all(state == np.rint(state)):
        return _Scale(SERVO, f"{GUESSED}: whole numbers up to {size:.0f}")
    why = f"the largest is {size:.0f}" if size > FULL_SCALE else "-100 to 100 is possible too"
    return _Scale("deg", f"{GUESSED}: {why}")


# The calibration file that LeRobot writes for each arm.


def _calibration_in(path: Path) -> Path | None:
    """Return the only calibration file in a data set's folder, its `meta` or `calibration`.

    Raises:
        InputError: If there are several.
    """
    files = []
    for file in (f for name in ("", "meta", "calibration") for f in (path / name).glob("*.json")):
        with suppress(InputError):  # of other JSON files
            _calibration(file)
            files.append(file)
    if len(files) > 1:
        raise InputError(
            f"{path}: holds {len(files)} calibration files: "
            f"{', '.join(sorted(f.name for f in files))}. Expected one. Name that of the follower "
            "arm: --columns FILE.json."
        )
    return files[0] if files else None


def _calibration(file: Path) -> dict[str, Any]:
    """Return what a calibration file says of each joint.

    Raises:
        InputError: If the file is no calibration file of LeRobot.
    """
    with reading(file, "JSON"):
        joints = json.loads(read_text(file, "JSON"))
    entries = list(joints.values()) if isinstance(joints, dict) else []
    if not entries or not all(isinstance(one, dict) and "range_min" in one for one in entries):
        raise InputError(
            f"{file}: no calibration of LeRobot. Expected for each joint range_min and range_max, "
            "as `lerobot-calibrate` writes them."
        )
    return joints


def _ranges(file: Path, robot: Robot) -> FloatArray:
    """Return ``range_min`` and ``range_max`` of each motor, (2, motor) [counts].

    Raises:
        InputError: If the file is no calibration file of LeRobot, or lacks a joint.
    """
    joints, wanted = _calibration(file), [motor.joint for motor in robot.motors]
    for joint in wanted:
        check_name("joint", joint, joints, f"{file} lacks a joint of {robot.name!r}: ")
    ends = [[joints[joint].get(end) for joint in wanted] for end in ("range_min", "range_max")]
    with reading(file, "a calibration of LeRobot", "Calibrate the arm again."):
        ranges = as_floats(ends)
        if not (np.isfinite(ranges).all() and np.all(np.diff(ranges, axis=0) > 0.0)):
            raise InputError(
                f"{file}: range_min and range_max are {ends}. Expected counts, range_min the "
                "smaller one. Calibrate the arm again, or state low and high in a map."
            )
    return ranges
