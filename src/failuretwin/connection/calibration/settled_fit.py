"""Bias, compliance, friction and scatter of every motor from where healthy movements settled.

The settled error of a motor is linear in bias, compliance and friction; what is left scatters as a
Student t. All unknowns are fitted together by their posterior mode under wide priors, and its
curvature gives their intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from failuretwin.connection.calibration.observations import Observations
from failuretwin.core.ellipsoid import log_student
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, loads_in_range
from failuretwin.digital_model.twin import DigitalTwin

OFFSET_PRIOR_RAD = 0.03
"""Prior standard deviation of bias, friction and the largest sag [rad]: about 2 degrees."""
SCATTER_PRIOR_RAD, SCATTER_PRIOR_SPREAD = 0.007, 1.0
"""Prior median of the scatter [rad] and standard deviation of its logarithm."""
DOF_PRIOR, DOF_PRIOR_SPREAD = 5.0, 0.7
"""Prior median of the degrees of freedom and standard deviation of their logarithm."""
TOOL_NOISE_PRIOR_M, TOOL_NOISE_PRIOR_SPREAD = 0.0005, 1.0
"""Prior median of a tool sensor's own noise [m] and standard deviation of its logarithm."""
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


@dataclass(frozen=True)
class _Problem:
    """The settled errors as a linear model.

    Attributes:
        error: Settled minus commanded: angles (movement, motor) [rad] or tool (movement, axis) [m].
        design: Factor of bias, compliance and friction, (3, movement, motor).
        jacobian: Tool position by angle, (movement, axis, motor); None where angles were read.
        rounding: Standard deviation of what the motors' readings round off [rad].
        arrived: Motors whose command arrived, (movement, motor); readings of others do not count.
    """

    error: FloatArray
    design: FloatArray
    jacobian: FloatArray | None
    rounding: float
    arrived: FloatArray

    def log_likelihood(self, parameters: FloatArray) -> float:
        """Return the log likelihood of parameters as in `SettledFit.mode`.

        With the tool path alone, the logarithm of the tool sensor's noise [m] comes after them.
        """
        motors = self.design.shape[2]
        grouped = parameters[: 4 * motors].reshape(4, -1)
        linear, log_scatter = grouped[:3], grouped[3]
        dof = float(np.exp(parameters[4 * motors]))
        expected = np.einsum("pik,pk->ik", self.design, linear)
        scale = np.hypot(np.exp(log_scatter), self.rounding)
        if self.jacobian is None:
            unit = (self.error - expected) / scale
            constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
            density = constant - np.log(scale) - 0.5 * (dof + 1) * np.log1p(unit**2 / dof)
            return float(np.sum(density * self.arrived))
        moved = np.einsum("iak,ik->ia", self.jacobian, expected)
        noise = float(np.exp(2.0 * parameters[-1]))
        return float(np.sum(log_student(self.error - moved, self.jacobian * scale, noise, dof)))


def fit_settling(
    observations: Observations, robot: Robot, arrived: FloatArray, payload: float = 0.0
) -> SettledFit:
    """Fit where the motors of a healthy robot settle.

    Args:
        observations: Settled movements.
        robot: The robot.
        arrived: 1 where a motor got its command, 0 where it did not, (movement, motor).
        payload: Mass at the tool point [kg].
    """
    of_motors = observations.position is not None
    prior = _Prior.of(robot, payload, of_motors)
    fit, start = None, prior.mean
    for _ in range(1 if of_motors else POSE_ROUNDS):
        problem = _problem(observations, robot, arrived, payload, fit)
        fit, start = _mode(problem, prior, start)
    assert fit is not None
    return fit


@dataclass(frozen=True)
class _Prior:
    """Independent normal priors: mean and standard deviation of each parameter."""

    mean: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, robot: Robot, payload: float, of_motors: bool) -> _Prior:
        """Return priors that know how large a load the motors of the robot carry."""
        motors = len(robot.motors)
        load = np.maximum(largest_load(robot, payload), 1e-6)
        offset = np.full(motors, OFFSET_PRIOR_RAD)
        mean = np.zeros(4 * motors + 1)
        mean[3 * motors : -1], mean[-1] = np.log(SCATTER_PRIOR_RAD), np.log(DOF_PRIOR)
        compliance = np.where(load > 1e-6, OFFSET_PRIOR_RAD / load, 1e-9)
        spread = np.full(motors, SCATTER_PRIOR_SPREAD)
        deviation = np.concatenate([offset, compliance, offset, spread, [DOF_PRIOR_SPREAD]])
        if of_motors:
            return cls(mean, deviation)
        return cls(
            np.append(mean, np.log(TOOL_NOISE_PRIOR_M)),
            np.append(deviation, TOOL_NOISE_PRIOR_SPREAD),
        )

    def log_density(self, parameters: FloatArray) -> float:
        return -0.5 * float(np.sum(((parameters - self.mean) / self.deviation) ** 2))


def largest_load(robot: Robot, payload: float) -> FloatArray:
    """Return the largest gravity torque that each motor meets in its range, (motor,) [N m]."""
    return np.abs(loads_in_range(robot, payload)).max(axis=0)


def rounding(robot: Robot) -> float:
    """Return the standard deviation of what whole servo counts round off [rad]."""
    if robot.profile.servo_units is None:
        return 0.0
    return float(abs(robot.servo_units.rad_per_count) / np.sqrt(12.0))


def _problem(
    observations: Observations,
    robot: Robot,
    arrived: FloatArray,
    payload: float,
    fit: SettledFit | None,
) -> _Problem:
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
    return _Problem(
        error=error,
        design=np.stack([np.ones_like(torque), torque, -observations.direction]),
        jacobian=jacobian,
        rounding=rounding(robot),
        arrived=arrived,
    )


def _mode(problem: _Problem, prior: _Prior, start: FloatArray) -> tuple[SettledFit, FloatArray]:
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
