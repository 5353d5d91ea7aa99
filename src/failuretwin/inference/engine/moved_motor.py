"""A motor that a fault moves by one amount, and the amount that explains its moments best.

    angle of the motor in moment m = phi_m(x),    x = centre + z,    H_m = J_k dphi_m/dx

The centre of each row is where the moments from its onset on point: the best of a grid, then two
Gauss-Newton steps. A motor that is held says nothing of its own part of theta, unless it is held
where it had settled, off its target by that part.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.integral import Noise, invert, log_density
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.rows import (
    AmountPrior,
    ColumnsOf,
    Onsets,
    Rows,
    Scene,
    arrived,
    before_onset,
)
from failuretwin.inference.engine.theta import Motion, Shown, columns

Angle = Callable[[FloatArray, IntArray], FloatArray]
"""Angle of the motor at some amounts under outcomes of the commands,
(run, row, node), (run, row, moment) -> (run, row, moment, node) [rad]."""
ARRIVED = np.zeros((1, 1, 1), dtype=np.int64)
"""The first outcome of each moment: every command arrives."""
CHEBYSHEV = 9
"""Amounts at which what is expected is computed; between them it is interpolated."""
FREE_RAD = 0.08
"""Deviation of the angle about the best one, before the prior of the amount is put in [rad]."""
STEPS, LONGEST = 2, 0.1
"""Gauss-Newton steps from the best of the grid, and the longest [rad]."""
SAME_NATS = 1e-6
"""Densities that differ by less say the same."""


@dataclass(frozen=True)
class MovedMotor:
    """One motor of a scene, and how an amount moves it.

    Attributes:
        scene: The runs.
        motor: Index of the motor.
        held: Whether the gear holds it.
        angle: Its angle by the amount.
        first: First moment affected in each row, (row,).
    """

    scene: Scene
    motor: int
    held: bool
    angle: Angle
    first: IntArray

    @property
    def variance(self) -> FloatArray:
        """Variance of all motors, (motor,) [rad2]."""
        found = self.scene.model.scatter**2
        if self.held:
            found[self.motor] = self.scene.model.held_scatter[self.motor] ** 2
        return found

    def best(self, grid: FloatArray, alike: bool) -> tuple[FloatArray, IntArray]:
        """Return the amount of each row that explains its moments best, and their outcomes.

        What is expected is interpolated between a few amounts. The scale is that of the first
        outcome: all commands arrive.

        Args:
            grid: Amounts to look at, (run, node), spaced alike in all runs.
            alike: Whether the angle does not depend on the row.

        Returns:
            Amounts (run, row) and outcomes (run, row, moment).
        """
        moments, motor = self.scene.moments, self.motor
        nodes, between = _chebyshev(grid)
        nodes = np.repeat(nodes[:, None], 1 if alike else len(self.first), axis=1)
        count = min(1 + len(self.variance), moments.base.shape[2])  # the likeliest
        seen = [self._expected(nodes, ARRIVED + a) for a in range(count)]
        _, jacobian, angle = seen[0]
        step = np.abs(np.diff(angle @ between.T, axis=-1)).mean(axis=-1)
        variance = np.broadcast_to(self.variance, (*step.shape, len(self.variance))).copy()
        variance[..., motor] += step**2 / 6.0
        says = np.empty((*step.shape, grid.shape[1]))  # (run, row, moment, node)
        outcome = np.empty(says.shape, dtype=np.int64)
        _write_densities(
            moments.point,
            np.stack([expected for expected, _, _ in seen]),
            np.ascontiguousarray(jacobian),
            variance,
            self._doubt,
            moments.log_weight,
            between,
            self.scene.noise,
            says,
            outcome,
        )
        whole = np.where(self._counts[..., None], says, 0.0).sum(axis=2)
        at = _middle_of_best(whole)[..., None]
        outcome = np.broadcast_to(outcome, (*self._counts.shape, outcome.shape[-1]))
        found = np.take_along_axis(np.broadcast_to(grid[:, None], whole.shape), at, axis=2)
        return found[..., 0], np.take_along_axis(outcome, at[..., None], axis=3)[..., 0]

    def refined(
        self, found: tuple[FloatArray, IntArray], low: FloatArray, high: FloatArray
    ) -> FloatArray:
        """Return amounts (run, row) after some Gauss-Newton steps.

        Args:
            found: Amounts and outcomes to begin with.
            low: Least amount, (run, 1).
            high: Largest, same axes.
        """
        x, outcome = found
        for _ in range(STEPS):
            slope = self.slope(x, outcome)
            expected, jacobian, _ = self._expected(x[..., None], outcome)
            error = self.scene.moments.point[:, None] - expected[:, :, :, 0]
            jacobian = jacobian[:, :, :, 0]
            scale = np.matmul(jacobian * self.variance, np.swapaxes(jacobian, -1, -2))
            precision = np.linalg.inv(scale + self._doubt[:, None])
            lever = jacobian[..., self.motor] * slope[..., None]
            pull = np.einsum("brmij,brmj->brmi", precision, error)
            square = np.einsum("brmi,brmi->brm", error, pull)
            weight = np.where(self._counts, 1.0 / (1.0 + square / 9.0), 0.0)
            force = np.einsum("brm,brmi,brmi->br", weight, lever, pull)
            curve = np.einsum("brm,brmi,brmij,brmj->br", weight, lever, precision, lever)
            longest = LONGEST / np.maximum(np.abs(slope).max(axis=-1), 1e-6)
            x = x + np.clip(force / np.maximum(curve, 1e-9), -longest, longest)
            x = np.clip(x, low, high)
        return x

    def slope(self, x: FloatArray, outcome: IntArray) -> FloatArray:
        """Return dphi/dx, (run, row, moment)."""
        step = 1e-4
        low, high = (self.angle((x + h)[..., None], outcome)[..., 0] for h in (-step, step))
        return (high - low) / (2.0 * step)

    @property
    def _doubt(self) -> FloatArray:
        """What theta and the sensor leave open, (run, moment, channel, channel) [m2]."""
        noise = self.scene.model.path_noise**2
        return self.scene.spread + noise * np.eye(self.scene.spread.shape[-1])

    @property
    def _counts(self) -> BoolArray:
        """Moments from the onset of each row on, (run, row, moment)."""
        usable = self.scene.moments.usable[:, None]
        return usable & (np.arange(usable.shape[2]) >= self.first[:, None])

    def _expected(
        self, x: FloatArray, outcome: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the sensors show at some amounts, its Jacobian, and the motor's angle.

        Args:
            x: (run, row, node).
            outcome: Of each moment, (run, row, moment) or axes that spread to them.
        """
        angle = self.angle(x, outcome)
        settled = taken(self.scene.pose, outcome)[..., None, :]
        pose = np.broadcast_to(settled, (*angle.shape, settled.shape[-1])).copy()
        pose[..., self.motor] = angle
        return *self.scene.model.sensors.expected(pose), angle

    def rows(
        self,
        x: FloatArray,
        variance: FloatArray,
        log_prior: FloatArray,
        amount_prior: AmountPrior,
        onsets: Onsets,
        tie: FloatArray | None = None,
    ) -> Rows:
        """Return the rows about some amounts.

        Args:
            x: Centres, (run, row).
            variance: var(z), (run, row).
            log_prior: (run, row).
            amount_prior: Log density of the amount.
            onsets: Onset of a run and row.
            tie: What theta adds to the angle of a motor that is held, (run, row, theta).
        """
        scene, moments, motor = self.scene, self.scene.moments, self.motor
        base = np.repeat(moments.base[:, None], x.shape[1], axis=1)
        for a in range(base.shape[3]):
            angle = self.angle(x[..., None], ARRIVED + a)[..., 0]  # (run, row, moment)
            if self.held:
                base[..., a, motor] = angle
            else:  # off where each outcome of the commands leads
                base[..., a, motor] += angle - scene.pose[:, None, :, a, motor]
        direction = np.broadcast_to(moments.direction[:, None], base.shape)
        held = (np.arange(base.shape[-1]) == motor) & self.held
        pose = scene.model.settle(base, direction, held)
        speed, bend, late, bent = (
            np.broadcast_to(np.where(held, 0.0, values[:, None]), pose.shape)
            for values in (moments.speed, moments.bend, moments.late, moments.bent)
        )
        shown = scene.model.sensors.expected(pose)
        value, jacobian, *beside = (np.swapaxes(x, 1, 2) for x in (*shown, late, bent))
        outcomes = Outcomes.of_poses(moments, (value, jacobian), self.variance, *beside)
        columns_of = self._columns_of(pose, shown, Motion(direction, speed, bend), tie)
        weight = np.broadcast_to(moments.log_weight[:, None], pose.shape[:-1])
        rows = Rows(
            log_prior,
            self.first,
            outcomes.rows_first(),
            weight,
            np.arange(weight.shape[-1]),
            arrived(columns_of, x.shape[1], moments),
            columns_of,
            shown[1][:, :, :, 0, :, motor] * self.slope(x, ARRIVED)[..., None],
            x,
            variance,
            amount_prior,
            onsets=onsets,
            tie=tie,
            own=scene.layout.own(motor) if self.held else (),
        )
        return before_onset(rows, scene.healthy)

    def _columns_of(
        self, pose: FloatArray, shown: Shown, motion: Motion, tie: FloatArray | None
    ) -> ColumnsOf:
        """Return G by run, row, moment and outcome; before the onset that of a healthy robot.

        Args:
            pose: Settled angles, (run, row, moment, outcome, motor) [rad].
            shown: What the sensors show there.
            motion: How the motors move there.
            tie: As of `rows`.
        """
        scene, own = self.scene, self.scene.layout.own(self.motor)

        def of(run: IntArray, row: IntArray, moment: IntArray, outcome: IntArray) -> FloatArray:
            found = scene.columns_of(run, row, moment, outcome)
            after = moment >= self.first[row]
            at = tuple(index[after] for index in (run, row, moment, outcome))
            seen = shown[0][at], shown[1][at]
            moves = Motion(motion.direction[at], motion.speed[at], motion.bend[at])
            G = columns(scene.model, pose[at], seen, moves, scene.layout)
            if self.held:
                G[..., own] = 0.0
            if tie is not None:
                G[..., own] = seen[1][..., self.motor, None] * tie[at[:2]][:, None, own]
            found[after] = G
            return found

        return of


