"""Point-to-point movements, their reference, and their detection in a reference.

A movement is a ramp of every motor from its present reference to a target, all starting together,
then a plateau until the next movement. Angles are in the log's sense.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from itertools import pairwise
from typing import Annotated, Self

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.polyline import REST_S, TURN_RAD, simplify
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray

ROUNDING_RAD = 2e-3
"""Tolerance of the straight lines that replace logged references [rad], a tenth of a degree: half a
count of a coarse servo, well below any detectable fault."""

CORNER_TOLERANCE_RAD = 1e-7
"""Largest change of slope per step that counts as rounding [rad]."""
LONGEST_CORNER = 4
"""Largest number of samples of a corner between straight lines; a short ramp has two corners."""
SAME_MOVEMENT_S = 0.25
"""Motors that start within this time belong to one movement [s]: a bus serves six servos in about
0.02 s, and with a smooth start the shortest travel is detected last."""
GUIDED_BENDS = 2.0
"""Changes of speed per start of a movement from which a reference counts as guided by hand [-];
planned ramps that interrupt each other have one at most."""


@dataclass(frozen=True)
class Movements(ArrayStruct):
    """Movements of many runs; runs with fewer movements are padded with NaN at the end.

    Attributes:
        initial: Reference before the first movement, (run, motor) [rad].
        target: Reference on the plateau, (run, movement, motor) [rad].
        ramp_duration: Time from start to target, (run, movement, motor) [s].
        start: Start of the ramps, (run, movement) [s].
    """

    initial: Annotated[FloatArray, Axes("run", "motor", empty=np.nan)]
    target: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]
    ramp_duration: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]
    start: Annotated[FloatArray, Axes("run", "movement", empty=np.nan)]

    @property
    def exists(self) -> BoolArray:
        """Which entries are movements, not padding, (run, movement)."""
        return np.isfinite(self.start)

    def travel(self, run: int) -> FloatArray:
        """Return how far apart the lowest and the highest targets of a run are, (motor,) [rad]."""
        told = np.concatenate([self.initial[run : run + 1], self.target[run][self.exists[run]]])
        return np.asarray(np.ptp(told, axis=0))

    def origin(self) -> FloatArray:
        """Return the reference at the start of each movement, (run, movement, motor) [rad].

        An interrupted ramp ends where the next movement starts.
        """
        origin = np.empty_like(self.target)
        here = self.initial
        for m in range(self.target.shape[1]):
            origin[:, m] = here
            here = here + (self.target[:, m] - here) * self._share_done(m)
        return origin

    def since(self, number: int) -> Self:
        """Return the movements from one on, as if a run began with it."""
        return replace(self[:, number:], initial=self.origin()[:, number])

    def _share_done(self, m: int) -> FloatArray:
        """Return the completed share of ramp `m` when the next movement starts, (run, motor)."""
        if m + 1 == self.start.shape[1]:
            return np.ones_like(self.initial)
        available = (self.start[:, m + 1] - self.start[:, m])[:, None]
        needed = self.ramp_duration[:, m]
        share = np.divide(available, needed, out=np.ones_like(needed), where=needed > 0.0)
        return np.clip(share, 0.0, 1.0)

    def reference(self, time: FloatArray) -> FloatArray:
        """Return the reference of every motor at `time` (time,) [s]: (run, time, motor) [rad]."""
        runs, motors = self.initial.shape
        if self.start.shape[1] == 0:
            return np.repeat(self.initial[:, None], len(time), axis=1)
        knot_time, knot_value = self._knots()
        reference = np.empty((runs, motors, len(time)))
        for at in np.ndindex(runs, motors):
            knots = (at[0], slice(None), at[1])
            reference[at] = np.interp(time, knot_time[knots], knot_value[knots])
        return reference.transpose(0, 2, 1)

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        """Return times and values of the reference's corners, (run, 2 * movement, motor)."""
        runs, count, motors = self.target.shape
        start = np.broadcast_to(self.start[..., None], self.target.shape)
        origin = self.origin()
        following = np.full_like(self.start, np.inf)
        following[:, :-1] = np.where(self.exists[:, 1:], self.start[:, 1:], np.inf)
        end = np.minimum(start + self.ramp_duration, following[..., None])
        reached = np.concatenate([origin[:, 1:], self.target[:, -1:]], axis=1)
        reached = np.where(np.isinf(following)[..., None], self.target, reached)
        times = np.stack([start, end], axis=2).reshape(runs, 2 * count, motors)
        values = np.stack([origin, reached], axis=2).reshape(runs, 2 * count, motors)
        # Padded knots repeat the last real one, so that the reference holds.
        last, held = np.where(np.isfinite(times[:, 0]), -np.inf, 0.0), self.initial
        for knot in range(2 * count):
            missing = ~np.isfinite(times[:, knot])
            times[:, knot] = last = np.where(missing, last, times[:, knot])
            values[:, knot] = held = np.where(missing, held, values[:, knot])
        return times, values


