"""Does the calibration predict logs that it has not seen? Each session left out in turn."""

from __future__ import annotations

import numpy as np

from failuretwin.connection.calibration.calibration import HeldOut
from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.calibration.settled_part import SettledPart, fit_settled_part
from failuretwin.connection.healthy import PATH_NOISE_M, log_student
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.imperfections import generic_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

TO_DEVIATION = 1.4826
"""Median absolute deviation to standard deviation of a normal distribution."""


def held_out_sessions(observations: Observations, robot: Robot) -> tuple[HeldOut, ...]:
    """Return how well the other sessions predict each session; empty with one session alone."""
    found = []
    for index in range(len(observations.sessions)):
        inside = observations.session == index
        if not inside.any() or inside.all():
            continue
        try:
            others = fit_settled_part(observations[~inside], robot)
        except InputError:
            continue  # what is left is too little to learn from
        found.append(judge(observations[inside], others, robot, observations.sessions[index]))
    return tuple(found)


def judge(observations: Observations, others: SettledPart, robot: Robot, session: str) -> HeldOut:
    """Return how well a fit predicts settled movements that it has not seen.

    Movements whose commands did not arrive are left out: there is nothing to predict of them.

    Args:
        observations: Settled movements of one session.
        others: The fit to other sessions.
        robot: The robot.
        session: Name of the session.
    """
    settling = others.fit.settling("fit")
    generic = generic_imperfections(robot).settling
    assert generic is not None
    plain, told = _errors(observations, robot, None), _errors(observations, robot, settling)
    kept = _healthy(plain, observations)
    gain = _log_density(observations, robot, settling) - _log_density(observations, robot, generic)
    gain = gain[kept]
    return HeldOut(
        session=session,
        movements=int(kept.sum()),
        before=tuple(np.std(plain[kept], axis=0).tolist()),
        after=tuple(robust_deviation(told[kept]).tolist()),
        gain=float(gain.mean()),
        gain_error=float(gain.std() / np.sqrt(len(gain))),
    )


def _healthy(plain: FloatArray, observations: Observations) -> BoolArray:
    """Return the movements in which everything went near where it was told."""
    limit = 0.084 if observations.position is not None else 0.03
    return np.asarray((np.abs(plain) < limit).all(axis=1))


def robust_deviation(values: FloatArray) -> FloatArray:
    """Return 1.48 times the median absolute deviation of each column."""
    return TO_DEVIATION * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def _errors(observations: Observations, robot: Robot, settling: Settling | None) -> FloatArray:
    """Return settled minus expected: of motors [rad] or of the tool [m], a row a movement."""
    pose = _expected(observations, robot, settling)
    if observations.position is not None:
        return observations.position - pose
    return observations.point - DigitalTwin(robot).path(pose)


def _expected(observations: Observations, robot: Robot, settling: Settling | None) -> FloatArray:
    if settling is None:
        return observations.target
    target, direction = observations.target, observations.direction
    near = target + settling.offset(robot, target, direction)
    return target + settling.offset(robot, near, direction)


def _log_density(observations: Observations, robot: Robot, settling: Settling) -> FloatArray:
    """Return the log density of the settled tool position of each movement, (movement,)."""
    pose = _expected(observations, robot, settling)
    point, jacobian = DigitalTwin(robot).path_and_jacobian(pose)
    spread = jacobian * np.asarray(settling.scatter)
    return log_student(observations.point - point, spread, PATH_NOISE_M**2, settling.tail_dof)
