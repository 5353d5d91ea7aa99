"""Where a healthy robot settles, as exactly as one false alarm in a hundred hours asks for.

`HealthyModel.explain` takes all motors to scatter together, and one that missed its command to
scatter anew. Each is told from a fault all the same where a run has five movements; what happens
once in a million movements is not. Here every motor scatters by itself, and one that missed its
command stays where it was last seen to stand:

    p(r) = (1 - K sum q_i) t_nu(r; S) + sum over k, i of q_i N(r; S + (w_i - 1) s_k^2 J_k J_k^T)
    x_k | seen ~ N(mu, v),    v = 1 / (1 / v_0 + sum L_j),    mu = v sum L_j x_j

with the scale matrix S and the Jacobian J of `HealthyModel.residual`, q_i the probability that the
scatter of one motor is drawn with the variance w_i s^2 (a Student t is a normal of a variance that
is drawn: w = nu / chi2_nu; the last i is a blip, which no calibration knows), v_0 = E[w s^2] given
the movement that took the motor there, and x_j what movement j, at which the motor already stood
there, says of where it stands off its target, with precision L_j. A motor that has scattered far
and then misses its command would else look stuck.

Section: docs/inference.md#streams
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import stats

from failuretwin.core.numerics import Covariance, log_norm, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.movements.joint_likelihood import MovementLikelihoods
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

DECADES = (1e-2, 1e-3, 1e-4, 1e-5, 0.0)
"""Shares of movements with a wider scatter of one motor, between which one variance stands for all:
a hundredth is what scatters by itself, the rest all motors share."""
BLIP, BLIP_SCATTERS = 2.5e-5, 20.0
"""How often a motor settles anywhere for one movement, which no model says, and how far off that
is, in scatters; assumed: a hand on the arm, a reading of before."""
NEARLY_ONE = 0.999
"""Most of its own variance that a motor may explain: rounding must not turn precisions negative."""
LEAST = 1e-18
"""Least variance of a motor [rad2]: one that is ideal has none."""


def healthy_log_density(
    evidence: SettledEvidence, found: MovementLikelihoods, since: int = 0
) -> FloatArray:
    """Return the log density of each settled position of a healthy robot, (run, movement).

    Args:
        evidence: Settled positions.
        found: What every movement says by itself.
        since: Number of the first movement that is asked for.

    Returns:
        [log 1/m^dims]; 0 where nothing was seen.
    """
    model, asked = found.model, (slice(None), slice(since, None))
    kept = _Stays.of(evidence, found).kept(model, found.outcomes)
    mean, deviation = (part[asked] for part in kept)
    outcomes, evidence = found.outcomes[asked], evidence[asked]
    possible = np.isfinite(outcomes.log_weight)
    base = (outcomes.base - outcomes.kept + mean)[possible]
    pose = model.settle(base, outcomes.direction[possible], model.none_held)
    point = np.broadcast_to(evidence.point[:, :, None], (*possible.shape, model.sensors.channels))
    made = np.broadcast_to(outcomes.missed == 0, mean.shape)[possible]
    terms = outcomes.log_weight.copy()
    terms[possible] += _log_density(model, point[possible], pose, deviation[possible], made)
    total = np.logaddexp(log_sum(terms, axis=-1), model.outlier_log_density)
    return np.where(evidence.usable, total, 0.0)


def _log_density(
    model: HealthyModel, point: FloatArray, pose: FloatArray, scale: FloatArray, made: BoolArray
) -> FloatArray:
    """Return log p(r) of motors that scatter each by itself, (...).

    Args:
        model: The healthy robot.
        point: Settled positions, (..., channel) [m].
        pose: Angles at which the motors settle, (..., motor) [rad].
        scale: Scale of their scatter, (..., motor) [rad].
        made: Motors that made the movement: those alone scatter anew, (..., motor).
    """
    error, jacobian, spread = model.residual(point, pose, scale)
    together, alone = _ways(model, (error, jacobian, spread), scale, made)
    return np.asarray(np.logaddexp(together, log_sum(alone, axis=(-2, -1))))


def _ways(
    model: HealthyModel,
    residual: tuple[FloatArray, FloatArray, Covariance],
    scale: FloatArray,
    made: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Return log p(r, way): all motors scatter together (...); one far (..., motor, variance).

    Args:
        model: The healthy robot.
        residual: What `HealthyModel.residual` says.
        scale: Scale of the motors' scatter, (..., motor) [rad].
        made: Motors that made the movement, (..., motor).
    """
    error, jacobian, spread = residual
    dof, dims = model.settling.tail_dof, model.sensors.dims
    together = spread.log_student(error, dof)
    share, variance = wide_scatter(dof)
    pull = np.einsum("...ak,...a->...k", jacobian, spread.solve(error))[..., None]
    precision = _own_precision(jacobian, spread)[..., None]
    more = (variance - 1.0) * (scale**2)[..., None]
    inflation = 1.0 + more * precision
    square = spread.product(error, error)[..., None, None] - more * pull**2 / inflation
    alone = log_norm(np.inf, dims) - 0.5 * np.log(spread.determinant)[..., None, None]
    alone = alone - 0.5 * (square + np.log(inflation)) + np.log(share)
    usual = np.log1p(-share.sum() * made.sum(axis=-1))
    return usual + together, np.where(made[..., None], alone, -np.inf)


