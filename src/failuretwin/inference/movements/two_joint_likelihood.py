"""Where two motors must stand to bring the tool where it settled, the others being well.

Two motors reach nearly any place of the plane or the sphere that they span in up to two ways (elbow
up, elbow down). Near each, the density of the place is Gaussian in the two angles, so that of a run
with motors that are off by linear functions of unknown amounts is found by a Kalman filter.

    p(e_m | x) = sum over ways of exp(log_weight) N(x; x_way, P^-1)

with x the angles of both motors and P the 2 x 2 lever of both in units of the others' scatter.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import log_fall, log_norm, log_normal_2d
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

SCANNED = 16
"""Angles of the first motor from which a way is looked for; more find no other ways."""
SCANNED_STEP_RAD = 0.19
"""The furthest apart that they lie, whatever its travel."""
SOLUTIONS = 2
"""Ways to bring the tool somewhere that are followed."""
STEPS = 6
"""Newton steps towards each."""
LONGEST_STEP_RAD = 0.3
"""Bound on such a step: near a singular pose the parabola promises too much."""
LEAST_PRECISION = 1.0
"""Precision that any pair of angles has beforehand [1/rad2]: keeps singular poses finite."""
SAME = 2.0
"""Ways closer than so many deviations are one: near a straight elbow."""
RARE = 0.002
"""Losses of commands of other motors that are rarer than this are left aside [-]."""


@dataclass(frozen=True)
class TwoJointLikelihood:
    """What each movement says of the angles of two motors.

    The density of the settled place at angles x is, summed over the last axis, exp(log_weight)
    times a normal density of x about `angle`.

    Attributes:
        pair: Indices of the motors.
        angle: (run, movement, way, motor of the pair) [rad].
        covariance: (run, movement, way, motor of the pair, motor of the pair) [rad2].
        log_weight: (run, movement, way) [log rad2/m3].
        expected: Where they settle if they are well, (run, movement, motor of the pair) [rad].
        outcome: Outcome of the commands that each way belongs to, (way,).
    """

    pair: tuple[int, int]
    angle: FloatArray
    covariance: FloatArray
    log_weight: FloatArray
    expected: FloatArray
    outcome: IntArray


def two_joint_likelihood(
    evidence: SettledEvidence,
    model: HealthyModel,
    outcomes: CommandOutcomes,
    pair: tuple[int, int],
) -> TwoJointLikelihood:
    """Return what each movement says of the angles of two motors.

    Args:
        evidence: Settled positions.
        model: The healthy robot.
        outcomes: What may have become of each movement; of those in which other motors lose
            their commands, the usual ones are followed.
        pair: Indices of the motors.
    """
    followed = _followed(outcomes, pair)
    chosen = replace(
        outcomes,
        base=outcomes.base[:, :, followed],
        kept=outcomes.kept[:, :, followed],
        direction=outcomes.direction[:, :, followed],
        log_weight=outcomes.log_weight[:, :, followed],
    )
    expected = model.settle(chosen.base, chosen.direction, model.none_held)
    angle = _starts(model, expected, pair, evidence.point)
    for _ in range(STEPS):
        near = _laplace(evidence.point, model, chosen, pair, angle)
        angle = angle + near.step
    dof = model.settling.tail_dof
    log_weight = (
        chosen.log_weight[..., None]
        + near.log_norm
        + log_fall(near.square, dof, model.sensors.dims - 2)
    )
    log_weight = np.where(_found(model, pair, angle, near.covariance), log_weight, -np.inf)
    shape = (*evidence.usable.shape, len(followed) * SOLUTIONS)
    return TwoJointLikelihood(
        pair,
        angle.reshape(*shape, 2),
        near.covariance.reshape(*shape, 2, 2),
        log_weight.reshape(shape),
        expected[:, :, 0][..., list(pair)],
        np.repeat(followed, SOLUTIONS),
    )


@dataclass(frozen=True)
class _Laplace:
    """The squared distance near two angles: a parabola, (run, movement, outcome, way) each.

    Attributes:
        step: From there to its lowest point, bounded, (..., motor) [rad].
        square: Squared distance after that step, in scales of the others' scatter.
        covariance: Inverse of its curvature, (..., motor, motor) [rad2].
        log_norm: Log density at its lowest point, integrated over both angles.
    """

    step: FloatArray
    square: FloatArray
    covariance: FloatArray
    log_norm: FloatArray


def _laplace(
    point: FloatArray,
    model: HealthyModel,
    outcomes: CommandOutcomes,
    pair: tuple[int, int],
    angle: FloatArray,
) -> _Laplace:
    """Return the squared distance of the tool to where it was seen, near two angles.

    Args:
        point: Settled positions, (run, movement, axis) [m].
        model: The healthy robot.
        outcomes: What may have become of each movement.
        pair: Indices of the motors.
        angle: Their angles, (run, movement, outcome, way, motor) [rad].
    """
    fixed, scale = model.none_held.copy(), model.scatter.copy()
    fixed[list(pair)], scale[list(pair)] = True, 0.0
    pose = np.repeat(outcomes.base[..., None, :], SOLUTIONS, axis=-2)
    pose[..., list(pair)] = angle
    settled = model.settle(pose, outcomes.direction[..., None, :], fixed)
    error, jacobian, spread = model.residual(point[:, :, None, None], settled, scale)
    lever = jacobian[..., list(pair)]  # (..., axis, motor)
    pull = np.stack([spread.solve(lever[..., k]) for k in range(2)], axis=-1)
    precision = np.swapaxes(lever, -1, -2) @ pull + LEAST_PRECISION * np.eye(2)
    covariance = as_floats(np.linalg.inv(precision))
    slope = np.einsum("...ak,...a->...k", pull, error)
    step = np.einsum("...ij,...j->...i", covariance, slope)
    step = np.clip(step, -LONGEST_STEP_RAD, LONGEST_STEP_RAD)
    left = 2.0 * slope - np.einsum("...ij,...j->...i", precision, step)
    area = np.linalg.det(covariance) / spread.determinant
    return _Laplace(
        step,
        np.maximum(spread.product(error, error) - np.sum(step * left, axis=-1), 0.0),
        covariance,
        log_norm(model.settling.tail_dof, model.sensors.dims - 2) + 0.5 * np.log(area),
    )


def _followed(outcomes: CommandOutcomes, pair: tuple[int, int]) -> IntArray:
    """Return the outcomes in which other motors alone lose commands, and not too rarely."""
    most = np.exp(outcomes.log_weight.max(axis=(0, 1)))
    others = ~outcomes.lost[:, list(pair)].any(axis=1)
    kept = others & (most > RARE)
    kept[0] = True
    return np.flatnonzero(kept)


def _starts(
    model: HealthyModel, pose: FloatArray, pair: tuple[int, int], point: FloatArray
) -> FloatArray:
    """Return from where to look for each way, (run, movement, outcome, way, motor) [rad]."""
    first, second = pair
    low, high = model.twin.robot.travel[first]
    grid = np.linspace(low, high, max(SCANNED, int(np.ceil((high - low) / SCANNED_STEP_RAD)) + 1))
    poses = np.repeat(pose[..., None, :], len(grid), axis=-2)
    poses[..., first] = grid
    point = point[:, :, None, None]
    own = (np.arange(pose.shape[-1]) == second).reshape(1, *(1,) * (poses.ndim - 1), -1)
    poses[..., second] = model.sensors.nearest(poses, own, point)[0]
    distance = np.sum((model.sensors.value(poses) - point) ** 2, axis=-1)
    wall = np.full_like(distance[..., :1], np.inf)
    left = np.concatenate([wall, distance[..., :-1]], axis=-1)
    right = np.concatenate([distance[..., 1:], wall], axis=-1)
    valley = np.where((distance <= left) & (distance <= right), distance, 1.0 + distance)
    order = np.argsort(valley, axis=-1)[..., :SOLUTIONS]
    return np.stack([grid[order], np.take_along_axis(poses[..., second], order, axis=-1)], axis=-1)


def _found(
    model: HealthyModel, pair: tuple[int, int], angle: FloatArray, covariance: FloatArray
) -> BoolArray:
    """Return whether each way is within the range of both motors and no copy of the first."""
    there = np.ones(angle.shape[:-1], dtype=bool)
    for k, motor in enumerate(pair):
        low, high = model.twin.robot.travel[motor]
        margin = 0.2 * (high - low)
        there &= (angle[..., k] > low - margin) & (angle[..., k] < high + margin)
    off = angle[..., 1:, :] - angle[..., :1, :]
    square = np.sum(
        off * np.linalg.solve(covariance[..., 1:, :, :], off[..., None])[..., 0], axis=-1
    )
    apart = square > SAME**2
    there[..., 1:] &= apart | ~there[..., :1]
    return there


# A run followed by a Kalman filter of the amounts by which two motors are off, x = centre + slope *
# amount + noise. Which of its ways each movement took is chosen greedily.


@dataclass(frozen=True)
class LinearOffsets:
    """Where two motors stand after each movement: x = centre + slope * amount, give or take noise.

    Attributes:
        centre: (run, movement, kind, motor) [rad].
        slope: (run, movement, kind, motor), in rad for each unit of the amount.
        noise: Variance, (kind, motor) [rad2].
        mean: Mean of each amount beforehand, (kind, motor).
        variance: Its variance, (kind, motor).
        well: Where they stand if they are well, (run, movement, motor) [rad].
        well_noise: Variance then, (motor,) [rad2].
    """

    centre: FloatArray
    slope: FloatArray
    noise: FloatArray
    mean: FloatArray
    variance: FloatArray
    well: FloatArray
    well_noise: FloatArray


@dataclass(frozen=True)
class GaussianBelief:
    """Normal belief about the amounts by which two motors are off.

    Attributes:
        mean: (run, kind, motor).
        covariance: (run, kind, motor, motor).
    """

    mean: FloatArray
    covariance: FloatArray

    def predict(self, slope: FloatArray) -> FloatArray:
        """Return H P H^T, the covariance of slope * amount, (run, kind, state, motor, motor).

        Args:
            slope: The diagonal of H, (run, kind, state, motor).
        """
        return slope[..., None] * self.covariance[:, :, None] * slope[..., None, :]

    def update(
        self, slope: FloatArray, error: FloatArray, covariance: FloatArray
    ) -> GaussianBelief:
        """Return the belief once angles were off by `error` from what was predicted.

        With the gain K = P H^T S^-1, the mean grows by K error and P shrinks by K H P.

        Args:
            slope: The diagonal of H, (run, kind, motor).
            error: (run, kind, motor).
            covariance: S, of the error, (run, kind, motor, motor).
        """
        cross = self.covariance * slope[..., None, :]  # P H^T
        gain = cross @ np.linalg.inv(covariance)
        mean = self.mean + np.einsum("...ij,...j->...i", gain, error)
        return GaussianBelief(mean, self.covariance - gain @ np.swapaxes(cross, -1, -2))

    def where(self, some: BoolArray, other: GaussianBelief) -> GaussianBelief:
        """Return this belief for some of the (run, kind), the other for the rest."""
        return GaussianBelief(
            np.where(some[..., None], self.mean, other.mean),
            np.where(some[..., None, None], self.covariance, other.covariance),
        )


SHOWS = np.array([[True, True], [True, False], [False, True]])
"""Which of two faults a movement shows, (state, motor): either may begin late, or come and go."""
LOG_SHOWS = np.log([0.8, 0.1, 0.1])
"""How probable that is; assumed."""
SEEDS = 6
"""Movements, spread over the run, from which a path through the run is followed."""
SAME_NATS = 1e-6
"""Paths closer than this are one, met in another order: the first counts."""


@dataclass(frozen=True)
class GreedyPath:
    """What became of the movements of each run, and what that says.

    Attributes:
        log_density: Of each movement given those met before it, (run, kind, movement).
        way: Which way of `TwoJointLikelihood` each one took, (run, kind, movement); -1: none.
        angle: Where the two motors stand by the amounts learnt, (run, kind, movement, motor)
            [rad].
    """

    log_density: FloatArray
    way: IntArray
    angle: FloatArray


@dataclass(frozen=True)
class PathFilter:
    """Runs of two motors that are off, followed movement by movement.

    Attributes:
        seen: What each movement says of the two angles.
        offsets: Where the motors may stand.
        usable: Movements with evidence, (run, movement).
        outlier: Log density of the tool being anywhere, times its rate.
    """

    seen: TwoJointLikelihood
    offsets: LinearOffsets
    usable: BoolArray
    outlier: float

    def map_path(self) -> GreedyPath:
        """Return the most probable path of each run and kind, begun at one movement or another."""
        count = self.usable.shape[1]
        starts = np.unique(np.linspace(0, count - 1, min(SEEDS, count)).astype(np.int64)).tolist()
        paths = [self._path(start, way) for start in starts for way in range(SOLUTIONS)]
        total = np.array([path.log_density.sum(axis=-1) for path in paths])
        best = np.argmax(total > total.max(axis=0) - SAME_NATS, axis=0)
        chosen = (best, *np.indices(best.shape))
        return GreedyPath(
            np.stack([path.log_density for path in paths])[chosen],
            np.stack([path.way for path in paths])[chosen],
            np.stack([path.angle for path in paths])[chosen],
        )

    def _path(self, start: int, way: int) -> GreedyPath:
        """Return the path that begins with one way of one movement and goes on as is best.

        Args:
            start: The movement that is met first; then come the others in their order.
            way: Way that it took, with both faults showing.
        """
        offsets = self.offsets
        runs, movements, kinds, _ = offsets.slope.shape
        mean, variance = (
            np.broadcast_to(values, (runs, kinds, 2)) for values in (offsets.mean, offsets.variance)
        )
        belief = GaussianBelief(mean, variance[..., None] * np.eye(2))
        log_density = np.zeros((runs, kinds, movements))
        taken = np.full((runs, kinds, movements), -1)
        for m in (start, *(m for m in range(movements) if m != start)):
            log_at, *options = self._options(belief, m)
            best = np.full((runs, kinds), way) if m == start else np.argmax(log_at, axis=-1)
            at, usable = _select(log_at, best), self.usable[:, m, None]
            here = usable & (at > self.outlier)
            belief = belief.update(*(_select(values, best) for values in options)).where(
                here, belief
            )
            log_density[:, :, m] = np.where(usable, np.maximum(at, self.outlier), 0.0)
            taken[:, :, m] = np.where(here, best % self.seen.log_weight.shape[-1], -1)
        centre, slope = (np.moveaxis(values, 1, 2) for values in (offsets.centre, offsets.slope))
        return GreedyPath(log_density, taken, centre + slope * belief.mean[:, :, None])

    def _options(
        self, belief: GaussianBelief, m: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return what may have become of a movement, by state of the faults and way of the tool.

        Returns:
            Log density, (run, kind, option), and for each option the slope of both motors (..., 2),
            their error (..., 2) and its covariance (..., 2, 2).
        """
        seen, offsets = self.seen, self.offsets
        slope = np.where(SHOWS, offsets.slope[:, m, :, None], 0.0)  # (run, kind, state, motor)
        centre = np.where(SHOWS, offsets.centre[:, m, :, None], offsets.well[:, m, None, None])
        noise = np.where(SHOWS, offsets.noise[:, None], offsets.well_noise)
        predicted = belief.predict(slope) + noise[..., None] * np.eye(2)
        expected = centre + slope * belief.mean[:, :, None]
        error = seen.angle[:, m, None, None] - expected[..., None, :]
        covariance = predicted[:, :, :, None] + seen.covariance[:, m, None, None]
        log_at = log_normal_2d(error, covariance)
        log_at = log_at + LOG_SHOWS[:, None] + seen.log_weight[:, m, None, None]
        slope = np.broadcast_to(slope[..., None, :], error.shape)
        options = (*log_at.shape[:2], -1)
        return (
            log_at.reshape(options),
            slope.reshape(*options, 2),
            error.reshape(*options, 2),
            covariance.reshape(*options, 2, 2),
        )


def _select(values: FloatArray, option: IntArray) -> FloatArray:
    """Return the values (run, kind, option, ...) of one option each."""
    return np.asarray(values[(*np.indices(option.shape), option)])
