"""Settled movements sorted into healthy ones, lost commands and what stands out, and the fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.calibration.observations import (
    TRAVEL_RAD,
    Observations,
    SettlingPrior,
    SettlingRegression,
    has_known_origin,
    lost_command,
    rounding,
    without_lost,
)
from failuretwin.connection.calibration.result import LeftOut
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

# Bias, compliance, friction and scatter of every motor from where healthy movements settled.

POSE_ROUNDS = 3
"""Rounds in which the pose that gravity acts in and the fit settle together (tool path alone)."""


@dataclass(frozen=True)
class SettlingPosterior:
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


def settling_posterior(
    observations: Observations, robot: Robot, arrived: FloatArray, payload: float = 0.0
) -> SettlingPosterior:
    """Fit where the motors of a healthy robot settle.

    Args:
        observations: Settled movements.
        robot: The robot.
        arrived: How probable it is that each motor got its command, (movement, motor).
        payload: Mass at the tool point [kg].
    """
    of_motors = observations.position is not None
    prior = SettlingPrior.of(robot, payload, of_motors)
    settling, start = replace(Settling.ideal(len(robot.motors)), payload=payload), prior.mean
    for _ in range(1 if of_motors else POSE_ROUNDS):
        problem = SettlingRegression.of(observations, robot, arrived, settling)
        fit, start = _mode(problem, prior, start)
        settling = replace(fit.settling("fit"), payload=payload)
    return fit


def _mode(
    problem: SettlingRegression, prior: SettlingPrior, start: FloatArray
) -> tuple[SettlingPosterior, FloatArray]:
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
    fit = SettlingPosterior(
        mode[own], covariance[own, own], prior.deviation[own], -float(found.fun)
    )
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


FEWEST_MOVEMENTS = 6
"""Settled movements below which nothing can be fitted."""
STANDS_OUT_RAD, STANDS_OUT_M = 0.084, 0.03
"""Error beyond which a movement is no healthy one [rad], twenty counts, and of the tool [m]."""
ROUNDS = 2
"""Rounds of sorting and fitting; the second knows where motors settle."""


@dataclass(frozen=True)
class SettlingFit:
    """Settled movements of healthy logs and what was learned from them.

    Attributes:
        observations: All settled movements.
        lost: Motors that did not get their command, (movement, motor).
        odd: Movements that look like no healthy ones, (movement,).
        fitted: Movements that the fit is to: not odd, and after one that was seen, (movement,).
        arrived: How probable it is that each motor got its command, (movement, motor).
        fit: Where motors settle.
        payload: Mass at the tool point that the fit knows of [kg].
    """

    observations: Observations
    lost: BoolArray
    odd: BoolArray
    fitted: BoolArray
    arrived: FloatArray
    fit: SettlingPosterior
    payload: float = 0.0

    @property
    def settling(self) -> Settling:
        """Where motors settle, payload included."""
        return replace(self.fit.settling("fit"), payload=self.payload)

    def remarks(self) -> list[str]:
        """Return what else did not count, a sentence each."""
        unseen = int(np.sum(~self.odd & ~self.fitted))
        if unseen == 0:
            return []
        return [
            f"{unseen} movements follow one that was not seen at rest, so where their motors came "
            "from is not known: they count for losses alone"
        ]

    def left_out(self, robot: Robot) -> tuple[LeftOut, ...]:
        """Return the movements that did not count, each with its reason."""
        found = []
        seen = self.observations
        for i in np.flatnonzero(self.odd | self.lost.any(axis=1)):
            motors = [robot.motor_names[k] for k in np.flatnonzero(self.lost[i])]
            reason = "is far off its target"
            if motors:
                reason = f"did not get {'its command' if len(motors) == 1 else 'their commands'}"
            name = " and ".join(motors)
            found.append(LeftOut(seen.runs[seen.run[i]], int(seen.number[i]) + 1, name, reason))
        return tuple(found)


def sort_and_fit(observations: Observations, robot: Robot, payload: float = 0.0) -> SettlingFit:
    """Sort settled movements and fit where motors settle.

    Args:
        observations: Settled movements of healthy runs.
        robot: The robot.
        payload: Mass at the tool point [kg].

    Raises:
        InputError: If too few movements are left.
    """
    settling = Settling.ideal(len(robot.motors))
    commanded = observations
    for _ in range(ROUNDS):
        lost, odd = sort_movements(observations, robot, settling)
        kept = ~odd
        known = has_known_origin(observations[kept])
        if known.sum() >= FEWEST_MOVEMENTS:
            kept[kept] = known
        if kept.sum() < FEWEST_MOVEMENTS:
            raise InputError(
                f"only {int(kept.sum())} of {len(kept)} movements come to rest near their targets, "
                f"expected {FEWEST_MOVEMENTS} at least. Give longer logs of a healthy robot."
            )
        observations = without_lost(commanded, lost)
        arrived = probably_arrived(observations, robot, lost, settling)
        fit = settling_posterior(observations[kept], robot, arrived[kept], payload)
        part = SettlingFit(observations, lost, odd, kept, arrived, fit, payload)
        settling = part.settling
    return part


def sort_movements(
    observations: Observations, robot: Robot, settling: Settling
) -> tuple[BoolArray, BoolArray]:
    """Return motors without their commands, (movement, motor), and odd movements, (movement,).

    Args:
        observations: Settled movements.
        robot: The robot.
        settling: Where its motors settle, as far as is known.
    """
    target, direction = observations.target, observations.direction
    expected = target + settling.offset(robot, target, direction)
    lost = lost_command(observations, robot, expected)
    return lost, _odd(observations, robot, np.where(lost, observations.origin, expected))


def probably_arrived(
    observations: Observations, robot: Robot, lost: BoolArray, settling: Settling
) -> FloatArray:
    """Return how probable it is that each motor got its command, (movement, motor).

    A motor that had far to go is sorted already. One that had not, and is read, lost its command
    as often as the others do; where it rests says which of the two it is. Otherwise those few
    would make the tails of the scatter.

    Args:
        observations: Settled movements.
        robot: The robot.
        lost: Motors that surely did not get their command, (movement, motor).
        settling: Where its motors settle, as far as is known.
    """
    arrived = (~lost).astype(np.float64)
    travel = observations.target - observations.origin
    if observations.position is None or not any(settling.scatter):
        return arrived
    told = np.abs(travel) > TRAVEL_RAD
    rate = ((lost & told).sum(axis=0) + 0.5) / (told.sum(axis=0) + 1.0)
    scale = np.hypot(settling.scatter, rounding(robot))
    offset = settling.offset(robot, observations.position, observations.direction)
    off = observations.position - observations.target - offset
    # A motor that stays has come from either side before: friction holds it as now or as against.
    held, turned = off + travel, 2.0 * np.asarray(settling.friction) * observations.direction
    stays = 0.5 * sum(_density(error / scale, settling) for error in (held, held - turned))
    odds = (1.0 - rate) / rate * _density(off / scale, settling) / stays
    return np.where(told, arrived, odds / (1.0 + odds))


def _density(unit: FloatArray, settling: Settling) -> FloatArray:
    """Return the density of a Student t, but for a factor."""
    dof = settling.tail_dof
    return np.asarray((1.0 + unit**2 / dof) ** (-0.5 * (dof + 1.0)))


def _odd(observations: Observations, robot: Robot, expected: FloatArray) -> BoolArray:
    if observations.position is not None:
        off = np.abs(observations.position - expected) > STANDS_OUT_RAD
        return np.asarray(off.any(axis=1))
    away = DigitalTwin(robot).path(expected) - observations.point
    return np.asarray(np.linalg.norm(away, axis=1) > STANDS_OUT_M)
