"""Which samples of a path are readings of the sensor, and which lie on a line drawn between two.

Where the grid is finer than the sensor's true rate, somebody has filled it. Three samples of a path
drawn out by straight lines lie on one line, to rounding, unless a reading is in the middle; those
of a real arm do not, for noise and because its path bends. So the corners are the readings, and a
gap is a long line. A tool at rest says the same number again and again, and there a line cannot be
told from readings: those count as often as the sensor reads.

A joint that slides does move the tool along a line. A path is taken for drawn only if it is
straight from corner to corner all along, which that of a slide that gathers speed is not;
once drawn out, the steady part of its way counts as a line.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from failuretwin.core.runs import measured_rate, time_step
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray, as_floats

if TYPE_CHECKING:
    import xarray as xr

STRAIGHT = 1e-6
"""Steps along a drawn line differ by no more than this share of their length [-]. Of a joint that
turns, they differ by the angle of a step: a count in 4 s makes 1e-5."""
ROUNDINGS = 4.0
"""Roundings of a coordinate that may add up in the difference of two steps."""
CROWDED = 0.05
"""Share of a moving path's samples that may stand in a row of corners [-]. Lines have none; of a
path that bends everywhere all do, of a slide that speeds up and slows down, a third."""
REPEATED_PERIODS = 1.5
"""A path at one place for longer than this is no single line between regular readings."""
LEAST_PERIODS = 0.75
"""Readings of a tool at one place are put no closer than this to one that is known."""
TRAVEL_RAD = 0.02
"""Travel of two motors that must show at the tool [rad], a degree; one may be stuck."""
SETTLED_S = 0.15
"""A tool sets out this long after its command at the latest [s], if it does so on time."""


@dataclass(frozen=True)
class MeasuredSamples:
    """The readings behind the samples of many runs.

    Attributes:
        point: Tool positions, (run, time, axis) [m]; NaN where there is no reading.
        seen: Where there is one, (run, time).
        assumed: Readings of a tool that stays at one place, put there at the sensor's rate: it may
            not have been read at all, (run, time).
        filled: Runs whose path is filled between readings, and not by straight lines: every sample
            there is passes for a reading, (run,).
    """

    point: FloatArray
    seen: BoolArray
    assumed: BoolArray
    filled: BoolArray


def measured_samples(runs: xr.Dataset) -> MeasuredSamples:
    """Return the readings behind the samples of each run.

    Args:
        runs: A run set; `measured` (run, time, axis), its true rate and, where a path ends at one
            place, `command` (run, time, motor) are read.
    """
    point = as_floats(runs["measured"].values)
    seen = np.isfinite(_largest(point))
    assumed, filled = np.zeros_like(seen), np.zeros(len(seen), dtype=bool)
    every = grid_steps(runs)
    if every < 2:
        return MeasuredSamples(point, seen, assumed, filled)
    between = seen[:, 1:-1] & seen[:, :-2] & seen[:, 2:]
    dense = np.flatnonzero(between.any(axis=1))
    whole = np.where(seen[dense][..., None], point[dense], np.nan)
    shapes = _Shapes.of(whole, seen[dense], as_floats(runs["time"].values))
    lines = shapes.drawn_by_lines()
    filled[dense] = ~lines & (2 * between[dense].sum(axis=1) >= seen.shape[1])
    dense, shapes = dense[lines], shapes[lines]
    if len(dense) == 0:
        return MeasuredSamples(point, seen, assumed, filled)
    rests, settle = _Rests.of(shapes), round(SETTLED_S / time_step(runs))
    head, tail = _held(rests, as_floats(runs["command"].values[dense]), every, settle)
    held = (rests.head & head[:, None]) | (rests.tail & tail[:, None])
    assumed[dense] = rests.readings(every) & ~held
    beside = shapes.on_line | shapes.beside_corner()
    seen[dense] &= ~(beside | (rests.inside & ~assumed[dense]))
    return MeasuredSamples(np.where(seen[..., None], point, np.nan), seen, assumed, filled)


def grid_steps(runs: xr.Dataset) -> int:
    """Return how many steps of the grid lie between two readings of the sensor."""
    return round(1.0 / (measured_rate(runs) * time_step(runs)))


PerSample = Annotated[BoolArray, Axes("run", "time", empty=False)]


@dataclass(frozen=True)
class _Shapes(ArrayStruct):
    """How paths run through each of their samples, (run, time) each.

    A sample with a neighbour missing is none of the first three, except at the ends of a path.

    Attributes:
        on_line: Amid a straight line along which the tool moves.
        at_rest: Amid a stretch at one place, or at an end of the path that begins or ends in one.
        corner: Neither.
        bend: Change of the step from sample to sample there [m].
        seen: Samples that are there.
    """

    on_line: PerSample
    at_rest: PerSample
    corner: PerSample
    bend: Annotated[FloatArray, Axes("run", "time")]
    seen: PerSample

    @classmethod
    def of(cls, point: FloatArray, seen: BoolArray, time: FloatArray) -> _Shapes:
        """Return the shapes of paths (run, time, axis) [m] on a grid (time,) [s]."""
        step = np.diff(point, axis=1)
        size = _largest(step)
        rounding = ROUNDINGS * _rounding(point)[:, None]
        still = size <= rounding
        grid = np.diff(time)
        share = STRAIGHT + float(np.ptp(grid) / grid.mean())  # a grid in single precision is uneven
        bend = np.zeros(seen.shape)
        bend[:, 1:-1] = _largest(np.diff(step, axis=1))
        straight = bend[:, 1:-1] <= rounding + share * np.maximum(size[:, 1:], size[:, :-1])
        inside = np.isfinite(bend)
        inside[:, [0, -1]] = False
        at_rest, on_line = np.zeros_like(seen), np.zeros_like(seen)
        at_rest[:, 1:-1] = still[:, 1:] & still[:, :-1]
        on_line[:, 1:-1] = straight & ~at_rest[:, 1:-1]
        row, (first, last) = np.arange(len(seen)), _ends(seen)
        at_rest[row, first] = still[row, np.minimum(first, still.shape[1] - 1)]
        at_rest[row, last] = still[row, np.maximum(last - 1, 0)]
        return cls(on_line, at_rest, inside & ~(on_line | at_rest), bend, seen)

    def drawn_by_lines(self) -> BoolArray:
        """Return which paths are straight lines from corner to corner, all along, (run,)."""
        amid = self.corner[:, 1:-1] & self.corner[:, :-2] & self.corner[:, 2:]
        moving = self.on_line.sum(axis=1) + self.corner.sum(axis=1)
        few = amid.sum(axis=1) <= CROWDED * moving
        return np.asarray(few & self.on_line.any(axis=1))

    def beside_corner(self) -> BoolArray:
        """Return the flatter of each two corners side by side, (run, time).

        A reading that lies between two times of the grid bends the line at both.
        """
        flatter = np.zeros_like(self.corner)
        corner = np.pad(self.corner, ((0, 0), (1, 2)))
        pair = corner[:, 1:-2] & corner[:, 2:-1] & ~corner[:, :-3] & ~corner[:, 3:]
        run, first = np.nonzero(pair)
        later = self.bend[run, first] >= self.bend[run, first + 1]
        flatter[run, first + later] = True
        return flatter


def _largest(vector: FloatArray) -> FloatArray:
    """Return the largest size of a component of (..., axis); much faster than a maximum by axis."""
    x, y, z = (np.abs(vector[..., axis]) for axis in range(3))
    return np.maximum(np.maximum(x, y), z)


def _ends(seen: BoolArray) -> tuple[IntArray, IntArray]:
    """Return the first and the last sample of each path, (run,) each."""
    return np.argmax(seen, axis=1), seen.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)


def _rounding(point: FloatArray) -> FloatArray:
    """Return how finely each path (run, time, axis) is stored: its last digit, (run,) [m]."""
    far = np.nanmax(np.abs(point), axis=(1, 2), initial=0.0)
    single = point.astype(np.float32)
    coarse = ((single == point) | np.isnan(point)).all(axis=(1, 2))
    return far * np.where(coarse, np.finfo(np.float32).eps, np.finfo(np.float64).eps)


@dataclass(frozen=True)
class _Rests:
    """Stretches in which paths drawn by lines stay at one place.

    Attributes:
        inside: Samples amid such a stretch, (run, time).
        since: The last sample before it that is not, (run, time).
        until: The first one after it, (run, time).
        first: First sample of each path, (run,).
        last: Its last sample, (run,).
    """

    inside: BoolArray
    since: IntArray
    until: IntArray
    first: IntArray
    last: IntArray

    @classmethod
    def of(cls, shapes: _Shapes) -> _Rests:
        """Return the stretches of some paths."""
        inside, end = shapes.at_rest, shapes.seen.shape[1] - 1
        place = np.arange(end + 1)
        since = np.maximum.accumulate(np.where(inside, 0, place), axis=1)
        until = np.minimum.accumulate(np.where(inside, end, place)[:, ::-1], axis=1)[:, ::-1]
        return cls(inside, since, until, *_ends(shapes.seen))

    @property
    def head(self) -> BoolArray:
        """Samples amid the stretch that a path begins with, (run, time)."""
        return np.asarray(self.inside & (self.since <= self.first[:, None]))

    @property
    def tail(self) -> BoolArray:
        """Samples amid the stretch that it ends with, (run, time)."""
        return np.asarray(self.inside & (self.until >= self.last[:, None]))

    def repeats(self, every: int) -> BoolArray:
        """Return whether the sensor says the same number twice before the path's end, (run,)."""
        lasting = self.until - self.since > REPEATED_PERIODS * every
        return np.asarray((self.inside & lasting & ~self.head & ~self.tail).any(axis=1))

    def readings(self, every: int) -> BoolArray:
        """Return which samples pass for readings: one every so many, (run, time).

        They are counted from where a reading is for sure: where a stretch begins, or a head ends.
        """
        place = np.arange(self.inside.shape[1])
        after, before = place - self.since, self.until - place
        head, tail = self.head, self.tail
        counted = np.where(head, before, after)
        apart = (before >= LEAST_PERIODS * every) | head | tail
        return np.asarray(self.inside & (counted % every == 0) & apart)

    @property
    def bounds(self) -> tuple[IntArray, IntArray]:
        """Where heads end and tails begin, (run,) each; the path's own ends if it has none."""
        row, first, last = np.arange(len(self.inside)), self.first, self.last
        begun = np.where(self.inside[row, first], self.until[row, first], first)
        ended = np.where(self.inside[row, last], self.since[row, last], last)
        return begun, ended


