"""Point-to-point movements, the reference they ask for, and how to find them in a reference.

A movement is a ramp of every motor from where its reference stands to a target, all starting
together, then a plateau until the next movement. Angles are in the log's own sense.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray

CORNER_TOLERANCE_RAD = 1e-7
"""Change of slope times step [rad] below which two segments of a reference are one line."""


@dataclass(frozen=True)
class Movements:
    """Movements of many runs as arrays; runs with fewer movements are padded with NaN at the end.

    Attributes:
        initial: Reference before the first movement, (run, motor) [rad].
        target: Reference on the plateau, (run, movement, motor) [rad].
        ramp_duration: Time from start to target, (run, movement, motor) [s].
        start: Time at which the ramps begin, (run, movement) [s].
    """

    initial: FloatArray
    target: FloatArray
    ramp_duration: FloatArray
    start: FloatArray

    @property
    def exists(self) -> BoolArray:
        """Which entries are movements and which are padding, (run, movement)."""
        return np.isfinite(self.start)

    def origin(self) -> FloatArray:
        """Return the reference at the start of each movement, (run, movement, motor) [rad].

        A ramp that the next movement interrupts ends where it has come to.
        """
        origin = np.empty_like(self.target)
        here = self.initial
        for m in range(self.target.shape[1]):
            origin[:, m] = here
            here = here + (self.target[:, m] - here) * self._share_done(m)
        return origin

    def _share_done(self, m: int) -> FloatArray:
        """Return how much of ramp `m` is done when the next movement starts, (run, motor)."""
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
        for run in range(runs):
            for motor in range(motors):
                reference[run, motor] = np.interp(
                    time, knot_time[run, :, motor], knot_value[run, :, motor]
                )
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
        return _hold_padding(times, values, self.initial)


def _hold_padding(
    times: FloatArray, values: FloatArray, initial: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Replace padded knots by repeats of the last real one, so that the reference holds."""
    last = np.where(np.isfinite(times[:, 0]), -np.inf, 0.0)
    held = initial
    for knot in range(times.shape[1]):
        missing = ~np.isfinite(times[:, knot])
        times[:, knot] = np.where(missing, last, times[:, knot])
        values[:, knot] = np.where(missing, held, values[:, knot])
        last, held = times[:, knot], values[:, knot]
    return times, values


def find_movements(command: FloatArray, time: FloatArray) -> Movements:
    """Find the movements in references from the corners of the piecewise linear `command`.

    A movement starts where a motor leaves a plateau; motors that leave within 0.1 s of each
    other belong to the same movement. Start and end of a ramp are placed between the samples,
    where its line meets the plateaus.

    Args:
        command: Reference angles, (run, time, motor) [rad].
        time: Uniform time grid, (time,) [s].

    Raises:
        InputError: If a command is not finite.
    """
    if not np.all(np.isfinite(command)):
        raise InputError(
            "`command` holds values that are not finite. Expected an angle [rad] at every "
            "sample; hold the last command where a run has ended."
        )
    found = [_movements_of_run(run, time) for run in command]
    count = max((len(start) for start, _, _ in found), default=0)
    runs, _, motors = command.shape
    start = np.full((runs, count), np.nan)
    target = np.full((runs, count, motors), np.nan)
    ramp = np.full((runs, count, motors), np.nan)
    for i, (run_start, run_target, run_ramp) in enumerate(found):
        start[i, : len(run_start)] = run_start
        target[i, : len(run_start)] = run_target
        ramp[i, : len(run_start)] = run_ramp
    return Movements(np.array(command[:, 0]), target, ramp, start)


SAME_MOVEMENT_S = 0.1
"""Motors that start within this time [s] move together; a bus serves six servos in about 0.02 s."""


def _movements_of_run(
    command: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return start (movement,), target and ramp duration (movement, motor) of one run."""
    step = time[1] - time[0]
    moving = np.abs(np.diff(command, axis=0)) > CORNER_TOLERANCE_RAD
    rest = np.zeros((1, command.shape[1]), dtype=bool)
    leaves = moving & ~np.concatenate([rest, moving[:-1]])
    first = _merge_starts(np.flatnonzero(leaves.any(axis=1)), round(SAME_MOVEMENT_S / step))
    if len(first) == 0:
        return np.empty(0), np.empty((0, command.shape[1])), np.empty((0, command.shape[1]))
    last = np.append(first[1:], len(time) - 1)
    target = command[last]
    starts, ramps = zip(
        *(_ramp_times(command[a : b + 1], step) for a, b in zip(first, last, strict=True)),
        strict=True,
    )
    return time[first] + np.array(starts), target, np.array(ramps)


def _merge_starts(samples: IntArray, together: int) -> IntArray:
    """Return the samples that begin a movement: each later than the one before by `together`."""
    kept: list[int] = []
    for sample in samples:
        if not kept or sample - kept[-1] > together:
            kept.append(int(sample))
    return np.array(kept, dtype=np.int64)


def _ramp_times(segment: FloatArray, step: float) -> tuple[float, FloatArray]:
    """Return the start within the first step [s] and the ramp durations (motor,) [s].

    `segment` is (sample, motor) from the last sample before the movement to its end. The slope
    of a ramp is its largest step, since the first and last are shared with a plateau.
    """
    travel = segment[-1] - segment[0]
    steps = np.abs(np.diff(segment, axis=0))
    slope = steps.max(axis=0)
    moves = slope > CORNER_TOLERANCE_RAD
    if not moves.any():
        return 0.0, np.zeros(segment.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        duration = np.where(moves, np.abs(travel) / slope, 0.0)
        delay = np.where(moves & (steps[0] > CORNER_TOLERANCE_RAD), 1.0 - steps[0] / slope, np.inf)
    delay = np.where(np.isfinite(delay), delay, np.inf)
    start = float(delay.min()) if np.isfinite(delay.min()) else 0.0
    return start * step, duration * step