def _middle_of_best(says: FloatArray) -> IntArray:
    """Return the best node of each row, the middle one where several say the same, (..., node).

    A motor without a load tells nothing of a lost stiffness: rounding must not choose.
    """
    before = np.cumsum(says >= says.max(axis=-1, keepdims=True) - SAME_NATS, axis=-1)
    return np.asarray((2 * before > before[..., -1:]).argmax(axis=-1))


@compiled
def _write_densities(
    point: FloatArray,
    expected: FloatArray,
    jacobian: FloatArray,
    variance: FloatArray,
    doubt: FloatArray,
    log_weight: FloatArray,
    between: FloatArray,
    noise: Noise,
    says: FloatArray,
    outcome: IntArray,
) -> None:
    """Write the log density of each moment at amounts of a grid, and its likeliest outcome.

    Args:
        point: What was seen, (run, moment, channel) [m].
        expected: At some amounts, (outcome, run, row, moment, amount, channel) [m].
        jacobian: Of the first outcome, (run, row, moment, amount, channel, motor).
        variance: Of each motor, (run, row, moment, motor) [rad2].
        doubt: Of what is seen beside it, (run, moment, channel, channel) [m2].
        log_weight: Of outcomes, (run, moment, outcome).
        between: Weights of the amounts at each node of the grid, (node, amount).
        noise: The Student t of residuals.
        says: (run, row, moment, node), written.
        outcome: Same axes, written.
    """
    runs, rows, moments, nodes = says.shape
    size = jacobian.shape[-2]
    precision, error = np.empty((size, size)), np.empty(size)
    for r, row, m in np.ndindex(runs, rows, moments):
        for n in range(nodes):
            _write_scale(
                jacobian[r, row, m], variance[r, row, m], doubt[r, m], between[n], precision
            )
            determinant = invert(precision)
            best, total = -np.inf, np.exp(noise.log_outlier)
            for a in range(len(expected)):
                for c in range(size):
                    error[c] = point[r, m, c]
                    for k in range(between.shape[1]):
                        error[c] -= between[n, k] * expected[a, r, row, m, k, c]
                density = log_density(noise, _square(precision, error), determinant)
                density += log_weight[r, m, a]
                total += np.exp(density)
                if density > best or a == 0:
                    best, outcome[r, row, m, n] = density, a
            says[r, row, m, n] = np.log(total)


