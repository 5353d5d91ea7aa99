"""Settled movements sorted, and where motors settle fitted, also to other kinds of the robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from failuretwin.digital_model.settling import Settling, largest_load
from failuretwin.digital_model.twin import DigitalTwin

# Bias, compliance, friction and scatter of every motor from where healthy movements settled.

POSE_ROUNDS = 3
"""Rounds in which the pose that gravity acts in and the fit settle together (tool path alone)."""
MOST_DEVIATIONS = 30.0
"""Prior deviations beyond which a search learns no more [-]: scatter there overflows."""


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
    low, high = prior.mean - MOST_DEVIATIONS * unit, prior.mean + MOST_DEVIATIONS * unit

    def cost(scaled: FloatArray) -> float:
        parameters = scaled * unit
        likelihood = problem.log_likelihood(np.clip(parameters, low, high))
        return -likelihood - prior.log_density(parameters)

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


# What the robot might be beside what its profile says: another sense of a motor, a payload.

SURE_NATS = 5.0
"""Log odds from which one description of the robot is told to be better than another."""
ELSEWHERE = 3.0
"""A sense that puts a seen tool so many times farther off than the profile's is not it [-]."""
LEAST_SAG_RAD = 1e-3
"""Sag below which nothing is said of a payload [rad]: a quarter of a servo count."""
PAYLOADS_KG = (0.02, 0.1, 0.5, 2.0)
"""Masses at the tool point that are tried [kg]."""


def sense_remarks(part: SettlingFit, robot: Robot) -> list[str]:
    """Return what the logs say of each motor's sense, in sentences.

    A motor that turns the other way sags the other way; where gravity hardly loads it, nothing can
    be said. Where the tool alone was seen, its position tells senses that would put it elsewhere.
    """
    loaded = np.flatnonzero(largest_load(robot, 0.0) > 1e-6)
    elsewhere = _far_if_turned(part, robot)
    best, odds = _best_senses(part, robot, loaded[~elsewhere[loaded]].tolist())
    sag = _largest_sag(part, best)
    remarks = []
    for k, motor in enumerate(robot.motors):
        sense = best.motors[k].sense
        if elsewhere[k]:
            told = f"{sense:+.0f} as in the profile; the other way the tool would be elsewhere"
        elif k in odds and sag[k] < LEAST_SAG_RAD:
            told = "cannot be told, the motor does not give way"
        elif k not in odds:
            told = "cannot be told, gravity does not load it"
        elif odds[k] <= SURE_NATS:
            told = f"the logs do not tell ({odds[k]:+.1f} nats for {sense:+.0f})"
        elif sense == motor.sense:
            told = f"{sense:+.0f} as in the profile, {odds[k]:.0f} nats better than the other way"
        else:
            told = (
                f"the logs speak for {sense:+.0f} by {odds[k]:.0f} nats, the profile says "
                f"{motor.sense:+.0f}; check it"
            )
        remarks.append(f"sense of {motor.name}: {told}")
    return remarks


def _far_if_turned(part: SettlingFit, robot: Robot) -> BoolArray:
    """Return which motors, turned the other way, put the tool where it was not seen, (motor,).

    Where motors were read, or the tool's path was computed from the log, none: all turns together.
    """
    seen, motors = part.observations[part.fitted], range(len(robot.motors))

    def away(other: Robot) -> FloatArray:
        return np.linalg.norm(DigitalTwin(other).path(seen.target) - seen.point, axis=-1)

    if seen.position is not None:
        return np.zeros(len(motors), dtype=bool)
    turned = np.stack([away(_with_turned(robot, k)) for k in motors])
    return np.asarray(np.median(turned, axis=-1) > ELSEWHERE * np.median(away(robot)))


def _largest_sag(part: SettlingFit, robot: Robot) -> FloatArray:
    """Return how far each motor gives way under its largest load, as fitted, (motor,) [rad]."""
    seen, arrived = part.observations[part.fitted], part.arrived[part.fitted]
    fit, n = settling_posterior(seen, robot, arrived, part.payload), len(robot.motors)
    return np.asarray(np.abs(fit.mode[n : 2 * n]) * largest_load(robot, part.payload))


def _best_senses(
    part: SettlingFit, robot: Robot, loaded: Sequence[int]
) -> tuple[Robot, dict[int, float]]:
    """Return the robot with the senses that fit best, and how much worse each other way is [nats].

    The sense that gains most is turned first: a wrong one bends the loads of the motors before it,
    and makes theirs look wrong too.
    """
    best, posterior = robot, part.fit.log_posterior
    while True:
        turned = {k: _refit(part, _with_turned(best, k), part.payload) for k in loaded}
        k = max(turned, key=lambda motor: turned[motor], default=None)
        if k is None or turned[k] - posterior <= SURE_NATS:
            return best, {motor: posterior - other for motor, other in turned.items()}
        best, posterior = _with_turned(best, k), turned[k]


def _with_turned(robot: Robot, index: int) -> Robot:
    motors = tuple(
        replace(motor, sense=-motor.sense) if k == index else motor
        for k, motor in enumerate(robot.motors)
    )
    return replace(robot, profile=replace(robot.profile, motors=motors))


def best_payload(part: SettlingFit, robot: Robot) -> tuple[float, str]:
    """Return the payload that the logs speak for [kg] and a sentence about it.

    Compliance can take up most of what a payload does, so it is 0 unless the logs are sure.
    """
    sag = np.abs(np.asarray(part.settling.compliance) * largest_load(robot, 0.0))
    if sag.max() < LEAST_SAG_RAD:
        return 0.0, "payload: the motors do not give way, so none can be told"
    gain = np.array([_refit(part, robot, kg) for kg in PAYLOADS_KG]) - part.fit.log_posterior
    best = int(np.argmax(gain))
    if gain[best] > SURE_NATS:
        kg = PAYLOADS_KG[best]
        return kg, f"payload: about {kg:g} kg at the tool point, {gain[best]:.0f} nats over none"
    return 0.0, (
        "payload: the logs do not tell one from a softer motor "
        f"(best {PAYLOADS_KG[best]:g} kg, {gain[best]:+.1f} nats against none); weigh it, or run "
        "the same movements with and without it"
    )


def _refit(part: SettlingFit, robot: Robot, payload: float) -> float:
    """Return the log posterior of another description on the very same movements."""
    seen, arrived = part.observations[part.fitted], part.arrived[part.fitted]
    return settling_posterior(seen, robot, arrived, payload).log_posterior
