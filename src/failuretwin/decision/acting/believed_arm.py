"""The arm as it is believed to be: where commands bring it, and which command brings it where.

    pose = settle(command) = healthy settling + what the fault adds
    command = settle^-1(pose)

The fault itself says where it makes its motor settle (`FaultMode.settled_offset`); a motor that is
held, or that rests, stays where it is whatever it is told.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Fault
from failuretwin.core.numerics import Ellipsoid, log_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.inverse_kinematics import usable_limits
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import sag
from failuretwin.failure_behavior.fault import Arrival
from failuretwin.failure_behavior.mode import FaultMode, Reaction, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import size_words
from failuretwin.inference.observation.healthy_model import HealthyModel

UNMOVED_RAD = 1e-9
"""Commands nearer than this are the same [rad]."""
NEWTON_STEPS = 5
GAIN_STEP_RAD = 0.01
"""Step by which it is asked how far the faulty motor follows its command [rad]."""
CLOSE_RAD = 5e-4
"""A command is near enough once it changes by no more; the next change is a tenth of it [rad]."""
LEAST_GAIN = 0.1
"""A motor that follows less than this share of its command is not inverted any further."""
OUTLIER_RATE = 1e-3
"""Share of movements after which the tool is anywhere, in what movements say of an arm [-]."""
WAY = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Places on its way at which a motor that has stuck may stand, as shares of the way."""
HALF_90 = 1.645
"""Half of a 90 % interval in standard deviations."""
LEAST_LOSS_RATE = 0.01
"""Smallest drop rate of commands that is assumed [-]."""
MOVED_RAD = 0.02
"""Smallest commanded movement whose loss can be seen [rad]."""
SURPRISE_NATS = 2.0
"""Evidence for a dropped command, in addition to its rate, from which it is sent again [nats]."""
PROBE_RAD = 0.15
"""Movement of a held motor that tests whether it was repaired [rad]."""


@dataclass(frozen=True)
class Seen:
    """One movement as it was ordered, and where the tool came to rest.

    Attributes:
        command: What the motors were told, (motor,) [rad].
        previous: What they had been told before, (motor,) [rad].
        duration: Time that they were given, (motor,) [s].
        start_s: When it was ordered, by the robot's clock [s].
        rest_s: When the tool was seen at rest [s].
        point: Where, (3,) [m]; None: it was not seen at rest.
    """

    command: FloatArray
    previous: FloatArray
    duration: FloatArray
    start_s: float
    rest_s: float
    point: FloatArray | None


@dataclass(frozen=True)
class BelievedFault:
    """One fault that an arm is taken to have.

    Attributes:
        fault: Motor and mode.
        motor: Index of the motor.
        size: In the mode's unit; NaN where it has none.
        spread: Half of the 90 % interval of the size, or of the angle of a motor at rest.
        since_s: When it began [s].
        angle: Where the motor stands if it is held or rests [rad]; NaN: not known, or it moves.
        probability: When it was taken up.
    """

    fault: Fault
    motor: int
    size: float = np.nan
    spread: float = 0.0
    since_s: float = 0.0
    angle: float = np.nan
    probability: float = 1.0

    @property
    def mode(self) -> FaultMode:
        """Its mode."""
        return MODES[self.fault.mode]

    @property
    def reaction(self) -> Reaction:
        """What is done about it."""
        return self.mode.reaction

    @property
    def likely_size(self) -> float:
        """Its size, or the middle of those that diagnosis considers where it is not known."""
        return self.size if np.isfinite(self.size) else 0.5 * sum(self.mode.considered)

    @property
    def obeys(self) -> bool:
        """Whether the motor goes where it is told, now and then too late: it is parked by that."""
        return self.mode.signature is Signature.MISSED

    @property
    def set_aside(self) -> bool:
        """Whether plans leave the motor where it is: it rests, or was parked."""
        at_rest = self.reaction in (Reaction.LOCK, Reaction.PARK)
        return at_rest and bool(np.isfinite(self.angle))

    @property
    def rests(self) -> bool:
        """Whether the motor stays where it is: held, or at rest and told nothing new."""
        return self.set_aside and not self.obeys

    @property
    def inverted(self) -> bool:
        """Whether a known offset is taken off its commands."""
        offset = self.mode.signature in (Signature.OFFSET, Signature.GROWING_OFFSET)
        return offset and not self.set_aside and bool(np.isfinite(self.size))

    def in_words(self, robot: Robot) -> str:
        """Return the fault and what is done about it, in words."""
        unit = robot.own_unit(self.fault.motor, self.mode.unit)
        size = size_words(self.fault, self.size, unit) if np.isfinite(self.size) else ""
        return f"{self.mode.plain_name(self.fault.motor)}{size}: {self.reaction.value}"

    def age_s(self, time_s: FloatArray | float) -> FloatArray:
        """Return the time since the fault began [s], 0 before."""
        return np.maximum(np.asarray(time_s) - self.since_s, 0.0)


