"""Faults as laws: where a motor settles with a fault, over nodes of all that is unknown of it.

The fault begins with some movement; movements before it are those of a healthy robot. Sums over
the first movement and the nodes are exact; what each node says of a movement comes from the
profile of the motor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.quadrature import Weighted, log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.moving_evidence import MovingEvidence
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.decision.motor_profile import MotorProfile, motor_profile
from failuretwin.decision.ramps import RampModel
from failuretwin.decision.transients import Transients

HELD_ANGLES = 25
"""Held angles at which the way is judged, over the range of a motor."""


@dataclass(frozen=True)
class Scene:
    """Some runs, ready to be weighed: what was seen, and what a healthy robot would do.

    Attributes:
        evidence: Settled positions.
        model: The healthy robot.
        moving: Readings on the way; None: they are left aside.
        way_blur: Factor on the scatter of the way alone; 1 for a robot as it is.
    """

    evidence: SettledEvidence
    model: HealthyModel
    moving: MovingEvidence | None = None
    way_blur: float = 1.0
    _profiles: dict[int, MotorProfile] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )
    _off: dict[tuple[int, bool], FloatArray] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )
    _held: dict[int, FloatArray] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    def __getitem__(self, run: int) -> Scene:
        """Return the scene of one of the runs."""
        rows = slice(run, run + 1)
        moving = None if self.moving is None else self.moving[rows]
        return Scene(self.evidence[rows], self.model, moving, self.way_blur)

    @cached_property
    def alternatives(self) -> Alternatives:
        """What may have become of each movement."""
        return self.model.alternatives(self.evidence.movements)

    @cached_property
    def _explained(self) -> tuple[FloatArray, FloatArray]:
        return self.model.explain(self.evidence, self.alternatives)

    @cached_property
    def transients(self) -> Transients | None:
        """What the readings on the way say; None where they are left aside."""
        if self.moving is None:
            return None
        model = replace(self.model, blur=self.model.blur * self.way_blur)
        ramps = RampModel(model, self.evidence, self.moving)
        return Transients(ramps, self.alternatives, *self._explained)

    @cached_property
    def on_way(self) -> FloatArray:
        """Log density of the readings on the way if no motor is faulty, (run, movement)."""
        return np.zeros(self.usable.shape) if self.transients is None else self.transients.healthy

    def on_way_off(self, motor: int, lasting: bool = False) -> FloatArray:
        """Return the same with one motor that settles off its target, (run, movement).

        Args:
            motor: Index of the motor.
            lasting: Whether it is off by about the same in all movements.
        """
        if self.transients is None:
            return self.on_way
        key = (motor, lasting)
        if key not in self._off:
            self._off[key] = self.transients.off(motor, self.profile(motor), lasting)
        return self._off[key]

    def on_way_held(self, motor: int, angle: FloatArray) -> FloatArray:
        """Return the same with one motor that is held at some angle or gets stuck there.

        Args:
            motor: Index of the motor.
            angle: Angles, (run, node) [rad].

        Returns:
            (run, movement, node); between the angles that were computed, a straight line.
        """
        if self.transients is None:
            return np.repeat(self.on_way[..., None], angle.shape[1], axis=2)
        low, high = self.held_range(motor)
        if motor not in self._held:
            grid = np.linspace(low, high, HELD_ANGLES)
            self._held[motor] = self.transients.held(motor, self.profile(motor), grid)
        place = np.clip((angle - low) / (high - low) * (HELD_ANGLES - 1), 0, HELD_ANGLES - 1)
        left = np.minimum(place.astype(np.int64), HELD_ANGLES - 2)
        share = (place - left)[:, None]
        shape = (*self.usable.shape, angle.shape[1])
        at, after = (
            np.take_along_axis(self._held[motor], np.broadcast_to(k[:, None], shape), axis=2)
            for k in (left, left + 1)
        )
        return at + share * (after - at)

    def held_range(self, motor: int) -> tuple[float, float]:
        """Return the range of angles at which a motor may be held [rad]."""
        low, high = self.model.twin.robot.motors[motor].movement_range
        margin = 0.1 * (high - low)
        return low - margin, high + margin

    @cached_property
    def log_healthy(self) -> FloatArray:
        """Log density of each settled position if no motor is faulty, (run, movement)."""
        return with_outliers(self._explained[0], self.model.outlier_log_density, self.usable)

    @cached_property
    def became(self) -> FloatArray:
        """Probability of each alternative if no motor is faulty, (run, movement, alternative)."""
        return share_of(self._explained[0], self.model.outlier_log_density, self.usable)

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
        onsets: Onset at each node of a run, by its index, (movement, node, sample) [s], and the
            share of each sample, same axes; axes of nodes and movements may be 1.
        redrawn: Log weights of the nodes in each group, (group, node), where every movement draws
            its own node; None: one node holds for the whole run.
        on_way: Log density of the readings on the way at each node, (run, movement, node); None:
            as for any motor that settles off its target.
        lasting: Whether the motor is off by about the same in all movements.
    """

    motor: int
    held: bool
    angle: FloatArray
    log_prior: FloatArray
    size: FloatArray
    onsets: Callable[[int], tuple[FloatArray, FloatArray]]
    redrawn: FloatArray | None = None
    on_way: FloatArray | None = None
    lasting: bool = False


