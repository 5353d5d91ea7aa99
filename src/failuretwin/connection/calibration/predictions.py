"""Settled errors beside what a calibration expects of them, for a person to look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.calibration import Calibration
from failuretwin.connection.calibration.held_out import expected_pose, settled_errors
from failuretwin.connection.calibration.observations import Observations, observe
from failuretwin.connection.calibration.settled_errors import rounding
from failuretwin.connection.calibration.settled_part import fit_settled_part, sort_movements
from failuretwin.connection.healthy import PATH_NOISE_M
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

MOST_FOLDS = 10
"""Sessions are left out in at most this many groups: a fit to each rest takes about a second."""


@dataclass(frozen=True)
class Predictions:
    """Settled errors and what is expected of them, a row a movement.

    A channel is a motor [rad] or, where the log has the tool path alone, an axis of the tool [m].

    Attributes:
        error: Settled minus commanded, (movement, channel).
        expected: What the fit expects it to be, (movement, channel).
        scale: Scale of the Student t distribution of the difference, (movement, channel).
        counts: Entries whose command arrived and that look healthy, (movement, channel).
        target: Commanded angles, (movement, motor) [rad].
        direction: Sign of the commanded travel, (movement, motor).
        torque: Load torque that each motor meets, in the log's sense, (movement, motor) [N m].
        of_motors: Whether channels are motors.
        unseen: Whether each movement is expected by a fit that has not seen its session.
    """

    error: FloatArray
    expected: FloatArray
    scale: FloatArray
    counts: BoolArray
    target: FloatArray
    direction: FloatArray
    torque: FloatArray
    of_motors: bool
    unseen: bool


def trusted_runs(found: Calibration, runs: xr.Dataset) -> xr.Dataset:
    """Return the runs that were not left out as a whole."""
    out = {entry.run for entry in found.left_out if entry.movement == 0}
    kept = [i for i, run in enumerate(runs["run"].values) if str(run) not in out]
    return runs.isel(run=kept)


def settling_of(found: Calibration, robot: Robot) -> Settling:
    """Return where the motors settle by a calibration."""
    return found.imperfections.settling or Settling.ideal(len(robot.motors))


def predict(found: Calibration, runs: xr.Dataset, robot: Robot) -> Predictions:
    """Return what the calibration expects of the sessions held out.

    Where none were, each session is expected by a fit to the others; with one session alone, by
    the calibration itself.

    Args:
        found: The calibration.
        runs: The runs it was learned from or judged on.
        robot: The robot.
    """
    seen = observe(trusted_runs(found, runs), use_readings=found.used_readings)
    settling = settling_of(found, robot)
    learned = np.array([name in found.sessions for name in seen.sessions])[seen.session]
    if not learned.all():
        seen = seen[~learned]
        return _predictions(seen, robot, settling, expected_pose(seen, robot, settling), True)
    pose = _expected_by_others(seen, robot, settling.payload)
    unseen = pose is not None
    if pose is None:
        pose = expected_pose(seen, robot, settling)
    return _predictions(seen, robot, settling, pose, unseen)


def _expected_by_others(seen: Observations, robot: Robot, payload: float) -> FloatArray | None:
    """Return the angles expected by fits to other sessions; None where too little is left."""
    groups = min(len(seen.sessions), MOST_FOLDS)
    pose = np.empty_like(seen.target)
    for group in range(groups):
        inside = seen.session % groups == group
        try:
            others = fit_settled_part(seen[~inside], robot, payload)
        except InputError:
            return None
        pose[inside] = expected_pose(seen[inside], robot, others.settling)
    return pose


def _predictions(
    seen: Observations, robot: Robot, settling: Settling, pose: FloatArray, unseen: bool
) -> Predictions:
    lost, odd = sort_movements(seen, robot, settling)
    twin, scatter = DigitalTwin(robot), np.asarray(settling.scatter)
    error = settled_errors(seen, robot, None)
    if seen.position is not None:
        expected, counts = pose - seen.target, ~lost & ~odd[:, None]
        scale = np.broadcast_to(np.hypot(scatter, rounding(robot)), error.shape)
    else:
        point, jacobian = twin.path_and_jacobian(pose)
        expected = point - twin.path(seen.target)
        counts = np.repeat(~lost.any(axis=1, keepdims=True) & ~odd[:, None], 3, axis=1)
        scale = np.sqrt(jacobian**2 @ scatter**2 + PATH_NOISE_M**2)
    settled = pose if seen.position is None else seen.position
    return Predictions(
        error=error,
        expected=expected,
        scale=scale,
        counts=counts,
        target=seen.target,
        direction=seen.direction,
        torque=robot.sense * robot.loads.torque(settled * robot.sense, settling.payload),
        of_motors=seen.position is not None,
        unseen=unseen,
    )
