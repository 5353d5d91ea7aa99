"""Joint offsets of LeRobot data sets: lines of `diagnose`, and its corrected copy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin import __version__
from failuretwin.app.inputs import stated_angles
from failuretwin.connection.joint_offsets import JointOffset, joint_offsets
from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import FAULTY_STATE, Diagnosis, Hypothesis
from failuretwin.data_knowledge.readers.lerobot import (
    NOTE_FILE,
    STATE,
    check_copy,
    read_lerobot,
    write_shifted,
)
from failuretwin.data_knowledge.readers.lerobot_units import LeRobotAngles
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import joint_names_in, percent

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.app.commands.options import LogOptions


def check_correctable(logs: Sequence[Path], out: Path | None) -> None:
    """Raise InputError unless the logs are one LeRobot data set and a copy, if any, can be made."""
    if out is None:
        return
    if len(logs) != 1:
        raise InputError(
            f"--correct: {len(logs)} logs given, expected one LeRobot data set. Correct each alone."
        )
    check_copy(logs[0], out)


def offset_lines(
    runs: xr.Dataset,
    known: CalibratedRobot,
    diagnoses: Sequence[Diagnosis],
    reading: LogOptions,
    out: Path | None,
) -> list[str]:
    """Return lines on the offsets in LeRobot data, and write a corrected copy to `out`, if any."""
    if not str(runs.attrs.get("source", "")).startswith("LeRobot"):
        return []
    offsets = _offsets(runs, known, diagnoses)
    lines = [
        f"joint offset: {_in_words(offset, known.robot)}, in every episode; {_sure(offset)}"
        for offset in offsets
        if offset.found
    ]
    lines += _blamed_for(offsets, diagnoses, known.robot)
    if out is not None:
        angles = stated_angles(reading.columns)
        return [*lines, _corrected(reading.logs[0], out, known.robot, angles, offsets)]
    if lines:
        return [*lines, "--correct OUT writes a copy of the data set without it"]
    return [f"joint offsets: none found; {_judged(offsets, known.robot)}"]


def _blamed_for(
    offsets: Sequence[JointOffset], diagnoses: Sequence[Diagnosis], robot: Robot
) -> list[str]:
    """Return that verdicts may come from an offset, a line for each motor that they blame."""
    lines = []
    for motor in [offset.motor for offset in offsets if offset.found]:
        runs = [one for one in diagnoses if (one.diagnosis or "").startswith(f"{motor}:")]
        if any(one.state == FAULTY_STATE for one in runs):
            named = joint_names_in(motor.replace("_", " "), robot)
            lines.append(
                f"{counted(len(runs), 'run')} may blame {named} for that offset alone: judge the "
                "corrected copy"
            )
    return lines


def _judged(offsets: Sequence[JointOffset], robot: Robot) -> str:
    """Return how many joints could be judged, and which could not."""
    judged = {offset.motor for offset in offsets}
    others = [name.replace("_", " ") for name in robot.motor_names if name not in judged]
    text = (
        f"{len(judged)} of {len(robot.motors)} joints follow their commands and stop often enough"
    )
    return joint_names_in(f"{text}, not {', '.join(others)}", robot) if others else text


def _offsets(
    runs: xr.Dataset, known: CalibratedRobot, diagnoses: Sequence[Diagnosis]
) -> list[JointOffset]:
    """Return the offsets of joints; of stuck motors, none."""
    stuck = {
        fault.motor
        for one in diagnoses
        if one.state == FAULTY_STATE and one.diagnosis
        for fault in Hypothesis.parse(one.diagnosis).faults
        if (mode := MODES.get(fault.mode)) is not None and mode.signature is Signature.HELD
    }
    offsets = joint_offsets(runs, known.robot, known.imperfections)
    return [offset for offset in offsets if offset.motor not in stuck]


def _corrected(
    log: Path, out: Path, robot: Robot, angles: LeRobotAngles | None,
    offsets: Sequence[JointOffset],
) -> str:  # fmt: skip
    """Write a copy of a data set without the offsets that are found; return a line on it."""
    found = [offset for offset in offsets if offset.found]
    if not found:
        largest = max(offsets, key=lambda offset: offset.probability, default=None)
        got = (
            f"the most probable: {_in_words(largest, robot)}, {_sure(largest)}"
            if largest
            else ("no joint follows its commands and stops often enough")
        )
        raise InputError(
            f"{log}: nothing to correct: no joint offset has a probability of 95 % ({got}). "
            f"{out} was not written. Record more stops, or leave out --correct."
        )
    episodes = read_lerobot(log, robot, angles)
    names, channels = episodes.channels, episodes.channel_of
    per_rad = episodes.angles.per_rad(robot)
    shift, joints = np.zeros(len(names)), list[dict[str, Any]]()
    for offset in found:
        k = robot.motor_names.index(offset.motor)
        shift[channels[k]] = -offset.size * per_rad[k]
        joints.append({
            "channel": names[channels[k]],
            "motor": offset.motor,
            "offset_deg": float(np.rad2deg(offset.size)),
            "offset_90_deg": np.rad2deg(offset.interval_90).tolist(),
            "probability": offset.probability,
            "added": float(shift[channels[k]]),
            "unit": episodes.angles.unit,
        })  # fmt: skip
    note = {"program": f"failuretwin {__version__}", "source": log.resolve().name, "column": STATE}
    write_shifted(log, out, shift, note | {"joints": joints})
    named = ", ".join(str(joint["channel"]) for joint in joints)
    return f"corrected copy: {out}, with {STATE} of {named} shifted; see {out / NOTE_FILE}"


def _in_words(offset: JointOffset, robot: Robot) -> str:
    size, (low, high) = np.rad2deg(offset.size), np.rad2deg(offset.interval_90)
    motor = joint_names_in(offset.motor.replace("_", " "), robot)
    return f"{motor} reads {size:+.1f} deg off its command, sag apart ({low:+.1f} to {high:+.1f})"


def _sure(offset: JointOffset) -> str:
    return f"{percent(offset.probability)} sure"
