"""The last movements of many robots: the evidence of a recorded run, movement by movement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.inference.movements.joint_likelihood import (
    MovementLikelihoods,
    joint_likelihoods,
    movement_likelihoods,
)
from failuretwin.inference.observation.evidence import (
    MOST_READINGS,
    SettledEvidence,
    TransientSamples,
)
from failuretwin.inference.observation.healthy_model import Explanation, HealthyModel


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
        first: How well outcomes explain each movement if motors stood as commanded before it.
        judged: Movements of which `first` and `likelihoods` are up to date, (robot, movement).
        likelihoods: What every movement says by itself.
    """

    count: Annotated[IntArray, Axes("run", empty=0)]
    forgotten: Annotated[IntArray, Axes("run", empty=0)]
    zero_s: Annotated[FloatArray, Axes("run", empty=np.nan)]
    read_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    settled: SettledEvidence
    transient: TransientSamples
    first: Explanation
    judged: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    likelihoods: MovementLikelihoods

    @classmethod
    def of(cls, model: HealthyModel, robots: int, movements: int) -> MovementWindow:
        """Return windows of so many movements at most, without any yet."""
        channels = model.sensors.channels
        sizes = {"motor": len(model.scatter), "axis": channels, "reading": MOST_READINGS}
        settled = SettledEvidence.empty(run=0, movement=movements, **sizes)
        likelihoods = movement_likelihoods(settled, model)
        none = cls(
            count=np.zeros(0, dtype=np.int64),
            forgotten=np.zeros(0, dtype=np.int64),
            zero_s=np.zeros(0),
            read_s=np.zeros(0),
            settled=settled,
            transient=TransientSamples.empty(run=0, movement=movements, **sizes),
            judged=np.zeros((0, movements), dtype=bool),
            first=likelihoods.explanation,
            likelihoods=likelihoods,
        )
        return none.blank(robots, movements)

    def looked_at_by(self, model: HealthyModel) -> MovementWindow:
        """Return the same, nothing judged: another healthy robot may have other outcomes."""
        judged = np.zeros_like(self.judged)
        likelihoods = movement_likelihoods(self.settled[:0], model).blank(*judged.shape)
        first = likelihoods.explanation.blank(*judged.shape)
        return replace(self, first=first, likelihoods=likelihoods, judged=judged)

    def append(self, robot: int, movements: Movements, number: int) -> None:
        """Add a movement of a robot; where there is no room, the oldest is forgotten.

        It is one of the movements of a single run, by the time of the stream.
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
        """Return what the last movements of some robots say, looking anew at what is not judged."""
        some, usual = self._of(robots), model.outcomes(evidence.movements)
        run, movement = np.nonzero(evidence.movements.exists & ~self.judged[some])
        if len(run):
            item, at = (run[:, None], movement[:, None]), (robots[run][:, None], movement[:, None])
            single, known = evidence[item], self.likelihoods
            self.first.put(at, model.explain(single, usual[item]))
            seen = model.outcomes_as_seen(evidence, self.first[some])
            explanation = model.explain(single, seen[item])
            known.explanation.put(at, explanation)
            density = known.explanation.density[some]
            alone = model.filtered_outcomes(evidence, seen, density)[item]
            profiles = joint_likelihoods(single, model, alone, range(len(model.scatter)))
            known.put(at, MovementLikelihoods(model, alone, explanation, tuple(profiles)))
            self.judged[at] = True
        return self.likelihoods[some]

    def _of(self, robots: IntArray) -> tuple[IntArray, slice]:
        """Return some robots and as many movements as any of them has."""
        return robots, slice(0, int(self.count[robots].max(initial=0)))


# The samples of the last seconds, of all robots at once.

KEEP_S = 30.0
"""How long samples are kept [s]; movements that take longer are not found."""
FIRST_ROOM = 64
"""Samples that there is room for at first."""


class SampleBuffer:
    """Commands and readings of the last seconds, in the order of their times."""

    def __init__(self, robots: int, motors: int, channels: int = 3) -> None:
        self._first = self._stop = 0
        self._time = np.empty(FIRST_ROOM)
        self._command = np.empty((FIRST_ROOM, robots, motors))
        self._measured = np.empty((FIRST_ROOM, robots, channels))

    @property
    def time(self) -> FloatArray:
        """Times, increasing, (sample,) [s]."""
        return self._time[self._first : self._stop]

    @property
    def command(self) -> FloatArray:
        """References, (sample, robot, motor) [rad]; NaN where not known."""
        return self._command[self._first : self._stop]

    @property
    def measured(self) -> FloatArray:
        """Readings, (sample, robot, channel) [m]; NaN where there is none."""
        return self._measured[self._first : self._stop]

    def add(self, time: float, command: FloatArray, measured: FloatArray) -> None:
        """Take a sample; one that comes late takes its place among the others.

        References are (robot, motor) [rad], readings (robot, channel) [m]; NaN where there is none.
        """
        self._make_room()
        at = self._stop
        if len(self.time) and time <= self.time[-1]:
            at = self._first + int(np.searchsorted(self.time, time))
            if self._time[at] == time:
                _fill(self._command[at], command)
                _fill(self._measured[at], measured)
                return
            for values in (self._time, self._command, self._measured):
                values[at + 1 : self._stop + 1] = values[at : self._stop].copy()
        self._time[at], self._command[at], self._measured[at] = time, command, measured
        self._stop += 1
        oldest = self.time[-1] - KEEP_S
        while self._time[self._first] < oldest:
            self._first += 1

    def since(self, time: float) -> slice:
        """Return the samples that are no older than a time [s]."""
        return slice(int(np.searchsorted(self.time, time)), len(self.time))

    def state(self) -> dict[str, np.ndarray]:
        """Return all samples, by name."""
        return {
            "samples/time": self.time,
            "samples/command": self.command,
            "samples/measured": self.measured,
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over the samples of another stream, in the order of their times."""
        named = (state[name] for name in self.state())
        for time, command, measured in zip(*named, strict=True):
            self.add(float(time), command, measured)

    def _make_room(self) -> None:
        if self._stop < len(self._time):
            return
        count = self._stop - self._first
        room = 2 * len(self._time) if count > len(self._time) // 2 else len(self._time)
        for name in ("_time", "_command", "_measured"):
            old = getattr(self, name)
            new = np.empty((room, *old.shape[1:]))
            new[:count] = old[self._first : self._stop]
            setattr(self, name, new)
        self._first, self._stop = 0, count


def _fill(old: FloatArray, new: FloatArray) -> None:
    """Replace the values of robots (robot, ...) of which something new is known, in place."""
    known = np.isfinite(new).all(axis=-1)
    old[known] = new[known]
