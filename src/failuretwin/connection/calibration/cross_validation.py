"""Does the calibration predict logs that it has not seen? Each session left out in turn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.calibration.observations import (
    Observations,
    observe,
    uncalibrated,
)
from failuretwin.connection.calibration.result import Calibration, HeldOut
from failuretwin.connection.calibration.settling_fit import (
    SettlingFit,
    SortedMovements,
    fit_settling,
)
from failuretwin.core.errors import InputError
from failuretwin.core.numerics import log_student
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunSet
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.healthy_model import PATH_NOISE_M, HealthyModel

TO_DEVIATION = 1.4826
"""Median absolute deviation to standard deviation of a normal distribution."""


def cross_validate(
    part: SettlingFit, robot: Robot, on_progress: Progress = unseen
) -> tuple[HeldOut, ...]:
    """Return how well the other sessions predict each session; empty with one session alone.

    Args:
        part: The fit to all sessions.
        robot: The robot.
        on_progress: Called with the number of further sessions that were looked at.
    """
    found, seen = [], part.observations
    for index, name in enumerate(seen.sessions):
        on_progress(1)
        inside = seen.session == index
        if not inside.any() or inside.all():
            continue
        try:
            others = part.without(inside)
        except InputError:
            continue  # what is left is too little to learn from
        found.append(judge(seen[np.flatnonzero(inside)], others, robot, name))
    return tuple(entry for entry in found if entry is not None)


def judge(
    observations: Observations, others: SettlingFit, robot: Robot, session: str
) -> HeldOut | None:
    """Return how well the fit to other sessions predicts the settled movements of a session.

    Movements whose commands did not arrive are left out: there is nothing to predict of them. None
    if fewer than two are left, for one movement says nothing of scatter.
    """
    settling = others.settling
    kind = HealthyModel.of(robot, generic_imperfections(robot))
    generic = replace(kind.settling, scatter=tuple(kind.scatter.tolist()))
    plain = settled_errors(observations, robot, None)
    told = settled_errors(observations, robot, settling)
    became = SortedMovements.of(observations, others.together.learned)
    kept = _healthy(plain, observations) & ~became.lost.any(axis=1)
    gain = _log_density(observations, robot, settling) - _log_density(observations, robot, generic)
    gain = gain[kept]
    if len(gain) < 2:
        return None
    return HeldOut(
        session=session,
        movements=int(kept.sum()),
        before=tuple(robust_scale(plain[kept]).tolist()),
        after=tuple(robust_scale(told[kept]).tolist()),
        gain=float(gain.mean()),
        gain_error=float(gain.std(ddof=1) / np.sqrt(len(gain))),
    )


def _healthy(plain: FloatArray, observations: Observations) -> BoolArray:
    """Return the movements in which everything went near where it was told."""
    limit = 0.084 if observations.position is not None else 0.03
    return np.asarray((np.abs(plain) < limit).all(axis=1))


def robust_scale(errors: FloatArray) -> FloatArray:
    """Return 1.48 times the median size of the errors in each column.

    It is taken about zero: a shift of the whole session is an error too.
    """
    return TO_DEVIATION * np.median(np.abs(errors), axis=0)


def settled_errors(
    observations: Observations, robot: Robot, settling: Settling | None
) -> FloatArray:
    """Return settled minus expected: of motors [rad] or of the tool [m], a row a movement.

    Without `settling` motors are expected exactly at their targets.
    """
    pose = expected_pose(observations, robot, settling)
    if observations.position is not None:
        return observations.position - pose
    return observations.point - DigitalTwin(robot).path(pose)


def expected_pose(
    observations: Observations, robot: Robot, settling: Settling | None
) -> FloatArray:
    """Return the angles at which motors are expected to settle, (movement, motor) [rad]."""
    if settling is None:
        return observations.target
    target, direction = observations.target, observations.direction
    near = target + settling.offset(robot, target, direction)
    return target + settling.offset(robot, near, direction)


def _log_density(observations: Observations, robot: Robot, settling: Settling) -> FloatArray:
    """Return the log density of the settled tool position of each movement, (movement,)."""
    pose = expected_pose(observations, robot, settling)
    point, jacobian = DigitalTwin(robot).path_and_jacobian(pose)
    spread = jacobian * np.asarray(settling.scatter)
    return log_student(observations.point - point, spread, PATH_NOISE_M**2, settling.tail_dof)


# Settled errors beside what a calibration expects of them, for a person to look at.

MOST_FOLDS = 10
"""Sessions are left out in at most this many groups: a fit to each rest takes about a second."""


@dataclass(frozen=True)
class Predictions:
    """Settled errors and what is expected of them, a row a movement.

    A channel is a motor [rad] or, where the log has the tool path alone, an axis of the tool [m].

    Attributes:
        error: Settled minus commanded, (movement, channel).
        expected: What the fit expects it to be, (movement, channel).
        counts: Entries whose command arrived and that look healthy, (movement, channel).
        of_motors: Whether channels are motors.
        unseen: Whether each movement is expected by a fit that has not seen its session.
    """

    error: FloatArray
    expected: FloatArray
    counts: BoolArray
    of_motors: bool
    unseen: bool


def settling_of(found: Calibration, robot: Robot) -> Settling:
    """Return where the motors settle by a calibration."""
    return found.imperfections.settling or Settling.ideal(len(robot.motors))


def predict(found: Calibration, runs: RunSet, robot: Robot) -> Predictions:
    """Return what the calibration expects of the sessions held out.

    Where none were, each session is expected by a fit to the others; with one session alone, by
    the calibration itself.
    """
    out = {entry.run for entry in found.left_out if entry.movement == 0}
    trusted = [i for i, run in enumerate(runs["run"].values) if str(run) not in out]
    settling = settling_of(found, robot)
    seen = observe(runs.isel(run=trusted), robot)
    seen = seen.of(uncalibrated(robot, seen.of_motors, payload=settling.payload))
    learned = np.array([name in found.sessions for name in seen.sessions])[seen.session]
    pose = _expected_by_others(seen, robot) if learned.all() else None
    unseen = pose is not None or not learned.all()
    if not learned.all():
        seen = seen[np.flatnonzero(~learned)]
    if pose is None:
        pose = expected_pose(seen, robot, settling)
    return _predictions(seen, found, robot, pose, unseen)


def _expected_by_others(seen: Observations, robot: Robot) -> FloatArray | None:
    """Return the angles expected by fits to other sessions; None where too little is left."""
    groups, run = min(len(seen.sessions), MOST_FOLDS), seen.at[0]
    pose = np.empty_like(seen.target)
    try:
        part = fit_settling(seen)
        for group in range(groups):
            inside = seen.session % groups == group
            others, judged = part.without(inside), seen[np.flatnonzero(inside)]
            pose[inside[run]] = expected_pose(judged, robot, others.settling)
    except InputError:
        return None
    return pose


def _predictions(
    seen: Observations, found: Calibration, robot: Robot, pose: FloatArray, unseen: bool
) -> Predictions:
    known = replace(found.imperfections, sensors=seen.model.imperfections.sensors)
    became = SortedMovements.of(seen, replace(seen.model, imperfections=known))
    lost, odd, twin = became.lost, became.odd, DigitalTwin(robot)
    error = settled_errors(seen, robot, None)
    if seen.position is not None:
        expected, counts = pose - seen.target, ~lost & ~odd[:, None]
    else:
        expected = twin.path(pose) - twin.path(seen.target)
        counts = np.repeat(~lost.any(axis=1, keepdims=True) & ~odd[:, None], 3, axis=1)
    return Predictions(
        error=error,
        expected=expected,
        counts=counts,
        of_motors=seen.position is not None,
        unseen=unseen,
    )
