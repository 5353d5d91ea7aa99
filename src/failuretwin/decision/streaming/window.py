"""The last movements of many robots: the evidence of a recorded run, movement by movement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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
class MovementLook(ArrayStruct):
    """What a model says of the last movements of each robot.

    Attributes:
        first: How well outcomes explain each movement if motors stood as commanded before it.
        judged: Movements of which all is up to date, (robot, movement).
        likelihoods: What every movement says by itself.
    """

    first: Explanation
    judged: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    likelihoods: MovementLikelihoods

    def judge(self, robots: IntArray, evidence: SettledEvidence) -> None:
        """Look anew at the movements of some robots that are not judged."""
        some, known, model = _first_of(robots, evidence), self.likelihoods, self.likelihoods.model
        run, movement = np.nonzero(evidence.movements.exists & ~self.judged[some])
        if len(run) == 0:
            return
        item, at = (run[:, None], movement[:, None]), (robots[run][:, None], movement[:, None])
        single, usual = evidence[item], model.outcomes(evidence.movements)
        self.first.put(at, model.explain(single, usual[item]))
        seen = model.outcomes_as_seen(evidence, self.first[some])
        explanation = model.explain(single, seen[item])
        known.explanation.put(at, explanation)
        density = known.explanation.density[some]
        alone = model.filtered_outcomes(evidence, seen, density)[item]
        profiles = joint_likelihoods(single, model, alone, range(len(model.scatter)))
        known.put(at, MovementLikelihoods(model, alone, explanation, tuple(profiles)))
        self.judged[at] = True


MOST_LOOKS = 2
"""Models whose looks are kept: the calibration that is given, and one more."""


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
        looks: What the models that were asked last say; it can be computed anew.
    """

    count: Annotated[IntArray, Axes("run", empty=0)]
    forgotten: Annotated[IntArray, Axes("run", empty=0)]
    zero_s: Annotated[FloatArray, Axes("run", empty=np.nan)]
    read_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    settled: SettledEvidence
    transient: TransientSamples
    looks: list[MovementLook] = field(default_factory=list)

    @classmethod
    def of(cls, model: HealthyModel, robots: int, movements: int) -> MovementWindow:
        """Return windows of so many movements at most, without any yet."""
        sizes = {"motor": len(model.scatter), "axis": model.sensors.channels}
        return cls.empty(run=robots, movement=movements, reading=MOST_READINGS, **sizes)

    def renew(self, at: tuple[IntArray, IntArray]) -> None:
        """Note that something new was seen of some movements, (robot, movement)."""
        for look in self.looks:
            look.judged[at] = False

    def append(self, robots: IntArray, movements: Movements) -> None:
        """Add a movement of some robots; where there is no room, the oldest is forgotten.

        Movements are a run each, of one movement, by the time of the stream.
        """
        known = self.settled.movements
        self.forget_oldest(robots[self.count[robots] == known.start.shape[1]])
        place = self.count[robots]
        first = np.where(place[:, None] == 0, movements.initial, known.initial[robots])
        known.put((robots, place), movements[:, 0])
        known.initial[robots] = first
        self.count[robots] += 1

    def forget_oldest(self, runs: IntArray) -> None:
        """Drop the oldest movement of some robots."""
        if len(runs) == 0:
            return
        known, longer = self.settled.movements, runs[self.count[runs] > 1]
        if len(longer):
            known.initial[longer] = known[longer, :2].origin()[:, 1]
        super().forget_oldest(runs)
        for look in self.looks:
            look.forget_oldest(runs)
        self.zero_s[runs] = known.start[runs, 0]
        self.count[runs] -= 1
        self.forgotten[runs] += 1

    def evidence(self, robots: IntArray) -> tuple[SettledEvidence, TransientSamples]:
        """Return what was seen of some robots; times count from `zero_s`."""
        some = robots, slice(0, int(self.count[robots].max(initial=0)))
        zero = self.zero_s[robots, None]
        settled = self.settled[some]
        movements = replace(settled.movements, start=settled.movements.start - zero)
        begin, end = settled.begin - zero, settled.end - zero
        return replace(settled, movements=movements, begin=begin, end=end), self.transient[some]

    def judge(
        self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel
    ) -> MovementLikelihoods:
        """Return what the last movements of some robots say, looking anew at what is not judged."""
        look = self._look_of(model)
        look.judge(robots, evidence)
        return look.likelihoods[_first_of(robots, evidence)]

    def _look_of(self, model: HealthyModel) -> MovementLook:
        """Return the look of a model; it is the newest from now on."""
        looks = self.looks
        known = [look for look in looks if look.likelihoods.model is model]
        if not known:
            likelihoods = movement_likelihoods(self.settled[:0], model)
            shape = self.settled.usable.shape
            judged = np.zeros(shape, dtype=bool)
            first = likelihoods.explanation.blank(*shape)
            known = [MovementLook(first, judged, likelihoods.blank(*shape))]
        others = [look for look in looks if look is not known[0]]
        looks[:] = [*others, *known][-MOST_LOOKS:]
        return known[0]


def _first_of(robots: IntArray, evidence: SettledEvidence) -> tuple[IntArray, slice]:
    """Return some robots and as many movements as there is evidence of."""
    return robots, slice(0, evidence.usable.shape[1])


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