def _seen_variance(
    model: HealthyModel, residual: tuple[FloatArray, FloatArray, Covariance]
) -> FloatArray:
    """Return the variance with which each motor has scattered, by what was seen, (..., motor).

    E[w s^2 | r] over the ways in which it may have come about; of the Student t that all motors
    share, E[w | r] = (nu + D^2) / (nu + d - 2).

    Args:
        model: The healthy robot.
        residual: What `HealthyModel.residual` says.
    """
    error, _, spread = residual
    dof = model.settling.tail_dof
    scale = np.broadcast_to(model.scatter, (*error.shape[:-1], len(model.scatter)))
    together, alone = _ways(model, residual, scale, np.ones(scale.shape, dtype=bool))
    total = np.logaddexp(together, log_sum(alone, axis=(-2, -1)))
    far = np.exp(alone - total[..., None, None])
    square, dims = spread.product(error, error), model.sensors.dims
    common = np.ones_like(square) if np.isinf(dof) else (dof + square) / (dof + dims - 2.0)
    factor = np.exp(together - total) * (common - 1.0)
    widened = (far * (wide_scatter(dof)[1] - 1.0)).sum(axis=-1)
    return np.asarray((1.0 + factor[..., None] + widened) * scale**2)


@lru_cache(maxsize=64)
def wide_scatter(dof: float) -> tuple[FloatArray, FloatArray]:
    """Return how often one motor scatters far, and how far: q and w, (decade + 1,) each.

    Args:
        dof: nu of the scatter's Student t.
    """
    if np.isinf(dof):
        return np.array([BLIP]), np.array([BLIP_SCATTERS**2])
    rarer = np.array(DECADES)
    share, middle = -np.diff(rarer), 0.5 * (rarer[:-1] + rarer[1:])
    variance = dof / stats.chi2.ppf(middle, dof)
    return np.append(share, BLIP), np.append(variance, BLIP_SCATTERS**2)


def _own_precision(jacobian: FloatArray, spread: Covariance) -> FloatArray:
    """Return J_k^T S^-1 J_k of each motor, (..., motor) [1/rad2]."""
    columns = np.swapaxes(jacobian, -1, -2)
    return np.stack([spread.product(a, a) for a in np.moveaxis(columns, -2, 0)], axis=-1)