WAY_SAMPLES = 32
"""Samples of the reference from one reading to the next: what a motor makes of its way depends on
all of it."""


@dataclass(frozen=True)
class Stretches(Movements):
    """Movements up to one reading each, at rest or on the way.

    Attributes:
        beginning: Reference at the start of each, (run, movement, motor) [rad].
        speed: Of the reference at the reading, (run, movement, motor) [rad/s]; 0 at rest.
        bend: By what a first-order lag of the reference differs there from the reference that much
            later, (run, movement, motor) [rad].
        direction: Of the friction there, from -1 to 1, (run, movement, motor); NaN: as it last
            travelled.
        done: Share of the movement that each motor had made, (run, movement, motor).
        at_rest: Whether the reading is at rest, (run, movement).
        whole: Whether a stretch is all that is seen of its movement, (run, movement).
        curved: Whether its movement is a curve, not straight ramps, (run, movement).
        movement: Index of its movement, (run, movement).
        way: Reference that shows from the reading before up to this one, evenly in time, (run,
            movement, motor, sample) [rad]; NaN where no run is on its way.
    """

    beginning: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]
    speed: Annotated[FloatArray, Axes("run", "movement", "motor")]
    bend: Annotated[FloatArray, Axes("run", "movement", "motor")]
    direction: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]
    done: Annotated[FloatArray, Axes("run", "movement", "motor", empty=1.0)]
    at_rest: Annotated[BoolArray, Axes("run", "movement", empty=True)]
    whole: Annotated[BoolArray, Axes("run", "movement", empty=True)]
    curved: Annotated[BoolArray, Axes("run", "movement", empty=False)]
    movement: Annotated[IntArray, Axes("run", "movement", empty=0)]
    way: Annotated[FloatArray, Axes("run", "movement", "motor", "sample", empty=np.nan)]

    @classmethod
    def of(cls, movements: Movements) -> Stretches:
        """Return movements as stretches that end at rest; stretches as they are."""
        if isinstance(movements, Stretches):
            return movements
        runs, count, motors = movements.target.shape
        found = cls.empty(run=runs, movement=count, motor=motors, sample=WAY_SAMPLES)
        found.movement[:] = np.arange(count)
        found.beginning[:] = movements.origin()
        known = ("initial", "target", "ramp_duration", "start")
        return replace(found, **{name: getattr(movements, name) for name in known})

    def origin(self) -> FloatArray:
        """Return the reference at the start of each stretch, (run, movement, motor) [rad]."""
        return self.beginning

    @property
    def on_the_way(self) -> BoolArray:
        """Which runs have readings on the way, (run,)."""
        return np.asarray((self.exists & ~self.at_rest).any(axis=1))

    @property
    def as_movements(self) -> Movements:
        """The stretches as movements, of runs that are seen at rest."""
        return Movements(self.initial, self.target, self.ramp_duration, self.start)


def stack_movements(parts: Sequence[Movements]) -> Movements:
    """Return the movements of all `parts` along the run axis, padded to the largest count."""
    first, runs = parts[0], [len(part.start) for part in parts]
    count = max(part.start.shape[1] for part in parts)
    stacked = Movements.empty(run=sum(runs), movement=count, motor=first.initial.shape[1])
    for part, end in zip(parts, np.cumsum(runs), strict=True):
        place = slice(end - len(part.start), end), slice(0, part.start.shape[1])
        stacked.put(place, part)
    return stacked


