"""Faults as laws: where a motor settles with a fault, over nodes of all that is unknown of it.

The fault begins with some movement; movements before it are those of a healthy robot. Sums over
the first movement and the nodes are exact; what each node says of a movement comes from the
profile of the motor.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.quadrature import log_sum, weighted_quantiles
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.motor_profile import MotorProfile, motor_profile

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that are told: the ends of a 90 % interval and the median."""


@dataclass(frozen=True)
class Scene:
    """Some runs, ready to be weighed: what was seen, and what a healthy robot would do.

    Attributes:
        evidence: Settled positions.
        model: The healthy robot.
    """

    evidence: SettledEvidence
    model: HealthyModel
    _profiles: dict[int, MotorProfile] = field(default_factory=dict, compare=False, repr=False)

    def __getitem__(self, run: int) -> Scene:
        """Return the scene of one of the runs."""
        return Scene(self.evidence[run : run + 1], self.model)

    @cached_property
    def alternatives(self) -> Alternatives:
        """What may have become of each movement."""
        return self.model.alternatives(self.evidence.movements)

    @cached_property
    def _healthy_terms(self) -> FloatArray:
        """Log weight times density of each alternative, (run, movement, alternative)."""
        return self.model.log_terms(self.evidence, self.alternatives)

    @cached_property
    def log_healthy(self) -> FloatArray:
        """Log density of each movement if no motor is faulty, (run, movement)."""
        return with_outliers(self._healthy_terms, self.model.outlier_log_density, self.usable)

    @cached_property
    def became(self) -> FloatArray:
        """Probability of each alternative if no motor is faulty, (run, movement, alternative)."""
        return share_of(self._healthy_terms, self.model.outlier_log_density, self.usable)

    @property
    def usable(self) -> BoolArray:
        """Movements with evidence, (run, movement)."""
        return self.evidence.usable

    def profile(self, motor: int) -> MotorProfile:
        """Return what each movement says of one motor, computed once."""
        if motor not in self._profiles:
            found = motor_profile(self.evidence, self.model, self.alternatives, motor)
            self._profiles[motor] = found
        return self._profiles[motor]


@dataclass(frozen=True)
class Law:
    """How a fault makes one motor settle.

    Attributes:
        motor: Index of the motor.
        held: Whether the gear holds the motor exactly at `angle`.
        angle: Where it settles, (run, movement, node, alternative) [rad]; axes may be 1.
        log_prior: Log probability of the first movement spoilt and the node,
            (run, movement, node), or of the group of nodes where nodes are redrawn.
        size: Magnitude of the fault at each node, (run, node).
        onset: Onset at each node, (run, movement, node, sample) [s]; axes may be 1.
        onset_share: Share of each sample of it, same axes.
        redrawn: Log weights of the nodes in each group, (group, node), where every movement draws
            its own node; None: one node holds for the whole run.
    """

    motor: int
    held: bool
    angle: FloatArray
    log_prior: FloatArray
    size: FloatArray
    onset: FloatArray
    onset_share: FloatArray
    redrawn: FloatArray | None = None


@dataclass(frozen=True)
class Weight:
    """What some runs say of one hypothesis.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement given all others, (run, movement).
        onset: Quantiles 5, 50, 95 % of the onset, (run, 3) [s].
        size: Quantiles 5, 50, 95 % of the magnitude, (run, 3).
        became: Probability of each alternative, (run, movement, alternative), at the most
            probable node.
    """

    log_evidence: FloatArray
    by_movement: FloatArray
    onset: FloatArray
    size: FloatArray
    became: FloatArray


@dataclass(frozen=True)
class Posterior:
    """Log evidence of each run, and of first movement and cell given it.

    Attributes:
        log_evidence: (run,).
        log_share: Log posterior, (run, movement first spoilt, cell).
        by_movement: Log density of each movement given all others, (run, movement).
    """

    log_evidence: FloatArray
    log_share: FloatArray
    by_movement: FloatArray


def posterior_of(log_healthy: FloatArray, density: FloatArray, log_prior: FloatArray) -> Posterior:
    """Sum over the first movement that a fault spoils and over its cells.

    Args:
        log_healthy: Log density of each movement if all is well, (run, movement).
        density: The same with the fault, (run, movement, cell).
        log_prior: Log probability of first movement and cell, (run, movement, cell).
    """
    before = np.cumsum(log_healthy, axis=1) - log_healthy
    after = np.cumsum(density[:, ::-1], axis=1)[:, ::-1]
    joint = before[:, :, None] + after + log_prior
    log_evidence = log_sum(joint, axis=(1, 2))
    log_share = joint - log_evidence[:, None, None]
    return Posterior(log_evidence, log_share, _by_movement(log_healthy, density, log_share))


