"""The marginal likelihood of a fault: the sum over its change point and all else unknown of it.

    p(run | h) = sum over m0, z of p(m0, z) prod_{m<m0} exp L_m(healthy)
                                            prod_{m>=m0} exp L_m(phi(z))

Movements before the change point m0 are those of a healthy robot. A `FaultModel` holds the nodes z
and the angle phi of each; what a node says of a movement comes from the joint likelihood of its
motor. Sums over m0 and the nodes are exact. Where readings on the way count, each L_m is the sum of
the settled and the transient log likelihood.

Section: docs/inference.md#change-points
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import Weighted, log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.movements.joint_likelihood import JointLikelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood, share_of

# What runs say of a hypothesis: evidence, posterior of what is unknown, estimates.


@dataclass(frozen=True)
class Estimate:
    """What one run says of a fault that is taken to be there.

    Attributes:
        onset: Distribution of the onset [s]; None without a fault.
        size: Distribution of the magnitude; None where it has none.
        outcome_probability: Probability of each outcome, (movement, outcome).
    """

    onset: Weighted | None
    size: Weighted | None
    outcome_probability: FloatArray


@dataclass(frozen=True)
class MarginalLikelihood:
    """What some runs say of one hypothesis.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement of a run given all others, (movement,), by the
            run's index; asked for few hypotheses alone.
        settled: The same of its settled position alone.
        estimate: Onset and size in a run, by its index; asked for the best hypothesis alone.
    """

    log_evidence: FloatArray
    by_movement: Callable[[int], FloatArray]
    settled: Callable[[int], FloatArray]
    estimate: Callable[[int], Estimate]

    def shown_by(self, other: MarginalLikelihood, where: BoolArray) -> MarginalLikelihood:
        """Return the same with the movements of some runs as another hypothesis has them.

        Args:
            other: That hypothesis.
            where: Which runs, (run,).
        """
        return replace(
            self,
            by_movement=lambda run: (other if where[run] else self).by_movement(run),
            settled=lambda run: (other if where[run] else self).settled(run),
        )


# The change point: the first movement m0 that a fault spoils, and the cell z of all else unknown.


def change_points(
    log_healthy: FloatArray, log_faulty: FloatArray, log_prior: FloatArray
) -> FloatArray:
    """Return the log density of each run with each first movement spoilt and each cell.

    log p(e, m0, z) = sum_{m < m0} L_m(healthy) + sum_{m >= m0} L_m(z) + log p(m0, z)

    Args:
        log_healthy: Log density of each movement before the fault, (run, movement), or with axes
            for cells as below.
        log_faulty: The same with it, (run, movement, cell, ...).
        log_prior: log p(m0, z), axes as of `log_faulty`.

    Returns:
        (run, movement, cell, ...).
    """
    cells = (1,) * (log_faulty.ndim - log_healthy.ndim)
    before = np.cumsum(log_healthy, axis=1) - log_healthy
    after = np.cumsum(log_faulty[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(before.reshape(*before.shape, *cells) + after + log_prior)


@dataclass(frozen=True)
class ChangePointPosterior:
    """Log evidence of each run, and of first movement and cell given it.

    Attributes:
        log_evidence: log p(e) = log sum over m0 and z of p(e, m0, z), (run,).
        log_responsibility: log p(m0, z | e), (run, movement, cell).
    """

    log_evidence: FloatArray
    log_responsibility: FloatArray

    @classmethod
    def of(cls, log_joint: FloatArray) -> ChangePointPosterior:
        """Return the posterior that belongs to log p(e, m0, z), (run, movement, cell)."""
        log_evidence = log_sum(log_joint, axis=(1, 2))
        return cls(log_evidence, log_joint - log_evidence[:, None, None])


def leave_one_out(
    healthy: FloatArray, faulty: FloatArray, log_responsibility: FloatArray
) -> FloatArray:
    """Return the log density of each movement of a run given all others, (movement,).

    It is one over the posterior mean of one over its density.

    Args:
        healthy: Log density of each movement if all is well, (movement,).
        faulty: The same with the fault, (movement, cell).
        log_responsibility: Log posterior of first movement spoilt and cell, (movement, cell).
    """
    affected = np.logaddexp.accumulate(log_responsibility, axis=0)
    not_yet = np.full_like(healthy, -np.inf)
    later = log_sum(log_responsibility, axis=1)[::-1]
    not_yet[:-1] = np.logaddexp.accumulate(later)[::-1][1:]
    return -np.logaddexp(log_sum(affected - faulty, axis=1), not_yet - healthy)


@dataclass(frozen=True)
class FaultModel:
    """How a fault makes one motor settle.

    Attributes:
        motor: Index of the motor.
        held: Whether the gear holds the motor exactly at `angle`.
        angle: Where it settles, (run, movement, node, outcome) [rad]; axes may be 1.
        log_prior: Log probability of the first movement spoilt and the node,
            (run, movement, node), or of the group of nodes where nodes are redrawn.
        size: Magnitude of the fault at each node, (run, node), or (run, movement, node) where nodes
            are redrawn.
        onsets: Onset at each node of a run, by its index, (movement, node, sample) [s], and the
            share of each sample, same axes; axes of nodes and movements may be 1.
        redrawn: Log weights of the nodes in each group, (run, movement, group, node), where every
            movement draws its own node; None: one node holds for the whole run.
        log_transient: Log density of the readings on the way at each node, (run, movement, node);
            None: as for any motor that settles off its target.
        gain: By how much the motor is off for each unit of an amount that holds for the run,
            (run, movement, outcome) [rad]; None: other movements do not tell.
    """

    motor: int
    held: bool
    angle: FloatArray
    log_prior: FloatArray
    size: FloatArray
    onsets: Callable[[int], tuple[FloatArray, FloatArray]]
    redrawn: FloatArray | None = None
    log_transient: FloatArray | None = None
    gain: FloatArray | None = None

    def by_cell(self, by_node: FloatArray) -> FloatArray:
        """Return log densities by cell: by node, or by group where nodes are redrawn, (..., cell).

        Args:
            by_node: Log densities at each node, (..., node).
        """
        if self.redrawn is None:
            return by_node
        top = by_node.max(axis=-1, keepdims=True)
        runs, movements, *sums = self.redrawn.shape
        between = (1,) * (by_node.ndim - 3)  # axes for the cells of another fault
        weights = np.exp(self.redrawn).reshape(runs, movements, *between, *sums)
        return np.asarray(top + np.log((weights @ np.exp(by_node - top)[..., None])[..., 0]))


@dataclass(frozen=True)
class MovementLogLikelihoods:
    """Log densities of each movement with a fault.

    Attributes:
        by_node: Of its settled position at each node, (run, movement, node).
        by_cell: The same with nodes that are redrawn summed in their groups,
            (run, movement, cell).
        way: Of its readings on the way, (run, movement, cell) or the same for all cells,
            (run, movement, 1).
    """

    by_node: FloatArray
    by_cell: FloatArray
    way: FloatArray


def movement_log_likelihoods(
    likelihood: RunLikelihood, fault_model: FaultModel
) -> MovementLogLikelihoods:
    """Return what each movement says of a fault of one motor."""
    profile, way = likelihood.profile(fault_model.motor), fault_model.log_transient
    by_node = profile.log_density(fault_model.angle, fault_model.held)
    if way is None:
        way = likelihood.log_transient_offset(fault_model.motor, fault_model.gain)[..., None]
    return MovementLogLikelihoods(by_node, fault_model.by_cell(by_node), way)


def marginal_likelihood(likelihood: RunLikelihood, fault_model: FaultModel) -> MarginalLikelihood:
    """Return what the runs say of a fault of one motor."""
    profile = likelihood.profile(fault_model.motor)
    says = movement_log_likelihoods(likelihood, fault_model)
    by_node, density = says.by_node, says.by_cell
    healthy, faulty = likelihood.log_healthy, density + says.way
    usual = healthy + likelihood.log_transient
    found = ChangePointPosterior.of(change_points(usual, faulty, fault_model.log_prior))

    def by_movement(run: int) -> FloatArray:
        return leave_one_out(usual[run], faulty[run], found.log_responsibility[run])

    def settled(run: int) -> FloatArray:
        return leave_one_out(healthy[run], density[run], found.log_responsibility[run])

    def estimate(run: int) -> Estimate:
        share = np.exp(found.log_responsibility[run])
        if fault_model.redrawn is None:
            cells = share.sum(axis=0)
            size = Weighted(_of_run(fault_model.size, run), cells)
            nodes = np.broadcast_to(cells, by_node[run].shape)
        else:
            of_node = by_node[run][:, None] + fault_model.redrawn[run] - density[run][..., None]
            of_node = np.exp(of_node)
            exists = likelihood.evidence.movements.exists[run]
            size = _rms(exists, of_node, share, fault_model.size[run])
            nodes = np.einsum("fg,mgn->mn", share, of_node)
        outcome_probability = _became(profile, fault_model, run, share, nodes)
        return Estimate(_onset(fault_model, run, share), size, outcome_probability)

    return MarginalLikelihood(found.log_evidence, by_movement, settled, estimate)


def _of_run(values: FloatArray, run: int) -> FloatArray:
    """Return the part of one run; a leading axis of 1 is the same for all."""
    return np.asarray(values[run if len(values) > 1 else 0])


def _onset(fault_model: FaultModel, run: int, share: FloatArray) -> Weighted:
    """Return the distribution of the onset of a run [s]."""
    onset, part = fault_model.onsets(run)
    if onset.shape[1] == 1:
        share = share.sum(axis=1, keepdims=True)
    weight = share[..., None] * part
    return Weighted(np.broadcast_to(onset, weight.shape).ravel(), weight.ravel())


def _rms(exists: BoolArray, nodes: FloatArray, share: FloatArray, offset: FloatArray) -> Weighted:
    """Return the distribution of the rms of redrawn offsets over the movements spoilt.

    The mean square is a sum of independent terms; it is taken as normal with their mean and
    variance, for every first movement and group.

    Args:
        exists: Movements that are there, (movement,).
        nodes: Posterior of each node, (movement, group, node).
        share: Posterior of first movement and group, (movement, group).
        offset: Offsets, (movement, node).
    """
    there = exists[:, None]
    second, fourth = (np.einsum("mgn,mn->mg", nodes, offset**p) * there for p in (2, 4))

    def from_here(values: FloatArray) -> FloatArray:
        return np.cumsum(values[::-1], axis=0)[::-1]

    count = np.maximum(from_here(there.astype(np.float64)), 1.0)
    mean = from_here(second) / count
    spread = np.sqrt(np.maximum(from_here(fourth - second**2), 0.0)) / count
    steps = np.linspace(-2.4, 2.4, 25)
    squares = mean[..., None] + spread[..., None] * steps
    weight = share[..., None] * np.exp(-0.5 * steps**2)
    return Weighted(np.sqrt(np.maximum(squares, 0.0)).ravel(), weight.ravel())


def _became(
    profile: JointLikelihood,
    fault_model: FaultModel,
    run: int,
    share: FloatArray,
    nodes: FloatArray,
) -> FloatArray:
    """Return the probability of each outcome at the most probable nodes of a run.

    Args:
        profile: What each movement says of the motor.
        fault_model: The fault.
        run: Index of the run.
        share: Posterior of first movement and cell, (movement, cell).
        nodes: Posterior of each node, (movement, node).

    Returns:
        (movement, outcome).
    """
    angle = _of_run(fault_model.angle, run)
    shape = (*nodes.shape, angle.shape[-1])
    best = np.argmax(nodes, axis=1)
    angle = np.broadcast_to(angle, shape)[np.arange(len(best)), best]
    spoilt = np.cumsum(share.sum(axis=1))[:, None] > 0.5
    own = profile[run]
    terms = np.where(
        spoilt, own.log_terms(angle, fault_model.held), own.log_terms(own.expected, False)
    )
    return share_of(terms, profile.outlier, own.usable)