@dataclass(frozen=True)
class BelievedArm:
    """A robot with at most one fault.

    Attributes:
        model: The robot without it.
        fault: The fault; None: healthy.
    """

    model: HealthyModel
    fault: BelievedFault | None = None

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.model.twin.robot

    @cached_property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest command of each motor, (motor,) [rad]."""
        return usable_limits(self.robot)

    @cached_property
    def held(self) -> BoolArray:
        """Motors that stay where they are, whatever they are told, (motor,)."""
        return self._marked(self.fault is not None and self.fault.rests)

    @cached_property
    def locked(self) -> BoolArray:
        """Motors that plans leave where they are: held, or parked, (motor,)."""
        return self._marked(self.fault is not None and self.fault.set_aside)

    def _marked(self, faulty: bool) -> BoolArray:
        mask = np.zeros(len(self.robot.motors), dtype=bool)
        if self.fault is not None:
            mask[self.fault.motor] = faulty
        return mask

    def settle(
        self, command: FloatArray, previous: FloatArray, time_s: FloatArray | float
    ) -> FloatArray:
        """Return the poses that commands lead to, (..., motor) [rad].

        Commands and those before them are (..., motor) [rad]; times of arrival, (...) [s], count
        for faults that grow.
        """
        travel = command - previous
        direction = np.where(np.abs(travel) > UNMOVED_RAD, np.sign(travel), 0.0)
        fault, base = self.fault, command
        if fault is not None and fault.rests:
            base = np.where(self.held, fault.angle, command)
        pose = self.model.settle(base, direction, self.held)
        if fault is None or not fault.inverted:
            return pose
        k, load = fault.motor, np.zeros(pose.shape[:-1])
        if fault.mode.needs_compliance:
            settling = self.model.settling
            give = np.asarray(settling.compliance)
            load = sag(self.robot, pose, give, settling.payload)[..., k]
        told = (previous[..., k], command[..., k], direction[..., k], fault.age_s(time_s), load)
        arrival = Arrival(*(np.asarray(each) for each in told))
        found = pose.copy()
        found[..., k] += fault.mode.settled_offset(np.array(fault.size), arrival)
        return found

    def expected(
        self, command: FloatArray, previous: FloatArray, time_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and standard deviation of where motors settle, (..., motor) [rad] each.

        A movement that the faulty motor may miss counts by its first two moments. Arguments as of
        `settle`.
        """
        pose = self.settle(command, previous, time_s)
        scatter, fault = self.scatter(command, time_s), self.fault
        if fault is not None and fault.obeys:
            k, rate = fault.motor, fault.size
            missed = previous[..., k] - command[..., k]
            pose[..., k] += rate * missed
            scatter[..., k] = np.hypot(scatter[..., k], np.sqrt(rate * (1.0 - rate)) * missed)
        return pose, scatter

    def command_for(self, pose: FloatArray, previous: FloatArray, time_s: float) -> FloatArray:
        """Return the command that leads to a pose, (motor,) [rad], within limits, in whole counts.

        A motor that is held is told to stay where it stands: if it is not held after all, it goes
        there, and the plan is still right; if it is, it does not push against its gear. The motors
        were told `previous` before, (motor,) [rad], and will arrive at `time_s` [s].
        """
        command = self._nearly(pose, previous)
        for _ in range(NEWTON_STEPS):
            settled = self.settle(command, previous, time_s)
            gain = self.gain(command, previous, time_s)
            step = np.where(self.held, 0.0, (pose - settled) / gain)
            command = command + step
            if np.abs(step).max() < CLOSE_RAD:
                break
        return self.rounded(self.with_rest(command, previous))

    def _nearly(self, pose: FloatArray, previous: FloatArray) -> FloatArray:
        """Return the command that leads to a pose without a fault, (motor,) [rad].

        What gravity does there is known, for that is where the arm shall stand.
        """
        direction = np.sign(pose - previous)
        offset = self.model.settling.offset(self.robot, pose, direction)
        return np.where(self.held, pose, pose - offset)

    def gain(self, command: FloatArray, previous: FloatArray, time_s: float) -> FloatArray:
        """Return how far each motor follows a change of its command, (motor,) [-]; see `settle`."""
        gain, fault = np.ones_like(command), self.fault
        if fault is not None and fault.inverted:
            probed = command.copy()
            probed[fault.motor] += GAIN_STEP_RAD
            moved = self.settle(probed, previous, time_s) - self.settle(command, previous, time_s)
            gain[fault.motor] = max(moved[fault.motor] / GAIN_STEP_RAD, LEAST_GAIN)
        return gain

    def with_rest(self, command: FloatArray, previous: FloatArray) -> FloatArray:
        """Return a command that leaves a motor at rest alone.

        One that is held is told to be where it stands; one that is parked is told nothing new.
        """
        fault = self.fault
        if fault is None or not fault.rests:
            return command
        left = previous[fault.motor] if fault.reaction is Reaction.PARK else fault.angle
        return np.where(self.held, left, command)

    def rounded(self, command: FloatArray) -> FloatArray:
        """Return a command as it can be sent: within limits, and in whole counts of the servos."""
        low, high = self.limits
        command = np.clip(command, low, high)
        units = self.robot.profile.servo_units
        if units is None:
            return command
        ends = np.sort(units.to_counts(np.array([low, high])), axis=0)
        least, most = np.ceil(ends[0] - 1e-9), np.floor(ends[1] + 1e-9)
        return np.asarray(units.to_rad(np.clip(np.round(units.to_counts(command)), least, most)))

    def probing(self, command: FloatArray) -> FloatArray | None:
        """Return the command with a test movement of the held motor; None: no motor is held."""
        fault = self.fault
        if fault is None or not fault.rests or fault.reaction is not Reaction.LOCK:
            return None
        k, (low, high) = fault.motor, self.limits
        inward = 1.0 if command[k] < 0.5 * (low[k] + high[k]) else -1.0
        probed = command.copy()
        probed[k] += inward * PROBE_RAD
        return self.rounded(probed)

    # What a movement says of the arm.

    def log_density(self, seen: Seen) -> float:
        """Return the log density of a settled tool position [log 1/m3]; 0 if it was not seen.

        Of a motor that misses movements it is a mixture over where it may stand,

            p(e) = sum over places of p(place) p(e | place)
        """
        fault = self.fault
        if fault is None or not fault.obeys:
            return self.log_density_arrived(seen)
        missed = fault.likely_size * sum(fault.mode.misses)
        arrived = float(log_of(1.0 - missed)) + self.log_density_arrived(seen)
        return float(np.logaddexp(arrived, self.log_density_missed(seen)))

    def log_density_missed(self, seen: Seen) -> float:
        """Return the log of p(the faulty motor has not arrived, e); it misses movements."""
        fault = self.fault
        assert fault is not None
        k, (stays, midway) = fault.motor, fault.mode.misses
        rates = np.array([stays, *np.full(len(WAY), midway / len(WAY))]) * fault.likely_size
        says = log_of(rates)
        for i, share in enumerate((0.0, *WAY)):
            command = seen.command.copy()
            command[k] = seen.previous[k] + share * (seen.command[k] - seen.previous[k])
            says[i] += self.log_density_arrived(replace(seen, command=command))
        return float(np.logaddexp.reduce(says))

    def log_density_arrived(self, seen: Seen) -> float:
        """Return the log density of a settled tool position if every motor has arrived."""
        if seen.point is None:
            return 0.0
        pose = self.settle(seen.command, seen.previous, seen.rest_s)
        error, _, spread = self.model.residual(
            seen.point, pose, self.scatter(seen.command, seen.rest_s)
        )
        found = float(spread.log_student(error, self.model.settling.tail_dof))
        sure, odd = np.log1p(-OUTLIER_RATE), np.log(OUTLIER_RATE)
        return float(np.logaddexp(sure + found, odd + self.model.anywhere_log_density))

    def scatter(self, command: FloatArray, time_s: FloatArray | float) -> FloatArray:
        """Return the standard deviation of each motor around `settle`, (..., motor) [rad]."""
        scatter, fault = np.broadcast_to(self.model.scatter, command.shape).copy(), self.fault
        if fault is None:
            return scatter
        k, mode = fault.motor, fault.mode
        if fault.rests:
            scatter[..., k] = np.hypot(fault.spread / HALF_90, self.model.held_scatter[k])
        elif mode.signature is Signature.REDRAWN_OFFSET:
            scatter[..., k] = np.hypot(scatter[..., k], fault.likely_size)
        elif fault.inverted:
            per_unit = {"rad": np.ones(()), "rad/s": fault.age_s(time_s)}
            angle = fault.spread / HALF_90 * per_unit.get(mode.unit, np.abs(command[..., k]))
            scatter[..., k] = np.hypot(scatter[..., k], angle)
        return scatter

    def most_probable_pose(self, seen: Seen) -> FloatArray:
        """Return the pose that explains best where the tool was seen, (motor,) [rad]."""
        expected = self.settle(seen.command, seen.previous, seen.rest_s)
        if seen.point is None:
            return expected
        scatter, pose = self.scatter(seen.command, seen.rest_s), expected
        for _ in range(3):
            error, jacobian, _ = self.model.residual(seen.point, pose, scatter)
            spread = Ellipsoid.of(jacobian * scatter, self.model.path_noise**2)
            pull = spread.solve(error + jacobian @ (pose - expected))
            pose = expected + scatter**2 * (jacobian.T @ pull)
        return np.asarray(pose)

    def lost_command(self, seen: Seen) -> list[int]:
        """Return the motors that seem to have missed their command; empty: none.

            log p(e | lost) + log rate > log p(e | arrived) + 2

        A held motor does not count: it is not expected to move. A motor that sticks now and then
        may also stand on its way.
        """
        arrived, best, lost = self.log_density_arrived(seen), -np.inf, list[int]()
        moved = np.abs(seen.command - seen.previous) > MOVED_RAD
        for motors, rate in self._loss_sets():
            if not moved[motors].any() or (len(motors) == 1 and self.held[motors].any()):
                continue
            command = seen.command.copy()
            command[motors] = seen.previous[motors]
            says = self.log_density_arrived(replace(seen, command=command)) + np.log(rate)
            if says > best:
                best, lost = says, motors
        fault = self.fault
        if fault is not None and fault.obeys and moved[fault.motor]:
            says = self.log_density_missed(seen)
            if says > best:
                best, lost = says, [fault.motor]
        return lost if best > arrived + SURPRISE_NATS else []

    def _loss_sets(self) -> list[tuple[list[int], float]]:
        """Return the sets of motors that may miss a command together, with their rates."""
        names = self.robot.motor_names
        found: dict[tuple[int, ...], float] = {(k,): LEAST_LOSS_RATE for k in range(len(names))}
        found[tuple(range(len(names)))] = LEAST_LOSS_RATE
        for entry in self.model.imperfections.lost_commands:
            motors = tuple(names.index(motor) for motor in entry.motors)
            found[motors] = max(entry.rate, LEAST_LOSS_RATE)
        return [(list(motors), rate) for motors, rate in found.items()]