def weigh(scene: Scene, law: Law) -> Weight:
    """Return what the runs say of a fault of one motor."""
    profile = scene.profile(law.motor)
    by_node = profile.log_density(law.angle, law.held)
    density = by_node
    if law.redrawn is not None:
        terms = by_node[:, :, None] + law.redrawn  # (run, movement, group, node)
        density = log_sum(terms, axis=-1)
    found = posterior_of(scene.log_healthy, density, law.log_prior)
    share = np.exp(found.log_share)
    if law.redrawn is None:
        node_share = np.repeat(share.sum(axis=1)[:, None], density.shape[1], axis=1)
        size = weighted_quantiles(
            np.broadcast_to(law.size, share[:, 0].shape), node_share[:, 0], LEVELS
        )
    else:
        nodes = np.exp(terms - density[..., None])
        node_share = np.einsum("rg,rmgn->rmn", share.sum(axis=1), nodes)
        size = _rms_quantiles(scene, nodes, share, law.size[0])
    return Weight(
        log_evidence=found.log_evidence,
        by_movement=found.by_movement,
        onset=_onset_quantiles(law, share),
        size=size,
        became=_became(profile, law, share, node_share),
    )


def _by_movement(log_healthy: FloatArray, density: FloatArray, log_share: FloatArray) -> FloatArray:
    """Return the log density of each movement given all others, (run, movement).

    It is one over the posterior mean of one over its density.
    """
    affected = np.logaddexp.accumulate(log_share, axis=1)
    not_yet = np.full_like(log_healthy, -np.inf)
    later = log_sum(log_share, axis=2)[:, ::-1]
    not_yet[:, :-1] = np.logaddexp.accumulate(later, axis=1)[:, ::-1][:, 1:]
    inverse = np.logaddexp(log_sum(affected - density, axis=2), not_yet - log_healthy)
    return -inverse


def _onset_quantiles(law: Law, share: FloatArray) -> FloatArray:
    """Return quantiles of the onset, (run, 3) [s]."""
    if law.onset.shape[2] == 1:
        share = share.sum(axis=2, keepdims=True)
    weight = share[..., None] * law.onset_share
    onset = np.broadcast_to(law.onset, weight.shape)
    return weighted_quantiles(onset.reshape(len(onset), -1), weight.reshape(len(onset), -1), LEVELS)


def _rms_quantiles(
    scene: Scene, nodes: FloatArray, share: FloatArray, offset: FloatArray
) -> FloatArray:
    """Return quantiles of the rms of redrawn offsets over the movements spoilt, (run, 3).

    The mean square is a sum of independent terms; it is taken as normal with their mean and
    variance, for every first movement and group.

    Args:
        scene: The runs.
        nodes: Posterior of each node, (run, movement, group, node).
        share: Posterior of first movement and group, (run, movement, group).
        offset: Offsets, (node,).
    """
    exists = scene.evidence.movements.exists[..., None]
    second, fourth = (np.einsum("rmgn,n->rmg", nodes, offset**p) * exists for p in (2, 4))

    def from_here(values: FloatArray) -> FloatArray:
        return np.cumsum(values[:, ::-1], axis=1)[:, ::-1]

    count = np.maximum(from_here(exists.astype(np.float64)), 1.0)
    mean = from_here(second) / count
    spread = np.sqrt(np.maximum(from_here(fourth - second**2), 0.0)) / count
    steps = np.linspace(-2.4, 2.4, 25)
    squares = mean[..., None] + spread[..., None] * steps
    weight = share[..., None] * np.exp(-0.5 * steps**2)
    runs = len(share)
    values = np.sqrt(np.maximum(squares, 0.0)).reshape(runs, -1)
    return weighted_quantiles(values, weight.reshape(runs, -1), LEVELS)


def _became(
    profile: MotorProfile, law: Law, share: FloatArray, node_share: FloatArray
) -> FloatArray:
    """Return the probability of each alternative at the most probable node of each movement."""
    best = np.argmax(node_share, axis=2)[..., None, None]
    shape = (*node_share.shape[:2], 1, 1)
    angle = np.broadcast_to(law.angle, (*node_share.shape, law.angle.shape[-1]))
    angle = np.take_along_axis(angle, np.broadcast_to(best, (*shape[:3], angle.shape[-1])), axis=2)
    spoilt = np.cumsum(share.sum(axis=2), axis=1)[..., None] > 0.5
    terms = np.where(
        spoilt,
        profile.log_terms(angle[:, :, 0], law.held),
        profile.log_terms(profile.expected, False),
    )
    return share_of(terms, profile.outlier, profile.usable)


def with_outliers(terms: FloatArray, outlier: float, usable: BoolArray) -> FloatArray:
    """Return the log density whatever became of the commands; 0 where there is no evidence.

    Args:
        terms: Log weight times density of each alternative, (run, movement, alternative).
        outlier: The same of the tool being anywhere.
        usable: Movements with evidence, (run, movement).
    """
    return np.where(usable, np.logaddexp(log_sum(terms, axis=-1), outlier), 0.0)


def share_of(terms: FloatArray, outlier: float, usable: BoolArray) -> FloatArray:
    """Return the probability of each alternative; 0 where there is no evidence.

    Arguments as for `with_outliers`.
    """
    total = np.logaddexp(log_sum(terms, axis=-1), outlier)
    return np.where(usable[..., None], np.exp(terms - total[..., None]), 0.0)
