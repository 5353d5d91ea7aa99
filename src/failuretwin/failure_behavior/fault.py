"""Faults in runs: one fault in one run, and those of one mode at one motor over many runs."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.hypothesis import Fault
from failuretwin.core.types import BoolArray, FloatArray

# Courses: severity over time.

STEP, RAMP, INTERMITTENT = PROFILES = ("step", "ramp", "intermittent")
"""Time profiles: sudden, growing linearly, episodic."""

_ROUNDING_S = 1e-9
"""Rounding error of grids and onsets [s]."""


@dataclass(frozen=True)
class Course:
    """Severity of one fault over time, from 0 (absent) to 1 (full magnitude).

    Attributes:
        profile: One of `PROFILES`.
        onset_s: Onset of the fault [s].
        rise_s: Time from the onset to full severity [s]; 0 unless the profile is a ramp.
        episodes: Start and end of each episode [s], in order; of the intermittent profile only.
    """

    profile: str
    onset_s: float
    rise_s: float = 0.0
    episodes: tuple[tuple[float, float], ...] = ()

    def detail(self) -> dict[str, Any]:
        """Return the profile and its parameters as a JSON object."""
        if self.profile == RAMP:
            return {"shape": RAMP, "rise_s": self.rise_s}
        if self.profile == INTERMITTENT:
            return {"shape": INTERMITTENT, "episodes_s": [list(e) for e in self.episodes]}
        return {"shape": self.profile}


def severities(courses: Sequence[Course], time: FloatArray) -> FloatArray:
    """Return the severity of many faults, (run, time), in [0, 1].

    Args:
        courses: One per run.
        time: Instants, common to all runs (time,) or of each run (run, time) [s].
    """
    onset, rise = _columns(courses)
    severity = np.where(
        rise > 0.0,
        np.clip((time - onset) / np.where(rise > 0.0, rise, 1.0), 0.0, 1.0),
        time >= onset - _ROUNDING_S,
    )
    for run, course in enumerate(courses):
        if course.profile == INTERMITTENT:
            at = time if time.ndim == 1 else time[run]
            edges = np.ravel(course.episodes)
            severity[run] = np.searchsorted(edges, at + _ROUNDING_S, side="right") % 2
    return severity


def exposures(courses: Sequence[Course], time: FloatArray) -> FloatArray:
    """Return the integral of the severity up to `time` (time,) [s]: (run, time) [s]."""
    onset, rise = _columns(courses)
    since = np.maximum(time - onset, 0.0)
    growing = since**2 / (2.0 * np.where(rise > 0.0, rise, 1.0))
    exposure = np.where(since < rise, growing, since - 0.5 * rise)
    for run, course in enumerate(courses):
        if course.profile == INTERMITTENT:
            exposure[run] = 0.0
            for start, end in course.episodes:
                exposure[run] += np.clip(time - start, 0.0, end - start)
    return exposure


def _columns(courses: Sequence[Course]) -> tuple[FloatArray, FloatArray]:
    """Return onsets and rise times, each (run, 1) [s]."""
    onset, rise = np.array([(course.onset_s, course.rise_s) for course in courses]).T
    return onset[:, None], rise[:, None]


def draw_episodes(
    onset_s: float,
    end_s: float,
    share: float,
    length_s: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[tuple[float, float], ...]:
    """Return random episodes that fill a given share of the time from the onset on.

    The first starts at the onset. Lengths are uniform, scaled to their sum; the gaps are uniform
    over all divisions of the rest.

    Args:
        onset_s: Start of the first episode [s].
        end_s: End of the run [s].
        share: Share of the time to fill, in [0, 1].
        length_s: Range of the lengths [s].
        rng: Random generator.

    Returns:
        Start and end of each [s]; none where the share is 0.
    """
    span = end_s - onset_s
    filled = share * span
    if filled <= 0.0:
        return ()
    count = max(1, round(filled / (0.5 * sum(length_s))))
    length = rng.uniform(*length_s, count)
    length *= filled / length.sum()
    gap = rng.dirichlet(np.ones(count)) * (span - filled)
    start = onset_s + np.concatenate([[0.0], np.cumsum(length + gap)[:-1]])
    return tuple((float(s), float(s + n)) for s, n in zip(start, length, strict=True))


@dataclass
class EndlessEpisodes:
    """Episodes of an intermittent fault without end, drawn as time proceeds.

    The first starts at the onset. Lengths are uniform, gaps exponential with mean

        E[gap] = E[length] (1 - share) / share

    the limit of `draw_episodes` for a long run.

    Attributes:
        begin_s: Start of the first [s].
        share: Share of the time that they fill in the long run, in (0, 1].
        length_s: Range of their lengths [s].
        rng: Random generator of these episodes only.
    """

    begin_s: float
    share: float
    length_s: tuple[float, float]
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self._drawn: list[tuple[float, float]] = []
        self._next_s = self.begin_s

    def within(self, begin_s: float, end_s: float) -> tuple[tuple[float, float], ...]:
        """Return the episodes that overlap a time interval, start and end of each [s]."""
        rate = (1.0 - self.share) / self.share
        while self._next_s < end_s and self.share > 0.0:
            length = float(self.rng.uniform(*self.length_s))
            gap = float(self.rng.exponential(0.5 * sum(self.length_s) * rate)) if rate else 0.0
            self._drawn.append((self._next_s, self._next_s + length))
            self._next_s += length + gap
        first = bisect_left(self._drawn, (begin_s - self.length_s[1],))
        return tuple(e for e in self._drawn[first:] if e[1] > begin_s and e[0] < end_s)


PerMovement = NDArray[np.float64 | np.bool_]
"""A random number or truth value for each movement."""


@dataclass(frozen=True)
class FaultValue:
    """One fault in one run.

    Attributes:
        fault: Motor and mode.
        magnitude: Size at full severity in the mode's unit; NaN if unknown, or before the motion is
            known.
        course: Onset and severity over time.
        per_movement: Values drawn for each movement, (movement,), by their name in the truth.
    """

    fault: Fault
    magnitude: float
    course: Course
    per_movement: Mapping[str, PerMovement] = field(default_factory=dict)

    @property
    def onset_s(self) -> float:
        """Its onset [s]."""
        return self.course.onset_s

    def detail(self, unit: str) -> dict[str, Any]:
        """Return the full truth as a JSON object; unknown values are None, `unit` is the mode's."""
        return {
            "motor": self.fault.motor,
            "mode": self.fault.mode,
            "magnitude": None if np.isnan(self.magnitude) else self.magnitude,
            "unit": unit,
            "onset_s": self.onset_s,
            "profile": self.course.detail(),
            **{name: values.tolist() for name, values in self.per_movement.items()},
        }