def find_movements(command: FloatArray, time: FloatArray) -> Movements:
    """Return the movements in piecewise linear references.

    A movement starts where a motor starts or reverses; starts within 0.25 s belong together. A
    curve, and all motion guided by hand (teleoperation), is one movement from rest to rest. Corners
    lie where the lines before and after them meet. The target of an interrupted ramp is the angle
    reached.

    Args:
        command: Reference angles, (run, time, motor) [rad].
        time: Uniform time grid, (time,) [s].
    """
    if not np.all(np.isfinite(command)):
        raise InputError(
            "`command` holds values that are not finite. Expected an angle [rad] at every "
            "sample; hold the last command where a run has ended."
        )
    found: dict[bytes, Movements] = {}  # by digest of the command: runs often repeat a motion
    parts = [Movements.empty(run=0, movement=0, motor=command.shape[2])]
    for run in command:
        key = blake2b(run.tobytes()).digest()
        if key not in found:
            found[key] = _movements_of_run(run, time)
        parts.append(found[key])
    return stack_movements(parts)


@dataclass(frozen=True)
class _Corners:
    """Corners of one motor's reference: times [s], angles [rad] and following speeds [rad/s]."""

    time: FloatArray
    angle: FloatArray
    speed: FloatArray

    def starts(self) -> FloatArray:
        """Return when the motor starts or reverses [s]; other changes of speed are curves."""
        before = np.concatenate([[0.0], self.speed[:-1]])
        return self.time[(self.speed != 0.0) & (before * self.speed <= 0.0)]

    def bends(self) -> int:
        """Return the number of changes of speed without a stop."""
        return int(np.sum((self.speed[1:] != 0.0) & (self.speed[:-1] != 0.0)))

    def stretches(self) -> FloatArray:
        """Return start and end of every line with motion, (line, 2) [s]."""
        lines = np.stack([self.time[:-1], self.time[1:]], axis=1)
        return lines[self.speed[:-1] != 0.0]


def _movements_of_run(command: FloatArray, time: FloatArray) -> Movements:
    """Return the movements in the reference of one run (time, motor), with a run axis of 1."""
    motors = [_corners(reference, time) for reference in command.T]
    start = _merge_starts(np.sort(np.concatenate([c.starts() for c in motors])))
    if max(c.bends() for c in motors) > GUIDED_BENDS * len(start):
        start = _after_rests(start, np.concatenate([c.stretches() for c in motors]))
    end = np.append(start[1:], time[-1])
    target, ramp = np.empty((2, len(start), len(motors)))
    for k, corners in enumerate(motors):
        target[:, k], ramp[:, k] = _ramps(corners, start, end)
    return Movements(command[None, 0], target[None], ramp[None], start[None])


def _corners(reference: FloatArray, time: FloatArray) -> _Corners:
    """Return the corners of one motor's reference (time,), the first being its start at rest."""
    lines = _lines(reference)
    if lines is None:
        times, angles = simplify(time, reference, ROUNDING_RAD)
        speeds = np.append(np.diff(angles) / np.diff(times), 0.0)
        return _Corners(times, angles, speeds)
    step = time[1] - time[0]
    found = [(float(time[0]), float(reference[0]), 0.0)]
    before = 0
    for first, last in lines:
        speed = (reference[last] - reference[first]) / (time[last] - time[first])
        if abs(speed) * step <= CORNER_TOLERANCE_RAD:
            speed = 0.0
        # How far this line lies off the one before it, at its own first sample.
        corner_time, corner_angle, old_speed = found[-1]
        off = reference[first] - corner_angle - old_speed * (time[first] - corner_time)
        turns = abs(speed - old_speed) * step > CORNER_TOLERANCE_RAD
        back = off / (speed - old_speed) if turns else np.inf
        if not turns and abs(off) <= CORNER_TOLERANCE_RAD:
            pass
        elif -0.001 * step <= back <= 1.001 * step:
            at = time[first] - back
            found.append((at, corner_angle + old_speed * (at - corner_time), speed))
        else:  # between the two lies a ramp too short to be a line of its own
            gap = max(time[first] - time[before], 1e-9)
            jump = (reference[first] - reference[before]) / gap
            found.append((time[before], reference[before], jump))
            found.append((time[first], reference[first], speed))
        before = last
    return _Corners(*np.array(found).T)


