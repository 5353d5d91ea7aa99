"""What some runs say of a healthy robot and of each motor: all that fault models draw from.

L_m(healthy), L_m(phi) of each motor, and the same of the readings on the way, (run, movement) each,
every part worked out once, when it is asked for.

Section: docs/inference.md#likelihood
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.robot import HELD_BEYOND
from failuretwin.inference.movements.joint_likelihood import (
    JointLikelihood,
    MovementLikelihoods,
    movement_likelihoods,
)
from failuretwin.inference.movements.transient_likelihood import TransientLikelihood
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel

HELD_ANGLES = 25
"""Held angles at which the way is judged, over a range of `USUAL_TRAVEL` or less."""
USUAL_TRAVEL = 3.4
"""Range of held angles up to which so few are enough [rad]; over a wider one they are more."""


@dataclass(frozen=True)
class RunLikelihood:
    """The posterior predictive density of a healthy robot for some runs, movement by movement.

    What was seen, laid beside what a healthy robot would do given the movements before; from the
    same numbers, the density of every movement with one motor off or held.

    Attributes:
        evidence: Settled positions.
        model: The healthy robot.
        moving: Readings on the way; None: they are left aside.
        transient_scatter_factor: Factor on the scatter of the way alone; 1 for a robot as it is.
        remembered: What every movement says by itself, where that was computed before.
        part_of: All runs, and which of them these are; None: these are all.
        healthy: Log density of each settled position if no motor is faulty, (run, movement), where
            that is not what the movements say of a healthy robot.
        memo: What was found on the way of each motor, by kind and index of the motor.
    """

    evidence: SettledEvidence
    model: HealthyModel
    moving: TransientSamples | None = None
    transient_scatter_factor: float = 1.0
    remembered: MovementLikelihoods | None = None
    healthy: FloatArray | None = None
    part_of: tuple[RunLikelihood, IntArray | slice] | None = field(
        default=None, compare=False, repr=False
    )
    memo: dict[tuple[str, int], FloatArray] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    def __getitem__(self, run: int | IntArray) -> RunLikelihood:
        """Return one or some of the runs alone."""
        rows = slice(run, run + 1) if isinstance(run, int | np.integer) else run
        moving = None if self.moving is None else self.moving[rows]
        return replace(
            self, evidence=self.evidence[rows], moving=moving, remembered=None, part_of=(self, rows)
        )

    def alike(self, runs: IntArray) -> RunLikelihood:
        """Return some of the runs alone, all seen at rest or all on the way."""
        return replace(self[runs], evidence=self.evidence.alike(runs))

    def since(self, movement: int) -> RunLikelihood:
        """Return the settled positions from one movement on, as if the runs began with it."""
        seen, healthy = self.evidence[:, movement:], self.healthy
        seen = replace(seen, movements=self.evidence.movements.since(movement))
        return RunLikelihood(
            seen,
            self.model,
            remembered=self.findings[:, movement:],
            healthy=None if healthy is None else healthy[:, movement:],
        )

    @cached_property
    def findings(self) -> MovementLikelihoods:
        """What every movement says by itself."""
        if self.remembered is not None and self.remembered.model is self.model:
            return self.remembered
        if self.part_of is not None and self.part_of[0].model is self.model:
            whole, rows = self.part_of
            return whole.findings[rows]
        return movement_likelihoods(self.evidence, self.model)

    @cached_property
    def healthy_pose(self) -> FloatArray:
        """Where a healthy arm settles if its commands arrive, (run, movement, motor) [rad]."""
        outcomes = self.model.outcomes_as_seen(self.evidence)
        base, direction = outcomes.base[:, :, 0], outcomes.direction[:, :, 0]
        return self.model.settle(base, direction, self.model.none_held)

    @property
    def outcomes(self) -> CommandOutcomes:
        """What may have become of each movement."""
        return self.findings.outcomes

    @cached_property
    def late(self) -> FloatArray:
        """Probability that each movement started late, (run, movement)."""
        return self.model.late(self.evidence.movements, self.evidence.first_reading_delay)

    @cached_property
    def start(self) -> FloatArray:
        """Pose of a healthy arm before the run, (run, motor) [rad]."""
        initial = self.evidence.movements.initial
        return self.model.settle(initial, np.zeros_like(initial), self.model.none_held)

    @cached_property
    def transients(self) -> TransientLikelihood | None:
        """What the readings on the way say; None where they are left aside."""
        if self.moving is None:
            return None
        model, factor = self.model, self.transient_scatter_factor
        if factor != 1.0:
            model = replace(model, scatter_factor=model.scatter_factor * factor)
        return TransientLikelihood(model, self.evidence, self.moving, self.findings, self.start)

    @cached_property
    def log_transient(self) -> FloatArray:
        """Log density of the readings on the way if no motor is faulty, (run, movement)."""
        return np.zeros(self.usable.shape) if self.transients is None else self.transients.healthy

    def log_transient_offset(self, motor: int, gain: FloatArray | None = None) -> FloatArray:
        """Return the same with one motor that settles off its target, (run, movement).

        Args:
            motor: Index of the motor.
            gain: By how much it is off for each unit of an amount that holds for the run,
                (run, movement, outcome) [rad]; None: other movements do not tell.
        """
        if self.transients is None:
            return self.log_transient
        if gain is not None:
            return self.transients.offset(motor, self.profile(motor), gain)
        known = ("off", motor)
        if known not in self.memo:
            self.memo[known] = self.transients.offset(motor, self.profile(motor))
        return self.memo[known]

    def log_transient_stuck(self, motor: int, angle: FloatArray) -> FloatArray:
        """Return the same with one motor that is held at some angle or gets stuck there.

        Args:
            motor: Index of the motor.
            angle: Angles, (run, node) [rad].

        Returns:
            (run, movement, node); between the angles that were computed, a straight line.
        """
        if self.transients is None:
            return np.repeat(self.log_transient[..., None], angle.shape[1], axis=2)
        low, high = self.held_range(motor)
        known = ("held", motor)
        if known not in self.memo:
            grid = np.linspace(low, high, self.spread_over(motor, HELD_ANGLES), axis=1)
            self.memo[known] = self.transients.stuck(motor, self.profile(motor), grid)
        last = self.memo[known].shape[2] - 1
        place = np.clip((angle - low[:, None]) / (high - low)[:, None] * last, 0, last)
        left = np.minimum(place.astype(np.int64), last - 1)
        share = (place - left)[:, None]
        shape = (*self.usable.shape, angle.shape[1])
        at, after = (
            np.take_along_axis(self.memo[known], np.broadcast_to(k[:, None], shape), axis=2)
            for k in (left, left + 1)
        )
        return at + share * (after - at)

    def held_range(self, motor: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest angle at which a motor may be held, (run,) [rad] each.

        Its travel, wider where a run's commands go beyond, and a little more.
        """
        robot, movements = self.model.twin.robot, self.evidence.movements
        (low, high), margin = robot.travel[motor], robot.held_beyond(motor)
        told = np.column_stack([movements.initial[:, motor], movements.target[..., motor]])
        lowest, highest = np.nanmin(told, axis=1), np.nanmax(told, axis=1)
        return np.minimum(low, lowest) - margin, np.maximum(high, highest) + margin

    def spread_over(self, motor: int, usual: int) -> int:
        """Return how many nodes lie over its range as densely as `usual` ones over `USUAL_TRAVEL`.

        Args:
            motor: Index of the motor.
            usual: The fewest; as many as there are over any narrower range.
        """
        robot = self.model.twin.robot
        if robot.slides[motor]:
            return usual
        wider = (1.0 + 2.0 * HELD_BEYOND) * float(np.ptp(robot.travel[motor])) / USUAL_TRAVEL
        return int(np.ceil(usual * max(wider, 1.0)))

    @cached_property
    def log_healthy(self) -> FloatArray:
        """Log density of each settled position if no motor is faulty, (run, movement)."""
        if self.healthy is not None:
            return self.healthy
        terms = log_sum(self.findings.terms, axis=-1)
        return np.where(self.usable, np.logaddexp(terms, self.model.outlier_log_density), 0.0)

    @cached_property
    def outcome_probability(self) -> FloatArray:
        """Probability of each outcome if no motor is faulty, (run, movement, outcome)."""
        return share_of(self.findings.terms, self.model.outlier_log_density, self.usable)

    @property
    def usable(self) -> BoolArray:
        """Movements with evidence, (run, movement)."""
        return self.evidence.usable

    def profile(self, motor: int) -> JointLikelihood:
        """Return what each movement says of one motor."""
        return self.findings.profiles[motor]


def share_of(terms: FloatArray, outlier: float, usable: BoolArray) -> FloatArray:
    """Return the probability of each outcome; 0 where there is no evidence.

    Args:
        terms: Log weight times density of each outcome, (..., outcome).
        outlier: The same of the tool being anywhere.
        usable: Movements with evidence, (...).
    """
    total = np.logaddexp(log_sum(terms, axis=-1), outlier)
    return np.where(usable[..., None], np.exp(terms - total[..., None]), 0.0)
