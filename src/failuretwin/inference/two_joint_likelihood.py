"""Where two motors must stand to bring the tool where it settled, the others being well.

Two motors reach nearly any place of the plane or the sphere that they span in up to two ways (elbow
up, elbow down). Near each, the density of the place is Gaussian in the two angles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.command_loss import CommandOutcomes
from failuretwin.inference.evidence import SettledEvidence
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.joint_likelihood import nearest_on_circle

SCANNED = 16
"""Angles of the first motor from which a way is looked for; more find no other ways."""
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
        covariance: (run, movement, way, 3): of both with themselves, and of one with the other
            [rad2].
        log_weight: (run, movement, way) [log rad2/m3].
        expected: Where they settle if they are well, (run, movement, motor of the pair) [rad].
        outcome_probability: Alternative that each way belongs to, (way,).
    """

    pair: tuple[int, int]
    angle: FloatArray
    covariance: FloatArray
    log_weight: FloatArray
    expected: FloatArray
    outcome_probability: IntArray


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
    kept = _kept(outcomes, pair)
    chosen = replace(
        outcomes,
        base=outcomes.base[:, :, kept],
        direction=outcomes.direction[:, :, kept],
        log_weight=outcomes.log_weight[:, :, kept],
    )
    expected = model.settle(chosen.base, chosen.direction, model.none_held)
    angle = _starts(model, expected, pair, evidence.point)
    for _ in range(STEPS):
        near = _laplace(evidence.point, model, chosen, pair, angle)
        angle = angle + near.step
    dof = model.settling.tail_dof
    log_weight = chosen.log_weight[..., None] + near.log_norm + _over_plane(near.square, dof)
    log_weight = np.where(_found(model, pair, angle, near.covariance), log_weight, -np.inf)
    shape = (*evidence.usable.shape, len(kept) * SOLUTIONS)
    return TwoJointLikelihood(
        pair,
        angle.reshape(*shape, 2),
        near.covariance.reshape(*shape, 3),
        log_weight.reshape(shape),
        expected[:, :, 0][..., list(pair)],
        np.repeat(kept, SOLUTIONS),
    )


@dataclass(frozen=True)
class _Laplace:
    """The squared distance near two angles: a parabola, (run, movement, outcome, way) each.

    Attributes:
        step: From there to its lowest point, bounded, (..., motor) [rad].
        square: Squared distance after that step, in scales of the others' scatter.
        covariance: Inverse of its curvature, (..., 3) [rad2].
        log_norm: Log density at its lowest point, times the area of `covariance`.
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
    levers = [jacobian[..., motor] for motor in pair]
    pulls = [spread.solve(lever) for lever in levers]
    aa, bb, ab = (np.sum(pulls[i] * levers[j], axis=-1) for i, j in ((0, 0), (1, 1), (0, 1)))
    aa, bb = aa + LEAST_PRECISION, bb + LEAST_PRECISION
    slope_a, slope_b = (np.sum(pull * error, axis=-1) for pull in pulls)
    area = 1.0 / (aa * bb - ab * ab)
    step = np.stack([bb * slope_a - ab * slope_b, aa * slope_b - ab * slope_a], axis=-1)
    step = np.clip(step * area[..., None], -LONGEST_STEP_RAD, LONGEST_STEP_RAD)
    a, b = step[..., 0], step[..., 1]
    gained = 2.0 * (a * slope_a + b * slope_b) - aa * a * a - bb * b * b - 2.0 * ab * a * b
    return _Laplace(
        step,
        np.maximum(spread.product(error, error) - gained, 0.0),
        np.stack([bb, aa, -ab], axis=-1) * area[..., None],
        spread.log_norm(model.settling.tail_dof) + 0.5 * np.log(area),
    )


def _kept(outcomes: CommandOutcomes, pair: tuple[int, int]) -> IntArray:
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
    low, high = model.twin.robot.motors[first].movement_range
    grid = np.linspace(low, high, SCANNED)
    poses = np.repeat(pose[..., None, :], SCANNED, axis=-2)
    poses[..., first] = grid
    point = point[:, :, None, None]
    own = (np.arange(pose.shape[-1]) == second).reshape(1, *(1,) * (poses.ndim - 1), -1)
    poses[..., second] = nearest_on_circle(model, poses, own, point)[0]
    distance = np.sum((model.twin.path(poses) - point) ** 2, axis=-1)
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
        low, high = model.twin.robot.motors[motor].movement_range
        margin = 0.2 * (high - low)
        there &= (angle[..., k] > low - margin) & (angle[..., k] < high + margin)
    a, b = np.moveaxis(angle[..., 1:, :] - angle[..., :1, :], -1, 0)
    aa, bb, ab = np.moveaxis(covariance[..., 1:, :], -1, 0)
    apart = bb * a * a + aa * b * b - 2.0 * ab * a * b > SAME**2 * (aa * bb - ab * ab)
    there[..., 1:] &= apart | ~there[..., :1]
    return there


def _over_plane(square: FloatArray, dof: float) -> FloatArray:
    """Return the log of a 3-variate Student t over its centre, integrated over two directions."""
    if np.isinf(dof):
        return np.log(2.0 * np.pi) - 0.5 * square
    whole = np.log(2.0 * np.pi * dof / (dof + 1.0))
    return whole - 0.5 * (dof + 1.0) * np.log1p(square / dof)