@compiled
def _write_scale(
    jacobian: FloatArray,
    variance: FloatArray,
    doubt: FloatArray,
    between: FloatArray,
    scale: FloatArray,
) -> None:
    """Write J diag(v) J^T and the doubt, with J interpolated, (amount, channel, motor)."""
    amounts, size, motors = jacobian.shape
    lever = np.empty(size)
    for c in range(size):
        for d in range(size):
            scale[c, d] = doubt[c, d]
    for j in range(motors):
        for c in range(size):
            lever[c] = 0.0
            for k in range(amounts):
                lever[c] += between[k] * jacobian[k, c, j]
        for c in range(size):
            for d in range(size):
                scale[c, d] += variance[j] * lever[c] * lever[d]


@compiled
def _square(precision: FloatArray, error: FloatArray) -> float:
    """Return error^T precision error."""
    total = 0.0
    for i in range(len(error)):
        for j in range(len(error)):
            total += error[i] * precision[i, j] * error[j]
    return total


def taken(values: FloatArray, outcome: IntArray) -> FloatArray:
    """Return the values (run, moment, outcome, motor) of some outcomes, (run, row, moment, motor).

    Args:
        values: Of all outcomes.
        outcome: Of each moment, (run, row, moment) or axes that spread to them.
    """
    at = np.broadcast_to(outcome, np.broadcast_shapes(outcome.shape, (len(values), 1, 1)))
    at = np.broadcast_to(at, (*at.shape[:2], values.shape[1]))
    return np.take_along_axis(values[:, None], at[..., None, None], axis=3)[..., 0, :]


def _chebyshev(grid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return amounts to interpolate between, (run, k), and their weights at a grid, (node, k)."""
    chebyshev = np.polynomial.chebyshev
    low, high = grid[:, :1], grid[:, -1:]
    points = chebyshev.chebpts2(CHEBYSHEV)
    at = 2.0 * (grid[0] - low[0]) / (high[0] - low[0]) - 1.0
    degree = CHEBYSHEV - 1
    between = chebyshev.chebvander(at, degree) @ np.linalg.inv(chebyshev.chebvander(points, degree))
    return low + 0.5 * (points + 1.0) * (high - low), between
