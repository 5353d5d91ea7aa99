"""Bias, compliance, friction and scatter of every motor from where healthy movements settled.

The settled error of a motor is linear in bias, compliance and friction; what is left scatters as a
Student t. All unknowns are fitted together by their posterior mode under wide priors, and its
curvature gives their intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.calibration.observations import Observations
from failuretwin.connection.calibration.settled_errors import SettledErrors, count_of
from failuretwin.connection.calibration.settled_prior import SettlingPrior
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

POSE_ROUNDS = 3
"""Rounds in which the pose that gravity acts in and the fit settle together (tool path alone)."""


@dataclass(frozen=True)
class SettledFit:
    """Posterior of all settling parameters of a robot.

    Attributes:
        mode: Bias, compliance, friction and log scatter, then the log degrees of freedom; with n
            motors (4 n + 1,), group by group.
        covariance: Of the same, (4 n + 1, 4 n + 1).
        prior_deviation: Standard deviation before the logs were seen, (4 n + 1,).
        log_posterior: Log likelihood and log prior at the mode, for comparing fits.
    """

    mode: FloatArray
    covariance: FloatArray
    prior_deviation: FloatArray
    log_posterior: float

    @property
    def motors(self) -> int:
        """Number of motors."""
        return (len(self.mode) - 1) // 4

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of each parameter, (4 n + 1,)."""
        return np.sqrt(np.diag(self.covariance))

    def settling(self, source: str) -> Settling:
        """Return the mode as a value of the digital model."""
        bias, compliance, friction, log_scatter = self.mode[:-1].reshape(4, -1)
        return Settling(
            bias=tuple(bias.tolist()),
            compliance=tuple(compliance.tolist()),
            friction=tuple(friction.tolist()),
            scatter=tuple(np.exp(log_scatter).tolist()),
            tail_dof=float(np.exp(self.mode[-1])),
            source=source,
        )


def fit_settling(
    observations: Observations, robot: Robot, arrived: FloatArray, payload: float = 0.0
) -> SettledFit:
    """Fit where the motors of a healthy robot settle.

    Args:
        observations: Settled movements.
        robot: The robot.
        arrived: How probable it is that each motor got its command, (movement, motor).
        payload: Mass at the tool point [kg].
    """
    of_motors = observations.position is not None
    prior = SettlingPrior.of(robot, payload, of_motors)
    fit, start = None, prior.mean
    for _ in range(1 if of_motors else POSE_ROUNDS):
        problem = _problem(observations, robot, arrived, payload, fit)
        fit, start = _mode(problem, prior, start)
    assert fit is not None
    return fit


def _problem(
    observations: Observations,
    robot: Robot,
    arrived: FloatArray,
    payload: float,
    fit: SettledFit | None,
) -> SettledErrors:
    twin = DigitalTwin(robot)
    base = np.where(arrived > 0, observations.target, observations.origin)
    jacobian = None
    if observations.position is not None:
        pose, error = observations.position, observations.position - observations.target
    else:
        pose = base
        if fit is not None:
            known = replace(fit.settling("fit"), payload=payload)
            pose = base + known.offset(robot, base, observations.direction)
        point, jacobian = twin.path_and_jacobian(pose)
        error = observations.point - point + np.einsum("iak,ik->ia", jacobian, pose - base)
    torque = robot.sense * robot.loads.torque(pose * robot.sense, payload)
    return SettledErrors(
        error=error,
        design=np.stack([np.ones_like(torque), torque, -observations.direction]),
        jacobian=jacobian,
        count=count_of(robot),
        arrived=arrived,
    )


def _mode(
    problem: SettledErrors, prior: SettlingPrior, start: FloatArray
) -> tuple[SettledFit, FloatArray]:
    """Return the posterior mode and its curvature, found in units of the prior deviations.

    The noise of a tool sensor belongs to no motor: it is averaged out of the fit, and only the
    second result, all parameters at the mode, still has it.
    """
    from scipy.optimize import minimize

    unit = prior.deviation

    def cost(scaled: FloatArray) -> float:
        parameters = scaled * unit
        return -problem.log_likelihood(parameters) - prior.log_density(parameters)

    found = minimize(cost, start / unit, method="BFGS", options={"gtol": 1e-4, "maxiter": 500})
    curvature = _hessian(cost, found.x)
    values, vectors = np.linalg.eigh(curvature)
    inverse = (vectors / np.maximum(values, 0.5)) @ vectors.T
    covariance = inverse * np.outer(unit, unit)
    own = slice(4 * problem.design.shape[2] + 1)
    mode = found.x * unit
    fit = SettledFit(mode[own], covariance[own, own], prior.deviation[own], -float(found.fun))
    return fit, mode


def _hessian(cost: Callable[[FloatArray], float], at: FloatArray, step: float = 1e-3) -> FloatArray:
    """Return the second derivatives of `cost` by central differences."""
    size = len(at)
    steps = np.eye(size) * step
    hessian = np.empty((size, size))
    for i in range(size):
        for j in range(i + 1):
            corners = (
                cost(at + steps[i] + steps[j])
                - cost(at + steps[i] - steps[j])
                - cost(at - steps[i] + steps[j])
                + cost(at - steps[i] - steps[j])
            )
            hessian[i, j] = hessian[j, i] = corners / (4.0 * step**2)
    return hessian