@dataclass(frozen=True)
class FaultGroup:
    """Faults of one mode at one motor, over the runs that have them.

    Attributes:
        magnitude: Size in the mode's unit, (run,).
        courses: Onset and severity over time, one per run, or one for all.
        per_movement: Values drawn for each movement, (run, movement), by name.
    """

    magnitude: FloatArray
    courses: Sequence[Course]
    per_movement: Mapping[str, PerMovement] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Sequence[FaultValue]) -> FaultGroup:
        """Return the faults of several runs as one group."""
        return cls(
            magnitude=np.array([value.magnitude for value in values]),
            courses=[value.course for value in values],
            per_movement={
                name: np.stack([value.per_movement[name] for value in values])
                for name in values[0].per_movement
            },
        )

    def severity(self, time: FloatArray) -> FloatArray:
        """Return the severity (run, time) at `time`, (time,) or (run, time) [s]."""
        return severities(self.courses, time)

    def effect(self, time: FloatArray) -> FloatArray:
        """Return magnitude times severity, (run, time), at `time`, (time,) or (run, time) [s]."""
        return self.magnitude[:, None] * self.severity(time)

    def accumulated(self, time: FloatArray) -> FloatArray:
        """Return the integral of `effect` up to `time` (time,) [s]: (run, time)."""
        return self.magnitude[:, None] * exposures(self.courses, time)


# Inputs of a fault, for one motor in many runs: orders, motion, end of a movement.


@dataclass(frozen=True)
class MotorOrders:
    """Commands of one motor in many runs.

    Attributes:
        target: Targets, (run, movement) [rad].
        ramp_duration: Time from start to target, (run, movement) [s].
        start: Start of each movement, (run, movement) [s].
        lost: Lost commands, (run, movement).
    """

    target: FloatArray
    ramp_duration: FloatArray
    start: FloatArray
    lost: BoolArray


@dataclass(frozen=True)
class MotorMotion:
    """Motion of one motor in many runs.

    Attributes:
        position: Its angles, (run, time) [rad].
        time: Grid of all runs, (time,) [s].
        start: Commanded start of each movement, (run, movement) [s].
    """

    position: FloatArray
    time: FloatArray
    start: FloatArray


@dataclass(frozen=True)
class Arrival:
    """End of a movement of one motor; shapes broadcast against each other.

    Attributes:
        origin: Start angle of the movement [rad].
        target: Its target [rad].
        direction: Sign of the last travel.
        since_onset: Time since the onset of the fault [s].
        sag: Displacement of the healthy motor by the load [rad].
    """

    origin: FloatArray
    target: FloatArray
    direction: FloatArray
    since_onset: FloatArray
    sag: FloatArray