def _held(rests: _Rests, command: FloatArray, every: int, settle: int) -> tuple[BoolArray, ...]:
    """Return which paths hold their first reading backwards and their last forwards, (run,) each.

    Whoever draws lines may do so, as the usual functions for it do. A held value looks like a tool
    at rest, and passes for one but in two cases: where motors are told to travel meanwhile that no
    single stuck one could hide, and where the sensor does not repeat itself at any rest before.

    Args:
        rests: Stretches at one place.
        command: References of the same runs, (run, time, motor) [rad].
        every: Samples from one reading to the next.
        settle: Samples after which a tool has set out.
    """
    (begun, ended), flickers = rests.bounds, ~rests.repeats(every)
    head, tail = np.zeros((2, len(command)), dtype=bool)
    for run, reference in enumerate(command):
        noisy = bool(flickers[run]) and _rests_between(reference, 3 * every + settle)
        start, stop = int(rests.first[run]), int(rests.last[run])
        if begun[run] - start > REPEATED_PERIODS * every:
            head[run] = noisy or _travels(reference[start : begun[run] - every - settle])
        if stop - ended[run] > REPEATED_PERIODS * every:
            tail[run] = noisy or _travels(reference[ended[run] : stop + 1])
    return head, tail


def _travels(reference: FloatArray) -> bool:
    """Return whether a reference (time, motor) [rad] moves two motors."""
    if len(reference) == 0 or reference.shape[1] < 2:
        return False
    return bool(np.sort(np.ptp(reference, axis=0))[-2] > TRAVEL_RAD)


def _rests_between(reference: FloatArray, samples: int) -> bool:
    """Return whether a reference (time, motor) stands still for so long between two movements."""
    moves = np.flatnonzero(np.any(np.diff(reference, axis=0) != 0.0, axis=1))
    return bool(np.any(np.diff(moves) > samples))
