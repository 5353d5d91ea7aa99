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


# The samples of the last seconds, each robot by its own times.

KEEP_S = 30.0
"""How long samples are kept [s]; movements that take longer are not found."""
FIRST_ROOM = 64
"""Samples of a robot that there is room for at first."""
FULL, GROWTH = 0.75, 1.5
"""Share of the room from which it grows when it is used up, and by what factor."""


class SampleBuffer:
    """Commands and readings of the last seconds, in the order of their times."""

    def __init__(self, robots: int, motors: int, channels: int = 3) -> None:
        self._first = np.zeros(robots, dtype=np.int64)
        self._stop = np.zeros(robots, dtype=np.int64)
        self._time = np.full((robots, FIRST_ROOM), np.inf)
        self._command = np.empty((robots, FIRST_ROOM, motors))
        self._measured = np.empty((robots, FIRST_ROOM, channels))

    def time(self, robot: int) -> FloatArray:
        """Return the times of a robot, increasing, (sample,) [s]."""
        return self._time[robot, self._first[robot] : self._stop[robot]]

    def command(self, robot: int) -> FloatArray:
        """Return its references, (sample, motor) [rad]; NaN where not known."""
        return self._command[robot, self._first[robot] : self._stop[robot]]

    def measured(self, robot: int) -> FloatArray:
        """Return its readings, (sample, channel) [m]; NaN where there is none."""
        return self._measured[robot, self._first[robot] : self._stop[robot]]

    def add(self, time: FloatArray, command: FloatArray, measured: FloatArray) -> None:
        """Take a sample of each robot; one that comes late takes its place among the others.

        Times are (robot,) [s], NaN: none of this robot; references (robot, motor) [rad], readings
        (robot, channel) [m], NaN where there is none.
        """
        rows = np.flatnonzero(np.isfinite(time))
        if len(rows) == 0:
            return
        self._make_room(rows)
        stop = self._stop[rows]
        newest = np.where(stop > self._first[rows], self._time[rows, stop - 1], -np.inf)
        late = time[rows] <= newest
        for robot in rows[late].tolist():
            self._insert(robot, float(time[robot]), command[robot], measured[robot])
        new, at = rows[~late], stop[~late]
        self._time[new, at] = time[new]
        self._command[new, at], self._measured[new, at] = command[new], measured[new]
        self._stop[new] += 1
        oldest = self._time[rows, self._stop[rows] - 1] - KEEP_S
        while (old := self._time[rows, self._first[rows]] < oldest).any():
            self._first[rows[old]] += 1

    def _insert(self, robot: int, time: float, command: FloatArray, measured: FloatArray) -> None:
        """Take a sample of one robot that is no newer than its newest."""
        known = self.time(robot)
        at = int(self._first[robot]) + int(np.searchsorted(known, time))
        if self._time[robot, at] == time:
            _fill(self._command[robot, at], command)
            _fill(self._measured[robot, at], measured)
            return
        stop = int(self._stop[robot])
        for values, value in (
            (self._time, time),
            (self._command, command),
            (self._measured, measured),
        ):
            values[robot, at + 1 : stop + 1] = values[robot, at:stop].copy()
            values[robot, at] = value
        self._stop[robot] += 1

    def since(self, robot: int, time: float) -> slice:
        """Return the samples of a robot that are no older than a time [s]."""
        known = self.time(robot)
        return slice(int(np.searchsorted(known, time)), len(known))

    def readings_since(self, robots: IntArray, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings of some robots, each since a time, (robot,) [s].

        Returns:
            Readings (robot, sample, channel) [m] and their times (robot, sample) [s]; behind the
            last of a robot NaN and inf.
        """
        known = [self.since(robot, at) for robot, at in zip(robots.tolist(), time, strict=True)]
        begin = self._first[robots] + np.array([one.start for one in known], dtype=np.int64)
        count = np.array([one.stop - one.start for one in known], dtype=np.int64)
        place = np.arange(count.max(initial=0))
        there = place < count[:, None]
        at = robots[:, None], np.where(there, begin[:, None] + place, 0)
        measured = np.where(there[..., None], self._measured[at], np.nan)
        return measured, np.where(there, self._time[at], np.inf)

    def state(self) -> dict[str, np.ndarray]:
        """Return all samples, by name; behind the last of a robot times are inf."""
        robots = np.arange(len(self._first))
        count = self._stop - self._first
        place = np.arange(count.max(initial=0))
        there = place < count[:, None]
        at = robots[:, None], np.where(there, self._first[:, None] + place, 0)
        return {
            "samples/time": np.where(there, self._time[at], np.inf),
            "samples/command": np.where(there[..., None], self._command[at], np.nan),
            "samples/measured": np.where(there[..., None], self._measured[at], np.nan),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over the samples of another stream.

        Raises:
            KeyError: If something is missing.
            ValueError: If something is of another shape.
        """
        time, command, measured = (state[f"samples/{what}"] for what in SAMPLED)
        robots, count = time.shape
        shapes = [(robots, count, self._command.shape[2]), (robots, count, self._measured.shape[2])]
        if robots > len(self._first) or [command.shape, measured.shape] != shapes:
            raise ValueError(f"samples have shapes {command.shape}, {measured.shape}")
        self._first[:], self._stop[:] = 0, 0
        self._resize(max(FIRST_ROOM, count))
        self._stop[:robots] = np.isfinite(time).sum(axis=1)
        self._time[:robots, :count] = time
        self._command[:robots, :count], self._measured[:robots, :count] = command, measured

    def _make_room(self, rows: IntArray) -> None:
        room = self._time.shape[1]
        if int(self._stop[rows].max()) < room:
            return
        count = int((self._stop - self._first).max())
        self._resize(int(GROWTH * room) if count > FULL * room else room)

    def _resize(self, room: int) -> None:
        """Move the samples of every robot to the begin of a room of another size."""
        count = self._stop - self._first
        place = np.arange(int(count.max(initial=0)))
        at = (
            np.arange(len(count))[:, None],
            np.minimum(self._first[:, None] + place, self._time.shape[1] - 1),
        )
        for name in ("_time", "_command", "_measured"):
            old = getattr(self, name)
            new = np.empty((len(old), room, *old.shape[2:]))
            new[:, : len(place)] = old[at]
            setattr(self, name, new)
        self._first[:], self._stop[:] = 0, count


SAMPLED = ("time", "command", "measured")
"""What a sample holds."""


def _fill(old: FloatArray, new: FloatArray) -> None:
    """Replace the values of one robot, in place, if something new is known of it."""
    if np.isfinite(new).all():
        old[:] = new
