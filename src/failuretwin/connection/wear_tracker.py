"""A slow tracker of wear: it learns from run after run, late, and never from a faulty one.

Every run waits until `DELAY` more have come. It is learned if it looked healthy and no fault is
suspected by then. A fault is suspected while runs look faulty one after another, and declared when
they go on to, or when the latest runs lie further off the tracked state than wear can take them:
whatever waits is then discarded. So nothing that comes with a fault is ever taken for wear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from failuretwin.connection.wear import (
    RunEvidence,
    WearLimits,
    WearState,
    calibrated_state,
    exceeds_wear_limits,
    learn,
    wear_unit,
    worn_settling,
    worn_variation,
)
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling

# What the tracker keeps of a run and what became of it.

RunOutcome = Literal["learned", "frozen", "discarded"]
"""What became of a run: learned; not learned because a fault was suspected when its turn came; not
learned because it, or a run that it waited for, is faulty."""


@dataclass(frozen=True)
class PendingRun:
    """A run of the latest.

    Attributes:
        number: How many runs had come with it, from 1.
        evidence: What it says.
        open: Whether it may still be learned.
    """

    number: int
    evidence: RunEvidence
    open: bool


@dataclass(frozen=True)
class Step:
    """What one run changed.

    Attributes:
        number: How many runs have come with it.
        evidence: What it says.
        fault_probability: Probability that it is faulty; NaN where nothing can be told.
        cusum: Sum of what runs say for a fault [nats].
        alarm: What is suspected, or empty.
        outcomes: What became of earlier runs or of this one, by number.
        learned_at: Number of the last run learned.
        state: Tracked state.
    """

    number: int
    evidence: RunEvidence
    fault_probability: float
    cusum: float
    alarm: str
    outcomes: tuple[tuple[int, RunOutcome], ...]
    learned_at: int
    state: WearState


DELAY = 25
"""Runs that must follow a run before it is learned."""
SUSPECT = 0.5
"""A run that is faulty with this probability or more is never learned."""
MOST_SCORE = 2.0
"""Most that one run says for or against a fault [nats]: chance may make one look like anything."""
SUSPECTED_NATS, DECLARED_NATS = 2.0, 9.0
"""Sums of what runs say for a fault, never below 0 (a CUSUM, Page 1954), at which it is suspected:
learning stops; and declared: five runs in a row that are sure of it."""


@dataclass(frozen=True)
class Tracker:
    """The tracker between two runs; a run makes a new one.

    Attributes:
        robot: The robot.
        calibration: Where it started from; friction, scatter and all else stay as they are there.
        settling: Settling of the calibration.
        unit: Wear that moves a motor by its scatter, (2 motor,).
        start: Wear of the calibration.
        state: Tracked wear.
        limits: How fast and how far it may go.
        window: The latest runs, oldest first.
        past: The state after every `DELAY` runs of the last horizon, oldest first.
        cusum: Sum of what runs say for a fault [nats].
        arrived: Runs so far.
        learned_at: Number of the last run learned; 0 for none.
        alarm: What is suspected, or empty.
    """

    robot: Robot
    calibration: Imperfections
    settling: Settling
    unit: FloatArray
    start: WearState
    state: WearState
    limits: WearLimits = field(default_factory=WearLimits)
    window: tuple[PendingRun, ...] = ()
    past: tuple[WearState, ...] = ()
    cusum: float = 0.0
    arrived: int = 0
    learned_at: int = 0
    alarm: str = ""

    @classmethod
    def of(
        cls, calibration: Imperfections, robot: Robot, limits: WearLimits | None = None
    ) -> Tracker:
        """Return the tracker that starts from a calibration.

        Raises:
            InputError: If the calibration does not say where motors settle.
        """
        settling = calibration.settling
        if settling is None:
            raise InputError(
                f"imperfections {calibration.name!r} do not say where motors settle, so there is "
                "nothing to track. Give a calibration (`failuretwin calibrate`)."
            )
        unit = wear_unit(robot, settling)
        start = calibrated_state(settling, calibration.variation, unit)
        return cls(robot, calibration, settling, unit, start, start, limits or WearLimits())

    def follow(self, evidence: RunEvidence, fault_probability: float) -> tuple[Tracker, Step]:
        """Return the tracker after one more run, and what it changed.

        Args:
            evidence: What the run says.
            fault_probability: Probability that the run is faulty; NaN where nothing can be told.
        """
        number = self.arrived + 1
        sound = bool(fault_probability < SUSPECT) and evidence.error.size > 0
        window = (*self.window, PendingRun(number, evidence, sound))
        cusum = min(max(self.cusum + _score(fault_probability), 0.0), DECLARED_NATS + MOST_SCORE)
        outcomes: list[tuple[int, RunOutcome]] = [] if sound else [(number, "discarded")]
        alarm = self._declared(window, cusum)
        if alarm:
            outcomes += [(run.number, "discarded") for run in window if run.open]
            window = tuple(replace(run, open=False) for run in window)
        elif cusum >= SUSPECTED_NATS:
            alarm = "the last runs look faulty"
        after = replace(self, window=window, cusum=cusum, arrived=number, alarm=alarm)
        if len(window) > DELAY:
            after, outcome = after._decide_oldest()
            outcomes += outcome
        if number % DELAY == 0:
            snapshots = (*self.past, after.state)[-(self.limits.horizon // DELAY) :]
            after = replace(after, past=snapshots)
        step = Step(
            number,
            evidence,
            fault_probability,
            cusum,
            alarm,
            tuple(outcomes),
            after.learned_at,
            after.state,
        )
        return after, step

    def _decide_oldest(self) -> tuple[Tracker, list[tuple[int, RunOutcome]]]:
        """Return the tracker without the oldest run, learned or not, and what became of it."""
        oldest, window = self.window[0], self.window[1:]
        if not oldest.open:
            return replace(self, window=window), []
        if self.alarm:
            return replace(self, window=window), [(oldest.number, "frozen")]
        state = self.state.blurred(self._walk(oldest.number))
        state = learn(state, oldest.evidence, self.settling.tail_dof)
        learned = replace(self, window=window, state=state, learned_at=oldest.number)
        return learned, [(oldest.number, "learned")]

    def _walk(self, number: int) -> FloatArray:
        """Return the variance of the wear since the last run learned, (2 motor,)."""
        runs = min(number - self.learned_at, self.limits.horizon)
        return runs * (self.limits.rate * self.unit) ** 2

    def _declared(self, window: Sequence[PendingRun], cusum: float) -> str:
        """Return which fault is declared, or nothing."""
        if cusum >= DECLARED_NATS:
            return "runs look faulty one after another"
        found = exceeds_wear_limits(
            [run.evidence for run in window],
            (self.state, *self.past[:1]),
            self.start,
            self.unit,
            self.limits,
            self.settling.tail_dof,
        )
        if found is None:
            return ""
        entry, fast = found
        kind, motor = divmod(entry, len(self.robot.motors))
        how = "changes faster than by wear" if fast else "is worn beyond what is normal"
        return f"{('bias', 'compliance')[kind]} of {self.robot.motor_names[motor]} {how}"

    def in_angle(self, wear: FloatArray) -> FloatArray:
        """Return wear as angles of the motors at their largest load, (2 motor,) [rad]."""
        share = np.divide(wear, self.unit, out=np.zeros_like(wear), where=self.unit > 0.0)
        return share * np.tile(self.unit[: len(wear) // 2], 2)

    @property
    def tracked_settling(self) -> Settling:
        """Where motors settle now."""
        return worn_settling(self.settling, self.state, self.learned_at)

    @property
    def imperfections(self) -> Imperfections:
        """The calibration with tracked bias and compliance and the doubt about them.

        Once it has learned, it has seen runs of unknown state: its protocol is P1.
        """
        if self.learned_at == 0:
            return self.calibration
        now = self.state.blurred(self._walk(self.arrived))
        return replace(
            self.calibration,
            name=f"{self.calibration.name}, tracked",
            protocol="P1",
            settling=self.tracked_settling,
            variation=worn_variation(self.calibration.variation, now),
        )


def _score(fault_probability: float) -> float:
    """Return what a run says for a fault [nats]; nothing where nothing can be told."""
    if np.isnan(fault_probability):
        return 0.0
    share = min(max(fault_probability, 1e-6), 1.0 - 1e-6)
    return float(np.clip(np.log(share / (1.0 - share)), -MOST_SCORE, MOST_SCORE))