@dataclass(frozen=True)
class _Stays:
    """Where each motor stands off its last target, by all that was seen since it went there.

    Attributes:
        missed: Commands that it has most probably missed in a row, (run, movement, motor).
        seen: Movements that say so, (run, movement).
        precision: sum L, (run, movement, motor) [1/rad2].
        pull: sum L x, (run, movement, motor) [1/rad].
        more: v_0 - s^2, by how much wider it has scattered, (run, movement, motor) [rad2].
    """

    missed: IntArray
    seen: BoolArray
    precision: FloatArray
    pull: FloatArray
    more: FloatArray

    @classmethod
    def of(cls, evidence: SettledEvidence, found: MovementLikelihoods) -> _Stays:
        """Return them by the most probable outcome of each movement."""
        model, outcomes = found.model, found.outcomes
        best = np.argmax(found.terms, axis=-1)

        def at_best(values: FloatArray) -> FloatArray:
            return np.take_along_axis(values, best[..., None, None], axis=2)[:, :, 0]

        base, direction = at_best(outcomes.base - outcomes.kept), at_best(outcomes.direction)
        pose = model.settle(base, direction, model.none_held)
        residual = model.residual(evidence.point, pose, model.scatter)
        variance = _seen_variance(model, residual)
        error, jacobian, spread = model.residual(evidence.point, pose, np.sqrt(variance))
        own = _own_precision(jacobian, spread)
        others = 1.0 - np.minimum(variance * own, NEARLY_ONE)
        top = np.take_along_axis(found.terms, best[..., None], axis=-1)[..., 0]
        total = np.logaddexp(log_sum(found.terms, axis=-1), model.outlier_log_density)
        trust = np.where(evidence.usable, np.exp(top - total), 0.0)[..., None]
        precision = trust * own / others
        pull = trust * np.einsum("...ak,...a->...k", jacobian, spread.solve(error)) / others
        more, missed = trust * (variance - model.scatter**2), outcomes.missed[best]
        for m in range(1, missed.shape[1]):
            stays = missed[:, m] == missed[:, m - 1] + 1
            precision[:, m] += np.where(stays, precision[:, m - 1], 0.0)
            pull[:, m] += np.where(stays, pull[:, m - 1], 0.0)
            more[:, m] = np.where(stays, more[:, m - 1], more[:, m])
        return cls(missed, evidence.usable, precision, pull, more)

    def kept(self, model: HealthyModel, outcomes: CommandOutcomes) -> tuple[FloatArray, FloatArray]:
        """Return mu and the scale of what is left, (run, movement, outcome, motor) [rad]."""
        precision, pull, more = np.moveaxis(self._since(outcomes.missed), -1, 0)
        variance = 1.0 / (1.0 / np.maximum(model.scatter**2 + more, LEAST) + precision)
        left = np.sqrt(variance + np.where(precision > 0.0, model.held_scatter**2, 0.0))
        return variance * pull, left

    def _since(self, missed: IntArray) -> FloatArray:
        """Return what the latest movement of a stay that was seen says of it, (..., motor, value).

        Args:
            missed: Commands in a row that each outcome has missed, (outcome, motor).

        Returns:
            Precision, pull and more; 0 where nothing was seen.
        """
        runs, count, _ = self.missed.shape
        ago = np.zeros((runs, count, *missed.shape), dtype=np.int64)
        open_ = np.broadcast_to(missed > 0, ago.shape).copy()
        for back in range(1, min(int(missed.max(initial=0)), count - 1) + 1):
            before = slice(0, count - back)
            fits = self.missed[:, before, None] == missed - back
            seen = self.seen[:, before, None, None]
            ago[:, back:][open_[:, back:] & seen & (missed >= back) & fits] = back
            open_[:, back:] &= ~seen
        told, at = np.stack([self.precision, self.pull, self.more], axis=-1), np.nonzero(ago)
        found = np.zeros((*ago.shape, told.shape[-1]))
        found[at] = told[at[0], at[1] - ago[at], at[3]]
        return found
