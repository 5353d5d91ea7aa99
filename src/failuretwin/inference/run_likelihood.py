"""Some runs, ready to be weighed: what was seen, and what a healthy robot would do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.command_loss import Alternatives
from failuretwin.inference.evidence import MovingEvidence, SettledEvidence
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.joint_likelihood import Findings, MotorProfile, find
from failuretwin.inference.transient_likelihood import RampModel
from failuretwin.inference.transients import CourseJudge, Transients

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
        remembered: What every movement says by itself, where that was computed before.
    """

    evidence: SettledEvidence
    model: HealthyModel
    moving: MovingEvidence | None = None
    way_blur: float = 1.0
    remembered: Findings | None = None
    _off: dict[int, FloatArray] = field(default_factory=dict, init=False, compare=False, repr=False)
    _held: dict[int, FloatArray] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )

    def __getitem__(self, run: int) -> Scene:
        """Return the scene of one of the runs."""
        rows = slice(run, run + 1)
        moving = None if self.moving is None else self.moving[rows]
        return Scene(self.evidence[rows], self.model, moving, self.way_blur)

    @cached_property
    def findings(self) -> Findings:
        """What every movement says by itself."""
        if self.remembered is not None and self.remembered.model is self.model:
            return self.remembered
        return find(self.evidence, self.model)

    @property
    def alternatives(self) -> Alternatives:
        """What may have become of each movement."""
        return self.findings.alternatives

    @property
    def late(self) -> FloatArray:
        """Probability that each movement started late, (run, movement)."""
        return self.model.late(self.evidence.movements, self.evidence.resumed)

    @cached_property
    def start(self) -> FloatArray:
        """Pose of a healthy arm before the run, (run, motor) [rad]."""
        initial = self.evidence.movements.initial
        return self.model.settle(initial, np.zeros_like(initial), self.model.none_held)

    @cached_property
    def transients(self) -> Transients | None:
        """What the readings on the way say; None where they are left aside."""
        if self.moving is None:
            return None
        model = replace(self.model, blur=self.model.blur * self.way_blur)
        ramps = RampModel(model, self.evidence, self.moving)
        found = self.findings
        return Transients(CourseJudge(ramps, found.alternatives), found.terms, found.poses)

    @cached_property
    def on_way(self) -> FloatArray:
        """Log density of the readings on the way if no motor is faulty, (run, movement)."""
        return np.zeros(self.usable.shape) if self.transients is None else self.transients.healthy

    def on_way_off(self, motor: int, gain: FloatArray | None = None) -> FloatArray:
        """Return the same with one motor that settles off its target, (run, movement).

        Args:
            motor: Index of the motor.
            gain: By how much it is off for each unit of an amount that holds for the run,
                (run, movement, alternative) [rad]; None: other movements do not tell.
        """
        if self.transients is None:
            return self.on_way
        if gain is not None:
            return self.transients.off(motor, self.profile(motor), gain)
        if motor not in self._off:
            self._off[motor] = self.transients.off(motor, self.profile(motor))
        return self._off[motor]

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
        return with_outliers(self.findings.terms, self.model.outlier_log_density, self.usable)

    @cached_property
    def became(self) -> FloatArray:
        """Probability of each alternative if no motor is faulty, (run, movement, alternative)."""
        return share_of(self.findings.terms, self.model.outlier_log_density, self.usable)

    @property
    def usable(self) -> BoolArray:
        """Movements with evidence, (run, movement)."""
        return self.evidence.usable

    def profile(self, motor: int) -> MotorProfile:
        """Return what each movement says of one motor."""
        return self.findings.profiles[motor]


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
