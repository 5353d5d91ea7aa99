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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import stats

from failuretwin.core.numerics import Covariance, log_norm, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.movements.joint_likelihood import JointLikelihood, MovementLikelihoods
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
    error, _, spread = model.residual(point[possible], pose, deviation[possible])
    far = _far(model, found.profiles, lambda values: values[asked][possible])
    dof = model.settling.tail_dof
    together = spread.log_student(error, dof) + np.log1p(-_far_rate(dof) * made.sum(axis=-1))
    terms = outcomes.log_weight.copy()
    terms[possible] += together
    alone = np.full(terms.shape, -np.inf)
    alone[possible] = log_sum(np.where(made[..., None], far, -np.inf), axis=(-2, -1))
    total = np.logaddexp(log_sum(terms, axis=-1), log_sum(alone, axis=-1))
    total = np.logaddexp(total, model.outlier_log_density)
    return np.where(evidence.usable, total, 0.0)


def _far(
    model: HealthyModel,
    profiles: Sequence[JointLikelihood],
    of: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Return log w_a q_i N(r) of each motor that scatters far by itself, (..., motor, variance).

    On the circle on which it takes the tool: so far off, a tangent is not near enough.

    Args:
        model: The healthy robot.
        profiles: What the movements say of each motor.
        of: Which outcomes are asked for, of (run, movement, outcome).
    """
    dof, dims = model.settling.tail_dof, model.sensors.dims
    share, variance = wide_scatter(dof)
    off = np.stack([of(one.turned(one.faulty_baseline - one.mode)) for one in profiles], axis=-1)
    nearest = np.stack([of(one.min_distance2) for one in profiles], axis=-1)
    precision = np.stack([of(one.precision) for one in profiles], axis=-1)[..., None]
    weight = np.stack([of(one.log_weight) for one in profiles], axis=-1)
    inflation = 1.0 + (model.scatter**2)[:, None] * variance * precision
    square = nearest[..., None] + precision * (off**2)[..., None] / inflation
    normal = log_norm(np.inf, dims) - log_norm(dof, dims)
    alone = weight[..., None] + normal - 0.5 * (square + np.log(inflation)) + np.log(share)
    return np.asarray(alone)


def _far_rate(dof: float) -> float:
    """Return the share of movements in which one given motor scatters far by itself."""
    return float(wide_scatter(dof)[0].sum())


def _seen_variance(
    model: HealthyModel, together: FloatArray, far: FloatArray, square: FloatArray
) -> FloatArray:
    """Return the variance with which each motor has scattered, by what was seen, (..., motor).

    E[w s^2 | r] over the ways in which it may have come about; of the Student t that all motors
    share, E[w | r] = (nu + D^2) / (nu + d - 2).

    Args:
        model: The healthy robot.
        together: Log density if all motors scatter together, (...).
        far: The same if one scatters far, (..., motor, variance).
        square: D^2, (...).
    """
    dof, dims = model.settling.tail_dof, model.sensors.dims
    together = together + np.log1p(-_far_rate(dof) * far.shape[-2])
    total = np.logaddexp(together, log_sum(far, axis=(-2, -1)))
    common = np.ones_like(square) if np.isinf(dof) else (dof + square) / (dof + dims - 2.0)
    wider = np.exp(together - total) * (common - 1.0)
    one = np.exp(far - total[..., None, None]) * (wide_scatter(dof)[1] - 1.0)
    return np.asarray((1.0 + wider[..., None] + one.sum(axis=-1)) * model.scatter**2)


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


def _chosen(values: FloatArray, outcome: IntArray) -> FloatArray:
    """Return the values of one outcome of each movement, (run, movement)."""
    return np.take_along_axis(values, outcome[..., None], axis=-1)[..., 0]


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
        error, _, spread = model.residual(evidence.point, pose, model.scatter)
        far = _far(model, found.profiles, lambda values: _chosen(values, best))
        square = spread.product(error, error)
        variance = _seen_variance(model, _chosen(found.terms, best), far, square)
        error, jacobian, spread = model.residual(evidence.point, pose, np.sqrt(variance))
        own = _own_precision(jacobian, spread)
        others = 1.0 - np.minimum(variance * own, NEARLY_ONE)
        top = _chosen(found.terms, best)
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
        told = self.precision, self.pull, self.more
        precision, pull, more = (self._since(values, outcomes.missed) for values in told)
        variance = 1.0 / (1.0 / np.maximum(model.scatter**2 + more, LEAST) + precision)
        left = np.sqrt(variance + np.where(precision > 0.0, model.held_scatter**2, 0.0))
        return variance * pull, left

    def _since(self, values: FloatArray, missed: IntArray) -> FloatArray:
        """Return what the latest movement of a stay that was seen says of it, (..., motor).

        Args:
            values: By movement, (run, movement, motor).
            missed: Commands in a row that each outcome has missed, (outcome, motor).
        """
        runs, count, motors = values.shape
        found = np.zeros((runs, count, len(missed), motors))
        open_ = np.broadcast_to(missed > 0, found.shape).copy()
        for back in range(1, min(int(missed.max(initial=0)), count - 1) + 1):
            before = slice(0, count - back)
            fits = self.missed[:, before, None] == missed - back
            seen = self.seen[:, before, None, None]
            now = open_[:, back:] & seen & (missed >= back)
            found[:, back:] = np.where(now & fits, values[:, before, None], found[:, back:])
            open_[:, back:] &= ~seen
        return found
