"""Features of tokens: what each moment says of each motor; see `moment_encoder`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.observation.healthy_model import HealthyModel

MOST_OUTCOMES = 5
"""Outcomes of a movement under which a motor alone is turned: the likeliest ones."""
STEPS, LONGEST_RAD = 2, 0.3
"""Gauss-Newton steps from the nearest point of the circle, and the longest of them [rad]."""
LEAST_PRECISION = 1e-2
"""Precision of a motor that does not move the tool [1/rad2]."""
LEAST_SCATTER_RAD = 1e-4
"""Scatter of a motor beside which turns are judged, at least [rad]."""
LEAST_LOG, LARGEST_SQUARE = -20.0, 1e4
"""Log probability and squared distance of an outcome that cannot be."""
LEAST_TRAVEL_RAD = 1e-3
"""A travel below it counts as so much [rad]."""
PLAY_RAD = 0.003
"""Deviation of a held motor from one angle [rad]."""
REWEIGHED = 3
"""How often moments are weighed anew by their distance from the common angle."""
UNIT_RAD = 0.01
"""Unit of angles and deviations [rad]."""


@dataclass(frozen=True)
class MomentFeatures:
    """Moments of some runs, and what they say of all motors.

    Attributes:
        model: The healthy robot.
        moments: The moments.
    """

    model: HealthyModel
    moments: Moments

    @cached_property
    def motors(self) -> list[MotorFeatures]:
        """What the moments say of each motor."""
        return [MotorFeatures(self, motor) for motor in range(self.pose.shape[-1])]

    @property
    def outcomes(self) -> int:
        """Outcomes under which a motor is turned."""
        return min(MOST_OUTCOMES, self.moments.log_weight.shape[-1])

    @cached_property
    def pose(self) -> FloatArray:
        """Settled angles under each outcome, (run, moment, outcome, motor) [rad]."""
        moments = self.moments
        return self.model.settle(moments.base, moments.direction, self.model.none_held)

    @cached_property
    def healthy(self) -> tuple[FloatArray, FloatArray]:
        """Squared distance and log density of each outcome, (run, moment, outcome)."""
        value, jacobian = self.model.sensors.expected(self.pose)
        inverse, log_det = self._inverse(jacobian, self._variance(slice(None)))
        error = self.moments.point[:, :, None] - value
        square = np.einsum("...i,...ij,...j->...", error, inverse, error)
        return square, self.log_density(square, log_det)

    @cached_property
    def log_healthy(self) -> FloatArray:
        """Log density of each moment of a healthy robot, (run, moment); 0 where not seen."""
        return self.total(self.moments.log_weight + self.healthy[1])

    def total(self, log_density: FloatArray) -> FloatArray:
        """Return the log of a sum over outcomes and outliers, (run, moment); 0 where not seen."""
        outlier = np.full((*self.moments.usable.shape, 1), self.model.outlier_log_density)
        found = logsumexp(np.concatenate([log_density, outlier], axis=-1), axis=-1)
        return np.where(self.moments.usable, found, 0.0)

    def _variance(self, outcomes: slice) -> FloatArray:
        moments = self.moments
        moving = (moments.late + moments.bent)[:, :, outcomes]
        return np.asarray(self.model.scatter**2 + moving)

    def _inverse(self, jacobian: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return S^-1 and log det S."""
        S = (jacobian * variance[..., None, :]) @ np.swapaxes(jacobian, -1, -2)
        S = S + self.model.path_noise**2 * np.eye(S.shape[-1])
        return as_floats(np.linalg.inv(S)), as_floats(np.linalg.slogdet(S)[1])

    def log_density(self, square: FloatArray, log_det: FloatArray) -> FloatArray:
        """Return the log density of residuals by their squared distance and log det S."""
        dof, dims = self.model.settling.tail_dof, self.moments.point.shape[-1]
        return np.asarray(log_norm(dof, dims) + log_fall(square, dof, dims) - 0.5 * log_det)

    def nearest(self, motor: int) -> tuple[FloatArray, ...]:
        """Return the angle of one motor that brings the tool nearest, under each outcome.

        Angle [rad], precision [1/rad2], squared distance left and log det S, (run, moment, outcome)
        each.
        """
        pose = self.pose[:, :, : self.outcomes].copy()
        variance, point = self._variance(slice(self.outcomes)), self.moments.point[:, :, None]
        if not self.model.twin.robot.slides[motor]:
            pose[..., motor] = self._on_circle(pose, motor)
        for step in range(STEPS + 1):
            value, jacobian = self.model.sensors.expected(pose)
            inverse, log_det = self._inverse(jacobian, variance)
            lever, error = jacobian[..., motor], point - value
            pull = np.einsum("...i,...ij->...j", lever, inverse)
            P = np.einsum("...j,...j->...", pull, lever)
            if step < STEPS:
                turn = np.einsum("...j,...j->...", pull, error) / np.maximum(P, LEAST_PRECISION)
                pose[..., motor] += np.clip(turn, -LONGEST_RAD, LONGEST_RAD)
        left = np.einsum("...i,...ij,...j->...", error, inverse, error)
        return pose[..., motor], np.maximum(P, LEAST_PRECISION), left, log_det

    def _on_circle(self, pose: FloatArray, motor: int) -> FloatArray:
        """Return the angle at which the circle of the tool comes nearest to where it was seen.

        Three points give the circle, p = c + u cos(angle) + v sin(angle).
        """
        own = pose[..., motor]
        turned = own[..., None] + 2.0 * np.pi / 3.0 * np.arange(3)
        poses = np.repeat(pose[..., None, :], 3, axis=-2)
        poses[..., motor] = turned
        value = self.model.sensors.value(poses)
        centre = value.mean(axis=-2)
        u, v = (
            2.0 / 3.0 * np.sum(value * part(turned)[..., None], axis=-2)
            for part in (np.cos, np.sin)
        )
        away = self.moments.point[:, :, None] - centre
        angle = np.arctan2(np.sum(v * away, axis=-1), np.sum(u * away, axis=-1))
        middle = self.model.twin.robot.travel[motor].mean()
        angle = middle + np.mod(angle - middle + np.pi, 2.0 * np.pi) - np.pi
        flat = np.sum(u * u, axis=-1) < self.model.path_noise**2
        return np.where(flat, own, angle)

    @property
    def shared(self) -> FloatArray:
        """Return the features of a moment that belong to no motor, (run, moment, feature)."""
        moments, usable = self.moments, self.moments.usable
        before = np.cumsum(usable, axis=1)
        after: IntArray = before[:, -1:] - before
        gain = self.log_healthy - self.model.outlier_log_density
        rest = ~(moments.speed[:, :, 0] != 0.0).any(axis=-1)
        parts = [
            usable,
            0.3 * np.log1p(self.healthy[0][..., 0]) * usable,
            0.2 * gain * usable,
            0.2 * np.maximum(moments.log_weight[..., 0], LEAST_LOG) * usable,
            0.2 * (before - usable),
            0.2 * after,
            rest,
            0.1 * moments.start,
        ]
        return np.stack([np.asarray(part, dtype=np.float64) for part in parts], axis=-1)