def _lines(reference: FloatArray) -> list[tuple[int, int]] | None:
    """Return first and last sample of every straight stretch of two steps or more.

    None if the reference bends for longer than any corner.
    """
    steps = reference[1:] - reference[:-1]
    bends = np.abs(steps[1:] - steps[:-1]) > CORNER_TOLERANCE_RAD
    edges = [0, *(np.flatnonzero(bends[1:] != bends[:-1]) + 1).tolist(), len(bends)]
    stretches = list(pairwise(edges)) if len(bends) else []
    bent = int(len(bends) == 0 or not bends[0])  # stretches are bent and straight in turn
    if any(last - first > LONGEST_CORNER for first, last in stretches[bent::2]):
        return None
    return [(first, last + 1) for first, last in stretches[1 - bent :: 2]]


def _merge_starts(starts: FloatArray) -> FloatArray:
    """Return the first of each group of starts that lie within `SAME_MOVEMENT_S`."""
    kept: list[float] = []
    for start in starts.tolist():
        if not kept or start - kept[-1] > SAME_MOVEMENT_S:
            kept.append(start)
    return np.array(kept)


def _after_rests(start: FloatArray, moving: FloatArray) -> FloatArray:
    """Return the starts that follow a rest of all motors, and the first one.

    Starts are (movement,) [s]; lines with motion are (line, 2) [s], start and end.
    """
    kept = []
    for at in start:
        before = moving[moving[:, 0] < at - SAME_MOVEMENT_S, 1]
        if not len(before) or at - before.max() >= REST_S:
            kept.append(at)
    return np.array(kept)


def _ramps(corners: _Corners, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return target [rad] and ramp duration [s] of one motor in each movement, (movement,)."""
    target, duration = np.empty((2, len(start)))
    origin = corners.angle[0]
    for m in range(len(start)):
        last = int(np.searchsorted(corners.time, end[m] - 1e-9)) - 1
        target[m] = corners.angle[last] + corners.speed[last] * (end[m] - corners.time[last])
        inside = (corners.time >= start[m] - 1e-9) & (corners.time < end[m] - 1e-9)
        speeds = np.abs(corners.speed[inside])
        if np.sum(speeds > 0.0) > 1:  # a curve: from its first corner to its last
            moving = np.flatnonzero(inside)[speeds > 0.0]
            stop = corners.time[min(moving[-1] + 1, len(corners.time) - 1)]
            duration[m] = min(stop, end[m]) - corners.time[moving[0]]
        else:
            speed = speeds.max(initial=0.0)
            duration[m] = abs(target[m] - origin) / speed if speed > 0.0 else 0.0
        origin = target[m]
    return target, duration


# Raw references: uneven times and noise.

NOISE_RAD = 1e-9
"""Typical change of slope from which a reference counts as noisy [rad]."""
GRID_S = 0.01
"""Step of the grid for references with uneven times [s]."""


def movements_of_samples(command: FloatArray, time: FloatArray) -> Movements:
    """Return the movements in the reference of one run with arbitrary sample times.

    Args:
        command: Reference angles, (sample, motor) [rad].
        time: Increasing times, at least two, (sample,) [s].
    """
    grid, values = _evenly(time, command)
    bends = np.abs(np.diff(values, 2, axis=0))
    if len(bends) and np.median(bends, axis=0).max() > NOISE_RAD:
        lines = [np.interp(grid, *simplify(grid, value, TURN_RAD)) for value in values.T]
        values = np.stack(lines, axis=-1)
    return find_movements(values[None], grid)


def _evenly(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values (time, motor) on an even grid, unchanged where the grid is even."""
    steps = np.diff(time)
    step = float(steps.min())
    multiples = steps / step
    if np.abs(multiples - np.rint(multiples)).max() < 1e-3 and step >= 0.5 * GRID_S:
        if multiples.max() < 1.5:
            return time, values
        grid = time[0] + step * np.arange(round((time[-1] - time[0]) / step) + 1)
    else:
        grid = np.append(np.arange(time[0], time[-1], GRID_S), time[-1])
        grid = np.linspace(time[0], time[-1], len(grid))
    return grid, np.stack([np.interp(grid, time, v) for v in values.T], axis=-1)
