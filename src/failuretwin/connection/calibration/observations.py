"""What healthy logs say of the motors: where each movement settled, by readings or by the tool."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import gammaln, stdtr

from failuretwin.core.numerics import log_student
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, largest_load
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.evidence import SettledEvidence, settled_evidence

if TYPE_CHECKING:
    import xarray as xr

STAYED_RAD = 0.035
"""A motor nearer than this to where it was [rad], about eight counts, may have lost its command."""
TRAVEL_RAD = 0.105
"""Travel below which a lost command cannot be told from a bad one [rad], 25 counts."""

FAR_OFF_M = 0.015
"""A tool nearer than this to where it is expected [m] gives no reason to think of lost commands."""


@dataclass(frozen=True)
class Observations:
    """Settled movements of many runs in a row, padding left out.

    Attributes:
        run: Index of the run, (movement,).
        session: Index of the session, (movement,).
        number: Number of the movement within its run, from 0, (movement,).
        origin: Angles that the motors were last told to go to, and went, (movement, motor) [rad].
        target: Commanded angles, (movement, motor) [rad].
        point: Settled tool position, (movement, axis) [m].
        position: Settled angles by the motors' readings, (movement, motor) [rad]; None where the
            log has none.
        sessions: Names of the sessions.
        runs: Names of the runs.
    """

    run: IntArray
    session: IntArray
    number: IntArray
    origin: FloatArray
    target: FloatArray
    point: FloatArray
    position: FloatArray | None
    sessions: tuple[str, ...]
    runs: tuple[str, ...]

    def __getitem__(self, kept: BoolArray | IntArray) -> Observations:
        """Return some of the movements."""
        named = {f.name: getattr(self, f.name) for f in fields(self)}
        each: dict[str, Any] = {n: v[kept] for n, v in named.items() if isinstance(v, np.ndarray)}
        return replace(self, **each)

    def __len__(self) -> int:
        """Return the number of movements."""
        return len(self.run)

    @property
    def direction(self) -> FloatArray:
        """Sign of the commanded travel, (movement, motor)."""
        return np.sign(self.target - self.origin)


def session_names(runs: xr.Dataset) -> list[str]:
    """Return the session of each run: its name without the last part, or its own name."""
    names = [str(name) for name in runs["run"].values]
    return [name.rpartition("/")[0] or name for name in names]


def observe(runs: xr.Dataset, *, use_readings: bool = True) -> Observations:
    """Return where the movements of a run set settled.

    Args:
        runs: Healthy runs.
        use_readings: Whether to look at the motors' own readings, where the runs have them.
    """
    evidence = settled_evidence(runs)
    movements = evidence.movements
    names = session_names(runs)
    sessions = tuple(dict.fromkeys(names))
    run, number = np.nonzero(evidence.usable)
    position = None
    if use_readings and "position" in runs:
        position = _settled_position(runs, evidence, run, number)
    found = Observations(
        run=run,
        session=np.array([sessions.index(name) for name in names])[run],
        number=number,
        origin=movements.origin()[run, number],
        target=movements.target[run, number],
        point=evidence.point[run, number],
        position=position,
        sessions=sessions,
        runs=tuple(str(name) for name in runs["run"].values),
    )
    if position is None:
        return found
    return found[np.asarray(np.isfinite(position).all(axis=1))]


def _settled_position(
    runs: xr.Dataset, evidence: SettledEvidence, run: IntArray, number: IntArray
) -> FloatArray:
    """Return the median of the readings over the same windows, (movement, motor) [rad]."""
    time = as_floats(runs["time"].values)
    position = as_floats(runs["position"].values)
    begin, end = evidence.begin[run, number], evidence.end[run, number]
    first, stop = np.searchsorted(time, begin), np.searchsorted(time, end - 1e-9)
    settled = np.full((len(run), position.shape[2]), np.nan)
    for i, at in enumerate(run):
        window = position[at, first[i] : stop[i]]
        seen = np.isfinite(window).any(axis=0)
        settled[i, seen] = np.nanmedian(window[:, seen], axis=0)
    return settled


def has_known_origin(observations: Observations) -> BoolArray:
    """Return which movements follow one that was seen, or begin a run, (movement,).

    After an unseen movement it is not known where a motor came from.
    """
    run, number = observations.run, observations.number
    seen = number == 0
    seen[1:] |= (run[1:] == run[:-1]) & (number[1:] == number[:-1] + 1)
    return np.asarray(seen)


def without_lost(observations: Observations, lost: BoolArray) -> Observations:
    """Return the observations with the origins of motors that had missed the command before.

    Args:
        observations: Settled movements with the commanded origins, in order.
        lost: Motors that did not get their command, (movement, motor).
    """
    origin = observations.origin.copy()
    for i in range(1, len(origin)):
        follows = observations.run[i] == observations.run[i - 1]
        if follows and observations.number[i] == observations.number[i - 1] + 1:
            origin[i] = np.where(lost[i - 1], origin[i - 1], origin[i])
    return replace(observations, origin=origin)


def lost_command(observations: Observations, robot: Robot, expected: FloatArray) -> BoolArray:
    """Return which motors stayed where they were although told to move, (movement, motor).

    With readings each motor is looked at by itself; with the tool path alone, a set of motors
    stayed if the tool is nearer to where it would then be than to anything else.

    Args:
        observations: Settled movements.
        robot: The robot.
        expected: Angles at which motors settle if their commands arrive, (movement, motor) [rad].
    """
    travel = np.abs(observations.target - observations.origin) > TRAVEL_RAD
    if observations.position is not None:
        near = np.abs(observations.position - observations.origin) < STAYED_RAD
        return near & travel
    twin, motors = DigitalTwin(robot), expected.shape[1]
    sets = [np.zeros(motors, dtype=bool)]
    sets += [np.arange(motors) == motor for motor in range(motors)]
    sets += [np.arange(motors) < count for count in range(2, motors + 1)]
    away = np.stack(
        [
            np.linalg.norm(
                twin.path(np.where(held, observations.origin, expected)) - observations.point,
                axis=-1,
            )
            for held in sets
        ]
    )
    best = np.argmin(away, axis=0)
    clear = (away[0] > FAR_OFF_M) & (away.min(axis=0) < 0.5 * away[0])
    return np.stack(sets)[np.where(clear, best, 0)] & travel


# How probable settled errors are: a linear model with the scatter of a Student t.

ROUNDING = float(1.0 / np.sqrt(12.0))
"""Standard deviation of what whole numbers round off."""
LEAST_SCATTER_RAD = 1e-5
"""Scatter assumed of motors that are said to have none [rad]; no reading is as fine."""
LEAST_DOF = 1.0
"""Degrees of freedom below which tails grow no heavier: where every error is far smaller than what
counts round off, ever heavier tails would fit ever better."""


@dataclass(frozen=True)
class SettlingRegression:
    """Settled errors, linear in bias, compliance and friction, with the scatter of a Student t.

    error = bias + compliance * torque - friction * direction + scatter of each motor; where the
    tool alone was seen, the Jacobian times that.

    Attributes:
        error: Settled minus commanded: angles (movement, motor) [rad] or tool (movement, axis) [m].
        design: Factor of bias, compliance and friction, (3, movement, motor).
        jacobian: Tool position by angle, (movement, axis, motor); None where angles were read.
        count: Step that motors are read in [rad]; 0: read as they are.
        arrived: How probable it is that each command arrived, (movement, motor): a reading counts
            by so much.
    """

    error: FloatArray
    design: FloatArray
    jacobian: FloatArray | None
    count: float
    arrived: FloatArray

    @classmethod
    def of(
        cls, observations: Observations, robot: Robot, arrived: FloatArray, settling: Settling
    ) -> SettlingRegression:
        """Return the regression of settled movements.

        Args:
            observations: Settled movements.
            robot: The robot.
            arrived: How probable it is that each motor got its command, (movement, motor).
            settling: Where motors settle as far as is known: where the tool alone was seen, the
                model is made linear there. Its payload is in the torques.
        """
        twin, direction = DigitalTwin(robot), observations.direction
        base = np.where(arrived > 0, observations.target, observations.origin)
        jacobian = None
        if observations.position is not None:
            pose, error = observations.position, observations.position - observations.target
        else:
            pose = base + settling.offset(robot, base, direction)
            point, jacobian = twin.path_and_jacobian(pose)
            error = observations.point - point + np.einsum("iak,ik->ia", jacobian, pose - base)
        torque = robot.sense * robot.loads.torque(pose * robot.sense, settling.payload)
        design = np.stack([np.ones_like(torque), torque, -direction])
        return cls(error, design, jacobian, count_of(robot), arrived)

    def whitened(self, settling: Settling, noise: float) -> tuple[FloatArray, FloatArray]:
        """Return errors and their slopes by bias and compliance in units of the scatter.

        Friction is taken off. What scatters together as one Student t is a group: the three axes
        of a tool position, or the reading of one motor.

        Args:
            settling: Friction and scatter.
            noise: Of the tool sensor [m].

        Returns:
            Errors, (movement, group, axis), and slopes, (movement, group, axis, 2 motor).
        """
        bias, torque, against = self.design
        friction = against * np.asarray(settling.friction)
        if self.jacobian is None:
            scale = np.hypot(settling.scatter, self.count * ROUNDING)
            scale = np.maximum(scale, LEAST_SCATTER_RAD)
            unit = np.eye(len(scale)) / scale[:, None]
            slope = np.concatenate([unit * bias[:, None], unit * torque[:, None]], axis=2)
            return ((self.error - friction) / scale)[..., None], slope[:, :, None]
        error = self.error - np.einsum("iak,ik->ia", self.jacobian, friction)
        slope = np.concatenate([self.jacobian, self.jacobian * torque[:, None]], axis=2)
        scaled = self.jacobian * np.asarray(settling.scatter)
        spread = np.einsum("iak,ibk->iab", scaled, scaled) + noise**2 * np.eye(3)
        both = np.concatenate([error[..., None], slope], axis=2)
        white = np.linalg.solve(np.linalg.cholesky(spread), both)
        return white[:, None, :, 0], white[:, None, :, 1:]

    def log_likelihood(self, parameters: FloatArray) -> float:
        """Return the log likelihood of parameters as in `SettlingPosterior.mode`.

        With the tool path alone, the logarithm of the tool sensor's noise [m] comes after them.
        """
        motors = self.design.shape[2]
        grouped = parameters[: 4 * motors].reshape(4, -1)
        linear, log_scatter = grouped[:3], grouped[3]
        dof = max(float(np.exp(parameters[4 * motors])), LEAST_DOF)
        expected = np.einsum("pik,pk->ik", self.design, linear)
        scatter = np.exp(log_scatter)
        if self.jacobian is None:
            density = log_rounded_student(self.error - expected, scatter, self.count, dof)
            return float(np.sum(density * self.arrived))
        scale = np.hypot(scatter, self.count * ROUNDING)
        moved = np.einsum("iak,ik->ia", self.jacobian, expected)
        noise = float(np.exp(2.0 * parameters[-1]))
        return float(np.sum(log_student(self.error - moved, self.jacobian * scale, noise, dof)))


def log_rounded_student(
    error: FloatArray, scale: FloatArray, count: float, dof: float
) -> FloatArray:
    """Return log densities of Student t errors that are read in whole counts.

    A reading stands for all angles within half a count, so its probability is that of all of them
    together. To widen the scale by the variance of rounding instead makes tails look lighter and
    scatter smaller than they are.

    Args:
        error: Deviations, (..., motor) [rad].
        scale: Scale of each motor, (motor,) [rad].
        count: Step of the readings [rad]; 0: none.
        dof: Degrees of freedom.

    Returns:
        Per rad, (..., motor).
    """
    away, half = np.abs(error), 0.5 * count
    if count == 0.0:
        constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
        density = constant - np.log(scale) - 0.5 * (dof + 1) * np.log1p((away / scale) ** 2 / dof)
        return np.asarray(density)
    share = stdtr(dof, (half - away) / scale) - stdtr(dof, (-half - away) / scale)
    return np.log(np.maximum(share, np.finfo(float).tiny) / count)


def count_of(robot: Robot) -> float:
    """Return the step that the motors are read in [rad]; 0 without servo units."""
    if robot.profile.servo_units is None:
        return 0.0
    return float(abs(robot.servo_units.rad_per_count))


def rounding(robot: Robot) -> float:
    """Return the standard deviation of what whole servo counts round off [rad]."""
    return count_of(robot) * ROUNDING


# What is believed of a robot's settling before its logs are seen.

OFFSET_PRIOR_RAD = 0.03
"""Prior standard deviation of bias, friction and the largest sag [rad]: about 2 degrees."""
SCATTER_PRIOR_RAD, SCATTER_PRIOR_SPREAD = 0.007, 1.0
"""Prior median of the scatter [rad] and standard deviation of its logarithm."""
DOF_PRIOR, DOF_PRIOR_SPREAD = 5.0, 0.7
"""Prior median of the degrees of freedom and standard deviation of their logarithm."""
TOOL_NOISE_PRIOR_M, TOOL_NOISE_PRIOR_SPREAD = 0.0005, 1.0
"""Prior median of a tool sensor's own noise [m] and standard deviation of its logarithm."""


@dataclass(frozen=True)
class SettlingPrior:
    """Independent normal priors: mean and standard deviation of each parameter."""

    mean: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, robot: Robot, payload: float, of_motors: bool) -> SettlingPrior:
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
        """Return the log density of parameters, but for a constant."""
        return -0.5 * float(np.sum(((parameters - self.mean) / self.deviation) ** 2))
