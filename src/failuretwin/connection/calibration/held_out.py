"""Does the calibration predict logs that it has not seen? Each session left out in turn."""

from __future__ import annotations

import numpy as np

from failuretwin.connection.calibration.calibration import HeldOut
from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.calibration.settled_part import SettledPart, fit_settled_part
from failuretwin.connection.healthy import PATH_NOISE_M
from failuretwin.core.ellipsoid import log_student
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import generic_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

TO_DEVIATION = 1.4826
"""Median absolute deviation to standard deviation of a normal distribution."""


def held_out_sessions(
    observations: Observations, robot: Robot, payload: float = 0.0
) -> tuple[HeldOut, ...]:
    """Return how well the other sessions predict each session; empty with one session alone."""
    found = []
    for index in range(len(observations.sessions)):
        inside = observations.session == index
        if not inside.any() or inside.all():
            continue
        try:
            others = fit_settled_part(observations[~inside], robot, payload)
        except InputError:
            continue  # what is left is too little to learn from
        found.append(judge(observations[inside], others, robot, observations.sessions[index]))
    return tuple(entry for entry in found if entry is not None)


def judge(
    observations: Observations, others: SettledPart, robot: Robot, session: str
) -> HeldOut | None:
    """Return how well a fit predicts settled movements that it has not seen.

    Movements whose commands did not arrive are left out: there is nothing to predict of them. None
    if fewer than two are left, for one movement says nothing of scatter.

    Args:
        observations: Settled movements of one session.
        others: The fit to other sessions.
        robot: The robot.
        session: Name of the session.
    """
    settling = others.settling
    generic = generic_imperfections(robot).settling
    assert generic is not None
    plain = settled_errors(observations, robot, None)
    told = settled_errors(observations, robot, settling)
    kept = _healthy(plain, observations)
    gain = _log_density(observations, robot, settling) - _log_density(observations, robot, generic)
    gain = gain[kept]
    if len(gain) < 2:
        return None
    return HeldOut(
        session=session,
        movements=int(kept.sum()),
        before=tuple(typical_size(plain[kept]).tolist()),
        after=tuple(typical_size(told[kept]).tolist()),
        gain=float(gain.mean()),
        gain_error=float(gain.std(ddof=1) / np.sqrt(len(gain))),
    )


def _healthy(plain: FloatArray, observations: Observations) -> BoolArray:
    """Return the movements in which everything went near where it was told."""
    limit = 0.084 if observations.position is not None else 0.03
    return np.asarray((np.abs(plain) < limit).all(axis=1))


def typical_size(errors: FloatArray) -> FloatArray:
    """Return 1.48 times the median size of the errors in each column.

    It is taken about zero: a shift of the whole session is an error too.
    """
    return TO_DEVIATION * np.median(np.abs(errors), axis=0)


def settled_errors(
    observations: Observations, robot: Robot, settling: Settling | None
) -> FloatArray:
    """Return settled minus expected: of motors [rad] or of the tool [m], a row a movement.

    Args:
        observations: Settled movements.
        robot: The robot.
        settling: Where its motors settle; None: exactly at their targets.
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
