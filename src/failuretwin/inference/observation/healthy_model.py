"""Where a robot without a fault settles, and how surely.

    angle = base + b + c g - f d,    r_m = e_m - path(angle),    S = J diag(s^2) J^T + sn^2 I

with bias b, compliance c, load torque g, friction f, direction d, residual r_m [m] and its
covariance S [m2]. The base is the target, or where a lost command has left the motor.

Section: docs/inference.md#healthy-robot
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from failuretwin.core.movements import Movements, Stretches
from failuretwin.core.numerics import Covariance, log_sum
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray
from failuretwin.digital_model.arm_classes import class_of
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike, calibrated
from failuretwin.digital_model.nonidealities import Imperfections, Timing
from failuretwin.digital_model.settling import Settling, loads_in_range, poses_in_range
from failuretwin.digital_model.twin import SAG_ROUNDS, DigitalTwin
from failuretwin.inference.observation.command_loss import (
    OUTLIER_RATE,
    CommandOutcomes,
    LostCommands,
    Standing,
)
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.sensors import TOOL_ALONE, SensorStack
from failuretwin.inference.observation.settings import InferenceSettings
from failuretwin.inference.observation.start_delay import PUNCTUAL_SPREAD_S, StartDelay

PATH_NOISE_M = 0.001
"""Noise assumed of a settled tool position where the sensor is not known [m]."""
UNMEASURED_OF_REACH = 0.001
"""Noise assumed of a settled tool position of an arm that nobody has calibrated, as a share of its
reach: links that differ from the drawing, and the sensor. Of two industrial arms links alone leave
0.0008 of it."""
HELD_PLAY_RAD = 0.003
"""What the gear of a held motor gives by under changing loads, 0.17 deg: it is not held better than
its healthy neighbours scatter, however exact these are; assumed."""
LAG_S, KNOWN_LAG_S = (0.03, 0.02), (0.015, 0.015)
"""Deviations of the lag of all motors together, with the clock, and of each of them, of a robot
whose timing nobody has measured and of one that is calibrated [s]; assumed."""
LEAST_VISIBLE_POSES = 200
"""Poses at which it is asked how small an angle shows."""


@dataclass(frozen=True)
class Explanation(ArrayStruct):
    """How well each outcome explains settled positions, and with which pose.

    Attributes:
        density: Log density of each position if no motor is faulty, (run, movement, outcome)
            [log 1/m3].
        poses: The pose, scattered so as to meet the position, (run, movement, outcome, motor)
            [rad].
    """

    density: Annotated[FloatArray, Axes("run", "movement", "outcome")]
    poses: Annotated[FloatArray, Axes("run", "movement", "outcome", "motor")]


@dataclass(frozen=True)
class HealthyModel:
    """Distribution of settled tool positions of the healthy robot.

    Attributes:
        twin: Kinematics.
        imperfections: Offsets, scatter and rates of lost commands.
        scatter_factor: Factor on all scatter and noise; 1 for a robot as it is.
        noise_factor: Factor on the noise of the sensor that is assumed or known.
        untold_noise_m: Noise of the sensor beside that [m].
        sensing: Names of the sensors that are believed.
    """

    twin: DigitalTwin
    imperfections: Imperfections
    scatter_factor: float = 1.0
    noise_factor: float = 1.0
    untold_noise_m: float = 0.0
    sensing: tuple[str, ...] = TOOL_ALONE

    @classmethod
    def of(cls, twin: RobotLike, imperfections: HealthyLike = None) -> HealthyModel:
        """Return the model of a robot; None: of the calibration that its profile names."""
        known = calibrated(twin, imperfections)
        return cls(known.twin, known.imperfections)

    def seen_by(self, sensing: tuple[str, ...]) -> HealthyModel:
        """Return the same with other sensors believed."""
        return self if sensing == self.sensing else replace(self, sensing=sensing)

    @cached_property
    def settings(self) -> InferenceSettings:
        """Lengths and angles by which runs of this robot are read."""
        return InferenceSettings.of(self.twin.robot, self.imperfections)

    @cached_property
    def sensors(self) -> SensorStack:
        """The sensors that are believed, as one."""
        known, rough = self._known_noise, self.settings.path_roughness_m
        return SensorStack.of(self.sensing, self.twin, self.imperfections, known, rough)

    @cached_property
    def motor_names(self) -> list[str]:
        """Names of the motors in chain order."""
        return self.twin.robot.motor_names

    @cached_property
    def settling(self) -> Settling:
        """Settled offsets; of ideal motors where the imperfections have none."""
        return self.imperfections.settling or Settling.ideal(len(self.twin.robot.motors))

    @cached_property
    def without_doubt(self) -> HealthyModel:
        """The same with offsets that are known: what is doubted of them does not scatter."""
        doubt = self.imperfections.variation
        if doubt is None:
            return self
        sharp = replace(doubt, bias=(), compliance=(), friction=())
        return replace(self, imperfections=replace(self.imperfections, variation=sharp))

    @cached_property
    def scatter(self) -> FloatArray:
        """Scale of the settled scatter and of what is not known of the robot, (motor,) [rad]."""
        return self.scatter_factor * self._sharp_scatter

    @cached_property
    def held_scatter(self) -> FloatArray:
        """Scale by which a held motor gives, where healthy ones scatter less, (motor,) [rad].

        h^2 = max(0, play^2 - s^2); none of a robot that is said to be ideal, nor of a slide.
        """
        if self.imperfections.settling is None:
            return np.zeros(len(self.scatter))
        more = np.sqrt(np.maximum(HELD_PLAY_RAD**2 - self.scatter**2, 0.0))
        return np.where(self.twin.robot.slides, 0.0, more)

    @property
    def _sharp_scatter(self) -> FloatArray:
        scatter, doubt = np.asarray(self.settling.scatter), self.imperfections.variation
        if doubt is None:
            return np.hypot(scatter, self._rounding)
        robot, settling = self.twin.robot, self.settling
        load = np.sqrt(np.mean(loads_in_range(robot, settling.payload) ** 2, axis=0))
        variance = scatter**2 * np.exp(2.0 * _spread(doubt.scatter) ** 2) + self._rounding**2
        variance = variance + _spread(doubt.bias) ** 2 + _spread(doubt.friction) ** 2
        yielding = np.asarray(settling.compliance) * load * _spread(doubt.compliance)
        return np.sqrt(variance + yielding**2)

    @property
    def _rounding(self) -> float:
        """Standard deviation of what whole servo counts round off [rad]."""
        readings = self.imperfections.readings
        if readings is None or not readings.whole_counts:
            return 0.0
        return abs(self.twin.robot.servo_units.rad_per_count) / np.sqrt(12.0)

    @property
    def count_rounding(self) -> float:
        """Standard deviation of a motor's angle about its reading in whole counts [rad].

        0 unless the tool path is computed from the readings of the motors: a motor that stands
        still then reads the same count all the time.
        """
        profile = self.twin.robot.profile
        if profile.sensor_pose != "log" or profile.servo_units is None:
            return 0.0
        return abs(profile.servo_units.rad_per_count) / np.sqrt(12.0)

    @cached_property
    def path_noise(self) -> float:
        """Noise of a settled tool position that belongs to no motor [m].

        Of an arm whose geometry is fitted, what the fit leaves less what the motors scatter.
        """
        return float(np.hypot(self.noise_factor * self._usual_noise, self.untold_noise_m))

    @property
    def noise_is_found(self) -> bool:
        """Whether runs of this very robot have told the noise of the sensor."""
        return self.is_calibrated or self.noise_factor != 1.0

    def with_noise(self, factor: float) -> HealthyModel:
        """Return the same with a factor on the noise, which stays above the least of such arms."""
        least = min(self.settings.least_noise_m / self._usual_noise, self.noise_factor)
        return replace(self, noise_factor=max(self.noise_factor * factor, least))

    @property
    def _usual_noise(self) -> float:
        return self.scatter_factor * self._known_noise

    @property
    def knows_noise(self) -> bool:
        """Whether the noise of the sensor is known: measured, or that of the motors' readings."""
        profile, known = self.twin.robot.profile, self.imperfections
        measured = profile.geometry.sensor_noise_m > 0.0 or known.readings is not None
        return measured or known.settling is None or profile.sensor_pose == "log"

    @property
    def is_calibrated(self) -> bool:
        """Whether this very robot was calibrated, or its geometry fitted."""
        fitted = self.twin.robot.profile.geometry.sensor_noise_m > 0.0
        return fitted or not self.imperfections.of_class

    @property
    def _known_noise(self) -> float:
        readings, fitted = self.imperfections.readings, self.twin.robot.profile.geometry
        if fitted.sensor_noise_m > 0.0:
            rest = np.sqrt(max(fitted.sensor_noise_m**2 - self._scatter_of_tool**2, 0.0))
        elif self.imperfections.settling is None:
            return PATH_NOISE_M
        else:  # nobody has measured the sensor, nor the links
            rest = 0.0 if readings else UNMEASURED_OF_REACH * self.twin.robot.reach
        told = 0.0 if readings is None else readings.noise_m
        return max(float(np.hypot(told, self.settings.least_noise_m)), rest)

    @property
    def _scatter_of_tool(self) -> float:
        """What the motors' settled scatter moves the tool on each axis, the median [m]."""
        robot = self.twin.robot
        _, jacobian = self.twin.path_and_jacobian(poses_in_range(robot) * robot.sense)
        moved = jacobian * np.asarray(self.settling.scatter)
        return float(np.sqrt(np.median(np.sum(moved**2, axis=(1, 2))) / 3.0))

    @cached_property
    def least_visible(self) -> FloatArray:
        """Smallest angle by which each motor can be seen to be off, (motor,) [rad or m].

        One standard deviation of what a settled position says of it, P^-1/2 with its own scatter,
        the median over poses spread over the travel.
        """
        low, high = self.twin.robot.travel.T
        poses = np.random.default_rng(0).uniform(low, high, (LEAST_VISIBLE_POSES, len(low)))
        _, jacobian = self.sensors.expected(poses)
        found = []
        for motor, own in enumerate(self.scatter):
            others = np.where(np.arange(len(self.scatter)) == motor, 0.0, self.scatter)
            spread = Covariance.of(jacobian * others, self.path_noise**2)
            lever = jacobian[..., motor]
            precision = np.maximum(spread.product(lever, lever), 1e-12)
            found.append(float(np.median(np.sqrt(1.0 / precision + own**2))))
        return np.array(found)

    @property
    def knows_timing(self) -> bool:
        """Whether it is known how late and how evenly this robot follows its commands.

        Commands alone tell late starts, but nothing of that.
        """
        known, nothing = self.imperfections.timing, Timing()
        exact = self.imperfections.settling is None
        return exact or (known.delay_s, known.lag_s) != (nothing.delay_s, nothing.lag_s)

    @cached_property
    def lag_s(self) -> float:
        """Mean lag of the motion behind the command [s]: servo loops, dead time, first-order lag.

        A loop follows a ramp one over its integral gain late.
        """
        timing = self.imperfections.timing
        loops = [1.0 / motor.loop.I for motor in self.twin.robot.motors]
        return float(np.mean(loops) + np.mean(timing.delay_s) + np.mean(timing.lag_s))

    @property
    def start_jitter_s(self) -> float:
        """Deviation of when a motor starts about its own lag [s]."""
        usual = class_of(self.twin.robot).start_jitter_s
        return min(PUNCTUAL_SPREAD_S, usual) if self._timing_measured else usual

    @property
    def lag_deviations_s(self) -> tuple[float, float]:
        """Deviations of the lag of all motors together, with the clock, and of each [s]."""
        return KNOWN_LAG_S if self._timing_measured else LAG_S

    @property
    def _timing_measured(self) -> bool:
        """Whether that is known of this very robot; figures of a class are ranges of many."""
        return self.knows_timing and self.is_calibrated

    def scatter_at(self, stretches: Stretches) -> FloatArray:
        """Return the scale of each motor's scatter on the way, its lag unknown, (..., motor) [rad].

        Args:
            stretches: The movements.
        """
        late = np.hypot(self.start_jitter_s, np.hypot(*self.lag_deviations_s))
        return np.hypot(np.hypot(self.scatter, late * stretches.speed), stretches.bend)

    @cached_property
    def start_delay(self) -> StartDelay:
        """How long after its command a movement begins."""
        return StartDelay.of(self.lag_s, self.imperfections.timing.late_s)

    @cached_property
    def shortening(self) -> float:
        """Mean share by which ramps end early [-]."""
        return float(np.mean(self.imperfections.timing.ramp_shortening))

    @cached_property
    def none_held(self) -> BoolArray:
        """The mask that holds no motor, (motor,)."""
        return np.zeros(len(self.scatter), dtype=bool)

    @cached_property
    def anywhere_log_density(self) -> float:
        """Log density of what is seen of an arm that may stand anyhow [log 1/m^dims]."""
        return self.sensors.log_anywhere(self.path_noise)

    @cached_property
    def outlier_log_density(self) -> float:
        """Log of the outlier rate times the density of "anywhere" [log 1/m^dims]."""
        return float(np.log(OUTLIER_RATE) + self.anywhere_log_density)

    @cached_property
    def lost_commands(self) -> LostCommands:
        """Which commands get lost, and how often."""
        return LostCommands(self.twin.robot, self.imperfections)

    def outcomes(self, movements: Movements, standing: Standing | None = None) -> CommandOutcomes:
        """Return what may become of each movement; see `LostCommands.outcomes`."""
        return self.lost_commands.outcomes(movements, standing)

    def filtered_outcomes(
        self,
        evidence: SettledEvidence,
        outcomes: CommandOutcomes,
        density: FloatArray,
        times: float = 1.0,
    ) -> CommandOutcomes:
        """Return outcomes with their probability given what was seen of the movements before.

        Args:
            evidence: Settled positions.
            outcomes: What may have become of each movement, whatever was seen.
            density: How well each explains the settled positions, from `explain`.
            times: How many times as often as usual commands get lost.
        """
        says = np.logaddexp(np.log1p(-OUTLIER_RATE) + density, self.outlier_log_density)
        says = np.where(evidence.usable[..., None], says, 0.0)
        late = self.late(evidence.movements, evidence.first_reading_delay)
        return self.lost_commands.filtered_outcomes(outcomes, late, says, evidence.arrived, times)

    def late(
        self, movements: Movements, first_reading_delay: FloatArray | None = None
    ) -> FloatArray:
        """Return the probability that each movement started late; see `LostCommands.late`."""
        return self.lost_commands.late(movements, first_reading_delay)

    def settle(self, base: FloatArray, direction: FloatArray, held: BoolArray) -> FloatArray:
        """Return the angles at which the motors settle, (..., motor) [rad].

        Args:
            base: Angles that they go for, (..., motor) [rad].
            direction: Sign of their last travel, (..., motor).
            held: Motors that stay exactly at `base`, (motor,).
        """
        robot = self.twin.robot
        near = base
        for _ in range(SAG_ROUNDS):
            offset = self.settling.offset(robot, near, direction)
            near = base + np.where(held, 0.0, offset)
        return near

    def residual(
        self, point: FloatArray, pose: FloatArray, scale: FloatArray
    ) -> tuple[FloatArray, FloatArray, Covariance]:
        """Return what the sensors say of poses: all that a settled position is weighed by.

        Linear in the scatter of the motors, r = J dq + noise with J the Jacobian of the channels.

        Args:
            point: Settled positions, (..., channel) [m].
            pose: Angles at which the motors settle, (..., motor) [rad].
            scale: Scale of their scatter, (..., motor) [rad]; 0: held.

        Returns:
            The residual r, seen minus expected, (..., channel) [m]; J, (..., channel, motor)
            [m/rad]; and the scale matrix of r, (...) [m2].
        """
        predicted, jacobian = self.sensors.expected(pose)
        root = jacobian * scale[..., None, :]
        spread = Covariance.of(root, self.path_noise**2, self.sensors.dims)
        return point - predicted, jacobian, spread

    def outcomes_as_seen(
        self, evidence: SettledEvidence, first: Explanation | None = None
    ) -> CommandOutcomes:
        """Return what may become of each movement, by where the motors stood before it.

        Where that was is judged by a first explanation that takes them to stand as commanded.

        Args:
            evidence: Settled positions.
            first: That explanation, where it was computed before.
        """
        usual = self.outcomes(evidence.movements)
        if first is None:
            first = self.explain(evidence, usual)
        found = self.filtered_outcomes(evidence, usual, first.density)
        return self.outcomes(evidence.movements, self._standing(evidence, found, first))

    def _standing(
        self, evidence: SettledEvidence, outcomes: CommandOutcomes, found: Explanation
    ) -> Standing:
        """Return how motors stood after each movement, at its most probable outcome.

        What they settled off is their most probable scatter times the probability that the outcome
        is what happened.
        """
        usable = evidence.usable
        terms = outcomes.log_weight + np.where(usable[..., None], found.density, 0.0)
        best = np.argmax(terms, axis=-1)

        def at_best(values: FloatArray) -> FloatArray:
            return np.take_along_axis(values, best[..., None, None], axis=2)[:, :, 0]

        base, direction = at_best(outcomes.base), at_best(outcomes.direction)
        total = np.logaddexp(log_sum(terms, axis=-1), self.outlier_log_density)
        trust = np.where(usable, np.exp(terms.max(axis=-1) - total), 0.0)
        scatter = at_best(found.poses) - self.settle(base, direction, self.none_held)
        at_rest = Stretches.of(evidence.movements).at_rest  # on the way a lag looks like scatter
        trust = np.where(at_rest, trust, 0.0)
        return Standing(outcomes.lost[best], base, trust[..., None] * scatter)

    def explain(self, evidence: SettledEvidence, outcomes: CommandOutcomes) -> Explanation:
        """Return how well each outcome explains the settled positions, and with which pose.

        Args:
            evidence: Settled positions.
            outcomes: What may have become of each movement.
        """
        pose = self.settle(outcomes.base, outcomes.direction, self.none_held)
        error, jacobian, spread = self.residual(evidence.point[:, :, None], pose, self.scatter)
        density = spread.log_student(error, self.settling.tail_dof)
        return Explanation(density, pose + scattered(spread, jacobian, self.scatter, error))


def scattered(
    spread: Covariance, jacobian: FloatArray, scale: FloatArray, error: FloatArray
) -> FloatArray:
    """Return by how much motors scatter, at the most probable, to meet a settled position.

    Args:
        spread: Covariance of the position, (...).
        jacobian: Its derivative by the angles, (..., channel, motor) [m/rad].
        scale: Scatter of each motor, (motor,) [rad].
        error: Position minus expected position, (..., channel) [m].

    Returns:
        (..., motor) [rad].
    """
    pull = spread.solve(error)
    return np.asarray(scale**2 * np.einsum("...ak,...a->...k", jacobian, pull))


def _spread(deviation: tuple[float, ...]) -> FloatArray:
    """Return standard deviations as an array that fits any number of motors; none are zero."""
    return np.asarray(deviation or 0.0)
