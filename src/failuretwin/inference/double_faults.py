"""Two faults at once: each with its own onset and size, on different motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.numerics import Weighted, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.joint_likelihood import JointLikelihood, joint_likelihoods
from failuretwin.inference.marginal import Estimate, FaultModel, MarginalLikelihood
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.unknown import way_of_two

FEWEST_NATS = 14.0
"""Nodes of the first fault this far below its best, given any movement, are left out."""
MOST_NODES = 400
"""Nodes of each fault to sum over; of laws with more, such as drift, the others are thinned out.
What one fault alone makes of a movement says little of its size beside another, so few can be
spared."""


def double_fault_likelihood(
    likelihoods: Sequence[RunLikelihood], fault_models: Sequence[tuple[FaultModel, FaultModel]]
) -> MarginalLikelihood:
    """Return what runs say of two faults at once.

    Args:
        likelihoods: One scene of a single run each: the sums over two sizes need memory.
        fault_models: The laws of the two faults in each, of different motors.
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
    alone = [
        _cells(_alone(likelihood, fault_model), fault_model) for fault_model in (one, two)
    ]  # (movement, cell)
    both = _both(likelihood, one, two)  # (movement, cell of one, cell of two)
    settled = likelihood.log_healthy[0], alone, both
    ways = [_way(likelihood, fault_model) for fault_model in (one, two)]
    alone = [values + way for values, way in zip(alone, ways, strict=True)]
    # The way with both faults is not computed for each node: it is no less probable than with one
    # of them, or with both motors where they are seen to settle.
    with_two = way_of_two(likelihood, (one.motor, two.motor))[0]
    both = both + np.maximum(
        np.maximum(ways[0][:, :, None], ways[1][:, None]), with_two[:, None, None]
    )
    healthy, count = settled[0] + likelihood.log_transient[0], len(both)
    prior = [fault_model.log_prior[0] for fault_model in (one, two)]  # (movement, cell)

    before = _sums(healthy)
    first, second = (_sums(values) for values in alone)
    together = _sums(both)
    terms = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            prior_before_run, late = min(i, j), max(i, j)
            between = (
                (first[late] - first[prior_before_run])[:, None]
                if i <= j
                else (second[late] - second[prior_before_run])[None, :]
            )
            joint = between + (together[-1] - together[late])
            joint = joint + prior[0][i][:, None] + prior[1][j][None, :]
            terms[i, j] = before[prior_before_run] + log_sum(joint, axis=(0, 1))
    log_evidence = log_sum(terms, axis=(0, 1))
    share = np.exp(terms - log_evidence)
    at = np.unravel_index(np.argmax(share), share.shape)
    first_two = int(at[0]), int(at[1])
    onset = _earliest(one, two, share)

    def estimate(run: int) -> Estimate:
        return Estimate(onset, None, np.zeros_like(likelihood.outcome_probability[run]))

    return MarginalLikelihood(
        log_evidence=np.atleast_1d(log_evidence),
        by_movement=lambda run: _by_movement(healthy, alone, both, *first_two),
        settled=lambda run: _by_movement(*settled, *first_two),
        estimate=estimate,
    )


def _way(likelihood: RunLikelihood, fault_model: FaultModel) -> FloatArray:
    """Return log densities of the way with one of the faults alone, (movement, node or 1)."""
    if fault_model.log_transient is not None:
        return fault_model.log_transient[0]
    return likelihood.log_transient_offset(fault_model.motor, fault_model.gain)[0][:, None]


def _alone(likelihood: RunLikelihood, fault_model: FaultModel) -> FloatArray:
    """Return log densities with one of the faults alone, (movement, node)."""
    return likelihood.profile(fault_model.motor).log_density(fault_model.angle, fault_model.held)[0]


def _both(likelihood: RunLikelihood, one: FaultModel, two: FaultModel) -> FloatArray:
    """Return log densities with both faults, (movement, cell of one, cell of two)."""
    profile = _given(likelihood, one, two.motor)
    angle = two.angle[:, :, None]  # (run, movement, 1, node of two, alternative)
    if not two.held:  # an offset from where the motor settles with the other fault there
        angle = angle - likelihood.profile(two.motor).expected[:, :, None, None]
        angle = angle + profile.expected[:, :, :, None]
    density = profile.log_density(angle, two.held)[0]
    density = _cells(density, two)
    return np.swapaxes(_cells(np.swapaxes(density, 1, 2), one), 1, 2)


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


def _cells(density: FloatArray, fault_model: FaultModel) -> FloatArray:
    """Return densities by cell: by node, or by group where every movement draws its own node."""
    if fault_model.redrawn is None:
        return density
    return log_sum(density[..., None, :] + fault_model.redrawn, axis=-1)


def _thinned(likelihood: RunLikelihood, fault_model: FaultModel) -> FaultModel:
    """Return the fault model with few nodes: those within reach of what the movements say."""
    nodes = fault_model.angle.shape[2]
    if fault_model.redrawn is not None or nodes <= MOST_NODES:
        return fault_model
    density = _alone(likelihood, fault_model)
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


def _sums(values: FloatArray) -> FloatArray:
    """Return sums of the first 0, 1, ... entries along the first axis."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _by_movement(
    healthy: FloatArray, alone: list[FloatArray], both: FloatArray, one: int, two: int
) -> FloatArray:
    """Return log densities of each movement with the most probable onsets, best cells."""
    movement = np.arange(len(healthy))
    return np.where(
        movement < min(one, two),
        healthy,
        np.where(
            movement < max(one, two),
            alone[0 if one <= two else 1].max(axis=1),
            both.max(axis=(1, 2)),
        ),
    )


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
