"""The last movements of many robots: the evidence of a recorded run, movement by movement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.arrays import ArrayStruct, Axes
from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.evidence import MOST_READINGS, SettledEvidence, TransientSamples
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.joint_likelihood import (
    MovementLikelihoods,
    joint_likelihoods,
    movement_likelihoods,
)


@dataclass(frozen=True)
class MovementWindow(ArrayStruct):
    """The last movements of each robot, oldest first; a robot is what a run is in a recording.

    Times are those of the stream. Behind the last movement there is nothing.

    Attributes:
        count: Movements that there are, (robot,).
        forgotten: Movements that there were before them, (robot,).
        zero_s: When the window begins: with the stream or its oldest movement, (robot,) [s].
        read_s: When the tool was last read, (robot,) [s].
        settled: Where the tools settled.
        transient: What was read on the way.
        judged: Movements of which `likelihoods` are up to date, (robot, movement).
        likelihoods: What every movement says by itself.
    """

    count: Annotated[IntArray, Axes("run", empty=0)]
    forgotten: Annotated[IntArray, Axes("run", empty=0)]
    zero_s: Annotated[FloatArray, Axes("run", empty=np.nan)]
    read_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    settled: SettledEvidence
    transient: TransientSamples
    judged: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    likelihoods: MovementLikelihoods

    @classmethod
    def of(cls, model: HealthyModel, robots: int, movements: int) -> MovementWindow:
        """Return windows of so many movements at most, without any yet."""
        sizes = {"motor": len(model.scatter), "axis": 3, "reading": MOST_READINGS}
        settled = SettledEvidence.empty(run=0, movement=movements, **sizes)
        none = cls(
            count=np.zeros(0, dtype=np.int64),
            forgotten=np.zeros(0, dtype=np.int64),
            zero_s=np.zeros(0),
            read_s=np.zeros(0),
            settled=settled,
            transient=TransientSamples.empty(run=0, movement=movements, **sizes),
            judged=np.zeros((0, movements), dtype=bool),
            likelihoods=movement_likelihoods(settled, model),
        )
        return none.blank(robots, movements)

    def append(self, robot: int, movements: Movements, number: int) -> None:
        """Add a movement of a robot; where there is no room, the oldest is forgotten.

        Args:
            robot: Index of the robot.
            movements: Movements of a single run, by the time of the stream.
            number: Which of them.
        """
        known = self.settled.movements
        if self.count[robot] == known.start.shape[1]:
            self.forget_oldest(robot)
        place = int(self.count[robot])
        first = movements.origin()[0, number] if place == 0 else known.initial[robot].copy()
        known.put((robot, place), movements[0, number])
        known.initial[robot] = first
        self.count[robot] += 1

    def forget_oldest(self, run: int) -> None:
        """Drop the oldest movement of a robot."""
        known = self.settled.movements
        if self.count[run] > 1:
            known.initial[run] = known[[run], : self.count[run]].origin()[0, 1]
        super().forget_oldest(run)
        self.zero_s[run] = known.start[run, 0]
        self.count[run] -= 1
        self.forgotten[run] += 1

    def evidence(self, robots: IntArray) -> tuple[SettledEvidence, TransientSamples]:
        """Return what was seen of some robots; times count from `zero_s`."""
        some, zero = self._of(robots), self.zero_s[robots, None]
        settled = self.settled[some]
        movements = replace(settled.movements, start=settled.movements.start - zero)
        begin, end = settled.begin - zero, settled.end - zero
        return replace(settled, movements=movements, begin=begin, end=end), self.transient[some]

    def judge(
        self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel
    ) -> MovementLikelihoods:
        """Return what the last movements of some robots say, looking anew at what is not judged.

        Args:
            robots: Their indices, (run,).
            evidence: Where their tools settled.
            model: The healthy robot.
        """
        some, usual = self._of(robots), model.outcomes(evidence.movements)
        run, movement = np.nonzero(evidence.movements.exists & ~self.judged[some])
        if len(run):
            item, at = (run[:, None], movement[:, None]), (robots[run][:, None], movement[:, None])
            single, known = evidence[item], self.likelihoods
            density, poses = model.explain(single, usual[item])
            known.density[at] = density
            alone = model.filtered_outcomes(evidence, usual, known.density[some])[item]
            profiles = joint_likelihoods(single, model, alone, range(len(model.scatter)))
            known.put(at, MovementLikelihoods(model, alone, density, poses, tuple(profiles)))
            self.judged[at] = True
        return self.likelihoods[some]

    def _of(self, robots: IntArray) -> tuple[IntArray, slice]:
        """Return some robots and as many movements as any of them has."""
        return robots, slice(0, int(self.count[robots].max(initial=0)))