@dataclass(frozen=True)
class Estimate:
    """What one run says of a fault that is taken to be there.

    Attributes:
        onset: Distribution of the onset [s]; None without a fault.
        size: Distribution of the magnitude; None where it has none.
        became: Probability of each alternative, (movement, alternative).
    """

    onset: Weighted | None
    size: Weighted | None
    became: FloatArray


@dataclass(frozen=True)
class Weight:
    """What some runs say of one hypothesis.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement given all others, (run, movement).
        settled: The same of its settled position alone.
        estimate: Onset and size in a run, by its index; asked for the best hypothesis alone.
    """

    log_evidence: FloatArray
    by_movement: FloatArray
    settled: FloatArray
    estimate: Callable[[int], Estimate]


@dataclass(frozen=True)
class Posterior:
    """Log evidence of each run, and of first movement and cell given it.

    Attributes:
        log_evidence: (run,).
        log_share: Log posterior, (run, movement first spoilt, cell).
        by_movement: Log density of each movement given all others, (run, movement).
        settled: The same of its settled position alone.
    """

    log_evidence: FloatArray
    log_share: FloatArray
    by_movement: FloatArray
    settled: FloatArray


def posterior_of(
    log_healthy: FloatArray,
    density: FloatArray,
    log_prior: FloatArray,
    on_way: tuple[FloatArray, FloatArray],
) -> Posterior:
    """Sum over the first movement that a fault spoils and over its cells.

    Args:
        log_healthy: Log density of each settled position if all is well, (run, movement).
        density: The same with the fault, (run, movement, cell).
        log_prior: Log probability of first movement and cell, (run, movement, cell).
        on_way: Log density of the readings on the way if all is well, (run, movement), and with
            the fault, (run, movement, cell) or the same for all cells, (run, movement, 1).
    """
    healthy, faulty = log_healthy + on_way[0], density + on_way[1]
    before = np.cumsum(healthy, axis=1) - healthy
    after = np.cumsum(faulty[:, ::-1], axis=1)[:, ::-1]
    joint = before[:, :, None] + after + log_prior
    log_evidence = log_sum(joint, axis=(1, 2))
    log_share = joint - log_evidence[:, None, None]
    return Posterior(
        log_evidence,
        log_share,
        _by_movement(healthy, faulty, log_share),
        _by_movement(log_healthy, density, log_share),
    )


@dataclass(frozen=True)
class Densities:
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


def densities(scene: Scene, law: Law) -> Densities:
    """Return what each movement says of a fault of one motor."""
    by_node = by_cell = scene.profile(law.motor).log_density(law.angle, law.held)
    if law.redrawn is not None:  # (run, movement, group, node) summed over nodes
        by_cell = log_sum(by_node[:, :, None] + law.redrawn, axis=-1)
    way = law.on_way
    if way is None:
        way = scene.on_way_off(law.motor, law.lasting)[..., None]
    return Densities(by_node, by_cell, way)


def weigh(scene: Scene, law: Law) -> Weight:
    """Return what the runs say of a fault of one motor."""
    profile, says = scene.profile(law.motor), densities(scene, law)
    by_node, density, way = says.by_node, says.by_cell, says.way
    found = posterior_of(scene.log_healthy, density, law.log_prior, (scene.on_way, way))

    def estimate(run: int) -> Estimate:
        share = np.exp(found.log_share[run])
        if law.redrawn is None:
            cells = share.sum(axis=0)
            size = Weighted(_of_run(law.size, run), cells)
            nodes = np.broadcast_to(cells, by_node[run].shape)
        else:
            of_node = np.exp(by_node[run][:, None] + law.redrawn - density[run][..., None])
            size = _rms(scene.evidence.movements.exists[run], of_node, share, law.size[0])
            nodes = np.einsum("fg,mgn->mn", share, of_node)
        became = _became(profile, law, run, share, nodes)
        return Estimate(_onset(law, run, share), size, became)

    return Weight(found.log_evidence, found.by_movement, found.settled, estimate)


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


def _of_run(values: FloatArray, run: int) -> FloatArray:
    """Return the part of one run; a leading axis of 1 is the same for all."""
    return np.asarray(values[run if len(values) > 1 else 0])


def _onset(law: Law, run: int, share: FloatArray) -> Weighted:
    """Return the distribution of the onset of a run [s]."""
    onset, part = law.onsets(run)
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
        offset: Offsets, (node,).
    """
    there = exists[:, None]
    second, fourth = (np.einsum("mgn,n->mg", nodes, offset**p) * there for p in (2, 4))

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
    profile: MotorProfile, law: Law, run: int, share: FloatArray, nodes: FloatArray
) -> FloatArray:
    """Return the probability of each alternative at the most probable nodes of a run.

    Args:
        profile: What each movement says of the motor.
        law: The fault.
        run: Index of the run.
        share: Posterior of first movement and cell, (movement, cell).
        nodes: Posterior of each node, (movement, node).

    Returns:
        (movement, alternative).
    """
    angle = _of_run(law.angle, run)
    shape = (*nodes.shape, angle.shape[-1])
    best = np.argmax(nodes, axis=1)
    angle = np.broadcast_to(angle, shape)[np.arange(len(best)), best]
    spoilt = np.cumsum(share.sum(axis=1))[:, None] > 0.5
    own = profile[run]
    terms = np.where(spoilt, own.log_terms(angle, law.held), own.log_terms(own.expected, False))
    return share_of(terms, profile.outlier, own.usable)


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