@dataclass(frozen=True)
class MotorFeatures:
    """What the moments say of one motor, all arrays (run, moment) unless said otherwise.

    Attributes:
        whole: The moments.
        motor: Index of the motor.
    """

    whole: MomentFeatures
    motor: int

    @cached_property
    def nearest(self) -> tuple[FloatArray, ...]:
        """Angle, precision, squared distance left and log det S, (run, moment, outcome)."""
        return self.whole.nearest(self.motor)

    @cached_property
    def _free(self) -> tuple[FloatArray, FloatArray]:
        """Log weight of outcomes in which the motor gets its command, and log density there."""
        moments, count = self.whole.moments, self.whole.outcomes
        own = ~moments.lost[:, :, :count, self.motor]
        weight = np.where(own, moments.log_weight[:, :, :count], -np.inf)
        _, _, left, log_det = self.nearest
        return weight, weight + self.whole.log_density(left, log_det)

    @cached_property
    def best(self) -> IntArray:
        """The likeliest outcome if the motor is turned, (run, moment, 1)."""
        density = self._free[1]
        return np.asarray(np.argmax(np.maximum(density, -1e9), axis=-1)[..., None])

    def _at_best(self, values: FloatArray) -> FloatArray:
        return np.take_along_axis(values, self.best, axis=2)[..., 0]

    @cached_property
    def angle(self) -> FloatArray:
        """Angle that explains the moment [rad]."""
        return self._at_best(self.nearest[0])

    @cached_property
    def deviation(self) -> FloatArray:
        """Its deviation, P^-1/2 [rad]."""
        return np.asarray(np.sqrt(1.0 / self._at_best(self.nearest[1])))

    @cached_property
    def left(self) -> FloatArray:
        """Squared distance that is left."""
        return self._at_best(self.nearest[2])

    @cached_property
    def turn(self) -> FloatArray:
        """Turn from where a healthy motor settles [rad]."""
        pose = self.whole.pose[:, :, : self.whole.outcomes, self.motor]
        return self.angle - self._at_best(pose)

    @property
    def scatter(self) -> float:
        """Scatter of the motor [rad]."""
        return float(self.whole.model.scatter[self.motor])

    @cached_property
    def held(self) -> FloatArray:
        """Deviation of the angle of a motor that is held [rad]."""
        return np.sqrt(np.maximum(self.deviation**2 - self.scatter**2, 0.0) + PLAY_RAD**2)

    @property
    def goal(self) -> FloatArray:
        """Where the motor settles if its command arrives [rad]."""
        return self.whole.pose[:, :, 0, self.motor]

    @property
    def was(self) -> FloatArray:
        """Where it stood before [rad]."""
        first = self.whole.moments.origin[:, :1, self.motor]
        return np.concatenate([first, self.goal[:, :-1]], axis=1)

    @cached_property
    def log_free(self) -> FloatArray:
        """Log density of the moment with the motor at any angle."""
        return self.whole.total(self._free[1])

    @cached_property
    def common(self) -> CommonAngle:
        """One angle for all moments from each on."""
        return CommonAngle.of(self.angle, self.held, self.left, self.whole.moments.usable)

    @property
    def own_loss(self) -> tuple[FloatArray, FloatArray]:
        """Log weight and squared distance if this motor alone missed its command."""
        moments = self.whole.moments
        alone = moments.lost[..., self.motor] & (moments.lost.sum(axis=-1) == 1)
        at, there = np.argmax(alone, axis=-1)[..., None], alone.any(axis=-1)
        weight, square = (
            np.take_along_axis(values, at, axis=2)[..., 0]
            for values in (moments.log_weight, self.whole.healthy[0])
        )
        weight = np.where(there, np.maximum(weight, LEAST_LOG), LEAST_LOG)
        return weight, np.where(there, square, LARGEST_SQUARE)

    def _travelled(self, angle: FloatArray) -> FloatArray:
        """Return which share of its travel the motor has made at an angle."""
        travel = self.goal - self.was
        travel = np.where(np.abs(travel) > LEAST_TRAVEL_RAD, travel, LEAST_TRAVEL_RAD)
        return np.clip((angle - self.was) / travel, -1.0, 2.0)

    @property
    def now(self) -> list[FloatArray]:
        """Features of the moment itself."""
        angle, precision, left, _ = (values[..., 0] for values in self.nearest)
        lost, lost_square = self.own_loss
        said = np.maximum(self._at_best(self._free[0]), LEAST_LOG)
        gain = self.log_free - self.whole.log_healthy
        return [
            compressed(self.turn / self.deviation),
            compressed(self.turn / UNIT_RAD),
            np.log(self.deviation / UNIT_RAD) / 3.0,
            np.log(self.held / UNIT_RAD) / 3.0,
            0.3 * np.log1p(self.left),
            0.2 * said,
            as_floats(self.best[..., 0] > 0),
            0.3 * np.log1p(left),
            compressed((angle - self.goal) / np.sqrt(1.0 / precision)),
            0.2 * lost,
            0.3 * np.log1p(lost_square),
            compressed((self.angle - self.was) / self.held),
            self._travelled(self.angle),
            0.3 * compressed(gain),
            compressed((self.angle - self.common.angle) / self.held),
            self.angle / np.pi,
        ]

    @cached_property
    def _onward(self) -> BoolArray:
        """Moments from each on, (first moment, moment)."""
        count = np.arange(self.whole.moments.count)
        return np.asarray(count >= count[:, None])

    @property
    def held_gain(self) -> FloatArray:
        """Log density of all moments from each on at one angle, over that of a healthy robot."""
        seen = self.whole.moments.usable[:, None]
        held = self.common.log_density(self.log_free[:, None])
        held = np.where(seen, np.logaddexp(held, self.whole.model.outlier_log_density), 0.0)
        gain = np.where(self._onward, held - self.whole.log_healthy[:, None], 0.0)
        return np.asarray(gain.sum(axis=2))

    @property
    def free_gain(self) -> FloatArray:
        """The same with a turn that each moment draws anew, by Laplace's integral over it."""
        width = np.log(np.maximum(1.0 / self.deviation, 1.0))
        gain = (self.log_free - self.whole.log_healthy - width)[:, ::-1]
        return np.asarray(np.cumsum(gain, axis=1)[:, ::-1])

    @cached_property
    def _turns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean, rms, and log of the rms less scatter of the turns from each moment on."""
        weight = np.where(self.whole.moments.usable, 1.0 / (1.0 + self.left / 9.0), 0.0)
        weights = weight[:, None] * self._onward
        total = np.maximum(weights.sum(axis=2), 1e-9)
        mean, square, noise = (
            np.sum(weights * values[:, None], axis=2) / total
            for values in (self.turn, self.turn**2, self.deviation**2)
        )
        more = np.maximum(square - noise, 0.02 * square)
        return mean, np.sqrt(square), 0.5 * np.log(np.maximum(more, 1e-8))

    @property
    def since(self) -> list[FloatArray]:
        """Features of all moments from each on."""
        common, (mean, rms, log_rms) = self.common, self._turns
        return [
            compressed((self.goal - self.was) / self.held),
            compressed(self.held_gain),
            compressed(self.free_gain),
            0.3 * np.log1p(common.square),
            np.log(common.deviation / UNIT_RAD) / 3.0,
            compressed((common.angle - self.was) / np.hypot(common.deviation, 2.0 * self.scatter)),
            self._travelled(common.angle),
            compressed(mean / np.maximum(rms, 1e-6)),
            log_rms / 3.0 + 1.0,
            log_rms - np.log(max(self.scatter, LEAST_SCATTER_RAD)),
        ]

    @property
    def features(self) -> FloatArray:
        """All features, (run, moment, feature); those of the moment itself are 0 if not seen."""
        now = [np.where(self.whole.moments.usable, one, 0.0) for one in self.now]
        return np.stack([*now, *self.since], axis=-1)

    @property
    def anchor(self) -> FloatArray:
        """What sizes are told from, (run, moment, 4); see `Tokens`."""
        mean, _, log_rms = self._turns
        sign = np.where(mean < 0.0, -1.0, 1.0)
        return np.stack([self.common.angle, self.common.deviation, log_rms, sign], axis=-1)


FEATURES = 26 + 8
"""Features of a token: of its motor, and of its moment."""


def compressed(values: FloatArray) -> FloatArray:
    """Return values on a scale that is linear near 0 and logarithmic far from it."""
    return np.arcsinh(np.clip(np.nan_to_num(values), -1e6, 1e6)) / 2.0


@dataclass(frozen=True)
class CommonAngle:
    """One angle of a motor for all moments from each on.

    Attributes:
        angle: (run, moment) [rad].
        deviation: Its standard deviation, same axes [rad].
        square: Squared distance of these moments from it, robust, same axes.
        own: Squared distance of each moment, (run, first moment, moment).
    """

    angle: FloatArray
    deviation: FloatArray
    square: FloatArray
    own: FloatArray

    def log_density(self, log_free: FloatArray) -> FloatArray:
        """Return the log density of each moment at the angle, (run, first moment, moment)."""
        return log_free - 2.5 * np.log1p(self.own / 4.0)

    @classmethod
    def of(
        cls, phi: FloatArray, deviation: FloatArray, left: FloatArray, usable: BoolArray
    ) -> CommonAngle:
        """Return the angle that explains all moments from each on, outliers weighed down.

        Args:
            phi: Angle of each moment, (run, moment) [rad].
            deviation: Its deviation, same axes [rad].
            left: Squared distance that is left, same axes.
            usable: Moments that count, same axes.
        """
        count = usable.shape[1]
        counts = (np.arange(count) >= np.arange(count)[:, None]) & usable[:, None]
        base = np.where(counts, (1.0 / (deviation**2 * (1.0 + left / 9.0)))[:, None], 0.0)
        angles = np.broadcast_to(phi[:, None], counts.shape)
        angle = _weighted_median(angles, base)
        for _ in range(REWEIGHED):
            weight = base / (1.0 + ((angles - angle[..., None]) / deviation[:, None]) ** 2 / 4.0)
            total = np.maximum(weight.sum(axis=2), 1e-6)
            angle = np.where(counts.any(axis=2), np.sum(weight * angles, axis=2) / total, phi)
        own = ((angles - angle[..., None]) / deviation[:, None]) ** 2
        square = np.sum(np.where(counts, 4.0 * np.log1p(own / 4.0), 0.0), axis=2)
        return cls(angle, np.minimum(np.sqrt(1.0 / total), 3.0), square, own)


def _weighted_median(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted median over the last axis."""
    order = np.argsort(values, axis=-1)
    ranked, mass = (np.take_along_axis(v, order, axis=-1) for v in (values, weight))
    below = np.cumsum(mass, axis=-1)
    at = np.argmax(below >= 0.5 * below[..., -1:], axis=-1)[..., None]
    return np.take_along_axis(ranked, at, axis=-1)[..., 0]
