"""What one run says of the wear of the motors: a linear model with unit scatter."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.calibration.observations import Observations, stayed
from failuretwin.connection.healthy import PATH_NOISE_M
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

DECIMALS = 6
"""Errors and designs are rounded to this many decimals of the scatter: short in a file, and a run
read back from it is the run that was written."""
LEAST_SCATTER_RAD = 1e-5
"""Scatter assumed of motors that are said to have none [rad]; no reading is as fine."""
KEY_DIGITS = 16


@dataclass(frozen=True)
class RunEvidence:
    """Settled errors of one run as a linear model: error = design @ wear + unit scatter.

    Wear is the bias of every motor, then its compliance. A group is what scatters together as one
    Student t: the three axes of a tool position, or the reading of one motor.

    Attributes:
        run: Name of the run.
        key: Fingerprint of its settled movements; a run given twice is known by it.
        error: Settled minus commanded, friction taken off, in scatters, (group, axis).
        design: Its slope by wear, (group, axis, 2 motor) [1/rad, then N m/rad].
    """

    run: str
    key: str
    error: FloatArray
    design: FloatArray


def run_evidence(
    observations: Observations, robot: Robot, settling: Settling, runs: Sequence[int]
) -> list[RunEvidence]:
    """Return what runs say; nothing of movements whose command did not arrive.

    Args:
        observations: Settled movements; by the motors' readings where they have them, else by the
            tool.
        robot: The robot.
        settling: Where motors settle as far as is known: the model is made linear there.
        runs: Indices of the wanted runs.
    """
    wanted = observations[np.isin(observations.run, np.asarray(runs))]
    expected = wanted.target + settling.offset(robot, wanted.target, wanted.direction)
    lost = stayed(wanted, robot, expected)
    if wanted.position is None:
        error, design = _by_tool(wanted, robot, settling, expected)
        kept = np.asarray(~lost.any(axis=1, keepdims=True))
    else:
        error, design = _by_readings(wanted, wanted.position, robot, settling)
        kept = ~lost
    return [_of_run(wanted, error, design, kept, run) for run in runs]


def _by_tool(
    seen: Observations, robot: Robot, settling: Settling, expected: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return white errors (movement, 1, axis) and designs (movement, 1, axis, 2 motor)."""
    point, jacobian = DigitalTwin(robot).path_and_jacobian(expected)
    short = np.asarray(settling.friction) * seen.direction
    away = expected - seen.target + short
    error = seen.point - point + np.einsum("iak,ik->ia", jacobian, away)
    torque = robot.sense * robot.loads.torque(expected * robot.sense, settling.payload)
    design = np.concatenate([jacobian, jacobian * torque[:, None]], axis=2)
    scaled = jacobian * np.asarray(settling.scatter)
    spread = np.einsum("iak,ibk->iab", scaled, scaled) + PATH_NOISE_M**2 * np.eye(3)
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.concatenate([error[..., None], design], axis=2))
    return white[:, None, :, 0], white[:, None, :, 1:]


def _by_readings(
    seen: Observations, position: FloatArray, robot: Robot, settling: Settling
) -> tuple[FloatArray, FloatArray]:
    """Return white errors (movement, motor, 1) and designs (movement, motor, 1, 2 motor)."""
    count = 0.0
    if robot.profile.servo_units is not None:
        count = abs(robot.servo_units.rad_per_count) / np.sqrt(12.0)
    scale = np.sqrt(np.asarray(settling.scatter) ** 2 + count**2)
    scale = np.maximum(scale, LEAST_SCATTER_RAD)
    torque = robot.sense * robot.loads.torque(position * robot.sense, settling.payload)
    error = position - seen.target + np.asarray(settling.friction) * seen.direction
    unit = np.eye(position.shape[1])
    design = np.concatenate(
        [np.broadcast_to(unit, (len(seen), *unit.shape)), unit * torque[:, :, None]], axis=2
    )
    return (error / scale)[..., None], (design / scale[:, None])[:, :, None]


def _of_run(
    seen: Observations, error: FloatArray, design: FloatArray, kept: BoolArray, run: int
) -> RunEvidence:
    inside = seen.run == run
    chosen = inside[:, None] & kept
    return RunEvidence(
        run=seen.runs[run],
        key=_key(seen[inside], seen.runs[run]),
        error=np.round(error[chosen], DECIMALS),
        design=np.round(design[chosen], DECIMALS),
    )


def _key(seen: Observations, name: str) -> str:
    """Return the fingerprint of the movements of one run."""
    digest = hashlib.sha256(name.encode())
    for values in (seen.target, seen.point):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()[:KEY_DIGITS]
