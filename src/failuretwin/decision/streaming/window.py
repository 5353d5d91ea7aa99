"""The last movements of many robots, and where the tool was seen after each."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.command_loss import CommandOutcomes
from failuretwin.inference.evidence import MOST_READINGS, Rest, SettledEvidence, TransientSamples
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.joint_likelihood import (
    JointLikelihood,
    MovementLikelihoods,
    filtered_outcomes,
    joint_likelihoods,
    likelihood_given_outcome,
    movement_likelihoods,
)


@dataclass
class MovementWindow:
    """The last movements of each robot, oldest first; times are those of the stream.

    Attributes:
        count: Movements that there are, (robot,).
        forgotten: Movements that there were before them, (robot,).
        zero_s: When the window begins: with the stream or its oldest movement, (robot,) [s].
        initial: Reference before the oldest movement, (robot, motor) [rad].
        target: (robot, movement, motor) [rad]; NaN where there is no movement, like all that
            follows.
        ramp_duration: (robot, movement, motor) [s].
        start: (robot, movement) [s].
        begin: When the readings that count begin, (robot, movement) [s].
        end: End of each plateau, (robot, movement) [s].
        first_reading_delay: Time from each command to the first reading after it, (robot,
            movement) [s]; NaN where there was none yet.
        point: Where the tool rests, (robot, movement, axis) [m]; 0 where that is not known.
        usable: Movements after which it rests, (robot, movement).
        moving: Movements whose readings do not come to rest, (robot, movement).
        since: Times of readings on the way after the start, (robot, movement, reading) [s].
        way: Those readings, (robot, movement, reading, axis) [m].
        seen: Readings that are there, (robot, movement, reading).
    """

    count: IntArray
    forgotten: IntArray
    zero_s: FloatArray
    initial: FloatArray
    target: FloatArray
    ramp_duration: FloatArray
    start: FloatArray
    begin: FloatArray
    end: FloatArray
    first_reading_delay: FloatArray
    point: FloatArray
    usable: BoolArray
    moving: BoolArray
    since: FloatArray
    way: FloatArray
    seen: BoolArray

    @classmethod
    def empty(cls, robots: int, movements: int, motors: int) -> MovementWindow:
        """Return windows of so many movements at most, without any yet."""
        shape = (robots, movements)
        return cls(
            count=np.zeros(robots, dtype=np.int64),
            forgotten=np.zeros(robots, dtype=np.int64),
            zero_s=np.full(robots, np.nan),
            initial=np.full((robots, motors), np.nan),
            target=np.full((*shape, motors), np.nan),
            ramp_duration=np.full((*shape, motors), np.nan),
            start=np.full(shape, np.nan),
            begin=np.full(shape, np.nan),
            end=np.full(shape, np.nan),
            first_reading_delay=np.full(shape, np.nan),
            point=np.zeros((*shape, 3)),
            usable=np.zeros(shape, dtype=bool),
            moving=np.zeros(shape, dtype=bool),
            since=np.zeros((*shape, MOST_READINGS)),
            way=np.zeros((*shape, MOST_READINGS, 3)),
            seen=np.zeros((*shape, MOST_READINGS), dtype=bool),
        )

    def full(self, robot: int) -> bool:
        """Return whether the oldest movement of a robot must go before another can be added."""
        return bool(self.count[robot] == self.start.shape[1])

    def append(self, robot: int, movements: Movements, number: int) -> None:
        """Add a movement of a robot.

        Args:
            robot: Index of the robot.
            movements: Movements of a single run, by the time of the stream.
            number: Which of them.
        """
        if self.count[robot] == 0:
            self.initial[robot] = movements.origin()[0, number]
        place = int(self.count[robot])
        self.target[robot, place] = movements.target[0, number]
        self.ramp_duration[robot, place] = movements.ramp_duration[0, number]
        self.start[robot, place] = movements.start[0, number]
        self.count[robot] += 1

    def settle(self, robot: IntArray, place: IntArray, end: FloatArray, rest: Rest) -> None:
        """Say where tools rest after movements.

        Args:
            robot: Indices of robots, (item,).
            place: Their movements, (item,).
            end: Ends of the plateaus, (item,) [s].
            rest: Where the tools rest, by item.
        """
        at = robot, place
        self.end[at] = end
        self.point[at], self.usable[at], self.moving[at] = (
            rest.point,
            rest.usable,
            rest.moving,
        )

    def see_on_way(self, robot: int, place: int, time: FloatArray, point: FloatArray) -> None:
        """Say what was read on the way of a movement.

        Args:
            robot: Index of the robot.
            place: The movement.
            time: When, (reading,) [s].
            point: Tool positions, (reading, axis) [m].
        """
        self.seen[robot, place] = np.arange(MOST_READINGS) < len(time)
        self.since[robot, place, : len(time)] = time - self.start[robot, place]
        self.way[robot, place, : len(time)] = point

    def evidence(self, robots: IntArray) -> SettledEvidence:
        """Return where the tools of some robots settled; times count from `zero_s`."""
        some = slice(0, int(self.count[robots].max(initial=0)))
        zero = self.zero_s[robots, None]
        movements = Movements(
            self.initial[robots],
            self.target[robots, some],
            self.ramp_duration[robots, some],
            self.start[robots, some] - zero,
        )
        return SettledEvidence(
            movements,
            self.point[robots, some],
            self.usable[robots, some],
            self.moving[robots, some],
            self.begin[robots, some] - zero,
            self.end[robots, some] - zero,
            self.first_reading_delay[robots, some],
        )

    def log_transient(self, robots: IntArray) -> TransientSamples:
        """Return what was read on the way of the same movements."""
        some = slice(0, int(self.count[robots].max(initial=0)))
        return TransientSamples(
            self.since[robots, some], self.way[robots, some], self.seen[robots, some]
        )

    def forget_oldest(self, robot: int) -> None:
        """Drop the oldest movement of a robot."""
        if self.count[robot] > 1:
            self.initial[robot] = self.evidence(np.array([robot])).movements.origin()[0, 1]
        times = (self.start, self.begin, self.end, self.first_reading_delay)
        for values in (self.target, self.ramp_duration, *times,
                       self.point, self.usable, self.moving, self.since, self.way,
                       self.seen):  # fmt: skip
            values[robot, :-1] = values[robot, 1:].copy()
        for values in (self.target, self.ramp_duration, *times):
            values[robot, -1] = np.nan
        self.point[robot, -1] = 0.0
        self.usable[robot, -1] = self.moving[robot, -1] = False
        self.seen[robot, -1] = False
        self.zero_s[robot] = self.start[robot, 0]
        self.count[robot] -= 1
        self.forgotten[robot] += 1


# Parts of a stream's state as plain arrays, and back.

Arrays = Mapping[str, np.ndarray]


def arrays_of(part: Any, prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays of a dataclass, and of those in it, by ``prefix/name``.

    Fields with ``saved=False`` in their metadata are left out.
    """
    found: dict[str, np.ndarray] = {}
    for entry in dataclasses.fields(part):
        value, name = getattr(part, entry.name), f"{prefix}/{entry.name}"
        if not entry.metadata.get("saved", True):
            continue
        if isinstance(value, np.ndarray):
            found[name] = value
        elif dataclasses.is_dataclass(value):
            found |= arrays_of(value, name)
    return found


