"""Input of the motor-wise network: what each moment of a run says of each motor.

A token is a moment and a motor. For each the engine's moments give the turn of this motor alone
that explains where the tool was seen, its precision and what is left,

    t = argmin r(t)^T S^-1 r(t),    P = J^T S^-1 J,    S = J diag(s^2) J^T + sn^2 I

under the likeliest outcome of the commands; what a lost command of the motor leaves; how well one
angle explains all moments from this one on; and travel and times. Angles and distances are in units
of their deviation, so that arms of any size look alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.calibrated_robot import CalibratedRobot
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.engine.moments import Moments, moments_of
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.seen_runs import SeenRuns

if TYPE_CHECKING:
    import xarray as xr

Floats = NDArray[np.float32]

MOST_OUTCOMES = 5
"""Outcomes of a movement under which a motor alone is turned: the likeliest ones."""
STEPS, LONGEST_RAD = 2, 0.3
"""Gauss-Newton steps from the nearest point of the circle, and the longest of them [rad]."""
LEAST_PRECISION = 1e-2
"""Precision of a motor that does not move the tool [1/rad2]."""
LEAST_SCATTER_RAD = 1e-4
"""Scatter of a motor beside which turns are judged, at least [rad]."""
LEAST_LOG = -20.0
"""Log probability of an outcome that cannot be."""
PLAY_RAD = 0.003
"""Deviation of a held motor from one angle [rad]."""
REWEIGHED = 3
"""How often moments are weighed anew by their distance from the common angle."""
PLATEAU_BINS, RAMP_BINS = 4, 8
"""Bins of the onset before each moment: while the motor rests, and on its ramp."""
BINS = PLATEAU_BINS + RAMP_BINS


@dataclass(frozen=True)
class Tokens:
    """Runs as the network takes them.

    Attributes:
        features: (run, moment, motor, feature).
        exists: Moments that there are, (run, moment); others pad short runs.
        anchor: Angle that explains the moments from each on, its deviation, the logarithm of their
            rms turn and the sign of their mean turn, (run, moment, motor, 4).
        edges: Times between the bins of the onset, (run, moment, motor, bin + 1) [s].
    """

    features: Floats
    exists: BoolArray
    anchor: Floats
    edges: Floats

    @property
    def arrays(self) -> tuple[NDArray[np.generic], ...]:
        """All arrays, in the order of attributes."""
        return self.features, self.exists, self.anchor, self.edges

    def __len__(self) -> int:
        """How many runs."""
        return len(self.exists)

    def __getitem__(self, runs: NDArray[np.int64] | slice) -> Tokens:
        """Return some runs."""
        return Tokens(self.features[runs], self.exists[runs], self.anchor[runs], self.edges[runs])

    @property
    def lengths(self) -> IntArray:
        """Moments of each run, (run,)."""
        return np.asarray(self.exists.sum(axis=1))

    def cut(self) -> Tokens:
        """Return the same without room that no run needs."""
        most = int(self.lengths.max(initial=1))
        return Tokens(*(values[:, :most] for values in self.arrays))  # type: ignore[arg-type]

    def padded(self, moments: int) -> Tokens:
        """Return the same with room for so many moments."""
        more = moments - self.exists.shape[1]
        if more <= 0:
            return self

        def wide(values: NDArray[np.generic]) -> NDArray[np.generic]:
            return np.pad(values, [(0, 0), (0, more)] + [(0, 0)] * (values.ndim - 2))

        return Tokens(*(wide(values) for values in self.arrays))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, parts: Sequence[Tokens]) -> Tokens:
        """Return the runs of several sets, the shorter ones padded."""
        most = max(part.exists.shape[1] for part in parts)
        columns = zip(*(part.padded(most).arrays for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class MomentEncoder:
    """Turns runs of a robot into tokens.

    Attributes:
        robot: The robot.
        imperfections: What is known of its healthy behaviour.
    """

    robot: Robot
    imperfections: Imperfections

    @property
    def protocol(self) -> str:
        """Protocol letter of what is known."""
        return self.imperfections.protocol

    @property
    def expected(self) -> Imperfections:
        """What is known of the healthy behaviour; it carries the name of the calibration."""
        return self.imperfections

    @cached_property
    def model(self) -> HealthyModel:
        """The healthy robot."""
        return HealthyModel.of(CalibratedRobot(self.robot, self.imperfections))

    def encode(self, runs: xr.Dataset) -> Tokens:
        """Return the tokens of runs; reads `command` and `measured` alone."""
        seen = SeenRuns(runs, self.model, (), Priors())
        moments = moments_of(self.model, seen.settled)
        return _Encoding(self.model, moments).tokens


@dataclass(frozen=True)
class _Encoding:
    """One set of runs on its way to tokens."""

    model: HealthyModel
    moments: Moments

    @cached_property
    def outcomes(self) -> int:
        return min(MOST_OUTCOMES, self.moments.log_weight.shape[-1])

    @cached_property
    def pose(self) -> FloatArray:
        """Settled angles under each outcome, (run, moment, outcome, motor) [rad]."""
        moments = self.moments
        return self.model.settle(moments.base, moments.direction, self.model.none_held)

    @cached_property
    def healthy(self) -> tuple[FloatArray, FloatArray]:
        """Squared distance and log density of each outcome, (run, moment, outcome)."""
        moments = self.moments
        value, jacobian = self.model.sensors.expected(self.pose)
        spread, log_det = self._precision(jacobian, self._variance(slice(None)))
        error = moments.point[:, :, None] - value
        square = np.einsum("...i,...ij,...j->...", error, spread, error)
        return square, self._log_density(square, log_det)

    def _variance(self, outcomes: slice) -> FloatArray:
        moments = self.moments
        moving = (moments.late + moments.bent)[:, :, outcomes]
        return np.asarray(self.model.scatter**2 + moving)

    def _precision(
        self, jacobian: FloatArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return S^-1 and log det S."""
        S = (jacobian * variance[..., None, :]) @ np.swapaxes(jacobian, -1, -2)
        S = S + self.model.path_noise**2 * np.eye(S.shape[-1])
        return as_floats(np.linalg.inv(S)), as_floats(np.linalg.slogdet(S)[1])

    def _log_density(self, square: FloatArray, log_det: FloatArray) -> FloatArray:
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
            precision, log_det = self._precision(jacobian, variance)
            lever, error = jacobian[..., motor], point - value
            pull = np.einsum("...i,...ij->...j", lever, precision)
            P = np.einsum("...j,...j->...", pull, lever)
            if step < STEPS:
                turn = np.einsum("...j,...j->...", pull, error) / np.maximum(P, LEAST_PRECISION)
                pose[..., motor] += np.clip(turn, -LONGEST_RAD, LONGEST_RAD)
        left = np.einsum("...i,...ij,...j->...", error, precision, error)
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

    @cached_property
    def tokens(self) -> Tokens:
        moments = self.moments
        usable = moments.usable
        square, density = self.healthy
        log_healthy = logsumexp(
            np.concatenate([moments.log_weight + density, self._outlier], axis=-1), axis=-1
        )
        log_healthy = np.where(usable, log_healthy, 0.0)
        motors = [self._motor(k, square, log_healthy) for k in range(self.pose.shape[-1])]
        features, anchor = (np.stack(parts, axis=2) for parts in zip(*motors, strict=True))
        shared = self._shared(square, log_healthy)
        shared = np.repeat(shared[:, :, None], features.shape[2], axis=2)
        features = np.concatenate([features, shared], axis=-1)
        return Tokens(
            features.astype(np.float32),
            self._exists,
            anchor.astype(np.float32),
            self._edges.astype(np.float32),
        )

    @property
    def _outlier(self) -> FloatArray:
        return np.full((*self.moments.usable.shape, 1), self.model.outlier_log_density)

    @property
    def _exists(self) -> BoolArray:
        return np.asarray((self.moments.ramp > 0.0).any(axis=-1) | self.moments.usable)

    @property
    def _edges(self) -> FloatArray:
        """Times between bins of the onset, (run, moment, motor, bin + 1) [s]."""
        moments, model = self.moments, self.model
        begin = (moments.start + model.lag_s)[..., None] + np.zeros_like(moments.ramp)
        end = begin + moments.ramp * (1.0 - model.shortening)
        last = np.concatenate([np.zeros_like(end[:, :1]), end[:, :-1]], axis=1)
        last = np.maximum.accumulate(last, axis=1)
        begin = np.maximum(begin, last)
        end = np.maximum(end, begin)
        rest = np.linspace(0.0, 1.0, PLATEAU_BINS + 1)
        first = np.r_[0.0, np.linspace(0.0, 1.0, PLATEAU_BINS)]  # there before the run
        shares = np.where((np.arange(begin.shape[1]) == 0)[:, None], first, rest)[None, :, None]
        resting = last[..., None] + (begin - last)[..., None] * shares
        ramp = np.linspace(0.0, 1.0, RAMP_BINS + 1)[1:]
        return np.concatenate([resting, begin[..., None] + (end - begin)[..., None] * ramp], -1)

    def _shared(self, square: FloatArray, log_healthy: FloatArray) -> FloatArray:
        """Return the features of a moment that belong to no motor, (run, moment, feature)."""
        moments, usable = self.moments, self.moments.usable
        before = np.cumsum(usable, axis=1)
        after: IntArray = before[:, -1:] - before
        gain = log_healthy - self.model.outlier_log_density
        rest = ~(moments.speed[:, :, 0] != 0.0).any(axis=-1)
        parts = [
            usable,
            0.3 * np.log1p(square[..., 0]) * usable,
            0.2 * gain * usable,
            0.2 * np.maximum(moments.log_weight[..., 0], LEAST_LOG) * usable,
            0.2 * (before - usable),
            0.2 * after,
            rest,
            0.1 * moments.start,
        ]
        return np.stack([np.asarray(part, dtype=np.float64) for part in parts], axis=-1)

    def _motor(
        self, motor: int, square: FloatArray, log_healthy: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the features of one motor and its anchors, (run, moment, ...)."""
        moments, model, usable = self.moments, self.model, self.moments.usable
        angle, precision, left, log_det = self.nearest(motor)
        own = ~moments.lost[:, :, : self.outcomes, motor]
        weight = np.where(own, moments.log_weight[:, :, : self.outcomes], -np.inf)
        free = weight + self._log_density(left, log_det)
        best = np.argmax(np.where(np.isfinite(free), free, -1e9), axis=-1)[..., None]

        def at_best(values: FloatArray) -> FloatArray:
            return np.take_along_axis(values, best, axis=2)[..., 0]

        phi, P, rest, said = at_best(angle), at_best(precision), at_best(left), at_best(weight)
        healthy = self.pose[..., motor]
        turn = phi - at_best(healthy[:, :, : self.outcomes])
        deviation = np.sqrt(1.0 / P)
        scatter = model.scatter[motor]
        held = np.sqrt(np.maximum(1.0 / P - scatter**2, 0.0) + PLAY_RAD**2)
        was = np.concatenate([moments.origin[:, :1, motor], healthy[:, :-1, 0]], axis=1)
        goal = healthy[:, :, 0]
        log_free = logsumexp(np.concatenate([free, self._outlier], axis=-1), axis=-1)
        log_free = np.where(usable, log_free, 0.0)
        lost, lost_square = self._own_loss(motor, square)
        common = _common_angle(phi, held, rest, usable)
        log_held = np.where(usable[:, None], common.log_density(log_free[:, None]), 0.0)
        log_held = np.where(
            usable[:, None], np.logaddexp(log_held, self.model.outlier_log_density), 0.0
        )
        onward = np.arange(usable.shape[1]) >= np.arange(usable.shape[1])[:, None]
        gain = np.sum(np.where(onward, log_held - log_healthy[:, None], 0.0), axis=2)
        width = 0.5 * np.log(np.maximum(P, 1.0))
        freely = np.cumsum((log_free - log_healthy - width)[:, ::-1], axis=1)[:, ::-1]
        weights = np.where(usable, 1.0 / (1.0 + rest / 9.0), 0.0)[:, None] * onward
        total = np.maximum(weights.sum(axis=2), 1e-9)
        mean = np.sum(weights * turn[:, None], axis=2) / total
        rms2 = np.sum(weights * (turn**2)[:, None], axis=2) / total
        excess = np.maximum(rms2 - np.sum(weights / P[:, None], axis=2) / total, 0.02 * rms2)
        log_rms = 0.5 * np.log(np.maximum(excess, 1e-8))
        travel = goal - was
        share = (phi - was) / np.where(np.abs(travel) > 1e-3, travel, 1e-3)
        common_share = (common.angle - was) / np.where(np.abs(travel) > 1e-3, travel, 1e-3)
        now = [
            _compressed(turn / deviation),
            _compressed(turn / 0.01),
            np.log(deviation / 0.01) / 3.0,
            np.log(held / 0.01) / 3.0,
            0.3 * np.log1p(rest),
            0.2 * np.maximum(said, LEAST_LOG),
            best[..., 0] > 0,
            0.3 * np.log1p(left[..., 0]),
            _compressed((angle[..., 0] - goal) / np.sqrt(1.0 / precision[..., 0])),
            0.2 * lost,
            0.3 * np.log1p(lost_square),
            _compressed((phi - was) / held),
            np.clip(share, -1.0, 2.0),
            0.3 * _compressed(log_free - log_healthy),
            _compressed((phi - common.angle) / held),
            phi / np.pi,
        ]
        since = [
            _compressed(travel / held),
            _compressed(gain),
            _compressed(freely),
            0.3 * np.log1p(common.square),
            np.log(common.deviation / 0.01) / 3.0,
            _compressed((common.angle - was) / np.hypot(common.deviation, 2.0 * scatter)),
            np.clip(common_share, -1.0, 2.0),
            _compressed(mean / np.maximum(np.sqrt(rms2), 1e-6)),
            log_rms / 3.0 + 1.0,
            log_rms - np.log(max(scatter, LEAST_SCATTER_RAD)),
        ]
        features = [*(np.where(usable, one, 0.0) for one in now), *since]
        anchor = [common.angle, common.deviation, log_rms, np.where(mean < 0.0, -1.0, 1.0)]
        return (
            np.stack([np.asarray(one, dtype=np.float64) for one in features], axis=-1),
            np.stack(anchor, axis=-1),
        )

    def _own_loss(self, motor: int, square: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log weight and squared distance if this motor alone missed its command."""
        moments = self.moments
        alone = moments.lost[..., motor] & (moments.lost.sum(axis=-1) == 1)
        at = np.argmax(alone, axis=-1)[..., None]
        there = alone.any(axis=-1)

        def taken(values: FloatArray) -> FloatArray:
            return np.take_along_axis(values, at, axis=2)[..., 0]

        weight = np.where(there, np.maximum(taken(moments.log_weight), LEAST_LOG), LEAST_LOG)
        return weight, np.where(there, taken(square), 1e4)


FEATURES = 26 + 8
"""Features of a token: of its motor, and of its moment."""


def _compressed(values: FloatArray) -> FloatArray:
    return np.arcsinh(np.clip(np.nan_to_num(values), -1e6, 1e6)) / 2.0


@dataclass(frozen=True)
class _Common:
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


def _common_angle(
    phi: FloatArray, deviation: FloatArray, left: FloatArray, usable: BoolArray
) -> _Common:
    """Return the angle that explains all moments from each on, outliers weighed down."""
    count = usable.shape[1]
    onward = np.arange(count) >= np.arange(count)[:, None]
    counts = onward & usable[:, None]
    base = np.where(counts, (1.0 / (deviation**2 * (1.0 + left / 9.0)))[:, None], 0.0)
    angles = np.broadcast_to(phi[:, None], counts.shape)
    angle = _weighted_median(angles, base)
    for _ in range(REWEIGHED):
        own = ((angles - angle[..., None]) / deviation[:, None]) ** 2
        weight = base / (1.0 + own / 4.0)
        total = np.maximum(weight.sum(axis=2), 1e-6)
        angle = np.where(counts.any(axis=2), np.sum(weight * angles, axis=2) / total, phi)
    own = ((angles - angle[..., None]) / deviation[:, None]) ** 2
    square = np.sum(np.where(counts, 4.0 * np.log1p(own / 4.0), 0.0), axis=2)
    return _Common(angle, np.minimum(np.sqrt(1.0 / total), 3.0), square, own)


def _weighted_median(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted median over the last axis."""
    order = np.argsort(values, axis=-1)
    ranked, mass = (np.take_along_axis(v, order, axis=-1) for v in (values, weight))
    below = np.cumsum(mass, axis=-1)
    at = np.argmax(below >= 0.5 * below[..., -1:], axis=-1)[..., None]
    return np.take_along_axis(ranked, at, axis=-1)[..., 0]
