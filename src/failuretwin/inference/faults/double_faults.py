"""Two faults at once: each with its own onset and size, on different motors.

    p(run | h) = sum over both change points and both sizes of p(m1, z1) p(m2, z2) prod exp L_m

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import Weighted, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.faults.marginal import (
    Estimate,
    FaultModel,
    MarginalLikelihood,
    change_points,
    movement_log_likelihoods,
)
from failuretwin.inference.faults.unknown import way_of_two
from failuretwin.inference.movements.joint_likelihood import JointLikelihood, joint_likelihoods
from failuretwin.inference.movements.run_likelihood import RunLikelihood

FEWEST_NATS = 14.0
"""Nodes of the first fault this far below its best, given any movement, are left out."""
MOST_NODES = 400
"""Nodes of each fault to sum over; of faults with more, such as drift, the others are thinned out.
What one fault alone makes of a movement says little of its size beside another, so few can be
spared."""


def double_fault_likelihood(
    likelihoods: Sequence[RunLikelihood], fault_models: Sequence[tuple[FaultModel, FaultModel]]
) -> MarginalLikelihood:
    """Return what runs say of two faults at once.

    Args:
        likelihoods: Of a single run each: the sums over two sizes need memory.
        fault_models: Fault models of the two faults in each, of different motors.
    """
    found = [
        _weigh_one(likelihood, *pair)
        for likelihood, pair in zip(likelihoods, fault_models, strict=True)
    ]
    return MarginalLikelihood(
        log_evidence=np.concatenate([w.log_evidence for w in found]),
        by_movement=lambda run: found[run].by_movement(0),
        settled=lambda run: found[run].settled(0),
        estimate=lambda run: found[run].estimate(0),
    )


def _weigh_one(likelihood: RunLikelihood, one: FaultModel, two: FaultModel) -> MarginalLikelihood:
    one, two = _thinned(likelihood, one), _thinned(likelihood, two)
    first, second = (movement_log_likelihoods(likelihood, fault) for fault in (one, two))
    settled = _Densities(
        likelihood.log_healthy,
        first.by_cell[..., None],
        second.by_cell[:, :, None],
        _both(likelihood, one, two),
    )
    whole = settled.on_way(
        likelihood.log_transient,
        first.way[..., None],
        second.way[:, :, None],
        way_of_two(likelihood, (one.motor, two.motor))[..., None, None],
    )
    log_joint = _log_joint(whole, one.log_prior[..., None], two.log_prior[:, :, None])
    log_evidence = log_sum(log_joint, axis=(0, 1))
    share = np.exp(log_joint - log_evidence)
    begun = np.divmod(int(np.argmax(share)), len(share))
    onset = _earliest(one, two, share)

    def estimate(run: int) -> Estimate:
        return Estimate(onset, None, np.zeros_like(likelihood.outcome_probability[run]))

    return MarginalLikelihood(
        log_evidence=np.atleast_1d(log_evidence),
        by_movement=lambda run: whole.by_movement(*begun),
        settled=lambda run: settled.by_movement(*begun),
        estimate=estimate,
    )


@dataclass(frozen=True)
class _Densities:
    """Log densities of the movements of a run, with none, one and both of two faults.

    Attributes:
        healthy: (1, movement).
        one: With the first fault alone, (1, movement, cell of one, 1).
        two: With the second alone, (1, movement, 1, cell of two).
        both: (1, movement, cell of one, cell of two).
    """

    healthy: FloatArray
    one: FloatArray
    two: FloatArray
    both: FloatArray

    def on_way(
        self, healthy: FloatArray, one: FloatArray, two: FloatArray, seen: FloatArray
    ) -> _Densities:
        """Return the densities with those of the way, axes as of the attributes.

        With both faults the way is not computed for each cell: it is no less probable than with one
        of them, or with both motors where they are `seen` to settle, (1, movement, 1, 1).
        """
        both = np.maximum(np.maximum(one, two), seen)
        return _Densities(self.healthy + healthy, self.one + one, self.two + two, self.both + both)

    def by_movement(self, one: int, two: int) -> FloatArray:
        """Return the log density of each movement under the best cells, (movement,).

        Args:
            one: First movement that the first fault spoils.
            two: First one that the second spoils.
        """
        alone, movement = self.one if one <= two else self.two, np.arange(self.both.shape[1])
        return np.where(
            movement < min(one, two),
            self.healthy[0],
            np.where(
                movement < max(one, two), alone[0].max(axis=(1, 2)), self.both[0].max(axis=(1, 2))
            ),
        )


def _log_joint(says: _Densities, log_one: FloatArray, log_two: FloatArray) -> FloatArray:
    """Return log p(run, i, j): the faults begin with movements i and j, whatever their cells.

    Once the earlier fault is there, the later one is a change point of what is left of the run.

    Args:
        says: Log densities of the movements.
        log_one: Log prior of first movement and cell of one fault, (1, movement, cell of one, 1).
        log_two: The same of the other, (1, movement, 1, cell of two).
    """
    count = says.both.shape[1]
    joint = np.empty((count, count))
    for i in range(count):
        before, both = says.healthy[0, :i].sum(), says.both[:, i:]
        later = change_points(says.one[:, i:], both, log_one[:, i, None] + log_two[:, i:])
        joint[i, i:] = before + log_sum(later[0], axis=(1, 2))
        later = change_points(says.two[:, i:], both, log_one[:, i:] + log_two[:, i, None])
        joint[i + 1 :, i] = before + log_sum(later[0, 1:], axis=(1, 2))
    return joint


def _both(likelihood: RunLikelihood, one: FaultModel, two: FaultModel) -> FloatArray:
    """Return log densities with both faults, (1, movement, cell of one, cell of two)."""
    profile = _given(likelihood, one, two.motor)
    angle = two.angle[:, :, None]  # (run, movement, 1, node of two, alternative)
    if not two.held:  # an offset from where the motor settles with the other fault there
        angle = angle - likelihood.profile(two.motor).expected[:, :, None, None]
        angle = angle + profile.expected[:, :, :, None]
    density = two.by_cell(profile.log_density(angle, two.held))
    return np.swapaxes(one.by_cell(np.swapaxes(density, 2, 3)), 2, 3)


def _given(likelihood: RunLikelihood, one: FaultModel, motor: int) -> JointLikelihood:
    """Return the profile of a motor with another fault there, at each of its nodes."""
    shape = likelihood.outcomes.base.shape
    angle = np.broadcast_to(one.angle, (1, shape[1], one.angle.shape[2], shape[2]))
    (profile,) = joint_likelihoods(
        likelihood.evidence,
        likelihood.model,
        likelihood.outcomes,
        [motor],
        other=one.motor,
        other_angle=angle,
        other_held=one.held,
    )
    return profile


def _thinned(likelihood: RunLikelihood, fault_model: FaultModel) -> FaultModel:
    """Return the fault model with few nodes: those within reach of what the movements say."""
    nodes = fault_model.angle.shape[2]
    if fault_model.redrawn is not None or nodes <= MOST_NODES:
        return fault_model
    profile = likelihood.profile(fault_model.motor)
    density = profile.log_density(fault_model.angle, fault_model.held)[0]
    near = density - density.max(axis=1, keepdims=True) > -FEWEST_NATS
    score = near.sum(axis=0) + log_sum(fault_model.log_prior[0], axis=0) / 100.0
    kept = np.sort(np.argsort(-score, kind="stable")[:MOST_NODES])
    owner = _nearest(fault_model.size[0], fault_model.size[0][kept])
    prior = np.full((*fault_model.log_prior.shape[:2], len(kept)), -np.inf)
    for node, cell in enumerate(owner):  # the mass of a node left out goes to its neighbour
        prior[..., cell] = np.logaddexp(prior[..., cell], fault_model.log_prior[..., node])

    def of_run(run: int) -> tuple[FloatArray, FloatArray]:
        onset, part = fault_model.onsets(run)
        return _of_nodes(onset, kept), _of_nodes(part, kept)

    return replace(
        fault_model,
        angle=fault_model.angle[:, :, kept],
        log_prior=prior,
        size=fault_model.size[:, kept],
        onsets=of_run,
        log_transient=None
        if fault_model.log_transient is None
        else fault_model.log_transient[:, :, kept],
    )


def _of_nodes(values: FloatArray, nodes: IntArray) -> FloatArray:
    """Return the values (movement, node, sample) of some nodes; a node axis of 1 is for all."""
    return values if values.shape[1] == 1 else values[:, nodes]


def _nearest(values: FloatArray, kept: FloatArray) -> IntArray:
    return np.argmin(np.abs(values[:, None] - kept), axis=1)


def _earliest(one: FaultModel, two: FaultModel, share: FloatArray) -> Weighted:
    """Return the distribution of the earlier onset [s].

    Args:
        one: A fault.
        two: The other.
        share: Posterior of the first movement that each spoils, (movement of one, of two).
    """
    values, weights = [], []
    for fault_model, earlier in (
        (one, np.triu(share).sum(axis=1)),
        (two, np.tril(share, -1).sum(axis=0)),
    ):
        onset, part = fault_model.onsets(0)
        onset, part = np.broadcast_arrays(onset, part)
        weight = earlier[:, None, None] * part / part.sum(axis=(1, 2), keepdims=True).clip(1e-300)
        values.append(np.broadcast_to(onset, weight.shape).ravel())
        weights.append(weight.ravel())
    return Weighted(np.concatenate(values), np.concatenate(weights))