def put_arrays(part: Any, prefix: str, arrays: Arrays) -> None:
    """Fill the arrays of a dataclass with what `arrays_of` returned.

    Raises:
        KeyError: If one is missing.
        ValueError: If one is of another shape.
    """
    for name, value in arrays_of(part, prefix).items():
        value[...] = _alike(arrays[name], value.shape, name)


def _alike(value: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
    return value


# What past movements were found to say, kept so that only the present one is looked at anew.

PER_MOTOR = (
    *("mode", "precision", "min_distance2", "log_weight", "expected", "map_pose"),
    "faulty_baseline",
)
"""What is kept of each motor's profile."""


PER_MOVEMENT = ("base", "direction", "chance", "density", "poses")
"""What is kept of each movement beside."""


@dataclass
class LikelihoodCache:
    """Findings of the last movements of many robots.

    Attributes:
        fresh: Movements whose findings are up to date, (robot, movement).
        arrays: What is kept, by name: (robot, movement, ...); of profiles
            (robot, movement, motor, ...). Empty before the first look.
        like: Findings of any movements, for all that is the same for all of them.
    """

    fresh: BoolArray
    arrays: dict[str, FloatArray] = field(default_factory=dict)
    like: MovementLikelihoods | None = field(default=None, metadata={"saved": False})

    @classmethod
    def empty(cls, robots: int, movements: int) -> LikelihoodCache:
        """Return a memory of nothing yet."""
        return cls(np.zeros((robots, movements), dtype=bool))

    def restore(self, arrays: Arrays) -> None:
        """Take over arrays of another memory, by ``memory/name``."""
        self.fresh = arrays["memory/fresh"].copy()
        names = [n for n in (*PER_MOVEMENT, *PER_MOTOR) if f"memory/{n}" in arrays]
        self.arrays = {name: arrays[f"memory/{name}"].copy() for name in names}

    def forget_oldest(self, robot: int) -> None:
        """Drop the oldest movement of a robot."""
        for values in self.arrays.values():
            values[robot, :-1] = values[robot, 1:].copy()
        self.fresh[robot, :-1] = self.fresh[robot, 1:].copy()
        self.fresh[robot, -1] = False

    def findings(
        self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel
    ) -> MovementLikelihoods:
        """Return what the last movements of some robots say, looking at what is not fresh.

        Args:
            robots: Their indices, (run,).
            evidence: Where their tools settled.
            model: The healthy robot.
        """
        usual = model.outcomes(evidence.movements)
        exists = evidence.movements.exists
        stale = np.nonzero(exists & ~self.fresh[robots, : exists.shape[1]])
        at = robots[stale[0]], stale[1]
        if len(stale[0]):
            single, alone = _of_items(evidence, usual, stale)
            density, poses = likelihood_given_outcome(single, model, alone)
            self._put(at, density=density, poses=poses, base=alone.base, direction=alone.direction)
            known = self.arrays["density"][robots, : exists.shape[1]]
            weighed = filtered_outcomes(evidence, model, usual, known)
            alone = replace(alone, log_weight=weighed.log_weight[stale][:, None])
            profiles = joint_likelihoods(single, model, alone, range(len(model.scatter)))
            self._put(at, chance=alone.log_weight, **_together(profiles))
            self.like = MovementLikelihoods(model, alone, density, poses, profiles)
            self.fresh[at] = True
        return self._recall(robots, evidence, model)

    def _put(self, at: tuple[IntArray, IntArray], **values: FloatArray) -> None:
        """Keep values of single movements, (item, 1, ...)."""
        for name, value in values.items():
            if name not in self.arrays:
                self.arrays[name] = np.zeros((*self.fresh.shape, *value.shape[2:]))
            self.arrays[name][at] = value[:, 0]

    def _recall(
        self, robots: IntArray, evidence: SettledEvidence, model: HealthyModel
    ) -> MovementLikelihoods:
        some = robots, slice(0, evidence.usable.shape[1])
        recalled = {name: values[some] for name, values in self.arrays.items()}
        like = self.like = self.like or movement_likelihoods(evidence[:0], model)
        profiles = [
            _profile(profile, {n: recalled[n][:, :, motor] for n in PER_MOTOR}, evidence.usable)
            for motor, profile in enumerate(like.profiles)
        ]
        outcomes = replace(
            like.outcomes,
            base=recalled["base"],
            direction=recalled["direction"],
            log_weight=recalled["chance"],
        )
        return MovementLikelihoods(
            model, outcomes, recalled["density"], recalled["poses"], profiles
        )


def _profile(
    like: JointLikelihood, recalled: Mapping[str, FloatArray], usable: BoolArray
) -> JointLikelihood:
    return replace(
        like,
        mode=recalled["mode"],
        precision=recalled["precision"],
        min_distance2=recalled["min_distance2"],
        log_weight=recalled["log_weight"],
        expected=recalled["expected"],
        map_pose=recalled["map_pose"],
        faulty_baseline=recalled["faulty_baseline"],
        usable=usable,
    )


def _together(profiles: Sequence[JointLikelihood]) -> dict[str, FloatArray]:
    """Return what is kept of profiles, (item, 1, motor, ...), by name."""
    return {
        name: np.stack([getattr(profile, name) for profile in profiles], axis=2)
        for name in PER_MOTOR
    }


def _of_items(
    evidence: SettledEvidence, outcomes: CommandOutcomes, item: tuple[IntArray, ...]
) -> tuple[SettledEvidence, CommandOutcomes]:
    """Return single movements as runs of one movement each."""
    single = replace(
        evidence,
        point=evidence.point[item][:, None],
        usable=evidence.usable[item][:, None],
    )
    alone = replace(
        outcomes,
        base=outcomes.base[item][:, None],
        direction=outcomes.direction[item][:, None],
        log_weight=outcomes.log_weight[item][:, None],
    )
    return single, alone
